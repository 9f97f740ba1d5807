"""Normalised anisotropic Gaussian weights: each probe with a footprint of its own, cut off smoothly at the k nearest.

Source: normalised radial basis functions (Moody and Darken, "Fast learning in networks of locally-tuned processing units",
Neural Computation 1989), each with a metric of its own. Probe j at p_j has a matrix M_j; how far away a point x is for it:

    d_j = |M_j (x - p_j)|^2

A point reads the k probes of least d_j. With d_(1) the least and d_(k+1) the least of those that are not read,

    w_j ~ exp(-(d_j - d_(1)) / 2) - exp(-(d_(k+1) - d_(1)) / 2) + 1e-9,    normalised

so that a probe that drops out of the k nearest has lost its weight before (up to the 1e-9 that keeps points at equal distance
from more than k probes defined): weights are continuous in points, positions and metrics but for places that are equally far
from the k + 1 nearest (with k = 1, half-way between two probes), and defined for any probes, also coplanar ones, duplicates and
a single one. A wall needs no ray where the footprints on its two sides are flat along it.
"""

from __future__ import annotations

import torch

from difflpv.coordinates import check_points
from difflpv.probes.footprints import nearest_footprints
from difflpv.probes.rows import Rows

__all__ = ["GaussianInterpolation", "isotropic_metric"]

_LEAST = 1e-9


class GaussianInterpolation:
    """Weights by Gaussian footprints (see the module), differentiable in positions, metrics and points.

    Attributes:
        metric: M of each probe [n,3,3] 1/m.
    """

    def __init__(self, metric: torch.Tensor, *, neighbours: int = 8) -> None:
        """Choose.

        Args:
            metric: [n,3,3] 1/m, any matrices; ``isotropic_metric`` makes some to start from.
            neighbours: k of the module.

        Raises:
            ValueError: naming the argument, what was expected and what came.
        """
        if metric.ndim != 3 or metric.shape[1:] != (3, 3) or not len(metric):
            raise ValueError(f"metric: expected shape [n,3,3] with n > 0, got {list(metric.shape)}")
        if not bool(metric.detach().isfinite().all()):
            raise ValueError("metric: expected finite numbers, got NaN or infinity")
        if neighbours < 1:
            raise ValueError(f"neighbours: expected a number > 0, got {neighbours}")
        self.metric = metric
        self._neighbours = neighbours

    def rows(self, position: torch.Tensor, points: torch.Tensor) -> Rows:
        """Weights [m,k] of ``points`` [m,3] m over probes at ``position`` [n,3] m, fewer columns if n < k.

        Raises:
            TypeError, ValueError: naming the argument, what was expected and what came.
        """
        check_points("position", position)
        check_points("points", points, like=position)
        if len(position) != len(self.metric):
            raise ValueError(f"position: expected {len(self.metric)} probes, got {len(position)}")
        count = min(self._neighbours + 1, len(position))
        near, distance = nearest_footprints(position, self.metric.to(position), points, count)
        share = torch.exp(-0.5 * (distance - distance[:, :1]))
        if len(position) > self._neighbours:
            share = (share[:, :-1] - share[:, -1:]).clamp_min(0) + _LEAST
            near = near[:, :-1]
        return Rows(near.long(), share / share.sum(1, keepdim=True))


def isotropic_metric(position: torch.Tensor, *, width: float = 0.6) -> torch.Tensor:
    """Metrics [n,3,3] 1/m of round footprints: standard deviation ``width`` times the distance to the nearest other probe.

    A single probe gets 1 m; probes in one place get the smallest distance that any two others have.
    """
    count = len(position)
    if count == 1:
        return torch.eye(3, dtype=position.dtype)[None]
    distance = torch.cdist(position, position, compute_mode="donot_use_mm_for_euclid_dist")
    distance.fill_diagonal_(torch.inf)
    nearest = distance.amin(1)
    apart = nearest[nearest > 0]
    nearest = nearest.clamp_min(float(apart.min()) if len(apart) else 1.0)
    return torch.eye(3, dtype=position.dtype) / (width * nearest)[:, None, None]
