"""What an ``Lpv`` can learn: names, starting values and bounds.

| name | shape | start | bounds | gradient through |
|---|---|---|---|---|
| propagation | [] | 1 | 0..2 (energy), 0..8 (thesis) | propagation |
| propagation_steps | [steps] | 1 | the same, times ``propagation`` | propagation |
| occlusion | [] | 1 | 0..8 | geometry volume |
| sampling_bias, injection_bias | [] | 0.5 cells | -0.5..2 | sampling, trilinear deposit |
| light_intensity, light_color | [lights], [lights,3] | 1 (times the scene's) | > 0 | shading |
| light_position | [lights,3] | 0 m (offset) | none | trilinear deposit, shading |
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

__all__ = ["GLOBAL_LEARNABLES", "LEARNABLES", "SCENE_LEARNABLES", "describe_learnables", "fixed_values"]

GLOBAL_LEARNABLES = ("propagation", "propagation_steps", "occlusion", "sampling_bias", "injection_bias")
SCENE_LEARNABLES = ("light_intensity", "light_color", "light_position", "albedo")
LEARNABLES = GLOBAL_LEARNABLES + SCENE_LEARNABLES
_NEEDS_TRILINEAR = ("injection_bias", "light_position")
_ALBEDO_MARGIN = 1e-3  # an albedo of exactly 0 or 1 lies on its bound and could not be learned


def fixed_values(config: LpvConfig) -> dict[str, torch.Tensor]:
    """Values of the scene-free quantities where nothing is learned, float64."""
    one, half = torch.ones((), dtype=torch.float64), torch.full((), 0.5, dtype=torch.float64)
    steps = torch.ones(config.steps, dtype=torch.float64)
    return dict(zip(GLOBAL_LEARNABLES, (one, steps, one, half, half), strict=True))


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
        if name == "occlusion" and config.occlusion == "none":
            raise ValueError("learn: 'occlusion' needs occlusion='clamp' or 'exp', got 'none'")
        if name in _NEEDS_TRILINEAR and config.deposit != "trilinear":
            raise ValueError(f"learn: '{name}' needs deposit='trilinear', got {config.deposit!r}")
        if name == "propagation_steps" and not config.steps:
            raise ValueError("learn: 'propagation_steps' needs at least one step")
        if name in SCENE_LEARNABLES and scene is None:
            raise ValueError(f"learn: '{name}' belongs to a scene: pass scene=")
    starts: dict[str, Any] = dict(fixed_values(config))
    bounds: dict[str, tuple[float, float, float | None]] = {
        "propagation": (0.0, 2 * config.critical_factor, None),
        "propagation_steps": (0.0, 2.0, None),
        "occlusion": (0.0, 8.0, None),
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
