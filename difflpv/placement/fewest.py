"""The fewest probes that meet a tolerance: grown until they do, then thinned out until they no longer would."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from difflpv.placement.descent import Descent, Probes
from difflpv.placement.population import without_least
from difflpv.placement.segments import Segments
from difflpv.placement.task import PlacementTask

__all__ = ["fewest", "held_out_points"]

_FIRST = 8
_HELD_OUT = 5  # every so manieth point judges
_THINNED = (0.75, 0.88)  # of the probes, first in large steps, then in small ones


def fewest(
    descent: Descent,
    judge: PlacementTask,
    placed: Callable[[Descent, int, Probes | None], Probes],
    segments: Segments,
    *,
    most: int,
    tolerance: float,
) -> dict[str, Any]:
    """Leave the fewest probes found that meet a tolerance as the best of the segments.

    Args:
        descent: on the points that probes are fitted to.
        judge: points that neither positions nor content are fitted to: the error there has to meet the tolerance.
        placed: places so many probes from a start, a grid if None.
        segments: keeps the best so far.
        most: probes at most.
        tolerance: relative error.

    Returns:
        ``tolerance``, ``met``, ``held_out_error`` of the probes left, and ``tried``: (count, held-out error) in order.
    """
    tried: list[tuple[int, float]] = []

    def attempt(count: int, start: Probes | None) -> tuple[Probes, float]:
        try:
            probes = placed(descent, count, start)
        finally:  # also where the work is broken off
            if met is not None:
                segments.best = met[0]
        error = descent.error_at(probes, judge)
        tried.append((len(probes), error))
        return probes, error

    met: tuple[Probes, float] | None = None
    count = min(_FIRST, most)
    probes, error = attempt(count, None)
    while error > tolerance and count < most:
        count = min(most, max(count + 1, round(count * np.clip((error / tolerance) ** 1.5, 1.2, 2.0))))
        probes, error = attempt(count, None)  # a fresh grid: one that grew keeps the shape it had when it was small
    if error <= tolerance:
        met = probes, error
        for share in _THINNED:
            while len(met[0]) > 1:
                count = min(len(met[0]) - 1, int(share * len(met[0])))
                probes, error = attempt(count, without_least(descent, met[0], len(met[0]) - max(count, 1)))
                if error > tolerance:
                    break
                met = probes, error
        probes, error = met
    segments.best = probes
    return {"tolerance": tolerance, "met": met is not None, "held_out_error": error, "tried": tuple(tried)}


def held_out_points(task: PlacementTask) -> tuple[PlacementTask, PlacementTask]:
    """The task on four fifths of its points, and on the others.

    Raises:
        ValueError: fewer than five points.
    """
    count = len(task.points)
    if count < _HELD_OUT:
        raise ValueError(f"tolerance: expected at least {_HELD_OUT} points, some to be held out, got {count}")
    others = torch.arange(count) % _HELD_OUT == _HELD_OUT - 1

    def part(chosen: torch.Tensor) -> PlacementTask:
        weight = None if task.weight is None else task.weight[chosen]
        return replace(task, points=task.points[chosen], radiance=task.radiance[chosen], weight=weight)

    return part(~others), part(others)
