"""The publications' cure for self-lighting and bleeding: damping by the directional derivative, for comparison.

Source: HOLPV thesis section 3.2.4 (after Kaplanyan 2009): where the coefficients change much along the surface's normal and
the change deviates from the coefficients themselves, the light is damped. Neither source gives the formula; ours is, per
colour, with c = A(x') and g = A(x' + h n / 2) - A(x' - h n / 2):

    d = 1 - min(1, |g| / |c|) (1 - max(0, <g, c> / (|g| |c|)))

1 in a constant field and in one that grows along the normal in proportion to itself, towards 0 where the change is as large
as the light and points elsewhere.
"""

from __future__ import annotations

import torch

from difflpv.coordinates import check_points, shifted_points
from difflpv.grid import Grid
from difflpv.sampling import sample_coeffs
from difflpv.sh import cosine_lobe, degree_of_count

__all__ = ["damped_irradiance"]


def damped_irradiance(
    volume: torch.Tensor, positions: torch.Tensor, normals: torch.Tensor, grid: Grid, *, bias: float | torch.Tensor = 0.5
) -> torch.Tensor:
    """``difflpv.sampling.sample_irradiance`` times the damping of the module.

    Args:
        volume: accumulated intensity [W/sr], shape [C, K, n_z, n_y, n_x].
        positions: receivers [m], shape [n,3].
        normals: unit normals on the free side, shape [n,3].
        grid: the volume's cells.
        bias: offset along the normal, in cells.

    Returns:
        Irradiance [W/m2], shape [n,C]. Gradients reach every tensor.

    Raises:
        TypeError, ValueError: as ``sample_irradiance``.
    """
    check_points("positions", positions, like=volume)
    check_points("normals", normals, like=volume, count=len(positions))
    x = shifted_points(positions, normals, grid, bias)
    here = sample_coeffs(volume, x, grid)
    half = 0.5 * grid.cell_size * normals
    change = sample_coeffs(volume, x + half, grid) - sample_coeffs(volume, x - half, grid)
    tiny = torch.finfo(volume.dtype).tiny
    size = (here.square().sum(-1) + tiny).sqrt()
    steep = (change.square().sum(-1) + tiny).sqrt()
    along = ((change * here).sum(-1) / (steep * size)).clamp_min(0)
    damping = 1 - (steep / size).clamp_max(1) * (1 - along)
    lobes = cosine_lobe(-normals, degree_of_count(volume.shape[1]))
    return damping * torch.einsum("nck,nk->nc", here, lobes) / grid.cell_size**2
