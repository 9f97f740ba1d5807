"""Gradients of receivers' irradiance by Mitsuba 3's path replay, with respect to power and place of area lights.

Power: path replay backpropagation (Vicini et al. 2021). Place: as seen from a surface, a light that moves changes nothing but
its outline, so the whole gradient lies in visibility; plain path replay (``prb``) finds zero. Projective sampling
(``prb_projective``, Zhang et al. 2023) samples edges of the light and connects them to both sides. It takes an outline that is
seen from behind for one that is seen from the front, which is right for closed surfaces; one-sided panels are corrected here.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Any

import numpy as np

from difflpv.bench.configuration import Configuration
from difflpv.bench.mitsuba_peer import FIRST_BOUNCE, MitsubaRun, loaded_mitsuba
from difflpv.bench.scenes import BenchScene
from difflpv.scene import AreaLight

__all__ = ["PathReplay"]


@lru_cache
def _integrator() -> Any:
    mi = loaded_mitsuba()
    import drjit as dr
    from mitsuba.python.ad.integrators.prb_projective import PathProjectiveIntegrator

    class OneSided(PathProjectiveIntegrator):
        """Outlines of panels shine to the front only."""

        def sample_radiance_difference(
            self, scene: Any, ss: Any, curr_depth: Any, sampler: Any, wavelengths: Any, active: Any
        ) -> Any:
            edge = dr.zeros(mi.PreliminaryIntersection3f)
            edge.valid, edge.t, edge.prim_index, edge.prim_uv, edge.shape = active, 1, ss.prim_index, ss.uv, ss.shape
            panel = edge.compute_surface_interaction(mi.Ray3f(ss.p - ss.d, ss.d), mi.RayFlags.Minimal, active)
            front = dr.dot(panel.n, ss.d) < 0
            return super().sample_radiance_difference(scene, ss, curr_depth, sampler, wavelengths, active & front)

    mi.register_integrator("difflpv_one_sided", lambda props: OneSided(props))
    # Without guiding: its octree takes minutes for a thousand receivers. What receivers see of the panel's own back
    # (sppp) is dark in the first bounce.
    options = {"sppc": 0, "sppp": 0, "guiding": "none"}
    found = mi.load_dict({"type": "difflpv_one_sided", **FIRST_BOUNCE, **options})
    found.sample_border_warning = False
    return found


class PathReplay:
    """Gradient of ``sum(weight * irradiance)`` over receivers after the first bounce of area lights, by Mitsuba."""

    def __init__(self, bench: BenchScene, position: np.ndarray, normal: np.ndarray, weight: np.ndarray) -> None:
        """Build the scene.

        Args:
            bench: the scene under its lights.
            position: receivers [n,3] m.
            normal: unit normals [n,3].
            weight: by receiver and channel, [n,3].

        Raises:
            ImportError: Mitsuba cannot be used here.
            ValueError: a component other than the first bounce, or a light that is no area light.
        """
        if bench.component != "bounce1" or not all(isinstance(light, AreaLight) for light in bench.scene.lights):
            raise ValueError(f"{bench.key}: path replay is measured for the first bounce of area lights")
        self._mi = loaded_mitsuba()
        self.run = MitsubaRun(Configuration("path replay", "mitsuba", "Mitsuba 3", samples=1), bench)
        self._parameters = self._mi.traverse(self.run.scene)
        names, keys = [mesh.name for mesh in bench.scene.meshes], list(self._parameters.keys())
        lit = [f"mesh{names.index(light.mesh)}" for light in bench.scene.lights if isinstance(light, AreaLight)]
        self._places = [f"{mesh}.vertex_positions" for mesh in lit]
        self._powers = [next(k for k in keys if re.match(rf"{mesh}\.emitter\.radiance\.value$", k)) for mesh in lit]
        self._corners = [self._mi.Float(self._parameters[name]) for name in self._places]
        self._sensor = self.run.sensor(position, normal)
        self._replay = self._mi.load_dict({"type": "prb", **FIRST_BOUNCE})
        width, height = self._sensor.film().size()
        adjoint = np.zeros((height, width, 3), np.float32)
        adjoint.reshape(-1, 3)[: len(position)] = weight
        self._adjoint = self._mi.TensorXf(adjoint)

    def gradient(self, *, power_samples: int, place_samples: int, seed: int, forward: bool = True) -> dict[str, np.ndarray]:
        """One forward and backward pass.

        Args:
            power_samples: paths per receiver for irradiance and for the gradient by power; 0 for none.
            place_samples: edges per receiver for the gradient by place; 0 for none.
            seed: of the paths.
            forward: render the irradiance too, as whoever fits to it has to.

        Returns:
            ``light_intensity`` [lights], by a factor of each light's power, and ``light_position`` [lights,3] 1/m.
        """
        import drjit as dr

        mi = self._mi
        offsets = [mi.Point3f(0.0) for _ in self._places]
        factors = [mi.Float(1.0) for _ in self._powers]
        radiances = [mi.Color3f(self._parameters[name]) for name in self._powers]
        dr.enable_grad(*offsets, *factors)
        if power_samples:
            for name, radiance, factor in zip(self._powers, radiances, factors, strict=True):
                self._parameters[name] = radiance * factor
            self._parameters.update()
            if forward:
                path = self.run.integrator
                dr.eval(mi.render(self.run.scene, sensor=self._sensor, integrator=path, spp=power_samples, seed=seed))
            self._backward(self._replay, power_samples, seed)
        if place_samples:
            for name, corners, offset in zip(self._places, self._corners, offsets, strict=True):
                self._parameters[name] = dr.ravel(dr.unravel(mi.Point3f, corners) + offset)
            self._parameters.update()
            integrator = _integrator()
            integrator.sppi = place_samples
            self._backward(integrator, 0, seed)
        found = {
            "light_intensity": np.array([np.array(dr.grad(f)).item() for f in factors]),
            "light_position": np.array([np.array(dr.grad(o)).ravel() for o in offsets]),
        }
        for name, radiance in zip(self._powers, radiances, strict=True):
            self._parameters[name] = dr.detach(radiance)
        for name, corners in zip(self._places, self._corners, strict=True):
            self._parameters[name] = corners
        self._parameters.update()
        return found

    def _backward(self, integrator: Any, samples: int, seed: int) -> None:
        scene, parameters = self.run.scene, self._parameters
        integrator.render_backward(scene, parameters, self._adjoint, sensor=self._sensor, seed=seed, spp=samples)
