"""Closest hit and visibility on Embree (embreex), over the triangles of a scene.

Embree works in float32, so secondary rays start ``offset`` away from the surface along its normal (chosen from the
scene's extent). embreex holds the GIL: scale with processes. Source: Wald et al. 2014, Embree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh

from difflpv.scene import Scene

__all__ = ["Hits", "Raycaster"]


@dataclass(frozen=True)
class Hits:
    """Closest hits: ``triangle`` [n] (-1 for a miss), ``distance`` [n] m (inf for a miss), ``barycentric`` [n,2]."""

    triangle: np.ndarray
    distance: np.ndarray
    barycentric: np.ndarray

    @property
    def valid(self) -> np.ndarray:
        """True where a ray hit something, shape [n]."""
        return self.triangle >= 0


class Raycaster:
    """Embree acceleration structure over triangles (built once, float32)."""

    def __init__(self, scene: Scene | np.ndarray) -> None:
        """Build it over a scene, or over the corners [T,3,3] m of any triangles, at least one."""
        triangles = scene.triangle_vertices if isinstance(scene, Scene) else scene
        corners = np.ascontiguousarray(triangles, np.float32)
        self._scene = rtcore_scene.EmbreeScene()
        self._mesh = TriangleMesh(self._scene, corners)
        points = triangles.reshape(-1, 3)
        low, high = points.min(0), points.max(0)
        extent = max(float((high - low).max()), float(np.abs([low, high]).max()))
        self.offset = 2e-5 * extent  # about 170 float32 ulps at the scene's far corner
        self.triangle_count = len(corners)

    def closest(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """Closest hit of rays: ``origins`` [n,3] m, unit ``directions`` [n,3]."""
        if not len(origins):
            return Hits(np.empty(0, np.int64), np.empty(0), np.empty((0, 2)))
        result = self._scene.run(
            np.ascontiguousarray(origins, np.float32), np.ascontiguousarray(directions, np.float32), output=1
        )
        triangle = np.asarray(result["primID"], np.int64)
        distance = np.where(triangle >= 0, np.asarray(result["tfar"], np.float64), np.inf)
        return Hits(triangle, distance, np.stack([result["u"], result["v"]], -1).astype(np.float64))

    def blocked(self, origins: np.ndarray, targets: np.ndarray, *, shortened: bool = True) -> np.ndarray:
        """True where the open segment from ``origins`` to ``targets`` [n,3] m meets a triangle.

        The segment is shortened by twice ``offset`` at its far end, unless the targets lie on no surface; start ``origins``
        off their surface.
        """
        delta = np.asarray(targets, np.float64) - origins
        length = np.linalg.norm(delta, axis=1)
        limit = length - 2 * self.offset if shortened else length
        return self.blocked_along(origins, delta / np.maximum(length, 1e-30)[:, None], limit)

    def blocked_from_either_end(self, origins: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """True where a ray from one end or the other of the segments [n,3] m, off every surface, meets a triangle.

        A ray may miss a surface that it starts closer to than it can tell.
        """
        there = self.blocked(origins, targets, shortened=False)
        return np.asarray(there | self.blocked(targets, origins, shortened=False))

    def blocked_along(self, origins: np.ndarray, directions: np.ndarray, distance: np.ndarray | float) -> np.ndarray:
        """True where a ray meets a triangle within ``distance`` [n] or scalar, m; ``np.inf`` for a parallel light."""
        if not len(origins):
            return np.zeros(0, bool)
        # Embree takes a negative limit for none at all: nothing lies within such a distance.
        limit = np.clip(np.broadcast_to(np.asarray(distance, np.float64), (len(origins),)), 0.0, 1e30)
        hits = self._scene.run(
            np.ascontiguousarray(origins, np.float32),
            np.ascontiguousarray(directions, np.float32),
            dists=np.ascontiguousarray(limit, np.float32),
            query="OCCLUDED",
        )
        return (np.asarray(hits) >= 0) & (limit > 0)
