"""The picture: path traced, and predicted by each model under the same test light and through the same camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from difflpv.bench import images
from difflpv.camera_view import camera_view
from difflpv.demo.settings import DemoSettings
from difflpv.illumination import Illumination
from difflpv.lights import LightEntry
from difflpv.pipeline import Lpv
from difflpv.scene import Camera, Scene
from difflpv.simulate import render

__all__ = ["Views", "render_views", "trace_image"]

_SUPERSAMPLING = 2  # rays along a pixel's edge: the path tracer averages over the pixel too


@dataclass(frozen=True, eq=False)
class Views:
    """Images of one light set, radiance of the first bounce [W/(m2 sr)].

    Attributes:
        truth: path traced, [H,W,3].
        noise: its standard error, [H,W,3].
        hit: pixels that see a surface, [H,W] bool.
        predicted: by name of the model, [H,W,3].
    """

    truth: np.ndarray
    noise: np.ndarray
    hit: np.ndarray
    predicted: dict[str, np.ndarray]


def trace_image(
    scene: Scene, entries: list[LightEntry], settings: DemoSettings, *, folder: Path, seed: int, workers: int
) -> tuple[np.ndarray, np.ndarray]:
    """Path-traced image [H,W,3] of the first bounce and its standard error [H,W,3], from ``folder`` if it lies there."""
    sizes = {"width": settings.image_width, "height": settings.image_height, "spp": settings.image_spp}
    return images.trace_picture(scene, folder, "bounce1", light_sets=[entries], seed=seed, workers=workers, **sizes)


def render_views(
    light: Mapping[str, Illumination],
    models: Mapping[str, Lpv],
    settings: DemoSettings,
    truth: np.ndarray,
    noise: np.ndarray,
) -> Views:
    """Render every model.

    Args:
        light: the traced scene under the image's light set, by method.
        models: by name.
        settings: image size.
        truth: path-traced image [H,W,3].
        noise: its standard error [H,W,3].
    """
    some = next(iter(light.values()))
    small = _camera(some.scene, settings)
    fine = replace(small, width=small.width * _SUPERSAMPLING, height=small.height * _SUPERSAMPLING)
    view = camera_view(some.scene, some.raycaster, fine)
    seen = np.zeros(fine.width * fine.height)
    seen[view.hit] = 1
    hit = _binned(seen.reshape(fine.height, fine.width, 1))[:, :, 0] > 0
    predicted = {name: _binned(render(lpv, light[lpv.config.method], fine)[0]) for name, lpv in models.items()}
    return Views(truth, noise, hit, predicted)


def _camera(scene: Scene, settings: DemoSettings) -> Camera:
    return replace(scene.cameras[0], width=settings.image_width, height=settings.image_height)


def _binned(image: np.ndarray) -> np.ndarray:
    height, width, channels = image.shape
    s = _SUPERSAMPLING
    return image.reshape(height // s, s, width // s, s, channels).mean((1, 3))
