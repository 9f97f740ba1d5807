"""Torch twin of occlusion: the equations of physics.md, "The chain" 4, one surfel sum and one slice per corner.

Imports torch and ``difflpv.sh`` (the one SH convention, torch-agnostic polynomials) only.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch

from difflpv.sh import cosine_lobe, degree_of_count, sh_basis

__all__ = ["geometry_volume", "transmittance"]


def geometry_volume(
    position: torch.Tensor,
    normal: torch.Tensor,
    area: torch.Tensor,
    minimum: Sequence[float],
    cell_size: float,
    resolution: Sequence[int],
    *,
    l_max: int,
    two_sided: bool = True,
) -> torch.Tensor:
    """Blocking potential [K, n_z+1, n_y+1, n_x+1] of surfels (position [n,3] m, normal [n,3], area [n] m2)."""
    corner = torch.floor((position - position.new_tensor(minimum)) / cell_size + 0.5).long()
    inside = ((corner >= 0) & (corner <= torch.tensor(resolution))).all(1)
    lobes = cosine_lobe(normal, l_max)
    if two_sided:
        lobes = lobes + cosine_lobe(-normal, l_max)
    values = (area / cell_size**2)[:, None] * lobes
    nx, ny, nz = resolution
    volume = values.new_zeros((nz + 1, ny + 1, nx + 1, values.shape[1]))
    x, y, z = corner[inside].unbind(1)
    return volume.index_put((z, y, x), values[inside], accumulate=True).permute(3, 0, 1, 2)


def transmittance(
    blocking: torch.Tensor,
    offsets: Sequence[Sequence[int]],
    directions: torch.Tensor,
    *,
    model: str = "clamp",
    strength: float | torch.Tensor = 1.0,
) -> torch.Tensor:
    """Transmittance [F, n_z, n_y, n_x] of a geometry volume for the faces of a stencil."""
    basis = sh_basis(-directions, degree_of_count(blocking.shape[0]))
    sizes = [n - 1 for n in blocking.shape[1:]]
    faces = []
    for offset, weights in zip(offsets, basis, strict=True):
        potential = torch.tensordot(weights, blocking, dims=1)
        # Corners of the source cell that the destination cell has as well, per axis z, y, x.
        shared = [{-1: (0,), 0: (0, 1), 1: (1,)}[int(step)] for step in reversed(offset)]
        corners = [
            potential[tuple(slice(bit, bit + size) for bit, size in zip(bits, sizes, strict=True))]
            for bits in itertools.product(*shared)
        ]
        mean = torch.stack(corners).mean(0)
        faces.append(1 - (strength * mean).clamp(0, 1) if model == "clamp" else torch.exp(-strength * mean.clamp_min(0)))
    return torch.stack(faces)
