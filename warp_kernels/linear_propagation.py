"""One propagation step of a linear stencil with occlusion, its adjoint, and the gradient of its matrices, all as gathers.

Step (physics.md, "The chain" 5, with one matrix per offset), S [W/sr] the moving intensity, for destination cell d:

    q[d]  = A_0 S[d] + sum_{pairs n > 0} A_n T[n,d-n] S[d-n] + A_{-n} T[n,d] S[d+n]
    S'[d] = p q[d],   A[d] += S'[d]

``nested`` is the same sum from the inside out, A' = S_0 + p q(A) with the last step first (Horner): no third buffer, for what
is added is the injected volume itself, ``accumulated`` [C,K,n_z,n_y,n_x] without a halo.

T[n,c] is the share that passes between c and c + n, the same both ways [1]. It is zero where c or c + n is outside.

Adjoint, G the adjoint of S': the same gather, for T belongs to the pair and not to its direction. Only the weights change:
A_0^T for A_0, A_{-n}^T for A_n, A_n^T for A_{-n}; what comes out is G_next[s] = Abar[s] + p q[s]. Besides

    pbar[step,row]   = sum <q[s], S[s]>
    Tbar[n,s]       += p <A_n^T G[s+n], S[s]>           the half of T[n,s] that this cell sees
    Tbar[P+n,s]     += p <A_{-n}^T G[s-n], S[s]>        the other half of T[n,s-n]: added up by the caller
    Abar_n          += p sum_d G[d] (T S[d-n])^T        (``matrices_kernel``)

Stencils that the cube's symmetries leave alone have A_{-n} = P A_n P with P = diag((-1)^l). Then with s = u + v, d = u - v
of the two arriving fields u, v each entry A_n[k,j] meets s_j where degrees k and j have equal parity and d_j elsewhere:
half the products (``paired``).

Layout: ``difflpv.padded``: rows of cells along x, all fields of a row together, a halo of one cell that stays zero, so there
are no bounds checks. Fields are (c, k) for volumes and n for T. Weights are [1 + 2P, K, K]: A_0, then A_n and A_{-n} of each
pair, destination from source coefficients.

Threads: one per (z, y) row on the CPU, ``lanes`` neighbouring cells at once, one per cell on CUDA; all channels in one
thread, for they share the gradient of T, but one after the other, so that the fields of a pair stay in registers.
``matrices_kernel``: one per (slab of rows, matrix), partial sums per slab, so that their order does not depend on the number
of threads. Snippets are native for the reasons given in ``warp_kernels.propagation``. Cells that no light has reached, or that
nothing reads, are left out (``warp_kernels.row_spans``).
"""

import re
from functools import lru_cache
from typing import Any

import warp as wp

from warp_kernels.row_spans import fill_spans

__all__ = ["cpu_lanes", "matrices_kernel", "step_kernel"]

# Warp's compiler does not contract a * b + c of a snippet into one instruction unless told to: a quarter of a step.
_TYPES = """
#if defined(__CUDA_ARCH__)
    typedef SCALAR V;
#else
    #pragma clang fp contract(fast)
    typedef SCALAR V __attribute__((vector_size(LANES * sizeof(SCALAR)), aligned(sizeof(SCALAR))));
#endif
    const V zero = {};
    const SCALAR p = factor.data[step];
    const long long volume_line = (long long)channels * COEFFS * pitch;
    const long long passed_line = (long long)pairs * pitch;
"""

_STEP = (
    _TYPES
    + """
    const SCALAR* w = weights.data;
    const long long line = (long long)(z + 1) * pitch_y + (y + 1);
    V factor_sum = zero;
    SPANS_BEGIN
    for (int c = 0; c < channels; ++c)
    for (int x = x_begin; x < x_end; x += LANES) {
        const long long at = line * volume_line + c * COEFFS * pitch + x + 1;
        SPANS_SKIP
        const long long source_pitch = (long long)z_size * y_size * x_size;
        const long long source = c * COEFFS * source_pitch + ((long long)z * y_size + y) * x_size + x;
#if !defined(__CUDA_ARCH__)
        if (NESTED)  // its fields lie far apart: a tenth of a step
            for (int k = 0; k < COEFFS; ++k) __builtin_prefetch(accumulated.data + source + k * source_pitch);
#endif
        V flux[COEFFS], u[COEFFS], v[COEFFS];
        #pragma unroll
        for (int k = 0; k < COEFFS; ++k) {
            flux[k] = zero;
            u[k] = *(const V*)(moving.data + at + k * pitch);
        }
        #pragma unroll
        for (int k = 0; k < COEFFS; ++k)
            #pragma unroll
            for (int j = 0; j < COEFFS; ++j) flux[k] += u[j] * w[k * COEFFS + j];
        for (int n = 0; n < pairs; ++n) {
            const long long shift = line_shift.data[n] * volume_line + x_shift.data[n];
            const SCALAR* a = w + (2 * n + 1) * COEFFS * COEFFS;
            const SCALAR* b = a + COEFFS * COEFFS;
            V t0 = zero, t1 = zero;
            if (OCCLUDED) {
                const SCALAR* passed = transmittance.data + line * passed_line + n * pitch + x + 1;
                t0 = *(const V*)(passed - line_shift.data[n] * passed_line - x_shift.data[n]);
                t1 = *(const V*)passed;
            }
            #pragma unroll
            for (int k = 0; k < COEFFS; ++k) {
                u[k] = *(const V*)(moving.data + at - shift + k * pitch);
                v[k] = *(const V*)(moving.data + at + shift + k * pitch);
                if (OCCLUDED && !NEED_TRANSMITTANCE) {
                    u[k] *= t0;
                    v[k] *= t1;
                }
                if (PAIRED && !NEED_TRANSMITTANCE) {
                    const V sum = u[k] + v[k];
                    v[k] = u[k] - v[k];
                    u[k] = sum;
                }
            }
            if (NEED_TRANSMITTANCE) {
                V bar0 = zero, bar1 = zero;
                #pragma unroll
                for (int k = 0; k < COEFFS; ++k) {
                    V q0 = u[0] * a[k * COEFFS], q1 = v[0] * b[k * COEFFS];
                    #pragma unroll
                    for (int j = 1; j < COEFFS; ++j) {
                        q0 += u[j] * a[k * COEFFS + j];
                        q1 += v[j] * b[k * COEFFS + j];
                    }
                    const V s = *(const V*)(before.data + at + k * pitch);
                    flux[k] += q0 * t0 + q1 * t1;
                    bar0 += q0 * s;
                    bar1 += q1 * s;
                }
                SCALAR* near = transmittance_bar.data + 2 * line * passed_line + n * pitch + x + 1;
                SCALAR* far = near + passed_line;
                *(V*)near = *(const V*)near + bar1 * p;
                *(V*)far = *(const V*)far + bar0 * p;
            } else
                #pragma unroll
                for (int k = 0; k < COEFFS; ++k)
                    #pragma unroll
                    for (int j = 0; j < COEFFS; ++j) {
                        if (PAIRED) flux[k] += (ODD(k) == ODD(j) ? u[j] : v[j]) * a[k * COEFFS + j];
                        else flux[k] += u[j] * a[k * COEFFS + j] + v[j] * b[k * COEFFS + j];
                    }
        }
        #pragma unroll
        for (int k = 0; k < COEFFS; ++k) {
            SCALAR* out = next.data + at + k * pitch;
            SCALAR* sum = accumulated.data + at + k * pitch;
            if (NEED_FACTOR) factor_sum += flux[k] * *(const V*)(before.data + at + k * pitch);
            V value = flux[k] * p;
            if (NESTED) {
                const long long from = source + k * source_pitch;
                if (from + LANES <= channels * COEFFS * source_pitch) value += *(const V*)(accumulated.data + from);
                else  // the end of the memory
                    for (int lane = 0; lane < x_size - x; ++lane) ((SCALAR*)&value)[lane] += accumulated.data[from + lane];
            }
            if (ADJOINT) value += *(const V*)sum;
            *(V*)out = value;
            if (!ADJOINT && !NESTED) *(V*)sum = *(const V*)sum + value;
            for (int lane = x_size - x; lane < LANES; ++lane) {  // keep the halo zero
                out[lane] = 0;
                if (!ADJOINT && !NESTED) sum[lane] = 0;
            }
            if (x == 0) out[-1] = 0;  // and make it so where ``next`` is fresh memory
            if (x + LANES >= x_size) out[LANES] = 0;
        }
        SPANS_NOTE
    }
    SPANS_END
    if (NEED_FACTOR) {
        SCALAR* out = factor_bar.data + ((long long)step * z_size + z) * y_size + y;
#if defined(__CUDA_ARCH__)
        atomicAdd(out, factor_sum);
#else
        for (int lane = 0; lane < LANES; ++lane) *out += factor_sum[lane];  // lanes beyond the row read a zero S
#endif
    }
"""
)

_MATRICES = (
    _TYPES
    + """
    const int n = (matrix - 1) / 2, side = matrix == 0 ? 0 : (matrix % 2 ? -1 : 1);  // S comes from d + side n
    const int lines = matrix ? line_shift.data[n] : 0, columns = matrix ? x_shift.data[n] : 0;
    const long long shift = side * (lines * volume_line + columns);
    const int rows = slab_rows, strip = x_size < 64 ? 64 / x_size : 1;  // rows that stay in cache while all blocks meet them
    V sums[COEFFS * COEFFS];  // block after block
    for (int i = 0; i < COEFFS * COEFFS; ++i) sums[i] = zero;
    for (int begin = 0; begin < rows; begin += strip)
    for (int k = 0; k < COEFFS; k += ROWS)
    for (int j = 0; j < COEFFS; j += COLUMNS) {
        V* block = sums + k * COEFFS + j * ROWS;
        V sum[ROWS * COLUMNS];
        #pragma unroll
        for (int i = 0; i < ROWS * COLUMNS; ++i) sum[i] = block[i];
        for (int row = begin; row < begin + strip && row < rows; ++row) {
            const int cell = slab * rows + row;
            const long long line = (long long)(cell / y_size + 1) * pitch_y + (cell % y_size + 1);
            const SCALAR* g = after.data + line * volume_line + k * pitch + 1;
            const SCALAR* s = before.data + line * volume_line + shift + j * pitch + 1;
            const SCALAR* passed = transmittance.data + line * passed_line + n * pitch + 1;
            if (side < 0) passed -= lines * passed_line + columns;
            for (int x = 0; x < x_size; x += LANES) {
                V t = zero;
                if (OCCLUDED && side) t = *(const V*)(passed + x);
                for (int c = 0; c < channels; ++c) {
                    const long long at = (long long)c * COEFFS * pitch + x;
                    V arriving[COLUMNS];
                    #pragma unroll
                    for (int i = 0; i < COLUMNS; ++i) {
                        arriving[i] = *(const V*)(s + at + i * pitch);
                        if (OCCLUDED && side) arriving[i] *= t;
                    }
                    #pragma unroll
                    for (int r = 0; r < ROWS; ++r) {
                        const V bar = *(const V*)(g + at + r * pitch);
                        #pragma unroll
                        for (int i = 0; i < COLUMNS; ++i) sum[r * COLUMNS + i] += bar * arriving[i];
                    }
                }
            }
        }
        #pragma unroll
        for (int i = 0; i < ROWS * COLUMNS; ++i) block[i] = sum[i];
    }
    SCALAR* out = partial.data + ((long long)slab * (2 * pairs + 1) + matrix) * COEFFS * COEFFS;
    const V* sum = sums;
    for (int k = 0; k < COEFFS; k += ROWS)
    for (int j = 0; j < COEFFS; j += COLUMNS)
        for (int r = 0; r < ROWS; ++r)
            for (int i = 0; i < COLUMNS; ++i, ++sum) {
#if defined(__CUDA_ARCH__)
                SCALAR total = *sum;
#else
                SCALAR total = 0;  // lanes beyond the row hold a zero adjoint
                for (int lane = 0; lane < LANES; ++lane) total += (*sum)[lane];
#endif
                out[(k + r) * COEFFS + j + i] += total * p;
            }
"""
)

# Rows and columns of a matrix whose sums stay in registers (27 of AVX-512's 32), measured: (8, 2) and (16, 1) were slower.
_BLOCKS = {1: (1, 1), 4: (4, 4), 9: (9, 3), 16: (4, 4)}


def cpu_lanes(scalar_bytes: int) -> int:
    """Cells that one CPU thread works on at once: 64 bytes; half of that took 1.1 to 1.9 times as long."""
    return 64 // scalar_bytes


def _snippet(text: str, scalar: Any, **constants: int) -> str:
    """``text`` with its compile-time constants filled in; flags as constants keep the inner loops free of branches."""
    text = re.sub(r"\bSCALAR\b", "double" if scalar is wp.float64 else "float", text)
    for name, value in constants.items():
        text = re.sub(rf"\b{name.upper()}\b", str(int(value)), text)
    return re.sub(r"ODD\((\w)\)", r"((\1 >= 1 && \1 <= 3) || \1 >= 9)", text)


@lru_cache
def step_kernel(
    scalar: Any, *, coeffs: int, lanes: int, paired: bool, occluded: bool, adjoint: bool = False, nested: bool = False,
    need_factor: bool = False, need_transmittance: bool = False,
) -> Any:  # fmt: skip
    """One step forward, or of the adjoint: scalar type, K, lanes (1: a thread per cell, CUDA), flags."""
    floats, ints = wp.array(dtype=scalar), wp.array(dtype=wp.int32)
    text = fill_spans(_STEP, used=lanes > 1 and not adjoint, group="0", fields=coeffs, at="at")
    text = _snippet(
        text, scalar, coeffs=coeffs, lanes=lanes, paired=paired, occluded=occluded, adjoint=adjoint,
        nested=nested, need_factor=need_factor, need_transmittance=need_transmittance,
    )  # fmt: skip

    @wp.func_native(text)
    def step_row(
        moving: floats, next: floats, accumulated: floats, transmittance: floats, before: floats, transmittance_bar: floats,
        factor_bar: floats, weights: floats, factor: floats, line_shift: ints, x_shift: ints, lit: ints, lit_next: ints,
        needed: ints, moved: floats, pairs: int, step: int,
        pitch_y: int, pitch: int, channels: int, z_size: int, y_size: int, x_size: int, x_begin: int, x_end: int, z: int,
        y: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module="unique")
    def propagate_linear(
        moving: floats, next: floats, accumulated: floats, transmittance: floats, before: floats, transmittance_bar: floats,
        factor_bar: floats, weights: floats, factor: floats, line_shift: ints, x_shift: ints, lit: ints, lit_next: ints,
        needed: ints, moved: floats, pairs: int, step: int,
        pitch_y: int, pitch: int, channels: int, z_size: int, y_size: int, x_size: int, row: int,
    ):  # fmt: skip
        line, x = wp.tid()
        line = line + row
        x_begin, x_end = wp.where(wp.static(lanes == 1), x, 0), wp.where(wp.static(lanes == 1), x + 1, x_size)
        step_row(
            moving, next, accumulated, transmittance, before, transmittance_bar, factor_bar, weights, factor, line_shift,
            x_shift, lit, lit_next, needed, moved, pairs, step, pitch_y, pitch, channels, z_size, y_size, x_size, x_begin,
            x_end, line // y_size, line % y_size,
        )  # fmt: skip

    return propagate_linear


@lru_cache
def matrices_kernel(scalar: Any, *, coeffs: int, lanes: int, occluded: bool) -> Any:
    """Adds one step's gradient of all matrices onto ``partial`` [slabs, 1 + 2P, K, K]."""
    floats, ints = wp.array(dtype=scalar), wp.array(dtype=wp.int32)
    rows, columns = _BLOCKS[coeffs]
    text = _snippet(
        _MATRICES, scalar, coeffs=coeffs, lanes=lanes, occluded=occluded, rows=rows, columns=columns
    )

    @wp.func_native(text)
    def matrices_slab(
        after: floats, before: floats, transmittance: floats, partial: floats, factor: floats, line_shift: ints,
        x_shift: ints, pairs: int, step: int, pitch_y: int, pitch: int, channels: int, slab_rows: int, y_size: int, x_size: int,
        slab: int, matrix: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module="unique")
    def propagate_linear_matrices(
        after: floats, before: floats, transmittance: floats, partial: floats, factor: floats, line_shift: ints,
        x_shift: ints, pairs: int, step: int, pitch_y: int, pitch: int, channels: int, slab_rows: int, y_size: int, x_size: int,
        first: int,
    ):  # fmt: skip
        slab, matrix = wp.tid()
        matrices_slab(
            after, before, transmittance, partial, factor, line_shift, x_shift, pairs, step, pitch_y, pitch, channels,
            slab_rows, y_size, x_size, slab + first, matrix,
        )  # fmt: skip

    return propagate_linear_matrices
