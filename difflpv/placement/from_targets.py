"""Path-traced targets as a placement task, and which of their points place and which judge."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from data_gen.probe_targets import ProbeTargets
from difflpv.placement.task import PlacementTask
from difflpv.probes.lattice import LatticeField, fill_from_neighbours
from difflpv.scene import Scene

__all__ = ["light_channels", "placement_task", "split_points"]


def placement_task(
    scene: Scene,
    targets: ProbeTargets,
    *,
    lights: Sequence[int] | None = None,
    points: slice | Sequence[int] | np.ndarray | None = None,
) -> PlacementTask:
    """What targets tell a placement.

    Args:
        scene: which the targets were made for.
        targets: from ``data_gen.probe_targets.make_probe_targets``.
        lights: numbers of light sets, in the order of the task's channels; all if None.
        points: which points, as numpy indices them (see ``split_points``); all if None.

    Returns:
        The task, float64, channels RGB of one light after the other. Cells that are not free hold the light of the nearest
        free one, so that the field between a probe and a wall is that in front of the wall.

    Raises:
        TargetsError: the targets belong to another scene.
        ValueError: a light set or point that there is not, or none.
    """
    targets.check_scene(scene)
    chosen = np.arange(len(targets.light_sets)) if lights is None else np.asarray(lights, dtype=int)
    if chosen.ndim != 1 or not chosen.size or chosen.min() < 0 or chosen.max() >= len(targets.light_sets):
        raise ValueError(f"lights: expected numbers from 0 to {len(targets.light_sets) - 1}, got {lights}")
    rows = np.arange(len(targets.points))
    if points is not None:
        try:
            rows = rows[points if isinstance(points, slice) else np.asarray(points)]
        except IndexError:
            raise ValueError(f"points: expected indices of {len(rows)} points, got others") from None
    field = fill_from_neighbours(light_channels(targets.lattice[chosen]), targets.free)
    return PlacementTask(
        scene,
        torch.as_tensor(targets.points[rows]),
        torch.as_tensor(light_channels(targets.radiance[chosen][:, rows])),
        LatticeField(targets.grid, torch.as_tensor(field)),
        LatticeField(targets.grid, torch.as_tensor(targets.clearance)),
    )


def split_points(targets: ProbeTargets, share: float = 0.75, *, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points to place by, and points to judge by, of both kinds (free space, over surfaces) in the same share.

    Args:
        targets: whose points.
        share: of the points to place by, between 0 and 1.
        seed: the same seed gives the same split.

    Returns:
        Indices into ``targets.points``, ascending: [a] to place by and [b] to judge by, a + b = m.

    Raises:
        ValueError: a share that is none, or one part stays empty.
    """
    if not 0 < share < 1:
        raise ValueError(f"share: expected a number between 0 and 1, got {share}")
    count = len(targets.points)
    random, first = np.random.default_rng(seed), count - targets.surface_count
    train = np.zeros(count, bool)
    for kind in (np.arange(first), np.arange(first, count)):
        train[random.permutation(kind)[: round(share * len(kind))]] = True
    if train.all() or not train.any():
        raise ValueError(f"share: {share} of {count} points leaves one part empty")
    return np.flatnonzero(train), np.flatnonzero(~train)


def light_channels(values: np.ndarray) -> np.ndarray:
    """RGB of each light set [L,...,9,3] as the channels of a ``PlacementTask`` [...,9,3L], float64."""
    moved = np.moveaxis(values, 0, -2).astype(np.float64)
    return moved.reshape(*moved.shape[:-2], -1)
