"""Torch twin of injection: the equations of physics.md, "The chain" 3, with one indexed addition per corner.

Imports torch and ``difflpv.sh`` (the one SH convention, torch-agnostic polynomials) only.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch

from difflpv.sh import cosine_lobe

__all__ = ["inject", "trilinear_corners"]


def trilinear_corners(
    cells: torch.Tensor, resolution: Sequence[int]
) -> list[tuple[tuple[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]]:
    """The eight ((z, y, x) cell indices [n], weight [n]) around points of cell coordinates [n,3]; indices clipped."""
    base = torch.floor(cells.detach() - 0.5)
    fraction = cells - 0.5 - base
    corners = []
    for bits in itertools.product((0, 1), repeat=3):
        index, weight = [], torch.ones_like(cells[:, 0])
        for axis in range(3):
            index.append((base[:, axis] + bits[axis]).clamp(0, resolution[axis] - 1).long())
            weight = weight * (fraction[:, axis] if bits[axis] else 1 - fraction[:, axis])
        corners.append(((index[2], index[1], index[0]), weight))
    return corners


def inject(
    position: torch.Tensor,
    normal: torch.Tensor,
    flux: torch.Tensor,
    minimum: Sequence[float],
    cell_size: float,
    resolution: Sequence[int],
    *,
    l_max: int,
    deposit: str = "nearest",
    bias: float | torch.Tensor = 0.5,
) -> torch.Tensor:
    """Intensity [W/sr], shape [C, K, n_z, n_y, n_x], of VPLs (position [m], normal, flux [n,C] W)."""
    cells = (position + bias * cell_size * normal - position.new_tensor(minimum)) / cell_size
    inside = ((cells >= 0) & (cells < cells.new_tensor(resolution))).all(1)
    cells, normal, flux = cells[inside], normal[inside], flux[inside]
    values = (flux / math.pi)[:, :, None] * cosine_lobe(normal, l_max)[:, None, :]
    nx, ny, nz = resolution
    volume = values.new_zeros((nz, ny, nx, *values.shape[1:]))
    if deposit == "nearest":
        x, y, z = torch.floor(cells.detach()).long().unbind(1)
        volume = volume.index_put((z, y, x), values, accumulate=True)
    else:
        for index, weight in trilinear_corners(cells, resolution):
            volume = volume.index_put(index, weight[:, None, None] * values, accumulate=True)
    return volume.permute(3, 4, 0, 1, 2)
