"""A stencil in rooms with walls: irradiance by degree, and the receivers' gains that bring it nearest to the truth.

A room is injected, occluded, propagated and read as a solve does it (``difflpv.pipeline``). Irradiance is linear in the gains,
E = sum_l g_l E_l, so that one solve per room gives all that their fit needs: g minimises the mean logarithm of the relative
errors over rooms and components, in which every room counts alike, however hard it is. A handful of numbers for all rooms.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from difflpv.config import LpvConfig, Method
from difflpv.illumination import Component, illuminate
from difflpv.injection import inject
from difflpv.propagation import propagate
from difflpv.sh import cosine_lobe
from difflpv.stencil import LinearStencil
from difflpv.training.rooms import TrainingRoom
from difflpv.weighted import gather_lobes

__all__ = ["RoomResponse", "fit_gains", "mean_room_error"]

_STEPS = 32
_COMPONENTS: tuple[Component, ...] = ("direct", "bounce1")
_START, _ITERATIONS = 0.8, 60


@dataclass(frozen=True, eq=False)
class RoomResponse:
    """Irradiance of a room's receivers by degree, direct and after one bounce, each over the norm of its truth.

    Attributes:
        by_degree: E_l of receivers with a wall behind them, [l_max+1, n, 6], weighted by the root of their area.
        rest: irradiance of the others, which no gain touches, and minus the truth, [n,6], weighted likewise.
    """

    by_degree: torch.Tensor
    rest: torch.Tensor

    @classmethod
    @torch.no_grad()
    def of(
        cls, room: TrainingRoom, stencil: LinearStencil, method: Method, transport: Callable[..., torch.Tensor] = propagate
    ) -> RoomResponse:
        """Solve a room with a stencil, and with a way of moving light, in the place of the method's own."""
        config = LpvConfig(method=method)
        weight = torch.as_tensor(room.receivers.area_weight, dtype=torch.float32)
        lights, truths = [], []
        for component in _COMPONENTS:
            traced = illuminate(room.scene, room.grid, config, component)
            vpls = traced.vpls()
            cells = traced.vpl_cells(vpls)
            volume, _ = inject(vpls, room.grid, l_max=stencil.l_max, deposit="visible", open_cells=cells)
            truth = torch.as_tensor(room.irradiance[component], dtype=torch.float32)
            norm = (weight[:, None] * truth.square()).sum().sqrt()
            lights.append(volume / norm)
            truths.append(truth / norm)
        receivers = traced.receivers(room.receivers.position, room.receivers.normal)
        (reads,) = receivers.reads
        solved = transport(
            torch.cat(lights), stencil, steps=_STEPS, transmittance=traced.blocking[0].passed, occlude_first_step=True
        )
        lobes = cosine_lobe(-receivers.normal, stencil.l_max) / room.grid.cell_size**2
        root = weight.sqrt()[:, None]
        parts = []
        for degree in range(stencil.l_max + 1):
            only = torch.zeros_like(lobes)
            only[:, degree**2 : (degree + 1) ** 2] = lobes[:, degree**2 : (degree + 1) ** 2]
            parts.append(root * gather_lobes(solved, reads.cells, reads.weights, only))
        by_degree = torch.stack(parts)
        free = (1 - reads.backed)[:, None] * by_degree.sum(0)
        return cls(reads.backed[:, None] * by_degree, free - root * torch.cat(truths, 1))

    def errors(self, gains: torch.Tensor) -> torch.Tensor:
        """Relative L2 error of direct light and of one bounce with gains [l_max+1], shape [2]; differentiable."""
        gap = torch.tensordot(gains, self.by_degree, 1) + self.rest
        return torch.stack([part.square().sum().sqrt() for part in gap.split(3, dim=1)])


def mean_room_error(rooms: Sequence[RoomResponse], gains: torch.Tensor) -> torch.Tensor:
    """Geometric mean of the errors of rooms, both components."""
    return torch.stack([room.errors(gains) for room in rooms]).log().mean().exp()


def fit_gains(rooms: Sequence[RoomResponse], l_max: int) -> tuple[float, ...]:
    """Gains by degree [l_max+1] with the least geometric mean error; those of degrees that no receiver reads stay 1."""
    read = min(l_max, 2) + 1  # the cosine lobe has no degree 3
    gains = torch.full((read,), _START, requires_grad=True)
    ones = torch.ones(l_max + 1 - read)
    optimizer = torch.optim.LBFGS([gains], max_iter=_ITERATIONS, line_search_fn="strong_wolfe")

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        loss = mean_room_error(rooms, torch.cat([gains, ones])).log()
        loss.backward()
        return loss

    optimizer.step(closure)
    return (*gains.detach().double().tolist(), *ones.tolist())
