"""Torch twin of the Gaussian footprints: every probe's distance, a sort, and the weights as the equation states them.

With d_j = |M_j (x - p_j)|^2 and d_(1) <= d_(2) <= ... in order, the k nearest have

    w_j ~ exp(-(d_j - d_(1)) / 2) - exp(-(d_(k+1) - d_(1)) / 2) + least,    normalised

and where there are no more than k probes, all have exp(-d_j / 2), normalised. [m, n] of memory; autograd does the rest.
"""

from __future__ import annotations

import torch

__all__ = ["dense_footprint_weights", "nearest_footprints"]


def nearest_footprints(
    position: torch.Tensor, metric: torch.Tensor, points: torch.Tensor, count: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """The ``count`` probes of least d_j (all, if there are fewer) of points [m,3], in order, and their d_j, both [m,count]."""
    distance = _distances(position, metric, points)
    least = distance.sort(dim=1, stable=True)
    return least.indices[:, :count], least.values[:, :count]


def dense_footprint_weights(
    position: torch.Tensor, metric: torch.Tensor, points: torch.Tensor, neighbours: int, *, least: float = 1e-9
) -> torch.Tensor:
    """Weights [m,n] of points [m,3] m over probes [n,3] m with metrics [n,3,3] 1/m, of which ``neighbours`` count."""
    distance = _distances(position, metric, points)
    if len(position) <= neighbours:
        return torch.softmax(-distance / 2, 1)
    order = distance.sort(dim=1, stable=True)
    first, cut = order.values[:, :1], order.values[:, neighbours : neighbours + 1]
    share = (-(distance - first) / 2).exp() - (-(cut - first) / 2).exp() + least
    counts = torch.zeros_like(share).scatter(1, order.indices[:, :neighbours], 1.0)
    return share * counts / (share * counts).sum(1, keepdim=True)


def _distances(position: torch.Tensor, metric: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """d_j [m,n]."""
    offset = points[:, None] - position
    return torch.einsum("nij,mnj->mni", metric, offset).square().sum(-1)
