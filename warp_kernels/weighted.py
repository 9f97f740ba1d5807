"""Receivers and lights that name their cells: lobes read from, or given to, listed cells with listed weights.

Where geometry decides which cells a point may use (``difflpv.lookup``), the cells J_i. (eight or 27) and their weights W_i.
are data rather than a function of the position. Gather (a receiver's lookup) and its transpose, spread (a light's deposit):

    gather   E_ic       = sum_j W_ij sum_k L_ik V[c,k,J_ij]
    spread   V[c,k,J_ij] += W_ij L_ik F_ic

Both are linear in each argument, so with G the adjoint of the result (F in place of Ebar for spread, Vbar for V):

    Vbar = spread(Ebar),   Fbar = gather(Vbar)
    Wbar_ij = sum_ck Ebar_ic L_ik V[c,k,J_ij],   Lbar_ik = sum_cj Ebar_ic W_ij V[c,k,J_ij]

Shapes: cells [n,J] int32, index into the flattened grid; weights [n,J]; lobes [n,K]; results and flux [n,C]; volume
[C K, cells], row c K + k. Threads: one per point. ``spread`` adds atomically (in point order on the CPU, where a launch is
serial); everything else gathers.
"""

# mypy: disable-error-code="valid-type"

from functools import lru_cache
from typing import Any, NamedTuple

import warp as wp

__all__ = ["WeightedKernels", "weighted_kernels"]


class WeightedKernels(NamedTuple):
    """Kernels of one scalar type."""

    gather: Any
    spread: Any
    weights_adjoint: Any
    lobes_adjoint: Any


@lru_cache
def weighted_kernels(scalar: Any) -> WeightedKernels:
    """The kernels for ``wp.float32`` or ``wp.float64``."""
    module = wp.get_module(f"difflpv_weighted_{scalar.__name__}")

    @wp.kernel(module=module, enable_backward=False)
    def gather(
        volume: wp.array2d(dtype=scalar),
        cells: wp.array2d(dtype=wp.int32),
        weights: wp.array2d(dtype=scalar),
        lobes: wp.array2d(dtype=scalar),
        result: wp.array2d(dtype=scalar),
    ):
        i = wp.tid()
        coeffs = lobes.shape[1]
        for c in range(result.shape[1]):
            total = scalar(0.0)
            for j in range(cells.shape[1]):
                part = scalar(0.0)
                for k in range(coeffs):
                    part += lobes[i, k] * volume[c * coeffs + k, cells[i, j]]
                total += weights[i, j] * part
            result[i, c] = total

    @wp.kernel(module=module, enable_backward=False)
    def spread(
        flux: wp.array2d(dtype=scalar),
        cells: wp.array2d(dtype=wp.int32),
        weights: wp.array2d(dtype=scalar),
        lobes: wp.array2d(dtype=scalar),
        volume: wp.array2d(dtype=scalar),
    ):
        i = wp.tid()
        coeffs = lobes.shape[1]
        for c in range(flux.shape[1]):
            for j in range(cells.shape[1]):
                amount = weights[i, j] * flux[i, c]
                if amount != scalar(0.0):
                    for k in range(coeffs):
                        wp.atomic_add(volume, c * coeffs + k, cells[i, j], amount * lobes[i, k])

    @wp.kernel(module=module, enable_backward=False)
    def weights_adjoint(
        volume: wp.array2d(dtype=scalar),
        cells: wp.array2d(dtype=wp.int32),
        lobes: wp.array2d(dtype=scalar),
        result_bar: wp.array2d(dtype=scalar),
        weights_bar: wp.array2d(dtype=scalar),
    ):
        i = wp.tid()
        coeffs = lobes.shape[1]
        for j in range(cells.shape[1]):
            total = scalar(0.0)
            for c in range(result_bar.shape[1]):
                part = scalar(0.0)
                for k in range(coeffs):
                    part += lobes[i, k] * volume[c * coeffs + k, cells[i, j]]
                total += result_bar[i, c] * part
            weights_bar[i, j] = total

    @wp.kernel(module=module, enable_backward=False)
    def lobes_adjoint(
        volume: wp.array2d(dtype=scalar),
        cells: wp.array2d(dtype=wp.int32),
        weights: wp.array2d(dtype=scalar),
        result_bar: wp.array2d(dtype=scalar),
        lobes_bar: wp.array2d(dtype=scalar),
    ):
        i = wp.tid()
        coeffs = lobes_bar.shape[1]
        for k in range(coeffs):
            total = scalar(0.0)
            for c in range(result_bar.shape[1]):
                part = scalar(0.0)
                for j in range(cells.shape[1]):
                    part += weights[i, j] * volume[c * coeffs + k, cells[i, j]]
                total += result_bar[i, c] * part
            lobes_bar[i, k] = total

    return WeightedKernels(gather, spread, weights_adjoint, lobes_adjoint)
