"""One propagation step of a face stencil and its adjoint, both as gathers.

Forward (physics.md, "The chain" 5), S [W/sr] the moving intensity, for destination cell d and channel c:

    u_f   = sum_k W[f,k] S[c,k,d-n_f]                      flux through face f of the source cell d - n_f [W]
    Phi_a = sum_{f: axis a} T[f,d-n_f] max(0, u_f)         flux per lobe axis
    S'[c,k,d] = p sum_a lobe[a,k] Phi_a,   A[c,k,d] += S'[c,k,d]

Adjoint, G the adjoint of S' and H[c,a,.] = sum_k lobe[a,k] G[c,k,.] its part along each lobe, for source cell s:

    m_f = T[f,s] H[c,axis f,s+n_f] [u_f > 0]
    G_next[c,k,s] = Abar[c,k,s] + p sum_f m_f W[f,k],   H_next from it
    Tbar[f,s] += p sum_c H max(0, u_f),   pbar[step,row] += sum_{f,c} T H max(0, u_f)

Only H passes from one adjoint step to the next; the sweep starts with no faces (``pairs`` = 0), which leaves H of Abar.
Faces come in antipodal pairs (2j, 2j+1): the even degrees of W are equal and the odd ones opposite, so the adjoint
evaluates both fluxes of a source cell with one set of products.

Layout: ``difflpv.padded``: rows of cells along x, all fields of a row together, a halo of one cell that stays zero, so there
are no bounds checks. Fields are (c, k) for volumes, f for T, (c, a) for H. The forward step reads T where it arrives,
``arriving[i,d]`` = T[f,d-n_f] with i the place of f in ``face``, so that every row is read in order. Arrays are passed flat
with at least ``LANES`` spare elements at the end.

Threads: one per (channel group, z, y) row on the CPU, one per cell on CUDA. Within a row the CPU works on ``LANES``
neighbouring cells at once (vector extension of the compiler that Warp brings along): Warp itself does not vectorise across
the threads of a CPU launch. The bodies are native snippets for that reason; there is nothing for Warp to differentiate.
Cells that no light has reached, or that nothing reads, are left out (``warp_kernels.row_spans``).
"""

import re
from functools import lru_cache
from typing import Any, NamedTuple

import warp as wp

from warp_kernels.row_spans import fill_spans

__all__ = ["CPU_LANES", "adjoint_kernel", "forward_kernel"]

CPU_LANES = 8  # 8 beat 4 and 16 on AVX2 and AVX-512 alike: 16 spills the 27 + 18 live vectors of HOLPV

# Warp's compiler does not contract a * b + c of a snippet into one instruction unless told to: 5 to 15 % of a step.
_TYPES = """
#if defined(__CUDA_ARCH__)
    typedef SCALAR V;
#else
    #pragma clang fp contract(fast)
    typedef SCALAR V __attribute__((vector_size(LANES * sizeof(SCALAR)), aligned(sizeof(SCALAR))));
#endif
    const V zero = {};
    const SCALAR* w = weights.data;
    const SCALAR p = factor.data[step];
    const long long line = (long long)(z + 1) * pitch_y + (y + 1);
    const long long volume_line = (long long)groups * CHANNELS * COEFFS * pitch;
    const long long passed_line = (long long)faces * pitch;
    const long long volume_at = line * volume_line + group * CHANNELS * COEFFS * pitch;
"""

_FORWARD = (
    _TYPES
    + """
    SPANS_BEGIN
    for (int x = x_begin; x < x_end; x += LANES) {
        SPANS_SKIP
        V flux[AXES * CHANNELS];
        #pragma unroll
        for (int i = 0; i < AXES * CHANNELS; ++i) flux[i] = zero;
        const SCALAR* passed = arriving.data + line * passed_line + x + 1;
        for (int n = 0; n < neighbours; ++n) {
            const SCALAR* source = moving.data + volume_at - line_shift.data[n] * volume_line + x + 1 - x_shift.data[n];
            V s[CHANNELS * COEFFS];
            #pragma unroll
            for (int i = 0; i < CHANNELS * COEFFS; ++i) s[i] = *(const V*)(source + i * pitch);
            for (int i = first.data[n]; i < first.data[n + 1]; ++i) {
                const int f = face.data[i];
                V u[CHANNELS];
                #pragma unroll
                for (int c = 0; c < CHANNELS; ++c) u[c] = s[c * COEFFS] * w[f * COEFFS];
                #pragma unroll
                for (int k = 1; k < COEFFS; ++k)
                    #pragma unroll
                    for (int c = 0; c < CHANNELS; ++c) u[c] += s[c * COEFFS + k] * w[f * COEFFS + k];
                if (CLAMP)
                    #pragma unroll
                    for (int c = 0; c < CHANNELS; ++c) u[c] = u[c] > zero ? u[c] : zero;
                if (OCCLUDED) {
                    const V t = *(const V*)(passed + i * pitch);
                    #pragma unroll
                    for (int c = 0; c < CHANNELS; ++c) u[c] *= t;
                }
                #pragma unroll
                for (int c = 0; c < CHANNELS; ++c) flux[axis.data[f] * CHANNELS + c] += u[c];
            }
        }
        #pragma unroll
        for (int c = 0; c < CHANNELS; ++c)
            #pragma unroll
            for (int k = 0; k < COEFFS; ++k) {
                V value = flux[c] * lobes.data[k];
                #pragma unroll
                for (int a = 1; a < AXES; ++a) value += flux[a * CHANNELS + c] * lobes.data[a * COEFFS + k];
                value *= p;
                SCALAR* out = next.data + volume_at + (c * COEFFS + k) * pitch + x + 1;
                SCALAR* sum = accumulated.data + volume_at + (c * COEFFS + k) * pitch + x + 1;
                *(V*)out = value;
                *(V*)sum = *(const V*)sum + value;
                for (int lane = x_size - x; lane < LANES; ++lane) out[lane] = sum[lane] = 0;  // keep the halo zero
                if (x == 0) out[-1] = 0;  // and make it so where ``next`` is fresh memory
                if (x + LANES >= x_size) out[LANES] = 0;
            }
        SPANS_NOTE
    }
    SPANS_END
"""
)

_ADJOINT = (
    _TYPES
    + """
    const long long lobe_line = (long long)groups * CHANNELS * AXES * pitch;
    const long long lobe_at = line * lobe_line + group * CHANNELS * AXES * pitch;
    V factor_sum = zero;
    for (int x = x_begin; x < x_end; x += LANES) {
        V s[CHANNELS * COEFFS], g[CHANNELS * COEFFS];
        #pragma unroll
        for (int i = 0; i < CHANNELS * COEFFS; ++i) {
            g[i] = zero;
            if (NEED_FLUX) s[i] = *(const V*)(moving.data + volume_at + i * pitch + x + 1);
        }
        const SCALAR* passed = transmittance.data + line * passed_line + x + 1;
        SCALAR* passed_bar = transmittance_bar.data + line * passed_line + x + 1;
        for (int pair = 0; pair < pairs; ++pair) {
            const int f0 = 2 * pair, f1 = f0 + 1, n = face_neighbour.data[f0];
            const SCALAR* wf = w + f0 * COEFFS;
            const long long shift = line_shift.data[n] * lobe_line + x_shift.data[n];
            const SCALAR* h0 = lobe_bar.data + lobe_at + shift + axis.data[f0] * pitch + x + 1;
            const SCALAR* h1 = lobe_bar.data + lobe_at - shift + axis.data[f1] * pitch + x + 1;
            V t0, t1, bar0 = zero, bar1 = zero;
            if (OCCLUDED) {
                t0 = *(const V*)(passed + f0 * pitch);
                t1 = *(const V*)(passed + f1 * pitch);
            }
            #pragma unroll
            for (int c = 0; c < CHANNELS; ++c) {
                V m0 = *(const V*)(h0 + c * AXES * pitch);
                V m1 = *(const V*)(h1 + c * AXES * pitch);
                if (NEED_FLUX) {
                    V even = s[c * COEFFS] * wf[0], odd = zero;
                    #pragma unroll
                    for (int k = 1; k < COEFFS; ++k) {
                        if (ODD(k)) odd += s[c * COEFFS + k] * wf[k];
                        else even += s[c * COEFFS + k] * wf[k];
                    }
                    const V u0 = even + odd, u1 = even - odd;
                    if (CLAMP) {
                        m0 = u0 > zero ? m0 : zero;
                        m1 = u1 > zero ? m1 : zero;
                    }
                    if (NEED_FACTOR) {
                        bar0 += m0 * u0;
                        bar1 += m1 * u1;
                    }
                }
                if (OCCLUDED) {
                    m0 *= t0;
                    m1 *= t1;
                }
                const V even = m0 + m1, odd = m0 - m1;
                #pragma unroll
                for (int k = 0; k < COEFFS; ++k) g[c * COEFFS + k] += (ODD(k) ? odd : even) * wf[k];
            }
            if (NEED_FACTOR) factor_sum += OCCLUDED ? bar0 * t0 + bar1 * t1 : bar0 + bar1;
            if (NEED_TRANSMITTANCE) {
                *(V*)(passed_bar + f0 * pitch) = *(const V*)(passed_bar + f0 * pitch) + bar0 * p;
                *(V*)(passed_bar + f1 * pitch) = *(const V*)(passed_bar + f1 * pitch) + bar1 * p;
            }
        }
        #pragma unroll
        for (int i = 0; i < CHANNELS * COEFFS; ++i) {
            const long long at = volume_at + i * pitch + x + 1;
            g[i] = *(const V*)(accumulated_bar.data + at) + g[i] * p;
            if (write_volume) *(V*)(volume_bar.data + at) = g[i];
        }
        #pragma unroll
        for (int c = 0; c < CHANNELS; ++c)
            #pragma unroll
            for (int a = 0; a < AXES; ++a) {
                V value = g[c * COEFFS] * lobes.data[a * COEFFS];
                #pragma unroll
                for (int k = 1; k < COEFFS; ++k) value += g[c * COEFFS + k] * lobes.data[a * COEFFS + k];
                SCALAR* out = lobe_bar_next.data + lobe_at + (c * AXES + a) * pitch + x + 1;
                *(V*)out = value;
                for (int lane = x_size - x; lane < LANES; ++lane) out[lane] = 0;
            }
    }
    if (NEED_FACTOR) {
        SCALAR* out = factor_bar.data + ((long long)step * groups * z_size + group * z_size + z) * y_size + y;
#if defined(__CUDA_ARCH__)
        atomicAdd(out, factor_sum);
#else
        for (int lane = 0; lane < LANES; ++lane) *out += factor_sum[lane];  // lanes beyond the row read a zero S
#endif
    }
"""
)


class _Spec(NamedTuple):
    """What a kernel is compiled for; flags are compile-time constants, which doubles the adjoint's speed."""

    scalar: Any
    coeffs: int
    axes: int
    channels: int
    lanes: int
    clamp: bool
    occluded: bool
    need_factor: bool = False
    need_transmittance: bool = False

    def snippet(self, text: str) -> str:
        constants = {
            "SCALAR": "double" if self.scalar is wp.float64 else "float",
            "COEFFS": self.coeffs,
            "AXES": self.axes,
            "CHANNELS": self.channels,
            "LANES": self.lanes,
            "CLAMP": int(self.clamp),
            "OCCLUDED": int(self.occluded),
            "NEED_FLUX": int(self.clamp or self.need_factor or self.need_transmittance),
            "NEED_FACTOR": int(self.need_factor or self.need_transmittance),
            "NEED_TRANSMITTANCE": int(self.need_transmittance),
        }
        for name, value in constants.items():
            text = re.sub(rf"\b{name}\b", str(value), text)
        return text.replace("ODD(k)", "((k >= 1 && k <= 3) || k >= 9)")


@lru_cache
def forward_kernel(
    scalar: Any, *, coeffs: int, axes: int, channels: int, lanes: int, clamp: bool, occluded: bool
) -> Any:
    """One step forward: scalar type, K, lobe axes, channels per thread, lanes (1: a thread per cell, CUDA), flags."""
    floats, ints = wp.array(dtype=scalar), wp.array(dtype=wp.int32)

    text = fill_spans(_FORWARD, used=lanes > 1, group="group", fields=channels * coeffs, at="volume_at + x + 1")

    @wp.func_native(_Spec(scalar, coeffs, axes, channels, lanes, clamp, occluded).snippet(text))
    def forward_row(
        moving: floats, next: floats, accumulated: floats, arriving: floats, weights: floats, lobes: floats,
        factor: floats, line_shift: ints, x_shift: ints, first: ints, face: ints, axis: ints, lit: ints, lit_next: ints,
        needed: ints, moved: floats, neighbours: int, faces: int, step: int, pitch_y: int, pitch: int, groups: int, z_size: int,
        y_size: int, x_size: int, x_begin: int, x_end: int, group: int, z: int, y: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module="unique")
    def propagate_forward(
        moving: floats, next: floats, accumulated: floats, arriving: floats, weights: floats, lobes: floats,
        factor: floats, line_shift: ints, x_shift: ints, first: ints, face: ints, axis: ints, lit: ints, lit_next: ints,
        needed: ints, moved: floats, neighbours: int, faces: int, step: int, pitch_y: int, pitch: int, groups: int, z_size: int,
        y_size: int, x_size: int, row: int,
    ):  # fmt: skip
        line, x = wp.tid()
        line = line + row
        y = line % y_size
        z = (line // y_size) % z_size
        x_begin, x_end = wp.where(wp.static(lanes == 1), x, 0), wp.where(wp.static(lanes == 1), x + 1, x_size)
        forward_row(
            moving, next, accumulated, arriving, weights, lobes, factor, line_shift, x_shift, first, face, axis, lit,
            lit_next, needed, moved, neighbours, faces, step, pitch_y, pitch, groups, z_size, y_size, x_size, x_begin, x_end,
            line // (y_size * z_size), z, y,
        )  # fmt: skip

    return propagate_forward


@lru_cache
def adjoint_kernel(
    scalar: Any, *, coeffs: int, axes: int, channels: int, lanes: int, clamp: bool, occluded: bool, need_factor: bool,
    need_transmittance: bool,
) -> Any:  # fmt: skip
    """One step of the adjoint; ``need_transmittance`` implies the factor's gradient."""
    floats, ints = wp.array(dtype=scalar), wp.array(dtype=wp.int32)
    spec = _Spec(scalar, coeffs, axes, channels, lanes, clamp, occluded, need_factor, need_transmittance)

    @wp.func_native(spec.snippet(_ADJOINT))
    def adjoint_row(
        moving: floats, lobe_bar: floats, lobe_bar_next: floats, accumulated_bar: floats, volume_bar: floats,
        transmittance: floats, transmittance_bar: floats, factor_bar: floats, weights: floats, lobes: floats,
        factor: floats, line_shift: ints, x_shift: ints, face_neighbour: ints, axis: ints, pairs: int, faces: int,
        write_volume: int, step: int, pitch_y: int, pitch: int, groups: int, z_size: int, y_size: int, x_size: int,
        x_begin: int, x_end: int, group: int, z: int, y: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module="unique")
    def propagate_adjoint(
        moving: floats, lobe_bar: floats, lobe_bar_next: floats, accumulated_bar: floats, volume_bar: floats,
        transmittance: floats, transmittance_bar: floats, factor_bar: floats, weights: floats, lobes: floats,
        factor: floats, line_shift: ints, x_shift: ints, face_neighbour: ints, axis: ints, pairs: int, faces: int,
        write_volume: int, step: int, pitch_y: int, pitch: int, groups: int, z_size: int, y_size: int, x_size: int,
        row: int,
    ):  # fmt: skip
        line, x = wp.tid()
        line = line + row
        y = line % y_size
        z = (line // y_size) % z_size
        x_begin, x_end = wp.where(wp.static(lanes == 1), x, 0), wp.where(wp.static(lanes == 1), x + 1, x_size)
        adjoint_row(
            moving, lobe_bar, lobe_bar_next, accumulated_bar, volume_bar, transmittance, transmittance_bar, factor_bar,
            weights, lobes, factor, line_shift, x_shift, face_neighbour, axis, pairs, faces, write_volume, step, pitch_y,
            pitch, groups, z_size, y_size, x_size, x_begin, x_end, line // (y_size * z_size), z, y,
        )  # fmt: skip

    return propagate_adjoint
