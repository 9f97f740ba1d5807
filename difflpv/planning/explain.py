"""A plan in words: what each rung bought, what was left out and why, what half the tolerance would take."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence

from difflpv.planning.plan import Plan
from difflpv.planning.race import Runner

__all__ = ["bought_table", "explain", "half_tolerance", "left_out"]

_WIDTH = 100
_LONGER = 1.25  # times that differ by less are alike
_FAR = 100.0  # times the time: nothing that was measured foretells so far

_STATES = {
    "out": "error surely too large",
    "unsure": "not surely within the tolerance",
    "dear": "over the budget",
    "hopeless": "what was judged of its kind foretells that it cannot",
    "met": "within the tolerance, but dearer than what was chosen",
    "open": "dearer than what was chosen",
}


def explain(plan: Plan) -> str:
    """The whole report, in lines of at most 100 characters."""
    parts = [_verdict(plan)]
    if plan.best is not None:
        parts += [bought_table(plan), left_out(plan), half_tolerance(plan)]
    return "\n\n".join(part for part in parts if part)


def _verdict(plan: Plan) -> str:
    """What was found, and whether it meets the goal."""
    goal = f"tolerance {plan.tolerance:g}" if plan.tolerance is not None else f"budget {1e3 * (plan.budget or 0):g} ms"
    best = plan.best
    if best is None:
        return f"{goal}: nothing was judged" + (" before the interruption" if plan.interrupted else " within it")
    assert best.estimate is not None and best.seconds is not None
    e = best.estimate
    found = f"{best.rung.name}: error {e.error:.3f} (below {e.high:.3f} with {100 * plan.confidence:.4g} %), "
    found += f"{1e3 * best.seconds:.2f} ms a solve"
    if plan.moving:
        found += f" with the lookups of {plan.moving} receivers that move"
    if best.rung.config is None:
        found += "; it solves nothing: every receiver gets the mean of the path-traced truth"
    if plan.chosen is not None:
        return _filled(f"{goal} is met by {found}")
    if best.level < plan.last_level:
        found += f"; judged roughly, on level {best.level + 1} of {plan.last_level + 1}"
    if plan.interrupted:
        return _filled(f"{goal}: interrupted; best so far {found}")
    return _filled(f"{goal} is not met by anything on the ladder; best found {found}")


def bought_table(plan: Plan) -> str:
    """Markdown table: from rung to rung of the front to the best, what the error fell to and what it cost.

    Errors of early levels are rough: they were enough to reject.
    """
    rows = [("rung", "error", "ms a solve", "judged on level")]
    rows += [(r.rung.name, _error(r), _milliseconds(r), f"{r.level + 1} of {plan.last_level + 1}") for r in plan.front]
    widths = [max(len(row[k]) for row in rows) for k in range(4)]

    def line(cells: Sequence[str]) -> str:
        numbers = [cell.rjust(width) for cell, width in zip(cells[1:], widths[1:], strict=True)]
        return f"| {' | '.join([cells[0].ljust(widths[0]), *numbers])} |"

    rule = [("-" * (width - 1) + ":") if k else "-" * width for k, width in enumerate(widths)]
    return "\n".join(map(line, (rows[0], rule, *rows[1:])))


def _error(runner: Runner) -> str:
    return "" if runner.estimate is None else f"{runner.estimate.error:.3f}"


def _milliseconds(runner: Runner) -> str:
    return "" if runner.seconds is None else f"{1e3 * runner.seconds:.2f}"


def left_out(plan: Plan) -> str:
    """A list: how many rungs for each reason, and the nearest of them to being chosen."""
    lines = []
    for state, reason in _STATES.items():
        if state == "out" and plan.budget is not None:
            reason = "less accurate"
        if state == "open" and (plan.interrupted or plan.chosen is None):
            reason = "not judged to the end"
        runners = [r for r in plan.runners if r.state == state and r is not plan.best]
        if runners:
            lines.append(_filled(f"- {len(runners)}: {reason}{_nearest(state, runners)}", indent="  "))
    return "\n".join([f"Left out of {len(plan.runners)} rungs:", "", *lines]) if lines else ""


def _nearest(state: str, runners: Sequence[Runner]) -> str:
    """Of what was over the budget the cheapest, else the most accurate, of those judged."""
    if state == "dear":
        timed = [r for r in runners if r.seconds is not None]
        nearest = min(timed, key=lambda r: r.seconds or 0.0, default=None)
        return "" if nearest is None else f"; the cheapest timed: {nearest.rung.name} ({_milliseconds(nearest)} ms)"
    judged = [r for r in runners if r.estimates]
    nearest = min(judged, key=lambda r: r.estimates[-1].error, default=None)
    return "" if nearest is None else f"; best judged: {nearest.rung.name} ({_error(nearest)})"


def half_tolerance(plan: Plan) -> str:
    """What half the tolerance would take, from what was judged; empty for a budget."""
    if plan.tolerance is None or plan.best is None:
        return ""
    half = plan.tolerance / 2
    left = [r for r in plan.runners if r.estimates and r.seconds is not None and r.state in ("open", "met", "chosen")]
    enough = [r for r in left if plan.foreseen(r) <= half]
    if enough:
        least = min(enough, key=lambda r: r.seconds or 0.0)
        likely = f"{least.rung.name} ({plan.foreseen(least):.3f}), {_milliseconds(least)} ms"
        return _filled(f"Half the tolerance, {half:g}: likely {likely}")
    front = [r for r in plan.front if r.seconds and r.estimate]
    waiting = any(r.state == "open" for r in plan.runners)
    hope = f"Half the tolerance, {half:g}: {'dearer rungs were not judged' if waiting else 'nothing on the ladder reached it'}"
    if len(front) < 2:
        return hope
    first, last = front[0], front[-1]
    assert first.estimate and last.estimate and first.seconds and last.seconds
    if last.seconds < _LONGER * first.seconds:  # tells nothing of what more time buys
        return hope
    fall = math.log(first.estimate.error / max(last.estimate.error, 1e-12))
    power = fall / math.log(last.seconds / first.seconds)
    far = math.log(last.estimate.error / half) >= power * math.log(_FAR)
    if power <= 0 or far:
        return _filled(f"{hope}; going by the table, not even {_FAR:g} times the time would reach it")
    factor = (last.estimate.error / half) ** (1 / power)
    return _filled(
        f"{hope}; going by the table (error as time to the power {-power:.2f}), it takes about {factor:.2g} times the "
        f"{_milliseconds(last)} ms of {last.rung.name}"
    )


def _filled(text: str, *, indent: str = "") -> str:
    return textwrap.fill(text, _WIDTH, subsequent_indent=indent, break_on_hyphens=False, break_long_words=False)
