"""``difflpv probes evaluate``: placed probes judged by points and lights that did not place them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from difflpv.cli.options import add_command, add_output, positive
from difflpv.cli.output import print_json, warn
from difflpv.cli.probes.judged import CONTENTS, PlacedProbes, judging

if TYPE_CHECKING:
    from difflpv.placement.held_out import HeldOut
    from difflpv.placement.judge import Judgement

__all__ = ["add_parser", "run"]

_HEADS = (
    "probes", "method", "count", "error", "p95", "leak", "cut", "free", "surface", "bytes", "place s", "M/s", "in solids",
)  # fmt: skip
_TEXT = 2  # columns to the left


def add_parser(subparsers: Any) -> None:
    """Add the subcommand."""
    parser = add_command(
        subparsers,
        "evaluate",
        run,
        help="judge placed probes by points and lights that did not place them",
        description="Bakes the probes of each folder for the lights of the judging targets and compares what points read with "
        "the path-traced truth: relative L2 error of irradiance over 26 normals, its 95th percentile over points, the leak "
        "(error where the tetrahedron of probes around a point is cut by a wall), size, lookups per second of one core, "
        "probes inside of solids. Light sets that the placing targets have too are left out; by three quarters of the points "
        "content is fitted, on the rest everything is judged. 'difflpv probes targets SCENE --lights moved:4 --seed 1' makes "
        "such targets.",
        example="""
        difflpv probes evaluate cornell out/probes --targets out/judge --placed-by out/place
        difflpv probes evaluate cornell out/grid out/ours --content traced --targets out/judge --json
        """,
    )
    parser.add_argument("probes", nargs="+", type=Path, metavar="PROBES", help="folders with probes.json")
    parser.add_argument("--targets", type=Path, required=True, metavar="DIR", help="that judge, from 'difflpv probes targets'")
    parser.add_argument("--placed-by", type=Path, metavar="DIR", help="targets that placed them: their lights do not judge")
    parser.add_argument(
        "--content", choices=CONTENTS, default="fitted",
        help="traced: path-traced where the probes stand; fitted: by least squares from there (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--workers", type=positive, default=1, metavar="N", help="processes that trace (default: %(default)s)")
    add_output(parser)


def run(args: argparse.Namespace) -> int:
    """Judge each folder, print the table."""
    from difflpv.io import load_scene
    from difflpv.placement.judge import judge

    scene = load_scene(args.scene)
    warn(scene.warnings)
    placed = [PlacedProbes.of(folder, scene) for folder in args.probes]
    held_out = judging(scene, args.targets, args.placed_by)
    found = []
    for probes in placed:
        content = probes.content(held_out, args.content, workers=args.workers)
        judgement = judge(
            held_out.judge, probes.position, probes.reader, content, surface=held_out.surface, seconds=probes.seconds
        )
        found.append((probes, judgement, held_out.in_solids(probes.position)))
    if args.json:
        print_json(
            {
                "command": "probes evaluate",
                "content": args.content,
                "points": len(held_out.judge.points),
                "lights": held_out.lights,
                "left_out": held_out.left_out,
                "noise": held_out.noise,
                "probes": [
                    {
                        "folder": probes.folder,
                        "method": probes.record.method,
                        "reader": probes.reader.described,
                        "in_solids": inside,
                        **judgement.to_json(),
                    }
                    for probes, judgement, inside in found
                ],
            }
        )
        return 0
    print(_table(found))
    print(_unseen(held_out, args))
    return 0


def _table(found: Sequence[tuple[PlacedProbes, Judgement, int]]) -> str:
    rows: list[Sequence[str]] = [_HEADS]
    for probes, j, inside in found:
        rows.append(
            (
                str(probes.folder), probes.record.method or "?", str(j.count), f"{j.error:.3f}", f"{j.p95:.3f}",
                f"{j.leak:.3f}", f"{j.cut_share:.2f}", _shown(j.free_error, ".3f"), _shown(j.surface_error, ".3f"),
                str(j.bytes), _shown(j.seconds, ".1f"), _shown(j.lookups_per_second, ".2f", 1e-6), str(inside),
            )
        )  # fmt: skip
    widths = [max(len(row[k]) for row in rows) for k in range(len(_HEADS))]
    lines = []
    for row in rows:
        cells = [c.ljust(w) if k < _TEXT else c.rjust(w) for k, (c, w) in enumerate(zip(row, widths, strict=True))]
        lines.append("  ".join(cells))
    return "\n".join(lines)


def _shown(value: float | None, form: str, factor: float = 1.0) -> str:
    return "-" if value is None else format(factor * value, form)


def _unseen(held_out: HeldOut, args: argparse.Namespace) -> str:
    total = len(held_out.targets.light_sets)
    unseen = "placed no probes and fitted nothing" if args.placed_by is not None else "fitted nothing"
    points = f"{len(held_out.judge.points)} points that {unseen}"
    lights = f"{len(held_out.lights)} of {total} light set(s)"
    if args.placed_by is None:
        which = f"{lights}; which lights placed the probes is not known without --placed-by"
    elif held_out.left_out:
        which = f"{lights} that placed nothing; left out, because they did: {', '.join(map(str, held_out.left_out))}"
    else:
        which = f"{lights}, none of which placed anything"
    fitted = f", fitted by {len(held_out.fit.points)} other points" if args.content == "fitted" else ""
    return (
        f"Judged at {points}, under {which}.\n"
        f"Content {args.content}{fitted}. Noise of the truth: {held_out.noise:.3f}. M/s: million lookups a second on one core."
    )
