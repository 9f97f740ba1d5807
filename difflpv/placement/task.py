"""What a placement knows: the truth at points in free space, a field to fill probes from, and where free space ends."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

from difflpv.probes.lattice import LatticeField
from difflpv.probes.probe_set import COEFFS
from difflpv.probes.reader import ProbeReader
from difflpv.raycast import Raycaster
from difflpv.scene import Scene
from difflpv.triangle_distance import TriangleDistance

__all__ = ["Placement", "PlacementTask", "Progress"]

_WITNESSES = 16

Progress = Callable[[int, float, int], None]
"""Called with the step, the current training error (NaN where a method knows none) and the number of probes."""


@dataclass(frozen=True, eq=False)
class PlacementTask:
    """A scene under one or several lights, for which probes are wanted. All tensors are float64.

    Channels are RGB of one light after the other: C = 3 x lights. One set of positions serves all of them.

    Attributes:
        scene: its geometry stops light between a probe and a receiver.
        points: where probes are read, in free space [m,3] m.
        radiance: true radiance SH there [m,9,C] W/m2, toward the incoming light.
        field: radiance SH [9,C] W/m2 wherever a probe may go: what an unfitted probe holds.
        clearance: signed distance to the nearest surface [m], negative in solids and outside of the scene.
        weight: importance of each point [m]; ones if None.
    """

    scene: Scene
    points: torch.Tensor
    radiance: torch.Tensor
    field: LatticeField
    clearance: LatticeField
    weight: torch.Tensor | None = None

    def __post_init__(self) -> None:
        count = len(self.points)
        if self.points.ndim != 2 or self.points.shape[1] != 3 or not count:
            raise ValueError(f"placement points: expected shape [m,3] with m > 0, got {list(self.points.shape)}")
        shape = list(self.radiance.shape)
        if len(shape) != 3 or shape[:2] != [count, COEFFS] or shape[2] % 3 or not shape[2]:
            raise ValueError(f"placement radiance: expected shape [{count},9,3 x lights], got {shape}")
        if list(self.field.values.shape[3:]) != [COEFFS, shape[2]]:
            raise ValueError(f"placement field: expected [9,{shape[2]}] at a point, got {list(self.field.values.shape[3:])}")
        if self.clearance.values.ndim != 3:
            raise ValueError(f"placement clearance: expected one number a cell, got {list(self.clearance.values.shape[3:])}")
        weight = self.weights
        if weight.shape != (count,) or not bool((weight >= 0).all()) or not bool(weight.sum() > 0):
            raise ValueError(f"placement weight: expected {count} numbers >= 0, not all 0, got {list(weight.shape)}")

    @cached_property
    def weights(self) -> torch.Tensor:
        """``weight``, or ones [m]."""
        return torch.ones(len(self.points), dtype=torch.float64) if self.weight is None else self.weight

    @cached_property
    def raycaster(self) -> Raycaster:
        """Rays against the scene's triangles."""
        return Raycaster(self.scene)

    @cached_property
    def surface_distance(self) -> TriangleDistance:
        """Exact distance to the scene's triangles."""
        return TriangleDistance(self.scene.triangle_vertices)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner [3] m of the box around the points: the working volume of the thesis (3.1.1)."""
        points = self.points.numpy()
        return points.min(0), points.max(0)

    def part(self, *, points: torch.Tensor | None = None, lights: Sequence[int] | None = None) -> PlacementTask:
        """What the task knows of some points (indices or booleans [m]; all if None) under some lights (all if None)."""
        points = torch.arange(len(self.points)) if points is None else points
        number = torch.tensor(range(self.light_count) if lights is None else lights, dtype=torch.long)
        channels = (3 * number[:, None] + torch.arange(3)).flatten()
        return replace(
            self,
            points=self.points[points],
            radiance=self.radiance[points][..., channels],
            field=LatticeField(self.field.grid, self.field.values[..., channels]),
            weight=None if self.weight is None else self.weight[points],
        )

    @property
    def light_count(self) -> int:
        """Light sets."""
        return self.radiance.shape[2] // 3

    def in_free_space(self, position: np.ndarray, margin: float = 0.0, *, seen_by: float = 0.0) -> np.ndarray:
        """True for positions [n,3] m at least ``margin`` m off every surface and in no solid.

        The clearance lattice says so, and the nearest points: one that sees the position, or a share ``seen_by`` of them. The
        lattice misses walls that are thinner than its cells.
        """
        free: np.ndarray = (self.clearance(torch.as_tensor(position, dtype=torch.float64)) > margin).numpy()
        if free.any():
            free[free] = self.seen(np.asarray(position, np.float64)[free], seen_by)
        return free

    def seen(self, position: np.ndarray, share: float = 0.0) -> np.ndarray:
        """True for positions [n,3] m that one of the nearest points sees, and this share of them: none in a solid does."""
        points = self.points.numpy()
        witnesses = min(_WITNESSES, len(points))
        near = points[self._tree.query(position, witnesses)[1]].reshape(len(position), witnesses, 3)
        there = np.broadcast_to(position[:, None], near.shape).reshape(-1, 3)
        ends = near.reshape(-1, 3)
        hidden = self.raycaster.blocked_from_either_end(ends, there)
        seeing = (~hidden).reshape(len(position), witnesses).mean(1)
        return np.asarray((seeing > 0) & (seeing >= share))

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import KDTree

        return KDTree(self.points.numpy())


@dataclass(frozen=True, eq=False)
class Placement:
    """Probes as a method left them.

    Attributes:
        method: its name.
        position: [n,3] m.
        radiance: what they hold for each light [n,9,C] W/m2, or None for the field's value at their positions.
        seconds: spent placing, the targets apart.
        evaluations: how often the field (or its gradient, counted as one more) was taken at all probes.
        history: (step, training error, probe count) as the method went on.
        details: of the method: thresholds it chose, probes it dropped, why it stopped.
        reader: how points are to read them.
    """

    method: str
    position: np.ndarray
    radiance: np.ndarray | None = None
    seconds: float = 0.0
    evaluations: int = 0
    history: tuple[tuple[int, float, int], ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)
    reader: ProbeReader = ProbeReader()

    def __len__(self) -> int:
        return len(self.position)
