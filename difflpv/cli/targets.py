"""``difflpv targets``: path-traced truth to fit to and to be judged by."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from difflpv.cli.options import (
    UsageError,
    add_command,
    add_output,
    check_indices,
    fraction,
    index_list,
    light_sets,
    natural,
    positive,
    seeded,
)
from difflpv.cli.output import last_change, print_json, warn

if TYPE_CHECKING:
    from data_gen.load import Targets
    from difflpv.io.tables import ReceiverTable
    from difflpv.lights import LightEntry

__all__ = ["add_parser", "run"]


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = add_command(
        subparsers,
        "targets",
        run,
        help="path-trace targets of a scene",
        description="Path-trace irradiance at receivers (and images, and probes) of a scene, under its own lights or under "
        "light sets, each value with its standard error. An interrupted run goes on where it stopped, a finished one is "
        "recognised; the same seed gives the same bits for any number of workers. Runs on the CPU.",
        example="""
        difflpv targets cornell --lights bundled --receivers 2000 --workers 2 --out out/cornell
        difflpv targets room.glb --spp 4096 --component direct bounce1 --images --out out/room
        """,
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the targets")
    parser.add_argument(
        "--receivers", default="4000", metavar="N|TABLE.npz", help="how many to draw by area, or a table (default: 4000)"
    )
    parser.add_argument(
        "--component",
        nargs="+",
        default=["direct", "bounce1", "full"],
        metavar="NAME",
        help="direct, bounce1, uptoK, full, full_indirect (default: direct bounce1 full)",
    )
    goal = parser.add_mutually_exclusive_group()
    goal.add_argument("--spp", type=positive, metavar="N", help="paths per receiver, rounded up: 32, 64, ..., multiples of 512")
    goal.add_argument(
        "--target-error", type=fraction, metavar="SHARE", help="go on to this standard error over mean (default: 0.01)"
    )
    parser.add_argument(
        "--max-spp", type=positive, default=65536, metavar="N", help="where --target-error gives up (default: %(default)s)"
    )
    parser.add_argument(
        "--lights", metavar="SETS.json", help="light sets, or 'bundled' for the package's own (default: the scene's lights)"
    )
    parser.add_argument("--light", type=index_list, metavar="LIST", help="which of the light sets, as 0-4,7 (default: all)")
    parser.add_argument("--images", action="store_true", help="also render the scene's camera, EXR and PNG")
    parser.add_argument("--image-spp", type=positive, default=256, metavar="N", help="per pixel (default: %(default)s)")
    parser.add_argument(
        "--probes", type=natural, default=0, metavar="N", help="free-space points with radiance SH (default: %(default)s)"
    )
    parser.add_argument("--probe-spp", type=positive, default=4096, metavar="N", help="per probe (default: %(default)s)")
    parser.add_argument("--workers", type=positive, default=1, metavar="N", help="processes (default: %(default)s)")
    parser.add_argument("--overwrite", action="store_true", help="replace targets of another request in DIR")
    seeded(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> int:
    """Make or recognise the targets."""
    from data_gen.load import MANIFEST
    from data_gen.targets import make_targets
    from difflpv.io import load_scene

    scene = load_scene(args.scene)
    warn(scene.warnings)
    receivers, count = _receivers(args.receivers)
    named = light_sets(args, scene)
    sets: list[list[LightEntry]] | None = None
    numbers: list[int | None] = [None]
    if named is not None:
        source, every = named
        chosen = range(len(every)) if args.light is None else args.light
        if not chosen:
            raise UsageError("--light: expected at least one light set")
        check_indices("--light", chosen, len(every), source)
        sets, numbers = [every[k] for k in chosen], list(chosen)
    manifest = args.out / MANIFEST
    before = last_change(manifest)
    targets = make_targets(
        scene,
        args.out,
        receivers=receivers,
        receiver_count=count,
        components=args.component,
        spp=args.spp,
        target_error=args.target_error,
        max_spp=args.max_spp,
        light_sets=sets,
        probes=args.probes,
        probe_spp=args.probe_spp,
        images=args.images,
        image_spp=args.image_spp,
        seed=args.seed,
        workers=args.workers,
        overwrite=args.overwrite,
        progress=False if args.json else None,
    )
    recognised = last_change(manifest) == before
    warn(_unreached(args, targets))
    if args.json:
        print_json(
            {
                "command": "targets",
                "folder": targets.folder,
                "recognised": recognised,
                "receivers": len(targets.receivers),
                "components": targets.components,
                "lights": [{"light": k, "set": n} | row for k, n, row in zip(*_numbered(targets, numbers), strict=True)],
                "rays": targets.manifest["rays"],
                "seconds": targets.manifest["seconds"],
                "warnings": [*scene.warnings, *_unreached(args, targets)],
            }
        )
    else:
        print(_text(targets, numbers, recognised))
    return 0


def _receivers(text: str) -> tuple[ReceiverTable | None, int | None]:
    """A table, or a number of receivers to draw."""
    from difflpv.io.tables import load_receivers

    if not text.isdigit():
        return load_receivers(text), None
    try:
        return None, positive(text)
    except argparse.ArgumentTypeError as error:
        raise UsageError(f"--receivers: {error}") from None


def _numbered(targets: Targets, numbers: list[Any]) -> tuple[range, list[Any], list[dict[str, Any]]]:
    rows = [{k: row[k] for k in ("spp", "error", "receivers_without_weight")} for row in targets.manifest["lights"]]
    return range(len(rows)), numbers, rows


def _unreached(args: argparse.Namespace, targets: Targets) -> list[str]:
    """A line per light whose standard error stayed above the goal."""
    if args.spp is not None:
        return []
    goal = args.target_error or 0.01
    lines = []
    for k, row in enumerate(targets.manifest["lights"]):
        error = row["error"].get("full", max(row["error"].values()))
        if error > goal:
            lines.append(f"light {k}: standard error {error:.3g} of the mean after {row['spp']} paths, asked for {goal:g}")
    return lines


def _text(targets: Targets, numbers: list[Any], recognised: bool) -> str:
    state = "already there, nothing repeated" if recognised else "written"
    probes = f", {len(targets.probe_positions)} probes" if len(targets.probe_positions) else ""
    lines = [f"{targets.folder}: {state}: {len(targets.receivers)} receivers{probes}, {len(targets.lights)} light(s)"]
    for k, number, row in zip(*_numbered(targets, numbers), strict=True):
        named = "" if number is None else f" (set {number})"
        errors = ", ".join(f"{name} {100 * error:.3g} %" for name, error in row["error"].items())
        lines.append(f"light {k}{named}: {row['spp']} paths per receiver, standard error over mean: {errors}")
    rays, seconds = targets.manifest["rays"], targets.manifest["seconds"]
    lines.append(f"{rays:.3g} rays in {seconds:.3g} s of processor time")
    return "\n".join(lines)
