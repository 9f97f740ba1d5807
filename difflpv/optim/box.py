"""Coordinates scaled to the bounds, for solvers that search a box of physical values."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from difflpv.optim.problem import Problem

__all__ = ["Box"]


class Box:
    """Scaled coordinates: [0, 1] over an interval, distance from the bound or from 0 over the scale elsewhere.

    Attributes:
        lower: lower bounds in scaled coordinates, shape [n], -inf for none.
        upper: upper bounds likewise.
    """

    def __init__(self, problem: Problem) -> None:
        origin, scale = {}, {}
        for p in problem.parameters:
            free = torch.zeros_like(p.initial)
            origin[p.name] = {"free": free, "below": p.upper}.get(p.map, p.lower)
            scale[p.name] = p.upper - p.lower if p.map == "interval" else free + float(p.scale or 1.0)
        self._low, self._high = problem.lower.numpy(), problem.upper.numpy()
        self._origin, self._scale = problem.pack(origin).numpy(), problem.pack(scale).numpy()
        self.lower = (self._low - self._origin) / self._scale
        self.upper = (self._high - self._origin) / self._scale

    def to_unit(self, x: Tensor) -> np.ndarray:
        """Physical flat vector [n] -> scaled coordinates [n], inside the bounds."""
        return np.clip((x.numpy() - self._origin) / self._scale, self.lower, self.upper)

    def to_physical(self, u: np.ndarray) -> Tensor:
        """Scaled coordinates [n] -> physical flat vector [n], inside the bounds."""
        return torch.from_numpy(np.clip(self._origin + self._scale * u, self._low, self._high))

    def gradient(self, gradient: Tensor) -> np.ndarray:
        """Gradient [n] by physical values -> gradient by scaled coordinates."""
        return gradient.numpy() * self._scale
