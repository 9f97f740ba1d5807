"""Lookup of a volume at points: irradiance of receivers, or the interpolated coefficients; and the adjoints.

Forward (physics.md, "The chain" 7), point i at cell coordinates u_i, w_j the trilinear weights of ``trilinear``:

    coefficients  a_ick = sum_j w_j(u_i) V[c,k,j]
    irradiance    E_ic = s sum_k lobe_k(-n_i) a_ick,   s = 1 / h^2 [1/m^2]

Adjoint, Ebar and abar given, t_cj = sum_k lobe_k(-n_i) V[c,k,j]:

    Vbar[c,k,j] += w_j abar_ick                        or  s w_j Ebar_ic lobe_k(-n_i)
    ubar_i = sum_j grad w_j sum_ck abar_ick V[c,k,j]   or  s sum_j grad w_j sum_c Ebar_ic t_cj
    nbar_i = -s lobe'(-n_i)^T sum_c Ebar_ic a_ic

Shapes: cells u, normal [n,3]; irradiance [n,C]; volume [C K, n_z, n_y, n_x], row c K + k; coefficients [n, C K].
Threads: one per point, or per (point, row) for coefficients. The volume's adjoint adds atomically (in order on the
CPU, where a launch is serial), everything else gathers. A NaN coordinate gives NaN.
"""

# mypy: disable-error-code="valid-type"

from functools import lru_cache
from typing import Any, NamedTuple

import warp as wp

from warp_kernels.sh import LOBE_COUNT, cosine_lobe, lobe_pullback
from warp_kernels.trilinear import centre_coordinate, corner_cell, corner_weight, corner_weight_gradient

__all__ = ["SamplingKernels", "sampling_kernels"]


class SamplingKernels(NamedTuple):
    """Kernels of one scalar type."""

    irradiance: Any
    irradiance_volume_adjoint: Any
    irradiance_point_adjoint: Any
    coeffs: Any
    coeffs_volume_adjoint: Any
    coeffs_point_adjoint: Any


@lru_cache
def sampling_kernels(scalar: Any) -> SamplingKernels:
    """The kernels for ``wp.float32`` or ``wp.float64``."""
    module = wp.get_module(f"difflpv_sampling_{scalar.__name__}")
    vec3 = wp.types.vector(3, scalar)
    vec9 = wp.types.vector(9, scalar)

    @wp.func
    def row3(rows: wp.array2d(dtype=scalar), i: int):
        return vec3(rows[i, 0], rows[i, 1], rows[i, 2])

    @wp.func
    def size_of(volume: wp.array4d(dtype=scalar)):
        return wp.vec3i(volume.shape[3], volume.shape[2], volume.shape[1])

    @wp.func
    def base_of(u: vec3, size: wp.vec3i):
        return wp.vec3i(
            int(wp.floor(centre_coordinate(u[0], size[0]))),
            int(wp.floor(centre_coordinate(u[1], size[1]))),
            int(wp.floor(centre_coordinate(u[2], size[2]))),
        )

    @wp.func
    def fraction_of(u: vec3, base: wp.vec3i, size: wp.vec3i):
        fraction = vec3(
            centre_coordinate(u[0], size[0]) - scalar(base[0]),
            centre_coordinate(u[1], size[1]) - scalar(base[1]),
            centre_coordinate(u[2], size[2]) - scalar(base[2]),
        )
        return fraction + (u - u)  # the clamp above swallows NaN; this brings it back

    @wp.kernel(module=module, enable_backward=False)
    def irradiance(
        volume: wp.array4d(dtype=scalar),
        cells: wp.array2d(dtype=scalar),
        normal: wp.array2d(dtype=scalar),
        coeffs: int,
        scale: scalar,
        result: wp.array2d(dtype=scalar),
    ):
        i = wp.tid()
        size = size_of(volume)
        u = row3(cells, i)
        base = base_of(u, size)
        fraction = fraction_of(u, base, size)
        lobe = cosine_lobe(-row3(normal, i))
        for c in range(result.shape[1]):
            total = scalar(0.0)
            for corner in range(8):
                j = corner_cell(base, corner, size)
                s = scalar(0.0)
                for k in range(wp.min(coeffs, LOBE_COUNT)):
                    s += lobe[k] * volume[c * coeffs + k, j[2], j[1], j[0]]
                total += corner_weight(fraction, corner) * s
            result[i, c] = scale * total

    @wp.kernel(module=module, enable_backward=False)
    def irradiance_volume_adjoint(
        result_bar: wp.array2d(dtype=scalar),
        cells: wp.array2d(dtype=scalar),
        normal: wp.array2d(dtype=scalar),
        coeffs: int,
        scale: scalar,
        volume_bar: wp.array4d(dtype=scalar),
    ):
        i = wp.tid()
        size = size_of(volume_bar)
        u = row3(cells, i)
        base = base_of(u, size)
        fraction = fraction_of(u, base, size)
        lobe = cosine_lobe(-row3(normal, i))
        for c in range(result_bar.shape[1]):
            for corner in range(8):
                j = corner_cell(base, corner, size)
                g = scale * result_bar[i, c] * corner_weight(fraction, corner)
                for k in range(wp.min(coeffs, LOBE_COUNT)):
                    wp.atomic_add(volume_bar, c * coeffs + k, j[2], j[1], j[0], g * lobe[k])

    @wp.kernel(module=module, enable_backward=False)
    def irradiance_point_adjoint(
        result_bar: wp.array2d(dtype=scalar),
        volume: wp.array4d(dtype=scalar),
        cells: wp.array2d(dtype=scalar),
        normal: wp.array2d(dtype=scalar),
        coeffs: int,
        scale: scalar,
        cells_bar: wp.array2d(dtype=scalar),
        normal_bar: wp.array2d(dtype=scalar),
    ):
        i = wp.tid()
        size = size_of(volume)
        u = row3(cells, i)
        base = base_of(u, size)
        fraction = fraction_of(u, base, size)
        direction = -row3(normal, i)
        lobe = cosine_lobe(direction)
        u_bar = vec3()
        lobe_bar = vec9()
        for c in range(result_bar.shape[1]):
            g = scale * result_bar[i, c]
            for corner in range(8):
                j = corner_cell(base, corner, size)
                weight = corner_weight(fraction, corner)
                s = scalar(0.0)
                for k in range(wp.min(coeffs, LOBE_COUNT)):
                    v = volume[c * coeffs + k, j[2], j[1], j[0]]
                    s += lobe[k] * v
                    lobe_bar[k] += g * weight * v
                u_bar += g * s * corner_weight_gradient(fraction, corner)
        n_bar = -lobe_pullback(direction, lobe_bar)
        for axis in range(3):
            cells_bar[i, axis] = u_bar[axis]
            normal_bar[i, axis] = n_bar[axis]

    @wp.kernel(module=module, enable_backward=False)
    def coeffs(volume: wp.array4d(dtype=scalar), cells: wp.array2d(dtype=scalar), result: wp.array2d(dtype=scalar)):
        i, row = wp.tid()
        size = size_of(volume)
        u = row3(cells, i)
        base = base_of(u, size)
        fraction = fraction_of(u, base, size)
        total = scalar(0.0)
        for corner in range(8):
            j = corner_cell(base, corner, size)
            total += corner_weight(fraction, corner) * volume[row, j[2], j[1], j[0]]
        result[i, row] = total

    @wp.kernel(module=module, enable_backward=False)
    def coeffs_volume_adjoint(
        result_bar: wp.array2d(dtype=scalar), cells: wp.array2d(dtype=scalar), volume_bar: wp.array4d(dtype=scalar)
    ):
        i, row = wp.tid()
        size = size_of(volume_bar)
        u = row3(cells, i)
        base = base_of(u, size)
        fraction = fraction_of(u, base, size)
        for corner in range(8):
            j = corner_cell(base, corner, size)
            g = corner_weight(fraction, corner) * result_bar[i, row]
            wp.atomic_add(volume_bar, row, j[2], j[1], j[0], g)

    @wp.kernel(module=module, enable_backward=False)
    def coeffs_point_adjoint(
        result_bar: wp.array2d(dtype=scalar),
        volume: wp.array4d(dtype=scalar),
        cells: wp.array2d(dtype=scalar),
        cells_bar: wp.array2d(dtype=scalar),
    ):
        i = wp.tid()
        size = size_of(volume)
        u = row3(cells, i)
        base = base_of(u, size)
        fraction = fraction_of(u, base, size)
        u_bar = vec3()
        for corner in range(8):
            j = corner_cell(base, corner, size)
            s = scalar(0.0)
            for row in range(result_bar.shape[1]):
                s += result_bar[i, row] * volume[row, j[2], j[1], j[0]]
            u_bar += s * corner_weight_gradient(fraction, corner)
        for axis in range(3):
            cells_bar[i, axis] = u_bar[axis]

    return SamplingKernels(
        irradiance,
        irradiance_volume_adjoint,
        irradiance_point_adjoint,
        coeffs,
        coeffs_volume_adjoint,
        coeffs_point_adjoint,
    )
