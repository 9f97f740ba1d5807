"""Which of several solves is the cheapest: rivals are timed in turns, so that what else the machine does hits all alike.

Single times of a solve of a few ms on a machine that does other work scatter by a third, and one time after the other differs
by what the machine did meanwhile. In turns, each round's ratio of two times is free of most of that, and the geometric mean of
such ratios over some rounds tells two solves apart closer than the ratio of their least times, which a single quiet moment of
the one decides.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from statistics import geometric_mean
from typing import TypeVar

__all__ = ["TIE", "cheapest_of", "time_rivals"]

T = TypeVar("T")

TIE = 1.05  # costs closer than this are one: what times in turns hardly tell apart
_ROUGH = 3.0  # times of first runs, which allocate and load, may be so far off
_DOUBTFUL = 1.6  # and those of one round
_CLEAR = 1.25  # and of some
_ROUNDS = 25  # at most
_FEW = 5  # rounds after which whoever is clearly dearer drops out
_LEAST = 3  # rounds of however long solves
_ENOUGH = 0.3  # s that one takes in all: long solves scatter less


def time_rivals(rough: Mapping[T, float], solve_of: Callable[[T], Callable[[], float]]) -> dict[T, float]:
    """Time anew, in turns, those whose rough times leave open which is the cheapest.

    Args:
        rough: seconds of one solve of each, of a run or two; 0 for what solves nothing, which is not timed.
        solve_of: what solves one of them once and returns the seconds that it took; its set-up is done here, once.

    Returns:
        Seconds of one solve, for those timed: the geometric mean of its runs.
    """
    least = min(rough.values(), default=0.0)
    solves = {one: solve_of(one) for one, seconds in rough.items() if 0 < seconds <= _ROUGH * least}
    taken: dict[T, list[float]] = {one: [] for one in solves}
    turns, number = list(solves), 0
    while number < _ROUNDS and turns:
        for one in turns:
            taken[one].append(solves[one]())
        turns.reverse()  # each runs before another as often as after it
        number += 1
        found = {one: geometric_mean(taken[one]) for one in turns}
        best = min(found, key=lambda one: found[one])
        if number >= _LEAST and sum(taken[best]) >= _ENOUGH:
            break
        clear = _CLEAR if number >= _FEW else _DOUBTFUL
        turns = [one for one in turns if found[one] <= clear * found[best]]
        if number >= _FEW and len(turns) == 1:
            break
    return {one: geometric_mean(seconds) for one, seconds in taken.items()}


def cheapest_of(costs: Mapping[T, float], work: Mapping[T, float]) -> T:
    """The cheapest one; of costs within a tie (``TIE``) of it, the one of least work."""
    least = min(costs.values())
    return min((one for one, cost in costs.items() if cost <= TIE * least), key=lambda one: (work[one], costs[one]))
