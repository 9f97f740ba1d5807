"""Coloured triangles, and the sphere that lobes and probes are made of."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import numpy as np

__all__ = ["Shape", "icosphere", "joined"]


@dataclass(frozen=True, eq=False)
class Shape:
    """Triangles with a colour per vertex, seen from their front (counter-clockwise) alone.

    Attributes:
        vertices: [V,3] m.
        triangles: [T,3] indices.
        color: linear RGB, 1 = white, [V,3]; what is beyond 1 is clipped where it is drawn.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    color: np.ndarray

    def __post_init__(self) -> None:
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3 or self.color.shape != self.vertices.shape:
            got = f"{list(self.vertices.shape)} and {list(self.color.shape)}"
            raise ValueError(f"shape: expected vertices and colours [V,3] of equal number, got {got}")
        if self.triangles.ndim != 2 or self.triangles.shape[1] != 3:
            raise ValueError(f"shape triangles: expected shape [T,3], got {list(self.triangles.shape)}")
        if self.triangles.size and not 0 <= self.triangles.min() <= self.triangles.max() < len(self.vertices):
            raise ValueError(f"shape triangles: expected indices below {len(self.vertices)}")
        if not (np.isfinite(self.vertices).all() and np.isfinite(self.color).all()):
            raise ValueError("shape: expected finite vertices and colours")

    def __bool__(self) -> bool:
        """True if there is anything to see."""
        return len(self.triangles) > 0


def joined(shapes: Iterable[Shape]) -> Shape:
    """All triangles of several shapes."""
    parts = list(shapes)
    first = np.cumsum([0, *(len(s.vertices) for s in parts)])
    return Shape(
        np.concatenate([np.zeros((0, 3)), *(s.vertices for s in parts)]),
        np.concatenate([np.zeros((0, 3), np.int64), *(s.triangles + n for s, n in zip(parts, first, strict=False))]),
        np.concatenate([np.zeros((0, 3)), *(s.color for s in parts)]),
    )


@cache
def icosphere(detail: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions [10 * 4^detail + 2, 3] and outward triangles [20 * 4^detail, 3] of a subdivided icosahedron."""
    t = (1 + 5**0.5) / 2
    corners: list[tuple[float, float, float]] = [(-1, t, 0), (1, t, 0), (-1, -t, 0), (1, -t, 0), (0, -1, t), (0, 1, t)]
    corners += [(0, -1, -t), (0, 1, -t), (t, 0, -1), (t, 0, 1), (-t, 0, -1), (-t, 0, 1)]
    faces = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6)]
    faces += [(7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7)]
    faces += [(9, 8, 1)]
    points, triangles = np.array(corners, np.float64), np.array(faces)
    for _ in range(detail):
        edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        unique, middle = np.unique(edges, axis=0, return_inverse=True)
        ab, bc, ca = (middle.reshape(-1, 3) + len(points)).T
        a, b, c = triangles.T
        points = np.concatenate([points, points[unique].sum(1) / 2])
        quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        triangles = np.concatenate([np.stack(q, 1) for q in quarters])
    points = points / np.linalg.norm(points, axis=1, keepdims=True)
    points.setflags(write=False)
    triangles.setflags(write=False)
    return points, triangles
