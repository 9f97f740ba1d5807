"""Monte Carlo light transport on Embree rays: a wavefront of paths, one bounce of all of them at a time.

Estimates the radiance that arrives along rays, split by the number k of diffuse reflections between light and ray:

    L(x, w) = sum_k L_k,   L_0 = emission seen,   L_k = integral over the k-th vertex of rho/pi L_{k-1} cos

Emission is counted by two strategies at once, light sampling and the paths' own rays, weighted by the power heuristic
(Veach 1997, eq. 9.13), so that a receiver close to a panel has finite variance and nothing counts twice. Paths go on by
cosine sampling; from ``roulette_depth`` reflections on they survive with a probability of the square root of their
throughput (measured on the Cornell box: a third less variance per ray than the throughput itself). Surfaces are Lambert
on both sides, there is no sky. Vectors are [3, n] float32.
"""

from __future__ import annotations

import numpy as np

from data_gen.emitters import Emitters
from data_gen.rng import SampleStream
from data_gen.samplers import cosine_hemisphere, cosine_hemisphere_pdf, dot, pick, rotate_to
from difflpv.raycast import Raycaster
from difflpv.scene import Scene

__all__ = ["MAX_BOUNCE", "PathTracer", "power_weight"]

MAX_BOUNCE = 64
_ALL_DELTAS = 4  # up to so many point-like lights are all asked at every vertex, of more one is drawn


class PathTracer:
    """Path tracer over one scene.

    Args:
        scene: the scene.
        roulette_depth: number of reflections after which Russian roulette may end a path.

    Attributes:
        rays: number of rays traced so far.
    """

    def __init__(self, scene: Scene, *, roulette_depth: int = 5) -> None:
        self.scene = scene
        self.raycaster = Raycaster(scene)
        self.emitters = Emitters(scene)
        self.roulette_depth = roulette_depth
        self.rays = 0
        corners = scene.triangle_vertices
        self._corner = np.ascontiguousarray(corners[:, 0].T, np.float32)
        self._edge1 = np.ascontiguousarray((corners[:, 1] - corners[:, 0]).T, np.float32)
        self._edge2 = np.ascontiguousarray((corners[:, 2] - corners[:, 0]).T, np.float32)
        self._normal = np.ascontiguousarray(scene.triangle_normals.T, np.float32)
        self._albedo = np.ascontiguousarray(scene.mesh_albedo[scene.triangle_mesh].T, np.float32)
        self._textured = any(m.material.texture is not None and m.uv is not None for m in scene.meshes)
        self._delta_cumulative = np.cumsum(self.emitters.delta_power()) if self.emitters.deltas else np.ones(1)
        self._delta_cumulative[-1] = 1.0

    def lifted(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Ray origins: surface points [3, n] moved off their surface by the ray caster's offset."""
        return points + points.dtype.type(self.raycaster.offset) * normals

    def visible(self, origins: np.ndarray, directions: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """True where nothing lies between ``origins`` [3, n] and a light ``distance`` [n] m away."""
        self.rays += origins.shape[1]
        limit = distance - np.float32(2 * self.raycaster.offset)
        return ~self.raycaster.blocked_along(origins.T, directions.T, limit)

    def visible_from_surface(self, points, normals, directions, distance) -> np.ndarray:
        """``visible`` for points on a surface [3, n]: the ray starts off it and still ends on the same point."""
        if len(distance) and np.isinf(distance[0]):  # a directional light
            return self.visible(self.lifted(points, normals), directions, distance)
        ray = directions * distance - points.dtype.type(self.raycaster.offset) * normals
        length = np.sqrt(dot(ray, ray))
        return self.visible(self.lifted(points, normals), ray / length, length)

    def delta_irradiance(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Exact irradiance from all point, spot and directional lights.

        Args:
            points: positions on their surface [3, n] m, float64 for full precision.
            normals: unit normals [3, n].

        Returns:
            Irradiance [W/m2], [3, n].
        """
        total = np.zeros_like(points)
        for index in range(len(self.emitters.deltas)):
            sample = self.emitters.delta(index, points)
            self._add_delta(total, sample.direction, sample.distance, sample.irradiance, points, normals)
        return total

    def _add_delta(self, total, direction, distance, irradiance, points, normals) -> None:
        cosine = dot(direction, normals)
        seen = np.flatnonzero((cosine > 0) & (irradiance.max(0) > 0))
        if len(seen):
            toward, away = direction.take(seen, 1), distance.take(seen)
            free = self.visible_from_surface(points.take(seen, 1), normals.take(seen, 1), toward, away)
            seen = seen[free]
            _add_at(total, seen, irradiance.take(seen, 1) * cosine.take(seen))

    def area_irradiance(self, points: np.ndarray, normals: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Light-sampled part of the irradiance from area lights, weighted against cosine sampling.

        Distances and cosines are those of the points themselves, only the shadow rays start off the surface: next to a
        light's edge that distance shows.

        Args:
            points: positions on their surface [3, n] m.
            normals: unit normals [3, n].
            u: uniform numbers [2, n].

        Returns:
            One-sample estimates [W/m2], [3, n].
        """
        total = np.zeros(points.shape, np.float32)
        if not self.emitters.has_area:
            return total
        sample = self.emitters.sample_area(points, u)
        cosine = dot(sample.direction, normals)
        seen = np.flatnonzero((cosine > 0) & (sample.radiance.max(0) > 0))
        if len(seen):
            toward, away = sample.direction.take(seen, 1), sample.distance.take(seen)
            free = self.visible_from_surface(points.take(seen, 1), normals.take(seen, 1), toward, away)
            seen = seen[free]
            pdf, cosine = sample.pdf.take(seen), cosine.take(seen)
            weight = power_weight(pdf, cosine_hemisphere_pdf(cosine))
            _add_at(total, seen, sample.radiance.take(seen, 1) * (cosine * weight / pdf))
        return total

    def _vertex_irradiance(self, points, normals, stream: SampleStream, dimension: int, paths) -> np.ndarray:
        """Light-sampled irradiance at path vertices: area lights, and every or one drawn point-like light."""
        total = self.area_irradiance(points, normals, stream.uniform(dimension, 2, paths))
        count = len(self.emitters.deltas)
        if 0 < count <= _ALL_DELTAS:
            total += self.delta_irradiance(points, normals)
        elif count:
            chosen, _ = pick(self._delta_cumulative, stream.independent(points.shape[1]))
            shares = np.diff(self._delta_cumulative, prepend=0.0)
            for index in np.unique(chosen):
                here = np.flatnonzero(chosen == index)
                sample = self.emitters.delta(int(index), points[:, here])
                part = np.zeros((3, len(here)), np.float32)
                self._add_delta(
                    part, sample.direction, sample.distance, sample.irradiance, points[:, here], normals[:, here]
                )
                total[:, here] += part / np.float32(shares[index])
        return total

    def radiance(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        pdf: np.ndarray | float,
        stream: SampleStream,
        bucket_of_bounce: np.ndarray,
        *,
        dimension: int,
    ) -> np.ndarray:
        """Radiance arriving along rays, split by bounce.

        Args:
            origins: ray origins [3, n] m, off any surface.
            directions: unit directions [3, n].
            pdf: density [1/sr] with which each direction was drawn, for weighting against light sampling; ``np.inf``
                where no light was sampled at the origin (a camera ray).
            stream: random numbers, one path per ray.
            bucket_of_bounce: bucket index of each k = 0..max [max+1]; -1 leaves that k out.
            dimension: first free dimension of ``stream``.

        Returns:
            Radiance [W/(m2 sr)], shape [buckets, 3, n] float32.
        """
        n = origins.shape[1]
        max_bounce = len(bucket_of_bounce) - 1
        result = np.zeros((int(bucket_of_bounce.max()) + 1, 3, n), np.float32)
        paths = np.arange(n)
        throughput = np.ones((3, n), np.float32)
        pdf = np.broadcast_to(np.asarray(pdf, np.float32), (n,))
        for k in range(max_bounce + 1):
            hits = self.raycaster.closest(origins.T, directions.T)
            self.rays += origins.shape[1]
            hit = np.flatnonzero(hits.triangle >= 0)
            if not len(hit):
                break
            triangle, paths, throughput = hits.triangle.take(hit), paths.take(hit), throughput.take(hit, 1)
            directions = directions.take(hit, 1)
            normals = self._normal.take(triangle, 1)
            cosine = -dot(directions, normals)
            if bucket_of_bounce[k] >= 0 and self.emitters.has_area:
                glowing = np.flatnonzero(self.emitters.triangle_pdf.take(triangle) > 0)
                if len(glowing):
                    where, facing = triangle[glowing], cosine[glowing]
                    distance = hits.distance[hit[glowing]].astype(np.float32)
                    light_pdf = self.emitters.solid_angle_pdf(where, facing, distance)
                    weight = power_weight(pdf[hit[glowing]], light_pdf)
                    light = self.emitters.emitted(where, facing) * weight * throughput.take(glowing, 1)
                    _add_at(result[bucket_of_bounce[k]], paths[glowing], light)
            if k == max_bounce:
                break
            barycentric = hits.barycentric.take(hit, 0)
            albedo = self._albedo.take(triangle, 1)
            if self._textured:
                albedo = np.ascontiguousarray(self.scene.albedo_at(triangle, barycentric).T, np.float32)
            throughput = throughput * albedo
            strength = throughput.max(0)
            alive = strength > 0
            if k + 1 >= self.roulette_depth:
                # the vertex's own light sampling shares the path's fate: fewer shadow rays where little light is left
                survival = np.minimum(np.sqrt(strength), np.float32(0.95))
                alive &= stream.independent(len(strength)) < survival
                throughput = throughput / np.maximum(survival, np.float32(1e-20))
            if not alive.all():
                keep = np.flatnonzero(alive)
                if not len(keep):
                    break
                triangle, paths, throughput = triangle.take(keep), paths.take(keep), throughput.take(keep, 1)
                normals, cosine, barycentric = normals.take(keep, 1), cosine.take(keep), barycentric.take(keep, 0)
            b, c = barycentric.T.astype(np.float32)
            normals = normals * np.copysign(np.float32(1), cosine)
            points = self._corner.take(triangle, 1)
            points += b * self._edge1.take(triangle, 1) + c * self._edge2.take(triangle, 1)
            base = dimension + 4 * k
            if bucket_of_bounce[k + 1] >= 0:
                light = self._vertex_irradiance(points, normals, stream, base, paths)
                _add_at(result[bucket_of_bounce[k + 1]], paths, throughput * light * np.float32(1 / np.pi))
            origins = self.lifted(points, normals)
            directions = rotate_to(cosine_hemisphere(stream.uniform(base + 2, 2, paths)), normals)
            pdf = cosine_hemisphere_pdf(dot(directions, normals))
        return result


def _add_at(total: np.ndarray, index: np.ndarray, values: np.ndarray) -> None:
    """``total[:, index] += values`` for distinct indices, row by row, which numpy does several times faster."""
    for row, value in zip(total, values, strict=True):
        row[index] += value


def power_weight(pdf: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Power heuristic (exponent 2) pdf^2/(pdf^2 + other^2), safe for huge and infinite ``pdf``."""
    with np.errstate(over="ignore", divide="ignore"):
        ratio = other / pdf
        return 1 / (1 + ratio * ratio)
