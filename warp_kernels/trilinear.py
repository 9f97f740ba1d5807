"""Trilinear weights on cell centres, for deposit (injection) and lookup (sampling).

A point has cell coordinates u = (x - minimum) / h, so cell i covers [i, i+1) and has its centre at i + 1/2. Per
axis, with t = u - 1/2, b = floor(t), f = t - b:

    corner bit 0: cell b, weight 1 - f;   bit 1: cell b + 1, weight f;   cells clipped to 0..n-1

Bit a of a corner number 0..7 belongs to axis a (x, y, z). Clipping makes a point beyond the outermost centres read,
or give to, the edge cell alone, and its weights still sum to one.
"""

from typing import Any

import warp as wp

__all__ = ["centre_coordinate", "corner_cell", "corner_weight", "corner_weight_gradient"]


@wp.func
def centre_coordinate(u: Any, size: int):
    """``u - 1/2``, held within one cell of the grid so that it fits an int however far the point is."""
    return wp.clamp(u - type(u)(0.5), type(u)(-1.0), type(u)(size))


@wp.func
def corner_cell(base: wp.vec3i, corner: int, size: wp.vec3i):
    """Cell (x, y, z) of a corner, clipped to the grid."""
    return wp.vec3i(
        wp.clamp(base[0] + (corner & 1), 0, size[0] - 1),
        wp.clamp(base[1] + ((corner >> 1) & 1), 0, size[1] - 1),
        wp.clamp(base[2] + ((corner >> 2) & 1), 0, size[2] - 1),
    )


@wp.func
def axis_weight(fraction: Any, bit: int):
    """Weight of one axis."""
    weight = type(fraction)(1.0) - fraction
    if bit == 1:
        weight = fraction
    return weight


@wp.func
def corner_weight(fraction: Any, corner: int):
    """Product of the three axis weights."""
    return (
        axis_weight(fraction[0], corner & 1)
        * axis_weight(fraction[1], (corner >> 1) & 1)
        * axis_weight(fraction[2], (corner >> 2) & 1)
    )


@wp.func
def corner_weight_gradient(fraction: Any, corner: int):
    """Gradient of ``corner_weight`` with respect to the point's cell coordinates."""
    wx = axis_weight(fraction[0], corner & 1)
    wy = axis_weight(fraction[1], (corner >> 1) & 1)
    wz = axis_weight(fraction[2], (corner >> 2) & 1)
    sx = type(wx)(2 * (corner & 1) - 1)
    sy = type(wx)(2 * ((corner >> 1) & 1) - 1)
    sz = type(wx)(2 * ((corner >> 2) & 1) - 1)
    return wp.vector(sx * wy * wz, wx * sy * wz, wx * wy * sz)
