"""Probes moved down the gradient of the reconstruction error: variable projection with moves that stay in free space."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from difflpv.placement.free_moves import FreeMoves
from difflpv.placement.penalties import Penalties
from difflpv.placement.reconstruction import Reconstruction, fitted_content
from difflpv.placement.task import PlacementTask
from difflpv.probes.gaussian import GaussianInterpolation
from difflpv.probes.reader import InterpolationName, ProbeReader
from difflpv.probes.rows import Interpolation, Rows
from difflpv.probes.tetrahedra import TetrahedralInterpolation
from difflpv.probes.visible import Sight, VisibleInterpolation

__all__ = ["Descent", "Probes"]

_MOMENTS = (0.9, 0.99)
_METRIC_RATE = 0.03  # of the largest entry of the metrics, where positions move by `rate` of the box


@dataclass(frozen=True, eq=False)
class Probes:
    """Positions [n,3] m and, where they are read by Gaussians, metrics [n,3,3] 1/m; float64."""

    position: np.ndarray
    metric: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.position)

    def kept(self, index: np.ndarray) -> Probes:
        """Those of ``index``."""
        return Probes(self.position[index], None if self.metric is None else self.metric[index])


@dataclass(frozen=True, eq=False)
class Descent:
    """What the descent goes by.

    Attributes:
        reconstruction: the error, and what probes hold.
        penalties: terms beside it.
        moves: where probes may go.
        interpolation: how points read probes: barycentric in "tetrahedra", or by "gaussian" footprints that are fitted too.
        neighbours: of the Gaussians (``GaussianInterpolation``).
        sight: multiply weights by how far points see the probes (``VisibleInterpolation``).
    """

    reconstruction: Reconstruction
    penalties: Penalties
    moves: FreeMoves
    interpolation: InterpolationName = "tetrahedra"
    neighbours: int = 8
    sight: bool = False

    @property
    def task(self) -> PlacementTask:
        """Points and truth."""
        return self.reconstruction.task

    @cached_property
    def _eyes(self) -> Sight:
        """How far the points see; they look once for all steps."""
        return Sight(self.task.scene, raycaster=self.task.raycaster)

    def reader(self, position: torch.Tensor, metric: torch.Tensor | None) -> Interpolation:
        """The interpolation over probes at ``position`` [n,3] m, differentiable in ``metric`` [n,3,3] 1/m."""
        inner: Interpolation
        if metric is None:
            inner = TetrahedralInterpolation(position)
        else:
            inner = GaussianInterpolation(metric, neighbours=self.neighbours)
        return VisibleInterpolation(inner, self._eyes) if self.sight else inner

    def settled(self, probes: Probes) -> ProbeReader:
        """How points are to read ``probes`` that stay where they are."""
        return ProbeReader(self.interpolation, probes.metric, self.neighbours, self.sight)

    @torch.no_grad()
    def read(self, probes: Probes) -> tuple[Rows, torch.Tensor, torch.Tensor]:
        """Rows of the points, what probes hold and what points read (``Reconstruction.read``)."""
        position, metric = _tensors(probes)
        rows = self.reader(position, metric).rows(position, self.task.points)
        return rows, *self.reconstruction.read(position, rows)

    @torch.no_grad()
    def error(self, probes: Probes) -> float:
        """Training error without penalties."""
        position, metric = _tensors(probes)
        return float(self.reconstruction.error(position, self.reader(position, metric).rows(position, self.task.points)))

    @torch.no_grad()
    def content(self, probes: Probes) -> np.ndarray:
        """Radiance SH [n,9,C] W/m2 fitted to the points."""
        position, metric = _tensors(probes)
        rows = self.reader(position, metric).rows(position, self.task.points)
        return fitted_content(self.task, position, rows, ridge=self.reconstruction.ridge).numpy()

    def run(
        self, probes: Probes, steps: int, first: float, last: float, *, told: Callable[[float], None] | None = None
    ) -> tuple[Probes, float]:
        """Go so many steps of Adam (Kingma and Ba 2015) and return the best probes on the way, with their training error.

        Args:
            probes: in free space.
            steps: how many.
            first: step length in the beginning as a share of the box's longest edge.
            last: in the end; it falls evenly in between.
            told: called with the error after each step.
        """
        low, high = self.task.bounds
        size = float((high - low).max())
        position, metric = _tensors(probes)
        position.requires_grad_(True)
        groups: list[dict[str, object]] = [{"params": [position]}]
        scale = 0.0
        if metric is not None:
            metric.requires_grad_(True)
            groups.append({"params": [metric]})
            scale = float(metric.detach().abs().max()) * _METRIC_RATE
        adam = torch.optim.Adam(groups, lr=1.0, betas=_MOMENTS)
        best, least, lowest = probes, math.inf, math.inf
        for step in range(steps + 1):
            rows = self.reader(position, metric).rows(position, self.task.points)
            error = self.reconstruction.error(position, rows)
            total = error + self.penalties.total(self.task, position, rows, self._eyes if self.penalties.leak else None)
            if float(total.detach()) < lowest:
                lowest, least = float(total.detach()), float(error.detach())
                best = Probes(position.detach().numpy().copy(), None if metric is None else metric.detach().numpy().copy())
            if told is not None:
                told(float(error.detach()))
            if step == steps:
                break
            adam.zero_grad()
            total.backward()
            length = first + step / steps * (last - first)
            adam.param_groups[0]["lr"] = length * size
            if metric is not None:
                adam.param_groups[1]["lr"] = scale * length / first
            old = position.detach().numpy().copy()
            adam.step()
            with torch.no_grad():
                moved, stay = self.moves.moved(old, position.numpy())
                position.copy_(torch.from_numpy(moved))
                adam.state[position]["exp_avg"][torch.from_numpy(stay)] = 0.0  # or it would push at the same wall for long
        return best, least


def _tensors(probes: Probes) -> tuple[torch.Tensor, torch.Tensor | None]:
    metric = None if probes.metric is None else torch.tensor(probes.metric)
    return torch.tensor(probes.position), metric
