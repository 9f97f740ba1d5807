"""``difflpv render``: what the scene's camera sees, lit by the volume."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from difflpv.cli.floor import add_floor, check_floor, floor_of
from difflpv.cli.options import (
    COMPONENTS,
    UsageError,
    add_command,
    add_device,
    add_lights,
    add_output,
    check_indices,
    chosen_light,
    natural,
    seeded,
    select_device,
)
from difflpv.cli.output import make_folder_of, print_json, warn
from difflpv.cli.simulate import add_constant, check_targets, constant_irradiance
from difflpv.cli.solve import Solve, add_solve, describe_solve, solve_from

if TYPE_CHECKING:
    from difflpv.scene import Camera, Scene

__all__ = ["add_parser", "run"]


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = add_command(
        subparsers,
        "render",
        run,
        help="an image from the scene's camera",
        description="Radiance that the scene's camera sees (albedo x irradiance / pi, and what lights emit) as OpenEXR with "
        "the channels R,G,B for the sum and direct.R, bounce1.R, ... for each component, and a tone-mapped PNG beside it.",
        example="difflpv render cornell --method holpv --out out/cornell.exr\n"
        "difflpv render cornell --fitted out/fit --component bounce1 --exposure 1.5 --out out/fitted.exr",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="IMAGE.exr", help="image; the PNG gets the same name")
    parser.add_argument(
        "--component", nargs="+", choices=COMPONENTS, default=list(COMPONENTS), help="what to add up (default: direct bounce1)"
    )
    parser.add_argument("--camera", type=natural, default=0, metavar="K", help="which camera (default: %(default)s)")
    parser.add_argument(
        "--exposure", type=float, metavar="STOPS", help="of the PNG (default: white at the 98th percentile, printed)"
    )
    add_solve(parser)
    add_constant(parser)
    add_floor(parser)
    add_lights(parser)
    add_device(parser)
    seeded(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> int:
    """Render and write both images."""
    from difflpv.io import load_scene
    from difflpv.io.exr import write_exr
    from difflpv.io.png import auto_exposure, write_png

    started = time.perf_counter()
    if args.out.suffix.lower() != ".exr":
        raise UsageError(f"--out: expected a file name ending in .exr, got {args.out}")
    if args.exposure is not None and not abs(args.exposure) <= 100:
        raise UsageError(f"--exposure: expected stops in -100..100, got {args.exposure}")
    scene = load_scene(args.scene)
    if args.camera >= len(scene.cameras):
        raise UsageError(f"--camera: {args.camera} is out of range, scene '{scene.name}' has {len(scene.cameras)} camera(s)")
    camera = scene.cameras[args.camera]
    solve = solve_from(args, scene)
    check_floor(args, solve)
    make_folder_of("--out", args.out)
    images, told = _images(args, scene, solve, camera)
    warnings = [*scene.warnings, *told]
    warn(warnings)
    total = np.sum(list(images.values()), axis=0)
    channels = {name: total[:, :, k] for k, name in enumerate("RGB")}
    for component, image in images.items():
        channels |= {f"{component}.{name}": image[:, :, k] for k, name in enumerate("RGB")}
    exposure = auto_exposure(total) if args.exposure is None else args.exposure
    preview = args.out.with_suffix(".png")
    write_exr(args.out, channels, {"scene": scene.name, "method": solve.label, "components": " ".join(images)})
    write_png(preview, total, exposure=exposure)
    seconds = time.perf_counter() - started
    if args.json:
        print_json(
            {
                "command": "render",
                "scene": scene.name,
                "method": solve.label,
                "config": None if solve.method == "constant" else solve.config.to_json(),
                "components": list(images),
                "channels": list(channels),
                "width": camera.width,
                "height": camera.height,
                "exposure": exposure,
                "out": args.out,
                "preview": preview,
                "seconds": round(seconds, 3),
                "warnings": list(dict.fromkeys(warnings)),
            }
        )
        return 0
    print(f"{scene.name}, {' + '.join(images)}: {describe_solve(solve)}")
    print(f"{camera.width} x {camera.height} pixels, exposure {exposure:+.2f} stops, {seconds:.1f} s -> {args.out}, {preview}")
    return 0


def _images(
    args: argparse.Namespace, scene: Scene, solve: Solve, camera: Camera
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Radiance [H,W,3] by component, and what the solves had to say."""
    from difflpv.camera_view import camera_view
    from difflpv.illumination import illuminate
    from difflpv.raycast import Raycaster
    from difflpv.simulate import render

    components = list(dict.fromkeys(args.component))
    images: dict[str, np.ndarray] = {}
    told: list[str] = []
    if solve.method == "constant":
        lit = _lit_by_targets(args, scene)
        view = camera_view(lit, Raycaster(lit), camera)
        for component in components:
            irradiance = np.broadcast_to(constant_irradiance(args, scene, component), view.position.shape)
            images[component] = view.image(irradiance, emission=component == "direct")
        return images, told
    check_targets(args, solve)
    device = select_device(args.device)
    lit = chosen_light(args, scene)
    for component in components:
        light = illuminate(lit, solve.grid, solve.config, component, seed=args.seed, device=device)
        if solve.method == "floor":
            view = camera_view(lit, light.raycaster, camera)
            floor = floor_of(args, light, view.position, view.normal)
            images[component] = view.image(floor.irradiance, emission=component == "direct")
            told += floor.warnings
            continue
        images[component], warnings = render(solve.model(lit), light, camera)
        told += warnings
    return images, told


def _lit_by_targets(args: argparse.Namespace, scene: Scene) -> Scene:
    """The scene under the light set of ``--targets`` that ``--light`` names."""
    from data_gen.load import load_targets
    from difflpv.lights import apply_light_set

    if args.targets is None:
        raise UsageError("--method constant: needs --targets DIR, it predicts their area-weighted mean")
    lights = load_targets(args.targets).lights
    check_indices("--light", [args.light or 0], len(lights), str(args.targets))
    return apply_light_set(scene, lights[args.light or 0].entries)
