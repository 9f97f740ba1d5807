"""What every solver returns: the best parameters found, why it stopped and how it got there."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from torch import Tensor

__all__ = ["HistoryPoint", "OptimResult", "Status"]


class Status(StrEnum):
    """Why a solver stopped."""

    CONVERGED = "converged"
    BUDGET = "budget"
    TIME_LIMIT = "time_limit"
    INTERRUPTED = "interrupted"
    NON_FINITE = "non_finite"
    ROUNDOFF_LIMITED = "roundoff_limited"
    FAILED = "failed"

    @property
    def advice(self) -> str:
        """What a user can do about it, one line."""
        return _ADVICE[self]


_ADVICE = {
    Status.CONVERGED: "the tolerance is met; another start may lead to another optimum",
    Status.BUDGET: "the budget of forward-equivalents is used up; give a larger budget if the loss was still falling",
    Status.TIME_LIMIT: "the time limit was reached; allow more seconds, or use a coarser grid",
    Status.INTERRUPTED: "stopped by the user; run again with the same checkpoint to go on",
    Status.NON_FINITE: "the loss or its gradient is not finite; tighten the named parameter's bounds or lower the "
    "step size",
    Status.ROUNDOFF_LIMITED: "rounding errors hide any further progress; the best point is as good as this precision "
    "allows, or loosen the tolerance",
    Status.FAILED: "the solver gave up; try another solver or another initial value",
}


class HistoryPoint(NamedTuple):
    """One evaluation of the loss.

    Attributes:
        forward_equivalents: cost of the run up to and with this evaluation.
        seconds: wall time since the start of the run, earlier parts of a resumed run included.
        loss: value at this point, not the best so far; NaN where it was not finite.
    """

    forward_equivalents: float
    seconds: float
    loss: float


@dataclass(frozen=True, eq=False)
class OptimResult:
    """Outcome of a fit.

    Attributes:
        parameters: best physical values seen, float64, by name.
        loss: the loss there; inf if no evaluation was finite (the parameters are then the initial ones).
        status: why the solver stopped.
        message: one line that says so in words, with advice.
        history: every evaluation in order.
        evaluations: number of evaluations of the loss, with or without gradient.
        forward_equivalents: what they cost.
        seconds: wall time, earlier parts of a resumed run included.
        solver: name in the registry.
        seed: the seed given.
    """

    parameters: dict[str, Tensor]
    loss: float
    status: Status
    message: str
    history: tuple[HistoryPoint, ...]
    evaluations: int
    forward_equivalents: float
    seconds: float
    solver: str
    seed: int
