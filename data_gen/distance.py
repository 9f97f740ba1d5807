"""Distance from points to triangles, exact, for any mix of large and small triangles."""

from __future__ import annotations

import numpy as np

__all__ = ["triangle_distance"]


def triangle_distance(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Exact distance from each point to the nearest of many triangles.

    Args:
        corners: triangles [T,3,3] m, none without area.
        points: positions [n,3] m.

    Returns:
        Distance [m], shape [n]; inf where there is no triangle.
    """
    from scipy.spatial import cKDTree  # half a second that worker processes need not wait for

    centers = corners.mean(1)
    radius = np.linalg.norm(corners - centers[:, None], axis=2).max(1)
    best = np.full(len(points), np.inf)
    # triangles of like size together: within a class the nearest one's centre is among the near centres
    size_class = np.round(np.log2(np.maximum(radius, 1e-30))).astype(int)
    for size in np.unique(size_class)[::-1]:
        members = np.flatnonzero(size_class == size)
        tree = cKDTree(centers[members])
        reach = np.minimum(tree.query(points)[0], best) + radius[members].max()
        near = tree.query_ball_point(points, reach * (1 + 1e-9))
        lengths = np.array([len(found) for found in near])
        if not lengths.sum():
            continue
        point = np.repeat(np.arange(len(points)), lengths)
        triangle = members[np.concatenate([np.asarray(found, np.int64) for found in near])]
        np.minimum.at(best, point, _pair_distance(points[point], corners[triangle]))
    return best


def _pair_distance(p: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Distance of each point [n,3] to its triangle [n,3,3]."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    inside = np.ones(len(p), bool)
    nearest = np.full(len(p), np.inf)
    for k in range(3):
        a = corners[:, k]
        edge, offset = corners[:, (k + 1) % 3] - a, p - a
        inside &= np.einsum("ij,ij->i", np.cross(edge, offset), normal) >= 0
        along = np.clip(np.einsum("ij,ij->i", offset, edge) / np.einsum("ij,ij->i", edge, edge), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(offset - along[:, None] * edge, axis=1))
    height = np.abs(np.einsum("ij,ij->i", p - corners[:, 0], normal))
    return np.where(inside, height, nearest)
