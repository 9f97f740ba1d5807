"""Torch twin of sampling: the equations of physics.md, "The chain" 7, with one indexed read per corner.

Imports torch and ``difflpv.sh`` (the one SH convention, torch-agnostic polynomials) only.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from difflpv.reference.injection import trilinear_corners
from difflpv.sh import cosine_lobe, degree_of_count

__all__ = ["sample_coeffs", "sample_irradiance"]


def sample_coeffs(
    volume: torch.Tensor, points: torch.Tensor, minimum: Sequence[float], cell_size: float
) -> torch.Tensor:
    """Coefficients [m, C, K] of a volume [C, K, n_z, n_y, n_x] at points [m,3]."""
    cells = (points - points.new_tensor(minimum)) / cell_size
    by_cell = volume.permute(2, 3, 4, 0, 1)
    resolution = tuple(reversed(volume.shape[2:]))
    corners = trilinear_corners(cells, resolution)
    return sum((weight[:, None, None] * by_cell[index] for index, weight in corners), start=volume.new_zeros(()))


def sample_irradiance(
    volume: torch.Tensor,
    positions: torch.Tensor,
    normals: torch.Tensor,
    minimum: Sequence[float],
    cell_size: float,
    *,
    bias: float | torch.Tensor = 0.5,
) -> torch.Tensor:
    """Irradiance [n,C] of receivers (position [n,3] m, normal [n,3])."""
    coeffs = sample_coeffs(volume, positions + bias * cell_size * normals, minimum, cell_size)
    lobe = cosine_lobe(-normals, degree_of_count(volume.shape[1]))
    return torch.einsum("nck,nk->nc", coeffs, lobe) / cell_size**2
