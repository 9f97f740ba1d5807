"""Mean over the corners that two neighbouring cells share, and its adjoint, both as gathers.

Forward, face f of the stencil with neighbour offset d_f (entries -1, 0, 1), source cell s, P a field per face on
the corner lattice (cell i lies between corners i and i + 1):

    B[f,s] = mean of P[f,q] over the corners q between the centres of s and s + d_f

Per axis: d = 0 takes corners s and s + 1, d = 1 takes s + 1, d = -1 takes s. So a face neighbour has 4 corners, an edge
neighbour 2, a corner neighbour 1; all exist, also where s + d_f lies outside the grid.

Adjoint: Pbar[f,q] = 1/count_f sum of Bbar[f,s] over the cells s that read q: per axis d = 0 is q - 1 and q, d = 1
is q - 1, d = -1 is q, inside the grid.

Shapes: corners P [F, n_z+1, n_y+1, n_x+1]; mean B [F, n_z, n_y, n_x]; offsets [F,3] (x, y, z), int32. Threads: one per
element of the result.
"""

# mypy: disable-error-code="valid-type"

from functools import lru_cache
from typing import Any, NamedTuple

import warp as wp

__all__ = ["OcclusionKernels", "occlusion_kernels"]


class OcclusionKernels(NamedTuple):
    """Kernels of one scalar type."""

    forward: Any
    adjoint: Any


@lru_cache
def occlusion_kernels(scalar: Any) -> OcclusionKernels:
    """The kernels for ``wp.float32`` or ``wp.float64``."""
    module = wp.get_module(f"difflpv_occlusion_{scalar.__name__}")

    @wp.func
    def corner_count(offsets: wp.array2d(dtype=wp.int32), f: int):
        shared_axes = wp.abs(offsets[f, 0]) + wp.abs(offsets[f, 1]) + wp.abs(offsets[f, 2])
        return scalar(8 >> shared_axes)

    @wp.kernel(module=module, enable_backward=False)
    def forward(corners: wp.array4d(dtype=scalar), offsets: wp.array2d(dtype=wp.int32), mean: wp.array4d(dtype=scalar)):
        f, z, y, x = wp.tid()
        dx = offsets[f, 0]
        dy = offsets[f, 1]
        dz = offsets[f, 2]
        total = scalar(0.0)
        for qz in range(z + wp.max(dz, 0), z + 2 + wp.min(dz, 0)):
            for qy in range(y + wp.max(dy, 0), y + 2 + wp.min(dy, 0)):
                for qx in range(x + wp.max(dx, 0), x + 2 + wp.min(dx, 0)):
                    total += corners[f, qz, qy, qx]
        mean[f, z, y, x] = total / corner_count(offsets, f)

    @wp.kernel(module=module, enable_backward=False)
    def adjoint(mean_bar: wp.array4d(dtype=scalar), offsets: wp.array2d(dtype=wp.int32), corners_bar:
    wp.array4d(dtype=scalar)):
        f, z, y, x = wp.tid()
        dx = offsets[f, 0]
        dy = offsets[f, 1]
        dz = offsets[f, 2]
        total = scalar(0.0)
        for sz in range(wp.max(z - 1 - wp.min(dz, 0), 0), wp.min(z + 1 - wp.max(dz, 0), mean_bar.shape[1])):
            for sy in range(wp.max(y - 1 - wp.min(dy, 0), 0), wp.min(y + 1 - wp.max(dy, 0), mean_bar.shape[2])):
                for sx in range(wp.max(x - 1 - wp.min(dx, 0), 0), wp.min(x + 1 - wp.max(dx, 0), mean_bar.shape[3])):
                    total += mean_bar[f, sz, sy, sx]
        corners_bar[f, z, y, x] = total / corner_count(offsets, f)

    return OcclusionKernels(forward, adjoint)
