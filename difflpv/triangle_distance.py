"""Distance from points to triangles, exact, for any mix of large and small triangles."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["TriangleDistance", "triangle_distance"]


class TriangleDistance:
    """Many triangles, sorted once for as many points as are asked about.

    Attributes:
        corners: [T,3,3] m.
        normal: unit, (b-a) x (c-a), of each triangle [T,3].
    """

    def __init__(self, corners: np.ndarray) -> None:
        """Sort triangles ``corners`` [T,3,3] m, none without area."""
        from scipy.spatial import KDTree  # half a second that worker processes need not wait for

        self.corners = corners
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self.normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        centers = corners.mean(1)
        radius = np.linalg.norm(corners - centers[:, None], axis=2).max(1)
        # triangles of like size together: within a class the nearest one's centre is among the near centres
        size_class = np.round(np.log2(np.maximum(radius, 1e-30))).astype(int)
        self._classes: list[tuple[np.ndarray, float, Any]] = []
        for size in np.unique(size_class)[::-1]:
            members = np.flatnonzero(size_class == size)
            self._classes.append((members, float(radius[members].max()), KDTree(centers[members])))

    def __call__(self, points: np.ndarray, limit: float = np.inf) -> np.ndarray:
        """Distance of ``points`` [n,3] m to the nearest triangle [n] m, or ``limit`` [m] where that is less: sooner found."""
        return self.nearest(points, limit)[1]

    def nearest(self, points: np.ndarray, limit: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
        """The nearest triangle of ``points`` [n,3] m, or -1 where none is below ``limit`` [m], and the distance as above."""
        best, which = np.full(len(points), float(limit)), np.full(len(points), -1)
        for members, radius, tree in self._classes:
            reach = best if limit < np.inf else np.minimum(tree.query(points)[0], best)
            near = tree.query_ball_point(points, (reach + radius) * (1 + 1e-9))
            lengths = np.array([len(found) for found in near], int)
            if not lengths.sum():
                continue
            point = np.repeat(np.arange(len(points)), lengths)
            triangle = members[np.concatenate([found for found in near if found])]
            height = np.abs(np.einsum("ij,ij->i", points[point] - self.corners[triangle, 0], self.normal[triangle]))
            close = height < best[point]  # most planes are farther away than a nearer triangle
            point, triangle, height = point[close], triangle[close], height[close]
            distance = _pair_distance(points[point], self.corners[triangle], self.normal[triangle], height)
            falling = np.argsort(-distance, kind="stable")
            falling = falling[distance[falling] < best[point[falling]]]
            best[point[falling]], which[point[falling]] = distance[falling], triangle[falling]  # the last one written stays
        return which, best


def triangle_distance(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Exact distance from each point to the nearest of many triangles.

    Args:
        corners: triangles [T,3,3] m, none without area.
        points: positions [n,3] m.

    Returns:
        Distance [m], shape [n]; inf where there is no triangle.
    """
    return TriangleDistance(corners)(points)


def _pair_distance(p: np.ndarray, corners: np.ndarray, normal: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Distance of each point [n,3] to its triangle [n,3,3], of whose plane it is ``height`` [n] off."""
    inside = np.ones(len(p), bool)
    nearest = np.full(len(p), np.inf)
    for k in range(3):
        a = corners[:, k]
        edge, offset = corners[:, (k + 1) % 3] - a, p - a
        inside &= np.einsum("ij,ij->i", np.cross(edge, offset), normal) >= 0
        along = np.clip(np.einsum("ij,ij->i", offset, edge) / np.einsum("ij,ij->i", edge, edge), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(offset - along[:, None] * edge, axis=1))
    return np.where(inside, height, nearest)
