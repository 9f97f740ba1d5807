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

Shapes, a tensor [t,3] being read as t vectors: offset, direction, normal, albedo [t,3]; plane, weight [t]; position,
power [3], one vector each. Threads: forward, one per texel. Adjoint, one per block of texels: it writes its texels'
rhobar and its own row of the partial sums of pbar and Pbar, so there are no atomics and the result is deterministic.
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

    @wp.kernel(module=module, enable_backward=False)
    def forward(
        offset: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
        normal: wp.array(dtype=vec3),
        plane: wp.array(dtype=scalar),
        weight: wp.array(dtype=scalar),
        albedo: wp.array(dtype=vec3),
        position: wp.array(dtype=vec3),
        power: wp.array(dtype=vec3),
        hit: wp.array(dtype=vec3),
        flux: wp.array(dtype=vec3),
    ):
        t = wp.tid()
        n = normal[t]
        d = direction[t]
        origin = position[0] + offset[t]
        hit[t] = origin + d * ((plane[t] - wp.dot(n, origin)) / wp.dot(n, d))
        flux[t] = wp.cw_mul(albedo[t], power[0]) * weight[t]

    @wp.kernel(module=module, enable_backward=False)
    def adjoint(
        direction: wp.array(dtype=vec3),
        normal: wp.array(dtype=vec3),
        weight: wp.array(dtype=scalar),
        albedo: wp.array(dtype=vec3),
        power: wp.array(dtype=vec3),
        hit_bar: wp.array(dtype=vec3),
        flux_bar: wp.array(dtype=vec3),
        position_partial: wp.array(dtype=vec3),
        power_partial: wp.array(dtype=vec3),
        albedo_bar: wp.array(dtype=vec3),
    ):
        block = wp.tid()
        begin = block * _BLOCK
        end = wp.min(begin + _BLOCK, direction.shape[0])
        to_position = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        to_power = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        strength = power[0]
        for t in range(begin, end):
            n = normal[t]
            d = direction[t]
            received = flux_bar[t] * weight[t]
            to_position += hit_bar[t] - n * (wp.dot(d, hit_bar[t]) / wp.dot(n, d))
            to_power += wp.cw_mul(received, albedo[t])
            albedo_bar[t] = wp.cw_mul(received, strength)
        position_partial[block] = to_position
        power_partial[block] = to_power

    return RsmKernels(forward, adjoint)
