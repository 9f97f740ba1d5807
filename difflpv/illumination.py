"""A scene under its lights, ready to solve: everything that rays decide, computed once and held fixed.

What moves or scales with a learnable (light power and position, albedo) is applied per solve by ``Illumination.vpls``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np
import torch

from difflpv.blocking import Blocking, blocking_of
from difflpv.config import LpvConfig
from difflpv.coordinates import check_points
from difflpv.direct import (
    Emitters,
    area_light_vpls,
    direct_irradiance,
    drop_unlit,
    emitters_of,
    lit_surface_vpls,
    visibility,
)
from difflpv.grid import Grid
from difflpv.lit_probes import VolumeProbes
from difflpv.lookup import CellReads, Lookup, OpenCells, open_cells
from difflpv.occlusion import Blockers
from difflpv.probes.rows import Rows
from difflpv.raycast import Raycaster
from difflpv.rsm import Rsm, TexelFlux, render_rsm, rsm_blockers, rsm_vpls
from difflpv.scene import AreaLight, Scene, SceneError
from difflpv.sh import cosine_lobe
from difflpv.surface import SurfaceSamples, sample_surfaces
from difflpv.vpl import Vpls

_BIAS = 0.5  # cells are picked half a cell off the surface

__all__ = ["Component", "Illumination", "LightValues", "Receivers", "illuminate"]

Component = Literal["direct", "bounce1"]
_EXTENTS = (1e-5, 1e9)  # m; Embree and the fourth power of a distance in float32 set these
_FARTHEST_READ = 3.5  # cells: the largest bias (difflpv.learnables), half a cell of damping, one of the weights
_FARTHEST = 1e3  # distance from the origin over the extent; rays start 2e-5 of it off a surface


@dataclass(frozen=True, eq=False)
class LightValues:
    """Learnables of lights and surfaces; None leaves the scene's own.

    Attributes:
        intensity: factor per light, [lights].
        color: factor per light and channel, [lights,3].
        position: displacement per light [m], [lights,3].
        albedo: untextured albedo per mesh, [meshes,3].
    """

    intensity: torch.Tensor | None = None
    color: torch.Tensor | None = None
    position: torch.Tensor | None = None
    albedo: torch.Tensor | None = None

    def __bool__(self) -> bool:
        """True if anything is given."""
        return any(v is not None for v in (self.intensity, self.color, self.position, self.albedo))

    def scale(self) -> torch.Tensor | None:
        """Factor on each light's power, [lights,3], or None."""
        if self.intensity is None or self.color is None:
            return self.color if self.intensity is None else self.intensity[:, None].expand(-1, 3)
        return self.intensity[:, None] * self.color


@dataclass(frozen=True, eq=False)
class Receivers:
    """Points that ask for irradiance.

    Attributes:
        position: [n,3] m.
        normal: unit normals on the free side, [n,3].
        visible: which point, spot and directional light each sees, uint8 [n,m] (component "direct" only).
        reads: cells that each may read, for each of the configuration's grids; empty where the lookup reads all eight.
        lookup: what they were picked by.
        boxes: for each of the grids a box of cells that holds all that is read, (z, y, x) as (begin, end) pairs.
        rows: which of the configuration's light probes each reads; ``reads`` and ``boxes`` are those of the probes then.
    """

    position: torch.Tensor
    normal: torch.Tensor
    visible: torch.Tensor | None = None
    reads: tuple[CellReads, ...] = ()
    lookup: Lookup = "trilinear"
    boxes: tuple[tuple[int, ...], ...] = ()
    rows: Rows | None = None
    _lobes: dict[int, torch.Tensor] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.position)

    def lobes(self, l_max: int) -> torch.Tensor:
        """What each reads light with that flies along its coefficients, [n,(l_max+1)^2]: made once."""
        if l_max not in self._lobes:
            self._lobes[l_max] = cosine_lobe(-self.normal, l_max)
        return self._lobes[l_max]


@dataclass(frozen=True, eq=False)
class Illumination:
    """One scene under one set of lights, for one component; see ``illuminate``.

    Attributes:
        component: "direct" or "bounce1".
        scene: with its lights.
        grid: cells of the volume.
        config: the solve it was traced for.
        emitters: all lights (area lights as samples of their surface).
        samples: lit surface samples that start the bounce of area lights, or None.
        visible: which emitter each sample sees, uint8.
        rsms: one per point, spot or directional light (component "bounce1").
        blocking: what stands between the cells of each of the configuration's grids, finest first.
        raycaster: over the scene.
    """

    component: Component
    scene: Scene
    grid: Grid
    config: LpvConfig
    emitters: Emitters
    samples: SurfaceSamples | None
    visible: torch.Tensor | None
    rsms: tuple[Rsm, ...]
    blocking: tuple[Blocking, ...]
    raycaster: Raycaster

    def on(
        self,
        grid: Grid,
        config: LpvConfig,
        *,
        blocking: tuple[Blocking, ...] | None = None,
        surface_samples: int = 8192,
        seed: int = 0,
    ) -> Illumination:
        """The same lights in other cells or for another solve: what they see, and their VPLs, are not traced again.

        Args:
            grid: cells of the volume.
            config: the solve.
            blocking: as for ``illuminate``; traced if None, with all surfaces as blockers of a geometry volume.
            surface_samples: as for ``illuminate``.
            seed: as for ``illuminate``.
        """
        like = self.emitters.position

        def surfels() -> tuple[Blockers, bool]:
            return _surface_blockers(self.scene, surface_samples, seed, like.dtype, like.device), True

        if blocking is None:
            blocking = tuple(
                blocking_of(self.scene, level, config, self.raycaster, surfels, dtype=like.dtype, device=like.device)
                for level in config.grids(grid)
            )
        other = replace(self, grid=grid, config=config, blocking=blocking)
        kept = ["_scene_vpls"] + (["_scene_vpl_cells"] if grid == self.grid else [])
        other.__dict__.update({name: self.__dict__[name] for name in kept if name in self.__dict__})
        return other

    def _punctual(self) -> torch.Tensor:
        return ~_of_area_lights(self.scene, self.emitters)

    def vpls(self, values: LightValues | None = None) -> Vpls:
        """All virtual point lights of the component; empty where no light needs the volume."""
        return self._scene_vpls if not values else self._shade(values)

    @cached_property
    def _scene_vpls(self) -> Vpls:
        with torch.no_grad():
            return self._shade(LightValues())

    def vpl_cells(self, vpls: Vpls, bias: float = _BIAS) -> OpenCells:
        """Cells that each VPL may give to, for deposit="visible": traced once for the scene's own lights, anew for moved ones.

        Args:
            vpls: all of the component.
            bias: offset along the normal [cells].
        """
        own = self._scene_vpls
        if bias == _BIAS and torch.equal(vpls.position, own.position):
            return self._scene_vpl_cells
        return self._open_cells(vpls.position, vpls.normal, "visible", self.grid, bias)

    @cached_property
    def _scene_vpl_cells(self) -> OpenCells:
        vpls = self._scene_vpls
        return self._open_cells(vpls.position, vpls.normal, "visible", self.grid, _BIAS)

    def _open_cells(
        self, position: torch.Tensor, normal: torch.Tensor, mode: Literal["front", "visible", "affine"], grid: Grid,
        bias: float,
    ) -> OpenCells:  # fmt: skip
        return open_cells(
            position.detach().cpu().numpy(), normal.detach().cpu().numpy(), grid, mode=mode, raycaster=self.raycaster,
            bias=bias, dtype=position.dtype, device=position.device,
        )  # fmt: skip

    def _shade(self, values: LightValues) -> Vpls:
        emitters = self.emitters.adjusted(scale=values.scale(), offset=values.position)
        punctual = self._punctual()
        if self.component == "direct":
            return area_light_vpls(emitters.select(~punctual))
        parts = [self._rsm_vpls(rsm, emitters, values) for rsm in self.rsms]
        if self.samples is not None and self.visible is not None:
            area = emitters.select(~punctual)
            albedo = None if values.albedo is None else self.samples.albedo_from(values.albedo)
            parts.append(lit_surface_vpls(self.samples, area, self.visible, albedo=albedo))
        return Vpls.cat(parts)

    def _rsm_vpls(self, rsm: Rsm, emitters: Emitters, values: LightValues) -> Vpls:
        light = int((emitters.light_index == rsm.light_index).nonzero()[0])
        albedo = None if values.albedo is None else rsm.albedo_from(values.albedo)
        position = None if rsm.light == "directional" else emitters.position[light]
        return rsm_vpls(rsm, position=position, power=emitters.power[light], albedo=albedo)

    def receivers(self, position: np.ndarray | torch.Tensor, normal: np.ndarray | torch.Tensor) -> Receivers:
        """Receivers [n,3] m with unit normals [n,3], and the rays that direct light of punctual lights and the lookup need.

        Raises:
            ValueError: a wrong shape, a number that is not finite, or a normal that is no unit vector.
        """
        like = self.emitters.position
        x, n = (torch.as_tensor(a, dtype=like.dtype, device=like.device).detach() for a in (position, normal))
        check_points("position", x)
        check_points("normal", n, count=len(x))
        length = torch.linalg.vector_norm(n, dim=1)
        if bool(((length - 1).abs() > 1e-3).any()):
            worst = int((length - 1).abs().argmax())
            raise ValueError(f"normal: expected unit length, got {float(length[worst]):.6g} in row {worst}")
        seen, rows, grids = None, None, self.config.grids(self.grid)
        reads: list[CellReads] = []
        boxes = [_box_around(x, grid) for grid in grids]
        if self.config.probes:
            reads, rows = list(self.probes.reads), self.probes.rows(x)
            boxes = [r.box(grid) for r, grid in zip(reads, grids, strict=True)]
        elif self.config.lookup in ("front", "visible", "affine"):
            for grid in grids:
                usable = self._open_cells(x, n, self.config.lookup, grid, _BIAS)
                reads.append(CellReads(usable.cells, usable.weights(x, n, grid), usable.backed))
            boxes = [r.box(grid) for r, grid in zip(reads, grids, strict=True)]
        punctual = self._punctual()
        if self.component == "direct" and bool(punctual.any()):
            seen = visibility(x, n, self.emitters.select(punctual), self.raycaster)
        return Receivers(x, n, seen, tuple(reads), self.config.lookup or "trilinear", tuple(boxes), rows)

    @cached_property
    def probes(self) -> VolumeProbes:
        """The configuration's light probes in this volume."""
        like, position = self.emitters.position, np.array(self.config.probes)
        return VolumeProbes.of(position, self.config.grids(self.grid), self.raycaster, dtype=like.dtype, device=like.device)

    def punctual_irradiance(self, receivers: Receivers, values: LightValues | None = None) -> torch.Tensor | None:
        """Direct irradiance [n,3] W/m2 of point, spot and directional lights by shadow rays; None where there is none."""
        if receivers.visible is None:
            return None
        values = values or LightValues()
        lights = self.emitters.adjusted(scale=values.scale(), offset=values.position).select(self._punctual())
        return direct_irradiance(receivers.position, receivers.normal, lights, receivers.visible)


def illuminate(
    scene: Scene,
    grid: Grid,
    config: LpvConfig,
    component: Component = "bounce1",
    *,
    surface_samples: int = 8192,
    area_samples: int = 64,
    rsm_resolution: int = 128,
    texel_flux: TexelFlux = "exact",
    blockers: Literal["surface", "rsm"] = "surface",
    blocking: tuple[Blocking, ...] | None = None,
    seed: int = 0,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Illumination:
    """Trace what a solve needs of a scene, once.

    Args:
        scene: with the lights to solve for (``difflpv.lights.apply_light_set``).
        grid: cells of the volume.
        config: decides the stencil and whether geometry blocks.
        component: "direct": area lights are VPLs and the volume carries their direct light, punctual lights are exact;
            "bounce1": VPLs on lit surfaces, an RSM per punctual light, surface samples for area lights.
        surface_samples: surface points (each with two sides) that carry the bounce and block light.
        area_samples: samples per area light.
        rsm_resolution: texels along an edge of an RSM face.
        texel_flux: what a texel receives, see ``difflpv.rsm.render_rsm``.
        blockers: what fills the geometry volume: all surfaces by area, or only what the RSMs see (the publications); a
            linear stencil's pairs of cells see each of them from both sides.
        blocking: of an earlier illumination of the same geometry on these grids with this occlusion, such as under other
            lights: what stands between cells is then not traced again.
        seed: of all samples.
        dtype: float32 to run, float64 to check gradients.
        device: where the solve runs.

    Raises:
        SceneError: a scene too small, too large or too far from the origin for the float32 of rays and form factors.
        ValueError: an unknown choice, ``blockers="rsm"`` where no light has an RSM, or ``blocking`` of another number of
            grids.
    """
    _check_extent(scene)
    if component not in get_args(Component):
        raise ValueError(f"component: expected 'direct' or 'bounce1', got {component!r}")
    if blockers not in ("surface", "rsm"):
        raise ValueError(f"blockers: expected 'surface' or 'rsm', got {blockers!r}")
    if blocking is not None and len(blocking) != len(config.grids(grid)):
        raise ValueError(f"blocking: expected that of {len(config.grids(grid))} grid(s), got {len(blocking)}")
    raycaster = Raycaster(scene)
    emitters = emitters_of(scene, area_samples=area_samples, seed=seed, dtype=dtype, device=device)
    samples, visible = None, None
    rsms: tuple[Rsm, ...] = ()
    has_area = any(isinstance(light, AreaLight) for light in scene.lights)
    if component == "bounce1" and has_area:
        lit = sample_surfaces(scene, surface_samples, seed=seed, dtype=dtype, device=device)
        of_area = emitters.select(_of_area_lights(scene, emitters))
        samples, visible = drop_unlit(lit, visibility(lit.position, lit.normal, of_area, raycaster))
    if component == "bounce1" or (blockers == "rsm" and config.occlusion != "none"):
        rsms = tuple(
            replace(  # by its place: one light may be there twice
                render_rsm(
                    scene, light, raycaster, resolution=rsm_resolution, texel_flux=texel_flux, dtype=dtype, device=device
                ),
                light_index=place,
            )
            for place, light in enumerate(scene.lights)
            if not isinstance(light, AreaLight)
        )

    def surfels() -> tuple[Blockers, bool]:
        if blockers == "rsm":
            parts = [Blockers(*rsm_blockers(rsm)) for rsm in rsms]
            if not parts:
                raise ValueError("blockers: 'rsm' needs a point, spot or directional light; use 'surface'")
            joined = (torch.cat([getattr(p, name) for p in parts]) for name in ("position", "normal", "area"))
            return Blockers(*joined), False
        return _surface_blockers(scene, surface_samples, seed, dtype, device), True

    if blocking is None:
        blocking = tuple(
            blocking_of(scene, level, config, raycaster, surfels, dtype=dtype, device=device) for level in config.grids(grid)
        )
    if component == "direct":
        rsms = ()
    return Illumination(component, scene, grid, config, emitters, samples, visible, rsms, blocking, raycaster)


def _surface_blockers(scene: Scene, count: int, seed: int, dtype: torch.dtype, device: torch.device | str) -> Blockers:
    """All surfaces by area, each once."""
    s = sample_surfaces(scene, count, seed=seed, dtype=dtype, device=device, both_sides=False, include_lights=True)
    return Blockers(s.position, s.normal, s.area)


def _check_extent(scene: Scene) -> None:
    """Refuse what would come out dark or torn without a word (measured: docs/stability.md)."""
    low, high = scene.bounds
    extent, reach = float((high - low).max()), float(np.abs([low, high]).max())
    smallest, largest = _EXTENTS
    if not smallest <= extent <= largest:
        raise SceneError(
            f"scene '{scene.name}': {extent:.3g} m across, rays and form factors work from {smallest:g} to {largest:g} m: "
            "rescale it to metres"
        )
    if reach > _FARTHEST * extent:
        raise SceneError(
            f"scene '{scene.name}': {extent:.3g} m across but {reach:.3g} m from the origin, more than {_FARTHEST:g} times its "
            "size: float32 rays cannot tell its surfaces apart; move it to the origin"
        )


def _box_around(x: torch.Tensor, grid: Grid) -> tuple[int, ...]:
    """Box of the cells that points [n,3] m may read by trilinear weights, whatever their normal and bias are."""
    if not len(x):
        return (0, 0, 0, 0, 0, 0)
    low, high = ((v.cpu().double().numpy() - grid.minimum) / grid.cell_size for v in (x.amin(0), x.amax(0)))
    size = np.array(grid.resolution)
    begin = np.clip(np.floor(low - _FARTHEST_READ), 0, size - 1).astype(int)
    end = np.clip(np.ceil(high + _FARTHEST_READ), 1, size).astype(int)
    return tuple(int(v) for axis in (2, 1, 0) for v in (begin[axis], end[axis]))


def _of_area_lights(scene: Scene, emitters: Emitters) -> torch.Tensor:
    """Which emitters sample an area light, bool [m]."""
    area = torch.tensor([isinstance(light, AreaLight) for light in scene.lights], device=emitters.kind.device)
    return area[emitters.light_index]
