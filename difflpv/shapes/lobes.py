"""SH functions as lobes: the surface at distance f(w) from a centre in each direction w.

The octree LPV thesis' simulator draws them so, as polygons in the plane of a slice and for one colour channel (section 5.1);
here they are surfaces, and each direction has the colour of the light that goes there.
"""

from __future__ import annotations

import numpy as np

from difflpv.sh import degree_of_count, sh_basis
from difflpv.shapes.shape import Shape, icosphere, joined

__all__ = ["DEFAULT_CONTRAST", "lobe_shape"]

DEFAULT_CONTRAST = 0.3
"""Exponent of sizes between lobes: 1 draws twice the light twice as long, 0 all lobes of one length."""
_NEGATIVE = np.array([0.10, 0.14, 0.65])  # where an expansion undershoots: no light is of this colour here
_FAINT = 2e-3  # of the largest f
_SHORT = 0.05  # of the longest lobe: what is fainter or shorter is a dot that only costs time
_FINER = (0.25, 0.6)  # lengths, in longest lobes, from which lobes are made of more triangles
_MOST_VERTICES = 80_000  # some 4 MB for a browser behind ssh
_KEY = np.array([0.35, 0.55, 0.76])  # a unit vector, from above and before the slice


def lobe_shape(
    centers: np.ndarray,
    coeffs: np.ndarray,
    length: float,
    *,
    contrast: float = DEFAULT_CONTRAST,
    detail: int | None = None,
    reference: float | None = None,
) -> Shape:
    """A lobe per centre; the longest is ``length`` long.

    Args:
        centers: [m,3] m.
        coeffs: SH coefficients [m,K,3] of f, in any unit, K = 1, 4, 9 or 16.
        length: distance of the longest lobe's tip from its centre [m].
        contrast: lengths of lobes go with the power ``contrast`` of their largest f. The form of each is kept: within a lobe
            the distance is proportional to |f| (mean of the channels), whatever the contrast.
        detail: of the sphere, see ``icosphere``; by default 1 for short lobes to 3 for long ones.
        reference: largest f that stands for ``length``; by default of these lobes.

    Returns:
        Lobes with the colour of f in each direction, its largest channel 1; blue where the mean of f is negative. Lobes
        of less than 1/500 of the largest f, or shorter than a twentieth of ``length``, are left out.
    """
    centers, coeffs = np.asarray(centers, np.float64), np.asarray(coeffs, np.float64)
    if coeffs.ndim != 3 or coeffs.shape[2] != 3 or centers.shape != (len(coeffs), 3):
        raise ValueError(
            f"lobes: expected centres [m,3] and coefficients [m,K,3], got {list(centers.shape)} and {list(coeffs.shape)}"
        )
    if not (0 <= contrast < np.inf and length > 0):
        raise ValueError(f"lobes: expected a contrast >= 0 and a length above 0, got {contrast} and {length}")
    l_max = degree_of_count(coeffs.shape[1])
    largest = np.abs(coeffs.mean(2) @ sh_basis(icosphere(2)[0], l_max).T).max(1, initial=0.0)
    top = largest.max(initial=0.0) if reference is None else reference
    if not top > 0:
        return joined([])
    share = np.minimum(largest / top, 1.0)
    size = share**contrast
    fine = np.full(len(size), detail) if detail is not None else 1 + np.searchsorted(_FINER, size)
    fine = np.where((share > _FAINT) & (size > _SHORT), fine, -1)
    while detail is None and (10 * 4.0 ** fine[fine > 0]).sum() > _MOST_VERTICES and fine.max() > 1:
        fine = np.where(fine > 1, fine - 1, fine)
    return joined(
        _lobes(centers[fine == d], coeffs[fine == d], length * size[fine == d] / largest[fine == d], l_max, int(d))
        for d in np.unique(fine[fine >= 0])
    )


def _lobes(centers: np.ndarray, coeffs: np.ndarray, scale: np.ndarray, l_max: int, detail: int) -> Shape:
    """Surfaces at distance ``scale`` [m] times |f|."""
    directions, triangles = icosphere(detail)
    values = np.einsum("vk,mkc->mvc", sh_basis(directions, l_max), coeffs)  # f in each direction [m,v,3]
    mean = values.mean(2)
    vertices = centers[:, None] + (scale[:, None] * np.abs(mean))[..., None] * directions
    hue = np.clip(values, 0, None)
    hue = hue / np.maximum(hue.max(2, keepdims=True), 1e-30)
    hue = np.where(mean[..., None] < 0, _NEGATIVE, hue)
    light = 0.30 + 0.70 * np.clip(_normals(vertices, triangles) @ _KEY, 0, None)  # reads as round
    each = triangles + len(directions) * np.arange(len(centers))[:, None, None]
    return Shape(vertices.reshape(-1, 3), each.reshape(-1, 3), (hue * light[..., None]).reshape(-1, 3))


def _normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit normals [m,v,3] of m surfaces of the same triangles; 0 where a surface has no area."""
    corners = vertices[:, triangles]
    cross = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    touches = np.zeros((vertices.shape[1], len(triangles)))
    touches[triangles, np.arange(len(triangles))[:, None]] = 1.0
    normal = touches @ cross
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-30))
