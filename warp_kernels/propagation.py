"""One propagation step of a face stencil and its adjoint, both as gathers.

Forward (physics.md, "The chain" 5), S [W/sr] the moving intensity, for destination cell d and channel c:

    u_f   = sum_k W[f,k] S[c,k,d-n_f]                      flux through face f of the source cell d - n_f [W]
    Phi_a = sum_{f: axis a} p T[f,d-n_f] max(0, u_f)       flux per lobe axis
    S'[c,k,d] = sum_a lobe[a,k] Phi_a,   A[c,k,d] += S'[c,k,d]

Adjoint, G the adjoint of S', H[a,c,.] = sum_k lobe[a,k] G[c,k,.] (computed once per cell by the caller):

    m_f = p T[f,s] H[axis f,c,s+n_f] [u_f > 0]
    G_next[c,k,s] = Abar[c,k,s] + sum_f m_f W[f,k]
    Tbar[f,s] += sum_c p H max(0, u_f),   pbar[step,row] += sum_{f,c} T H max(0, u_f)

Faces come in antipodal pairs (f, f') = (2j, 2j+1): the even degrees of W are equal and the odd ones opposite, so the
adjoint evaluates both fluxes of a source cell with one set of products.

Layout: every field has a halo of one cell that stays zero, so there are no bounds checks: ``[C, K, n_z+2, n_y+2, row]``
with ``row = ceil(n_x / LANES) LANES + 2``; T likewise ``[F, n_z+2, n_y+2, row]`` and H ``[C, axes, n_z+2, n_y+2, row]``; all arrays are passed flat with at least
``LANES`` spare elements at the end, and S, S' and T must be zero in the halo.

Threads: one per (channel group, z, y) row on the CPU, one per cell on CUDA. Within a row the CPU works on ``LANES``
neighbouring cells at once (vector extension of the compiler that Warp brings along): Warp itself does not vectorise across
the threads of a CPU launch. The bodies are native snippets for that reason; there is nothing for Warp to differentiate.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import warp as wp

__all__ = ["CPU_LANES", "StepKernels", "step_kernels"]

CPU_LANES = 8  # 8 beat 4 and 16 on AVX2 and AVX-512 alike: 16 spills the 27 + 18 live vectors of HOLPV

_TYPES = """
#if defined(__CUDA_ARCH__)
    typedef SCALAR V;
#else
    typedef SCALAR V __attribute__((vector_size(LANES * sizeof(SCALAR)), aligned(sizeof(SCALAR))));
#endif
    const V zero = {};
    const SCALAR* w = weights.data;
    const long long plane = (long long)(z + 1) * pitch_y + (y + 1);
"""

_FORWARD = (
    _TYPES
    + """
    for (int x = x_begin; x < x_end; x += LANES) {
        const long long here = plane * pitch_x + x + 1;
        V flux[AXES * CHANNELS];
        for (int i = 0; i < AXES * CHANNELS; ++i) flux[i] = zero;
        for (int n = 0; n < neighbours; ++n) {
            const long long source = here - shift.data[n];
            V s[CHANNELS * COEFFS];
            for (int c = 0; c < CHANNELS; ++c)
                for (int k = 0; k < COEFFS; ++k)
                    s[c * COEFFS + k] = *(const V*)(moving.data + ((group * CHANNELS + c) * COEFFS + k) * cells + source);
            for (int i = first.data[n]; i < first.data[n + 1]; ++i) {
                const int f = face.data[i];
                V u[CHANNELS];
                for (int c = 0; c < CHANNELS; ++c) u[c] = s[c * COEFFS] * w[f * COEFFS];
                for (int k = 1; k < COEFFS; ++k)
                    for (int c = 0; c < CHANNELS; ++c) u[c] += s[c * COEFFS + k] * w[f * COEFFS + k];
                if (clamp)
                    for (int c = 0; c < CHANNELS; ++c) u[c] = u[c] > zero ? u[c] : zero;
                if (occluded) {
                    const V t = *(const V*)(transmittance.data + f * cells + source);
                    for (int c = 0; c < CHANNELS; ++c) u[c] *= t;
                }
                for (int c = 0; c < CHANNELS; ++c) flux[axis.data[f] * CHANNELS + c] += u[c];
            }
        }
        const SCALAR p = factor.data[step];
        for (int c = 0; c < CHANNELS; ++c)
            for (int k = 0; k < COEFFS; ++k) {
                V value = flux[c] * lobes.data[k];
                for (int a = 1; a < AXES; ++a) value += flux[a * CHANNELS + c] * lobes.data[a * COEFFS + k];
                value *= p;
                SCALAR* out = next.data + ((group * CHANNELS + c) * COEFFS + k) * cells + here;
                SCALAR* sum = accumulated.data + ((group * CHANNELS + c) * COEFFS + k) * cells + here;
                *(V*)out = value;
                *(V*)sum = *(const V*)sum + value;
                for (int lane = x_size - x; lane < LANES; ++lane) out[lane] = sum[lane] = 0;  // keep the halo zero
            }
    }
"""
)

_ADJOINT = (
    _TYPES
    + """
    V factor_sum = zero;
    for (int x = x_begin; x < x_end; x += LANES) {
        const long long here = plane * pitch_x + x + 1;
        V s[CHANNELS * COEFFS], g[CHANNELS * COEFFS];
        for (int c = 0; c < CHANNELS; ++c)
            for (int k = 0; k < COEFFS; ++k) {
                const long long at = ((group * CHANNELS + c) * COEFFS + k) * cells + here;
                g[c * COEFFS + k] = *(const V*)(accumulated_bar.data + at);
                if (need_flux) s[c * COEFFS + k] = *(const V*)(moving.data + at);
            }
        const SCALAR p = factor.data[step];
        for (int pair = 0; pair < pairs; ++pair) {
            const int f0 = 2 * pair, f1 = f0 + 1;
            const SCALAR* wf = w + f0 * COEFFS;
            V t0 = zero + 1, t1 = zero + 1, bar0 = zero, bar1 = zero;
            if (occluded) {
                t0 = *(const V*)(transmittance.data + f0 * cells + here);
                t1 = *(const V*)(transmittance.data + f1 * cells + here);
            }
            for (int c = 0; c < CHANNELS; ++c) {
                const SCALAR* h0 = lobe_bar.data + ((group * CHANNELS + c) * AXES + axis.data[f0]) * cells;
                const SCALAR* h1 = lobe_bar.data + ((group * CHANNELS + c) * AXES + axis.data[f1]) * cells;
                V m0 = *(const V*)(h0 + here + face_shift.data[f0]);
                V m1 = *(const V*)(h1 + here + face_shift.data[f1]);
                if (need_flux) {
                    V even = s[c * COEFFS] * wf[0], odd = zero;
                    for (int k = 1; k < COEFFS; ++k) {
                        if (ODD(k)) odd += s[c * COEFFS + k] * wf[k];
                        else even += s[c * COEFFS + k] * wf[k];
                    }
                    V u0 = even + odd, u1 = even - odd;
                    if (clamp) {
                        m0 = u0 > zero ? m0 : zero;
                        m1 = u1 > zero ? m1 : zero;
                    }
                    const V b0 = m0 * u0, b1 = m1 * u1;
                    bar0 += b0;
                    bar1 += b1;
                    factor_sum += b0 * t0 + b1 * t1;
                }
                m0 *= t0 * p;
                m1 *= t1 * p;
                const V even = m0 + m1, odd = m0 - m1;
                for (int k = 0; k < COEFFS; ++k) g[c * COEFFS + k] += (ODD(k) ? odd : even) * wf[k];
            }
            if (need_transmittance) {
                SCALAR* out0 = transmittance_bar.data + f0 * cells + here;
                SCALAR* out1 = transmittance_bar.data + f1 * cells + here;
                *(V*)out0 = *(const V*)out0 + bar0 * p;
                *(V*)out1 = *(const V*)out1 + bar1 * p;
            }
        }
        for (int c = 0; c < CHANNELS; ++c)
            for (int k = 0; k < COEFFS; ++k) {
                SCALAR* out = moving_bar.data + ((group * CHANNELS + c) * COEFFS + k) * cells + here;
                *(V*)out = g[c * COEFFS + k];
                for (int lane = x_size - x; lane < LANES; ++lane) out[lane] = 0;
            }
    }
    if (need_flux) {
        SCALAR* out = factor_bar.data + ((long long)step * groups * z_size + group * z_size + z) * y_size + y;
#if defined(__CUDA_ARCH__)
        atomicAdd(out, factor_sum);
#else
        for (int lane = 0; lane < LANES; ++lane) *out += factor_sum[lane];  // lanes beyond the row read a zero S
#endif
    }
"""
)


class StepKernels(NamedTuple):
    """Kernels of one specialisation; see the module for the arguments."""

    forward: Any
    adjoint: Any


@lru_cache
def step_kernels(scalar: Any, *, coeffs: int, axes: int, channels: int, lanes: int) -> StepKernels:
    """Kernels for a scalar type, K, number of lobe axes, channels per thread and lanes (1: a thread per cell, CUDA)."""
    names = {"SCALAR": "double" if scalar is wp.float64 else "float", "COEFFS": coeffs, "AXES": axes, "CHANNELS": channels}
    odd = "(((K) >= 1 && (K) <= 3) || (K) >= 9)"

    def specialise(snippet: str) -> str:
        for name, value in {**names, "LANES": lanes}.items():
            snippet = snippet.replace(name, str(value))
        return snippet.replace("ODD(k)", odd.replace("K", "k"))

    floats = wp.array(dtype=scalar)
    ints = wp.array(dtype=wp.int32)

    @wp.func_native(specialise(_FORWARD))
    def forward_row(
        moving: floats, next: floats, accumulated: floats, transmittance: floats, weights: floats, lobes: floats,
        factor: floats, shift: ints, first: ints, face: ints, axis: ints, neighbours: int, clamp: int, occluded: int,
        step: int, cells: wp.int64, pitch_y: int, pitch_x: int, x_size: int, x_begin: int, x_end: int,
        group: int, z: int, y: int,
    ): ...  # fmt: skip

    @wp.func_native(specialise(_ADJOINT))
    def adjoint_row(
        moving: floats, lobe_bar: floats, accumulated_bar: floats, moving_bar: floats, transmittance: floats,
        transmittance_bar: floats, factor_bar: floats, weights: floats, factor: floats, face_shift: ints, axis: ints,
        pairs: int, clamp: int, occluded: int, need_flux: int, need_transmittance: int, step: int, cells: wp.int64,
        pitch_y: int, pitch_x: int, groups: int, z_size: int, y_size: int, x_size: int, x_begin: int, x_end: int,
        group: int, z: int, y: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module="unique")
    def forward_step(
        moving: floats, next: floats, accumulated: floats, transmittance: floats, weights: floats, lobes: floats,
        factor: floats, shift: ints, first: ints, face: ints, axis: ints, neighbours: int, clamp: int, occluded: int,
        step: int, cells: wp.int64, pitch_y: int, pitch_x: int, z_size: int, y_size: int, x_size: int, row: int,
    ):  # fmt: skip
        line, x = wp.tid()
        line = line + row
        y = line % y_size
        z = (line // y_size) % z_size
        x_begin, x_end = wp.where(wp.static(lanes == 1), x, 0), wp.where(wp.static(lanes == 1), x + 1, x_size)
        forward_row(
            moving, next, accumulated, transmittance, weights, lobes, factor, shift, first, face, axis, neighbours,
            clamp, occluded, step, cells, pitch_y, pitch_x, x_size, x_begin, x_end, line // (y_size * z_size), z, y,
        )  # fmt: skip

    @wp.kernel(enable_backward=False, module="unique")
    def adjoint_step(
        moving: floats, lobe_bar: floats, accumulated_bar: floats, moving_bar: floats, transmittance: floats,
        transmittance_bar: floats, factor_bar: floats, weights: floats, factor: floats, face_shift: ints, axis: ints,
        pairs: int, clamp: int, occluded: int, need_flux: int, need_transmittance: int, step: int, cells: wp.int64,
        pitch_y: int, pitch_x: int, groups: int, z_size: int, y_size: int, x_size: int, row: int,
    ):  # fmt: skip
        line, x = wp.tid()
        line = line + row
        y = line % y_size
        z = (line // y_size) % z_size
        x_begin, x_end = wp.where(wp.static(lanes == 1), x, 0), wp.where(wp.static(lanes == 1), x + 1, x_size)
        adjoint_row(
            moving, lobe_bar, accumulated_bar, moving_bar, transmittance, transmittance_bar, factor_bar, weights,
            factor, face_shift, axis, pairs, clamp, occluded, need_flux, need_transmittance, step, cells, pitch_y,
            pitch_x, groups, z_size, y_size, x_size, x_begin, x_end, line // (y_size * z_size), z, y,
        )  # fmt: skip

    return StepKernels(forward_step, adjoint_step)
