"""Learnable quantities and the smooth maps that keep them inside their bounds.

A solver without bounds (Adam, L-BFGS) moves *raw* values anywhere on the real line; the stages see *physical* values.
Three maps, each strictly increasing with an exact inverse (raw r, physical x, bounds l and u, scale s):

    interval   x = l + (u - l) / (1 + exp(-r))         inverse  r = log(x - l) - log(u - x)
    half line  x = l + s log(1 + exp(r)), mirrored     inverse  r = y + log(-expm1(-y)), y = (x - l) / s
               for an upper bound alone
    free       x = s r                                 inverse  r = x / s

Everything is computed in float64. ``torch.nn.functional.softplus`` is not used: it becomes the identity above 20, which
costs half of the digits of a float64.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

__all__ = ["Parameter"]

Map = Literal["interval", "above", "below", "free"]


@dataclass(frozen=True, eq=False)
class Parameter:
    """One named learnable quantity: where it starts and what it may become.

    Attributes:
        name: what messages and results call it; the key of the dictionary that a loss receives.
        initial: initial physical value of any shape; stored as a float64 tensor on the CPU.
        lower: lowest physical value, broadcast to the shape of ``initial``; -inf for none.
        upper: highest physical value, broadcast likewise; inf for none.
        scale: size of a typical change, in the unit of the value, used where no interval sets one. Default: 1 for a
            free parameter, the mean distance from the bound at the start for a half line.

    Raises:
        ValueError: a bound is NaN, bounds are equal or swapped, some entries are bounded and others are not, or an
            initial value is not finite or lies on or outside its bounds.
    """

    name: str
    initial: Any
    lower: Any = -torch.inf
    upper: Any = torch.inf
    scale: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f"parameter name: expected a non-empty string, got {self.name!r}")
        initial = _float64(self.initial)
        object.__setattr__(self, "initial", initial)
        for side in ("lower", "upper"):
            bound = _float64(getattr(self, side))
            try:
                bound = bound.expand(initial.shape).clone()
            except RuntimeError:
                shapes = f"the shape of initial {list(initial.shape)}, got {list(bound.shape)}"
                raise ValueError(f"parameter '{self.name}': {side} must broadcast to {shapes}") from None
            if bound.isnan().any():
                raise ValueError(f"parameter '{self.name}': {side} must not be NaN, got {bound.tolist()}")
            if bound.isinf().any() and not bound.isinf().all():
                every = "finite for every entry or for none (use two parameters)"
                raise ValueError(f"parameter '{self.name}': {side} must be {every}, got {bound.tolist()}")
            object.__setattr__(self, side, bound)
        if initial.numel() == 0:
            raise ValueError(f"parameter '{self.name}': expected at least one entry, got shape {list(initial.shape)}")
        if not (self.lower < self.upper).all():
            got = f"{self.lower.tolist()} and {self.upper.tolist()}"
            raise ValueError(f"parameter '{self.name}': lower must be below upper, got {got}")
        outside = ~(initial.isfinite() & (initial > self.lower) & (initial < self.upper))
        if outside.any():
            first = tuple(outside.nonzero()[0].tolist())
            where = f" at index {list(first)}" if first else ""
            interval = f"({self.lower[first].item():g}, {self.upper[first].item():g})"
            raise ValueError(
                f"parameter '{self.name}': initial must be finite and strictly inside its bounds {interval}, "
                f"got {initial[first].item():g}{where}"
            )
        object.__setattr__(self, "scale", self._default_scale() if self.scale is None else float(self.scale))
        if not 0 < self._scale < torch.inf:
            raise ValueError(f"parameter '{self.name}': scale must be positive and finite, got {self.scale}")

    @property
    def shape(self) -> torch.Size:
        """Shape of the value."""
        return self.initial.shape

    @property
    def size(self) -> int:
        """Number of entries."""
        return int(self.initial.numel())

    @property
    def map(self) -> Map:
        """Which smooth map holds it: ``interval``, ``above`` a lower bound, ``below`` an upper bound, ``free``."""
        low, high = bool(self.lower.isfinite().all()), bool(self.upper.isfinite().all())
        return "interval" if low and high else "above" if low else "below" if high else "free"

    @property
    def _scale(self) -> float:
        assert self.scale is not None
        return self.scale

    def _default_scale(self) -> float:
        if self.map == "above":
            return float((self.initial - self.lower).mean())
        return float((self.upper - self.initial).mean()) if self.map == "below" else 1.0

    def to_physical(self, raw: Tensor) -> Tensor:
        """Physical value of a raw one: differentiable, never outside the bounds.

        Args:
            raw: unconstrained values, float64, shape of the parameter.

        Returns:
            Physical values, float64, same shape.
        """
        raw = self._checked("raw", raw)
        lower, upper = self.lower.to(raw.device), self.upper.to(raw.device)
        if self.map == "interval":
            width = upper - lower
            # Measured from the nearer bound, so that digits are kept next to either of them.
            below = lower + width * torch.sigmoid(raw)
            above = upper - width * torch.sigmoid(-raw)
            return torch.where(raw <= 0, below, above)
        if self.map == "above":
            return lower + self._scale * _softplus(raw)
        if self.map == "below":
            return upper - self._scale * _softplus(-raw)
        return self._scale * raw

    def to_raw(self, value: Tensor) -> Tensor:
        """Raw value of a physical one, the inverse of ``to_physical``.

        Args:
            value: physical values, float64, shape of the parameter, strictly inside the bounds.

        Returns:
            Raw values, float64, same shape.

        Raises:
            ValueError: a value is not finite, or lies on or outside its bounds, where no finite raw value exists.
        """
        value = self._checked("value", value)
        if not (value.isfinite() & (value > self.lower) & (value < self.upper)).all():
            raise ValueError(
                f"parameter '{self.name}': value must be finite and strictly inside its bounds "
                f"({self.lower.min().item():g}, {self.upper.max().item():g}), got {value.tolist()}"
            )
        if self.map == "interval":
            return torch.log(value - self.lower) - torch.log(self.upper - value)
        if self.map == "above":
            return _softplus_inverse((value - self.lower) / self._scale)
        if self.map == "below":
            return -_softplus_inverse((self.upper - value) / self._scale)
        return value / self._scale

    def nudge_inside(self, value: Tensor) -> Tensor:
        """A physical value moved off its bounds by a millionth of the interval (or of 1), so that ``to_raw`` takes it.

        For starting from a solver that reaches bounds exactly.
        """
        value = self._checked("value", value)
        margin = 1e-6 * torch.where((self.upper - self.lower).isfinite(), self.upper - self.lower, torch.ones_like(value))
        return value.clamp(self.lower + margin, self.upper - margin)

    def _checked(self, argument: str, values: Tensor) -> Tensor:
        if not isinstance(values, Tensor) or values.dtype != torch.float64:
            got = values.dtype if isinstance(values, Tensor) else type(values).__name__
            raise TypeError(f"parameter '{self.name}': {argument} must be a float64 tensor, got {got}")
        if values.shape != self.shape:
            shapes = f"expected shape {list(self.shape)}, got {list(values.shape)}"
            raise ValueError(f"parameter '{self.name}': {argument}: {shapes}")
        return values


def _float64(value: Any) -> Tensor:
    # With the type given at once: as_tensor(0.1) alone rounds to float32.
    return torch.as_tensor(value, dtype=torch.float64, device="cpu").detach().clone()


def _softplus(raw: Tensor) -> Tensor:
    return torch.logaddexp(raw, torch.zeros((), dtype=raw.dtype, device=raw.device))


def _softplus_inverse(value: Tensor) -> Tensor:
    return value + torch.log(-torch.expm1(-value))
