"""What an error looks like: SSIM and FLIP of the picture from the scene's camera.

FLIP: Andersson et al. 2020 and, for linear images of any exposure, HDR-FLIP (Andersson et al. 2021), by NVIDIA's own package
``flip-evaluator``; without it there is no FLIP.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from data_gen.targets import make_targets
from difflpv.bench.scenes import BenchScene
from difflpv.camera_view import CameraView, camera_view
from difflpv.io.exr import read_image
from difflpv.loss import image_ssim
from difflpv.raycast import Raycaster
from difflpv.scene import Scene

__all__ = ["BenchView", "bench_view", "flip", "flip_unavailable", "image_errors", "trace_picture"]


class Predicts(Protocol):
    """Irradiance of any receivers."""

    def predict(self, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Irradiance [n,3] of receivers [n,3] with normals [n,3]."""


@dataclass(frozen=True, eq=False)
class BenchView:
    """What the camera sees of a scene, and its path-traced picture [H,W,3] W/(m2 sr)."""

    view: CameraView
    truth: np.ndarray


def flip_unavailable() -> str:
    """Why there is no FLIP, in one line; empty where there is."""
    return "" if find_spec("flip_evaluator") else "no FLIP: flip-evaluator is not installed (pip install 'difflpv[bench]')"


def trace_picture(
    scene: Scene,
    folder: Path,
    component: str,
    *,
    width: int,
    height: int,
    spp: int,
    light_sets: Sequence[Sequence[Mapping[str, Any]]] | None = None,
    seed: int = 0,
    workers: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Path-traced image [H,W,3] of a component and its standard error [H,W,3], from ``folder`` if they lie there."""
    small = replace(scene, cameras=(replace(scene.cameras[0], width=width, height=height),))
    targets = make_targets(
        small,
        folder,
        receiver_count=1,  # the receivers are not asked for here
        components=(component,),
        spp=1,
        light_sets=light_sets,
        images=True,
        image_spp=spp,
        seed=seed,
        workers=workers,
        overwrite=True,
    )
    truth, noise = read_image(targets.lights[0].images[component])
    assert noise is not None
    return truth.astype(np.float64), noise.astype(np.float64)


def bench_view(scene: BenchScene, *, width: int = 128, spp: int = 256, workers: int = 1) -> BenchView | None:
    """The picture of a bench scene, kept beside its truth; None without a camera."""
    if not scene.scene.cameras:
        return None
    camera = scene.scene.cameras[0]
    height = max(16, round(width * camera.height / camera.width))
    folder = scene.folder / f"image_{scene.component}_{max(scene.light, 0)}"
    truth, _ = trace_picture(
        scene.scene, folder, scene.component, width=width, height=height, spp=spp, seed=scene.seed, workers=workers
    )
    view = camera_view(scene.scene, Raycaster(scene.scene), replace(camera, width=width, height=height))
    return BenchView(view, truth) if len(view.hit) and truth.any() else None


def image_errors(run: Predicts, picture: BenchView, *, direct: bool) -> dict[str, float | None]:
    """Structural dissimilarity (1 - SSIM)/2 and mean FLIP of a prediction's picture.

    Args:
        run: predicts irradiance.
        picture: the truth.
        direct: whether lights show their own radiance.
    """
    irradiance = run.predict(picture.view.position, picture.view.normal)
    found = np.maximum(picture.view.image(irradiance, emission=direct), 0)
    shown = np.minimum(found, picture.truth.max()), picture.truth
    pair = [torch.as_tensor(image, dtype=torch.float32) for image in shown]
    return {"ssim": float(image_ssim(*pair)), "flip": flip(*shown) if not flip_unavailable() else None}


def flip(found: np.ndarray, truth: np.ndarray) -> float:
    """Mean HDR-FLIP of linear images [H,W,3] >= 0 at 67 pixels per degree, in [0, 1].

    Raises:
        ImportError: flip-evaluator is not installed.
    """
    import flip_evaluator

    peak = float(truth.max())  # FLIP picks its exposures by the truth; only the ratio to it counts
    pair = [np.ascontiguousarray(image / peak, np.float32) for image in (truth, found)]
    _, mean, _ = flip_evaluator.evaluate(*pair, "HDR", applyMagma=False)
    return float(mean)
