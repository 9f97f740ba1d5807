"""The failure cases of the light probe thesis as cases that any way of placing can be put to.

Sources: 3.1.1 and 3.1.2, "Downfalls and shortcomings"; 3.2.2, "Light leaking". A case is a task, the heuristics that fail at
it, and a number that tells how badly: above ``limit`` is failure. A way that is said not to fail stays below it:
``case.badness(place(case.task(), case.count, "..."))``.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from placement_tasks import HIGH, LIGHT, LOW, WALL, analytic_task, point_light

from difflpv.placement.edge_rays import tetrahedra_cut_by_walls
from difflpv.placement.task import Placement, PlacementTask
from difflpv.probes.probe_set import DIRECTIONS_26, irradiance_of
from difflpv.probes.tetrahedra import TetrahedralInterpolation


@dataclass(frozen=True)
class FailureCase:
    """One way to fail: ``heuristics`` are (method, options) that do."""

    task: Callable[[], PlacementTask]
    count: int
    heuristics: tuple[tuple[str, dict[str, Any]], ...]
    measure: Callable[[PlacementTask, Placement], float]
    limit: float

    def badness(self, task: PlacementTask, placement: Placement) -> float:
        return self.measure(task, placement)


def irradiance_error(task: PlacementTask, placement: Placement) -> tuple[np.ndarray, np.ndarray]:
    """|E - T| and T [m,26,C] at the points, from probes that hold what the placement says or the field."""
    position = torch.as_tensor(placement.position)
    content = task.field(position) if placement.radiance is None else torch.as_tensor(placement.radiance)
    with torch.no_grad():
        E = irradiance_of(TetrahedralInterpolation(position).rows(position, task.points).apply(content), DIRECTIONS_26).numpy()
    T = irradiance_of(task.radiance, DIRECTIONS_26).numpy()
    return np.abs(E - T), T


def _near_light(task: PlacementTask, placement: Placement) -> float:
    """Share of the probes of the lit room that stand within 0.4 m of the light: 3.5 % of that room."""
    lit = placement.position[placement.position[:, 0] < WALL]
    return float((np.linalg.norm(lit - LIGHT, axis=1) < 0.4).mean())


def _behind_wall(task: PlacementTask, placement: Placement) -> float:
    return float((placement.position[:, 0] > WALL).mean())


def _dim_room_unsampled(task: PlacementTask, placement: Placement) -> float:
    """By how much the dim room has fewer probes for its volume than a uniform distribution."""
    share = (HIGH[0] - WALL) / (HIGH[0] - LOW[0])
    return float(share / max(_behind_wall(task, placement), 1e-3))


def _leak(task: PlacementTask, placement: Placement) -> float:
    """Mean error at points of the dark room whose probes stand on both sides, over the mean of the lit room."""
    probes = TetrahedralInterpolation(placement.position).rows(torch.as_tensor(placement.position), task.points).probe.numpy()
    cut = tetrahedra_cut_by_walls(task.raycaster, placement.position, probes)
    dark = task.points[:, 0].numpy() > WALL
    error, truth = irradiance_error(task, placement)
    return float(error[cut & dark].sum() / max(dark.sum(), 1) / truth[~dark].sum() * (~dark).sum())


def _lit_wall(x: np.ndarray) -> np.ndarray:
    """Light that grows toward the wall between the rooms, and none behind it: a bright white wall."""
    mirrored = x.copy()
    mirrored[..., 0] = x[..., 0] - WALL + LIGHT[0] - 0.5  # the wall's glow comes from 0.5 m behind it
    return point_light(mirrored, wall=False, size=0.8) * (x[..., 0] < WALL)[..., None, None]


def _dim_room(x: np.ndarray) -> np.ndarray:
    """The point light in the left room, a hundredth of one in the right."""
    twin = x - np.array([2.2, 0.0, 0.0])
    return point_light(x) + 0.01 * point_light(twin, wall=False) * (x[..., 0] >= WALL)[..., None, None]


def _dim_room_task() -> PlacementTask:
    """Its points weigh as much in the dim room as in the bright one: what one sees there matters."""
    task = analytic_task(radiance=_dim_room)
    dim = task.points[:, 0] > WALL
    energy = task.radiance.square().sum((1, 2))
    weight = torch.where(dim, energy[~dim].mean() / energy[dim].mean(), 1.0)
    return replace(task, weight=weight.double())


CLIMB_ALL = {"until": "converged"}

CASES = {
    "clusters at the light": FailureCase(
        analytic_task, 64, (("irradiance_ascent", CLIMB_ALL), ("spawn_merge", {"closest": 0.1})), _near_light, 0.35
    ),
    "probes behind walls": FailureCase(
        lambda: analytic_task(radiance=_lit_wall),
        27,
        (("irradiance_ascent", CLIMB_ALL | {"backtrack": False}),),
        _behind_wall,
        0.7,
    ),
    "dark areas unsampled": FailureCase(
        _dim_room_task, 27, (("spawn_merge", {}),), _dim_room_unsampled, 2.0
    ),
    "thin walls leak": FailureCase(
        analytic_task, 27, (("spawn_merge", {}), ("irradiance_ascent", {}), ("grid", {})), _leak, 0.1
    ),
}
