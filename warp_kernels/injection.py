"""Injection of virtual point lights into a volume, and its adjoint.

Forward (physics.md, "The chain" 3), VPL i at cell coordinates u_i with amplitude a_ic = Phi_ic / pi [W/sr] and
normal n_i:

    V[c,k,j] += w_j(u_i) a_ic lobe_k(n_i)

``nearest``: one cell j = floor(u), w = 1 (Kaplanyan and Dachsbacher 2010). ``trilinear``: eight cells, see
``trilinear``. A VPL with u outside [0, n) on any axis, NaN included, adds nothing.

Adjoint, G the adjoint of V, s_cj = sum_k lobe_k G[c,k,j]:

    abar_ic = sum_j w_j s_cj,   ubar_i = sum_j grad w_j sum_c a_ic s_cj,
    nbar_i = lobe'(n_i)^T sum_j w_j sum_c a_ic G[c,:,j]

Shapes: u, normal [n,3]; amplitude [n,C]; volume [C K, n_z, n_y, n_x], row c K + k (Warp arrays have four axes at most),
zeroed by the caller. Threads: one per VPL. The forward adds atomically (in VPL order on the CPU, where a launch is
serial); the adjoint gathers and is free of atomics.
"""

# mypy: disable-error-code="valid-type"

from functools import lru_cache
from typing import Any, NamedTuple

import warp as wp

from warp_kernels.sh import LOBE_COUNT, cosine_lobe, lobe_pullback
from warp_kernels.trilinear import centre_coordinate, corner_cell, corner_weight, corner_weight_gradient

__all__ = ["InjectionKernels", "injection_kernels"]


class InjectionKernels(NamedTuple):
    """Kernels of one scalar type."""

    forward: Any
    adjoint: Any


@lru_cache
def injection_kernels(scalar: Any) -> InjectionKernels:
    """The kernels for ``wp.float32`` or ``wp.float64``."""
    module = wp.get_module(f"difflpv_injection_{scalar.__name__}")
    vec3 = wp.types.vector(3, scalar)
    vec9 = wp.types.vector(9, scalar)

    @wp.func
    def inside(u: vec3, size: wp.vec3i):
        return (
            u[0] >= scalar(0.0) and u[0] < scalar(size[0])
            and u[1] >= scalar(0.0) and u[1] < scalar(size[1])
            and u[2] >= scalar(0.0) and u[2] < scalar(size[2])
        )  # fmt: skip

    @wp.func
    def lattice_point(u: vec3, size: wp.vec3i, trilinear: int):
        """What is floored to the first cell: u itself for the nearest cell, the centre coordinate for eight."""
        point = u
        if trilinear == 1:
            point = vec3(
                centre_coordinate(u[0], size[0]), centre_coordinate(u[1], size[1]), centre_coordinate(u[2], size[2])
            )
        return point

    @wp.kernel(module=module, enable_backward=False)
    def forward(
        cells: wp.array2d(dtype=scalar),
        normal: wp.array2d(dtype=scalar),
        amplitude: wp.array2d(dtype=scalar),
        coeffs: int,
        trilinear: int,
        volume: wp.array4d(dtype=scalar),
    ):
        i = wp.tid()
        size = wp.vec3i(volume.shape[3], volume.shape[2], volume.shape[1])
        u = vec3(cells[i, 0], cells[i, 1], cells[i, 2])
        if not inside(u, size):
            return
        point = lattice_point(u, size, trilinear)
        base = wp.vec3i(int(wp.floor(point[0])), int(wp.floor(point[1])), int(wp.floor(point[2])))
        fraction = vec3()
        if trilinear == 1:
            fraction = vec3(point[0] - scalar(base[0]), point[1] - scalar(base[1]), point[2] - scalar(base[2]))
        lobe = cosine_lobe(vec3(normal[i, 0], normal[i, 1], normal[i, 2]))
        for corner in range(1 + 7 * trilinear):
            j = corner_cell(base, corner, size)
            weight = corner_weight(fraction, corner)
            for c in range(amplitude.shape[1]):
                for k in range(wp.min(coeffs, LOBE_COUNT)):
                    wp.atomic_add(volume, c * coeffs + k, j[2], j[1], j[0], weight * amplitude[i, c] * lobe[k])

    @wp.kernel(module=module, enable_backward=False)
    def adjoint(
        cells: wp.array2d(dtype=scalar),
        normal: wp.array2d(dtype=scalar),
        amplitude: wp.array2d(dtype=scalar),
        coeffs: int,
        trilinear: int,
        volume_bar: wp.array4d(dtype=scalar),
        cells_bar: wp.array2d(dtype=scalar),
        normal_bar: wp.array2d(dtype=scalar),
        amplitude_bar: wp.array2d(dtype=scalar),
    ):
        i = wp.tid()
        size = wp.vec3i(volume_bar.shape[3], volume_bar.shape[2], volume_bar.shape[1])
        u = vec3(cells[i, 0], cells[i, 1], cells[i, 2])
        if not inside(u, size):
            return
        point = lattice_point(u, size, trilinear)
        base = wp.vec3i(int(wp.floor(point[0])), int(wp.floor(point[1])), int(wp.floor(point[2])))
        fraction = vec3()
        if trilinear == 1:
            fraction = vec3(point[0] - scalar(base[0]), point[1] - scalar(base[1]), point[2] - scalar(base[2]))
        n = vec3(normal[i, 0], normal[i, 1], normal[i, 2])
        lobe = cosine_lobe(n)
        u_bar = vec3()
        lobe_bar = vec9()
        for c in range(amplitude.shape[1]):
            a = amplitude[i, c]
            a_bar = scalar(0.0)
            for corner in range(1 + 7 * trilinear):
                j = corner_cell(base, corner, size)
                weight = corner_weight(fraction, corner)
                s = scalar(0.0)
                for k in range(wp.min(coeffs, LOBE_COUNT)):
                    g = volume_bar[c * coeffs + k, j[2], j[1], j[0]]
                    s += lobe[k] * g
                    lobe_bar[k] += weight * a * g
                a_bar += weight * s
                u_bar += a * s * corner_weight_gradient(fraction, corner)
            amplitude_bar[i, c] = a_bar
        n_bar = lobe_pullback(n, lobe_bar)
        for axis in range(3):
            normal_bar[i, axis] = n_bar[axis]
            if trilinear == 1:
                cells_bar[i, axis] = u_bar[axis]

    return InjectionKernels(forward, adjoint)
