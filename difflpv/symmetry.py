"""Cube symmetries of a stencil: how the 48 symmetries act on SH coefficients, and which stencils respect them.

A grid has no preferred axis, so its propagation should have none: for every symmetry R of the cube (signed permutations of
the axes) a stencil must satisfy

    A_{Rn} = M(R) A_n M(R)^T,        M(R): f(w) -> f(R^T w) on SH coefficients, orthogonal.

Such stencils form a linear space. Its basis is built per orbit of offsets (cell itself, 6 faces, 12 edges, 8 corners) and per
pair of degrees: the matrices at one offset that its stabiliser leaves alone (the image of a group average), carried to the
rest of the orbit. Everything is computed from ``difflpv.sh``; nothing is tabulated.

Source: Serre 1977, "Linear Representations of Finite Groups", section 2.6 (projection by averaging over the group).
"""

from __future__ import annotations

import itertools
from functools import lru_cache

import numpy as np

from difflpv.sh import coeff_count, sh_basis
from difflpv.stencil import LinearStencil

__all__ = [
    "asymmetry",
    "cube_symmetries",
    "equivariant_basis",
    "neighborhood_offsets",
    "project_equivariant",
    "sh_representation",
]


@lru_cache
def cube_symmetries() -> np.ndarray:
    """The 48 signed permutation matrices, reflections included, identity first, shape [48,3,3] int."""
    group = []
    for axes in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            symmetry = np.zeros((3, 3), dtype=np.int64)
            symmetry[range(3), axes] = signs
            group.append(symmetry)
    return _frozen(np.array(group))


@lru_cache
def sh_representation(l_max: int) -> np.ndarray:
    """M(R) with Y(R w) = M(R) Y(w) for every symmetry of ``cube_symmetries``, shape [48,K,K] float64, orthogonal.

    From the exact quadrature of products of degree 2 l_max: M(R) = integral Y(R w) Y(w)^T dw.
    """
    directions, weights = _sphere_quadrature(l_max)
    here = sh_basis(directions, l_max)
    moved = np.stack([sh_basis(directions @ symmetry.T, l_max) for symmetry in cube_symmetries()])
    return _frozen(np.einsum("rqi,q,qj->rij", moved, weights, here))


def _sphere_quadrature(l_max: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre in z times even steps in azimuth: exact for polynomials of degree 2 l_max + 1."""
    z, w = np.polynomial.legendre.leggauss(l_max + 2)
    steps = 2 * l_max + 3
    phi = 2 * np.pi * np.arange(steps) / steps
    s = np.sqrt(1 - z * z)[:, None]
    directions = np.stack([s * np.cos(phi), s * np.sin(phi), np.broadcast_to(z[:, None], (len(z), steps))], -1)
    return directions.reshape(-1, 3), np.repeat(w * 2 * np.pi / steps, steps)


@lru_cache
def neighborhood_offsets(neighbors: int) -> np.ndarray:
    """Offsets of the cell itself and its 6 face neighbours or all 26, in lexicographic order, shape [7,3] or [27,3] int."""
    if neighbors not in (6, 26):
        raise ValueError(f"neighbors: expected 6 or 26, got {neighbors!r}")
    cube = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
    return _frozen(cube[np.abs(cube).sum(1) <= 1] if neighbors == 6 else cube)


@lru_cache
def equivariant_basis(l_max: int, neighbors: int) -> np.ndarray:
    """Orthonormal basis of all stencils that the cube's symmetries leave alone.

    Args:
        l_max: SH degree, 0..3.
        neighbors: 6 or 26; the cell itself is always an offset too.

    Returns:
        Shape [p, n, K, K] float64, offsets as in ``neighborhood_offsets``; p is 7 (l_max 1, 6 neighbours), 19 (2, 6),
        18 (1, 26), 62 (2, 26) or 172 (3, 26).
    """
    offsets, group, rep = neighborhood_offsets(neighbors), cube_symmetries(), sh_representation(l_max)
    count = coeff_count(l_max)
    basis = []
    for representative in ([0, 0, 0], [0, 0, 1], [0, 1, 1], [1, 1, 1]):
        if not (offsets == representative).all(1).any():
            continue
        images = group @ np.array(representative)
        stabilizer = rep[(images == representative).all(1)]
        orbit, first = np.unique(images, axis=0, return_index=True)
        rows = [int(np.flatnonzero((offsets == image).all(1))[0]) for image in orbit]
        for invariant in _invariant_matrices(stabilizer, l_max):
            member = np.zeros((len(offsets), count, count))
            member[rows] = rep[first] @ invariant @ rep[first].transpose(0, 2, 1) / np.sqrt(len(orbit))
            basis.append(member)
    return _frozen(np.stack(basis))


def _invariant_matrices(stabilizer: np.ndarray, l_max: int) -> list[np.ndarray]:
    """Orthonormal basis of the matrices with A = M A M^T for all given M, each within one pair of degrees."""
    found = []
    for l_to, l_from in itertools.product(range(l_max + 1), repeat=2):
        to, start = slice(l_to**2, (l_to + 1) ** 2), slice(l_from**2, (l_from + 1) ** 2)
        size = ((2 * l_to + 1), (2 * l_from + 1))
        average = np.mean([np.kron(m[to, to], m[start, start]) for m in stabilizer], axis=0)
        values, vectors = np.linalg.eigh((average + average.T) / 2)
        for vector in vectors[:, values > 0.5].T:
            matrix = np.zeros((coeff_count(l_max),) * 2)
            # The sign of an eigenvector is the library's whim; the largest entry decides it here.
            matrix[to, start] = (vector * np.sign(vector[np.abs(vector).argmax()])).reshape(size)
            found.append(matrix)
    return found


def project_equivariant(stencil: LinearStencil, *, neighbors: int) -> np.ndarray:
    """Coordinates [p] of a stencil in ``equivariant_basis``: of the nearest stencil that respects the symmetries."""
    basis = equivariant_basis(stencil.l_max, neighbors)
    return np.einsum("pnij,nij->p", basis, _aligned(stencil, neighbors))


def asymmetry(stencil: LinearStencil) -> float:
    """Relative distance of a stencil from the nearest one that respects the symmetries: 0 where it does."""
    full = _aligned(stencil, 26)
    basis = equivariant_basis(stencil.l_max, 26)
    nearest = np.tensordot(np.tensordot(basis, full, 3), basis, 1)
    return float(np.linalg.norm(full - nearest) / max(np.linalg.norm(full), np.finfo(float).tiny))


def _aligned(stencil: LinearStencil, neighbors: int) -> np.ndarray:
    """A stencil's matrices in the order of ``neighborhood_offsets``, zero where it has none."""
    offsets = neighborhood_offsets(neighbors)
    count = coeff_count(stencil.l_max)
    aligned = np.zeros((len(offsets), count, count))
    for offset, matrix in zip(stencil.offsets, stencil.matrices, strict=True):
        row = np.flatnonzero((offsets == offset).all(1))
        if not len(row):
            raise ValueError(f"stencil '{stencil.name}': offset {offset.tolist()} is outside {neighbors} neighbours")
        aligned[row[0]] = matrix
    return aligned


def _frozen(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)  # cached: a caller who writes into it would change everyone's
    return array
