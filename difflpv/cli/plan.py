"""``difflpv plan``: the cheapest model that a scene needs, or the most accurate one for a time."""

from __future__ import annotations

import argparse
import shlex
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from difflpv.cli.failures import INTERRUPTED
from difflpv.cli.options import (
    COMPONENTS,
    UsageError,
    add_command,
    add_output,
    natural,
    positive,
    positive_float,
    seeded,
    usage_errors,
)
from difflpv.cli.output import make_folder, make_folder_of, print_json, warn

if TYPE_CHECKING:
    from difflpv.planning.race import Runner

__all__ = ["add_parser", "run"]


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = add_command(
        subparsers,
        "plan",
        run,
        help="choose the model, cells and steps that a scene needs",
        description="Climb a ladder of models, from a constant over coarse cells to fine ones, and stop at the cheapest whose "
        "error on receivers and lights held out meets the tolerance, or find the most accurate within a budget of time. Writes "
        "a file for --config of simulate, render, evaluate and fit. Exit code 1 where nothing meets the goal: the best found "
        "is written all the same.",
        example="""
        difflpv plan cornell --tolerance 0.2 --out out/plan.json
        difflpv plan cornell --budget-ms 20 --out out/plan.json
        difflpv plan cornell --tolerance 0.25 --moving 100000 --out out/plan.json
        """,
    )
    goal = parser.add_mutually_exclusive_group(required=True)
    goal.add_argument("--tolerance", type=positive_float, metavar="E", help="relative L2 error of irradiance to stay below")
    goal.add_argument("--budget-ms", type=positive_float, metavar="MS", help="time that one solve may take on this machine")
    parser.add_argument(
        "--moving", type=natural, default=0, metavar="N", help="receivers that move, as on objects: a rung's time counts what "
        "they take to find out anew what they see and to read it, where light probes are cheap (default: 0, receivers stay)"
    )
    parser.add_argument("--component", choices=COMPONENTS, default="bounce1", help="of the light (default: %(default)s)")
    parser.add_argument(
        "--confidence", type=float, default=0.95, metavar="P", help="that the error is below the tolerance (default: 0.95)"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out/plan.json"), metavar="FILE.json", help="the plan (default: %(default)s)"
    )
    parser.add_argument(
        "--truth", type=Path, metavar="DIR", help="where path-traced truth is kept (default: beside --out, by scene)"
    )
    parser.add_argument("--workers", type=positive, default=1, metavar="N", help="path tracing processes (default: 1)")
    seeded(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> int:
    """Plan, write, explain."""
    from difflpv.io import load_scene
    from difflpv.planning.explain import explain
    from difflpv.planning.plan import make_plan
    from difflpv.planning.truth import LEVELS

    if args.out.suffix != ".json":
        raise UsageError(f"--out: expected a file name ending in .json, got {args.out}")
    if not 0.5 <= args.confidence < 1:
        raise UsageError(f"--confidence: expected a number in [0.5, 1), got {args.confidence:g}")
    scene = load_scene(args.scene)
    warn(scene.warnings)
    make_folder_of("--out", args.out)
    truth = args.truth or args.out.parent / f"plan_{scene.name}_{args.component}"
    make_folder("--truth", truth)
    with usage_errors():
        plan = make_plan(
            scene,
            truth,
            tolerance=args.tolerance,
            budget=None if args.budget_ms is None else args.budget_ms / 1e3,
            component=args.component,
            confidence=args.confidence,
            seed=args.seed,
            workers=args.workers,
            moving=args.moving,
            tell=(lambda runner: None) if args.json else partial(_tell, levels=len(LEVELS)),
        )
    if plan.best is not None:
        plan.save(args.out)
    if args.json:
        print_json({"command": "plan", **plan.to_json(), "out": args.out if plan.best is not None else None})
    else:
        print(f"\n{scene.name}, {args.component}\n{explain(plan)}")
        if plan.best is not None:
            print(f"\nplanning took {plan.seconds['all']:.0f} s, {plan.seconds['truth']:.0f} s of it to trace the truth")
            print(f"plan, with all rungs: {args.out}")
        if plan.config is not None:
            use = ["difflpv", "render", args.scene, "--config", str(args.out), "--out", str(args.out.with_suffix(".exr"))]
            print(f"to use it: {shlex.join(use)}")
    if plan.interrupted:
        return INTERRUPTED
    return 0 if plan.chosen is not None else 1


def _tell(runner: Runner, levels: int) -> None:
    assert runner.estimate is not None and runner.seconds is not None
    e = runner.estimate
    error, cost = f"{e.error:.3f} ({e.low:.3f} to {e.high:.3f})", f"{1e3 * runner.seconds:8.2f} ms"
    print(f"level {runner.level + 1} of {levels}  error {error} {cost}  {runner.rung.name}", flush=True)
