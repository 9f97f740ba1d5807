"""A camera for a scene that brings none."""

from __future__ import annotations

import numpy as np

from difflpv.raycast import Raycaster
from difflpv.scene import Camera, Scene

__all__ = ["default_camera"]

_YFOV = float(np.radians(50.0))


def default_camera(scene: Scene) -> Camera:
    """Camera that looks at the middle of the scene's bounds.

    A room is looked at from inside, from the candidate with the freest view; an object from outside. A scene counts
    as a room if it blocks the view into its bounds right where most of the outside candidates' rays enter them; a flat
    one never does.
    """
    low, high = scene.bounds
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-6 * float((high - low).max()) + 1e-12)
    radius = float(np.linalg.norm(half))
    signs = np.array([[x, 0.5, z] for z in (1.0, -1.0) for x in (1.0, -1.0)])
    rays = Raycaster(scene)

    directions = signs / np.linalg.norm(signs, axis=1, keepdims=True)
    outside = middle + 1.15 * radius / np.sin(_YFOV / 2) * directions
    distance = np.linalg.norm(outside - middle, axis=1)
    entry = distance - np.min(half / np.abs(directions), axis=1)
    hit = rays.closest(outside, -directions).distance
    sheet = half.min() < 1e-3 * half.max()  # has no inside to look from
    if sheet or (hit > entry + 0.1 * radius).sum() >= 2:
        return _look_at(outside[int(np.argmax(hit - entry))], middle)

    angles = np.arange(16) * np.pi / 8
    cameras, views = [], []
    for reach in (0.8, 0.6, 0.4):
        for height in (0.4, 0.0):
            for angle in angles:
                camera = _look_at(middle + half * [reach * np.cos(angle), height, reach * np.sin(angle)], middle)
                cameras.append(camera)
                views.append(_openness(rays, camera, radius))
    return cameras[int(np.argmax(views))]


def _openness(rays: Raycaster, camera: Camera, radius: float) -> float:
    """Mean log distance of what the camera sees; what is close, and what looks out of the scene, counts against it."""
    u = (np.arange(8) + 0.5) / 8
    offsets = np.stack(np.meshgrid(u * camera.width, u * camera.height), -1).reshape(-1, 2)
    distance = rays.closest(*camera.rays(offsets)).distance
    distance = np.where(np.isfinite(distance), distance, 0.0)
    return float(np.log(np.maximum(distance, 0.02 * radius)).mean())


def _look_at(position: np.ndarray, target: np.ndarray) -> Camera:
    back = (position - target) / np.linalg.norm(position - target)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    to_world = np.eye(4)
    to_world[:3, 0], to_world[:3, 1], to_world[:3, 2], to_world[:3, 3] = right, np.cross(back, right), back, position
    return Camera(to_world, _YFOV)
