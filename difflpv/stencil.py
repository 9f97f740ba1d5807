"""Propagation stencils: where light moves in one step, and how much of it.

A ``FaceStencil`` is the published form: from a source cell's centre, light passes the relevant faces of its neighbours and
is reprojected there as a cosine lobe (Kaplanyan and Dachsbacher 2010, LPV; HOLPV thesis sections 3.2.3 and 4.2). Its
linear part, one matrix per neighbour, is a ``LinearStencil``: what a convolution applies and what can be learned.

Normalisation (physics.md, "The chain" 5): ``"energy"`` has flux Omega I and lobe/pi, so an isotropic field keeps its flux;
``"thesis"`` has Omega/(4 pi) I and the bare lobe, a quarter of that per step.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np

from difflpv.sh import coeff_count, cosine_lobe, degree_of_count, sh_basis

__all__ = [
    "FaceStencil",
    "LinearStencil",
    "Normalization",
    "Reprojection",
    "holpv_stencil",
    "lpv_stencil",
    "pair_offsets",
    "square_solid_angle",
]

Normalization = Literal["energy", "thesis"]
Reprojection = Literal["face", "ray"]


@dataclass(frozen=True, eq=False)
class LinearStencil:
    """One matrix per neighbour, destination from source coefficients.

    Attributes:
        name: short name for tables and files.
        offsets: destination minus source cell (x, y, z), shape [n,3] int.
        matrices: shape [n, K, K] float64.
        lookup_gains: factor per degree l with which receivers read the volume, [l_max+1]; trained with the matrices, 1 where
            nothing was.
        pair_count: number P of pairs of cells that it connects, see ``pair_offsets``.
        one_way: offsets whose opposite it lacks; occlusion needs both.
    """

    name: str
    offsets: np.ndarray
    matrices: np.ndarray
    lookup_gains: tuple[float, ...] = ()
    pair_count: int = field(init=False)
    one_way: tuple[tuple[int, ...], ...] = field(init=False)

    def __post_init__(self) -> None:
        offsets, matrices = np.asarray(self.offsets), np.asarray(self.matrices)
        if offsets.ndim != 2 or offsets.shape[1] != 3 or np.abs(offsets).max(initial=0) > 1:
            raise ValueError(f"offsets: expected shape [n, 3] with entries -1, 0, 1, got shape {list(offsets.shape)}")
        if len({tuple(o) for o in offsets.tolist()}) != len(offsets):
            raise ValueError("offsets: expected distinct offsets, got repeated ones")
        if matrices.ndim != 3 or matrices.shape[0] != len(offsets) or matrices.shape[1] != matrices.shape[2]:
            raise ValueError(f"matrices: expected shape [{len(offsets)}, K, K], got {list(matrices.shape)}")
        if not np.isfinite(matrices).all():
            raise ValueError("matrices: expected finite numbers, got NaN or infinity")
        l_max = degree_of_count(matrices.shape[1])
        gains = tuple(float(v) for v in self.lookup_gains) or (1.0,) * (l_max + 1)
        if len(gains) != l_max + 1 or not np.isfinite(gains).all():
            raise ValueError(f"lookup_gains: expected {l_max + 1} finite numbers, got {list(gains)}")
        object.__setattr__(self, "lookup_gains", gains)
        cells = [tuple(n) for n in offsets.tolist()]
        # plain numbers, here and not where they are used, so that torch.compile can trace what uses them
        object.__setattr__(self, "pair_count", len(pair_offsets(offsets)))
        object.__setattr__(self, "one_way", tuple(n for n in cells if tuple(-step for step in n) not in cells))

    @property
    def l_max(self) -> int:
        """Highest SH degree."""
        return degree_of_count(self.matrices.shape[1])

    def uniform_gain(self) -> np.ndarray:
        """Sum of all matrices [K,K]: what one step does to a field that is the same in every cell."""
        return np.asarray(self.matrices).sum(0)


def pair_offsets(offsets: np.ndarray) -> np.ndarray:
    """The pairs of cells that a stencil connects: its offsets n > (0, 0, 0), shape [P,3], P = 13 (26 neighbours) or 3 (6).

    A transmittance [P, n_z, n_y, n_x] of a linear stencil follows this order: its value at cell c is the share that passes
    between c and c + n, both ways.

    Args:
        offsets: destination minus source cell (x, y, z), shape [n,3] int; either of n and -n suffices.

    Returns:
        Lexicographic in (x, y, z), shape [P,3] int.
    """
    cells = [tuple(n) for n in np.asarray(offsets).tolist()]
    ahead = {max(n, (-n[0], -n[1], -n[2])) for n in cells} - {(0, 0, 0)}
    return np.array(sorted(ahead), dtype=np.int64).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class FaceStencil:
    """Faces that light passes in one step, with a clamp max(0, I) on each.

    Attributes:
        name: short name for tables and files.
        l_max: highest SH degree.
        offsets: destination minus source cell of each face (x, y, z), shape [F,3] int.
        directions: unit vectors from the source centre to the face centre, shape [F,3].
        solid_angles: seen from the source centre [sr], shape [F].
        lobe_axes: axis of the reprojected lobe, shape [F,3].
        normalization: see the module.

    Faces come in antipodal pairs: face 2j+1 mirrors face 2j (the adjoint kernel evaluates both with one set of products).
    """

    name: str
    l_max: int
    offsets: np.ndarray
    directions: np.ndarray
    solid_angles: np.ndarray
    lobe_axes: np.ndarray
    normalization: Normalization = "energy"

    def __post_init__(self) -> None:
        for name in ("offsets", "directions", "lobe_axes"):
            rows = np.asarray(getattr(self, name))
            paired = rows.shape == (len(self.offsets), 3) and len(rows) % 2 == 0 and np.allclose(rows[0::2], -rows[1::2])
            if not paired:
                raise ValueError(f"{name}: expected shape [F, 3] in antipodal pairs, got shape {list(rows.shape)}")

    @property
    def lookup_gains(self) -> tuple[float, ...]:
        """Receivers read every degree as it is, [l_max+1]."""
        return (1.0,) * (self.l_max + 1)

    @cached_property
    def flux_weights(self) -> np.ndarray:
        """Coefficients -> face flux [W]: Omega_f Y(w_f) (energy) or Omega_f/(4 pi) Y(w_f) (thesis), shape [F,K]."""
        scale = 1.0 if self.normalization == "energy" else 0.25 / math.pi
        return scale * self.solid_angles[:, None] * sh_basis(self.directions, self.l_max)

    @cached_property
    def lobes(self) -> np.ndarray:
        """Face flux -> coefficients [1/sr]: lobe(axis)/pi (energy) or lobe(axis) (thesis), shape [F,K]."""
        scale = 1.0 / math.pi if self.normalization == "energy" else 1.0
        return scale * cosine_lobe(self.lobe_axes, self.l_max)

    @cached_property
    def distinct_lobes(self) -> tuple[np.ndarray, np.ndarray]:
        """Distinct rows of ``lobes`` [A,K] and the row of each face [F]: fluxes are summed per lobe before they meet it."""
        rows, index = np.unique(self.lobes, axis=0, return_inverse=True)
        return rows, index.ravel()

    @cached_property
    def linear_part(self) -> LinearStencil:
        """The stencil without the clamp: one matrix per neighbour."""
        products = self.lobes[:, :, None] * self.flux_weights[:, None, :]
        offsets, index = np.unique(self.offsets, axis=0, return_inverse=True)
        matrices = np.zeros((len(offsets), *products.shape[1:]))
        np.add.at(matrices, index.ravel(), products)
        return LinearStencil(self.name, offsets, matrices)


def square_solid_angle(center: np.ndarray, axis: int) -> float:
    """Solid angle [sr] of the unit square centred at ``center``, normal along ``axis``, seen from the origin.

    Exact, from the corner function atan(ab / (d sqrt(a^2 + b^2 + d^2))) (physics.md lists the values).
    """
    d = abs(float(center[axis]))
    a, b = (float(center[i]) for i in range(3) if i != axis)

    def corner(u: float, v: float) -> float:
        return math.atan2(u * v, d * math.sqrt(u * u + v * v + d * d))

    return corner(a + 0.5, b + 0.5) - corner(a - 0.5, b + 0.5) - corner(a + 0.5, b - 0.5) + corner(a - 0.5, b - 0.5)


def _faces(
    name: str,
    l_max: int,
    relevant: Callable[[np.ndarray, int, int], bool],
    normalization: Normalization,
    reprojection: Reprojection,
) -> FaceStencil:
    if normalization not in ("energy", "thesis"):
        raise ValueError(f"normalization: expected 'energy' or 'thesis', got {normalization!r}")
    if reprojection not in ("face", "ray"):
        raise ValueError(f"reprojection: expected 'face' or 'ray', got {reprojection!r}")
    coeff_count(l_max)
    offsets, directions, angles, normals = [], [], [], []
    half = [n for n in itertools.product((-1, 0, 1), repeat=3) if n > (0, 0, 0)]  # the others mirror these
    for offset, axis, sign in itertools.product(half, range(3), (-1, 1)):
        if not relevant(np.array(offset), axis, sign):
            continue
        for mirror in (1, -1):
            normal = mirror * sign * np.eye(3)[axis]
            center = mirror * np.array(offset) + 0.5 * normal
            offsets.append(mirror * np.array(offset))
            directions.append(center / np.linalg.norm(center))
            angles.append(square_solid_angle(center, axis))
            normals.append(normal)
    rays = np.array(directions)
    axes = np.array(normals) if reprojection == "face" else rays
    return FaceStencil(name, l_max, np.array(offsets), rays, np.array(angles), axes, normalization)


@lru_cache
def lpv_stencil(
    *, l_max: int = 1, normalization: Normalization = "energy", reprojection: Reprojection = "face"
) -> FaceStencil:
    """The 30-face LPV stencil: 6 neighbours, the five faces that each does not share with the source."""

    def relevant(n: np.ndarray, axis: int, sign: int) -> bool:
        return bool(np.abs(n).sum() == 1 and n[axis] != -sign)

    return _faces("lpv", l_max, relevant, normalization, reprojection)


@lru_cache
def holpv_stencil(
    *, l_max: int = 2, normalization: Normalization = "energy", reprojection: Reprojection = "face"
) -> FaceStencil:
    """The 54-face HOLPV stencil: 26 neighbours, the outer faces of the 3x3x3 block (thesis section 4.2)."""

    def relevant(n: np.ndarray, axis: int, sign: int) -> bool:
        return bool(n[axis] == sign)

    return _faces("holpv", l_max, relevant, normalization, reprojection)


