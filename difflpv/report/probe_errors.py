"""Pictures of where probes fail: the judging points as small spheres, coloured by their error."""

from __future__ import annotations

import numpy as np

from difflpv.raycast import Raycaster
from difflpv.report.picture import picture
from difflpv.scene import Camera, Scene
from difflpv.shapes.colors import scale_color
from difflpv.shapes.overview import outside_camera
from difflpv.shapes.shape import Shape, joined
from difflpv.shapes.spheres import sphere_shape
from difflpv.shapes.surfaces import surfaces_of

__all__ = ["error_picture"]

_RADIUS = 0.006  # of the scene's extent
_DARK, _LIGHT = 0.04, 0.16  # grey of surfaces, by how they face this way:
_FACING = np.array([0.48, 0.8, 0.36])
_CORNERS = 12  # of the sphere that a point is


def error_picture(
    scene: Scene, points: np.ndarray, error: np.ndarray, *, camera: Camera | None = None, width: int = 560
) -> np.ndarray:
    """Points in their scene, black where nothing is wrong and light yellow where the error is 1 or more.

    Args:
        scene: the room, drawn dark.
        points: [m,3] m.
        error: of each point [m], relative to the root mean square of the truth at all of them.
        camera: by default one that stands outside (``difflpv.shapes.overview``).
        width: in pixels.

    Returns:
        Linear picture [H,W,3].

    Raises:
        ValueError: shapes that do not belong together, or an error that is not finite.
    """
    points, error = np.asarray(points, np.float64), np.asarray(error, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or error.shape != (len(points),) or not np.isfinite(error).all():
        raise ValueError(
            f"errors: expected points [m,3] and as many finite errors, got {list(points.shape)} and {list(error.shape)}"
        )
    low, high = scene.bounds
    surfaces = surfaces_of(scene, Raycaster(scene)).plain()
    color = np.repeat(scale_color(error)[:, None], _CORNERS, axis=1)
    spheres = sphere_shape(points, _RADIUS * float((high - low).max()), color)
    seen = joined([_grey(surfaces), spheres])
    return picture(seen, camera or outside_camera(scene), width=width, background=(0.012, 0.012, 0.012))


def _grey(surfaces: Shape) -> Shape:
    """The same triangles in greys that tell floors from walls, and dark enough for points to stand out."""
    corners = surfaces.vertices[surfaces.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = np.abs(normal @ _FACING) / np.maximum(np.linalg.norm(normal, axis=1), 1e-30)
    grey = _DARK + (_LIGHT - _DARK) * np.minimum(facing, 1)
    color = np.broadcast_to(grey[:, None, None], corners.shape).reshape(-1, 3)
    return Shape(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), np.array(color))
