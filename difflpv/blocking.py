"""What stands between the cells of one grid, as the configured occlusion model sees it: traced once, held fixed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from difflpv.config import LpvConfig
from difflpv.grid import Grid
from difflpv.occlusion import Blockers, blocking_potential, geometry_volume
from difflpv.raycast import Raycaster
from difflpv.scene import Scene
from difflpv.stencil import FaceStencil, pair_offsets
from difflpv.traced import face_transmittance, pair_transmittance

__all__ = ["Blocking", "blocking_of"]


@dataclass(frozen=True, eq=False)
class Blocking:
    """Blockers of one grid; both None where nothing blocks.

    Attributes:
        potential: blocking potential of the geometry volume, shape [F, n_z, n_y, n_x] for the faces or [P, ...] for the
            pairs of the configuration's stencil; None with another occlusion.
        passed: traced transmittance, shape likewise; None with another occlusion.
    """

    potential: torch.Tensor | None = None
    passed: torch.Tensor | None = None


def blocking_of(
    scene: Scene,
    grid: Grid,
    config: LpvConfig,
    raycaster: Raycaster,
    surfels: Callable[[], tuple[Blockers, bool]],
    *,
    dtype: torch.dtype,
    device: torch.device | str,
) -> Blocking:
    """Trace or collect what blocks light between the cells of a grid.

    Args:
        scene: the geometry.
        grid: cells.
        config: decides the model and the stencil.
        raycaster: over the scene.
        surfels: of the geometry volume, and whether they block from both sides; called only where it is used.
        dtype: of the result.
        device: of the result.
    """
    stencil = config.stencil
    if config.occlusion == "none":
        return Blocking()
    pairs = pair_offsets(stencil.offsets)
    if config.occlusion == "traced":
        shares = pair_transmittance(raycaster, scene.triangle_vertices, grid, pairs)
        passed = torch.as_tensor(shares, dtype=dtype, device=device)
        if isinstance(stencil, FaceStencil):
            passed = face_transmittance(passed, pairs, stencil.offsets)
        return Blocking(passed=passed)
    blockers, two_sided = surfels()
    if isinstance(stencil, FaceStencil):
        corners = geometry_volume(blockers, grid, l_max=stencil.l_max, two_sided=two_sided)
        return Blocking(blocking_potential(corners, stencil.offsets, stencil.directions))
    # a pair is blocked both ways alike; the cosine lobe has no degree 3
    corners = geometry_volume(blockers, grid, l_max=min(stencil.l_max, 2), two_sided=True)
    return Blocking(blocking_potential(corners, pairs, pairs / np.linalg.norm(pairs, axis=1, keepdims=True)))
