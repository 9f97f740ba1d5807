"""Predict irradiance and images of a scene: a solve from end to end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from difflpv.camera_view import camera_view
from difflpv.config import LpvConfig
from difflpv.grid import Grid
from difflpv.illumination import Component, Illumination, illuminate
from difflpv.pipeline import Lpv
from difflpv.scene import Camera, Scene
from difflpv.trouble import describe_trouble

__all__ = ["Prediction", "read_volume", "render", "simulate", "solve_irradiance"]

_RECEIVERS_PER_CHUNK = 1 << 18


@dataclass(frozen=True, eq=False)
class Prediction:
    """Irradiance [n,3] W/m2 and what the user should be told about it, a line each."""

    irradiance: np.ndarray
    warnings: tuple[str, ...] = ()


@torch.no_grad()
def solve_irradiance(lpv: Lpv, light: Illumination, position: np.ndarray, normal: np.ndarray) -> Prediction:
    """Irradiance of receivers [n,3] m with unit normals [n,3], without gradients, whatever their number.

    Raises:
        FloatingPointError: the result is not finite.
    """
    parts, volumes = [], None
    for begin in range(0, max(len(position), 1), _RECEIVERS_PER_CHUNK):
        rows = slice(begin, begin + _RECEIVERS_PER_CHUNK)
        receivers = light.receivers(position[rows], normal[rows])
        if volumes is None:  # solved once for all of them; of a single chunk only where it reads
            volumes = lpv.accumulate(light, receivers=receivers if len(position) <= _RECEIVERS_PER_CHUNK else None)
        parts.append(lpv.gather(volumes, light, receivers).cpu().numpy())
    irradiance = np.concatenate(parts).astype(np.float64)
    return Prediction(irradiance, describe_trouble(lpv, light, position, normal, irradiance))


@torch.no_grad()
def read_volume(volume: np.ndarray, light: Illumination, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Irradiance [n,3] W/m2 of receivers from a volume of degree 2 that was not solved for, such as the true one.

    Args:
        volume: accumulated intensity [W/sr], shape [3, 9, n_z, n_y, n_x], on the finest grid of ``light``.
        light: whose configuration names the lookup, and whose punctual lights add their direct light.
        position: receivers [n,3] m.
        normal: unit normals [n,3].
    """
    lpv = Lpv(light.grid, LpvConfig(method="holpv", lookup=light.config.lookup))
    parts = []
    for begin in range(0, max(len(position), 1), _RECEIVERS_PER_CHUNK):
        rows = slice(begin, begin + _RECEIVERS_PER_CHUNK)
        receivers = light.receivers(position[rows], normal[rows])
        parts.append(lpv.gather((torch.as_tensor(volume).to(receivers.position),), light, receivers).cpu().numpy())
    return np.concatenate(parts).astype(np.float64)


def simulate(
    scene: Scene,
    position: np.ndarray,
    normal: np.ndarray,
    *,
    grid: Grid,
    config: LpvConfig | None = None,
    component: Component = "bounce1",
    lpv: Lpv | None = None,
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> Prediction:
    """Irradiance of receivers by a volume solve.

    Args:
        scene: with the lights to solve for.
        position: receivers [n,3] m.
        normal: unit normals [n,3] on the free side.
        grid: cells of the volume (``difflpv.config.grid_for``).
        config: the solve; HOLPV as published by default. Ignored where ``lpv`` is given.
        component: "direct" or "bounce1" (see ``difflpv.illumination.illuminate``).
        lpv: a fitted model on the same grid.
        seed: of the light samples.
        device: where to solve.

    Raises:
        ValueError: a grid or component that does not fit.
        FloatingPointError: the result is not finite.
    """
    model = lpv or Lpv(grid, config)
    light = illuminate(scene, grid, model.config, component, seed=seed, device=device)
    return solve_irradiance(model, light, np.asarray(position), np.asarray(normal))


def render(lpv: Lpv, light: Illumination, camera: Camera | None = None) -> tuple[np.ndarray, tuple[str, ...]]:
    """Image from a camera: radiance albedo E / pi [H,W,3], lights showing their own in component "direct".

    A learned albedo is that of the surfaces seen too.

    Raises:
        SceneError: the scene has no camera.
        FloatingPointError: the result is not finite.
    """
    view = camera_view(light.scene, light.raycaster, camera)
    if not len(view.hit):
        return view.image(np.zeros((0, 3))), ("the camera sees no surface",)
    if "albedo" in lpv.learned:
        view = view.with_albedo(lpv.values()["albedo"].detach().cpu().numpy())
    prediction = solve_irradiance(lpv, light, view.position, view.normal)
    return view.image(prediction.irradiance, emission=light.component == "direct"), prediction.warnings
