"""What every way of placing keeps account of: the clock, how often the field was taken, and how the work went."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import torch

from difflpv.placement.reconstruction import reconstruction_error
from difflpv.placement.task import Placement, PlacementTask, Progress
from difflpv.probes.lattice import LatticeField
from difflpv.probes.reader import ProbeReader

__all__ = ["Journal", "distinct"]


class Journal:
    """Reads the field of a task for one method, counts that, and writes the ``Placement`` in the end.

    Attributes:
        task: what is known.
        evaluations: how often the field was taken at all probes.
        seconds_before: spent by earlier runs of the same work, whose results are taken from a checkpoint.
    """

    def __init__(self, task: PlacementTask, method: str, count: int, progress: Progress | None) -> None:
        """Start the clock.

        Raises:
            ValueError: ``count`` is not a positive number of probes, or no light comes to the task's points.
        """
        if count < 1:
            raise ValueError(f"{method}: expected at least 1 probe, got {count}")
        if not task.radiance.any():
            raise ValueError(f"{method}: expected light at the task's points, got none")
        self.task = task
        self.evaluations = 0
        self.seconds_before = 0.0
        self._method, self._count, self._progress = method, count, progress
        self._history: list[tuple[int, float, int]] = []
        self._start = time.perf_counter()

    def radiance(self, position: np.ndarray, field: LatticeField | None = None) -> np.ndarray:
        """Radiance SH [n,9,C] at ``position`` [n,3] m by a field, the task's if None: one evaluation."""
        self.evaluations += 1
        with torch.no_grad():
            return (field or self.task.field)(torch.as_tensor(position, dtype=torch.float64)).numpy()

    def error(self, position: np.ndarray) -> float:
        """Training error of the probes, which hold the field's values: one evaluation."""
        self.evaluations += 1
        with torch.no_grad():
            return float(reconstruction_error(self.task, torch.as_tensor(position, dtype=torch.float64)))

    def note(self, count: int, error: float = math.nan) -> None:
        """Write down the number of probes and the training error after one more step."""
        step = len(self._history)
        self._history.append((step, error, count))
        if self._progress is not None:
            self._progress(step, error, count)

    def nothing_free(self) -> ValueError:
        """The error where no probe is left."""
        return ValueError(f"{self._method}: no probe lies in free space: check the clearance, or ask for more probes")

    def placement(
        self, position: np.ndarray, *, radiance: np.ndarray | None = None, reader: ProbeReader | None = None, **details: Any
    ) -> Placement:
        """The result; without ``radiance`` probes hold the field's, without ``reader`` they are read in tetrahedra.

        Raises:
            ValueError: no probe is left, because none lay in free space.
        """
        if not len(position):
            raise self.nothing_free()
        assert len(position) <= self._count
        seconds = self.seconds_before + time.perf_counter() - self._start
        history = tuple(self._history)
        return Placement(
            self._method, np.array(position), radiance, seconds, self.evaluations, history, details, reader or ProbeReader()
        )


def distinct(position: np.ndarray, distance: float) -> np.ndarray:
    """Indices, ascending, of positions [n,3] of which no two are within ``distance`` m: the first of each group stays."""
    from scipy.spatial import KDTree

    keep = np.ones(len(position), bool)
    for i, near in enumerate(KDTree(position).query_ball_point(position, distance) if len(position) else ()):
        if keep[i]:
            keep[[j for j in near if j > i]] = False
    return np.flatnonzero(keep)
