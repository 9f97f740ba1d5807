"""The planner's choices for the bundled scenes beside those of a brute-force sweep, and what planning costs.

    python benchmarks/planner.py [--scenes NAME ...] [--tolerances 0.1 0.2 0.4] [--folder out/planner] [--out docs/planner.md]

The sweep judges every rung of the ladder on all receivers, paths and lights of the last level, sharing set-up among rungs as
the planner does, and times each by the function that the planner uses (``difflpv.planning.timing``); those whose times leave
open which is the cheapest are then timed anew in turns, as by the planner. The planner starts anew for every tolerance, tracing
its own truth. Both are timed by the processor time of this process (one thread), after kernels have been loaded. A scene whose
results lie in ``--folder`` is not run again.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from difflpv.bench.scenes import BUNDLED
from difflpv.io import load_scene
from difflpv.io.atomic import write_json, write_text
from difflpv.planning.explain import explain
from difflpv.planning.judging import SceneJudge
from difflpv.planning.ladder import PLAN_LADDER
from difflpv.planning.lights import held_out_lights
from difflpv.planning.plan import make_plan
from difflpv.planning.timing import TIE, cheapest_of, time_rivals
from difflpv.planning.truth import LEVELS, Level

_NEAR = 1.1  # times the cost of the sweep's choice
_MOVING = (10_000, 1_000_000)
_WANTED = 0.25  # of the sweep's time


def load_kernels() -> None:
    """Judge every kind of rung once, roughly: what a process pays once is no part of a sweep or a plan."""
    scene = load_scene("cornell")
    with tempfile.TemporaryDirectory() as folder:
        judge = SceneJudge(scene, "bounce1", held_out_lights(scene, 1), folder, levels=(Level(50, 32, 1),))
        for rung in PLAN_LADDER:
            if (rung.cells or 0) <= 32:
                judge.judge(rung, 0)


def sweep(name: str, tolerances: list[float]) -> dict[str, Any]:
    """Every rung on the last level, and what is chosen for each tolerance.

    Returns:
        rungs: name -> error, bounds, seconds.
        choices: tolerance -> "chosen" and the "seconds" of those that were timed in turns.
        truth, timing, seconds: processor time of the truth, of timing every rung, and of all.
    """
    scene, component, last = load_scene(name), BUNDLED[name][0], len(LEVELS) - 1
    begin, by_name = time.process_time(), {rung.name: rung for rung in PLAN_LADDER}
    with tempfile.TemporaryDirectory() as folder:
        judge = SceneJudge(scene, component, held_out_lights(scene, LEVELS[-1].lights), folder)
        judge.truth.level(last)
        rungs, choices, truth, timing = {}, {}, time.process_time() - begin, 0.0
        for rung in PLAN_LADDER:
            estimate, rough = judge.judge(rung, last)
            started = time.process_time()
            seconds = time_rivals({rung: rough}, judge.solve_of).get(rung, 0.0)
            timing += time.process_time() - started
            rungs[rung.name] = {**estimate.to_json(), "seconds": seconds, "work": judge.work(rung)}
            print(f"{name}: {rung.name}: {estimate.error:.3f} to {estimate.high:.3f}, {1e3 * seconds:.2f} ms", flush=True)
        for tolerance in tolerances:
            meeting = {n: r["seconds"] for n, r in rungs.items() if r["high"] <= tolerance}
            timed = time_rivals(meeting, lambda n: judge.solve_of(by_name[n]))
            chosen = cheapest_of({**meeting, **timed}, {n: rungs[n]["work"] for n in meeting}) if meeting else None
            choices[f"{tolerance:g}"] = {"chosen": chosen, "seconds": timed}
    return {"rungs": rungs, "choices": choices, "truth": truth, "timing": timing, "seconds": time.process_time() - begin}


def plan(name: str, tolerance: float, moving: int = 0) -> dict[str, Any]:
    """One plan, its words, and the whole processor time; with ``moving`` receivers that move."""
    begin = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        found = make_plan(load_scene(name), folder, tolerance=tolerance, component=BUNDLED[name][0], moving=moving)
    chosen = None if found.chosen is None else found.chosen.rung.name
    best = None if found.best is None else found.best.rung.name
    judged = sum(r.level >= 0 for r in found.runners)
    print(f"{name}, {tolerance:g}, {moving} moving: {chosen} (best {best})", flush=True)
    error, cost = (None, None) if found.best is None else (found.best.estimate.error, found.best.seconds)
    return {
        "chosen": chosen, "best": best, "words": explain(found), "judged": judged, "seconds": time.process_time() - begin,
        "error": error, "cost": cost,
    }  # fmt: skip


def cost_ratio(seconds: dict[str, float], ours: str | None, theirs: str | None) -> float:
    """Cost of the planner's answer over that of the sweep's; infinite where only one of them found any."""
    if ours == theirs:
        return 1.0
    if ours is None or theirs is None:
        return float("inf")
    return seconds[ours] / max(seconds[theirs], 1e-9)


def page(results: dict[str, Any], tolerances: list[float], command: str) -> str:
    """The document."""
    rows, shares, untimed, ratios = [], {}, [], []
    for name, result in results.items():
        rungs = result["sweep"]["rungs"]
        for tolerance in tolerances:
            p = result["plans"][f"{tolerance:g}"]
            theirs, timed = (result["sweep"]["choices"][f"{tolerance:g}"][key] for key in ("chosen", "seconds"))
            seconds = {n: timed.get(n, r["seconds"]) for n, r in rungs.items()}
            share = p["seconds"] / result["sweep"]["seconds"]
            shares[f"{name} at {tolerance:g}"] = share
            untimed.append(p["seconds"] / (result["sweep"]["seconds"] - result["sweep"]["timing"]))
            ratios.append(cost_ratio(seconds, p["chosen"], theirs))
            cells = [
                f"{name} {BUNDLED[name][0]}", f"{tolerance:g}", _shown(p["chosen"], rungs, seconds),
                _shown(theirs, rungs, seconds),
                "same" if p["chosen"] == theirs else f"{ratios[-1]:.2f} x its cost", f"{p['judged']} of {len(rungs)}",
                f"{p['seconds']:.1f} of {result['sweep']['seconds']:.1f} ({share:.2f})",
            ]  # fmt: skip
            rows.append(f"| {' | '.join(cells)} |")
    levels = "; ".join(
        f"{v.receivers} receivers, {v.spp} paths for those that are new, {v.lights} light{'s' * (v.lights > 1)}" for v in LEVELS
    )
    mean, near = sum(shares.values()) / len(shares), sum(ratio <= _NEAR for ratio in ratios)
    over = {pair: share for pair, share in shares.items() if share > _WANTED}
    listed = ", ".join(f"{pair} ({share:.2f})" for pair, share in sorted(over.items(), key=lambda one: -one[1]))
    lines = [
        "# What the planner chooses", "",
        f"Written by `{command}`. `difflpv plan SCENE --tolerance E` climbs a ladder of {len(PLAN_LADDER)} models and stops at "
        "the cheapest one whose relative L2 error on receivers and lights held out is below E with 95 % confidence (bootstrap "
        "over receivers; the noise of the path-traced truth is taken off). The sweep beside it judges every rung on the last "
        "level, with the same truth and sharing set-up among rungs as the planner does.", "",
        f"Levels, each adding to the one before: {levels}. Lights: of cornell and two_rooms_90 four of the bundled sets, "
        "elsewhere the scene's own and three moved or turned ones. Costs: processor time of one solve (inject, propagate), one "
        "thread; where a choice hangs on it, the geometric mean of up to 25 taken in turns with whatever else may be "
        f"the cheapest. Costs within {100 * (TIE - 1):g} % are one: then the least work is taken.", "",
        "| scene | tolerance | planner: rung, error, ms | sweep: rung, error, ms | planner against sweep | judged | time [s] |",
        "|---|---|---|---|---|---|---|", *rows, "",
        f"Wanted: the sweep's answer, or one within 10 % of its cost. Reached in {near} of {len(ratios)} cases.", "",
        f"Wanted: at most {_WANTED:g} of the sweep's time. Reached in {len(shares) - len(over)} of {len(shares)} cases; "
        f"{min(shares.values()):.2f} to {max(shares.values()):.2f}, {mean:.2f} on average"
        + (f"; over it: {listed}" if over else "")
        + ". A sweep serves all tolerances at once, a plan one. Dear are tolerances near what the best rungs reach: then many "
        "are judged under all lights, and on the last level, whose truth alone takes "
        f"{_share(results, 'truth')} of a sweep's time. Timing every rung by itself takes {_share(results, 'timing')} of it: "
        f"of a sweep that did without, a plan takes {min(untimed):.2f} to {max(untimed):.2f}, "
        f"{sum(untimed) / len(untimed):.2f} on average.", "",
        *_moving_table(results, max(tolerances)),
        "## In the planner's words", "",
        "Errors are those of the last level on which a rung was judged: what is rejected early is known roughly, and under "
        "the first light only.", "",
    ]  # fmt: skip
    for name, result in results.items():
        lines += [f"### {name}, {BUNDLED[name][0]}", ""]
        for tolerance in tolerances[1:2] if name == "cornell" else ():
            lines += [result["plans"][f"{tolerance:g}"]["words"], ""]
        for tolerance in tolerances:
            words = [" ".join(part.split()) for part in result["plans"][f"{tolerance:g}"]["words"].split("\n\n")]
            lines += [f"- {words[0]}. {words[-1] + '.' if len(words) > 1 else ''}".rstrip()]
        lines.append("")
    return "\n".join(lines)


def _moving_table(results: dict[str, Any], tolerance: float) -> list[str]:
    """What is chosen where receivers move."""
    counts = (0, *_MOVING)
    heads = ["receivers stay", *(f"{n:,} move" for n in _MOVING)]
    lines = [
        "## Where receivers move", "",
        f"`difflpv plan SCENE --tolerance {tolerance:g} --moving N`: a rung's time counts what N receivers, as on objects that "
        "move, take after each solve to find out anew what they see, and to read it. In cells that is 27 rays a receiver; in "
        "light probes that the volume lights, a walk through tetrahedra, which knows no walls. Each entry: rung; error; time "
        "of the solve with its lookups [ms], one thread.", "",
        f"| scene | {' | '.join(heads)} |", "|---" * (len(heads) + 1) + "|",
    ]  # fmt: skip
    for name, result in results.items():
        plans = [result["plans"][_key(tolerance, n)] for n in counts]
        cells = [
            "none meets it" if p["chosen"] is None else f"{p['chosen']}; {p['error']:.3f}; {1e3 * p['cost']:.1f}" for p in plans
        ]
        lines.append(f"| {name} {BUNDLED[name][0]} | {' | '.join(cells)} |")
    return [*lines, ""]


def _key(tolerance: float, moving: int = 0) -> str:
    return f"{tolerance:g}" + (f", {moving} moving" if moving else "")


def _share(results: dict[str, Any], part: str) -> str:
    shares = [result["sweep"][part] / result["sweep"]["seconds"] for result in results.values()]
    return f"{min(shares):.2f} to {max(shares):.2f}"


def _shown(name: str | None, rungs: dict[str, Any], seconds: dict[str, float]) -> str:
    if name is None:
        return "none meets it"
    return f"{name}; {rungs[name]['error']:.3f}; {1e3 * seconds[name]:.1f}"


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(BUNDLED), choices=list(BUNDLED))
    parser.add_argument("--tolerances", nargs="+", type=float, default=[0.1, 0.2, 0.4])
    parser.add_argument("--folder", type=Path, default=Path("out/planner"))
    parser.add_argument("--out", type=Path)
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    args.folder.mkdir(parents=True, exist_ok=True)
    load_kernels()
    results = {}
    for name in args.scenes:
        kept = args.folder / f"{name}.json"
        result = json.loads(kept.read_text()) if kept.exists() else {"plans": {}}
        wanted = [(tolerance, 0) for tolerance in args.tolerances] + [(max(args.tolerances), n) for n in _MOVING]
        for tolerance, moving in wanted:
            if _key(tolerance, moving) not in result["plans"]:
                result["plans"][_key(tolerance, moving)] = plan(name, tolerance, moving)
                write_json(kept, result)
        if not {f"{tolerance:g}" for tolerance in args.tolerances} <= set(result.get("sweep", {}).get("choices", ())):
            result["sweep"] = sweep(name, args.tolerances)
            write_json(kept, result)
        results[name] = result
    text = page(results, args.tolerances, "python benchmarks/planner.py --out docs/planner.md")
    print(text)
    if args.out:
        write_text(args.out, text)


if __name__ == "__main__":
    main()
