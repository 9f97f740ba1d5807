"""What a solver minimises: a loss over named, bounded parameters, and what its evaluations cost.

A ``Problem`` knows no solver and no scene. Solvers see flat float64 vectors in one of two spaces: ``physical`` values,
inside the bounds, or ``raw`` ones, unconstrained, through the maps of ``difflpv.parameters``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal

import torch
from torch import Tensor

from difflpv.parameters import Parameter

__all__ = ["Problem", "Space"]

Space = Literal["physical", "raw"]


class Problem:
    """A differentiable loss over named parameters.

    Cost is counted in *forward-equivalents*: a value costs 1, a gradient ``backward_cost`` on top of its value.

    Attributes:
        parameters: descriptions, in the order of the flat vector.
        backward_cost: what one backward costs in forwards.
        generator: see the constructor; None for a deterministic loss.
        label: see the constructor.
        value_count: losses and residuals computed.
        gradient_count: gradients computed.
    """

    def __init__(
        self,
        loss: Callable[[dict[str, Tensor]], Tensor],
        parameters: Sequence[Parameter],
        *,
        backward_cost: float = 2.0,
        residual: Callable[[dict[str, Tensor]], Tensor] | None = None,
        generator: torch.Generator | None = None,
        label: str = "",
    ) -> None:
        """Describe a problem.

        Args:
            loss: maps physical values (float64, by name) to a scalar tensor.
            parameters: at least one, of different names.
            backward_cost: what one backward costs in forwards, as measured by the caller.
            residual: weighted residual vector sqrt(w)(E - E*) as an affine function of the physical values, for
                solvers of linear least squares.
            generator: source of randomness that the loss draws from, if any; a solver seeds it, checkpoints keep it.
            label: names data and scene, so that a checkpoint of another fit is recognised.

        Raises:
            TypeError: ``parameters`` holds something else.
            ValueError: no parameters, a name twice, or a cost that is negative or not finite.
        """
        self.parameters = tuple(parameters)
        for parameter in self.parameters:
            if not isinstance(parameter, Parameter):
                raise TypeError(f"parameters: expected Parameter objects, got {type(parameter).__name__}")
        names = [p.name for p in self.parameters]
        if not names or len(set(names)) != len(names):
            raise ValueError(f"parameters: expected at least one, each of its own name, got {names}")
        if not 0 <= backward_cost < math.inf:
            raise ValueError(f"backward_cost: expected a finite number >= 0, got {backward_cost}")
        self._loss = loss
        self._residual = residual
        self.backward_cost = float(backward_cost)
        self.generator = generator
        self.label = label
        self.value_count = 0
        self.gradient_count = 0

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names in the order of the flat vector."""
        return tuple(p.name for p in self.parameters)

    @property
    def size(self) -> int:
        """Length n of the flat vector."""
        return sum(p.size for p in self.parameters)

    @property
    def forward_equivalents(self) -> float:
        """Cost of everything evaluated so far."""
        return self.value_count + self.backward_cost * self.gradient_count

    @property
    def initial(self) -> Tensor:
        """Initial physical values, shape [n]."""
        return self.pack({p.name: p.initial for p in self.parameters})

    @property
    def lower(self) -> Tensor:
        """Lower bounds of the physical values, shape [n]."""
        return self.pack({p.name: p.lower for p in self.parameters})

    @property
    def upper(self) -> Tensor:
        """Upper bounds of the physical values, shape [n]."""
        return self.pack({p.name: p.upper for p in self.parameters})

    def pack(self, values: dict[str, Tensor]) -> Tensor:
        """Values by name -> flat vector, shape [n]."""
        if set(values) != set(self.names):
            raise ValueError(f"values: expected the names {list(self.names)}, got {sorted(values)}")
        parts = []
        for p in self.parameters:
            if values[p.name].shape != p.shape:
                shapes = f"expected shape {list(p.shape)}, got {list(values[p.name].shape)}"
                raise ValueError(f"values '{p.name}': {shapes}")
            parts.append(values[p.name].reshape(-1).to(torch.float64))
        return torch.cat(parts)

    def unpack(self, x: Tensor) -> dict[str, Tensor]:
        """Flat vector of shape [n] -> values by name."""
        if x.shape != (self.size,):
            raise ValueError(f"x: expected shape [{self.size}], got {list(x.shape)}")
        parts = x.split([p.size for p in self.parameters])
        return {p.name: part.reshape(p.shape) for p, part in zip(self.parameters, parts, strict=True)}

    def to_physical(self, raw: Tensor) -> Tensor:
        """Raw flat vector -> physical flat vector, both of shape [n]; differentiable."""
        values = self.unpack(raw)
        return self.pack({p.name: p.to_physical(values[p.name]) for p in self.parameters})

    def to_raw(self, x: Tensor) -> Tensor:
        """Physical flat vector -> raw flat vector, both of shape [n]."""
        values = self.unpack(x)
        return self.pack({p.name: p.to_raw(values[p.name]) for p in self.parameters})

    def value(self, x: Tensor, *, space: Space = "physical") -> float:
        """Loss at the flat vector ``x`` of shape [n]; costs 1. May be NaN or infinite."""
        self.value_count += 1
        return self._value(x, space)

    def value_and_grad(self, x: Tensor, *, space: Space = "physical") -> tuple[float, Tensor]:
        """Loss at ``x`` and its gradient with respect to ``x``; costs 1 + ``backward_cost``.

        Args:
            x: flat vector, float64, shape [n].
            space: which values ``x`` holds.

        Returns:
            The loss and its gradient of shape [n], float64. Either may be NaN or infinite.

        Raises:
            ValueError: the loss does not depend on the parameters through torch.
        """
        self.value_count += 1
        leaf = x.detach().to("cpu", torch.float64).clone().requires_grad_(True)
        with torch.enable_grad():
            loss = self._scalar(self.to_physical(leaf) if space == "raw" else leaf)
            if not loss.requires_grad:
                raise ValueError("loss: expected a tensor that depends on the parameters, got one without gradient")
            self.gradient_count += 1
            (gradient,) = torch.autograd.grad(loss, leaf)
        return float(loss.detach()), gradient

    def residual_at(self, x: Tensor) -> Tensor:
        """Residual vector at the physical point ``x``, float64, shape [m]; costs 1.

        Raises:
            ValueError: the problem was made without a residual.
        """
        if self._residual is None:
            raise ValueError("problem: expected one made with residual=..., got one without")
        self.value_count += 1
        with torch.no_grad():
            residual = self._residual(self.unpack(x.detach().to("cpu", torch.float64).clone()))
        return residual.reshape(-1).to("cpu", torch.float64)

    def blame(self, x: Tensor, gradient: Tensor | None, last: Tensor | None) -> list[str]:
        """Names of the parameters that make loss or gradient non-finite at the physical point ``x``.

        First those whose own value is not finite; else those whose value alone, put into the ``last`` good point,
        reproduces a loss that is not finite; else those whose gradient is not finite. Evaluations made here are not
        counted: they happen once, when a run has ended.
        """
        values = self.unpack(x)
        names = [name for name, value in values.items() if not value.isfinite().all()]
        if not names and last is not None and not math.isfinite(self._value(x, "physical")):
            good = self.unpack(last)
            for name in self.names:
                if not math.isfinite(self._value(self.pack({**good, name: values[name]}), "physical")):
                    names.append(name)
        if not names and gradient is not None:
            names = [name for name, part in self.unpack(gradient).items() if not part.isfinite().all()]
        return names

    def identity(self) -> dict[str, object]:
        """What makes this problem itself: plain values for comparison with a checkpoint."""
        described: dict[str, object] = {"label": self.label, "backward_cost": self.backward_cost}
        described["parameter names"] = list(self.names)
        for p in self.parameters:
            described[f"shape of '{p.name}'"] = list(p.shape)
            described[f"bounds of '{p.name}'"] = [p.lower.flatten().tolist(), p.upper.flatten().tolist()]
            described[f"initial value of '{p.name}'"] = p.initial.flatten().tolist()
            described[f"scale of '{p.name}'"] = p.scale
        return described

    def _value(self, x: Tensor, space: Space) -> float:
        with torch.no_grad():
            x = x.detach().to("cpu", torch.float64).clone()
            return float(self._scalar(self.to_physical(x) if space == "raw" else x))

    def _scalar(self, x: Tensor) -> Tensor:
        loss = self._loss(self.unpack(x))
        if not isinstance(loss, Tensor) or loss.numel() != 1:
            got = list(loss.shape) if isinstance(loss, Tensor) else type(loss).__name__
            raise TypeError(f"loss: expected a scalar tensor, got {got}")
        return loss.reshape(())
