"""``--method floor``: what a perfect propagation could do, the true light in the cells read as any volume is.

The true volume is path-traced once per light, grid and component and kept: in ``floor/`` of the targets where there are
some, else in ``floor/`` beside the output.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from difflpv.cli.options import UsageError, positive
from difflpv.cli.output import Progress
from difflpv.cli.solve import Solve

if TYPE_CHECKING:
    from data_gen.cells import TrueVolume
    from difflpv.illumination import Illumination
    from difflpv.simulate import Prediction

__all__ = ["add_floor", "check_floor", "floor_folder", "floor_of", "known_floor"]

_NOISY = 0.05


def add_floor(parser: Any) -> None:
    """``--spp`` of ``--method floor``."""
    parser.add_argument(
        "--spp", type=positive, metavar="N", help="for --method floor: paths per cell (default: as kept, else 1024)"
    )


def check_floor(args: argparse.Namespace, solve: Solve) -> None:
    """A ``UsageError`` for ``--spp`` of another method."""
    if args.spp is not None and solve.method != "floor":
        raise UsageError(f"--spp: only --method floor traces paths, got --method {solve.method}")


def floor_folder(args: argparse.Namespace) -> Path:
    """Where true volumes are kept."""
    beside = args.targets if getattr(args, "targets", None) is not None else args.out.parent
    return Path(beside) / "floor"


def floor_of(args: argparse.Namespace, light: Illumination, position: np.ndarray, normal: np.ndarray) -> Prediction:
    """Irradiance of receivers from the true volume, path-traced unless it is kept; told how noisy it is where that shows."""
    from data_gen.cells import kept_volume

    progress = Progress(quiet=args.json)
    progress.show(f"floor: path tracing {light.component} in {len(light.grid.cell_centers().reshape(-1, 3))} cells")
    try:
        volume = kept_volume(
            floor_folder(args), light.scene, light.grid, light.component, spp=args.spp, seed=args.seed
        )
    except OSError as error:
        raise UsageError(f"{floor_folder(args)}: cannot be written: {error.strerror}") from None
    finally:
        progress.close()
    return _read(volume, light, position, normal)


def known_floor(folder: Path, light: Illumination, position: np.ndarray, normal: np.ndarray) -> Prediction | None:
    """The same from what is kept in ``folder``; None where nothing is."""
    from data_gen.cells import find_volume

    volume = find_volume(folder, light.scene, light.grid, light.component)
    return None if volume is None else _read(volume, light, position, normal)


def _read(volume: TrueVolume, light: Illumination, position: np.ndarray, normal: np.ndarray) -> Prediction:
    from difflpv.simulate import Prediction, read_volume

    irradiance = read_volume(volume.mean, light, position, normal)
    half = read_volume(volume.halves[0], light, position, normal)
    noise, size = float(np.linalg.norm(half - irradiance)), float(np.linalg.norm(irradiance))
    if not noise > _NOISY * size > 0:
        return Prediction(irradiance)
    line = (
        f"floor: {volume.spp} paths per cell leave a noise of {noise / size:.3f} of the irradiance in it, which is a part of "
        "its error; take more with --method floor --spp"
    )
    return Prediction(irradiance, (line,))
