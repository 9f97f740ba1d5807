"""A plan in words: what each rung bought, what was left out and why, what half the tolerance would take."""

from __future__ import annotations

import math

from difflpv.planning.plan import Plan
from difflpv.planning.race import Runner

__all__ = ["bought_table", "explain", "half_tolerance", "left_out"]

_STATES = {
    "out": "error surely too large",
    "unsure": "not surely within the tolerance",
    "dear": "over the budget",
    "hopeless": "what was judged of its kind foretells that it cannot",
    "met": "within the tolerance, but dearer than what was chosen",
    "open": "dearer than what was chosen",
}


def explain(plan: Plan) -> str:
    """The whole report."""
    parts = [_verdict(plan)]
    if plan.best is not None:
        parts += [bought_table(plan), left_out(plan), half_tolerance(plan)]
    return "\n\n".join(part for part in parts if part)


def _verdict(plan: Plan) -> str:
    goal = f"tolerance {plan.tolerance:g}" if plan.tolerance is not None else f"budget {1e3 * (plan.budget or 0):g} ms"
    best = plan.best
    if best is None:
        return f"{goal}: nothing was judged" + (" before the interruption" if plan.interrupted else " within it")
    assert best.estimate is not None and best.seconds is not None
    e = best.estimate
    bound = f"below {e.high:.3f} with {100 * plan.confidence:.4g} %"
    found = f"{best.rung.name}: error {e.error:.3f} ({bound}), {1e3 * best.seconds:.2f} ms a solve"
    if plan.moving:
        found += f" with the lookups of {plan.moving} receivers that move"
    if plan.chosen is not None:
        return f"{goal} is met by {found}"
    if best.level < plan.last_level:
        found += f"; judged roughly, on level {best.level + 1} of {plan.last_level + 1}"
    if plan.interrupted:
        return f"{goal}: interrupted; best so far {found}"
    return f"{goal} is not met by anything on the ladder; best found {found}"


def bought_table(plan: Plan) -> str:
    """Markdown table: from rung to rung of the front, what the error and the cost were before and after.

    Errors of early levels are rough: they were enough to reject.
    """
    rows = ["| rung | error before | after | judged on level | cost before [ms] | after |", "|---|---|---|---|---|---|"]
    before: Runner | None = None
    for runner in plan.front:
        rows.append(
            f"| {runner.rung.name} | {_error(before)} | {_error(runner)} | {runner.level + 1} of {plan.last_level + 1} | "
            f"{_milliseconds(before)} | {_milliseconds(runner)} |"
        )
        before = runner
    return "\n".join(rows)


def _error(runner: Runner | None) -> str:
    return "" if runner is None or runner.estimate is None else f"{runner.estimate.error:.3f}"


def _milliseconds(runner: Runner | None) -> str:
    return "" if runner is None or runner.seconds is None else f"{1e3 * runner.seconds:.2f}"


def left_out(plan: Plan) -> str:
    """One line per reason, naming the rungs."""
    lines = []
    for state, reason in _STATES.items():
        if state == "out" and plan.budget is not None:
            reason = "less accurate"
        if state == "open" and (plan.interrupted or plan.chosen is None):
            reason = "not judged to the end"
        names = [f"{r.rung.name} ({_error(r)})" if r.estimate else r.rung.name for r in plan.runners if r.state == state]
        names = [name for name in names if plan.best is None or not name.startswith(plan.best.rung.name + " (")]
        if names:
            lines.append(f"left out, {reason}: {'; '.join(names)}")
    return "\n".join(lines)


def half_tolerance(plan: Plan) -> str:
    """What half the tolerance would take, from what was judged; empty for a budget."""
    if plan.tolerance is None or plan.best is None:
        return ""
    half = plan.tolerance / 2
    left = [r for r in plan.runners if r.estimates and r.seconds is not None and r.state in ("open", "met", "chosen")]
    enough = [r for r in left if plan.foreseen(r) <= half]
    if enough:
        least = min(enough, key=lambda r: r.seconds or 0.0)
        return f"half the tolerance, {half:g}: likely {least.rung.name} ({plan.foreseen(least):.3f}), {_milliseconds(least)} ms"
    front = [r for r in plan.front if r.seconds and r.estimate]
    waiting = any(r.state == "open" for r in plan.runners)
    hope = "dearer rungs were not judged" if waiting else "nothing on the ladder reached it"
    if len(front) < 2:
        return f"half the tolerance, {half:g}: {hope}"
    first, last = front[0], front[-1]
    assert first.estimate and last.estimate and first.seconds and last.seconds
    fall = math.log(first.estimate.error / max(last.estimate.error, 1e-12))
    power = fall / math.log(last.seconds / first.seconds) if last.seconds > first.seconds else 0.0
    if power < 0.05:
        return f"half the tolerance, {half:g}: {hope}, and more time has bought next to nothing so far"
    factor = (last.estimate.error / half) ** (1 / power)
    return (
        f"half the tolerance, {half:g}: {hope}; the error has fallen as time to the power {-power:.2f}: if that went on, about "
        f"{factor:.3g} times the {_milliseconds(last)} ms of {last.rung.name}"
    )
