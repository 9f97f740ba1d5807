"""Receivers: points on surfaces, drawn by area, with the normal on the side where light can be.

Which side of a two-sided triangle is asked for is decided by light, in a grey twin of the scene (every albedo 1/2, so
that no material hides a place): a side counts as lit when a few paths of up to six reflections bring it at least 1 % of
what the other side gets.

1. One side lit: that side.
2. Both lit (a leaf, a floor seen from below): the geometric normal (b-a) x (c-a), or its opposite where the points of
   the mesh with only one lit side are lit on the opposite one by a majority (a mesh wound inside out).
3. Neither lit: the same default side if a ray from it escapes (the unlit back of an object in the open). Else the
   point is buried, such as a floor under a box, and so is a point that coincides with another mesh, such as the bottom
   of that box. Buried points are dropped; their area belongs to no receiver.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from data_gen.components import Components
from data_gen.estimators import REPLICATES, irradiance_block
from data_gen.pathtracer import PathTracer
from data_gen.rng import generator
from data_gen.samplers import cosine_hemisphere, rotate_to, triangle_barycentric
from difflpv.grid import Grid
from difflpv.io.tables import ReceiverTable
from difflpv.scene import Mesh, Scene
from difflpv.triangle_distance import triangle_distance

__all__ = ["draw_receivers", "grey_twin"]

_STREAM = 101  # names this file's random streams
_PATHS = 2**15
_ESCAPE_RAYS = 32
_LIT_SHARE = 0.01
_SEARCH = 64 * REPLICATES  # paths from each side of a point that looks enclosed


@dataclass(frozen=True)
class _SurfacePoints:
    triangle: np.ndarray
    barycentric: np.ndarray
    position: np.ndarray
    normal: np.ndarray

    def at(self, index: np.ndarray) -> _SurfacePoints:
        """Some of the points."""
        return _SurfacePoints(self.triangle[index], self.barycentric[index], self.position[index], self.normal[index])


def grey_twin(scene: Scene) -> Scene:
    """The same geometry and lights with albedo 1/2 everywhere: where light can get to, whatever the materials."""

    def grey(mesh: Mesh) -> Mesh:
        return replace(mesh, material=replace(mesh.material, albedo=np.full(3, 0.5), texture=None))

    return replace(scene, meshes=tuple(grey(mesh) for mesh in scene.meshes))


def draw_receivers(
    scene: Scene,
    count: int,
    seed: int = 0,
    *,
    within: Grid | None = None,
    search: int = _SEARCH,
    expected_share: float = 1.0,
) -> ReceiverTable:
    """Draw receivers by area on all surfaces that do not emit.

    Args:
        scene: the scene, under the lights that decide the lit side.
        count: number of receivers.
        seed: equal seeds draw equal receivers.
        within: only where this grid reaches; everywhere if None.
        search: paths from each side of a point that looks enclosed, a multiple of 32. They take most of the time where
            objects stand on one another; fewer take the dimmest corners for buried.
        expected_share: of the area that does not emit, what is known to be neither buried nor outside the grid, as from an
            earlier draw: so much more is drawn at once. Only the time depends on how right it is.

    Returns:
        Table with albedo, area weights [m2] (all equal: area that is not buried / count) and ``mesh_id`` [n].

    Raises:
        ValueError: ``count`` below 1, another option out of range, or no surface to draw from.
    """
    if count < 1:
        raise ValueError(f"receiver count: expected at least 1, got {count}")
    if search < REPLICATES or search % REPLICATES:
        raise ValueError(f"search: expected a multiple of {REPLICATES} paths, got {search}")
    if not 0 < expected_share <= 1:
        raise ValueError(f"expected_share: expected a number in (0, 1], got {expected_share}")
    emits = scene.mesh_emission.max(1)[scene.triangle_mesh] > 0
    area = np.where(emits, 0.0, scene.triangle_areas)
    if not area.sum() > 0:
        raise ValueError(f"scene '{scene.name}': every surface emits, no place for receivers")
    tracer = PathTracer(grey_twin(scene))
    drawn = int(np.ceil(count / expected_share))
    for attempt in range(12):
        points = _draw_points(scene, area, drawn, seed, attempt)
        if within is not None:
            points = points.at(within.contains(points.position))
        side = _free_sides(tracer, points, seed, attempt, search // REPLICATES)
        kept = np.flatnonzero(side)
        if len(kept) >= count:
            break
        drawn = int(np.ceil(drawn * min(1.02 * count / max(len(kept), 1), 16)))
    else:
        where = "buried" if within is None else "buried or outside the grid"
        raise ValueError(f"scene '{scene.name}': nearly all is {where}, found {len(kept)} of {count} receivers")
    # the stratified order runs along the triangles: leave out at random, not the tail
    chosen = np.sort(generator(seed, _STREAM, 2).permutation(kept)[:count])
    triangle = points.triangle[chosen]
    return ReceiverTable(
        position=points.position[chosen],
        normal=points.normal[chosen] * side[chosen, None],
        area_weight=np.full(count, area.sum() * len(kept) / drawn / count),
        albedo=scene.albedo_at(triangle, points.barycentric[chosen]),
        extras={"mesh_id": scene.triangle_mesh[triangle].astype(np.int32)},
    )


def _draw_points(scene: Scene, area: np.ndarray, count: int, seed: int, attempt: int) -> _SurfacePoints:
    """Points uniform by area, one in each of ``count`` equal shares of the total."""
    rng = generator(seed, _STREAM, 0, attempt)
    cumulative = np.cumsum(area) / area.sum()
    u = (np.arange(count) + rng.random(count)) / count
    triangle = np.minimum(np.searchsorted(cumulative, u, side="right"), np.flatnonzero(area)[-1])
    barycentric = triangle_barycentric(rng.random((2, count))).T
    a, b, c = np.moveaxis(scene.triangle_vertices[triangle], 1, 0)
    v, w = barycentric[:, :1], barycentric[:, 1:]
    return _SurfacePoints(triangle, barycentric, (1 - v - w) * a + v * b + w * c, scene.triangle_normals[triangle])


def _free_sides(tracer: PathTracer, points: _SurfacePoints, seed: int, attempt: int, search: int) -> np.ndarray:
    """+1 or -1 times the geometric normal for each point, 0 where it is buried."""
    everywhere = np.arange(len(points.triangle))
    only, dark = _lit_side(tracer, points, everywhere, 2, seed, attempt)
    mesh = tracer.scene.triangle_mesh[points.triangle]
    votes = np.bincount(mesh, only, len(tracer.scene.meshes))
    default = np.where(votes < 0, -1, 1)[mesh]
    side = np.where(only != 0, only, default)
    unlit = np.flatnonzero(dark)
    escaping = _escapes(tracer, points, unlit, default[unlit], seed, attempt)
    # the enclosed ones once more with many more paths: a dim corner is no solid
    enclosed = unlit[~escaping]
    only, dark = _lit_side(tracer, points, enclosed, search, seed, attempt)
    side[enclosed] = np.where(only != 0, only, default[enclosed]) * ~dark
    escaping = unlit[escaping]
    buried = _coincident(tracer.scene, points.position[escaping], mesh[escaping], 2 * tracer.raycaster.offset)
    side[escaping[buried]] = 0
    return side


def _lit_side(
    tracer: PathTracer, points: _SurfacePoints, index: np.ndarray, samples: int, seed: int, attempt: int
) -> tuple[np.ndarray, np.ndarray]:
    """The only lit side of the points ``index``: +1, -1, or 0 where both or neither is lit; and True for neither."""
    light = np.stack([_light(tracer, points, index, sign, samples, seed, attempt) for sign in (1, -1)])
    lit = light > _LIT_SHARE * light[::-1]
    return lit[0].astype(int) - lit[1].astype(int), ~(lit[0] | lit[1])


def _coincident(scene: Scene, position: np.ndarray, mesh: np.ndarray, gap: float) -> np.ndarray:
    """True for points [n,3] that lie within ``gap`` [m] of a triangle of another mesh than theirs [n]."""
    near = np.zeros(len(position), bool)
    for index in np.unique(mesh):
        here = np.flatnonzero(mesh == index)
        others = scene.triangle_vertices[scene.triangle_mesh != index]
        if len(others):
            near[here] = triangle_distance(others, position[here]) < gap
    return near


def _light(
    tracer: PathTracer, points: _SurfacePoints, index: np.ndarray, sign: int, samples: int, seed: int, attempt: int
) -> np.ndarray:
    """Rough irradiance of the points ``index`` on one side, summed over channels."""
    components = Components.of(["upto6"])
    light = np.zeros(len(index))
    chunk = max(1, _PATHS // (REPLICATES * samples))
    for start in range(0, len(index), chunk):
        part = index[start : start + chunk]
        address = (_STREAM, 1, attempt, sign > 0, samples, start)
        normals = sign * points.normal[part]
        irradiance = irradiance_block(
            tracer, points.position[part], normals, components, samples=samples, seed=seed, address=address
        )
        light[start : start + chunk] = irradiance.sum((0, 2, 3))
    return light


def _escapes(
    tracer: PathTracer, points: _SurfacePoints, index: np.ndarray, sign: np.ndarray, seed: int, attempt: int
) -> np.ndarray:
    normals = (points.normal[index] * sign[:, None]).T
    origins = tracer.lifted(points.position[index].T, normals)
    u = generator(seed, _STREAM, 3, attempt).random((_ESCAPE_RAYS, 2, len(index)))
    free = np.zeros(len(index), bool)
    for row in u:
        free |= ~tracer.raycaster.closest(origins.T, rotate_to(cosine_hemisphere(row), normals).T).valid
    return free
