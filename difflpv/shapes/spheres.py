"""Spheres with a colour in each direction, and tubes along edges: probes and the tetrahedra between them."""

from __future__ import annotations

import numpy as np

from difflpv.shapes.shape import Shape, icosphere

__all__ = ["probe_radius", "sphere_normals", "sphere_shape", "tube_shape"]

_SIDES = 4


def sphere_normals(detail: int = 2) -> np.ndarray:
    """Unit normals [k,3] of the vertices of each sphere of ``sphere_shape``."""
    return icosphere(detail)[0]


def sphere_shape(centers: np.ndarray, radius: float | np.ndarray, color: np.ndarray) -> Shape:
    """Spheres about ``centers`` [n,3] m of ``radius`` [m], one or [n], with linear colours [n,k,3].

    The colours belong to the normals of ``sphere_normals`` of the ``detail`` that has k of them.
    """
    centers, color = np.asarray(centers, np.float64), np.asarray(color, np.float64)
    details = {10 * 4**d + 2: d for d in range(6)}
    if color.ndim != 3 or color.shape[1] not in details or centers.shape != (len(color), 3):
        raise ValueError(
            f"spheres: expected centres [n,3] and colours [n,k,3] with k from {', '.join(map(str, details))}, "
            f"got {list(centers.shape)} and {list(color.shape)}"
        )
    normals, triangles = icosphere(details[color.shape[1]])
    vertices = centers[:, None] + np.broadcast_to(radius, (len(centers),))[:, None, None] * normals
    each = (triangles + len(normals) * np.arange(len(centers))[:, None, None]).reshape(-1, 3)
    return Shape(vertices.reshape(-1, 3), each, color.reshape(-1, 3))


def probe_radius(position: np.ndarray, largest: float) -> float:
    """Radius [m] for spheres about ``position`` [n,3]: a fifth of the median distance to the next, ``largest`` at most."""
    from scipy.spatial import cKDTree

    if len(position) < 2:
        return largest
    nearest = cKDTree(position).query(position, k=2)[0][:, 1]
    nearest = nearest[nearest > 0]
    return float(min(largest, 0.2 * np.median(nearest))) if len(nearest) else largest


def tube_shape(ends: np.ndarray, radius: float, color: tuple[float, float, float]) -> Shape:
    """Straight tubes of four sides between ``ends`` [m,2,3] m, one linear colour; those without a length are left out."""
    ends = np.asarray(ends, np.float64).reshape(-1, 2, 3)
    along = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=1)
    ends, along = ends[length > 0], along[length > 0] / length[length > 0, None]
    helper = np.where(np.abs(along[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    u = np.cross(along, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(along, u)
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    ring = radius * (np.cos(angle)[:, None] * u[:, None] + np.sin(angle)[:, None] * v[:, None])  # [m,sides,3]
    vertices = (ends[:, :, None] + ring[:, None]).reshape(-1, 3)
    k = np.arange(_SIDES)
    low, high = k, (k + 1) % _SIDES
    side = np.concatenate([np.stack([low, high, high + _SIDES], 1), np.stack([low, high + _SIDES, low + _SIDES], 1)])
    triangles = (side + 2 * _SIDES * np.arange(len(ends))[:, None, None]).reshape(-1, 3)
    return Shape(vertices, triangles, np.broadcast_to(color, vertices.shape).astype(np.float64))
