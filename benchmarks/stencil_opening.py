"""Matrices of their own for the first steps, trained with those of all later ones: a trial of ``stencil_trials.py``.

From the shipped stencil L-BFGS moves [matrices of the first m steps, matrices of the rest], all cube-symmetric with l=0 gain
1, by the training's own loss and by one that weighs lit planes and the nearest cells more. Each result is judged in free
space and, with the gains of receivers refitted to the training's 28 rooms as ``difflpv train-stencil`` does, in rooms and
scenes that nothing was fitted to.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from data_gen.targets import make_targets
from difflpv.config import grid_for
from difflpv.io import load_scene
from difflpv.propagation import propagate, propagate_moving
from difflpv.stability import stability, symbol
from difflpv.stencil import LinearStencil
from difflpv.stencil_coordinates import StencilCoordinates
from difflpv.stencil_files import learned_stencil
from difflpv.training.objective import FreeSpaceLoss, PlaneLoss, Shell, growth_penalty
from difflpv.training.room_loss import RoomResponse, fit_gains, mean_room_error
from difflpv.training.rooms import TrainingRoom, traced_room

NAME = "learned_9x26"
ROOMS, HELD_OUT = 28, 6
SHELLS = ((20, 2.0, 9.5), (30, 9.5, 16.0), (34, 2.0, 9.5), (34, 0.9, 4.0))
SCENES = {"cornell": (0, 1), "two_rooms_90": (0, 1), "atrium": (1,), "planter": (1,)}  # direct, bounce1
PENALTY, MARGIN = 100.0, 1e-3


@dataclass(frozen=True)
class Plan:
    """How many steps have matrices of their own, how long all are trained, and the weights of shells and lit planes."""

    steps: int
    rounds: int
    shells: tuple[float, ...] = (1, 1, 1, 1)
    planes: float = 0.5

    @property
    def name(self) -> str:
        """Its row's title."""
        if not self.rounds:
            return "as shipped"
        loss = "as in training" if self.planes == 0.5 else "planes 8 x"
        return f"{self.steps} step{'s' if self.steps > 1 else ''}, {10 * self.rounds} iterations, {loss}"


PLANS = (
    Plan(0, 0),
    Plan(1, 20),
    Plan(4, 20),
    Plan(1, 5, (2, 2, 1, 3), 4.0),
    Plan(1, 20, (2, 2, 1, 3), 4.0),
    Plan(4, 5, (2, 2, 1, 3), 4.0),
)


def trained(plan: Plan, coordinates: StencilCoordinates, start: torch.Tensor) -> torch.Tensor:
    """Matrices [steps + 1, n, K, K]: of each of the first steps, and of all later ones."""
    shells = tuple(Shell(*shell, weight) for shell, weight in zip(SHELLS, plan.shells, strict=True))
    loss = FreeSpaceLoss(2, 26, shells, size=18, dtype=torch.float32)
    planes = PlaneLoss(2, size=18, dtype=torch.float32, weight=plan.planes)
    lattice = np.stack(np.meshgrid(*[np.linspace(0, np.pi, 7)] * 3), -1).reshape(-1, 3)
    waves = np.unique(-np.sort(-np.concatenate([lattice, lattice / 7, lattice[1:] / 2]), axis=1), axis=0)[1:]
    z = torch.stack([start] * (plan.steps + 1)).requires_grad_(True)

    def matrices() -> torch.Tensor:
        return torch.stack([coordinates.matrices(own) for own in z])

    optimizer = torch.optim.LBFGS(
        [z], max_iter=10, history_size=40, line_search_fn="strong_wolfe", tolerance_grad=0, tolerance_change=0
    )

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        found = loss.responses(matrices().float())
        growth = growth_penalty(matrices()[-1], 26, torch.tensor(waves), margin=MARGIN)
        value = (loss.of(found) + planes.of(found[-1])).double() + PENALTY * growth
        if not bool(torch.isfinite(value)):  # a trial step too far out: the line search turns back
            value = 1e6 + 0.0 * z.sum()
        value.backward()
        return value

    for _ in range(plan.rounds):
        optimizer.step(closure)
    return matrices().detach()


def moved(volume: torch.Tensor, stencil: LinearStencil, opening: torch.Tensor, *, steps: int, **options: Any) -> torch.Tensor:
    """``propagate`` with matrices [m,n,K,K] of their own for the first m steps."""
    passed = torch.zeros_like(volume)
    for own in opening.to(volume):
        passed = passed + volume
        volume = propagate_moving(volume, stencil, steps=1, matrices=own, **options)[1]
    return passed + propagate(volume, stencil, steps=steps - len(opening), **options)


def scene_room(name: str, folder: Path) -> TrainingRoom:
    """A bundled scene with the targets that ``scenes.py`` makes, without receivers outside its grid."""
    scene = load_scene(name)
    grid = grid_for(scene)
    targets = make_targets(
        scene, folder / name, receiver_count=2000, components=("direct", "bounce1"), spp=2048, progress=False
    )
    light, table = targets.lights[0], targets.receivers
    inside = grid.contains(table.position)
    return TrainingRoom(scene, grid, replace(table, area_weight=light.area_weight * inside), light.irradiance)


def symbol_norm(offsets: np.ndarray, opening: torch.Tensor) -> float:
    """Largest factor by which one of the first steps can raise a plane wave: the symbol's 2-norm over wave vectors."""
    waves = np.stack(np.meshgrid(*[np.linspace(0, np.pi, 9)] * 3), -1).reshape(-1, 3)
    symbols = [symbol(LinearStencil(NAME, offsets, own.numpy()), waves) for own in opening]
    return max(float(np.linalg.norm(own, 2, axis=(1, 2)).max()) for own in symbols)


def opening_rows(out: Path, shells: tuple[tuple[float, float, int], ...]) -> list[str]:
    """A table row for each plan."""
    shipped = learned_stencil(NAME)
    coordinates = StencilCoordinates.for_stencil(shipped)
    judge = FreeSpaceLoss(2, 26, tuple(Shell(n, near, far) for near, far, n in shells), size=21, dtype=torch.float32)
    rooms = [traced_room(0, index, out / "rooms") for index in range(ROOMS + HELD_OUT)]
    scenes = {name: scene_room(name, out / "scenes") for name in SCENES}
    rows = []
    for plan in PLANS:
        matrices = trained(plan, coordinates, coordinates.of(shipped))
        stencil = LinearStencil(NAME, coordinates.offsets, matrices[-1].numpy())
        opening, radius = matrices[:-1], stability(stencil).radius

        def response(room: TrainingRoom, stencil: LinearStencil = stencil, opening: torch.Tensor = opening) -> RoomResponse:
            def transport(volume: torch.Tensor, own: LinearStencil, **options: Any) -> torch.Tensor:
                return moved(volume, own, opening, **options)

            return RoomResponse.of(room, stencil, NAME, transport)

        responses = [response(room) for room in rooms]
        gains = torch.tensor(fit_gains(responses[:ROOMS], 2))
        errors = judge.errors(matrices.float())
        errors += [float(mean_room_error(part, gains)) for part in (responses[:ROOMS], responses[ROOMS:])]
        for name, components in SCENES.items():
            found = response(scenes[name]).errors(gains)
            errors += [float(found[component]) for component in components]
        norm = symbol_norm(coordinates.offsets, matrices)
        rows.append(f"| {plan.name} | " + " | ".join(f"{e:.3f}" for e in errors) + f" | {norm:.2f} | {radius:.6f} |")
        print(rows[-1], flush=True)
    return rows
