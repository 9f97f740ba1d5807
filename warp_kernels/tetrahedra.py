"""Points in a tetrahedral grid: which simplex holds each, its barycentric weights, and their adjoint.

A tetrahedron of probes v_0..v_3 keeps the 3x3 matrix M whose rows are the gradients g_0..g_2 of its barycentric weights:

    b_k(x) = g_k . (x - v_3), k = 0, 1, 2;    b_3 = 1 - b_0 - b_1 - b_2;    g_3 = -g_0 - g_1 - g_2

Walk: while a weight is negative, step over the face opposite the most negative one; at a face of the hull the point is
outside. Sources: Cupisz, "Light probe interpolation using tetrahedral tessellations", GDC 2012; the probe thesis, 3.2.1. On a
regular triangulation such a walk ends (Edelsbrunner 1990); one that rounding turns back, that runs into its bound, or that
leaves through a hull that is not convex is followed by a look at every tetrahedron, so no result depends on the start:
on a shared face both sides give equal weights (within rounding), however the walk came.

Outside of the hull, the weights are those of the closest point of the hull's triangles (of each: its interior, then its edges),
found by a loop over all that a bounding sphere does not rule out. A triangle may be a segment (a, b, b) or a point (a, a, a).

Adjoint of the weights, for a simplex of any dimension that p = sum_k b_k v_k is the closest point of, g_k being the gradients
within it and r = x - p (0 in a tetrahedron). Differentiating the normal equations of min |x - sum b v|^2:

    db_i = g_i . (dx - sum_k b_k dv_k) + sum_k (g_i . g_k) r . dv_k
    h = sum_i bbar_i g_i:    xbar = h,    vbar_k = -b_k h + (h . g_k) r

Shapes: position vec3 [n] m, points vec3 [m] m; vertices, neighbours vec4i [t] (a neighbour below 0, -1 - f, is triangle f of
the hull); hull vec3i [f]; found [m] (tetrahedron, or -1 - f with f a triangle to look at first). ``probe`` vec4i and ``weight``
vec4 [m]: the simplex's vertices first, ``active`` [m] of them, then repetitions with weight 0. Threads: ``prepare_*`` one per
tetrahedron or triangle, the others one per point; ``adjoint`` adds atomically into the probes (in point order on the CPU).
"""

# mypy: disable-error-code="valid-type"

from functools import lru_cache
from typing import Any, NamedTuple

import warp as wp

__all__ = ["TetrahedraKernels", "tetrahedra_kernels"]


class TetrahedraKernels(NamedTuple):
    """Kernels and types of one scalar type."""

    prepare_tetrahedra: Any
    prepare_hull: Any
    locate: Any
    weigh: Any
    adjoint: Any
    vec3: Any
    vec4: Any
    mat33: Any
    vec3i: Any
    vec4i: Any


@lru_cache
def tetrahedra_kernels(scalar: Any) -> TetrahedraKernels:
    """The kernels for ``wp.float32`` or ``wp.float64``."""
    module = wp.get_module(f"difflpv_tetrahedra_{scalar.__name__}")
    vec3 = wp.types.vector(3, scalar)
    vec4 = wp.types.vector(4, scalar)
    mat33 = wp.types.matrix((3, 3), scalar)
    fine = scalar is wp.float64
    # How far below 0 a weight still counts as inside: at once, and after all tetrahedra were looked at (slivers round more).
    inside, nearly = wp.constant(scalar(1e-12 if fine else 1e-6)), wp.constant(scalar(1e-6 if fine else 1e-3))
    flat = wp.constant(scalar(1e-20 if fine else 1e-10))  # of a triangle: (twice its area / longest edge squared) squared

    @wp.func
    def rows_of(a: vec3, b: vec3, c: vec3, d: vec3):
        e0, e1, e2 = a - d, b - d, c - d
        g0 = wp.cross(e1, e2)
        scale = scalar(1.0) / wp.dot(e0, g0)
        return wp.matrix_from_rows(g0 * scale, wp.cross(e2, e0) * scale, wp.cross(e0, e1) * scale)

    @wp.func
    def coordinates(m: mat33, origin: vec3, x: vec3):
        b = m * (x - origin)
        return vec4(b[0], b[1], b[2], scalar(1.0) - b[0] - b[1] - b[2])

    @wp.func
    def lowest(b: vec4):
        k = wp.where(b[1] < b[0], 1, 0)  # without branches, which no processor could predict here
        low = wp.min(b[0], b[1])
        j = wp.where(b[3] < b[2], 3, 2)
        return wp.where(wp.min(b[2], b[3]) < low, j, k)

    @wp.func
    def along(x: vec3, a: vec3, b: vec3):
        e = b - a
        return wp.clamp(wp.dot(x - a, e) / wp.max(wp.dot(e, e), scalar(1e-37)), scalar(0.0), scalar(1.0))

    @wp.func
    def closest(x: vec3, a: vec3, b: vec3, c: vec3):
        """Weights of the closest point of triangle a, b, c."""
        ab, ac, d = b - a, c - a, x - a
        aa, bb, cc = wp.dot(ab, ab), wp.dot(ab, ac), wp.dot(ac, ac)
        size = aa * cc - bb * bb
        longest = wp.max(aa, cc)
        if size > flat * longest * longest:
            da, dc = wp.dot(d, ab), wp.dot(d, ac)
            u, v = (cc * da - bb * dc) / size, (aa * dc - bb * da) / size
            w = scalar(1.0) - u - v
            if u > scalar(0.0) and v > scalar(0.0) and w > scalar(0.0):
                return vec3(w, u, v)
        s, t, q = along(x, a, b), along(x, b, c), along(x, c, a)
        one = scalar(1.0)
        best = vec3(one - s, s, scalar(0.0))
        low = wp.length_sq(x - a - s * ab)
        second = wp.length_sq(x - b - t * (c - b))
        if second < low:
            low = second
            best = vec3(scalar(0.0), one - t, t)
        if wp.length_sq(x - c - q * (a - c)) < low:
            best = vec3(q, scalar(0.0), one - q)
        return best

    @wp.kernel(module=module, enable_backward=False)
    def prepare_tetrahedra(
        position: wp.array(dtype=vec3),
        vertices: wp.array(dtype=wp.vec4i),
        matrix: wp.array(dtype=mat33),
        origin: wp.array(dtype=vec3),
    ):
        t = wp.tid()
        v = vertices[t]
        origin[t] = position[v[3]]
        matrix[t] = rows_of(position[v[0]], position[v[1]], position[v[2]], position[v[3]])

    @wp.kernel(module=module, enable_backward=False)
    def prepare_hull(position: wp.array(dtype=vec3), hull: wp.array(dtype=wp.vec3i), sphere: wp.array(dtype=vec4)):
        f = wp.tid()
        v = hull[f]
        a, b, c = position[v[0]], position[v[1]], position[v[2]]
        centre = (a + b + c) / scalar(3.0)
        radius = wp.max(wp.length(a - centre), wp.max(wp.length(b - centre), wp.length(c - centre)))
        sphere[f] = vec4(centre[0], centre[1], centre[2], radius)

    @wp.kernel(module=module, enable_backward=False)
    def locate(
        points: wp.array(dtype=vec3),
        matrix: wp.array(dtype=mat33),
        origin: wp.array(dtype=vec3),
        neighbours: wp.array(dtype=wp.vec4i),
        start: wp.array(dtype=wp.int32),
        limit: int,
        convex: int,
        found: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        x = points[i]
        t, before, result = int(start[i]), wp.int32(-1), wp.int32(-1)
        search = wp.int32(1)
        for _step in range(limit):
            b = coordinates(matrix[t], origin[t], x)
            k = lowest(b)
            if b[k] >= -inside:
                result = t
                search = 0
                break
            over = int(neighbours[t][k])
            if over < 0:
                result = int(over)
                search = 1 - convex
                break
            if over == before:
                break
            before = t
            t = int(over)
        if search == 1:
            best = -nearly
            for other in range(matrix.shape[0]):
                b = coordinates(matrix[other], origin[other], x)
                low = wp.min(b)
                if low > best:
                    best = low
                    result = other
        found[i] = result

    @wp.kernel(module=module, enable_backward=False)
    def weigh(
        position: wp.array(dtype=vec3),
        points: wp.array(dtype=vec3),
        vertices: wp.array(dtype=wp.vec4i),
        hull: wp.array(dtype=wp.vec3i),
        matrix: wp.array(dtype=mat33),
        origin: wp.array(dtype=vec3),
        sphere: wp.array(dtype=vec4),
        found: wp.array(dtype=wp.int32),
        probe: wp.array(dtype=wp.vec4i),
        weight: wp.array(dtype=vec4),
        active: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        x = points[i]
        t = found[i]
        if t >= 0:
            probe[i] = vertices[t]
            weight[i] = coordinates(matrix[t], origin[t], x)
            active[i] = 4
            return
        chosen = -1 - t
        v = hull[chosen]
        w = closest(x, position[v[0]], position[v[1]], position[v[2]])
        least = wp.length(x - w[0] * position[v[0]] - w[1] * position[v[1]] - w[2] * position[v[2]])
        for f in range(hull.shape[0]):
            s = sphere[f]
            reach = least + s[3]
            if wp.length_sq(x - vec3(s[0], s[1], s[2])) < reach * reach:
                u = hull[f]
                trial = closest(x, position[u[0]], position[u[1]], position[u[2]])
                gap = wp.length(x - trial[0] * position[u[0]] - trial[1] * position[u[1]] - trial[2] * position[u[2]])
                if gap < least or (gap == least and f < chosen):
                    least = gap
                    chosen = f
                    w = trial
        v = hull[chosen]
        kept, values, count = wp.vec4i(), vec4(), wp.int32(0)
        for k in range(3):
            if w[k] > scalar(0.0):
                kept[count] = v[k]
                values[count] = w[k]
                count += 1
        for k in range(4):
            if k >= count:
                kept[k] = kept[0]
        probe[i] = kept
        weight[i] = values
        active[i] = count

    @wp.kernel(module=module, enable_backward=False)
    def adjoint(
        position: wp.array(dtype=vec3),
        points: wp.array(dtype=vec3),
        probe: wp.array(dtype=wp.vec4i),
        weight: wp.array(dtype=vec4),
        active: wp.array(dtype=wp.int32),
        weight_bar: wp.array(dtype=vec4),
        position_bar: wp.array(dtype=vec3),
        points_bar: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        v, b, bar, count = probe[i], weight[i], weight_bar[i], active[i]
        p0, p1, p2, p3 = position[v[0]], position[v[1]], position[v[2]], position[v[3]]
        g0, g1, g2, g3 = vec3(), vec3(), vec3(), vec3()
        if count == 4:
            m = rows_of(p0, p1, p2, p3)
            g0 = vec3(m[0, 0], m[0, 1], m[0, 2])
            g1 = vec3(m[1, 0], m[1, 1], m[1, 2])
            g2 = vec3(m[2, 0], m[2, 1], m[2, 2])
            g3 = -g0 - g1 - g2
        elif count == 3:
            ab, ac = p1 - p0, p2 - p0
            aa, bb, cc = wp.dot(ab, ab), wp.dot(ab, ac), wp.dot(ac, ac)
            scale = scalar(1.0) / (aa * cc - bb * bb)
            g1 = (cc * ab - bb * ac) * scale
            g2 = (aa * ac - bb * ab) * scale
            g0 = -g1 - g2
        elif count == 2:
            g1 = (p1 - p0) / wp.length_sq(p1 - p0)
            g0 = -g1
        h = bar[0] * g0 + bar[1] * g1 + bar[2] * g2 + bar[3] * g3
        points_bar[i] = h
        r = vec3()
        if count < 4:
            r = points[i] - b[0] * p0 - b[1] * p1 - b[2] * p2
        wp.atomic_add(position_bar, v[0], wp.dot(h, g0) * r - b[0] * h)
        if count > 1:
            wp.atomic_add(position_bar, v[1], wp.dot(h, g1) * r - b[1] * h)
        if count > 2:
            wp.atomic_add(position_bar, v[2], wp.dot(h, g2) * r - b[2] * h)
        if count > 3:
            wp.atomic_add(position_bar, v[3], wp.dot(h, g3) * r - b[3] * h)

    kernels = prepare_tetrahedra, prepare_hull, locate, weigh, adjoint
    return TetrahedraKernels(*kernels, vec3, vec4, mat33, wp.vec3i, wp.vec4i)
