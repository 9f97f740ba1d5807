"""``difflpv fit``: learn on some lights, be judged on others."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from difflpv.cli.failures import FAILED, INTERRUPTED
from difflpv.cli.held_out import overfitting, peer_scores, unseen_scene, unseen_scores
from difflpv.cli.options import (
    COMPONENTS,
    METHODS,
    UsageError,
    add_command,
    add_device,
    add_output,
    check_indices,
    index_list,
    name_list,
    natural_float,
    positive_float,
    seeded,
    select_device,
    usage_errors,
)
from difflpv.cli.output import Progress, jsonable, make_folder, print_json, warn
from difflpv.cli.solve import Solve, add_solve, describe_solve, learning_defaults, solve_from
from difflpv.optim import SOLVERS

if TYPE_CHECKING:
    import torch

    from data_gen.load import Targets
    from difflpv.evaluate import Score
    from difflpv.fit import FitOutcome, LightTarget
    from difflpv.scene import Scene

__all__ = ["LEARNABLES", "LOSSES", "add_parser", "default_split", "run"]

LEARNABLES = (
    "propagation",
    "propagation_steps",
    "occlusion",
    "occlusion_correction",
    "sampling_bias",
    "injection_bias",
    "lookup_gains",
    "stencil",
    "cell_propagation",
    "cell_occlusion",
    "light_intensity",
    "light_color",
    "light_position",
    "albedo",
)
LOSSES = ("l2", "log", "image-l1", "image-ssim")
_CELL_FIELDS = ("cell_propagation", "cell_occlusion")
_OF_LIGHTS = ("light_intensity", "light_color", "light_position")


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = add_command(
        subparsers,
        "fit",
        run,
        help="fit a volume's factors, lights or albedo to targets",
        description="Minimise the error of a solve over what --learn names, by gradients or without, on the train lights, and "
        "judge it on the test lights beside the constant, the untuned and the published method. Writes fitted.json, "
        "fitted.safetensors, fit.json and a checkpoint; the same command goes on from the checkpoint.",
        example="""
        difflpv fit cornell --targets out/targets --learn propagation,occlusion,sampling_bias \\
            --solver lbfgs --train-lights 0-4 --test-lights 5-7 --budget 100 --out out/fit
        """,
    )
    parser.add_argument("--targets", type=Path, required=True, metavar="DIR", help="folder from 'difflpv targets'")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the fitted model")
    parser.add_argument("--learn", type=name_list, required=True, metavar="NAMES", help=f"of {', '.join(LEARNABLES)}")
    parser.add_argument("--solver", choices=sorted(SOLVERS), default="lbfgs", help="(default: %(default)s)")
    parser.add_argument("--component", choices=COMPONENTS, help="(default: bounce1 where the targets have it, else direct)")
    parser.add_argument(
        "--train-lights", type=index_list, metavar="LIST", help="as 0-4,7 (default: all but the test lights)"
    )
    parser.add_argument(
        "--test-lights",
        type=index_list,
        metavar="LIST",
        help="as 5-7, or none (default: those not trained on; else the last three of eight, in proportion)",
    )
    parser.add_argument("--loss", choices=LOSSES, default="l2", help="image losses need targets with --images (default: l2)")
    parser.add_argument(
        "--budget", type=positive_float, default=60.0, metavar="N", help="forward-equivalents (default: %(default)g)"
    )
    parser.add_argument(
        "--sparsity", type=natural_float, metavar="X", help="weight of the mean |log f| of per-cell fields (default: 0.01)"
    )
    parser.add_argument(
        "--unseen", action="append", default=[], metavar="SCENE=DIR", help="judge on another scene with targets too; repeatable"
    )
    parser.add_argument("--seconds", type=positive_float, metavar="S", help="wall-time limit (default: none)")
    parser.add_argument("--lr", type=positive_float, metavar="X", help="step size of --solver adam (default: 0.05)")
    parser.add_argument("--overwrite", action="store_true", help="start anew instead of going on from DIR's checkpoint")
    add_solve(parser, methods=tuple(name for name in METHODS if name not in ("constant", "floor")), fitted=False)
    add_device(parser)
    seeded(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> int:
    """Fit, save, and print the table."""
    from data_gen.load import load_targets
    from difflpv.io import load_scene
    from difflpv.io.atomic import write_json
    from difflpv.optim.result import Status

    if args.lr is not None and args.solver != "adam":
        raise UsageError(f"--lr: belongs to --solver adam, got --solver {args.solver}")
    fields = set(args.learn) & set(_CELL_FIELDS)
    if args.sparsity and not fields:
        raise UsageError(f"--sparsity: belongs to --learn {' or '.join(_CELL_FIELDS)}")
    if args.sparsity is None and fields:
        args.sparsity = 0.01
    scene = load_scene(args.scene)
    targets = load_targets(args.targets)
    targets.check_scene(scene)
    component = _component(args, targets)
    others = [unseen_scene(text, args.learn, component) for text in args.unseen]
    train, test = _split(args, len(targets.lights))
    solve = solve_from(args, scene, **learning_defaults(args.learn, args.method or "holpv"))
    _check_learn(args, scene, solve)
    device = select_device(args.device)
    make_folder("--out", args.out)
    warn(scene.warnings)
    if not args.json:
        print(f"{scene.name}, {component}: {describe_solve(solve)}")
        learned = ", ".join(args.learn)
        print(f"learn {learned} by {args.solver} on lights {_listed(train)}, judged on {_listed(test)}", flush=True)
    lights = _light_targets(args, scene, targets, solve, component, [*train, *test], device)
    outcome = _fit(args, scene, targets, lights, solve, component, train, test)
    train_scores, test_scores = (peer_scores(outcome, lights, group) for group in (train, test))
    report = _report(args, outcome, component, train_scores, test_scores)
    _save(args, scene, targets, outcome, component, report)
    unseen = {u.label: unseen_scores(u, outcome.lpv, component, seed=args.seed, device=device) for u in others}
    if unseen:  # what was fitted lies there, whatever other scenes do
        report["unseen"] = {label: [s.to_json() for s in scores] for label, scores in unseen.items()}
        write_json(args.out / "fit.json", report)
    warn(_lost(lights, outcome))
    if args.json:
        print_json(report)
    else:
        print(_text(outcome, train_scores, test_scores, unseen, args.out))
    if outcome.result.status is Status.INTERRUPTED:
        return INTERRUPTED
    return FAILED if outcome.result.status in (Status.NON_FINITE, Status.FAILED) else 0


def default_split(count: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Train and test lights of ``count``: three eighths are held back, 0-4 and 5-7 of eight."""
    held = min(round(count * 3 / 8), count - 1)
    return tuple(range(count - held)), tuple(range(count - held, count))


def _split(args: argparse.Namespace, count: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    train, test = args.train_lights, args.test_lights
    if train is None and test is None:
        train, test = default_split(count)
    elif train is None:
        train = tuple(k for k in range(count) if k not in test)
    elif test is None:
        alone = any(name in _OF_LIGHTS for name in args.learn)  # what is learned of one light says nothing of others
        test = () if alone else tuple(k for k in range(count) if k not in train)
    for option, chosen in (("--train-lights", train), ("--test-lights", test)):
        check_indices(option, chosen, count, str(args.targets))
    if not train:
        raise UsageError("--train-lights: expected at least one light")
    both = sorted(set(train) & set(test))
    if both:
        raise UsageError(f"--test-lights: {_listed(both)} would be judged on what was learned; leave them out of one list")
    lights = [name for name in args.learn if name in _OF_LIGHTS]
    if lights and len(train) + len(test) > 1:
        raise UsageError(f"--learn: {', '.join(lights)} belong to one light: name it with --train-lights K --test-lights none")
    return train, test


def _component(args: argparse.Namespace, targets: Targets) -> Any:
    if args.component is None:
        for name in ("bounce1", "direct"):
            if name in targets.components:
                return name
        raise UsageError(f"--targets: {args.targets} has {', '.join(targets.components)}: need direct or bounce1")
    if args.component not in targets.components:
        raise UsageError(f"--component: {args.targets} has {', '.join(targets.components)}, not {args.component}")
    return args.component


def _check_learn(args: argparse.Namespace, scene: Scene, solve: Solve) -> None:
    from difflpv.learnables import describe_learnables

    with usage_errors():
        describe_learnables(args.learn, solve.config, solve.grid, scene)


def _listed(lights: Sequence[int]) -> str:
    return ", ".join(str(k) for k in lights) or "none"


def _light_targets(
    args: argparse.Namespace,
    scene: Scene,
    targets: Targets,
    solve: Solve,
    component: Any,
    wanted: Sequence[int],
    device: torch.device,
) -> list[LightTarget]:
    from difflpv.fit import light_target
    from difflpv.io.exr import read_image

    image_loss = args.loss.startswith("image")
    if image_loss and not targets.lights[0].images:
        raise UsageError(f"--loss: {args.loss} needs images, make the targets with 'difflpv targets ... --images'")
    progress = Progress(quiet=args.json)
    found = []
    for k in wanted:
        progress.show(f"fit: tracing light {k}")
        light = targets.lights[k]
        found.append(
            light_target(
                scene,
                light.entries,
                solve.grid,
                solve.config,
                component,
                index=k,
                position=targets.receivers.position,
                normal=targets.receivers.normal,
                irradiance=light.irradiance[component],
                weight=light.area_weight,
                image=read_image(light.images[component])[0] if image_loss else None,
                seed=args.seed,
                device=device,
            )
        )
    progress.close()
    return found


def _fit(
    args: argparse.Namespace,
    scene: Scene,
    targets: Targets,
    lights: Sequence[LightTarget],
    solve: Solve,
    component: str,
    train: Sequence[int],
    test: Sequence[int],
) -> FitOutcome:
    from data_gen.request import request_digest
    from difflpv.fit import fit
    from difflpv.optim.result import HistoryPoint

    checkpoint = args.out / "checkpoint.pt"
    if args.overwrite:
        checkpoint.unlink(missing_ok=True)
    progress = Progress(quiet=args.json)
    best = float("inf")

    def show(point: HistoryPoint) -> None:
        nonlocal best
        best = min(best, point.loss)
        progress.show(
            f"fit: {point.forward_equivalents:.0f} of {args.budget:g} forward-equivalents, "
            f"loss {point.loss:.4f}, best {best:.4f}, {point.seconds:.0f} s"
        )

    made_of = request_digest(targets.manifest["request"])[:12]
    config = ", ".join(f"{k} {v}" for k, v in solve.config.to_json().items())
    label = (
        f"{scene.name} {component} {args.loss}, targets {made_of}, train {_listed(train)}, {solve.grid}, {config}, "
        f"seed {args.seed}"
    )
    options = {} if args.lr is None else {"lr": args.lr}
    with usage_errors():
        try:
            return fit(
                scene,
                lights,
                config=solve.config,
                learn=args.learn,
                train=train,
                test=test,
                solver=args.solver,
                loss=args.loss,
                sparsity=args.sparsity or 0.0,
                budget=args.budget,
                seconds=args.seconds,
                seed=args.seed,
                checkpoint=checkpoint,
                callback=show,
                label=label,
                **options,
            )
        finally:
            progress.close()


def _report(
    args: argparse.Namespace,
    outcome: FitOutcome,
    component: str,
    train_scores: Sequence[Score],
    test_scores: Sequence[Score],
) -> dict[str, Any]:
    result = outcome.result
    return jsonable(
        {
            "command": "fit",
            "scene": args.scene,
            "targets": args.targets,
            "component": component,
            "config": outcome.lpv.config.to_json(),
            "learn": args.learn,
            "solver": args.solver,
            "loss_name": args.loss,
            "train_lights": outcome.train,
            "test_lights": outcome.test,
            "status": result.status.value,
            "message": result.message,
            "loss": result.loss,
            "forward_equivalents": result.forward_equivalents,
            "evaluations": result.evaluations,
            "seconds": result.seconds,
            "values": {name: value.tolist() for name, value in result.parameters.items()},
            "train": [s.to_json() for s in train_scores],
            "test": [s.to_json() for s in test_scores],
            "scores": [s.to_json() for s in outcome.scores],
            "history": [list(point) for point in result.history],
            "out": args.out,
        }
    )


def _save(
    args: argparse.Namespace,
    scene: Scene,
    targets: Targets,
    outcome: FitOutcome,
    component: str,
    report: dict[str, Any],
) -> None:
    from difflpv.io.atomic import write_json

    keys = ("solver", "loss_name", "loss", "status", "train_lights", "test_lights", "forward_equivalents", "train", "test")
    provenance = {
        "scene": {"name": scene.name, "hash": scene.hash},
        "targets": {"folder": str(targets.folder), "lights": targets.manifest["request"]["lights"]},
        "component": component,
        "seed": args.seed,
        **{key: report[key] for key in keys},
    }
    outcome.lpv.save(args.out, provenance=provenance)
    write_json(args.out / "fit.json", report)


def _lost(lights: Sequence[LightTarget], outcome: FitOutcome) -> list[str]:
    """What the fitted solve has to say under each light."""
    from difflpv.simulate import solve_irradiance

    lines = []
    for target in lights:
        receivers = target.receivers
        x, n = receivers.position.cpu().numpy(), receivers.normal.cpu().numpy()
        prediction = solve_irradiance(outcome.lpv, target.illumination, x, n)
        lines += [f"light {target.index}: {line}" for line in prediction.warnings]
    return lines


def _text(
    outcome: FitOutcome, train: Sequence[Score], test: Sequence[Score], unseen: Mapping[str, Sequence[Score]], folder: Path
) -> str:
    from difflpv.evaluate import format_scores

    result = outcome.result
    lines = [f"{result.message} ({result.forward_equivalents:.0f} forward-equivalents, {result.seconds:.1f} s)"]
    for name, value in result.parameters.items():
        flat = value.reshape(-1).tolist()
        shown = ", ".join(f"{v:.4g}" for v in flat[:12]) + (", ..." if len(flat) > 12 else "")
        lines.append(f"  {name} = {shown}")
    lines += [f"train lights {_listed(outcome.train)}, loss {result.loss:.4f}", format_scores(train)]
    if test:
        lines += [f"test lights {_listed(outcome.test)}", format_scores(test)]
        lines += overfitting(train, test)
    for name, scores in unseen.items():
        lines += [f"scene '{name}', never seen", format_scores(scores)]
    lines.append(f"model in {folder}")
    return "\n".join(lines)
