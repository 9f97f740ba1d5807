"""The planner's choices for the bundled scenes beside those of a brute-force sweep, and what planning costs.

    python benchmarks/planner.py [--scenes NAME ...] [--tolerances 0.1 0.2 0.4] [--folder out/planner] [--out docs/planner.md]

The sweep judges every rung of the ladder on all receivers, paths and lights of the last level, sharing set-up among rungs as
the planner does; the planner starts anew for every tolerance, tracing its own truth. Both are timed by the processor time of
this process (one thread), after kernels have been loaded: other work on the machine hardly counts. A scene whose results lie
in ``--folder`` is not run again.
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
from difflpv.planning.truth import LEVELS, Level

_TIE = 1.1
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


def sweep(name: str) -> dict[str, Any]:
    """Every rung on the last level: name -> error, bounds, seconds; processor time of the truth, and of all."""
    scene, component = load_scene(name), BUNDLED[name][0]
    begin = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        judge = SceneJudge(scene, component, held_out_lights(scene, LEVELS[-1].lights), folder)
        judge.truth.level(len(LEVELS) - 1)
        rungs, truth = {}, time.process_time() - begin
        for rung in PLAN_LADDER:
            estimate, _ = judge.judge(rung, len(LEVELS) - 1)
            seconds = judge.retime(rung)
            rungs[rung.name] = {**estimate.to_json(), "seconds": seconds, "work": judge.work(rung)}
            print(f"{name}: {rung.name}: {estimate.error:.3f} to {estimate.high:.3f}, {1e3 * seconds:.2f} ms", flush=True)
    return {"rungs": rungs, "truth": truth, "seconds": time.process_time() - begin}


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


def brute_choice(rungs: dict[str, Any], tolerance: float) -> str | None:
    """The cheapest rung surely within the tolerance; of costs within a tie that of least work."""
    meeting = {name: r for name, r in rungs.items() if r["high"] <= tolerance}
    if not meeting:
        return None
    least = min(r["seconds"] for r in meeting.values())
    tied = [name for name, r in meeting.items() if r["seconds"] <= _TIE * least]
    return min(tied, key=lambda name: meeting[name]["work"])


def cost_ratio(rungs: dict[str, Any], ours: str | None, theirs: str | None) -> float:
    """Cost of the planner's answer over that of the sweep's; infinite where only one of them found any."""
    if ours == theirs:
        return 1.0
    if ours is None or theirs is None:
        return float("inf")
    return rungs[ours]["seconds"] / max(rungs[theirs]["seconds"], 1e-9)


def page(results: dict[str, Any], tolerances: list[float], command: str) -> str:
    """The document."""
    rows, shares, ratios = [], {}, []
    for name, result in results.items():
        rungs = result["sweep"]["rungs"]
        for tolerance in tolerances:
            p = result["plans"][f"{tolerance:g}"]
            theirs = brute_choice(rungs, tolerance)
            share = p["seconds"] / result["sweep"]["seconds"]
            shares[f"{name} at {tolerance:g}"] = share
            ratios.append(cost_ratio(rungs, p["chosen"], theirs))
            cells = [
                f"{name} {BUNDLED[name][0]}", f"{tolerance:g}", _shown(p["chosen"], rungs), _shown(theirs, rungs),
                "same" if p["chosen"] == theirs else f"{ratios[-1]:.2f} x its cost", f"{p['judged']} of {len(rungs)}",
                f"{p['seconds']:.1f} of {result['sweep']['seconds']:.1f} ({share:.2f})",
            ]  # fmt: skip
            rows.append(f"| {' | '.join(cells)} |")
    levels = "; ".join(
        f"{v.receivers} receivers, {v.spp} paths for those that are new, {v.lights} light{'s' * (v.lights > 1)}" for v in LEVELS
    )
    mean, near = sum(shares.values()) / len(shares), sum(ratio <= _TIE for ratio in ratios)
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
        "thread, the least of several.", "",
        "| scene | tolerance | planner: rung, error, ms | sweep: rung, error, ms | planner against sweep | judged | time [s] |",
        "|---|---|---|---|---|---|---|", *rows, "",
        f"Wanted: the sweep's answer, or one within 10 % of its cost. Reached in {near} of {len(ratios)} cases.", "",
        f"Wanted: at most {_WANTED:g} of the sweep's time. Reached in {len(shares) - len(over)} of {len(shares)} cases; "
        f"{min(shares.values()):.2f} to {max(shares.values()):.2f}, {mean:.2f} on average"
        + (f"; over it: {listed}" if over else "")
        + ". A sweep serves all tolerances at once, a plan one. Dear are tolerances near what the best rungs reach: then many "
        "are judged under all lights, and on the last level, whose truth alone takes "
        f"{_share_of_truth(results)} of a sweep's time.", "",
        *_moving_table(results, max(tolerances)),
        "## In the planner's words", "",
        "Errors are those of the last level on which a rung was judged: what is rejected early is known roughly, and under "
        "the first light only.", "",
    ]  # fmt: skip
    for name, result in results.items():
        lines += [f"### {name}, {BUNDLED[name][0]}", ""]
        for tolerance in tolerances[1:2] if name == "cornell" else ():
            lines += [result["plans"][f"{tolerance:g}"]["words"].replace("\nleft out,", "\n\nleft out,"), ""]
        for tolerance in tolerances:
            words = result["plans"][f"{tolerance:g}"]["words"].split("\n\n")
            lines += [f"- {words[0]}. {words[-1] if len(words) > 1 else ''}".rstrip()]
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


def _share_of_truth(results: dict[str, Any]) -> str:
    shares = [result["sweep"]["truth"] / result["sweep"]["seconds"] for result in results.values()]
    return f"{min(shares):.2f} to {max(shares):.2f}"


def _shown(name: str | None, rungs: dict[str, Any]) -> str:
    if name is None:
        return "none meets it"
    return f"{name}; {rungs[name]['error']:.3f}; {1e3 * rungs[name]['seconds']:.1f}"


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
        if "sweep" not in result:
            result["sweep"] = sweep(name)
            write_json(kept, result)
        results[name] = result
    text = page(results, args.tolerances, "python benchmarks/planner.py --out docs/planner.md")
    print(text)
    if args.out:
        write_text(args.out, text)


if __name__ == "__main__":
    main()
