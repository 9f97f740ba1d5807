"""A long descent cut into segments, each kept on disk once it is done, so that work that was broken off goes on."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from difflpv.optim.checkpoint import load_checkpoint, save_checkpoint
from difflpv.placement.descent import Descent, Probes
from difflpv.placement.journal import Journal
from difflpv.placement.task import PlacementTask

__all__ = ["Segments", "task_digest"]

_FORMAT = 2  # of a segment's entries
_TOLD_EVERY = 10  # steps


class Segments:
    """Runs descents one after the other; those that a checkpoint holds are taken from it.

    The work between them has no chance in it, so that the same segments come in the same order.

    Attributes:
        journal: told of every few steps.
        best: the latest result that the work called its best; what is left if it is broken off.
    """

    def __init__(self, journal: Journal, checkpoint: str | Path | None, identity: Mapping[str, Any]) -> None:
        """Read what is done.

        Args:
            journal: of the work.
            checkpoint: the file, or None for none.
            identity: plain values that the work must have in common with the checkpoint's.

        Raises:
            CheckpointError: the file cannot be read, or belongs to other work.
        """
        self.journal = journal
        self.best: Probes | None = None
        self._path = None if checkpoint is None else Path(checkpoint)
        self._identity = {"segments": _FORMAT, **identity}
        self._done: list[dict[str, Any]] = []
        self._next = 0
        if self._path is not None:
            found = load_checkpoint(self._path, self._identity)
            self._done = list(found["segments"]) if found else []

    def run(self, descent: Descent, probes: Probes, steps: int, first: float, last: float) -> tuple[Probes, float]:
        """``Descent.run`` with a step length that falls from ``first`` to ``last``, or what it came to before."""
        number, self._next = self._next, self._next + 1
        if number < len(self._done):
            kept = self._done[number]
            result = Probes(kept["position"].numpy(), None if kept["metric"] is None else kept["metric"].numpy())
            error = float(kept["error"])
            self.journal.evaluations += _evaluations(steps)
            self.journal.seconds_before += float(kept["seconds"])
            self.journal.note(len(result), error)
            return result, error
        since = 0

        def told(error: float) -> None:
            nonlocal since
            if since % _TOLD_EVERY == 0:
                self.journal.note(len(probes), error)
            since += 1

        start = time.perf_counter()
        result, error = descent.run(probes, steps, first, last, told=told)
        self.journal.evaluations += _evaluations(steps)
        metric = None if result.metric is None else torch.from_numpy(result.metric)
        seconds = time.perf_counter() - start
        self._done.append(
            {"position": torch.from_numpy(result.position), "metric": metric, "error": error, "seconds": seconds}
        )
        if self._path is not None:
            save_checkpoint(self._path, self._identity, {"segments": self._done})
        return result, error


def _evaluations(steps: int) -> int:
    return 2 * (steps + 1)


def task_digest(task: PlacementTask) -> str:
    """Sixteen digits that change with the task's scene, points, truth, field or clearance."""
    digest = hashlib.sha256(task.scene.hash.encode())
    for tensor in (task.points, task.radiance, task.field.values, task.clearance.values, task.weights):
        digest.update(np.ascontiguousarray(tensor.numpy()).tobytes())
    return digest.hexdigest()[:16]
