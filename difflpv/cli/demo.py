"""``difflpv demo``: the main job in one command."""

from __future__ import annotations

import argparse
import textwrap
from pathlib import Path
from typing import Any

from difflpv.cli.options import add_output, positive, seeded
from difflpv.cli.output import make_folder, print_json

__all__ = ["add_parser", "run"]


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "demo",
        help="the main job in one command: targets, fits, report",
        description=textwrap.fill(
            "Cornell box: path-traced targets for eight lights, LPV and HOLPV as published, fitted by gradients and by nlopt "
            "on five of them and judged on three, beside the constant. Writes report.html, one self-contained file. What is "
            "there already is not made again.",
            100,
            break_on_hyphens=False,
        ),
        epilog="example:\n  difflpv demo --out out/demo\n  difflpv demo --quick --workers 2 --out out/quick",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument(
        "--out", type=Path, default=Path("out/demo"), metavar="DIR", help="folder for everything (default: %(default)s)"
    )
    parser.add_argument("--quick", action="store_true", help="small sizes, for a first look")
    parser.add_argument("--workers", type=positive, metavar="N", help="tracing processes (default: one per processor)")
    seeded(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> int:
    """Run the demo and print its table."""
    from difflpv.demo import run_demo

    def tell(line: str) -> None:
        if not args.json:
            print(line, flush=True)

    make_folder("--out", args.out)
    summary = run_demo(args.out, quick=args.quick, seed=args.seed, workers=args.workers, progress=tell)
    if args.json:
        print_json(
            {
                "command": "demo",
                "folder": summary.folder,
                "report": summary.report,
                "train": [s.to_json() for s in summary.train],
                "test": [s.to_json() for s in summary.test],
            }
        )
    return 0
