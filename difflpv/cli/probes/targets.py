"""``difflpv probes targets``: path-traced light that probes are placed by and judged by."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from difflpv.cli.options import UsageError, add_command, add_output, light_sets, positive, seeded
from difflpv.cli.output import last_change, print_json, warn

if TYPE_CHECKING:
    from data_gen.probe_targets import ProbeTargets
    from difflpv.scene import Scene

__all__ = ["add_parser", "run"]

_MOVED = "moved:"


def add_parser(subparsers: Any) -> None:
    """Add the subcommand."""
    parser = add_command(
        subparsers,
        "targets",
        run,
        help="path-trace what probes are placed by",
        description="Path-trace radiance as spherical harmonics at points in free space and over surfaces, each value with its "
        "standard error, and on a lattice with its distance to the nearest surface, under one or several sets of lights. An "
        "interrupted run goes on where it stopped, a finished one is recognised; the same seed gives the same bits for any "
        "number of workers. Runs on the CPU.",
        example="""
        difflpv probes targets cornell --lights bundled --workers 2 --out out/cornell_probes
        difflpv probes targets atrium --lights 5 --component full_indirect --out out/atrium_probes
        """,
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the targets")
    parser.add_argument("--count", type=positive, default=4000, metavar="N", help="points (default: %(default)s)")
    parser.add_argument(
        "--surface-share", type=_share, default=0.25, metavar="SHARE",
        help="of them that lie over surfaces, 0 to 1 (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--cells", type=positive, default=32, metavar="N", help="of the lattice along the longest edge (default: %(default)s)"
    )
    parser.add_argument(
        "--component", default="bounce1", metavar="NAME",
        help="direct, bounce1, uptoK, full, full_indirect (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--spp", type=positive, default=1024, metavar="N",
        help="paths per point, rounded up as those of 'difflpv targets' (default: %(default)s)",
    )
    parser.add_argument("--lattice-spp", type=positive, default=256, metavar="N", help="paths per cell (default: %(default)s)")
    parser.add_argument(
        "--lights", default="own", metavar="LIGHTS",
        help="own: the scene's; bundled: the package's light sets; SETS.json: those of a file; a number: so many, spread over "
        "the bundled ones, or the scene's own moved a little where none are bundled; moved:N: so many in any scene, its own "
        "lights first, then moved ones (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--workers", type=positive, default=1, metavar="N", help="processes (default: %(default)s)")
    parser.add_argument("--overwrite", action="store_true", help="replace targets of another request in DIR")
    seeded(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> int:
    """Make or recognise the targets."""
    from data_gen.load import MANIFEST
    from data_gen.probe_targets import make_probe_targets
    from difflpv.io import load_scene

    scene = load_scene(args.scene)
    sets = _light_sets(args, scene)
    warnings = [*scene.warnings]
    wanted = args.lights.removeprefix(_MOVED)
    if wanted.isdigit() and sets is not None and len(sets) < int(wanted):
        warnings.append(f"--lights {args.lights}: scene '{scene.name}' has only {len(sets)} different light set(s)")
    warn(warnings)
    manifest = args.out / MANIFEST
    before = last_change(manifest)
    targets = make_probe_targets(
        scene,
        args.out,
        count=args.count,
        surface_share=args.surface_share,
        cells=args.cells,
        component=args.component,
        spp=args.spp,
        lattice_spp=args.lattice_spp,
        light_sets=sets,
        seed=args.seed,
        workers=args.workers,
        overwrite=args.overwrite,
        progress=False if args.json else None,
    )
    recognised = last_change(manifest) == before
    if args.json:
        print_json(_record(targets) | {"recognised": recognised, "warnings": warnings})
    else:
        print(_text(targets, recognised))
    return 0


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"expected a share from 0 to 1, got '{text}'")
    return value


def _light_sets(args: argparse.Namespace, scene: Scene) -> list[Any] | None:
    """Light sets that ``--lights`` names; None for the scene's own lights."""
    if args.lights == "own":
        return None
    moved, wanted = args.lights.startswith(_MOVED), args.lights.removeprefix(_MOVED)
    if not moved and not wanted.isdigit():
        named = light_sets(argparse.Namespace(lights=args.lights, light=None), scene)
        assert named is not None
        return list(named[1])
    from difflpv.planning.lights import held_out_lights, moved_light_sets

    try:
        count = positive(wanted)
    except argparse.ArgumentTypeError as error:
        raise UsageError(f"--lights: {error}") from None
    return (moved_light_sets if moved else held_out_lights)(scene, count, seed=args.seed)


def _record(targets: ProbeTargets) -> dict[str, Any]:
    return {
        "command": "probes targets",
        "folder": targets.folder,
        "component": targets.component,
        "points": len(targets.points),
        "surface_points": targets.surface_count,
        "cells": targets.grid.resolution,
        "cell_size": targets.grid.cell_size,
        "free_cells": int(targets.free.sum()),
        "lights": [{key: row[key] for key in ("spp", "lattice_spp", "noise")} for row in targets.manifest["lights"]],
        "rays": targets.manifest["rays"],
        "seconds": targets.manifest["seconds"],
    }


def _text(targets: ProbeTargets, recognised: bool) -> str:
    state = "already there, nothing repeated" if recognised else "written"
    lines = [
        f"{targets.folder}: {state}: {targets.component} of {len(targets.light_sets)} light set(s)",
        f"{len(targets.points)} points, {targets.surface_count} of them over surfaces; {targets.free.sum()} free cells of "
        f"{targets.grid.cell_size:.3g} m",
    ]
    for k, row in enumerate(targets.manifest["lights"]):
        noise = row["noise"]
        lines.append(
            f"light {k}: standard error over value: {100 * noise['points']:.3g} % at points ({row['spp']} paths), "
            f"{100 * noise['lattice']:.3g} % in cells ({row['lattice_spp']} paths)"
        )
    lines.append(f"{targets.manifest['rays']:.3g} rays in {targets.manifest['seconds']:.3g} s of processor time")
    return "\n".join(lines)
