"""``difflpv probes place``: where light probes go, by gradients of the reconstruction error or any other way."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from difflpv.cli.failures import INTERRUPTED
from difflpv.cli.options import (
    UsageError,
    add_command,
    add_output,
    check_indices,
    fraction,
    index_list,
    natural,
    natural_float,
    positive,
    positive_float,
    seeded,
    usage_errors,
)
from difflpv.cli.output import Progress, jsonable, make_folder, print_json, warn

if TYPE_CHECKING:
    from data_gen.probe_targets import ProbeTargets
    from difflpv.placement.task import Placement, PlacementTask
    from difflpv.probes.probe_files import ProbeRecord
    from difflpv.scene import Scene

__all__ = ["CONTENTS", "INTERPOLATIONS", "METHODS", "add_parser", "run"]

# As in difflpv.placement.place, probes.reader and placement.reconstruction, which would load torch; a test holds them together.
METHODS = (
    "grid", "grid_moved", "spawn_merge", "spawn_merge_hierarchical", "irradiance_ascent", "greedy_removal", "gradient",
    "sbplx", "crs2", "bobyqa", "cma",
)  # fmt: skip
INTERPOLATIONS = ("tetrahedra", "gaussian")
CONTENTS = ("field", "fitted")
_OWN = ("interpolation", "content", "tolerance", "steps", "relocations", "leak", "reach")  # passed on where they are given


def add_parser(subparsers: Any) -> None:
    """Add the subcommand."""
    parser = add_command(
        subparsers,
        "place",
        run,
        help="place light probes by path-traced targets",
        description="Place probes where they reconstruct the targets' light best: by gradients of the reconstruction error "
        "over positions, with the content solved inside, or by grids, heuristics and solvers without derivatives. Writes "
        "probes.json and probes.safetensors. Ctrl-C keeps the best so far; with --method gradient the same command then goes "
        "on from its checkpoint, to the same bits. Options of the gradient are refused for methods without them.",
        example="""
        difflpv probes place cornell --targets out/place --count 64 --out out/probes
        difflpv probes place cornell --targets out/place --tolerance 0.15 --count 200 --out out/fewest
        difflpv probes place cornell --targets out/place --region=-1,0,-1,1,1,1 --out out/lower_half
        """,
    )
    parser.add_argument(
        "--targets", type=Path, metavar="DIR",
        help="from 'difflpv probes targets'; where it is left out, they are made by that command's defaults into OUT/targets",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the probes")
    parser.add_argument(
        "--count", type=positive, default=64, metavar="N", help="probes; with --tolerance, at most (default: %(default)s)"
    )
    parser.add_argument("--method", choices=METHODS, default="gradient", help="(default: %(default)s)")
    parser.add_argument(
        "--lights", type=index_list, metavar="LIST", help="light sets of the targets to place by, as 0-4,7 (default: all)"
    )
    parser.add_argument(
        "--bake", type=natural, metavar="K",
        help="light set, one of those, whose light the written probes hold (default: the first of them)",
    )  # fmt: skip
    parser.add_argument(
        "--edge-rays", action="store_true",
        help="then add probes on either side of walls that cut edges of tetrahedra, beyond --count",
    )  # fmt: skip
    parser.add_argument(
        "--workers", type=positive, default=1, metavar="N", help="processes that make targets (default: %(default)s)"
    )
    parser.add_argument("--overwrite", action="store_true", help="start anew, and replace probes of another request in DIR")
    own = parser.add_argument_group("options of --method gradient")
    own.add_argument(
        "--interpolation", choices=INTERPOLATIONS, help="how points read probes; footprints are fitted (default: tetrahedra)"
    )
    own.add_argument(
        "--content", choices=CONTENTS, help="what probes hold: fitted to the points, or the field's value (default: fitted)"
    )
    own.add_argument("--sight", action="store_true", help="points read only probes that they see")
    own.add_argument(
        "--tolerance", type=fraction, metavar="E",
        help="end with the fewest probes whose error meets it at points and under lights that are held out",
    )  # fmt: skip
    own.add_argument("--steps", type=positive, metavar="N", help="of descent (default: 300)")
    own.add_argument("--relocations", type=natural, metavar="N", help="of probes in between (default: 3)")
    own.add_argument("--leak", type=natural_float, metavar="W", help="weight of reading through walls (default: 0)")
    own.add_argument("--reach", type=positive_float, metavar="M", help="ask that each point has a probe within M metres")
    own.add_argument(
        "--region", type=_region, action="append", default=[], metavar="X0,Y0,Z0,X1,Y1,Z1",
        help="box [m] that probes may stand in; repeatable; write --region=-1,... where the first number is negative",
    )  # fmt: skip
    seeded(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> int:
    """Place, write, and say how good the probes are at the points that placed them."""
    from difflpv.io import load_scene
    from difflpv.placement.from_targets import placement_task
    from difflpv.probes.probe_files import save_probes

    options = _options(args)
    scene = load_scene(args.scene)
    warnings = list(scene.warnings)
    warn(warnings)
    targets = _targets(args, scene)
    lights = tuple(range(len(targets.light_sets))) if args.lights is None else args.lights
    check_indices("--lights", lights, len(targets.light_sets), str(targets.folder))
    if not lights:
        raise UsageError("--lights: expected at least one light set, got none")
    bake = lights[0] if args.bake is None else args.bake
    if bake not in lights:
        raise UsageError(f"--bake: expected one of the light sets {', '.join(map(str, lights))}, got {bake}")
    make_folder("--out", args.out)
    request = _request(args, options, targets, lights)
    record = None if args.overwrite else _finished(args.out, request, bake)
    recognised = record is not None
    if record is None:
        record = _place(args, options, placement_task(scene, targets, lights=lights), request, targets, lights.index(bake))
        save_probes(args.out, record)
    interrupted = bool(record.provenance["interrupted"])
    if args.json:
        print_json(_report(args, record, targets) | {"recognised": recognised, "warnings": warnings})
    else:
        print(_text(args.out, record, recognised))
    return INTERRUPTED if interrupted else 0


def _region(text: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    low, high = numbers[:3], numbers[3:]
    if len(numbers) != 6 or not all(a < b for a, b in zip(low, high, strict=True)):
        raise argparse.ArgumentTypeError(f"expected x0,y0,z0,x1,y1,z1 with each first number below the second, got '{text}'")
    return low, high


def _options(args: argparse.Namespace) -> dict[str, Any]:
    """What is given of the method's own options, in the words of ``place``."""
    options = {name: getattr(args, name) for name in _OWN if getattr(args, name) is not None}
    if args.sight:
        options["sight"] = True
    if args.region:
        options["regions"] = args.region
    if args.reach is not None:
        options["coverage"] = 1.0
    if args.edge_rays and args.interpolation == "gaussian":
        raise UsageError("--edge-rays: belongs to --interpolation tetrahedra, got gaussian")
    return options


def _targets(args: argparse.Namespace, scene: Scene) -> ProbeTargets:
    """Those of the folder, or new ones by default."""
    from data_gen.probe_targets import load_probe_targets, make_probe_targets

    if args.targets is not None:
        targets = load_probe_targets(args.targets)
        targets.check_scene(scene)
        return targets
    progress = False if args.json else None
    return make_probe_targets(scene, args.out / "targets", workers=args.workers, progress=progress)


def _request(args: argparse.Namespace, options: dict[str, Any], targets: ProbeTargets, lights: tuple[int, ...]) -> Any:
    """Everything that decides where the probes go, as JSON values."""
    from data_gen.request import request_digest

    return jsonable(
        {
            "targets": request_digest(targets.manifest["request"]),
            "method": args.method,
            "count": args.count,
            "seed": args.seed,
            "lights": lights,
            "edge_rays": args.edge_rays,
            "options": options,
        }
    )


def _finished(out: Path, request: dict[str, Any], bake: int) -> ProbeRecord | None:
    """Probes of this request that are there already.

    Raises:
        UsageError: the folder holds probes of another request.
        ProbeFileError: it holds probes that cannot be read.
    """
    from difflpv.probes.probe_files import load_probes

    if not (out / "probes.json").exists():
        return None
    record = load_probes(out)
    there = record.provenance.get("request", {})
    differing = [key for key in request if there.get(key) != request[key]]
    if differing:
        raise UsageError(
            f"{out}: holds probes of another request (different {', '.join(differing)}); choose another folder, or --overwrite"
        )
    again = record.provenance["interrupted"] or record.provenance["light"] != bake
    return None if again else record


def _place(
    args: argparse.Namespace,
    options: dict[str, Any],
    task: PlacementTask,
    request: dict[str, Any],
    targets: ProbeTargets,
    light: int,
) -> ProbeRecord:
    from difflpv.placement.content import probe_record, with_fitted_content
    from difflpv.placement.edge_rays import with_edge_rays
    from difflpv.placement.place import place

    if args.method == "gradient":
        checkpoint = args.out / "checkpoint.pt"
        if args.overwrite:
            checkpoint.unlink(missing_ok=True)
        options = options | {"checkpoint": checkpoint}
    progress = Progress(quiet=args.json)

    def show(step: int, error: float, count: int) -> None:
        known = f"error {error:.4f}, " if error == error else ""
        progress.show(f"place: step {step}, {known}{count} probes")

    with usage_errors():
        try:
            placement = place(task, args.count, args.method, seed=args.seed, progress=show, **options)
        finally:
            progress.close()
    interrupted = _interrupted(placement)
    if args.edge_rays and not interrupted:
        fitted = placement.radiance is not None
        placement = with_edge_rays(task, placement, progress=show)
        progress.close()
        if fitted:
            placement = with_fitted_content(task, placement)
    provenance = {
        "command": "probes place",
        "request": request,
        "targets": {"folder": str(targets.folder), "digest": request["targets"]},
        "component": targets.component,
        "light": request["lights"][light],
        "content": "field" if placement.radiance is None else "fitted",
        "interrupted": interrupted,
        "details": jsonable(dict(placement.details)),
    }
    return probe_record(task, placement, light=light, provenance=provenance)


def _interrupted(placement: Placement) -> bool:
    """By Ctrl-C: the gradient says so itself, the solvers without derivatives by their status."""
    return bool(placement.details.get("interrupted")) or placement.details.get("status") == "interrupted"


def _report(args: argparse.Namespace, record: ProbeRecord, targets: ProbeTargets) -> dict[str, Any]:
    kept = ("light", "content", "interrupted", "details", "seconds", "evaluations", "component")
    return {
        "command": "probes place",
        "folder": args.out,
        "targets": targets.folder,
        "method": record.method,
        "probes": len(record.probes),
        "training_error": record.errors["training"],
        "request": record.provenance["request"],
        **{key: record.provenance[key] for key in kept},
    }


def _text(out: Path, record: ProbeRecord, recognised: bool) -> str:
    known = record.provenance
    state = "already there, nothing repeated: " if recognised else ""
    if known["interrupted"]:
        state = "interrupted, the best so far: "
    lines = [
        f"{out}: {state}{len(record.probes)} probes by {record.method}, error {record.errors['training']:.4f} at the points "
        f"that placed them ({known['seconds']:.1f} s)"
    ]
    details = known["details"]
    if "met" in details:
        met = "met" if details["met"] else "not met"
        lights = len(details["lights_held_out"])
        under = f"{lights} light set(s) held out" if lights else "lights that placed, too few to hold some out"
        lines.append(
            f"tolerance {details['tolerance']:g} {met}: error {details['held_out_error']:.4f} at points held out, below "
            f"{details['held_out_bound']:.4f} with {details['confidence']:.0%} confidence, under {under}"
        )
    if "edge_ray_probes" in details:
        lines.append(f"{details['edge_ray_probes']} of them by edge rays")
    how = "fitted to the points" if known["content"] == "fitted" else "the field's values"
    lines.append(f"they hold the light of set {known['light']} of {known['targets']['folder']} ({known['component']}): {how}")
    if known["interrupted"]:
        lines.append("the same command goes on" if record.method == "gradient" else "the same command starts anew")
    return "\n".join(lines)
