"""Anisotropic footprints: the probes that are nearest to each point by their own metrics, and the adjoint of how near.

    d_j(x) = |M_j (x - p_j)|^2,    v = M_j (x - p_j):    xbar = 2 dbar M_j^T v,  pbar = -xbar,  Mbar = 2 dbar v (x - p_j)^T

Points look at all probes, or at those alone that their cell lists. With c the centre of a cell and h half its edges, for all x
in the cell

    | |M_j (x - p_j)| - |M_j (c - p_j)| | <= s_j = | |M_j| h |    (|M_j|: absolute values, entry by entry)

so a probe can only be among the k nearest where |M_j (c - p_j)| - s_j is at most the k-th least of |M_j (c - p_j)| + s_j. Both
are taken with a margin above rounding, so no result depends on the cells; probes are looked at in the order of their index, and
of those equally near the first ones count.

The k least so far are kept in order. ``list_cells`` and ``nearest_listed``, for the CPU and up to ``MOST_LISTED`` of them, keep
them in one vector (vector extension of the compiler that Warp brings along), where a new one is inserted without a branch:
an ordinary insertion has branches that no processor can predict, and takes three times as long. Their bodies are native
snippets for that reason. ``nearest_of_all`` is for CUDA and for more.

Shapes: position [n,3] m, metric [n,3,3] 1/m, spread s [n]; points [m,3] m; cells r_0 x r_1 x r_2, the last axis fastest, over a
``box`` [2,3] m (lowest corner, edges of a cell) that holds all points; ``lower`` [cells,n] is scratch, ``listed`` int32
[cells,n], of which ``length`` [cells] count; ``near`` int32 and ``distance`` [m,k], nearest first. The native ones take them
flat. Threads: ``list_cells`` one per cell, the others one per point; ``adjoint`` adds atomically into probes and metrics (in
point order on the CPU).
"""

# mypy: disable-error-code="valid-type"

import re
from functools import lru_cache
from typing import Any, NamedTuple

import warp as wp

__all__ = ["MOST_LISTED", "GaussianKernels", "gaussian_kernels"]

MOST_LISTED = 16
"""Probes that ``nearest_listed`` finds at most."""

# ``best`` and ``who``: the least values so far and whose they are. INSERT takes ``value`` of probe ``p``.
_START = """
    #pragma clang fp contract(fast)
    typedef SCALAR V __attribute__((vector_size(16 * sizeof(SCALAR))));
    typedef INTEGER I __attribute__((vector_size(16 * sizeof(SCALAR))));
    const I none = {};
    V best = (V){} + (SCALAR)INFINITY;
    I who = {};
"""
_INSERT = """
        const V given = (V){} + value;
        const I after = best > given;
        const I moves = __builtin_shufflevector(after, none, 16, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14);
        const V moved = __builtin_shufflevector(best, best, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14);
        const I whose = __builtin_shufflevector(who, who, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14);
        best = after ? (moves ? moved : given) : best;
        who = after ? (moves ? whose : none + p) : who;
"""
_SQUARE = """
        const SCALAR* m = metric.data + 9 * p;
        const SCALAR* q = position.data + 3 * p;
        const SCALAR dx = x - q[0], dy = y - q[1], dz = z - q[2];
        const SCALAR a = m[0] * dx + m[1] * dy + m[2] * dz;
        const SCALAR b = m[3] * dx + m[4] * dy + m[5] * dz;
        const SCALAR c = m[6] * dx + m[7] * dy + m[8] * dz;
        const SCALAR all = a * a + b * b + c * c;
        const SCALAR square = all < (SCALAR)FAR ? all : (SCALAR)FAR;
"""
_LIST = """
    START
    const int probes = spread.shape[0];
    const SCALAR half = 0.5;
    const SCALAR x = box.data[0] + (cell / (r1 * r2) + half) * box.data[3];
    const SCALAR y = box.data[1] + (cell / r2 % r1 + half) * box.data[4];
    const SCALAR z = box.data[2] + (cell % r2 + half) * box.data[5];
    SCALAR* low = lower.data + (long long)cell * probes;
    int* list = listed.data + (long long)cell * probes;
    for (int p = 0; p < probes; ++p) {
        SQUARE
        const SCALAR root = ::sqrt(square);
        const SCALAR value = root + spread.data[p];
        low[p] = root - spread.data[p];
        INSERT
    }
    const SCALAR most = best[count - 1] * (SCALAR)(1 + MARGIN);
    int kept = 0;
    for (int p = 0; p < probes; ++p) {
        list[kept] = p;
        kept += !(low[p] > most);
    }
    length.data[cell] = kept;
"""
_NEAREST = """
    START
    const SCALAR x = points.data[3 * row], y = points.data[3 * row + 1], z = points.data[3 * row + 2];
    const int i = (int)((x - box.data[0]) / box.data[3]), j = (int)((y - box.data[1]) / box.data[4]);
    const int k = (int)((z - box.data[2]) / box.data[5]);
    const int cell = ((i < r0 ? i : r0 - 1) * r1 + (j < r1 ? j : r1 - 1)) * r2 + (k < r2 ? k : r2 - 1);
    const int* list = listed.data + (long long)cell * (position.shape[0] / 3);
    const int listing = length.data[cell];
    for (int which = 0; which < listing; ++which) {
        const int p = list[which];
        SQUARE
        const SCALAR value = square;
        INSERT
    }
    for (int which = 0; which < count; ++which) {
        near.data[row * count + which] = who[which];
        distance.data[row * count + which] = best[which];
    }
"""


class GaussianKernels(NamedTuple):
    """Kernels and types of one scalar type."""

    list_cells: Any
    nearest_listed: Any
    nearest_of_all: Any
    adjoint: Any
    vec3: Any
    mat33: Any


@lru_cache
def gaussian_kernels(scalar: Any) -> GaussianKernels:
    """The kernels for ``wp.float32`` or ``wp.float64``."""
    fine = scalar is wp.float64
    module = wp.get_module(f"difflpv_gaussian_{scalar.__name__}")
    lanes = wp.get_module(f"difflpv_gaussian_lanes_{scalar.__name__}")  # of its own: CUDA does not know vector extensions
    vec3, mat33 = wp.types.vector(3, scalar), wp.types.matrix((3, 3), scalar)
    floats, ints = wp.array(dtype=scalar), wp.array(dtype=wp.int32)
    most = 1e300 if fine else 1e30  # what is farther counts as that far: differences stay finite
    far = wp.constant(scalar(most))

    def snippet(text: str) -> str:
        text = text.replace("START", _START).replace("INSERT", _INSERT).replace("SQUARE", _SQUARE)
        words = {"SCALAR": "double" if fine else "float", "INTEGER": "long long" if fine else "int"}
        words |= {"FAR": str(most), "MARGIN": "1e-9" if fine else "1e-3"}
        return re.sub(r"\b(SCALAR|INTEGER|FAR|MARGIN)\b", lambda found: words[found[0]], text)

    @wp.func_native(snippet(_LIST))
    def list_cell(
        position: floats, metric: floats, spread: floats, box: floats, r1: int, r2: int, count: int, lower: floats,
        listed: ints, length: ints, cell: int,
    ): ...  # fmt: skip

    @wp.func_native(snippet(_NEAREST))
    def nearest_of_list(
        position: floats, metric: floats, points: floats, box: floats, r0: int, r1: int, r2: int, count: int, listed: ints,
        length: ints, near: ints, distance: floats, row: int,
    ): ...  # fmt: skip

    @wp.kernel(module=lanes, enable_backward=False)
    def list_cells(
        position: floats, metric: floats, spread: floats, box: floats, r1: int, r2: int, count: int, lower: floats,
        listed: ints, length: ints,
    ):  # fmt: skip
        list_cell(position, metric, spread, box, r1, r2, count, lower, listed, length, wp.tid())

    @wp.kernel(module=lanes, enable_backward=False)
    def nearest_listed(
        position: floats, metric: floats, points: floats, box: floats, r0: int, r1: int, r2: int, count: int, listed: ints,
        length: ints, near: ints, distance: floats,
    ):  # fmt: skip
        nearest_of_list(position, metric, points, box, r0, r1, r2, count, listed, length, near, distance, wp.tid())

    @wp.kernel(module=module, enable_backward=False)
    def nearest_of_all(
        position: wp.array(dtype=vec3),
        metric: wp.array(dtype=mat33),
        points: wp.array(dtype=vec3),
        near: wp.array2d(dtype=wp.int32),
        distance: wp.array2d(dtype=scalar),
    ):
        row = wp.tid()
        count, held = near.shape[1], wp.int32(0)
        for p in range(position.shape[0]):
            d = wp.min(wp.length_sq(metric[p] * (points[row] - position[p])), far)
            if held < count or d < distance[row, count - 1]:
                at = wp.min(held, count - 1)
                for _ in range(count - 1):
                    if at > 0 and distance[row, wp.max(at - 1, 0)] > d:
                        distance[row, at] = distance[row, at - 1]
                        near[row, at] = near[row, at - 1]
                        at -= 1
                distance[row, at] = d
                near[row, at] = p
                held = wp.min(held + 1, count)

    @wp.kernel(module=module, enable_backward=False)
    def adjoint(
        position: wp.array(dtype=vec3),
        metric: wp.array(dtype=mat33),
        points: wp.array(dtype=vec3),
        near: wp.array2d(dtype=wp.int32),
        distance_bar: wp.array2d(dtype=scalar),
        position_bar: wp.array(dtype=vec3),
        metric_bar: wp.array(dtype=mat33),
        points_bar: wp.array(dtype=vec3),
    ):
        row = wp.tid()
        total = vec3()
        for which in range(near.shape[1]):
            p = near[row, which]
            m, offset = metric[p], points[row] - position[p]
            v = scalar(2.0) * distance_bar[row, which] * (m * offset)
            bar = wp.transpose(m) * v
            total += bar
            wp.atomic_add(position_bar, p, -bar)
            wp.atomic_add(metric_bar, p, wp.outer(v, offset))
        points_bar[row] = total

    return GaussianKernels(list_cells, nearest_listed, nearest_of_all, adjoint, vec3, mat33)
