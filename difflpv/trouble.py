"""What a user should be told about a solve that returned numbers: each way in which they may be worth little, and the cure.

A solve that overflows raises; what is checked here is finite and wrong. docs/stability.md charts every limit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch

from difflpv.illumination import Illumination
from difflpv.pipeline import Lpv
from difflpv.stability import TOLERANCE

__all__ = ["describe_trouble", "free_space"]

_LOST_SHARE = 1e-6
_PEAK_GROWTH = 10.0  # a fit may raise some steps' factors; light that grows tenfold on its way is no transport
_NEGATIVE_SHARE = 0.05  # the lobes' own truncation makes 0.02 to 0.03 (``difflpv.stability.negative_share``)
_NARROW_CELLS = 1.5  # free space that a receiver needs: errors double between two cells per room and one
_NARROW_SHARE = 0.25  # of the receivers
_SPARSE = 4.0  # cell faces per sample: fewer samples than that begin to show
_TRAINED = 32  # cells: learned stencils were trained to 16, and hold out to twice that
_THIN_SHARE = 0.02  # of the receivers
_PROBED = 512  # receivers whose surroundings are looked at
_HIGH_ALBEDO = 0.9
_ASKED_VPLS = 32  # whether they light the other side of a wall


def describe_trouble(
    lpv: Lpv,
    light: Illumination,
    position: np.ndarray,
    normal: np.ndarray,
    irradiance: np.ndarray,
    values: Mapping[str, torch.Tensor] | None = None,
) -> tuple[str, ...]:
    """Warnings about a solve, a line each with its cure; none where there is nothing to say.

    Args:
        lpv: the module, after the solve.
        light: what it solved.
        position: receivers [n,3] m.
        normal: unit normals [n,3].
        irradiance: the result [n,3] W/m2.
        values: as given to the solve.
    """
    found = [_outside(lpv, position)]
    if len(light.vpls()):
        found = [_lost(lpv), *found, _growth(lpv, values), _reach(lpv, light), _untrained(lpv, light), _sparse(lpv, light)]
        found += [*_cells(lpv, light, position, normal), _negative(irradiance), _albedo(light), _dim(light)]
    return tuple(line for line in found if line)


def free_space(light: Illumination, position: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Free space in front of receivers and matter behind them, along the normal [m], [n] each; inf where a ray meets nothing.

    A wall of one sheet has 0 m of matter: some of the VPLs light its other side, which they cannot inside a solid.

    Args:
        light: holds the rays.
        position: on surfaces [n,3] m.
        normal: unit normals on the free side [n,3].
    """
    lift = light.raycaster.offset * normal
    front = light.raycaster.closest(position + lift, normal).distance
    behind = light.raycaster.closest(position - lift, -normal).distance
    return front, np.where(_lit_behind(light, position - lift, normal), 0.0, behind)


def _lit_behind(light: Illumination, behind: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """True where some VPLs light points [n,3] just behind surfaces with normals [n,3], bool [n]."""
    vpls = light.vpls()
    some = np.unique(np.linspace(0, max(len(vpls) - 1, 0), min(len(vpls), _ASKED_VPLS)).round().astype(int))
    source, facing = (a.detach().cpu().double().numpy()[some] for a in (vpls.position, vpls.normal))
    way = source - behind[:, None]
    open_sides = ((way * -normal[:, None]).sum(-1) > 0) & ((-way * facing).sum(-1) > light.raycaster.offset)
    lit = np.zeros(open_sides.shape, bool)
    rows, columns = np.nonzero(open_sides)
    lit[rows, columns] = ~light.raycaster.blocked(behind[rows], source[columns] + light.raycaster.offset * facing[columns])
    return np.asarray(lit.any(1))


def _lost(lpv: Lpv) -> str:
    if lpv.report is None or not float(lpv.report.lost_share) > _LOST_SHARE:
        return ""
    return (
        f"the grid {_corner(lpv.grid.minimum)} .. {_corner(lpv.grid.maximum)} m does not contain the scene: "
        f"{int(lpv.report.lost_count)} VPLs with {100 * float(lpv.report.lost_share):.3g} % of the flux are lost"
    )


def _outside(lpv: Lpv, position: np.ndarray) -> str:
    outside = int((~lpv.grid.contains(position)).sum())
    return f"{outside} of {len(position)} receivers lie outside the grid and read its edge cells" if outside else ""


def _growth(lpv: Lpv, values: Mapping[str, torch.Tensor] | None) -> str:
    """Light that grows from step to step: by the factors' product, the published and learned stencils being neutral at 1."""
    factors = lpv.step_factors(values) / lpv.config.critical_factor
    if not len(factors):
        return ""
    growth = factors.double().clamp_min(1e-300).log().cumsum(0)
    if float(growth[-1]) <= TOLERANCE * len(factors) and float(growth.max()) <= math.log(_PEAK_GROWTH):
        return ""
    peak = int(growth.argmax()) + 1
    mean = lpv.config.critical_factor * math.exp(float(growth[peak - 1]) / peak)
    times = math.exp(min(float(growth.max()), 690.0))
    return (
        f"the propagation factor ({mean:.4g} on average over {peak} steps) lies beyond its critical value "
        f"{lpv.config.critical_factor:g}: light grows up to {times:.3g} times that was never emitted; lower the factor"
    )


def _reach(lpv: Lpv, light: Illumination) -> str:
    """Light moves at most one cell per step along each axis."""
    cells, config = _span(lpv, light), lpv.config
    reach = 2 * config.steps - config.fine_steps
    if reach >= cells - 1 or config.tolerance > 0:
        return ""
    return (
        f"{config.steps} steps carry light {reach} cells at most, the scene spans {cells}: what lies farther "
        f"from the light stays dark; take at least {config.steps + cells - 1 - reach} steps, larger cells or coarsen_after"
    )


def _span(lpv: Lpv, light: Illumination) -> int:
    """Cells that the scene fills along its longest axis."""
    low, high = light.scene.bounds
    low, high = np.maximum(low, lpv.grid.minimum), np.minimum(high, lpv.grid.maximum)
    return int(np.ceil(float((high - low).max()) / lpv.grid.cell_size - 1e-6))


def _untrained(lpv: Lpv, light: Illumination) -> str:
    cells = _span(lpv, light)
    if not lpv.config.method.startswith("learned") or cells <= _TRAINED * (1 if len(lpv.config.grids(lpv.grid)) == 1 else 2):
        return ""
    return (
        f"the scene spans {cells} cells, '{lpv.config.method}' was trained to {_TRAINED // 2} and holds to about {_TRAINED}: "
        "far light is wrong; take larger cells, or two cell sizes (coarsen_after)"
    )


def _sparse(lpv: Lpv, light: Illumination) -> str:
    """Samples farther apart than cells leave cells dark that should be lit, and holes in walls."""
    vpls, scene = light.vpls(), light.scene
    if light.samples is not None:
        areas = light.samples.area
    elif light.component == "direct":
        shines = scene.mesh_emission.max(1)[scene.triangle_mesh] > 0
        areas = torch.tensor([float(scene.triangle_areas[shines].sum()) / len(vpls)])
    else:
        return ""
    faces = float(areas.double().mean()) / lpv.grid.cell_size**2 if len(areas) else 0.0
    if not faces > _SPARSE:
        return ""
    return (
        f"{len(vpls)} VPLs are few for cells of {lpv.grid.cell_size:.3g} m: one per {faces:.3g} cell faces, and the cells "
        "between stay dark; illuminate with more surface_samples and area_samples, or take larger cells"
    )


def _cells(lpv: Lpv, light: Illumination, position: np.ndarray, normal: np.ndarray) -> list[str]:
    """Cells larger than rooms, and walls thinner than a cell, as a sample of the receivers sees them."""
    if not len(position):
        return []
    some = np.unique(np.linspace(0, len(position) - 1, min(len(position), _PROBED)).round().astype(int))
    front, behind = free_space(light, np.asarray(position)[some], np.asarray(normal)[some])
    size, lines = lpv.grid.cell_size, []
    narrow, thin = float((front < _NARROW_CELLS * size).mean()), float((behind < size).mean())
    if narrow > _NARROW_SHARE:
        lines.append(
            f"cells of {size:.4g} m are too large for the rooms: {100 * narrow:.0f} % of the receivers have less than "
            f"{_NARROW_CELLS:g} cells of free space in front of them (median {np.median(front):.3g} m); take more cells"
        )
    closed = lpv.config.occlusion == "traced" and lpv.config.lookup in ("front", "visible", "affine")
    if thin > _THIN_SHARE and not closed:
        lines.append(
            f"walls are thinner than a cell of {size:.4g} m: {100 * thin:.0f} % of the receivers lie on less than a cell of "
            f"matter (thinnest {behind.min():.2g} m), and light leaks through it; take smaller cells or occlusion 'traced'"
        )
    return lines


def _negative(irradiance: np.ndarray) -> str:
    below, above = float(np.maximum(-irradiance, 0).sum()), float(np.maximum(irradiance, 0).sum())
    if not below > _NEGATIVE_SHARE * above:
        return ""
    rows = int((irradiance < 0).any(1).sum())
    share = f"{100 * below / above:.3g} % of the positive sum" if above > 0 else "and positive nowhere"
    return (
        f"irradiance is negative at {rows} of {len(irradiance)} receivers ({share}): negative lobes; use clamp, another "
        "stencil, smaller cells or more steps"
    )


def _albedo(light: Illumination) -> str:
    if light.component != "bounce1":
        return ""
    mesh, emission = light.scene.triangle_mesh, light.scene.mesh_emission.max(1)
    area = np.where(emission[mesh] > 0, 0.0, light.scene.triangle_areas)
    albedo = float((area * light.scene.mesh_albedo.mean(1)[mesh]).sum() / max(area.sum(), 1e-300))
    if not albedo > _HIGH_ALBEDO:
        return ""
    return (
        f"the mean albedo is {albedo:.3g}: in a closed room the first bounce is about {100 * (1 - albedo):.2g} % of all "
        "reflected light, and component 'bounce1' holds nothing else"
    )


def _dim(light: Illumination) -> str:
    """Below tiny / eps, numbers lose digits on their way, and then everything."""
    flux = light.vpls().flux
    limits = torch.finfo(flux.dtype)
    brightest = float(flux.max())
    if not 0 <= brightest < limits.tiny / limits.eps or not _shines(light):
        return ""
    kind = str(flux.dtype).removeprefix("torch.")
    return (
        f"the lights are too dim for {kind}: the brightest VPL has {brightest:.3g} W, below {limits.tiny / limits.eps:.2g} W "
        "digits are lost; scale the lights and divide the result"
    )


def _shines(light: Illumination) -> bool:
    """True unless every light of the scene is exactly dark."""
    names = ("radiance", "intensity", "irradiance")
    return any(np.any(getattr(item, name, 0.0)) for item in light.scene.lights for name in names)


def _corner(values: tuple[float, float, float]) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in values) + ")"
