"""Probes as they are shown: places with the edges between them, and what they hold where a file says so."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from difflpv.probes.probe_set import ProbeSet
from difflpv.probes.reader import InterpolationName
from difflpv.probes.tetrahedra import Tetrahedra
from difflpv.scene import Scene

__all__ = ["ProbeView", "lattice_positions"]


@dataclass(frozen=True, eq=False)
class ProbeView:
    """Probes.

    Attributes:
        position: [n,3] m.
        edges: of the tetrahedra between them, [m,2,3] m; none where points read them otherwise.
        content: what they hold; None for places alone, which are shaded by the volume.
    """

    position: np.ndarray
    edges: np.ndarray
    content: ProbeSet | None = None

    @classmethod
    def of(cls, probes: ProbeSet | np.ndarray, *, interpolation: InterpolationName = "tetrahedra") -> ProbeView:
        """Probes with their content, or their places [n,3] m alone, that points read by ``interpolation``."""
        position = probes.position if isinstance(probes, ProbeSet) else np.asarray(probes, np.float64).reshape(-1, 3)
        view = cls(position, np.zeros((0, 2, 3)), probes if isinstance(probes, ProbeSet) else None)
        if not view.valid.any() or interpolation != "tetrahedra":
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
    """Centres [n,3] m of a lattice over the scene's bounds, ``per_side`` along the longest edge, those in solids too.

    Which of them are in free space is the path tracer's to tell (``data_gen.freespace.is_free``).

    Raises:
        ValueError: fewer than one along the longest edge.
    """
    if per_side < 1:
        raise ValueError(f"probe lattice: expected at least 1 along the longest edge, got {per_side}")
    low, high = scene.bounds
    size = high - low
    count = np.maximum(np.round(per_side * size / size.max()), 1).astype(int)
    axes = [low[a] + size[a] * (np.arange(count[a]) + 0.5) / count[a] for a in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
