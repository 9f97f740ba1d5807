"""Inverse-distance weights of the nearest probes, cut off smoothly.

Source: Shepard 1968 with the vanishing weights of Franke and Nielson 1980. With d_j the distance to probe j and d_(k) that to
the k-th nearest:

    R = 1.5 d_(k),    w_j ~ ((1 - d_j / R)+ / sqrt(d_j^2 + (0.001 R)^2))^p,    normalised

Every probe within R counts (at least k do, with positive weight), and its weight is 0 at R: weights are continuous when the
order of the neighbours changes, which the plain k nearest are not. The last term keeps a point at a probe finite.
"""

from __future__ import annotations

import numpy as np
import torch

from difflpv.coordinates import check_points
from difflpv.probes.rows import Rows

__all__ = ["InverseDistanceInterpolation"]

_REACH, _SOFT = 1.5, 1e-3
_TINY = 1e-30


class InverseDistanceInterpolation:
    """Weights that fall with distance (see the module), differentiable in the positions of probes and points."""

    def __init__(self, *, neighbours: int = 4, power: float = 2.0, valid: np.ndarray | None = None) -> None:
        """Choose.

        Args:
            neighbours: k of the module.
            power: p of the module.
            valid: [n] bool; probes that are not are left out. All, if None.

        Raises:
            ValueError: naming the argument, what was expected and what came.
        """
        if neighbours < 1:
            raise ValueError(f"neighbours: expected a number > 0, got {neighbours}")
        if not power > 0:
            raise ValueError(f"power: expected a number > 0, got {power}")
        if valid is not None and not np.any(valid):
            raise ValueError("probes: expected at least one that is valid, got none")
        self._neighbours, self._power = neighbours, power
        self._valid = None if valid is None else torch.from_numpy(np.array(valid, bool))

    def rows(self, position: torch.Tensor, points: torch.Tensor) -> Rows:
        """Weights of ``points`` [m,3] m over probes at ``position`` [n,3] m; as many columns as the fullest row needs.

        Raises:
            TypeError, ValueError: naming the argument, what was expected and what came.
        """
        check_points("position", position)
        check_points("points", points, like=position)
        if not len(position) or (self._valid is not None and len(self._valid) != len(position)):
            raise ValueError(f"position: expected the probes that validity was given for, at least one, got {len(position)}")
        usable = torch.arange(len(position)) if self._valid is None else torch.nonzero(self._valid)[:, 0]
        x = position[usable]
        with torch.no_grad():
            gap = torch.cdist(points, x, compute_mode="donot_use_mm_for_euclid_dist")
            k = min(self._neighbours, len(x))
            kth = gap.topk(k, largest=False).indices[:, -1:]
            within = gap <= _REACH * gap.gather(1, kth)
            most = max(int(within.sum(1).max()) if len(points) else 1, k)
            near = gap.topk(most, largest=False).indices
        distance = ((points[:, None] - x[near]).square().sum(-1) + _TINY).sqrt()
        reach = _REACH * ((points[:, None] - x[kth]).square().sum(-1) + _TINY).sqrt()
        share = (1 - distance / reach).clamp_min(0) / (distance.square() + (_SOFT * reach).square()).sqrt()
        share = share / share.detach().amax(1, keepdim=True)  # powers of it stay finite
        weight = share**self._power
        return Rows(usable[near], weight / weight.sum(1, keepdim=True))
