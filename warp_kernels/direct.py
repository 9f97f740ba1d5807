"""Direct irradiance of punctual lights and area-light samples, and its adjoint.

    E(x_i, n_i) = sum_j V_ij G_ij P_j        [W/m2]

with the visibility V in {0, 1} held fixed, r = |p_j - x_i|, w = (p_j - x_i)/r and the geometry term G:

    point        G = (n.w)+ / r^2                          P: intensity [W/sr]
    spot         G = s^2 (n.w)+ / r^2                      P: intensity on the axis [W/sr]
                 s = clamp((-u.w - cos_outer) / (cos_inner - cos_outer), 0, 1)   (KHR_lights_punctual)
    directional  G = (-u.n)+                               P: irradiance facing the light [W/m2]
    area sample  G = (n.w)+ (-u.w)+ / r^2                  P: radiance times area [W/sr]

where u is the unit direction in which the emitter looks. A pair closer than a micrometre has no direction: G = 0.

Adjoint, g_i the adjoint of E_i:

    Pbar_j = sum_i V_ij G_ij g_i,    pbar_j = sum_i V_ij (dG_ij/dp_j) (P_j . g_i)

Shapes: points, normals [n,3]; position, direction, power [m,3]; cone (cos inner, cos outer) [m,2]; visibility [n,m].
Threads: forward, one per receiver, with a loop over emitters. Adjoint, one per (block of receivers, emitter): it
gathers over its block and writes its own row of a partial sum [blocks, m], so there are no atomics and the result is
deterministic.
"""

# mypy: disable-error-code="valid-type"

from functools import lru_cache
from typing import Any, NamedTuple

import warp as wp

__all__ = ["AREA", "DIRECTIONAL", "POINT", "RECEIVER_BLOCK", "SPOT", "DirectKernels", "direct_kernels"]

POINT, SPOT, DIRECTIONAL, AREA = 0, 1, 2, 3
RECEIVER_BLOCK = 256
"""Receivers that one thread of the adjoint gathers over."""

_POINT, _SPOT, _DIRECTIONAL = wp.constant(POINT), wp.constant(SPOT), wp.constant(DIRECTIONAL)
_BLOCK = wp.constant(RECEIVER_BLOCK)


class DirectKernels(NamedTuple):
    """Kernels of one scalar type."""

    forward: Any
    adjoint: Any


@lru_cache
def direct_kernels(scalar: Any) -> DirectKernels:
    """The kernels for ``wp.float32`` or ``wp.float64``."""
    module = wp.get_module(f"difflpv_direct_{scalar.__name__}")
    vec3 = wp.types.vector(3, scalar)
    vec2 = wp.types.vector(2, scalar)

    @wp.func
    def row(array: wp.array2d(dtype=scalar), i: int):
        return vec3(array[i, 0], array[i, 1], array[i, 2])

    @wp.func
    def geometry_term(kind: wp.int32, position: vec3, direction: vec3, cone: vec2, x: vec3, n: vec3):
        zero = scalar(0.0)
        if kind == _DIRECTIONAL:
            return wp.max(-wp.dot(n, direction), zero)
        d = position - x
        r2 = wp.dot(d, d)
        a = wp.dot(n, d)
        if a <= zero or r2 < scalar(1.0e-12):
            return zero
        r = wp.sqrt(r2)
        if kind == _POINT:
            return a / (r2 * r)
        b = -wp.dot(direction, d)
        if kind == _SPOT:
            s = wp.clamp((b / r - cone[1]) / wp.max(cone[0] - cone[1], scalar(1.0e-4)), zero, scalar(1.0))
            return s * s * a / (r2 * r)
        return a * wp.max(b, zero) / (r2 * r2)

    @wp.func
    def geometry_gradient(kind: wp.int32, position: vec3, direction: vec3, cone: vec2, x: vec3, n: vec3):
        zero = scalar(0.0)
        if kind == _DIRECTIONAL:
            return vec3(zero, zero, zero)
        d = position - x
        r2 = wp.dot(d, d)
        a = wp.dot(n, d)
        if a <= zero or r2 < scalar(1.0e-12):
            return vec3(zero, zero, zero)
        r = wp.sqrt(r2)
        r3 = r2 * r
        inverse_square = n / r3 - d * (scalar(3.0) * a / (r3 * r2))
        if kind == _POINT:
            return inverse_square
        b = -wp.dot(direction, d)
        if kind == _SPOT:
            width = wp.max(cone[0] - cone[1], scalar(1.0e-4))
            t = (b / r - cone[1]) / width
            s = wp.clamp(t, zero, scalar(1.0))
            gradient = inverse_square * (s * s)
            if t > zero and t < scalar(1.0):
                cosine_gradient = -direction / r - d * (b / r3)
                gradient += cosine_gradient * (scalar(2.0) * s / width * a / r3)
            return gradient
        if b <= zero:
            return vec3(zero, zero, zero)
        return (n * b - direction * a) / (r2 * r2) - d * (scalar(4.0) * a * b / (r3 * r3))

    @wp.kernel(module=module, enable_backward=False)
    def forward(
        points: wp.array2d(dtype=scalar),
        normals: wp.array2d(dtype=scalar),
        kind: wp.array(dtype=wp.int32),
        position: wp.array2d(dtype=scalar),
        direction: wp.array2d(dtype=scalar),
        power: wp.array2d(dtype=scalar),
        cone: wp.array2d(dtype=scalar),
        visibility: wp.array2d(dtype=wp.uint8),
        irradiance: wp.array2d(dtype=scalar),
    ):
        i = wp.tid()
        x = row(points, i)
        n = row(normals, i)
        total = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        for j in range(kind.shape[0]):
            if visibility[i, j] != wp.uint8(0):
                angles = vec2(cone[j, 0], cone[j, 1])
                total += row(power, j) * geometry_term(kind[j], row(position, j), row(direction, j), angles, x, n)
        for c in range(3):
            irradiance[i, c] = total[c]

    @wp.kernel(module=module, enable_backward=False)
    def adjoint(
        points: wp.array2d(dtype=scalar),
        normals: wp.array2d(dtype=scalar),
        kind: wp.array(dtype=wp.int32),
        position: wp.array2d(dtype=scalar),
        direction: wp.array2d(dtype=scalar),
        power: wp.array2d(dtype=scalar),
        cone: wp.array2d(dtype=scalar),
        visibility: wp.array2d(dtype=wp.uint8),
        irradiance_gradient: wp.array2d(dtype=scalar),
        position_partial: wp.array3d(dtype=scalar),
        power_partial: wp.array3d(dtype=scalar),
    ):
        block, j = wp.tid()
        begin = block * _BLOCK
        end = wp.min(begin + _BLOCK, points.shape[0])
        to_position = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        to_power = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        p = row(position, j)
        u = row(direction, j)
        angles = vec2(cone[j, 0], cone[j, 1])
        strength = row(power, j)
        for i in range(begin, end):
            if visibility[i, j] != wp.uint8(0):
                x = row(points, i)
                n = row(normals, i)
                g = row(irradiance_gradient, i)
                to_power += g * geometry_term(kind[j], p, u, angles, x, n)
                to_position += geometry_gradient(kind[j], p, u, angles, x, n) * wp.dot(strength, g)
        for c in range(3):
            position_partial[block, j, c] = to_position[c]
            power_partial[block, j, c] = to_power[c]

    return DirectKernels(forward, adjoint)
