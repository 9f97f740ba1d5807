"""``difflpv stress``: push each method until it breaks."""

from __future__ import annotations

import argparse
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Any

from difflpv.cli.options import UsageError, add_output, name_list, seeded
from difflpv.cli.output import make_folder, print_json

__all__ = ["add_parser", "run"]


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "stress",
        help="push each method until it breaks, and say where",
        description=textwrap.fill(
            "Turns one knob at a time (propagation factor, steps, cell size, walls, position, scale, starts of fits) past the "
            "point where a method fails; charts error, gradient norm and energy, and writes a table of limits with what the "
            "library says there and the cure. What is there already is not run again.",
            100,
            break_on_hyphens=False,
        ),
        epilog="example:\n"
        "  difflpv stress --quick --out out/stress\n"
        "  difflpv stress --only refinement,walls --methods holpv,learned_9x26 --markdown out/stress/stability.md",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument("--only", type=name_list, metavar="NAMES", help="experiments, separated by commas (default: all)")
    parser.add_argument("--methods", type=name_list, metavar="NAMES", help="methods, separated by commas (default: all)")
    parser.add_argument("--quick", action="store_true", help="small sizes, under three minutes on one core")
    parser.add_argument(
        "--out", type=Path, default=Path("out/stress"), metavar="DIR", help="folder for results (default: %(default)s)"
    )
    parser.add_argument(
        "--markdown", type=Path, metavar="FILE.md", help="the document, its charts beside it (default: DIR/stability.md)"
    )
    seeded(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> int:
    """Run the experiments and print the table of limits."""
    from difflpv.stress import STRESS_METHODS, StressSettings, run_stress
    from difflpv.stress.page import limit_table
    from difflpv.stress.registry import EXPERIMENTS

    _check_names("--only", args.only, EXPERIMENTS)
    _check_names("--methods", args.methods, STRESS_METHODS)
    if args.markdown is not None and args.markdown.suffix != ".md":
        raise UsageError(f"--markdown: expected a file name ending in .md, got {args.markdown}")
    settings = StressSettings.quick(args.seed) if args.quick else replace(StressSettings(), seed=args.seed)
    make_folder("--out", args.out)
    if args.markdown is not None:
        make_folder("--markdown", args.markdown.parent)

    def tell(line: str) -> None:
        if not args.json:
            print(line, flush=True)

    experiments = run_stress(
        args.out,
        settings=settings,
        methods={name: STRESS_METHODS[name] for name in args.methods or STRESS_METHODS},
        only=args.only,
        markdown=args.markdown,
        command=_command(args),
        progress=tell,
    )
    if args.json:
        print_json({"command": "stress", "out": args.out, "experiments": [e.to_json() for e in experiments]})
    else:
        print(f"\n{limit_table(experiments)}")
    return 0


def _check_names(option: str, chosen: Any, known: Any) -> None:
    for name in chosen or ():
        if name not in known:
            raise UsageError(f"{option}: no '{name}', expected names of {', '.join(known)}")


def _command(args: argparse.Namespace) -> str:
    """The command that makes the document anew."""
    parts = ["difflpv stress"]
    parts += ["--quick"] if args.quick else []
    parts += [f"--only {','.join(args.only)}"] if args.only else []
    parts += [f"--methods '{','.join(args.methods)}'"] if args.methods else []
    parts += [f"--seed {args.seed}"] if args.seed else []
    return " ".join([*parts, f"--markdown {args.markdown}"] if args.markdown else parts)
