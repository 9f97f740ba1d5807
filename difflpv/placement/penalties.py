"""What the error alone does not ask of a placement: distance to walls, no reading through them, no empty regions."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from difflpv.placement.task import PlacementTask
from difflpv.probes.rows import Rows
from difflpv.probes.visible import Sight

__all__ = ["Penalties"]


@dataclass(frozen=True)
class Penalties:
    """Terms that are added to the relative error, each without a unit; 0 leaves a term out.

    Attributes:
        barrier: mean over probes of ((margin - clearance)+ / margin)^2: keeps probes off surfaces.
        margin: distance to surfaces that the barrier asks for [m]; 1 % of the longest edge of the points' box if None.
        leak: share of the weight with which points read probes that they do not see (smooth ``Sight``).
        coverage: mean over points of ((d - reach)+ / reach)^2 with d the distance to the nearest probe: a minimum density.
        reach: how far from a probe a point may be [m]; needed for ``coverage``.
    """

    barrier: float = 0.1
    margin: float | None = None
    leak: float = 0.0
    coverage: float = 0.0
    reach: float | None = None

    def __post_init__(self) -> None:
        for name in ("barrier", "leak", "coverage"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"penalty {name}: expected a number >= 0, got {getattr(self, name)}")
        for name in ("margin", "reach"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise ValueError(f"penalty {name}: expected a length > 0 m, got {value}")
        if self.coverage and self.reach is None:
            raise ValueError("penalty coverage: expected a reach [m] as well, got none")

    def total(
        self, task: PlacementTask, position: torch.Tensor, rows: Rows, sight: Sight | None
    ) -> torch.Tensor:
        """The sum, a scalar, for probes at ``position`` [n,3] m read by ``rows``; ``sight`` is needed for ``leak``."""
        found = position.new_zeros(())
        if self.barrier:
            margin = self.margin or 0.01 * float((task.bounds[1] - task.bounds[0]).max())
            short = (margin - task.clearance(position)).clamp_min(0) / margin
            found = found + self.barrier * short.square().mean()
        if self.leak:
            assert sight is not None
            unseen = 1 - sight.visibility(position, task.points, rows.probe)
            share = (rows.weight * unseen).sum(1) * task.weights
            found = found + self.leak * share.sum() / task.weights.sum()
        if self.coverage:
            assert self.reach is not None
            with torch.no_grad():
                nearest = torch.cdist(task.points, position).argmin(1)
            gap = (task.points - position[nearest]).square().sum(1).add(1e-12).sqrt()
            found = found + self.coverage * ((gap - self.reach).clamp_min(0) / self.reach).square().mean()
        return found
