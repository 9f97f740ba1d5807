"""The fewest probes that meet a tolerance: grown until they do, then thinned out until they no longer would."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from difflpv.error_bounds import Estimate
from difflpv.placement.descent import Descent, Probes
from difflpv.placement.population import without_least
from difflpv.placement.segments import Segments
from difflpv.placement.unseen import Unseen

__all__ = ["fewest"]

_FIRST = 8
_GROWN = (1.4, 2.0)  # least and most: a few more than needed do no harm, those that are thinned out end better than fresh ones
_THINNED = (0.75, 0.88)  # of the probes, first in large steps, then in small ones


def fewest(
    descent: Descent,
    unseen: Unseen,
    placed: Callable[[Descent, int, Probes | None], Probes],
    segments: Segments,
    *,
    most: int,
    tolerance: float,
    confidence: float,
) -> dict[str, Any]:
    """Leave the fewest probes found that meet a tolerance as the best of the segments.

    Args:
        descent: on the points and lights that place.
        unseen: whose error has to meet the tolerance.
        placed: places so many probes from a start, a grid if None.
        segments: keeps the best so far.
        most: probes at most.
        tolerance: relative error.
        confidence: with which the unseen error is to be below it.

    Returns:
        ``tolerance``, ``confidence``, ``met``, of the probes left ``held_out_error`` and ``held_out_bound``, the
        ``lights_held_out``, and ``tried``: (count, bound) in order.
    """
    tried: list[tuple[int, float]] = []

    def attempt(count: int, start: Probes | None) -> tuple[Probes, Estimate]:
        try:
            probes = placed(descent, count, start)
        finally:  # also where the work is broken off
            if met is not None:
                segments.best = met[0]
        error = unseen.error(descent, probes, confidence=confidence)
        tried.append((len(probes), error.high))
        return probes, error

    met: tuple[Probes, Estimate] | None = None
    count = min(_FIRST, most)
    probes, error = attempt(count, None)
    while error.high > tolerance and count < most:
        count = min(most, max(count + 1, round(count * np.clip((error.high / tolerance) ** 2, *_GROWN))))
        probes, error = attempt(count, None)  # a fresh grid: one that grew keeps the shape it had when it was small
    if error.high <= tolerance:
        met = probes, error
        for share in _THINNED:
            while len(met[0]) > 1:
                count = min(len(met[0]) - 1, int(share * len(met[0])))
                probes, error = attempt(count, without_least(descent, met[0], len(met[0]) - max(count, 1)))
                if error.high > tolerance:
                    break
                met = probes, error
        probes, error = met
    segments.best = probes
    return {
        "tolerance": tolerance,
        "confidence": confidence,
        "met": met is not None,
        "held_out_error": error.error,
        "held_out_bound": error.high,
        "lights_held_out": unseen.lights,
        "tried": tuple(tried),
    }
