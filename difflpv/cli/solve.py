"""The options of a solve and what they mean: configuration, grid, and a fitted model in their place."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from difflpv.cli.options import LEARNED, METHODS, UsageError, natural, positive, usage_errors
from difflpv.scene import Scene

if TYPE_CHECKING:
    from difflpv.config import LpvConfig
    from difflpv.fitted import FittedRecord
    from difflpv.grid import Grid
    from difflpv.pipeline import Lpv

__all__ = ["Solve", "add_solve", "describe_solve", "learning_defaults", "solve_from"]

# Option -> field of LpvConfig. The options' defaults are None, so that one that was given can be told from one that
# was not: a fitted model fixes them all.
_FIELDS = (
    "method", "steps", "occlusion", "lookup", "normalization", "reprojection", "clamp", "deposit", "occlude_first_step",
    "coarsen_after",
)  # fmt: skip


def add_solve(parser: Any, *, methods: tuple[str, ...] = METHODS, fitted: bool = True) -> None:
    """``--method``, ``--grid`` and what else decides a solve."""
    group = parser.add_argument_group("solve")
    group.add_argument(
        "--method",
        choices=methods,
        help="lpv: 30 faces, 4 coefficients; holpv: 54 faces, 9 coefficients; learned_KxN: K coefficients, N neighbours"
        + ("; constant: the targets' mean" if "constant" in methods else "")
        + ("; floor: the true light in the cells, path-traced" if "floor" in methods else "")
        + " (default: holpv)",
    )
    group.add_argument(
        "--grid", type=positive, metavar="N", help="cells along x (default: the scene's own grid; 32 where it names none)"
    )
    group.add_argument("--steps", type=natural, metavar="N", help="propagation steps (default: 32)")
    occlusion = "none" if fitted else "exp where occlusion is learned, else none"
    group.add_argument(
        "--occlusion",
        choices=("none", "clamp", "exp", "traced"),
        help=f"how geometry blocks the volume (default: traced for learned_KxN; {occlusion})",
    )
    group.add_argument(
        "--lookup",
        choices=("trilinear", "damped", "front", "visible", "affine"),
        help="cells a receiver may read: all eight (damped: as the HOLPV thesis), those before its plane, those in its sight, "
        "an affine fit to 27 in its sight (default: affine for learned_KxN and floor, else trilinear)",
    )
    group.add_argument(
        "--normalization", choices=("energy", "thesis"), help="energy keeps the flux, thesis a quarter (default: energy)"
    )
    group.add_argument(
        "--reprojection", choices=("face", "ray"), help="lobe along the face's normal or the ray (default: face)"
    )
    group.add_argument(
        "--no-clamp",
        dest="clamp",
        action="store_false",
        default=None,
        help="let negative intensity carry negative flux: makes transport linear (default: clamp)",
    )
    deposit = "visible for learned_KxN, else nearest"
    deposit += "" if fitted else "; trilinear where injection_bias or light_position is learned"
    group.add_argument(
        "--deposit", choices=("nearest", "trilinear", "visible"), help=f"how VPLs enter the cells (default: {deposit})"
    )
    group.add_argument(
        "--occlude-first-step",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="block the first step too (default: with traced occlusion; the publications leave it free)",
    )
    group.add_argument(
        "--coarsen-after",
        type=positive,
        metavar="N",
        help="after N steps light goes on in cells of twice the edge, at an eighth of the cost (default: one grid)",
    )
    group.add_argument(
        "--config", type=Path, metavar="FILE.json", help="what 'difflpv plan' wrote, in place of the options above but --grid"
    )
    if fitted:
        group.add_argument(
            "--fitted", type=Path, metavar="DIR", help="a model from 'difflpv fit', in place of the options above"
        )


@dataclass(frozen=True, eq=False)
class Solve:
    """What is to be solved, and by which model.

    Attributes:
        method: of the volume, "constant", or "floor".
        config: of the volume; of HOLPV for "constant", which does not use it, and "floor", which uses its lookup.
        grid: cells.
        record: the fitted model's file, or None.
        folder: where that lies, or None.
    """

    method: str
    config: LpvConfig
    grid: Grid
    record: FittedRecord | None = None
    folder: Path | None = None

    @property
    def label(self) -> str:
        """Name for tables."""
        return f"{self.method} fitted" if self.record is not None else self.method

    def model(self, lit: Scene) -> Lpv:
        """The module, fitted or not; ``lit`` is the scene under the lights to solve for."""
        from difflpv.pipeline import Lpv

        if self.folder is None:
            return Lpv(self.grid, self.config)
        return Lpv.load(self.folder, scene=lit, grid=self.grid)


def solve_from(args: argparse.Namespace, scene: Scene, **defaults: Any) -> Solve:
    """The solve that the options describe.

    Args:
        args: parsed options.
        scene: before any light set is applied.
        **defaults: fields of ``LpvConfig`` in place of its own defaults.
    """
    from difflpv.config import LpvConfig, grid_for

    given = {name: getattr(args, name) for name in _FIELDS if getattr(args, name) is not None}
    folder = getattr(args, "fitted", None)
    if folder is not None:
        if args.config is not None:
            raise UsageError("--config: --fitted brings a configuration of its own, give one of the two")
        return _fitted(args, scene, folder, given)
    if args.config is not None:
        return _configured(args, scene, given)
    method = given.get("method", "holpv")
    if method == "floor":
        for name in sorted(given.keys() - {"method", "lookup"}):
            option = _option(name, given[name])
            raise UsageError(f"{option}: --method floor solves nothing, only --grid, --lookup and --spp count")
        defaults |= {"lookup": "affine"}
    with usage_errors():
        grid = grid_for(scene, args.grid)
        volume = {k: v for k, v in given.items() if k != "method"}
        volume |= {} if method in ("constant", "floor") else {"method": method}
        config = LpvConfig(**(defaults | volume))
    return Solve(method, config, grid)


def _configured(args: argparse.Namespace, scene: Scene, given: dict[str, Any]) -> Solve:
    from difflpv.config import LpvConfig, grid_for
    from difflpv.config_file import read_config_file

    file = read_config_file(args.config)
    fixed = {"method": file.method} if file.config is None else file.config.to_json()
    for name, value in given.items():
        if value != fixed.get(name):
            shown = "" if isinstance(value, bool) else f" {value}"
            raise UsageError(f"{_option(name, value)}{shown}: {args.config} has {name} {fixed.get(name)}")
    if file.config is None and not hasattr(args, "fitted"):
        raise UsageError(f"--config: {args.config} is a constant, which has nothing to fit")
    if file.config is not None and file.config.probes and file.scene is not None and file.scene[1] != scene.hash:
        placed, here = f"scene '{file.scene[0]}'", f"this '{scene.name}'"
        raise UsageError(f"--config: {args.config} has light probes placed in {placed}, not in {here}")
    with usage_errors():
        return Solve(file.method, file.config or LpvConfig(), grid_for(scene, args.grid or file.cells))


def _fitted(args: argparse.Namespace, scene: Scene, folder: Path, given: dict[str, Any]) -> Solve:
    from difflpv.config import grid_for
    from difflpv.fitted import read_fitted

    record = read_fitted(folder)
    for name, value in given.items():
        fixed = getattr(record.config, name)
        if value != fixed:
            shown = "" if isinstance(value, bool) else f" {value}"
            raise UsageError(f"{_option(name, value)}{shown}: the fitted model in {folder} has {name} {fixed}")
    grid = record.grid
    made_for = record.provenance.get("scene")
    same_scene = isinstance(made_for, dict) and made_for.get("hash") == scene.hash
    fields = sorted({"cell_propagation", "cell_occlusion"} & set(record.values))
    if fields and (args.grid is not None or not same_scene):
        raise UsageError(f"--fitted: {', '.join(fields)} of {folder} belong to the scene and grid that were fitted")
    if args.grid is not None or not same_scene:
        with usage_errors():
            grid = grid_for(scene, args.grid or record.grid.resolution[0])
    return Solve(record.config.method, record.config, grid, record, folder)


def _option(name: str, value: Any) -> str:
    """The option that sets a field of the configuration."""
    return "--no-clamp" if name == "clamp" else "--" + ("no-" if value is False else "") + name.replace("_", "-")


def describe_solve(solve: Solve) -> str:
    """One line for people."""
    if solve.method == "constant":
        return "constant: the area-weighted mean of the targets"
    config, grid = solve.config, solve.grid
    cells = " x ".join(str(n) for n in grid.resolution)
    if solve.method == "floor":
        return f"floor: the true light in the cells, {cells} of {grid.cell_size:.4g} m, lookup {config.lookup}"
    parts = [
        solve.label,
        f"grid {cells} cells of {grid.cell_size:.4g} m",
        f"{config.steps} steps",
        f"occlusion {config.occlusion}",
        f"lookup {config.lookup}",
        f"deposit {config.deposit}",
        f"normalization {config.normalization}",
    ]
    if config.fine_steps < config.steps:
        parts.insert(3, f"the last {config.steps - config.fine_steps} in cells of twice the edge")
    if config.probes:
        parts.append(f"read through {len(config.probes)} light probes")
    return ", ".join(parts + ([] if config.clamp else ["no clamp"]))


def learning_defaults(learn: Sequence[str], method: str) -> dict[str, str]:
    """What has to be switched on for a learnable to have a gradient."""
    wanted = {}
    if {"occlusion", "cell_occlusion"} & set(learn) and method not in LEARNED:
        wanted["occlusion"] = "exp"
    if "occlusion_correction" in learn:
        wanted["occlusion"] = "traced"
    if "sampling_bias" in learn:
        wanted["lookup"] = "trilinear"
    if {"injection_bias", "light_position"} & set(learn) and method not in LEARNED:
        wanted["deposit"] = "trilinear"
    return wanted
