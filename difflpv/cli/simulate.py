"""``difflpv simulate``: irradiance of receivers by a volume solve."""

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
    seeded,
    select_device,
)
from difflpv.cli.output import make_folder_of, print_json, warn
from difflpv.cli.solve import Solve, add_solve, describe_solve, solve_from

if TYPE_CHECKING:
    from difflpv.evaluate import Score
    from difflpv.io.tables import ReceiverTable
    from difflpv.scene import Scene
    from difflpv.simulate import Prediction

__all__ = ["add_constant", "add_parser", "check_targets", "constant_irradiance", "run"]


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = add_command(
        subparsers,
        "simulate",
        run,
        help="predict the irradiance of receivers",
        description="Solve a light propagation volume and write the irradiance of a table of receivers (position [n,3] m, "
        "normal [n,3]). Where the table holds the truth (irr_direct, irr_bounce1) the error is printed too; a table of "
        "'difflpv targets' is the truth under its own light set alone.",
        example="""
        difflpv simulate cornell --method holpv --component bounce1 --lights bundled --light 0 \\
            --receivers out/targets/light_0.npz --out out/prediction.npz
        """,
    )
    parser.add_argument("--receivers", type=Path, required=True, metavar="TABLE.npz", help="where irradiance is asked for")
    parser.add_argument("--out", type=Path, required=True, metavar="PRED.npz", help="the table with irradiance [n,3] W/m2")
    parser.add_argument(
        "--component",
        choices=COMPONENTS,
        default="bounce1",
        help="direct: area lights through the volume, others by shadow rays; bounce1: one bounce (default: %(default)s)",
    )
    add_solve(parser)
    add_constant(parser)
    add_floor(parser)
    add_lights(parser)
    add_device(parser)
    seeded(parser)
    add_output(parser)


def add_constant(parser: Any) -> None:
    """``--targets`` of ``--method constant``."""
    parser.add_argument(
        "--targets", type=Path, metavar="DIR", help="for --method constant: targets whose mean it predicts (light "
        "--light); for --method floor: the true volume is kept there (default: beside --out)"
    )


def check_targets(args: argparse.Namespace, solve: Solve) -> None:
    """A ``UsageError`` for ``--targets`` of a method that has no use for them."""
    if args.targets is not None and solve.method != "floor":
        raise UsageError("--targets: only --method constant takes its mean from targets, and floor keeps its volume there")


def run(args: argparse.Namespace) -> int:
    """Predict, write, and score where the truth is known."""
    from difflpv.evaluate import format_scores
    from difflpv.io import load_scene
    from difflpv.io.tables import load_receivers, load_table, save_table

    started = time.perf_counter()
    if args.out.suffix != ".npz":
        raise UsageError(f"--out: expected a file name ending in .npz, got {args.out}")
    scene = load_scene(args.scene)
    table = load_receivers(args.receivers)
    if args.out.exists() and args.out.samefile(args.receivers):
        raise UsageError(f"--out: {args.out} is the table of --receivers and would be lost; choose another file")
    has_weight = "area_weight" in load_table(args.receivers)
    solve = solve_from(args, scene)
    check_floor(args, solve)
    prediction, lit = _predict(args, scene, solve, table)
    unjudged = _unjudged(args, table, lit)
    warnings = [*scene.warnings, *prediction.warnings, *unjudged]
    warn(warnings)
    columns: dict[str, Any] = {"position": table.position, "normal": table.normal, "irradiance": prediction.irradiance}
    if has_weight:
        columns["area_weight"] = table.area_weight
    if table.albedo is not None:
        columns["albedo"] = table.albedo
    save_table(args.out, **columns)
    scores = [] if unjudged else _scores(args, solve.label, table, prediction.irradiance)
    seconds = time.perf_counter() - started
    mean = np.average(prediction.irradiance, axis=0, weights=table.area_weight)
    if args.json:
        print_json(
            {
                "command": "simulate",
                "scene": scene.name,
                "method": solve.label,
                "component": args.component,
                "config": None if solve.method == "constant" else solve.config.to_json(),
                "receivers": len(table),
                "mean_irradiance": mean,
                "scores": [s.to_json() for s in scores],
                "out": args.out,
                "seconds": round(seconds, 3),
                "warnings": warnings,
            }
        )
        return 0
    print(f"{scene.name}, {args.component}: {describe_solve(solve)}")
    print(f"{len(table)} receivers, mean irradiance {np.array2string(mean, precision=4)} W/m2, {seconds:.1f} s -> {args.out}")
    if scores:
        print(format_scores(scores))
    return 0


def _predict(
    args: argparse.Namespace, scene: Scene, solve: Solve, table: ReceiverTable
) -> tuple[Prediction, Scene | None]:
    """The prediction, and the scene under the lights that it was solved for; None for the constant, which solves nothing."""
    from difflpv.illumination import illuminate
    from difflpv.simulate import Prediction, simulate

    if solve.method == "constant":
        mean = constant_irradiance(args, scene, args.component)
        make_folder_of("--out", args.out)
        return Prediction(np.broadcast_to(mean, table.position.shape).copy()), None
    check_targets(args, solve)
    device = select_device(args.device)
    lit = chosen_light(args, scene)
    make_folder_of("--out", args.out)
    if solve.method == "floor":
        light = illuminate(lit, solve.grid, solve.config, args.component, seed=args.seed, device=device)
        return floor_of(args, light, table.position, table.normal), lit
    prediction = simulate(
        lit,
        table.position,
        table.normal,
        grid=solve.grid,
        component=args.component,
        lpv=solve.model(lit),
        seed=args.seed,
        device=device,
    )
    return prediction, lit


def constant_irradiance(args: argparse.Namespace, scene: Scene, component: str) -> np.ndarray:
    """Area-weighted mean irradiance [3] W/m2 of the targets' light set ``--light``."""
    from data_gen.load import load_targets
    from difflpv.evaluate import predict_constant

    if args.targets is None:
        raise UsageError("--method constant: needs --targets DIR, it predicts their area-weighted mean")
    if args.lights is not None:
        raise UsageError("--lights: --method constant reads light set --light of --targets, not of a file")
    targets = load_targets(args.targets)
    targets.check_scene(scene)
    if component not in targets.components:
        raise UsageError(f"--component: {args.targets} has {', '.join(targets.components)}, not {component}")
    if args.light is None and len(targets.lights) > 1:
        raise UsageError(f"--targets: choose one of the {len(targets.lights)} light sets with --light")
    check_indices("--light", [args.light or 0], len(targets.lights), str(args.targets))
    light = targets.lights[args.light or 0]
    return predict_constant(light.irradiance[component], light.area_weight)[0]


def _unjudged(args: argparse.Namespace, table: ReceiverTable, lit: Scene | None) -> list[str]:
    """Why the truth that the table holds tells no error of this prediction, in a line; nothing where it does, or has none."""
    from data_gen.load import light_of_table

    name = f"irr_{args.component}"
    truth = table.extras.get(name)
    if truth is None:
        return []
    made_under = light_of_table(args.receivers)
    if lit is not None and made_under not in (None, lit.hash):
        return [
            f"{args.receivers}: the truth under another scene or light set than those of this solve, no error is told; name "
            "the light set with --lights and --light, or use 'difflpv evaluate'"
        ]
    if truth.shape != table.position.shape:
        shapes = f"expected shape {list(table.position.shape)}, got {list(truth.shape)}"
        return [f"{args.receivers}: {name}: {shapes}, no error is told"]
    if not np.isfinite(truth).all():
        return [f"{args.receivers}: {name}: row {int(np.argmin(np.isfinite(truth).all(1)))} is not finite, no error is told"]
    return [] if np.any(truth) else [f"{args.receivers}: {name} is 0 everywhere, no relative error is told"]


def _scores(args: argparse.Namespace, label: str, table: ReceiverTable, irradiance: np.ndarray) -> list[Score]:
    """The prediction's score and the constant's, where the table holds the truth."""
    from difflpv.evaluate import predict_constant, score

    component, light = args.component, args.light or 0
    truth = table.extras.get(f"irr_{component}")
    if truth is None:
        return []
    weight = table.area_weight
    assert weight is not None
    rows = {"constant": predict_constant(truth, weight)} | {label: irradiance}
    return [score(p, truth, weight, method=name, component=component, light=light) for name, p in rows.items()]
