"""The tetrahedral grid of a set of probes, and interpolation in it.

Source: Cupisz, GDC 2012, and the probe thesis, 3.2.1: a Delaunay tessellation, barycentric weights, walking. Two of the
thesis's limits are lifted. Its tessellation of co-spherical probes (any regular grid) holds tetrahedra without volume, whose
faces do not fit together; here the squared distances that lift probes onto the paraboloid (Edelsbrunner and Seidel 1986) are
shifted by up to 1e-10 of the square of the set's size, at random per probe. The lower hull of lifted points in general
position projects to a *regular triangulation*: no flat tetrahedra, every inner face shared by two, so that weights are
continuous. And no artificial probes are needed around the set: outside, the closest point of the hull answers (they are an
option all the same).

Probes in one plane make triangles, on one line segments, in one place a point; the weights are those of the closest point of
these. A probe in the place of another, or hidden by one less than 1e-5 of the set's size away, has weight 0 everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import torch

from difflpv.probes.barycentric import barycentric_weights
from difflpv.probes.rows import Rows

__all__ = ["Tetrahedra", "TetrahedralInterpolation", "box_corners"]

_SHIFT = 1e-10  # of lifted heights; the lifted set has size 1
_APEX = 10.0  # height of a point above all lifted ones: seen by no facet of the lower hull, and even four probes get a hull
_FLAT = 1e-10  # volume of a simplex over its longest edge to the power of its dimension, times dimension factorial
_THIN = 1e-6  # extent over the largest one, below which a set of probes has a dimension less
_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])  # opposite each vertex, counter-clockwise from outside


@dataclass(frozen=True, eq=False)
class Tetrahedra:
    """Connectivity of probes.

    Attributes:
        count: number of probes.
        vertices: probes of each tetrahedron [t,4] int32, of positive volume; t = 0 where all probes lie in one plane.
        neighbours: tetrahedron over the face opposite each vertex [t,4] int32; -1 - f for triangle f of the hull.
        hull: triangles around the tetrahedra [f,3] int32, counter-clockwise from outside. Where there are no tetrahedra, the
            triangles of the plane, segments (a, b, b) or a point (a, a, a).
    """

    count: int
    vertices: np.ndarray
    neighbours: np.ndarray
    hull: np.ndarray

    @classmethod
    def of(cls, position: np.ndarray, *, valid: np.ndarray | None = None) -> Tetrahedra:
        """Triangulate probes at ``position`` [n,3] m, those alone that are ``valid`` [n] (all, if None).

        Raises:
            ValueError: no valid probe, a wrong shape, or a valid position that is not finite.
        """
        x = np.asarray(position, np.float64)
        if x.ndim != 2 or x.shape[1] != 3:
            raise ValueError(f"probe position: expected shape [n,3], got {list(x.shape)}")
        if valid is not None and np.shape(valid) != (len(x),):
            raise ValueError(f"probe valid: expected {len(x)} booleans, got shape {list(np.shape(valid))}")
        used = np.arange(len(x)) if valid is None else np.flatnonzero(valid)
        if not len(used):
            raise ValueError("probes: expected at least one that is valid, got none")
        if not np.isfinite(x[used]).all():
            raise ValueError("probe position: expected finite numbers, got NaN or infinity")
        used = used[np.sort(np.unique(x[used], axis=0, return_index=True)[1])]  # of duplicates, the first
        local, neighbours = _simplices(x[used])
        vertices = used[local].astype(np.int32)
        if vertices.shape[1] < 4:
            padded = vertices[:, [0, 1, 2] if vertices.shape[1] == 3 else [0, -1, -1]]
            none = np.empty((0, 4), np.int32)
            return cls(len(x), none, none, padded)
        edges = x[vertices[:, :3]] - x[vertices[:, 3:]]
        turned = np.linalg.det(edges) > 0  # det(v0 - v3, ...) = -det(v1 - v0, ...)
        for table in (vertices, neighbours):
            table[turned] = table[turned][:, [0, 1, 3, 2]]
        cell, face = np.nonzero(neighbours < 0)
        neighbours[cell, face] = -1 - np.arange(len(cell))
        return cls(len(x), vertices, neighbours.astype(np.int32), vertices[cell[:, None], _FACES[face]])

    @cached_property
    def edges(self) -> np.ndarray:
        """Pairs of probes that share a simplex [e,2], lower index first, sorted."""
        cells = self.vertices if len(self.vertices) else self.hull
        a, b = np.triu_indices(cells.shape[1], 1)
        pairs = np.unique(np.sort(np.stack([cells[:, a].ravel(), cells[:, b].ravel()], 1), 1), axis=0)
        return pairs[pairs[:, 0] != pairs[:, 1]]

    @cached_property
    def first(self) -> np.ndarray:
        """A tetrahedron of each probe [n] int32, 0 for those that have none: where walks start."""
        found = np.zeros(self.count, np.int32)
        found[self.vertices] = np.arange(len(self.vertices), dtype=np.int32)[:, None]
        return found

    def volumes(self, position: np.ndarray) -> np.ndarray:
        """Volume of each tetrahedron [t] m3 with probes at ``position`` [n,3] m; below 0 where it has turned inside out."""
        e = position[self.vertices[:, 1:]] - position[self.vertices[:, :1]]
        return np.einsum("ti,ti->t", np.cross(e[:, 0], e[:, 1]), e[:, 2]) / 6

    def is_convex(self, position: np.ndarray) -> bool:
        """True if no probe of the hull lies beyond one of its triangles, by more than rounding."""
        a, b, c = (position[self.hull[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        used = position[np.unique(self.hull)]
        height = (normal @ used.T).max(1) - (normal * a).sum(1)
        return bool(height.max() <= 1e-12 * max(float(np.ptp(used, axis=0).max()), float(np.abs(used).max())))


def _simplices(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Simplices [t,d+1] of the highest dimension d that distinct points [n,3] span, and their neighbours (below 0: none)."""
    size = float(np.ptp(x, axis=0).max())
    u = (x - x.mean(0)) / max(size, np.finfo(np.float64).tiny)
    _, extent, axes = np.linalg.svd(u, full_matrices=False)
    for dimension in range(int((extent > _THIN * max(extent[0], 1e-300)).sum()) if size > 0 else 0, 1, -1):
        simplices, neighbours = _lower_hull(u @ axes[:dimension].T)
        if len(simplices):
            return simplices, neighbours
    order = np.argsort(u @ axes[0], kind="stable") if size > 0 else np.zeros(1, np.int64)
    pairs = np.stack([order[:-1], order[1:]], 1) if len(order) > 1 else order[:, None]
    return pairs, np.full_like(pairs, -1)


def _lower_hull(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The regular triangulation of points [n,d] of size 1 in d = 2 or 3 dimensions; empty if all simplices would be flat."""
    from scipy.spatial import ConvexHull, QhullError

    none = np.empty((0, u.shape[1] + 1), np.int64)
    height = (u**2).sum(1) + _SHIFT * np.random.default_rng(0).random(len(u))
    lifted = np.concatenate([np.c_[u, height], [[0.0] * u.shape[1] + [_APEX]]])
    try:
        hull = ConvexHull(lifted, qhull_options="Qt")
    except QhullError:
        return none, none
    simplices = hull.simplices.astype(np.int64)
    kept = (simplices < len(u)).all(1) & (hull.equations[:, u.shape[1]] < 0)
    corners = u[np.where(kept[:, None], simplices, 0)]
    edges = corners[:, 1:] - corners[:, :1]
    longest = np.linalg.norm(edges, axis=2).max(1)
    kept &= np.abs(np.linalg.det(edges)) > _FLAT * longest ** u.shape[1]
    renumbered = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)
    return simplices[kept], renumbered[hull.neighbors[kept]]


class TetrahedralInterpolation:
    """Barycentric weights in the tetrahedron that holds a point; outside, of the closest point of the hull.

    Connectivity is piecewise constant in the positions of the probes and has no gradient. With ``connectivity="fresh"`` it is
    that of the positions in every call (1 ms for 64 probes, 4 ms for 256); with ``"held"`` it stays until ``retriangulate``,
    unless a tetrahedron would turn inside out. Weights are continuous in the points always, in the positions until it changes.

    Attributes:
        tetrahedra: the current connectivity; over the box's corners, too, behind the probes.
        triangulations: how often it was made.
    """

    def __init__(
        self,
        position: torch.Tensor | np.ndarray,
        *,
        valid: np.ndarray | None = None,
        connectivity: Literal["fresh", "held"] = "fresh",
        box: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        """Triangulate.

        Args:
            position: probes [n,3] m.
            valid: [n] bool; probes that are not are left out. All, if None.
            connectivity: "fresh" or "held", see the class.
            box: lowest and highest corner [3] m of a box whose eight corners become artificial probes (the thesis, 3.2.1), each
                with the content of the probe that is nearest to it; None for none.

        Raises:
            ValueError: an unknown option, no valid probe, or positions that are not finite.
        """
        if connectivity not in ("fresh", "held"):
            raise ValueError(f"connectivity: expected 'fresh' or 'held', got {connectivity!r}")
        x = torch.as_tensor(position).detach().cpu().double().numpy()
        self._fresh = connectivity == "fresh"
        self._valid = None if valid is None else np.array(valid, bool)
        self._corners = np.empty((0, 3)) if box is None else box_corners(box)
        self._nearest = np.zeros(0, np.int64)
        self.forget()
        self.triangulations = 0
        self.retriangulate(x)

    def retriangulate(self, position: torch.Tensor | np.ndarray) -> None:
        """Make the connectivity that of probes at ``position`` [n,3] m."""
        x = torch.as_tensor(position).detach().cpu().double().numpy()
        valid = self._valid
        if len(self._corners):
            usable = np.arange(len(x)) if valid is None else np.flatnonzero(valid)
            if not len(usable):
                raise ValueError("probes: expected at least one that is valid, got none")
            gaps = np.linalg.norm(self._corners[:, None] - x[None, usable], axis=2)
            self._nearest = usable[gaps.argmin(1)]
            if valid is not None:
                valid = np.concatenate([valid, np.ones(8, bool)])
        self.count = len(x)
        self._made_at = np.concatenate([x, self._corners])
        self.tetrahedra = Tetrahedra.of(self._made_at, valid=valid)
        self._convex = self.tetrahedra.is_convex(self._made_at)
        parts = (self.tetrahedra.vertices, self.tetrahedra.neighbours, self.tetrahedra.hull, self.tetrahedra.first)
        self._tensors = tuple(torch.from_numpy(np.ascontiguousarray(part)) for part in parts)
        self.triangulations += 1

    def forget(self) -> None:
        """Let the next walks start in the first tetrahedron, not where the same number of points was found last."""
        self._last = torch.zeros(0, dtype=torch.int64)

    def rows(self, position: torch.Tensor, points: torch.Tensor) -> Rows:
        """Weights [m,4] of ``points`` [m,3] m over probes at ``position`` [n,3] m, differentiable in both.

        Raises:
            TypeError, ValueError: naming the argument, what was expected and what came.
        """
        if len(position) != self.count:
            raise ValueError(f"position: expected {self.count} probes, got {len(position)}")
        x = np.concatenate([position.detach().cpu().double().numpy(), self._corners])
        if not np.array_equal(x, self._made_at) and (self._fresh or not (self.tetrahedra.volumes(x) > 0).all()):
            self.retriangulate(x[: self.count])
        if len(self._corners):
            position = torch.cat([position, torch.as_tensor(self._corners, dtype=position.dtype, device=position.device)])
        vertices, neighbours, hull, first = (t.to(position.device) for t in self._tensors)
        start = first[self._last] if len(self._last) == len(points) else None
        convex = self._convex if np.array_equal(x, self._made_at) else self.tetrahedra.is_convex(x)
        probe, weight, _ = barycentric_weights(position, points, vertices, neighbours, hull, start=start, convex=convex)
        found = probe.long()
        self._last = found[:, 0]  # whatever the connectivity will be, the next walk starts near by
        if len(self._corners):
            named = torch.from_numpy(np.concatenate([np.arange(self.count), self._nearest])).to(found.device)
            found = named[found]
        return Rows(found, weight)


def box_corners(box: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """The eight corners [8,3] m of a box, x alternating fastest, from its lowest and its highest corner [3] m.

    Raises:
        ValueError: naming what was expected and what came.
    """
    low, high = (np.asarray(side, np.float64) for side in box)
    if low.shape != (3,) or high.shape != (3,) or not (low < high).all() or not np.isfinite([low, high]).all():
        raise ValueError(f"box: expected a lower and a higher corner [3], got {low.tolist()} and {high.tolist()}")
    return np.array([[(low, high)[k >> axis & 1][axis] for axis in range(3)] for k in range(8)])
