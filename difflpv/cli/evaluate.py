"""``difflpv evaluate``: how far a method is from path-traced targets."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from difflpv.cli.floor import add_floor, check_floor, floor_folder, floor_of, known_floor
from difflpv.cli.options import (
    COMPONENTS,
    UsageError,
    add_command,
    add_device,
    add_output,
    check_indices,
    index_list,
    seeded,
    select_device,
)
from difflpv.cli.output import Progress, print_json, warn
from difflpv.cli.solve import Solve, add_solve, describe_solve, solve_from

if TYPE_CHECKING:
    import torch

    from data_gen.load import Targets
    from difflpv.evaluate import Score
    from difflpv.scene import Scene

__all__ = ["add_parser", "run"]


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = add_command(
        subparsers,
        "evaluate",
        run,
        help="errors against targets, per component and light",
        description="Relative L2 error, the same at the best single scale, mean and 95th percentile error, weighted by area, "
        "per component and light and their means, with the constant beside it; for a fitted model the untuned one too. Once "
        "--method floor has path-traced the true light in the cells, every table of these targets and this grid shows it: what "
        "a perfect propagation could do, read by the method's own lookup.",
        example="""
        difflpv evaluate cornell --method lpv --targets out/targets
        difflpv evaluate cornell --method floor --targets out/targets
        difflpv evaluate cornell --fitted out/fit --targets out/targets --component bounce1 --light 5-7
        """,
    )
    parser.add_argument("--targets", type=Path, required=True, metavar="DIR", help="folder from 'difflpv targets'")
    parser.add_argument(
        "--component", nargs="+", choices=COMPONENTS, help="which to compare (default: those that the targets have)"
    )
    parser.add_argument("--light", type=index_list, metavar="LIST", help="which lights of the targets, as 0-4,7 (default: all)")
    add_solve(parser)
    add_floor(parser)
    add_device(parser)
    seeded(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> int:
    """Evaluate and print the table."""
    from data_gen.load import load_targets
    from difflpv.evaluate import format_scores, mean_score
    from difflpv.io import load_scene

    scene = load_scene(args.scene)
    targets = load_targets(args.targets)
    targets.check_scene(scene)
    components = _components(args, targets)
    lights = list(range(len(targets.lights))) if args.light is None else list(args.light)
    if not lights:
        raise UsageError("--light: expected at least one light")
    check_indices("--light", lights, len(targets.lights), str(args.targets))
    solve = solve_from(args, scene)
    check_floor(args, solve)
    device = select_device(args.device) if solve.method != "constant" else None
    progress = Progress(quiet=args.json)
    scores: list[Score] = []
    warnings = list(scene.warnings)
    for component in components:
        for k in lights:
            progress.show(f"evaluate: {component}, light {k}")
            found, told = _score_light(args, scene, targets, solve, component, k, device)
            scores += found
            warnings += [f"light {k}: {line}" for line in told]
    progress.close()
    warn(warnings)
    groups = dict.fromkeys((s.method, s.component) for s in scores)
    means = [mean_score([s for s in scores if (s.method, s.component) == group]) for group in groups]
    if args.json:
        print_json(
            {
                "command": "evaluate",
                "scene": scene.name,
                "method": solve.label,
                "config": None if solve.method == "constant" else solve.config.to_json(),
                "targets": args.targets,
                "scores": [s.to_json() for s in scores],
                "means": [s.to_json() for s in means],
                "warnings": list(dict.fromkeys(warnings)),
            }
        )
        return 0
    print(f"{scene.name}: {describe_solve(solve)}")
    print(format_scores([*scores, *means] if len(lights) > 1 else scores))
    return 0


def _components(args: argparse.Namespace, targets: Targets) -> list[str]:
    if args.component is None:
        components = [name for name in COMPONENTS if name in targets.components]
        if not components:
            raise UsageError(f"--targets: {args.targets} has {', '.join(targets.components)}: need direct or bounce1")
        return components
    for name in args.component:
        if name not in targets.components:
            raise UsageError(f"--component: {args.targets} has {', '.join(targets.components)}, not {name}")
    return list(dict.fromkeys(args.component))


def _score_light(
    args: argparse.Namespace,
    scene: Scene,
    targets: Targets,
    solve: Solve,
    component: Any,
    k: int,
    device: torch.device | None,
) -> tuple[list[Score], tuple[str, ...]]:
    """Scores under one light: the constant, the method, and the fitted model; and what the solve had to say."""
    from difflpv.evaluate import predict_constant, score
    from difflpv.illumination import illuminate
    from difflpv.lights import apply_light_set
    from difflpv.pipeline import Lpv
    from difflpv.simulate import solve_irradiance

    light = targets.lights[k]
    truth, weight = light.irradiance[component], light.area_weight
    predictions = {"constant": predict_constant(truth, weight)}
    told: tuple[str, ...] = ()
    if device is not None:
        lit = apply_light_set(scene, light.entries)
        illumination = illuminate(lit, solve.grid, solve.config, component, seed=args.seed, device=device)
        x, n = targets.receivers.position, targets.receivers.normal
        if solve.method == "floor":
            prediction = floor_of(args, illumination, x, n)
            predictions["floor"], told = prediction.irradiance, prediction.warnings
        else:
            models = {solve.method: Lpv(solve.grid, solve.config)}
            if solve.record is not None:
                models[solve.label] = solve.model(lit)
            for name, lpv in models.items():
                prediction = solve_irradiance(lpv, illumination, x, n)
                predictions[name], told = prediction.irradiance, prediction.warnings
            floor = known_floor(floor_folder(args), illumination, x, n)
            if floor is not None:
                predictions["floor"], told = floor.irradiance, (*told, *floor.warnings)
    rows = [score(p, truth, weight, method=name, component=component, light=k) for name, p in predictions.items()]
    return rows, told
