"""Book-keeping that all solvers share: budget, time, best point, history, checkpoint, and how a run ends.

A solver is a loop that calls ``Run.value`` or ``Run.value_and_grad``, which end it by raising ``StopRun``, and, where it can
be resumed, ``Run.mark`` after each completed step; ``Run.execute`` turns that, and Ctrl-C, into an ``OptimResult``.
"""

from __future__ import annotations

import copy
import math
import os
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from difflpv.optim.checkpoint import load_checkpoint, save_checkpoint
from difflpv.optim.problem import Problem, Space
from difflpv.optim.result import HistoryPoint, OptimResult, Status

__all__ = ["Callback", "Run", "StopRun"]

Callback = Callable[[HistoryPoint], None]


class StopRun(Exception):  # noqa: N818 - control flow, like StopIteration
    """Ends a solver's loop."""

    def __init__(self, status: Status, detail: str = "") -> None:
        super().__init__(detail)
        self.status = status
        self.detail = detail


class Run:
    """One run of a solver on a problem, possibly the continuation of an earlier one."""

    def __init__(
        self,
        problem: Problem,
        solver: str,
        *,
        budget: float,
        least: float,
        seconds: float | None,
        seed: int,
        tolerance: float,
        checkpoint: str | os.PathLike[str] | None,
        checkpoint_seconds: float,
        callback: Callback | None,
        options: dict[str, Any],
    ) -> None:
        """Check the shared options and load the checkpoint, if there is one.

        Args:
            problem: what to minimise.
            solver: name in the registry.
            budget: forward-equivalents that may be spent, an earlier part of the run included.
            least: forward-equivalents that the solver needs to do anything.
            seconds: wall time that may be spent, an earlier part included; None for no limit.
            seed: seeds everything random.
            tolerance: the solver's own.
            checkpoint: file to resume from, if it exists, and to write to.
            checkpoint_seconds: how often to write it; it is always written at the end.
            callback: told about each evaluation.
            options: the solver's other options; a checkpoint of other options is refused.
        """
        if not budget >= least:
            needs = f"at least {least:g} forward-equivalents for {solver}"
            raise ValueError(f"budget: expected {needs}, got {budget}")
        if seconds is not None and not seconds > 0:
            raise ValueError(f"seconds: expected a positive number or None, got {seconds}")
        if not 0 <= tolerance < math.inf:
            raise ValueError(f"tolerance: expected a finite number >= 0, got {tolerance}")
        self.problem = problem
        self.solver = solver
        self.budget = float(budget)
        self.seconds = math.inf if seconds is None else float(seconds)
        self.seed = int(seed)
        self.tolerance = float(tolerance)
        self.step = 0
        self.best, self.best_loss = problem.initial, math.inf
        self.history: list[HistoryPoint] = []
        self.state: dict[str, Any] | None = None
        self._callback = callback
        self._checkpoint = checkpoint
        self._checkpoint_seconds = checkpoint_seconds
        self._last_good: Tensor | None = None
        self._used_before = self._seconds_before = 0.0
        self._marked: dict[str, Any] = {}
        self._ended: tuple[Status, str] | None = None
        self._identity = {"solver": solver, "seed": self.seed, "tolerance": self.tolerance} | options
        self._identity |= problem.identity()
        if problem.generator is not None:
            problem.generator.manual_seed(self.seed)
        if checkpoint is not None:
            self._restore(load_checkpoint(checkpoint, self._identity))
        self._counted = problem.forward_equivalents
        self._started = self._saved_at = time.perf_counter()
        self.mark(self.state)

    @property
    def used(self) -> float:
        """Forward-equivalents spent, an earlier part of the run included."""
        return self._used_before + self.problem.forward_equivalents - self._counted

    @property
    def elapsed(self) -> float:
        """Wall time spent [s], an earlier part of the run included."""
        return self._seconds_before + time.perf_counter() - self._started

    def admit(self, cost: float) -> None:
        """Raise ``StopRun`` unless time and budget allow something of this cost: a budget is never exceeded."""
        if self.elapsed >= self.seconds:
            raise StopRun(Status.TIME_LIMIT)
        if self.used + cost > self.budget:
            raise StopRun(Status.BUDGET)

    def value(self, x: Tensor, *, refuse: bool = True) -> float:
        """Loss at the physical point ``x``, recorded.

        Args:
            x: flat vector, shape [n].
            refuse: raise ``StopRun`` where the loss is not finite; otherwise return NaN.
        """
        self.admit(1.0)
        loss = self.problem.value(x)
        if refuse and not math.isfinite(loss):
            raise self.non_finite(x, "physical", loss, None)
        return self._record(x, "physical", loss)

    def value_and_grad(self, x: Tensor, *, space: Space = "physical") -> tuple[float, Tensor]:
        """Loss and gradient at ``x``, recorded; raises ``StopRun`` where either is not finite."""
        self.admit(1.0 + self.problem.backward_cost)
        loss, gradient = self.problem.value_and_grad(x, space=space)
        if not (math.isfinite(loss) and bool(gradient.isfinite().all())):
            raise self.non_finite(x, space, loss, gradient)
        self._last_good = self._physical(x, space)
        return self._record(x, space, loss), gradient

    def non_finite(self, x: Tensor, space: Space, loss: float, gradient: Tensor | None) -> StopRun:
        """The end of a run whose loss or gradient is not finite: names what, where and whose fault."""
        self._record(x, space, math.nan)
        what = f"loss is {loss}" if not math.isfinite(loss) else "gradient is not finite"
        physical = self._physical(x, space)
        names = self.problem.blame(physical, gradient, self._last_good)
        values = self.problem.unpack(physical)
        named = ", ".join(f"'{name}' = {_short(values[name])}" for name in names or self.problem.names)
        cause = "because of parameter" if names else "at"
        return StopRun(Status.NON_FINITE, f"{what} at step {self.step}, {cause} {named}")

    def told(self, detail: str) -> str:
        """``detail``, with the number of evaluations that were not finite where there were any."""
        bad = sum(math.isnan(point.loss) for point in self.history)
        return f"{detail}, {bad} of {len(self.history)} evaluations were not finite" if bad else detail

    def mark(self, state: dict[str, Any] | None) -> None:
        """Note a completed step: a checkpoint, whenever it is written, continues from the last one noted.

        Args:
            state: the solver's own state; copied.
        """
        if self._checkpoint is None:
            return
        generator = self.problem.generator
        self._marked = {
            "state": copy.deepcopy(state),
            "step": self.step,
            "used": self.used,
            "evaluations": len(self.history),
            "generator": None if generator is None else generator.get_state(),
        }
        if time.perf_counter() - self._saved_at >= self._checkpoint_seconds:
            self._save(None)

    def execute(self, loop: Callable[[], tuple[Status, str]]) -> OptimResult:
        """Run a solver's loop to its end and return the result; any other exception is passed on, after a save."""
        if self._ended is not None:
            return self._result(*self._ended)
        try:
            status, detail = loop()
        except StopRun as stop:
            status, detail = stop.status, stop.detail
        except KeyboardInterrupt:
            status, detail = Status.INTERRUPTED, ""
        except BaseException:
            self._save(None)
            raise
        self._save((status, detail))
        return self._result(status, detail)

    def _physical(self, x: Tensor, space: Space) -> Tensor:
        with torch.no_grad():
            x = x.detach().to("cpu", torch.float64)
            return self.problem.to_physical(x) if space == "raw" else x.clone()

    def _record(self, x: Tensor, space: Space, loss: float) -> float:
        loss = loss if math.isfinite(loss) else math.nan
        if loss < self.best_loss:
            self.best, self.best_loss = self._physical(x, space), loss
        self.history.append(HistoryPoint(self.used, self.elapsed, loss))
        if self._callback is not None:
            self._callback(self.history[-1])
        return loss

    def _restore(self, content: dict[str, Any] | None) -> None:
        if content is None:
            return
        self.state, self.step = content["state"], content["step"]
        self.best, self.best_loss = content["best"], content["best_loss"]
        self._last_good = self.best if math.isfinite(self.best_loss) else None
        self.history = [HistoryPoint(*row) for row in content["history"].tolist()]
        self._used_before, self._seconds_before = content["used"], content["seconds"]
        if content["generator"] is not None and self.problem.generator is not None:
            self.problem.generator.set_state(content["generator"])
        if content["ended"] is not None:
            status, detail = Status(content["ended"][0]), content["ended"][1]
            # Only a finished search is final: more budget, more time or a second start continue the others.
            if status in (Status.CONVERGED, Status.ROUNDOFF_LIMITED):
                self._ended = status, detail

    def _save(self, ended: tuple[Status, str] | None) -> None:
        if self._checkpoint is None:
            return
        self._saved_at = time.perf_counter()
        history = self.history[: self._marked["evaluations"]]
        content = self._marked | {
            "history": torch.tensor(history, dtype=torch.float64).reshape(-1, 3),
            "best": self.best,
            "best_loss": self.best_loss,
            "seconds": self.elapsed,
            "ended": None if ended is None else [ended[0].value, ended[1]],
        }
        save_checkpoint(self._checkpoint, self._identity, content)

    def _result(self, status: Status, detail: str) -> OptimResult:
        message = f"{self.solver}: {detail or status.value.replace('_', ' ')}: {status.advice}"
        return OptimResult(
            parameters={name: value.clone() for name, value in self.problem.unpack(self.best).items()},
            loss=self.best_loss,
            status=status,
            message=message,
            history=tuple(self.history),
            evaluations=len(self.history),
            forward_equivalents=self.used,
            seconds=self.elapsed,
            solver=self.solver,
            seed=self.seed,
        )


def _short(value: Tensor) -> str:
    if value.numel() <= 4:
        return str(value.tolist())
    return f"{value.min().item():g} to {value.max().item():g}"
