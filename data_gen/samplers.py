"""Directions and points drawn with a known density.

Vectors are stored one row per axis (shape [3, n]): numpy works on contiguous rows several times faster than on
triples. Sources: Pharr, Jakob, Humphreys, Physically Based Rendering, 4th ed., appendix A.5 (warps); Duff et al. 2017,
Building an Orthonormal Basis, Revisited.
"""

from __future__ import annotations

import numpy as np

__all__ = [
    "cosine_hemisphere",
    "cosine_hemisphere_pdf",
    "dot",
    "pick",
    "rotate_to",
    "triangle_barycentric",
    "triangle_pdf",
    "uniform_sphere",
    "uniform_sphere_pdf",
]


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Scalar product of two [3, n] arrays, shape [n]."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cosine_hemisphere(u: np.ndarray) -> np.ndarray:
    """Directions about +z with density cos(theta)/pi [1/sr].

    Args:
        u: uniform numbers in [0, 1), shape [2, n].

    Returns:
        Unit vectors, shape [3, n].
    """
    radius = np.sqrt(u[0])
    angle = u.dtype.type(2 * np.pi) * u[1]
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - u[0])])


def cosine_hemisphere_pdf(cos_theta: np.ndarray) -> np.ndarray:
    """Density of ``cosine_hemisphere`` [1/sr]: max(0, cos(theta))/pi, shape [n]."""
    return np.maximum(cos_theta, 0) * cos_theta.dtype.type(1 / np.pi)


def uniform_sphere(u: np.ndarray) -> np.ndarray:
    """Directions with density 1/(4 pi) [1/sr]; ``u`` [2, n] in [0, 1) -> unit vectors [3, n]."""
    z = 1 - 2 * u[0]
    radius = np.sqrt(np.maximum(0, 1 - z * z))
    angle = u.dtype.type(2 * np.pi) * u[1]
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z])


def uniform_sphere_pdf() -> float:
    """Density of ``uniform_sphere`` [1/sr]."""
    return 1 / (4 * np.pi)


def triangle_barycentric(u: np.ndarray) -> np.ndarray:
    """Barycentric weights (second and third corner) of points uniform by area.

    Args:
        u: uniform numbers in [0, 1), shape [2, n].

    Returns:
        Weights (b, c), the first corner's being 1 - b - c, shape [2, n].
    """
    root = np.sqrt(u[0])
    return np.stack([root * (1 - u[1]), root * u[1]])


def triangle_pdf(area: np.ndarray) -> np.ndarray:
    """Density of ``triangle_barycentric`` over a triangle of ``area`` [m2]: 1/area [1/m2]."""
    return 1 / area


def pick(cumulative: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draw indices of a discrete distribution and give back what is left of the uniform number.

    Args:
        cumulative: cumulative probabilities [k], the last is 1.
        u: uniform numbers in [0, 1), shape [n].

    Returns:
        Index [n], and ``u`` stretched to [0, 1) within that index's share [n]: stratification survives the choice.
    """
    if len(cumulative) == 1:
        return np.zeros(len(u), np.int64), u
    index = np.minimum(np.searchsorted(cumulative, u, side="right"), len(cumulative) - 1)
    low = np.concatenate([[0.0], cumulative])[index]
    share = np.maximum(cumulative[index] - low, 1e-30)
    rest = ((u - low) / share).astype(u.dtype)
    return index, np.minimum(rest, np.nextafter(u.dtype.type(1), u.dtype.type(0)))


def rotate_to(local: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Turn directions about +z into directions about unit ``normals``; both [3, n]."""
    nx, ny, nz = normals
    sign = np.copysign(normals.dtype.type(1), nz)
    a = -1 / (sign + nz)
    b = nx * ny * a
    x, y, z = local
    return np.stack(
        [
            x * (1 + sign * nx * nx * a) + y * b + z * nx,
            x * sign * b + y * (sign + ny * ny * a) + z * ny,
            -x * sign * nx - y * ny + z * nz,
        ]
    )
