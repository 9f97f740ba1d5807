"""Torch twin of the weighted lookup and deposit: three sums, written down. Readable, exact, slow in memory."""

from __future__ import annotations

import torch

__all__ = ["gather_lobes", "spread_lobes"]


def gather_lobes(
    volume: torch.Tensor, cells: torch.Tensor, weights: torch.Tensor, lobes: torch.Tensor
) -> torch.Tensor:
    """E_ic = sum_j W_ij sum_k L_ik V[c,k,J_ij].

    Args:
        volume: shape [C, K, n_z, n_y, n_x].
        cells: index into the flattened grid, shape [n,J].
        weights: shape [n,J].
        lobes: shape [n,K].

    Returns:
        Shape [n,C].
    """
    listed = volume.flatten(2)[:, :, cells.long()]
    return torch.einsum("cknj,nj,nk->nc", listed, weights, lobes)


def spread_lobes(
    flux: torch.Tensor, cells: torch.Tensor, weights: torch.Tensor, lobes: torch.Tensor, shape: tuple[int, int, int]
) -> torch.Tensor:
    """V[c,k,J_ij] += W_ij L_ik F_ic.

    Args:
        flux: shape [n,C].
        cells: index into the flattened grid, shape [n,J].
        weights: shape [n,J].
        lobes: shape [n,K].
        shape: grid (n_z, n_y, n_x).

    Returns:
        Shape [C, K, n_z, n_y, n_x].
    """
    given = torch.einsum("nc,nj,nk->cknj", flux, weights, lobes).flatten(2)
    volume = flux.new_zeros((flux.shape[1], lobes.shape[1], shape[0] * shape[1] * shape[2]))
    return volume.index_add(2, cells.long().flatten(), given).unflatten(2, shape)
