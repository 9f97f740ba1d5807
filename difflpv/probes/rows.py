"""Interpolation weights as sparse rows: which probes a point reads, and how much of each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch

__all__ = ["Interpolation", "Rows"]


@dataclass(frozen=True, eq=False)
class Rows:
    """One row of weights for each point.

    Attributes:
        probe: indices [m,k] int64 into the probes; padding repeats an index with weight 0.
        weight: [m,k], each row sums to 1; differentiable in the positions of probes and points.
    """

    probe: torch.Tensor
    weight: torch.Tensor

    def apply(self, content: torch.Tensor) -> torch.Tensor:
        """Weighted sums [m, ...] of what the probes hold, ``content`` [n, ...]."""
        flat = content.reshape(len(content), -1)
        return torch.einsum("mk,mkc->mc", self.weight, flat[self.probe]).reshape(len(self.probe), *content.shape[1:])

    def dense(self, count: int) -> torch.Tensor:
        """The same weights as a matrix [m, count]."""
        return self.weight.new_zeros(len(self.probe), count).scatter_add(1, self.probe, self.weight)


class Interpolation(Protocol):
    """How points read probes.

    What is discrete (connectivity, neighbours, rays) is settled when it is made, or looked up again for each call; weights are
    differentiable in both arguments in between.
    """

    def rows(self, position: torch.Tensor, points: torch.Tensor) -> Rows:
        """Weights of ``points`` [m,3] m over probes at ``position`` [n,3] m."""
        ...
