"""What emits: area lights sampled by power and area, point, spot and directional lights taken exactly.

Vectors are [3, n], see ``data_gen.samplers``. An emitting mesh blocks light and reflects with its own albedo (panels of
the bundled scenes are black); it emits on the side of its geometric normal unless its light is two-sided.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_gen.samplers import dot, pick, triangle_barycentric
from difflpv.scene import AreaLight, DirectionalLight, PointLight, Scene, SpotLight

__all__ = ["AreaSample", "DeltaSample", "Emitters"]

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True)
class AreaSample:
    """Points on area lights as seen from n points.

    Attributes:
        direction: unit vectors toward the light, [3, n].
        distance: [n] m.
        radiance: emitted toward the point [W/(m2 sr)], zero on a dark side, [3, n].
        pdf: density per solid angle seen from the point [1/sr], [n].
    """

    direction: np.ndarray
    distance: np.ndarray
    radiance: np.ndarray
    pdf: np.ndarray


@dataclass(frozen=True)
class DeltaSample:
    """One point, spot or directional light as seen from n points.

    Attributes:
        direction: unit vectors toward the light, [3, n].
        distance: [n] m, inf for a directional light.
        irradiance: on a surface that faces the light [W/m2], without visibility, [3, n].
    """

    direction: np.ndarray
    distance: np.ndarray
    irradiance: np.ndarray


class Emitters:
    """All lights of a scene.

    Attributes:
        deltas: point, spot and directional lights.
        has_area: whether any area light emits.
        triangle_radiance: emission of every scene triangle [W/(m2 sr)], [3, T].
        triangle_pdf: density of ``sample_area`` on every scene triangle [1/m2], [T].
        triangle_two_sided: [T] bool.
    """

    def __init__(self, scene: Scene) -> None:
        self.deltas = tuple(light for light in scene.lights if not isinstance(light, AreaLight))
        emission = scene.mesh_emission[scene.triangle_mesh]
        power = emission @ _LUMINANCE * scene.triangle_areas
        power = np.where((power == 0) & emission.any(1), 1e-6 * max(power.max(), 1e-30), power)
        chosen = np.flatnonzero(power > 0)
        self.has_area = bool(len(chosen))
        self.triangle_radiance = np.ascontiguousarray(emission.T, np.float32)
        self.triangle_two_sided = scene.mesh_two_sided_emission[scene.triangle_mesh]
        total = power.sum() if self.has_area else 1.0
        self.triangle_pdf = (power / total / scene.triangle_areas).astype(np.float32)
        if not self.has_area:
            return
        self.cumulative = np.cumsum(power[chosen] / total)
        self.cumulative[-1] = 1.0
        corners = scene.triangle_vertices[chosen]
        self._corner = np.ascontiguousarray(corners[:, 0].T, np.float32)
        self._edge1 = np.ascontiguousarray((corners[:, 1] - corners[:, 0]).T, np.float32)
        self._edge2 = np.ascontiguousarray((corners[:, 2] - corners[:, 0]).T, np.float32)
        self._normal = np.ascontiguousarray(scene.triangle_normals[chosen].T, np.float32)
        self._radiance = np.ascontiguousarray(emission[chosen].T, np.float32)
        self._two_sided = self.triangle_two_sided[chosen]
        self._pdf = self.triangle_pdf[chosen]

    def sample_area(self, points: np.ndarray, u: np.ndarray) -> AreaSample:
        """Draw one point of the area lights per point: triangle by power, then uniform by area.

        Args:
            points: positions [3, n] m.
            u: uniform numbers [2, n].
        """
        light, rest = pick(self.cumulative, u[0])
        b, c = triangle_barycentric(np.stack([rest, u[1]]))
        # ndarray.take is five times faster than indexing the second axis
        delta = self._corner.take(light, 1) + b * self._edge1.take(light, 1) + c * self._edge2.take(light, 1) - points
        squared = np.maximum(dot(delta, delta), np.float32(1e-20))
        distance = np.sqrt(squared)
        direction = delta / distance
        cosine = -dot(direction, self._normal.take(light, 1))
        bright = (cosine > 0) | self._two_sided.take(light)
        radiance = self._radiance.take(light, 1) * bright
        pdf = self._pdf.take(light) * squared / np.maximum(np.abs(cosine), np.float32(1e-9))
        return AreaSample(direction, distance, radiance, pdf)

    def emitted(self, triangle: np.ndarray, cosine: np.ndarray) -> np.ndarray:
        """Radiance leaving scene triangles [W/(m2 sr)], [3, n].

        Args:
            triangle: scene triangle index [n].
            cosine: of the leaving direction with the geometric normal [n].
        """
        bright = (cosine > 0) | self.triangle_two_sided[triangle]
        return self.triangle_radiance.take(triangle, 1) * bright

    def solid_angle_pdf(self, triangle: np.ndarray, cosine: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """Density per solid angle [1/sr] with which ``sample_area`` would have chosen these points, [n]."""
        return self.triangle_pdf[triangle] * distance * distance / np.maximum(np.abs(cosine), np.float32(1e-9))

    def delta_power(self) -> np.ndarray:
        """Relative weights for choosing among ``deltas``, summing to 1, [k]."""
        weights = []
        for light in self.deltas:
            strength = light.irradiance if isinstance(light, DirectionalLight) else light.intensity
            weights.append(max(float(np.asarray(strength) @ _LUMINANCE), 1e-12))
        return np.asarray(weights) / np.sum(weights)

    def delta(self, index: int, points: np.ndarray) -> DeltaSample:
        """Light number ``index`` of ``deltas`` as seen from ``points`` [3, n]; computed in the dtype of ``points``."""
        light = self.deltas[index]
        kind = points.dtype.type
        if isinstance(light, DirectionalLight):
            n = points.shape[1]
            toward = -np.asarray(light.direction, points.dtype)
            irradiance = np.asarray(light.irradiance, points.dtype)
            return DeltaSample(
                np.repeat(toward[:, None], n, 1), np.full(n, np.inf, points.dtype), np.repeat(irradiance[:, None], n, 1)
            )
        if not isinstance(light, PointLight | SpotLight):
            raise TypeError(f"lights: expected point, spot, directional or area, got {type(light).__name__}")
        delta = np.asarray(light.position, points.dtype)[:, None] - points
        squared = np.maximum(dot(delta, delta), kind(1e-20))
        distance = np.sqrt(squared)
        direction = delta / distance
        intensity = np.asarray(light.intensity, points.dtype)[:, None]
        if isinstance(light, SpotLight):
            axis = np.asarray(light.direction, points.dtype)[:, None]
            intensity = intensity * light.falloff(-dot(direction, axis)).astype(points.dtype)
        return DeltaSample(direction, distance, intensity / squared)
