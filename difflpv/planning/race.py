"""The race: rungs in the order of their cost, each judged only as closely as it takes to reject it.

``cheapest`` climbs: the cheapest open rung is judged on the next level (more lights, then more receivers and paths) until it
is rejected or, on the last level, surely below the tolerance; what lies above the answer costs nothing. A rung is rejected

- once its error is surely above the tolerance (``Judge.slack`` where a level has fewer lights than the last one);
- once others that were judged more closely foretell it: rungs see the same receivers and lights, so the ratio of what a later
  level found to what this one did is much the same for all; the most hopeful ratio seen is taken, and a margin with it;
- before it is judged, where coarser cells of its family foretell it even if the error fell with the square of their edge, the
  order at which linear interpolation between cells converges, or as it did between these cells in a family that differs in
  one trait (its stencil, its occlusion ...), with a margin; and probes where the volume that lights them foretells it.

All three only reject. What is chosen rests on the bounds of the last level alone.

``most_accurate`` judges everything within the budget on the first level and halves the field on each further one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from difflpv.bench.configuration import Configuration
from difflpv.error_bounds import Estimate
from difflpv.planning.ladder import family_of
from difflpv.planning.timing import cheapest_of, time_rivals

__all__ = ["Judge", "Runner", "cheapest", "most_accurate"]

_FIRST_RATE = 1e-11  # s per product, before anything is measured
_FINER = 1.5  # times as much work a second may be done in finer cells
_OTHER_KIND = 2.5  # or by another kind of solve
_ABOVE_BASE = 3.0  # times the cheapest solve: what takes so long tells the rate of the work
_NEAR = 1.25  # a rung so many times over the budget may still turn out to be within it
_COLD = 4.0  # times a first run on a busy machine may take
_PREDICTION = 1.5  # a rung predicted to be so many times over the budget is not measured
_MARGIN = 1.1  # between the ratios of errors on two levels of two rungs
_MARGIN_OF_SEVERAL = 1.05  # and between the most hopeful of several and another
_FAMILIES = 1.15  # and between what finer cells do to the errors of two families
_TELLING = 16  # cells from which on they tell it
_ORDER = 2.0  # power of the cells' edge with which an error falls at best


class Judge(Protocol):
    """Measures rungs; level 0 is the cheapest.

    Attributes:
        slack: of each level, >= 1: a rung is out where its error is surely above the tolerance times this. More than 1 where a
            level sees other lights than the last one does, on which the same rung may do better.
        moving: receivers whose lookups are part of a rung's cost.
    """

    slack: Sequence[float]
    moving: int

    def work(self, rung: Configuration) -> float:
        """Products of one solve."""

    def judge(self, rung: Configuration, level: int) -> tuple[Estimate, float]:
        """Error on this level, and seconds of one solve with its lookups, roughly: the least of all so far."""

    def solve_of(self, rung: Configuration) -> Callable[[], float]:
        """What solves a judged rung once more, with its lookups, and returns the seconds that it took; its set-up is done."""


@dataclass(eq=False)
class Runner:
    """One rung in the race.

    Attributes:
        rung: what runs.
        work: products of one solve.
        estimates: of the levels judged, first to last.
        seconds: of one solve, as measured.
        state: "open", "out" (its error is too large), "unsure" (not surely below the tolerance, or foretold not to be), "met"
            (surely below it), "dear", "hopeless" (skipped), or "chosen".
    """

    rung: Configuration
    work: float
    estimates: list[Estimate] = field(default_factory=list)
    seconds: float | None = None
    state: str = "open"

    @property
    def level(self) -> int:
        """Last one judged, -1 before the first."""
        return len(self.estimates) - 1

    @property
    def estimate(self) -> Estimate | None:
        """On that level."""
        return self.estimates[-1] if self.estimates else None


@dataclass(eq=False)
class _Field:
    """All runners, and what a solve of one that was not measured yet will cost at least."""

    runners: list[Runner]
    judge: Judge
    tell: Callable[[Runner], object]

    def cost(self, runner: Runner) -> float:
        """Measured, or else the least to be expected: so none comes too late.

        That is what the cheapest measured solve costs besides its work, and the work at the best rate seen, taken to be better
        still for other cells and another kind of solve. Where lookups count, only what is read alike tells what they cost.
        """
        if runner.seconds is not None or not runner.work:
            return runner.seconds or 0.0
        known = [(r, r.seconds) for r in self.runners if r.seconds is not None and r.work]
        if self.judge.moving:
            known = [(r, seconds) for r, seconds in known if _reading(r) == _reading(runner)]
        base = min((seconds for _, seconds in known), default=0.0)
        rates = [(_kind(r), (seconds - base) / r.work) for r, seconds in known if seconds > _ABOVE_BASE * base]
        own = [rate / _FINER for kind, rate in rates if kind == _kind(runner)]
        others = [rate / _OTHER_KIND for _, rate in rates]
        return base + runner.work * min(own or others, default=_FIRST_RATE)

    def next(self, waiting: Sequence[Runner]) -> Runner:
        """The cheapest; of costs within a tie that of least work."""
        return cheapest_of({r: self.cost(r) for r in waiting}, {r: r.work for r in waiting})

    def advance(self, runner: Runner, level: int) -> Estimate:
        estimate, seconds = self.judge.judge(runner.rung, level)
        runner.estimates.append(estimate)
        runner.seconds = seconds if runner.seconds is None else min(seconds, runner.seconds)
        self.tell(runner)
        return estimate

    def timed(self, runners: Sequence[Runner]) -> dict[Runner, float]:
        """Seconds of those whose rough times leave open which is the cheapest, taken anew in turns."""
        rough = {r: r.seconds for r in runners if r.seconds is not None}
        return time_rivals(rough, lambda runner: self.judge.solve_of(runner.rung))

    def lost(self, estimate: Estimate, level: int, tolerance: float) -> str | None:
        """Why a rung that was so judged on a level is rejected ("out", "unsure"), or None."""
        if estimate.low > tolerance * self.judge.slack[level]:
            return "out"
        last = len(self.judge.slack) - 1
        for later in range(level + 1, last + 1):
            known = [r.estimates for r in self.runners if r.level >= later]
            # the last level asks for an upper bound within the tolerance, one before it hardly goes on with an error above it
            final = later == last
            ratios = [(e[later].high if final else e[later].error) / max(e[level].error, 1e-12) for e in known]
            # how far a bound lies above the error differs more between rungs: two have to agree
            margin = _MARGIN if len(ratios) == 1 else _MARGIN_OF_SEVERAL
            if len(ratios) >= (2 if final else 1) and estimate.error * min(ratios) > tolerance * margin:
                return "unsure"
        # with twice the receivers, one in twenty whose error is above here will have its upper bound within the tolerance there
        if level == last - 1 and self.judge.slack[level] == 1 and estimate.error > tolerance:
            return "unsure"
        return None

    def hopeless(self, runner: Runner, tolerance: float) -> bool:
        """True where what foretells it would be rejected even if its error fell as fast as it can (``fall``).

        One that was judged itself is foretold only by what was judged more closely.
        """
        for other in self.runners:
            fall = self.fall(other, runner) if other.level > runner.level else 0.0
            if fall:
                e = _error(other)
                if self.lost(Estimate(e.error * fall, e.low * fall, e.high * fall), other.level, tolerance):
                    return True
        return False

    def fall(self, coarser: Runner, finer: Runner) -> float:
        """The least share of ``coarser``'s error that may be left with ``finer``; 0 where the one says nothing about the other.

        Of probes in the volume ``coarser``: all but a margin. In finer cells of the same family: the square of the cells' edges
        or, if it is more, what the same two cell sizes made of the errors of another family that differs in one trait: the
        most hopeful of those judged, and a margin. Fewer cells than 16 say too little.
        """
        if coarser.rung.kind == "volume" and finer.rung.kind == "lit probes" and coarser.rung.config == finer.rung.config:
            return 1 / _FAMILIES if _cells(coarser) == _cells(finer) else 0.0
        if not 0 < _cells(coarser) < _cells(finer) or family_of(coarser.rung) != family_of(finer.rung):
            return 0.0
        least = (_cells(coarser) / _cells(finer)) ** _ORDER
        if _cells(coarser) < _TELLING:
            return least
        family, first = family_of(finer.rung), {}
        for r in self.runners:
            if r.estimates and _cells(r) in (_cells(coarser), _cells(finer)) and _alike(family_of(r.rung), family):
                first[family_of(r.rung), _cells(r)] = r.estimates[0].error
        shares = [
            error / max(first[other, _cells(coarser)], 1e-12)
            for (other, cells), error in first.items()
            if cells == _cells(finer) and (other, _cells(coarser)) in first
        ]
        return max(least, min(shares, default=0.0) / _FAMILIES)


def _alike(one: tuple[object, ...], other: tuple[object, ...]) -> bool:
    """Whether two families differ in one trait."""
    return len(one) == len(other) and sum(a != b for a, b in zip(one, other, strict=True)) == 1


def _kind(runner: Runner) -> tuple[str, bool] | None:
    config = runner.rung.config
    return None if config is None else (config.method, config.coarsen_after is not None)


def _reading(runner: Runner) -> tuple[object, ...]:
    config = runner.rung.config
    return (runner.rung.kind, None if config is None else config.lookup)


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
    while waiting := [r for r in race.runners if r.state in ("open", "met")]:
        runner = race.next(waiting)
        if runner.state == "met":
            runner.state = "chosen"
            return runner
        if race.hopeless(runner, tolerance):
            runner.state = "hopeless"
            continue
        lost = race.lost(runner.estimates[-1], runner.level, tolerance) if runner.estimates else None  # others came later
        if lost is None:
            lost = race.lost(race.advance(runner, runner.level + 1), runner.level, tolerance)
        if lost is not None:
            runner.state = lost
        elif runner.level == last:
            if _error(runner).high > tolerance:
                runner.state = "unsure"
                continue
            runner.state = "met"  # times were rough so far: is it the cheapest?
            for rival, seconds in race.timed(waiting).items():
                rival.seconds = seconds
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
    last = len(judge.slack) - 1
    for level in range(last + 1):
        for runner in sorted((r for r in race.runners if r.state == "open"), key=lambda r: (race.cost(r), r.work)):
            if runner.seconds is None and race.cost(runner) > _PREDICTION * budget:
                runner.state = "dear"
                continue
            race.advance(runner, level)
            if level == last or budget < race.cost(runner) <= _COLD * budget:
                for seconds in race.timed([runner]).values():  # what was within the budget once stays so
                    runner.seconds = min(seconds, race.cost(runner))
            if race.cost(runner) > budget * (1 if level == last else _NEAR):
                runner.state = "dear"
        left = sorted((r for r in race.runners if r.state == "open"), key=lambda r: _error(r).error)
        if not left:
            return None
        if level < last:
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
    return runner.estimates[-1]
