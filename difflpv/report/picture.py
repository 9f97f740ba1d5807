"""Coloured triangles as a picture, by the rays of a camera: the lobes, probes and surfaces of the viewer's page."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from difflpv.raycast import Raycaster
from difflpv.scene import Camera
from difflpv.shapes.shape import Shape

__all__ = ["axis_camera", "picture"]

_ON_PLAN = (((0, 0, -1), (0, 1, 0)), ((1, 0, 0), (0, 0, -1)), ((1, 0, 0), (0, 1, 0)))  # right and up, per normal
_NARROW = float(np.radians(4.0))  # nearly parallel rays: a slice is seen as on a plan


def picture(
    shape: Shape,
    camera: Camera,
    *,
    width: int = 480,
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),
    samples: int = 3,
) -> np.ndarray:
    """Linear image [H,W,3] of the fronts of triangles, colours interpolated between their vertices.

    Args:
        shape: what is seen.
        camera: from where; its own image size gives the aspect.
        width: of the picture in pixels.
        background: linear colour where nothing is hit.
        samples: rays along an edge of each pixel, averaged.
    """
    height = max(round(width * camera.height / camera.width), 1)
    fine = replace(camera, width=samples * width, height=samples * height)
    eye = camera.to_world[:3, 3]
    corners = shape.vertices[shape.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    front = np.flatnonzero(((eye - corners[:, 0]) * normal).sum(1) > 0)
    image = np.empty((fine.height * fine.width, 3))
    image[:] = background
    if len(front):
        y, x = np.mgrid[: fine.height, : fine.width] + 0.5
        hits = Raycaster(corners[front]).closest(*fine.rays(np.stack([x.ravel(), y.ravel()], -1)))
        hit = np.flatnonzero(hits.valid)
        u, v = hits.barycentric[hit].T[:, :, None]
        a, b, c = np.moveaxis(np.clip(shape.color, 0, 1)[shape.triangles[front[hits.triangle[hit]]]], 1, 0)
        image[hit] = (1 - u - v) * a + u * b + v * c
    return image.reshape(height, samples, width, samples, 3).mean((1, 3))


def axis_camera(low: np.ndarray, high: np.ndarray, axis: int, height: float) -> Camera:
    """Camera that sees the box ``low``..``high`` [m] along ``axis`` from its high end, framed at the plane x_axis = ``height``.

    Across z, x goes right and y up; across x, -z goes right and y up; across y, x goes right and -z up.
    """
    right, up = np.array(_ON_PLAN[axis], np.float64)
    back = np.cross(right, up)
    size = np.asarray(high, np.float64) - low
    wide, tall = float(np.abs(right) @ size), float(np.abs(up) @ size)
    middle = (np.asarray(low) + high) / 2
    middle[axis] = height
    to_world = np.eye(4)
    to_world[:3, 0], to_world[:3, 1], to_world[:3, 2] = right, up, back
    to_world[:3, 3] = middle + back * tall / 2 / np.tan(_NARROW / 2)
    return Camera(to_world, _NARROW, width=1000, height=max(round(1000 * tall / wide), 1))
