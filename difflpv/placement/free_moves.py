"""Moves of probes that stay in free space: none crosses a surface, ends close to one or in a solid, or leaves its regions.

The lattice of a task misses plates that are thinner than its cells, and a ray misses what it starts on: a probe that such a
plate attracts would end a few micrometres off it, where one cannot tell on which side. So each place is held to the triangles.
And it is held to what the points see: pockets between a solid and a wall, into which hardly any light comes, are no place.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from difflpv.placement.task import PlacementTask

__all__ = ["FreeMoves", "Region"]

Region = tuple[Sequence[float], Sequence[float]]
"""Lowest and highest corner [3] m of a box that probes may stand in."""

_CLEARANCE = 15.0  # times the length within which a ray may miss the surface that it starts at
_SEEN_BY = 0.25  # of the nearest points. In scenes of 36 to 28,656 triangles, light came to all such places in three of four
# tries of 64 paths at least, and to some that fewer points saw in none.
_OFF = 1.01  # times the clearance: what goes along a surface is not barred by rounding


class FreeMoves:
    """Judges moves for one task.

    Attributes:
        clearance: least distance of probes to the nearest triangle [m].
    """

    def __init__(self, task: PlacementTask, regions: Sequence[Region] = (), *, clearance: float | None = None) -> None:
        """Choose.

        Args:
            task: says where free space is.
            regions: without any, the box of the task's points is one.
            clearance: [m]; if None, 0.03 % of the scene's longest edge (or of its farthest coordinate).

        Raises:
            ValueError: a region without volume, or a clearance that is no length.
        """
        self._task = task
        self.clearance = _CLEARANCE * task.raycaster.offset if clearance is None else clearance
        if not 0 < self.clearance < float("inf"):
            raise ValueError(f"probe clearance: expected a length > 0 m, got {clearance}")
        boxes = [tuple(np.asarray(corner, np.float64) for corner in region) for region in regions] or [task.bounds]
        for low, high in boxes:
            if low.shape != (3,) or high.shape != (3,) or not (low < high).all():
                raise ValueError(f"region: expected a lower and a higher corner [3], got {low.tolist()} and {high.tolist()}")
        self._low, self._high = (np.stack([box[k] for box in boxes]) for k in range(2))

    def allowed(self, position: np.ndarray) -> np.ndarray:
        """True for positions [n,3] m in open space, ``clearance`` off every triangle, and in a region."""
        able = self._task.in_free_space(position, seen_by=_SEEN_BY) & (self._nearest(position) == position).all(1)
        able[able] = self._task.surface_distance(position[able], self.clearance) >= self.clearance
        return np.asarray(able)

    def moved(self, old: np.ndarray, new: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where probes at ``old`` [n,3] m, which are allowed, end on their way to ``new`` [n,3] m; and which of them stay [n].

        A probe that would leave the regions is put back to the nearest place in them. One that a surface bars goes along it, in
        a corner along a second one too; where that is barred as well it tries a quarter of its way, then stays.
        """
        position, stay, wanted = np.array(old), np.ones(len(old), bool), np.array(new, np.float64)
        for attempt in ("free", "along", "along", "quarter"):
            rest = np.flatnonzero(stay)
            if not len(rest):
                break
            if attempt == "along":
                wanted[rest] = self._held_off(old[rest], wanted[rest])
            elif attempt == "quarter":
                wanted[rest] = old[rest] + 0.25 * (new[rest] - old[rest])
            there = wanted[rest] = self._nearest(wanted[rest])
            able = self.allowed(there) & ~self._task.raycaster.blocked_from_either_end(old[rest], there)
            position[rest[able]] = there[able]
            stay[rest[able]] = False
        return position, stay

    def _held_off(self, old: np.ndarray, new: np.ndarray) -> np.ndarray:
        """``new`` [n,3] m moved back before the plane of what is in the way from ``old``, or of the nearest triangle."""
        surface, way = self._task.surface_distance, new - old
        length = np.linalg.norm(way, axis=1)
        hits = self._task.raycaster.closest(old, way / np.maximum(length, 1e-30)[:, None])
        triangle = np.where(hits.distance <= length, hits.triangle, surface.nearest(new, self.clearance)[0])
        corner, normal = surface.corners[triangle, 0], surface.normal[triangle]
        side = np.sign(np.einsum("ij,ij->i", old - corner, normal))
        height = side * np.einsum("ij,ij->i", new - corner, normal)
        push = np.where(triangle >= 0, side * np.maximum(_OFF * self.clearance - height, 0), 0.0)
        return np.asarray(new + push[:, None] * normal)

    def _nearest(self, position: np.ndarray) -> np.ndarray:
        """The nearest place in a region."""
        inside = np.clip(position[:, None], self._low, self._high)
        best = np.linalg.norm(inside - position[:, None], axis=2).argmin(1)
        return inside[np.arange(len(position)), best]
