"""What the page shows: a scene solved with the values of its sliders, and everything that is read from the solve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import torch

from difflpv.evaluate import score
from difflpv.grid import Grid
from difflpv.illumination import Component, Illumination, Receivers, illuminate
from difflpv.io.png import auto_exposure
from difflpv.learnables import fixed_values
from difflpv.pipeline import Lpv, coarsen
from difflpv.raycast import Raycaster
from difflpv.scene import AreaLight, DirectionalLight, Light, Mesh, Scene
from difflpv.shapes.colors import relative_errors
from difflpv.shapes.spheres import sphere_normals
from difflpv.shapes.surfaces import Surfaces, surfaces_of

__all__ = ["AXES", "Axis", "Knobs", "Quantity", "Solved", "Truth", "ViewState", "move_lights"]

Axis = Literal["x", "y", "z"]
Quantity = Literal["moving", "sum"]
AXES: tuple[Axis, ...] = get_args(Axis)
_LEAST_OCCLUSION = 1e-3  # traced transmittance 0 to the power 0 would let light through walls


@dataclass(frozen=True)
class Knobs:
    """Values of the sliders that need a solve.

    Attributes:
        propagation: times the model's own propagation factor.
        occlusion: times the model's own occlusion strength.
        intensity: times the power of each light.
        offset: displacement of each light [m].
    """

    propagation: float
    occlusion: float
    intensity: tuple[float, ...]
    offset: tuple[tuple[float, float, float], ...]

    @classmethod
    def neutral(cls, scene: Scene) -> Knobs:
        """The model and the lights as they are."""
        count = len(scene.lights)
        return cls(1.0, 1.0, (1.0,) * count, ((0.0, 0.0, 0.0),) * count)


@dataclass(frozen=True, eq=False)
class Truth:
    """Receivers whose irradiance under the scene's own lights is known: position, normal, irradiance [n,3], weight [n]."""

    position: np.ndarray
    normal: np.ndarray
    irradiance: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True, eq=False)
class Solved:
    """One solve.

    Attributes:
        knobs: what it was solved with.
        grids: of the volume, finest first.
        moving: what moves after each step [3,K,n_z,n_y,n_x] W/sr, S_0 to S_steps, all components together; from number
            ``fine_steps`` on, on the coarser grid where there is one.
        fine_steps: see ``moving``.
        surface: irradiance of the facets' vertices [V,3] W/m2.
        probes: irradiance of each probe for ``sphere_normals`` [n,k,3] W/m2, read from the volume at the probe.
        errors: of each known receiver, in means of the truth [m]; None where nothing is known of these lights.
        relative_l2: of all known receivers, or None.
    """

    knobs: Knobs
    grids: tuple[Grid, ...]
    moving: tuple[torch.Tensor, ...]
    fine_steps: int
    surface: np.ndarray
    probes: np.ndarray
    errors: np.ndarray | None
    relative_l2: float | None

    def grid_of(self, step: int) -> Grid:
        """The grid that step ``step`` is on."""
        return self.grids[int(len(self.grids) > 1 and step >= self.fine_steps)]

    def volume(self, step: int, quantity: Quantity) -> torch.Tensor:
        """What moves after ``step`` steps, or the sum of S_0 to S_step, [3,K,n_z,n_y,n_x] W/sr on ``grid_of(step)``."""
        if not 0 <= step < len(self.moving):
            raise ValueError(f"step: expected 0..{len(self.moving) - 1}, got {step}")
        if quantity == "moving":
            return self.moving[step]
        total = torch.zeros_like(self.moving[0])
        for i in range(step + 1):
            if self.moving[i].shape != total.shape:
                total = coarsen(total)
            total += self.moving[i]
        return total

    def slice(self, step: int, quantity: Quantity, axis: Axis, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Cells of one layer across ``axis``: centres [m,3] m and coefficients [m,K,3] W/sr.

        Args:
            step: 0 (the injected volume) to the number of steps.
            quantity: see ``volume``.
            axis: the layer's normal.
            index: of the layer in the finest grid.
        """
        along = AXES.index(axis)
        count = self.grids[0].resolution[along]
        if not 0 <= index < count:
            raise ValueError(f"slice: expected a layer in 0..{count - 1}, got {index}")
        grid = self.grid_of(step)
        if grid is not self.grids[0]:
            index //= 2
        layer = self.volume(step, quantity).select(4 - along, index)  # tensors are laid out z, y, x
        centers = np.take(grid.cell_centers(), index, axis=2 - along).reshape(-1, 3)
        return centers, layer.flatten(2).permute(2, 1, 0).double().cpu().numpy()


class ViewState:
    """A scene that is solved again and again: what rays decide is kept as long as no light moves.

    Attributes:
        scene: as it was given.
        surfaces: its facets.
        probe_position: [n,3] m.
        truth: known receivers, or None.
    """

    def __init__(
        self,
        scene: Scene,
        lpv: Lpv,
        *,
        components: Sequence[Component] = ("direct", "bounce1"),
        probe_position: np.ndarray | None = None,
        truth: Truth | None = None,
        facets: int = 12_000,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        """Set up; the first ``solve`` traces the rays.

        Args:
            scene: under the lights that the sliders start from.
            lpv: the model.
            components: which parts of the light are added up, at least one.
            probe_position: [n,3] m.
            truth: irradiance of the same components.
            facets: of all surfaces.
            seed: of light samples and rays.
            device: where to solve.
        """
        if not components:
            raise ValueError("components: expected at least one")
        self.scene = scene
        self.lpv = lpv
        self.components = tuple(components)
        self.truth = truth
        self.probe_position = np.zeros((0, 3)) if probe_position is None else np.asarray(probe_position, np.float64)
        self._seed, self._device, self._facets = seed, device, facets
        self._own = {**fixed_values(lpv.config), **{k: v.detach() for k, v in lpv.values().items()}}
        self._offset: tuple[tuple[float, float, float], ...] | None = None
        self._lit: list[tuple[Illumination, Receivers]] = []
        self.surfaces: Surfaces = surfaces_of(scene, Raycaster(scene), facets=facets, seed=seed)
        self._surface_scene = scene
        self._exposure: float | None = None

    @property
    def steps(self) -> int:
        """Propagation steps."""
        return self.lpv.config.steps

    @torch.no_grad()
    def solve(self, knobs: Knobs) -> Solved:
        """Solve with the values of the sliders.

        Raises:
            FloatingPointError: the result is not finite.
            SceneError: a light moved out of all bounds.
        """
        values = self._values(knobs)
        self._trace(knobs.offset)
        moving: list[torch.Tensor] = []
        irradiance = np.zeros((0, 3))
        for light, receivers in self._lit:
            volumes: list[torch.Tensor] = []
            for step, part in enumerate(self.lpv.moving(light, values)):
                if not volumes or volumes[-1].shape != part.shape:
                    volumes.append(part.clone())
                else:
                    volumes[-1] += part
                if step < len(moving):
                    moving[step] += part
                else:
                    moving.append(part)
            found = self.lpv.gather(volumes, light, receivers, values).double().cpu().numpy()
            irradiance = irradiance + found if len(irradiance) else found
        surface, probes, known = np.split(irradiance, np.cumsum(self._counts()[:2]))
        errors = total = None
        if self.truth is not None and self._under_own_lights(knobs):
            errors = relative_errors(known, self.truth.irradiance, self.truth.weight)
            t = self.truth
            total = score(known, t.irradiance, t.weight, method="", component="", light=0).relative_l2
        if self._exposure is None:
            self._exposure = auto_exposure(self.surfaces.radiance(surface, emission=False))
        count = len(sphere_normals())
        return Solved(
            knobs, self.lpv.config.grids(self.lpv.grid), tuple(moving), self.lpv.config.fine_steps, surface,
            probes.reshape(-1, count, 3), errors, total,
        )  # fmt: skip

    @property
    def exposure(self) -> float:
        """Stops that put the first solve's bright surfaces at white and stay, so that light can be seen to grow; 0 before."""
        return self._exposure or 0.0

    def _values(self, knobs: Knobs) -> dict[str, torch.Tensor]:
        lights = len(self.scene.lights)
        if len(knobs.intensity) != lights or len(knobs.offset) != lights:
            raise ValueError(f"knobs: expected an intensity and an offset for each of {lights} lights")
        own = self._own
        intensity = torch.tensor(knobs.intensity, dtype=torch.float64)
        return {
            "propagation": own["propagation"] * knobs.propagation,
            "occlusion": (own["occlusion"] * knobs.occlusion).clamp_min(_LEAST_OCCLUSION),
            "light_intensity": own.get("light_intensity", torch.ones(lights, dtype=torch.float64)) * intensity,
        }

    def _under_own_lights(self, knobs: Knobs) -> bool:
        neutral = Knobs.neutral(self.scene)
        return knobs.intensity == neutral.intensity and knobs.offset == neutral.offset

    def _counts(self) -> tuple[int, int, int]:
        known = 0 if self.truth is None else len(self.truth.position)
        return len(self.surfaces.vertices), len(self.probe_position) * len(sphere_normals()), known

    def _trace(self, offset: tuple[tuple[float, float, float], ...]) -> None:
        """Rays of lights at their places, unless they are there already."""
        if offset == self._offset:
            return
        scene = move_lights(self.scene, offset)
        config, grid = self.lpv.config, self.lpv.grid
        lit = [
            illuminate(scene, grid, config, component, seed=self._seed, device=self._device) for component in self.components
        ]
        if scene is not self._surface_scene:
            self.surfaces = surfaces_of(scene, lit[0].raycaster, facets=self._facets, seed=self._seed)
            self._surface_scene = scene
        directions = sphere_normals()
        position = [self.surfaces.receiver, np.repeat(self.probe_position, len(directions), axis=0)]
        normal = [self.surfaces.normal, np.tile(directions, (len(self.probe_position), 1))]
        if self.truth is not None:
            position.append(self.truth.position)
            normal.append(self.truth.normal)
        x, n = np.concatenate(position), np.concatenate(normal)
        self._lit = [(light, light.receivers(x, n)) for light in lit]
        self._offset = offset


def move_lights(scene: Scene, offset: Sequence[Sequence[float]]) -> Scene:
    """The scene with its lights (area lights with their mesh) displaced by ``offset`` [lights,3] m.

    A directional light has no place to move from.
    """
    if not np.any(offset):
        return scene
    lights: list[Light] = []
    moved: dict[str, Mesh] = {}
    for light, by in zip(scene.lights, np.asarray(offset, np.float64), strict=True):
        if isinstance(light, AreaLight):
            mesh = next(m for m in scene.meshes if m.name == light.mesh)
            moved[mesh.name] = Mesh(mesh.name, mesh.vertices + by, mesh.triangles, mesh.material, mesh.uv)
            lights.append(light)
        elif isinstance(light, DirectionalLight):
            lights.append(light)
        else:
            lights.append(replace(light, position=light.position + by))
    return scene.with_lights(lights, moved)
