"""The surfaces of a scene in facets small enough to show how light varies over them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from difflpv.raycast import Raycaster
from difflpv.scene import Scene
from difflpv.shapes.shape import Shape

__all__ = ["Surfaces", "surfaces_of"]

_FACETS = 12_000
_MOST = 48  # facets along an edge of a triangle
_RAYS = 400_000  # in all, for which sides of triangles face the scene
_RAYS_PER_SIDE = (8, 256)
_RAYS_PER_POINT = (8, 24)
_KEY = np.array([0.30, 0.85, 0.43]) / np.linalg.norm([0.30, 0.85, 0.43])


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Vertices of facets, on the sides that face the scene; each side of a triangle has vertices of its own.

    Attributes:
        vertices: [V,3] m.
        triangles: [T,3], counter-clockwise as seen from the side that they show.
        normal: unit normals on that side, [V,3].
        receiver: a point of the same facets a little off their edges, where the light of a vertex is asked for, [V,3] m.
        albedo: [V,3].
        emission: radiance of a light's own surface [W/(m2 sr)], [V,3].
        covered: inside a solid, as the floor under furniture is: dark whatever the light, [V] bool.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    normal: np.ndarray
    receiver: np.ndarray
    albedo: np.ndarray
    emission: np.ndarray
    covered: np.ndarray

    def plain(self) -> Shape:
        """Albedo under an even light from above that tells slopes apart; lights are white."""
        shade = 0.72 + 0.28 * self.normal @ _KEY
        color = np.where(self.emission.max(axis=1, keepdims=True) > 0, 1.0, self.albedo * shade[:, None])
        return Shape(self.vertices, self.triangles, color)

    def radiance(self, irradiance: np.ndarray, *, white: bool = False, emission: bool = True) -> np.ndarray:
        """Radiance [V,3] W/(m2 sr) of irradiance [V,3] at ``receiver``: albedo E / pi, or E / pi (``white``), and emission.

        A covered vertex takes the mean of those beside it that are not, lest its dark shows through on the facets around.
        """
        reflected = (1.0 if white else self.albedo) * self._uncovered(np.clip(irradiance, 0, None)) / np.pi
        return reflected + (self.emission if emission else 0.0)

    def _uncovered(self, irradiance: np.ndarray) -> np.ndarray:
        a, b = self.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).T
        a, b = np.concatenate([a, b]), np.concatenate([b, a])
        chosen = self.covered[a] & ~self.covered[b]
        a, b = a[chosen], b[chosen]
        count = np.bincount(a, minlength=len(irradiance))
        sums = np.stack([np.bincount(a, irradiance[b, k], len(irradiance)) for k in range(3)], 1)
        return np.where(count[:, None] > 0, sums / np.maximum(count, 1)[:, None], irradiance)


def surfaces_of(scene: Scene, raycaster: Raycaster, *, facets: int = _FACETS, seed: int = 0) -> Surfaces:
    """Cut the triangles of a scene into about ``facets`` facets.

    The sides that face nothing of the scene are left out, so that one looks into a room through its walls: rays from a side
    into its hemisphere meet no triangle. Where that is so on both sides of a triangle, both are kept.

    Args:
        scene: the surfaces.
        raycaster: over it.
        facets: how many to aim at; a scene of more triangles keeps them all.
        seed: of the rays.

    Raises:
        ValueError: fewer than one facet.
    """
    if facets < 1:
        raise ValueError(f"facets: expected at least 1, got {facets}")
    corners = scene.triangle_vertices
    edge = np.sqrt(2 * scene.triangle_areas.sum() / facets)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    count = np.ceil(np.maximum(np.sqrt(2 * scene.triangle_areas), longest / 3) / edge - 1e-9)
    count = np.clip(count, 1, _MOST).astype(np.int64)
    front, back = _facing(scene, raycaster, seed)
    parts = []
    for n in np.unique(count):
        for flip, shown in ((False, front), (True, back)):
            chosen = np.flatnonzero((count == n) & shown)
            if len(chosen):
                parts.append(_cut(scene, chosen, int(n), flip))
    return _welded(scene, parts, raycaster, seed)


def _facing(scene: Scene, raycaster: Raycaster, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Which fronts and backs [T] see anything of the scene."""
    corners, normals = scene.triangle_vertices, scene.triangle_normals
    total = len(corners)
    rays = int(np.clip(_RAYS // (2 * total), *_RAYS_PER_SIDE))
    rng = np.random.default_rng(seed)
    sees = []
    for normal in (normals, -normals):
        u = np.sort(rng.random((total, rays, 2)), axis=2)
        weight = np.stack([u[..., 0], u[..., 1] - u[..., 0], 1 - u[..., 1]], 2)  # uniform over the triangle
        origin = np.einsum("trc,tcd->trd", weight, corners) + 2 * raycaster.offset * normal[:, None]
        direction = _hemisphere(normal, rays, rng)
        hit = raycaster.blocked_along(origin.reshape(-1, 3), direction.reshape(-1, 3), np.inf)
        sees.append(hit.reshape(total, rays).any(axis=1))
    front, back = np.asarray(sees)
    alone = ~(front | back)
    return front | alone, back | alone


def _covered(scene: Scene, raycaster: Raycaster, x: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    """Which points [V,3] with normals [V,3] see only backs of triangles, all around."""
    rays = int(np.clip(_RAYS // len(x), *_RAYS_PER_POINT))
    direction = _hemisphere(n, rays, np.random.default_rng(seed))
    origin = np.broadcast_to((x + 2 * raycaster.offset * n)[:, None], direction.shape).reshape(-1, 3)
    hits = raycaster.closest(origin, direction.reshape(-1, 3))
    facing = (scene.triangle_normals[hits.triangle] * direction.reshape(-1, 3)).sum(1)  # a miss asks for the last: masked
    return np.asarray((hits.valid & (facing > 0)).reshape(len(x), rays).all(1))


def _hemisphere(normal: np.ndarray, rays: int, rng: np.random.Generator) -> np.ndarray:
    """Unit directions [m,rays,3], even over the hemisphere about each normal [m,3]."""
    direction = rng.standard_normal((len(normal), rays, 3))
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    away = (direction * normal[:, None]).sum(2, keepdims=True)
    return np.where(away < 0, -direction, direction)


def _cut(scene: Scene, chosen: np.ndarray, n: int, flip: bool) -> tuple[np.ndarray, ...]:
    """Vertices with mesh, normal, receiver, albedo and emission, then triangles, of triangles cut n times along each edge."""
    i, j = (a.ravel() for a in np.mgrid[: n + 1, : n + 1])
    i, j = i[i + j <= n], j[i + j <= n]
    number = np.full((n + 1, n + 1), -1)
    number[i, j] = np.arange(len(i))
    up = [(number[a, b], number[a + 1, b], number[a, b + 1]) for a in range(n) for b in range(n - a)]
    down = [(number[a + 1, b], number[a + 1, b + 1], number[a, b + 1]) for a in range(n) for b in range(n - a - 1)]
    facets = np.array(up + down)
    if flip:
        facets = facets[:, ::-1]
    weight = np.stack([1 - (i + j) / n, i / n, j / n], 1)
    pull = 0.3 / max(n, 2)
    inner = (1 - pull) * weight + pull / 3
    corners = scene.triangle_vertices[chosen]
    vertex, receiver = (np.einsum("vc,tcd->tvd", w, corners).reshape(-1, 3) for w in (weight, inner))
    triangle = np.repeat(chosen, len(weight))
    albedo = scene.albedo_at(triangle, np.tile(weight[:, 1:], (len(chosen), 1)))
    normal = scene.triangle_normals[triangle] * (-1 if flip else 1)
    mesh = scene.triangle_mesh[triangle]
    shines = scene.mesh_two_sided_emission[mesh] | (not flip)
    emission = np.where(shines[:, None], scene.mesh_emission[mesh], 0.0)
    triangles = (facets + len(weight) * np.arange(len(chosen))[:, None, None]).reshape(-1, 3)
    return mesh, vertex, normal, receiver, albedo, emission, triangles


def _welded(scene: Scene, parts: list[tuple[np.ndarray, ...]], raycaster: Raycaster, seed: int) -> Surfaces:
    """One vertex where facets of a mesh meet on nearly the same plane, with the mean of their values."""
    first = np.cumsum([0, *(len(p[0]) for p in parts)])
    triangles = np.concatenate([p[-1] + n for p, n in zip(parts, first, strict=False)])
    mesh, vertex, normal, receiver, albedo, emission = (np.concatenate([p[k] for p in parts]) for k in range(6))
    low, high = scene.bounds
    place = np.round(vertex / (1e-5 * (high - low).max()))
    key = np.concatenate([mesh[:, None], place, np.round(1.2 * normal)], 1)
    _, inverse, count = np.unique(key.astype(np.int64), axis=0, return_inverse=True, return_counts=True)
    inverse = inverse.reshape(-1)

    def mean(values: np.ndarray) -> np.ndarray:
        sums = [np.bincount(inverse, values[:, k], len(count)) for k in range(3)]
        return np.stack(sums, 1) / count[:, None]

    n, x = mean(normal), mean(receiver)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    covered = _covered(scene, raycaster, x, n, seed)
    return Surfaces(mean(vertex), inverse[triangles], n, x, mean(albedo), mean(emission), covered)
