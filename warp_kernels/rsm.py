"""RSM texels into VPLs, and the adjoint: moving a light slides each hit along the plane of the triangle that it hit.

Texel t has a fixed ray offset b_t (zero for a point or spot light), a fixed unit direction d_t and the plane
n_t.x = c_t of the triangle that it hit, n_t on the lit side. With the light at p and its power P
(intensity [W/sr], or irradiance [W/m2] for a directional light):

    x_t   = p + b_t + s_t d_t,    s_t = (c_t - n_t.(p + b_t)) / (n_t.d_t)      [m]
    Phi_t = rho_t w_t P                                                        [W]

w_t is what a texel receives per unit of power: its solid angle [sr] or area [m2] times the light's falloff.

Adjoint, with the adjoints xbar, Phibar:

    pbar   = sum_t xbar_t - n_t (d_t.xbar_t) / (n_t.d_t)
    Pbar   = sum_t w_t rho_t Phibar_t,    rhobar_t = w_t P Phibar_t

Shapes: offset, direction, normal, albedo [t,3]; plane, weight [t]; position, power [3]. Threads: forward, one per
texel. Adjoint, one per block of texels: it writes its texels' rhobar and its own row of the partial sums of pbar and
Pbar, so there are no atomics and the result is deterministic.
"""

# mypy: disable-error-code="valid-type"

from functools import lru_cache
from typing import Any, NamedTuple

import warp as wp

__all__ = ["TEXEL_BLOCK", "RsmKernels", "rsm_kernels"]

TEXEL_BLOCK = 256
"""Texels that one thread of the adjoint gathers over."""

_BLOCK = wp.constant(TEXEL_BLOCK)


class RsmKernels(NamedTuple):
    """Kernels of one scalar type."""

    forward: Any
    adjoint: Any


@lru_cache
def rsm_kernels(scalar: Any) -> RsmKernels:
    """The kernels for ``wp.float32`` or ``wp.float64``."""
    module = wp.get_module(f"difflpv_rsm_{scalar.__name__}")
    vec3 = wp.types.vector(3, scalar)

    @wp.func
    def row(array: wp.array2d(dtype=scalar), i: int):
        return vec3(array[i, 0], array[i, 1], array[i, 2])

    @wp.kernel(module=module, enable_backward=False)
    def forward(
        offset: wp.array2d(dtype=scalar),
        direction: wp.array2d(dtype=scalar),
        normal: wp.array2d(dtype=scalar),
        plane: wp.array(dtype=scalar),
        weight: wp.array(dtype=scalar),
        albedo: wp.array2d(dtype=scalar),
        position: wp.array(dtype=scalar),
        power: wp.array(dtype=scalar),
        hit: wp.array2d(dtype=scalar),
        flux: wp.array2d(dtype=scalar),
    ):
        t = wp.tid()
        n = row(normal, t)
        d = row(direction, t)
        origin = vec3(position[0], position[1], position[2]) + row(offset, t)
        x = origin + d * ((plane[t] - wp.dot(n, origin)) / wp.dot(n, d))
        for c in range(3):
            hit[t, c] = x[c]
            flux[t, c] = albedo[t, c] * power[c] * weight[t]

    @wp.kernel(module=module, enable_backward=False)
    def adjoint(
        direction: wp.array2d(dtype=scalar),
        normal: wp.array2d(dtype=scalar),
        weight: wp.array(dtype=scalar),
        albedo: wp.array2d(dtype=scalar),
        power: wp.array(dtype=scalar),
        hit_bar: wp.array2d(dtype=scalar),
        flux_bar: wp.array2d(dtype=scalar),
        position_partial: wp.array2d(dtype=scalar),
        power_partial: wp.array2d(dtype=scalar),
        albedo_bar: wp.array2d(dtype=scalar),
    ):
        block = wp.tid()
        begin = block * _BLOCK
        end = wp.min(begin + _BLOCK, direction.shape[0])
        to_position = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        to_power = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        for t in range(begin, end):
            n = row(normal, t)
            d = row(direction, t)
            x_bar = row(hit_bar, t)
            received = row(flux_bar, t) * weight[t]
            to_position += x_bar - n * (wp.dot(d, x_bar) / wp.dot(n, d))
            to_power += wp.cw_mul(received, row(albedo, t))
            for c in range(3):
                albedo_bar[t, c] = received[c] * power[c]
        for c in range(3):
            position_partial[block, c] = to_position[c]
            power_partial[block, c] = to_power[c]

    return RsmKernels(forward, adjoint)
