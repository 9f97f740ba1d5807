"""The equations of ``warp_kernels.weighted`` on volumes with all numbers of a cell side by side, for many points on the CPU.

In a volume [C, K, cells] the numbers of one cell lie as many cells apart, and a point touches C K cache lines for each cell
that it reads. Where points are many, the volume is turned once into rows, and each cell is then a few vectors. What is read
are rows ``[cells, C K]`` with ``LANES`` spare elements at the end, for the last vector reaches into the next row; ``spread``
adds to rows ``[cells, pitch]``, ``pitch`` = C K rounded up to ``LANES``, zeros at their ends.

Threads: ``gather``, ``lobes_adjoint``, ``weights_adjoint``: one per ``POINTS`` points. ``spread``: one per range of cells, each
going through all points and adding to its own cells alone: in the order of the points, for any number of threads. Weights of
zero are multiplied like others: geometry scatters them, and a branch that is guessed wrong costs more than a row.
"""

# mypy: disable-error-code="valid-type"

import re
from functools import lru_cache
from typing import Any, NamedTuple

import warp as wp

__all__ = ["POINTS", "CellRowKernels", "cell_row_kernels", "row_lanes"]

POINTS = 256  # of one thread: few enough to share out, many enough to hide the cost of a thread
_BYTES = 32  # a vector: 64 were as fast and pad 27 numbers no better

_TYPES = """
    #pragma clang fp contract(fast)
    typedef SCALAR V __attribute__((vector_size(LANES * sizeof(SCALAR)), aligned(sizeof(SCALAR))));
    const V zero = {};
"""
_OF_POINTS = (
    _TYPES
    + """
    const int end = count < (item + 1) * POINTS ? count : (item + 1) * POINTS;
    for (int point = item * POINTS; point < end; ++point) {
        const int* cell = cells.data + (long long)point * reads;
"""
)
_HELD = """
        V held[PARTS];
        for (int i = 0; i < PARTS; ++i) held[i] = zero;
        const int ahead = point + 1 < count ? reads : 0;
        for (int j = 0; j < reads; ++j) {
            const SCALAR weight = weights.data[(long long)point * reads + j];
            const SCALAR* row = rows.data + (long long)cell[j] * (CHANNELS * COEFFS);
            const SCALAR* soon = rows.data + (long long)cell[j + ahead] * (CHANNELS * COEFFS);
            for (int i = 0; i < PARTS; i += 2) __builtin_prefetch(soon + i * LANES);
            #pragma unroll
            for (int i = 0; i < PARTS; ++i) held[i] += *(const V*)(row + i * LANES) * weight;
        }
        const SCALAR* radiance = (const SCALAR*)held;
"""
_LOBE_OF_FLUX = """
        V carried[PARTS];
        for (int i = 0; i < PARTS; ++i) carried[i] = zero;
        #pragma unroll
        for (int c = 0; c < CHANNELS; ++c)
            #pragma unroll
            for (int k = 0; k < COEFFS; ++k)
                ((SCALAR*)carried)[c * COEFFS + k] =
                    flux.data[(long long)point * CHANNELS + c] * lobes.data[(long long)point * COEFFS + k];
"""
_GATHER = (
    _OF_POINTS
    + _HELD
    + """
        const SCALAR* lobe = lobes.data + (long long)point * COEFFS;
        #pragma unroll
        for (int c = 0; c < CHANNELS; ++c) {
            SCALAR sum = 0;
            #pragma unroll
            for (int k = 0; k < COEFFS; ++k) sum += lobe[k] * radiance[c * COEFFS + k];
            out.data[(long long)point * CHANNELS + c] = sum;
        }
    }
"""
)
_LOBES = (
    _OF_POINTS
    + _HELD
    + """
        const SCALAR* bar = flux.data + (long long)point * CHANNELS;
        #pragma unroll
        for (int k = 0; k < COEFFS; ++k) {
            SCALAR sum = 0;
            #pragma unroll
            for (int c = 0; c < CHANNELS; ++c) sum += bar[c] * radiance[c * COEFFS + k];
            out.data[(long long)point * COEFFS + k] = sum;
        }
    }
"""
)
_WEIGHTS = (
    _OF_POINTS
    + _LOBE_OF_FLUX
    + """
        for (int j = 0; j < reads; ++j) {
            const SCALAR* row = rows.data + (long long)cell[j] * (CHANNELS * COEFFS);
            V products = zero;
            #pragma unroll
            for (int i = 0; i < PARTS; ++i) products += *(const V*)(row + i * LANES) * carried[i];
            SCALAR sum = 0;
            for (int lane = 0; lane < LANES; ++lane) sum += products[lane];
            out.data[(long long)point * reads + j] = sum;
        }
    }
"""
)
_SPREAD = (
    _TYPES
    + """
    const int first = (long long)cell_count * item / ranges, last = (long long)cell_count * (item + 1) / ranges;
    for (int point = 0; point < count; ++point) {
        const int* cell = cells.data + (long long)point * reads;
"""
    + _LOBE_OF_FLUX
    + """
        for (int j = 0; j < reads; ++j) {
            const SCALAR weight = weights.data[(long long)point * reads + j];
            if (cell[j] < first || cell[j] >= last) continue;
            SCALAR* row = rows.data + (long long)cell[j] * (PARTS * LANES);
            #pragma unroll
            for (int i = 0; i < PARTS; ++i) *(V*)(row + i * LANES) = *(const V*)(row + i * LANES) + carried[i] * weight;
        }
    }
"""
)


class CellRowKernels(NamedTuple):
    """Kernels of one scalar type and shape, all with the same arguments; an array that one does not use may be empty."""

    gather: Any
    spread: Any
    weights_adjoint: Any
    lobes_adjoint: Any


def row_lanes(scalar_bytes: int) -> int:
    """Numbers of a vector."""
    return _BYTES // scalar_bytes


@lru_cache
def cell_row_kernels(scalar: Any, *, channels: int, coeffs: int) -> CellRowKernels:
    """The kernels for ``wp.float32`` or ``wp.float64``, C channels and K coefficients."""
    lanes = row_lanes(8 if scalar is wp.float64 else 4)
    constants = {
        "SCALAR": "double" if scalar is wp.float64 else "float", "CHANNELS": channels, "COEFFS": coeffs, "LANES": lanes,
        "PARTS": -(-channels * coeffs // lanes), "POINTS": POINTS,
    }  # fmt: skip
    floats, ints = wp.array(dtype=scalar), wp.array(dtype=wp.int32)

    def kernel(text: str) -> Any:
        for name, value in constants.items():
            text = re.sub(rf"\b{name}\b", str(value), text)

        @wp.func_native(text)
        def part(
            rows: floats, cells: ints, weights: floats, lobes: floats, flux: floats, out: floats, reads: int, count: int,
            cell_count: int, ranges: int, item: int,
        ): ...  # fmt: skip

        @wp.kernel(enable_backward=False, module="unique")
        def on_cell_rows(
            rows: floats, cells: ints, weights: floats, lobes: floats, flux: floats, out: floats, reads: int, count: int,
            cell_count: int, ranges: int, first_item: int,
        ):  # fmt: skip
            item, one = wp.tid()
            part(
                rows, cells, weights, lobes, flux, out, reads, count, cell_count, ranges, first_item + item
            )

        return on_cell_rows

    return CellRowKernels(kernel(_GATHER), kernel(_SPREAD), kernel(_WEIGHTS), kernel(_LOBES))
