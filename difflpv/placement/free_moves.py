"""Moves of probes that stay in free space: none crosses a surface, ends close to one or in a solid, or leaves its regions.

The lattice of a task misses plates that are thinner than its cells, and a ray misses what it starts on: a probe that such a
plate attracts would end a few micrometres off it, where one cannot tell on which side. So each place is held to the triangles.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from difflpv.placement.task import PlacementTask

__all__ = ["FreeMoves", "Region"]

Region = tuple[Sequence[float], Sequence[float]]
"""Lowest and highest corner [3] m of a box that probes may stand in."""

_CLEARANCE = 0.003  # of the longest edge of the points' box; the points of targets keep 0.004 of the scene's


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
            clearance: [m]; 0.3 % of the longest edge of the points' box if None.

        Raises:
            ValueError: a region without volume, or a clearance that is no length.
        """
        self._task = task
        self.clearance = _CLEARANCE * float((task.bounds[1] - task.bounds[0]).max()) if clearance is None else clearance
        if not 0 <= self.clearance < float("inf"):
            raise ValueError(f"probe clearance: expected a length >= 0 m, got {clearance}")
        boxes = [tuple(np.asarray(corner, np.float64) for corner in region) for region in regions] or [task.bounds]
        for low, high in boxes:
            if low.shape != (3,) or high.shape != (3,) or not (low < high).all():
                raise ValueError(f"region: expected a lower and a higher corner [3], got {low.tolist()} and {high.tolist()}")
        self._low, self._high = (np.stack([box[k] for box in boxes]) for k in range(2))

    def allowed(self, position: np.ndarray) -> np.ndarray:
        """True for positions [n,3] m in free space, ``clearance`` off every triangle, and in a region."""
        able = self._task.in_free_space(position) & (self._nearest(position) == position).all(1)
        able[able] = self._task.surface_distance(position[able], self.clearance) >= self.clearance
        return np.asarray(able)

    def moved(self, old: np.ndarray, new: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where probes at ``old`` [n,3] m, which are allowed, end on their way to ``new`` [n,3] m; and which of them stay [n].

        A probe that would leave the regions is put back to the nearest place in them. One whose way is barred tries a
        quarter of it, then stays.
        """
        position, stay = np.array(old), np.ones(len(old), bool)
        for share in (1.0, 0.25):
            rest = np.flatnonzero(stay)
            if not len(rest):
                break
            wanted = self._nearest(old[rest] + share * (new[rest] - old[rest]))
            crosses = self._task.raycaster.blocked_from_either_end(old[rest], wanted)
            able = self.allowed(wanted) & ~crosses
            position[rest[able]] = wanted[able]
            stay[rest[able]] = False
        return position, stay

    def _nearest(self, position: np.ndarray) -> np.ndarray:
        """The nearest place in a region."""
        inside = np.clip(position[:, None], self._low, self._high)
        best = np.linalg.norm(inside - position[:, None], axis=2).argmin(1)
        return inside[np.arange(len(position)), best]
