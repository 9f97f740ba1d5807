"""What an ``Lpv`` can learn: names, starting values and bounds.

| name | shape | start | bounds | gradient through |
|---|---|---|---|---|
| propagation | [] | 1 | 0..2 (energy), 0..8 (thesis) | propagation |
| propagation_steps | [steps] | 1 | the same, times ``propagation`` | propagation |
| occlusion | [] | 1 | 0..8 | geometry volume, or strength of traced transmittance (from 0.001) |
| occlusion_correction | [3] | 1 | 0.001..8 | strength of traced transmittance towards face, edge and corner neighbours |
| cell_propagation | [n_z,n_y,n_x] | 1 | 0.001..2 | transmittance: geometric mean of the two cells of a pair |
| cell_occlusion | [n_z,n_y,n_x] | 1 | 0.001..8 | strength of occlusion: geometric mean of the two cells of a pair |
| stencil | [free numbers] | the stencil's | none | propagation: cube-symmetric, l=0 gain held at 1 |
| lookup_gains | [l_max+1] | the stencil's | 0..2 | sampling |
| sampling_bias, injection_bias | [] | 0.5 cells | -0.5..2 | sampling, smooth deposit |
| light_intensity, light_color | [lights], [lights,3] | 1 (times the scene's) | > 0 | shading |
| light_position | [lights,3] | 0 m (offset) | none | smooth deposit, shading |
| albedo | [meshes,3] | the scene's | 0..1 | shading |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from difflpv.config import LpvConfig
from difflpv.grid import Grid
from difflpv.parameters import Parameter
from difflpv.scene import Scene
from difflpv.stencil import LinearStencil
from difflpv.stencil_coordinates import StencilCoordinates

__all__ = ["CELL_LEARNABLES", "GLOBAL_LEARNABLES", "LEARNABLES", "SCENE_LEARNABLES", "describe_learnables", "fixed_values"]

GLOBAL_LEARNABLES = (
    "propagation", "propagation_steps", "occlusion", "occlusion_correction", "sampling_bias", "injection_bias", "lookup_gains",
    "stencil",
)  # fmt: skip
CELL_LEARNABLES = ("cell_propagation", "cell_occlusion")
SCENE_LEARNABLES = ("light_intensity", "light_color", "light_position", "albedo")
LEARNABLES = GLOBAL_LEARNABLES + CELL_LEARNABLES + SCENE_LEARNABLES
_NEEDS_SMOOTH_DEPOSIT = ("injection_bias", "light_position")
_STENCIL_SCALE = 0.02  # a typical change of a free number; the learned ones differ from the published kernel's by 0.01 to 0.3
_LEAST = 1e-3  # of what is divided by or taken the logarithm of
_ALBEDO_MARGIN = 1e-3  # an albedo of exactly 0 or 1 lies on its bound and could not be learned


def fixed_values(config: LpvConfig) -> dict[str, torch.Tensor]:
    """Values of the scene-free quantities where nothing is learned, float64."""
    one, half = torch.ones((), dtype=torch.float64), torch.full((), 0.5, dtype=torch.float64)
    return {
        "propagation": one,
        "propagation_steps": torch.ones(config.steps, dtype=torch.float64),
        "occlusion": one,
        "sampling_bias": half,
        "injection_bias": half,
        "lookup_gains": torch.tensor(config.stencil.lookup_gains, dtype=torch.float64),
    }


def describe_learnables(
    names: Sequence[str],
    config: LpvConfig,
    grid: Grid,
    scene: Scene | None = None,
    initial: Mapping[str, Any] | None = None,
) -> list[Parameter]:
    """Descriptions of the named learnables.

    Args:
        names: from ``LEARNABLES``, each once.
        config: the solve; decides bounds, and what can have a gradient at all.
        grid: sets the scale of lengths.
        scene: needed for lights and albedo.
        initial: starting values by name, instead of the table's.

    Raises:
        ValueError: an unknown name, a name twice, or one that this configuration cannot learn.
    """
    for name in names:
        if name not in LEARNABLES:
            raise ValueError(f"learn: expected names from {', '.join(LEARNABLES)}, got {name!r}")
        if list(names).count(name) > 1:
            raise ValueError(f"learn: '{name}' is named twice")
        if name in ("occlusion", "cell_occlusion") and config.occlusion == "none":
            raise ValueError(f"learn: '{name}' needs occlusion='clamp', 'exp' or 'traced', got 'none'")
        if name == "occlusion_correction" and config.occlusion != "traced":
            raise ValueError(f"learn: 'occlusion_correction' needs occlusion='traced', got {config.occlusion!r}")
        if name in _NEEDS_SMOOTH_DEPOSIT and config.deposit == "nearest":
            raise ValueError(f"learn: '{name}' needs deposit='trilinear' or 'visible', got 'nearest'")
        if name == "sampling_bias" and config.lookup not in ("trilinear", "damped"):
            raise ValueError(f"learn: 'sampling_bias' needs lookup='trilinear' or 'damped', got {config.lookup!r}")
        if name == "stencil" and not isinstance(config.stencil, LinearStencil):
            raise ValueError(f"learn: 'stencil' needs a learned stencil, got method {config.method!r}")
        if name in CELL_LEARNABLES and config.fine_steps < config.steps:
            raise ValueError(f"learn: '{name}' belongs to one grid, coarsen_after={config.coarsen_after} makes two")
        if name == "propagation_steps" and not config.steps:
            raise ValueError("learn: 'propagation_steps' needs at least one step")
        if name in SCENE_LEARNABLES and scene is None:
            raise ValueError(f"learn: '{name}' belongs to a scene: pass scene=")
    starts: dict[str, Any] = dict(fixed_values(config))
    starts["occlusion_correction"] = torch.ones(3, dtype=torch.float64)
    starts["cell_propagation"] = starts["cell_occlusion"] = torch.ones(grid.shape, dtype=torch.float64)
    if "stencil" in names and isinstance(config.stencil, LinearStencil):
        starts["stencil"] = StencilCoordinates.for_stencil(config.stencil).of(config.stencil)
    bounds: dict[str, tuple[float, float, float | None]] = {
        "propagation": (0.0, 2 * config.critical_factor, None),
        "propagation_steps": (0.0, 2.0, None),
        "occlusion": (_LEAST if config.occlusion == "traced" else 0.0, 8.0, None),
        "occlusion_correction": (_LEAST, 8.0, None),
        "cell_propagation": (_LEAST, 2.0, None),
        "cell_occlusion": (_LEAST, 8.0, None),
        "stencil": (-np.inf, np.inf, _STENCIL_SCALE),
        "lookup_gains": (0.0, 2.0, None),
        "sampling_bias": (-0.5, 2.0, None),
        "injection_bias": (-0.5, 2.0, None),
        "light_intensity": (0.0, np.inf, None),
        "light_color": (0.0, np.inf, None),
        "light_position": (-np.inf, np.inf, grid.cell_size),
        "albedo": (0.0, 1.0, None),
    }
    if scene is not None:
        lights = len(scene.lights)
        starts["light_intensity"] = torch.ones(lights, dtype=torch.float64)
        starts["light_color"] = torch.ones(lights, 3, dtype=torch.float64)
        starts["light_position"] = torch.zeros(lights, 3, dtype=torch.float64)
        starts["albedo"] = torch.as_tensor(scene.mesh_albedo).clamp(_ALBEDO_MARGIN, 1 - _ALBEDO_MARGIN)
    unknown = set(initial or {}) - set(names)
    if unknown:
        raise ValueError(f"initial: expected names that are learned, got {sorted(unknown)}")
    starts.update(initial or {})
    return [Parameter(n, starts[n], lower=bounds[n][0], upper=bounds[n][1], scale=bounds[n][2]) for n in names]
