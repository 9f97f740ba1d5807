"""``difflpv bench``: error against time for every method, on this machine."""

from __future__ import annotations

import argparse
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Any

from difflpv.cli.options import UsageError, add_output, name_list, positive, seeded, usage_errors
from difflpv.cli.output import make_folder, print_json

__all__ = ["add_parser", "run"]


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "bench",
        help="chart speed against accuracy of every method on this machine",
        description=textwrap.fill(
            "Measures error, time, gradients and memory of every method on the bundled scenes or others, how cost grows, and "
            "from how many receivers on a solve beats path tracing. Writes JSON lines, CSV, charts and an interactive page; "
            "what was measured already is not measured again.",
            100,
            break_on_hyphens=False,
        ),
        epilog="example:\n  difflpv bench --quick --out out/bench\n  difflpv bench cornell my_room.glb --only learned_9x26",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="files or bundled scenes (default: the bundled seven)")
    parser.add_argument("--only", type=name_list, metavar="NAMES", help="configurations, separated by commas (default: all)")
    parser.add_argument("--quick", action="store_true", help="few configurations, small sizes: under five minutes on two cores")
    parser.add_argument("--no-growth", action="store_true", help="do not measure how cost grows")
    parser.add_argument("--no-break-even", action="store_true", help="do not measure time over receivers, gradients, pay-off")
    parser.add_argument("--no-lines", action="store_true", help="do not measure irradiance along lines")
    parser.add_argument("--threads", type=positive, metavar="N", help="threads of every method (default: all processors)")
    parser.add_argument(
        "--out", type=Path, default=Path("out/bench"), metavar="DIR", help="folder for results (default: %(default)s)"
    )
    parser.add_argument(
        "--markdown", type=Path, metavar="FILE.md", help="renew this document (default: DIR/benchmarks.md)"
    )
    seeded(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> int:
    """Measure, write and print the front_verdict on each scene."""
    from difflpv.bench.page import write_charts, write_document
    from difflpv.bench.pareto import front_verdict
    from difflpv.bench.run import run_bench
    from difflpv.bench.settings import BenchSettings

    if args.markdown is not None and args.markdown.suffix != ".md":
        raise UsageError(f"--markdown: expected a file name ending in .md, got {args.markdown}")
    settings = BenchSettings.of_quick(args.seed) if args.quick else replace(BenchSettings(), seed=args.seed)
    make_folder("--out", args.out)
    document = args.markdown or args.out / "benchmarks.md"
    make_folder("--markdown", document.parent)

    def tell(line: str) -> None:
        if not args.json:
            print(line, flush=True)

    with usage_errors():
        names = _names(args.only)
    result = run_bench(
        args.out, scenes=args.scenes or None, names=names, settings=settings, threads=args.threads,
        growth=not args.no_growth, break_even=not args.no_break_even, scanlines=not args.no_lines,
        progress=tell,
    )  # fmt: skip
    write_charts(args.out / "charts", result)
    write_document(document, result, command=_command(args))
    if args.json:
        print_json({"command": "bench", "out": args.out, **result.to_json()})
        return 0
    for line in result.skipped:
        tell(line)
    for key in result.scenes:
        tell(f"{key}: {front_verdict([p for p in result.points if p.scene == key], result.published)}")
    tell(f"tables and charts: {document}; interactive: {args.out / 'charts' / 'bench.html'}")
    return 0


def _names(only: tuple[str, ...] | None) -> list[str] | None:
    """Names of configurations, which have commas themselves: the longest run of parts that is one."""
    from difflpv.bench.configuration import LADDER, chosen

    if only is None:
        return None
    known, parts, found = {c.name for c in LADDER}, list(only), []
    while parts:
        for count in range(len(parts), 0, -1):
            if ", ".join(parts[:count]) in known:
                break
        found.append(", ".join(parts[:count]))
        parts = parts[count:]
    return [c.name for c in chosen(found)]


def _command(args: argparse.Namespace) -> str:
    """The command that makes the document anew."""
    parts = ["difflpv bench", *args.scenes]
    parts += [f"--only '{','.join(args.only)}'"] if args.only else []
    flags = (
        ("--quick", args.quick), ("--no-growth", args.no_growth), ("--no-break-even", args.no_break_even),
        ("--no-lines", args.no_lines),
    )  # fmt: skip
    parts += [flag for flag, given in flags if given]
    parts += [f"--threads {args.threads}"] if args.threads else []
    parts += [f"--seed {args.seed}"] if args.seed else []
    return " ".join([*parts, f"--markdown {args.markdown}"] if args.markdown else parts)
