"""``difflpv train-stencil``: learn a propagation stencil, in free space and in rooms."""

from __future__ import annotations

import argparse
import sys
import textwrap
from pathlib import Path
from typing import Any

from difflpv.cli.options import LEARNED, UsageError, add_output, natural, positive_float, seeded
from difflpv.cli.output import print_json

__all__ = ["add_parser", "run"]


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "train-stencil",
        help="learn a propagation stencil in free space and in rooms",
        description=textwrap.fill(
            "Trains one rung of the learned stencils, cube-symmetric, conserving and stable: on the closed form of a cosine "
            "emitter in free space, then on path-traced rooms drawn at random, for the gains of receivers on walls by "
            "degree. Writes RUNG.safetensors and RUNG.json. A run that was cut off goes on where it stopped.",
            100,
        ),
        epilog="example:\n  difflpv train-stencil learned_9x26 --quick --out out/stencils",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument("rung", metavar="RUNG", choices=LEARNED, help=", ".join(LEARNED))
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the stencil and its checkpoint")
    parser.add_argument(
        "--rounds", type=natural, metavar="N", help="rounds of 10 L-BFGS iterations in free space (default: the rung's own)"
    )
    parser.add_argument("--rooms", type=natural, metavar="N", help="rooms for the receivers' gains, 0 for none (default: 28)")
    parser.add_argument("--minutes", type=positive_float, metavar="M", help="stop after the round that exceeds M minutes")
    parser.add_argument("--start", type=Path, metavar="FILE", help="stencil to start from (default: the published kernel)")
    parser.add_argument("--no-resume", dest="resume", action="store_false", help="start anew, whatever lies in DIR")
    parser.add_argument("--quick", action="store_true", help="the shape of the result within 3 minutes")
    seeded(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> int:
    """Train and write."""
    from difflpv.training.stencils import train_stencil

    if args.start is not None and not args.start.is_file():
        raise UsageError(f"--start: {args.start}: not found")
    result = train_stencil(
        args.rung,
        seed=args.seed,
        rounds=args.rounds,
        rooms=args.rooms,
        minutes=args.minutes,
        out=args.out,
        start=args.start,
        resume=args.resume,
        quick=args.quick,
        report=None if args.json else lambda line: print(line, file=sys.stderr, flush=True),
    )
    path = args.out / f"{args.rung}.safetensors"
    if args.json:
        print_json(
            {
                "command": "train-stencil",
                "rung": args.rung,
                "path": str(path),
                "rounds": result.rounds,
                "lookup_gains": result.stencil.lookup_gains,
                "finished": result.finished,
                "errors": result.errors,
                "blended": result.blended,
            }
        )
        return 0
    for shell, error in result.errors.items():
        print(f"{shell}: relative L2 error {error:.4f}")
    unfinished = "" if result.finished else ", not finished: run the command again to go on"
    gains = ", ".join(f"{g:.3f}" for g in result.stencil.lookup_gains)
    print(f"gains of receivers on walls by degree: {gains}")
    print(f"{path}: {result.rounds} rounds in free space{unfinished}")
    return 0
