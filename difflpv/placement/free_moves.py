"""Moves of probes that stay in free space: none crosses a surface, ends in a solid, or leaves its regions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from difflpv.placement.task import PlacementTask

__all__ = ["FreeMoves", "Region"]

Region = tuple[Sequence[float], Sequence[float]]
"""Lowest and highest corner [3] m of a box that probes may stand in."""


class FreeMoves:
    """Judges moves for one task."""

    def __init__(self, task: PlacementTask, regions: Sequence[Region] = ()) -> None:
        """Take the regions; without any, the box of the task's points is one.

        Raises:
            ValueError: a region without volume, or none that holds free space.
        """
        self._task = task
        boxes = [tuple(np.asarray(corner, np.float64) for corner in region) for region in regions] or [task.bounds]
        for low, high in boxes:
            if low.shape != (3,) or high.shape != (3,) or not (low < high).all():
                raise ValueError(f"region: expected a lower and a higher corner [3], got {low.tolist()} and {high.tolist()}")
        self._low, self._high = (np.stack([box[k] for box in boxes]) for k in range(2))

    def allowed(self, position: np.ndarray) -> np.ndarray:
        """True for positions [n,3] m in free space and in a region."""
        return np.asarray(self._task.in_free_space(position) & (self._nearest(position) == position).all(1))

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
            able = self._task.in_free_space(wanted, seen=False) & ~crosses
            position[rest[able]] = wanted[able]
            stay[rest[able]] = False
        return position, stay

    def _nearest(self, position: np.ndarray) -> np.ndarray:
        """The nearest place in a region."""
        inside = np.clip(position[:, None], self._low, self._high)
        best = np.linalg.norm(inside - position[:, None], axis=2).argmin(1)
        return inside[np.arange(len(position)), best]
