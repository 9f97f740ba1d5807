"""Probes as they are shown: places with the edges between them, and what they hold where a file says so."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from difflpv.probes.probe_set import DIRECTIONS_26, ProbeSet
from difflpv.probes.tetrahedra import Tetrahedra
from difflpv.raycast import Raycaster
from difflpv.scene import Scene

__all__ = ["ProbeView", "lattice_positions"]


@dataclass(frozen=True, eq=False)
class ProbeView:
    """Probes.

    Attributes:
        position: [n,3] m.
        edges: of the tetrahedra between them, [m,2,3] m.
        content: what they hold; None for places alone, which are shaded by the volume.
    """

    position: np.ndarray
    edges: np.ndarray
    content: ProbeSet | None = None

    @classmethod
    def of(cls, probes: ProbeSet | np.ndarray) -> ProbeView:
        """Probes with their content, or their places [n,3] m alone."""
        position = probes.position if isinstance(probes, ProbeSet) else np.asarray(probes, np.float64).reshape(-1, 3)
        view = cls(position, np.zeros((0, 2, 3)), probes if isinstance(probes, ProbeSet) else None)
        if not view.valid.any():
            return view
        pairs = Tetrahedra.of(position, valid=view.valid).edges
        return cls(position, position[pairs], view.content)

    @property
    def valid(self) -> np.ndarray:
        """Which probes are used [n]."""
        if self.content is None or self.content.valid is None:
            return np.ones(len(self.position), bool)
        return self.content.valid


def lattice_positions(scene: Scene, per_side: int) -> np.ndarray:
    """Centres [n,3] m of a lattice over the scene's bounds, ``per_side`` along the longest edge, outside of solids.

    A centre counts as inside a solid if 26 rays from it all meet the scene, and most of them backs of triangles. Where that is
    so of every centre, the room is wound inside out and they all stay.

    Raises:
        ValueError: fewer than one along the longest edge.
    """
    if per_side < 1:
        raise ValueError(f"probe lattice: expected at least 1 along the longest edge, got {per_side}")
    low, high = scene.bounds
    size = high - low
    count = np.maximum(np.round(per_side * size / size.max()), 1).astype(int)
    axes = [low[a] + size[a] * (np.arange(count[a]) + 0.5) / count[a] for a in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    rays = np.tile(DIRECTIONS_26, (len(points), 1))
    n = len(points)
    hits = Raycaster(scene).closest(np.repeat(points, len(DIRECTIONS_26), axis=0), rays)
    back = hits.valid & ((scene.triangle_normals[hits.triangle] * rays).sum(1) > 0)
    solid = hits.valid.reshape(n, -1).all(1) & (back.reshape(n, -1).mean(1) > 0.5)  # a box may stand on a floor of its own
    return points if solid.all() else points[~solid]
