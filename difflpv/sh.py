"""Real, orthonormal spherical harmonics without the Condon-Shortley phase.

Index ``l(l+1)+m``; degree ``l <= l_max`` ("band" in the graphics literature: LPV has ``l_max`` 1, HOLPV 2). The one
convention of the project; publications differ in the sign of x and y. Works on numpy arrays and torch tensors alike and
imports neither torch nor Warp, so that path-tracing workers start quickly.

    Y = 1/(2 sqrt(pi)) [1, sqrt3 y, sqrt3 z, sqrt3 x,
                        sqrt15 xy, sqrt15 yz, sqrt5/2 (3z^2-1), sqrt15 xz, sqrt15/2 (x^2-y^2)]

Source: Ramamoorthi and Hanrahan 2001 (cosine lobe A_l); Sloan 2008 (polynomial forms).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

__all__ = ["L_MAX_LIMIT", "coeff_count", "cosine_lobe", "degree_of_count", "lobe_factors", "sh_basis"]

L_MAX_LIMIT = 3
_N = 0.5 / math.sqrt(math.pi)


def coeff_count(l_max: int) -> int:
    """Number of coefficients of degree 0..``l_max``: ``(l_max + 1)^2``."""
    if not 0 <= l_max <= L_MAX_LIMIT:
        raise ValueError(f"l_max: expected an integer in 0..{L_MAX_LIMIT}, got {l_max!r}")
    return (l_max + 1) ** 2


def degree_of_count(count: int) -> int:
    """The ``l_max`` whose expansion has ``count`` coefficients."""
    l_max = math.isqrt(count) - 1
    if count < 1 or (l_max + 1) ** 2 != count or l_max > L_MAX_LIMIT:
        raise ValueError(f"coefficient count: expected 1, 4, 9 or 16, got {count}")
    return l_max


def sh_basis(directions: Any, l_max: int) -> Any:
    """Evaluate the basis.

    Args:
        directions: unit vectors, numpy array or torch tensor, shape [..., 3]. Not normalised here: the polynomials are
            evaluated as they stand.
        l_max: highest degree, 0..3.

    Returns:
        Y_i(direction) [1/sqrt(sr)], shape [..., (l_max+1)^2], same kind and dtype as ``directions``.
    """
    count = coeff_count(l_max)
    if directions.shape[-1] != 3:
        raise ValueError(f"directions: expected shape [..., 3], got {tuple(directions.shape)}")
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    values = [_N + 0 * x]
    if l_max >= 1:
        a = _N * math.sqrt(3.0)
        values += [a * y, a * z, a * x]
    if l_max >= 2:
        a = _N * math.sqrt(15.0)
        values += [a * x * y, a * y * z, _N * math.sqrt(5.0) / 2 * (3 * z * z - 1), a * x * z, a / 2 * (x * x - y * y)]
    if l_max >= 3:
        a, b, c = _N * math.sqrt(17.5), _N * math.sqrt(105.0), _N * math.sqrt(10.5)
        values += [
            a / 2 * y * (3 * x * x - y * y),
            b * x * y * z,
            c / 2 * y * (5 * z * z - 1),
            _N * math.sqrt(7.0) / 2 * z * (5 * z * z - 3),
            c / 2 * x * (5 * z * z - 1),
            b / 2 * z * (x * x - y * y),
            a / 2 * x * (x * x - 3 * y * y),
        ]
    assert len(values) == count
    if isinstance(directions, np.ndarray):
        return np.stack(values, axis=-1)
    import torch  # only a caller that already holds a tensor gets here

    return torch.stack(values, dim=-1)


def lobe_factors(l_max: int) -> np.ndarray:
    """Zonal factors A_l of the clamped cosine, one per coefficient, shape [(l_max+1)^2].

    A_0..A_3 = pi, 2 pi/3, pi/4, 0: the lobe integrates to pi and its odd degrees above 1 vanish.
    """
    per_degree = (math.pi, 2 * math.pi / 3, math.pi / 4, 0.0)
    coeff_count(l_max)
    return np.concatenate([np.full(2 * degree + 1, per_degree[degree]) for degree in range(l_max + 1)])


def cosine_lobe(directions: Any, l_max: int) -> Any:
    """SH coefficients of max(0, n.w) about unit vectors n: ``A_l Y_lm(n)``, shape [..., (l_max+1)^2]."""
    basis = sh_basis(directions, l_max)
    factors = lobe_factors(l_max)
    if isinstance(basis, np.ndarray):
        return basis * factors.astype(basis.dtype)
    return basis * basis.new_tensor(factors)
