"""Clamped cosine lobe in real, orthonormal SH without the Condon-Shortley phase, as in ``difflpv.sh``.

    lobe_lm(n) = A_l Y_lm(n),   A_0..A_3 = pi, 2 pi/3, pi/4, 0

A_3 = 0, so nine numbers hold the lobe for every ``l_max`` up to 3: a kernel reads the first ``min(K, LOBE_COUNT)``
of them. The polynomials are evaluated as they stand; ``lobe_pullback`` differentiates just these polynomials.

Source: Ramamoorthi and Hanrahan 2001 (A_l); Sloan 2008 (polynomial forms). Functions are generic in the scalar
type; every constant is cast to it, as Warp reads a bare one as float32.
"""

import math
from typing import Any

import warp as wp

__all__ = ["LOBE_COUNT", "cosine_lobe", "lobe_pullback"]

LOBE_COUNT = wp.constant(9)

_A0 = wp.constant(math.sqrt(math.pi) / 2)  # A_0 Y_00
_A1 = wp.constant(math.sqrt(math.pi / 3))  # A_1 sqrt(3 / 4 pi)
_A2 = wp.constant(math.sqrt(15 * math.pi) / 8)  # A_2 sqrt(15 / 4 pi)
_A20 = wp.constant(math.sqrt(5 * math.pi) / 16)  # A_2 sqrt(5 / 16 pi), of 3 z^2 - 1


@wp.func
def cosine_lobe(n: Any):
    """Coefficients of max(0, n.w) for a unit vector ``n``; nine-vector of n's scalar type."""
    x = n[0]
    y = n[1]
    z = n[2]
    a1 = type(x)(_A1)
    a2 = type(x)(_A2)
    two_zonal = type(x)(3.0) * z * z - type(x)(1.0)
    return wp.vector(
        type(x)(_A0),
        a1 * y,
        a1 * z,
        a1 * x,
        a2 * x * y,
        a2 * y * z,
        type(x)(_A20) * two_zonal,
        a2 * x * z,
        a2 * type(x)(0.5) * (x * x - y * y),
    )


@wp.func
def lobe_pullback(n: Any, g: Any):
    """Gradient of ``sum_k g[k] lobe_k(n)`` with respect to ``n``; three-vector."""
    x = n[0]
    y = n[1]
    z = n[2]
    a1 = type(x)(_A1)
    a2 = type(x)(_A2)
    return wp.vector(
        a1 * g[3] + a2 * (g[4] * y + g[7] * z + g[8] * x),
        a1 * g[1] + a2 * (g[4] * x + g[5] * z - g[8] * y),
        a1 * g[2] + a2 * (g[5] * y + g[7] * x) + type(x)(6.0) * type(x)(_A20) * g[6] * z,
    )
