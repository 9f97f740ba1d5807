"""A camera for a scene that brings none."""

from __future__ import annotations

import numpy as np

from difflpv.raycast import Raycaster
from difflpv.scene import Camera, Scene

__all__ = ["default_camera"]

_YFOV = float(np.radians(50.0))


def default_camera(scene: Scene) -> Camera:
    """Camera that looks at the middle of the scene's bounds.

    A room is looked at from inside, out of the upper corner with the freest view; an object from outside. A scene counts
    as a room if it blocks the view into its bounds right where most of the outside candidates' rays enter them.
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
    if (hit > entry + 0.1 * radius).sum() >= 2:
        return _look_at(outside[int(np.argmax(hit - entry))], middle)

    inside = middle + 0.8 * half * (signs * [1.0, 0.6, 1.0])
    cameras = [_look_at(position, middle) for position in inside]
    u = (np.arange(8) + 0.5) / 8
    views = []
    for camera in cameras:
        grid = np.stack(np.meshgrid(u * camera.width, u * camera.height), -1).reshape(-1, 2)
        views.append(float(np.median(np.minimum(rays.closest(*camera.rays(grid)).distance, 2 * radius))))
    return cameras[int(np.argmax(views))]


def _look_at(position: np.ndarray, target: np.ndarray) -> Camera:
    back = (position - target) / np.linalg.norm(position - target)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    to_world = np.eye(4)
    to_world[:3, 0], to_world[:3, 1], to_world[:3, 2], to_world[:3, 3] = right, np.cross(back, right), back, position
    return Camera(to_world, _YFOV)
