"""A camera that sees all of a scene from outside: walls that face away are not drawn, so it looks into rooms."""

from __future__ import annotations

import numpy as np

from difflpv.io.default_camera import default_camera
from difflpv.scene import Camera, Scene

__all__ = ["outside_camera"]

_YFOV = float(np.radians(30.0))
_FROM = np.array([0.42, 0.62, 0.66]) / np.linalg.norm([0.42, 0.62, 0.66])


def outside_camera(scene: Scene, *, width: int = 1024, height: int = 768) -> Camera:
    """The scene's first camera (``default_camera`` if it has none) where that stands outside its bounds, else an overview.

    The overview looks down at the middle of the bounds from a corner, as near as shows all of them.
    """
    low, high = scene.bounds
    camera = scene.cameras[0] if scene.cameras else default_camera(scene)
    eye = camera.to_world[:3, 3]
    if not ((eye > low) & (eye < high)).all():
        return camera
    back = _FROM
    right = np.cross([0.0, 1, 0], back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back])
    corners = np.array([[(low, high)[k >> a & 1][a] for a in range(3)] for k in range(8)]) - (low + high) / 2
    x, y, z = axes @ corners.T
    slope = np.tan(_YFOV / 2) / 1.05  # a little margin
    distance = float(np.max(z + np.maximum(np.abs(x) * height / width, np.abs(y)) / slope))
    to_world = np.eye(4)
    to_world[:3, :3], to_world[:3, 3] = axes.T, (low + high) / 2 + distance * back
    return Camera(to_world, _YFOV, width, height)
