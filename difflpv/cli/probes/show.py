"""``difflpv probes show``: placed probes as a picture, with their tetrahedra and their errors."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from difflpv.cli.options import UsageError, add_command, add_output, positive
from difflpv.cli.output import make_folder_of, print_json, warn
from difflpv.cli.probes.judged import CONTENTS, PlacedProbes, judging

__all__ = ["add_parser", "run"]


def add_parser(subparsers: Any) -> None:
    """Add the subcommand."""
    parser = add_command(
        subparsers,
        "show",
        run,
        help="draw placed probes, their tetrahedra and their errors",
        description="Draws the probes of a folder in their scene, each a white sphere under its own light, with the edges of "
        "their tetrahedra, and with --targets the judging points beside them: black where they read the right light, light "
        "yellow where the error is as large as the light (root mean square over 26 normals).",
        example="""
        difflpv probes show cornell out/probes --out out/probes.png
        difflpv probes show cornell out/probes --targets out/judge --placed-by out/place --out out/probes.png
        """,
    )
    parser.add_argument("probes", type=Path, metavar="PROBES", help="folder with probes.json")
    parser.add_argument("--out", type=Path, required=True, metavar="FIGURE.png", help="the picture")
    parser.add_argument("--targets", type=Path, metavar="DIR", help="draw errors at the points of these targets")
    parser.add_argument("--placed-by", type=Path, metavar="DIR", help="targets that placed them: their lights do not judge")
    parser.add_argument("--content", choices=CONTENTS, default="fitted", help="with --targets (default: %(default)s)")
    parser.add_argument("--no-edges", action="store_true", help="leave the tetrahedra out, as for footprints")
    parser.add_argument("--workers", type=positive, default=1, metavar="N", help="processes that trace (default: %(default)s)")
    add_output(parser)


def run(args: argparse.Namespace) -> int:
    """Draw, then say what is seen."""
    if args.out.suffix.lower() != ".png":
        raise UsageError(f"--out: expected a file name ending in .png, got '{args.out}'")
    if args.placed_by is not None and args.targets is None:
        raise UsageError("--placed-by: needs --targets")

    from difflpv.io import load_scene
    from difflpv.io.atomic import write_bytes
    from difflpv.placement.edge_rays import tetrahedra_cut_by_walls
    from difflpv.probes.tetrahedra import Tetrahedra
    from difflpv.raycast import Raycaster
    from difflpv.report.scene_figures import draw_pictures, probe_picture

    scene = load_scene(args.scene)
    warn(scene.warnings)
    placed = PlacedProbes.of(args.probes, scene)
    held_out = None if args.targets is None else judging(scene, args.targets, args.placed_by)
    make_folder_of("--out", args.out)
    x = placed.position
    tetrahedra = Tetrahedra.of(x)
    cells = tetrahedra.vertices if len(tetrahedra.vertices) else tetrahedra.hull
    cut = tetrahedra_cut_by_walls(Raycaster(scene), x, cells)
    told: dict[str, Any] = {
        "command": "probes show",
        "figure": args.out,
        "method": placed.record.method,
        "probes": len(x),
        "invalid": len(placed.record.probes) - len(x),
        "reader": placed.reader.described,
        "tetrahedra": len(tetrahedra.vertices),
        "cut_by_walls": int(cut.sum()),
        "apart": _apart(x),
        "errors": placed.record.errors,
    }
    edges = None if args.no_edges or placed.reader.interpolation != "tetrahedra" else x[tetrahedra.edges]
    pictures = [probe_picture(scene, placed.record.probes, edges=edges)]
    titles = [f"{scene.name}: {len(x)} probes{f', {placed.record.method}' if placed.record.method else ''}"]
    if held_out is not None:
        from difflpv.placement.judge import judge, point_errors
        from difflpv.report.probe_errors import error_picture

        content = placed.content(held_out, args.content, workers=args.workers)
        error = point_errors(held_out.judge, x, placed.reader, content)
        whole = judge(held_out.judge, x, placed.reader, content, timed=False)
        pictures.append(error_picture(scene, held_out.judge.points.numpy(), error))
        titles.append(f"error {whole.error:.3f} (points: black 0, yellow 1)")
        told |= {"error": whole.error, "p95": whole.p95, "leak": whole.leak, "lights": held_out.lights}
    write_bytes(args.out, draw_pictures(pictures, titles))
    if args.json:
        print_json(told)
    else:
        print(_text(told))
    return 0


def _apart(position: np.ndarray) -> tuple[float, float] | None:
    """Least and median distance to the nearest other probe [m]."""
    from scipy.spatial import KDTree

    if len(position) < 2:
        return None
    nearest = KDTree(position).query(position, k=2)[0][:, 1]
    return float(nearest.min()), float(np.median(nearest))


def _text(told: dict[str, Any]) -> str:
    read = f", read by {told['reader']}" if told["reader"] != "tetrahedra" else ""
    left = f" ({told['invalid']} invalid ones left out)" if told["invalid"] else ""
    lines = [
        f"{told['probes']} probes{left}{', ' + told['method'] if told['method'] else ''}{read}: "
        f"{told['tetrahedra']} tetrahedra between them, {told['cut_by_walls']} cut by a wall"
    ]
    if told["apart"] is not None:
        lines.append("nearest other probe: {:.3g} m at least, {:.3g} m in the median".format(*told["apart"]))
    if told["errors"]:
        lines.append("as recorded: " + ", ".join(f"{name} {value:.3g}" for name, value in told["errors"].items()))
    if "error" in told:
        lines.append(
            f"judged under light sets {', '.join(map(str, told['lights']))}: error {told['error']:.3f}, "
            f"95th percentile {told['p95']:.3f}, leak {told['leak']:.3f}"
        )
    return "\n".join([*lines, f"-> {told['figure']}"])
