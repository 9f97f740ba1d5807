"""The race: rungs in the order of their cost, each judged only as closely as it takes to reject it.

``cheapest`` climbs: the cheapest open rung is judged on the next level (more receivers, paths and lights), out once its
error is surely above the tolerance, chosen once it is surely below it on the last level. So the many rungs below the answer
cost little each, what lies above it costs nothing, and only the answer and its near misses are judged in full. A rung is
skipped where coarser cells of its family say that finer ones cannot meet the tolerance (``_Field.hopeless``).

``most_accurate`` judges everything within the budget on the first level and halves the field on each further one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from difflpv.bench.configuration import Configuration
from difflpv.planning.estimate import Estimate
from difflpv.planning.ladder import family_of

__all__ = ["Judge", "Runner", "cheapest", "most_accurate"]

_TIE = 1.1  # costs closer than this are told apart by their work
_FIRST_RATE = 1e-11  # s per product, before anything is measured
_ABOVE_BASE = 3.0  # times the cheapest solve: what takes so long tells the rate of the work
_ROUGH = 1.25  # times the budget: a time of two or three runs may be so far off
_PREDICTION = 1.5  # a rung predicted to be so many times over the budget is not measured


class Judge(Protocol):
    """Measures rungs; level 0 is the cheapest.

    Attributes:
        slack: of each level, >= 1: a rung is out where its error is surely above the tolerance times this. More than 1 where a
            level sees other lights than the last one does, on which the same rung may do better.
    """

    slack: Sequence[float]

    def work(self, rung: Configuration) -> float:
        """Products of one solve."""

    def judge(self, rung: Configuration, level: int) -> tuple[Estimate, float]:
        """Error on this level, and seconds of one solve."""


@dataclass(eq=False)
class Runner:
    """One rung in the race.

    Attributes:
        rung: what runs.
        work: products of one solve.
        level: last one judged, -1 before the first.
        estimate: on that level.
        seconds: of one solve, as measured there.
        state: "open", "out" (its error is too large), "unsure" (not surely below the tolerance), "dear", "hopeless" (skipped),
            or "chosen".
    """

    rung: Configuration
    work: float
    level: int = -1
    estimate: Estimate | None = None
    seconds: float | None = None
    state: str = "open"


@dataclass(eq=False)
class _Field:
    """All runners, and what a solve of one that was not measured yet will cost at least."""

    runners: list[Runner]
    judge: Judge
    tell: Callable[[Runner], object]

    def cost(self, runner: Runner) -> float:
        """Measured, or else what the cheapest measured solve costs besides its work, and the work at the best rate seen."""
        if runner.seconds is not None or not runner.work:
            return runner.seconds or 0.0
        known = [(r.seconds, r.work) for r in self.runners if r.seconds is not None and r.work]
        base = min((seconds for seconds, _ in known), default=0.0)
        rates = [(seconds - base) / work for seconds, work in known if seconds > _ABOVE_BASE * base]
        return base + runner.work * min(rates, default=_FIRST_RATE)

    def key(self, runner: Runner) -> tuple[int, float]:
        """Order of the climb: costs within a tie are one."""
        return round(math.log(max(self.cost(runner), 1e-9)) / math.log(_TIE)), runner.work

    def advance(self, runner: Runner, level: int) -> Estimate:
        runner.estimate, seconds = self.judge.judge(runner.rung, level)
        runner.seconds = seconds if runner.seconds is None else min(seconds, runner.seconds)
        runner.level = level
        self.tell(runner)
        return runner.estimate

    def hopeless(self, runner: Runner, tolerance: float) -> bool:
        """True where coarser cells of the same family say that these cannot do it.

        The error is taken to fall as the cells' edge to a power: the one seen between two judged sizes, at its most generous
        (from the upper bound of one to the lower bound of the other), and at most 1, which is also what one size alone gets.
        """
        cells = runner.rung.cells
        family = [r for r in self.runners if r.estimate and r.rung.cells and family_of(r.rung) == family_of(runner.rung)]
        coarser = sorted((r for r in family if cells and _cells(r) < cells), key=_cells)
        if not coarser or not cells:
            return False
        first, last = coarser[0], coarser[-1]
        power = 1.0
        if _cells(first) < _cells(last):
            fall = max(_error(first).high, 1e-12) / max(_error(last).low, 1e-12)
            power = min(1.0, max(0.0, math.log(fall) / math.log(_cells(last) / _cells(first))))
        return _error(last).low * (_cells(last) / cells) ** power > tolerance * self.judge.slack[last.level]


def _cells(runner: Runner) -> int:
    return runner.rung.cells or 0


def _start(rungs: Sequence[Configuration], judge: Judge, runners: list[Runner] | None) -> list[Runner]:
    found = [] if runners is None else runners
    found.extend(Runner(rung, judge.work(rung)) for rung in rungs)
    return found


def cheapest(
    rungs: Sequence[Configuration],
    judge: Judge,
    tolerance: float,
    *,
    runners: list[Runner] | None = None,
    tell: Callable[[Runner], object] = lambda runner: None,
) -> Runner | None:
    """The cheapest rung whose error is surely within the tolerance, or None.

    Args:
        rungs: the ladder.
        judge: measures them.
        tolerance: of the relative error, > 0.
        runners: an empty list that is filled; whoever is interrupted finds there what is known.
        tell: told every runner that was judged.
    """
    if not (tolerance > 0 and math.isfinite(tolerance)):
        raise ValueError(f"tolerance: expected a positive number, got {tolerance}")
    race = _Field(_start(rungs, judge, runners), judge, tell)
    last = len(judge.slack) - 1
    while waiting := [r for r in race.runners if r.state == "open"]:
        runner = min(waiting, key=race.key)
        if runner.level < 0 and race.hopeless(runner, tolerance):
            runner.state = "hopeless"
            continue
        estimate = race.advance(runner, runner.level + 1)
        if estimate.low > tolerance * judge.slack[runner.level]:
            runner.state = "out"
        elif runner.level == last - 1 and judge.slack[runner.level] == 1 and estimate.error > tolerance:
            runner.state = "unsure"  # more receivers would have to move the error itself, not only its bounds
        elif runner.level == last:
            if estimate.high <= tolerance:
                runner.state = "chosen"
                return runner
            runner.state = "unsure"
    return None


def most_accurate(
    rungs: Sequence[Configuration],
    judge: Judge,
    budget: float,
    *,
    runners: list[Runner] | None = None,
    tell: Callable[[Runner], object] = lambda runner: None,
) -> Runner | None:
    """The rung of smallest error whose solve takes at most ``budget`` seconds, or None; arguments as for ``cheapest``."""
    if not (budget > 0 and math.isfinite(budget)):
        raise ValueError(f"budget: expected a positive number of seconds, got {budget}")
    race = _Field(_start(rungs, judge, runners), judge, tell)
    for level in range(len(judge.slack)):
        for runner in sorted((r for r in race.runners if r.state == "open"), key=race.key):
            if runner.seconds is None and race.cost(runner) > _PREDICTION * budget:
                runner.state = "dear"
                continue
            race.advance(runner, level)
            if race.cost(runner) > budget * (1 if level == len(judge.slack) - 1 else _ROUGH):
                runner.state = "dear"
        left = sorted((r for r in race.runners if r.state == "open"), key=lambda r: _error(r).error)
        if not left:
            return None
        if level < len(judge.slack) - 1:
            inside = [r for r in left if race.cost(r) <= budget]  # others may turn out to be, but push nobody out
            bar = min((_error(r).high for r in inside), default=math.inf)
            kept = inside[: max(2, math.ceil(len(inside) / 2))]
            for runner in left:
                if _error(runner).low > bar * judge.slack[level] or (runner in inside and runner not in kept):
                    runner.state = "out"
    left[0].state = "chosen"
    for runner in left[1:]:
        runner.state = "out"
    return left[0]


def _error(runner: Runner) -> Estimate:
    assert runner.estimate is not None
    return runner.estimate
