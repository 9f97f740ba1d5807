"""Adam on raw values (Kingma and Ba 2015, "Adam: a method for stochastic optimization"), by ``torch.optim.Adam``."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from typing import Literal

import torch

from difflpv.optim.problem import Problem
from difflpv.optim.result import OptimResult, Status
from difflpv.optim.run import Callback, Run

__all__ = ["solve_adam"]

_DIVERGED = 10.0  # times the first loss


def solve_adam(
    problem: Problem,
    *,
    budget: float,
    seconds: float | None = None,
    seed: int = 0,
    tolerance: float = 0.0,
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_seconds: float = 10.0,
    callback: Callback | None = None,
    lr: float = 0.05,
    schedule: Literal["cosine", "constant"] = "cosine",
    schedule_steps: int | None = None,
    clip_norm: float | None = None,
    patience: int = 50,
) -> OptimResult:
    """Minimise with Adam.

    A checkpoint continues bit for bit: the steps before and after an interruption are those of a run that was never
    interrupted.

    Args:
        problem: what to minimise.
        budget: forward-equivalents to spend at most; a step costs 1 + ``problem.backward_cost``.
        seconds: wall time to spend at most, None for no limit.
        seed: seeds ``problem.generator``; Adam itself draws nothing.
        tolerance: converged when the best loss has improved by less than this, relatively, over ``patience`` steps;
            0 never stops early.
        checkpoint: file to resume from, if it exists, and to write to.
        checkpoint_seconds: how often to write it [s]; it is always written at the end.
        callback: told about each evaluation.
        lr: step size in raw values at the start.
        schedule: ``cosine`` falls from ``lr`` to 0 over ``schedule_steps``, ``constant`` stays.
        schedule_steps: length of the cosine; by default the steps that the budget pays for.
        clip_norm: largest L2 norm of a gradient, None for no clipping.
        patience: see ``tolerance``.

    Returns:
        The best point seen.

    Raises:
        ValueError: an option out of range.
        CheckpointError: a checkpoint of another fit.
    """
    cost = 1.0 + problem.backward_cost
    if not 0 < lr < math.inf:
        raise ValueError(f"lr: expected a positive number, got {lr}")
    if schedule not in ("cosine", "constant"):
        raise ValueError(f"schedule: expected 'cosine' or 'constant', got {schedule!r}")
    if clip_norm is not None and not clip_norm > 0:
        raise ValueError(f"clip_norm: expected a positive number or None, got {clip_norm}")
    if schedule_steps is not None and schedule_steps < 1:
        raise ValueError(f"schedule_steps: expected at least 1, got {schedule_steps}")
    if schedule == "cosine" and schedule_steps is None and not math.isfinite(budget):
        raise ValueError("schedule_steps: expected a number of steps for a cosine without a budget, got None")
    length = (schedule_steps or max(1, int(budget // cost))) if schedule == "cosine" else None
    options = {"lr": lr, "schedule": schedule, "schedule_steps": length, "clip_norm": clip_norm, "patience": patience}
    run = Run(
        problem,
        "adam",
        budget=budget,
        least=cost,
        seconds=seconds,
        seed=seed,
        tolerance=tolerance,
        checkpoint=checkpoint,
        checkpoint_seconds=checkpoint_seconds,
        callback=callback,
        options=options,
    )

    def loop() -> tuple[Status, str]:
        # In here, because torch loads its compiler with its first optimiser: seconds in which Ctrl-C must count too.
        raw = problem.to_raw(problem.initial)
        optimizer = torch.optim.Adam([raw], lr=lr)
        # Loss and step of the last improvement by more than the tolerance.
        reference_loss, reference_step = math.inf, 0
        if run.state is not None:
            raw.copy_(run.state["raw"])
            optimizer.load_state_dict(run.state["optimizer"])
            reference_loss, reference_step = run.state["reference"]
        while True:
            if tolerance > 0 and run.step - reference_step >= patience:
                return Status.CONVERGED, f"converged after {run.step} steps"
            if length is not None:
                optimizer.param_groups[0]["lr"] = lr * 0.5 * (1 + math.cos(math.pi * min(run.step / length, 1.0)))
            _, gradient = run.value_and_grad(raw, space="raw")
            if clip_norm is not None:
                gradient = gradient * min(1.0, clip_norm / max(float(gradient.norm()), 1e-300))
            raw.grad = gradient
            optimizer.step()
            run.step += 1
            if run.best_loss < reference_loss - tolerance * abs(run.best_loss):
                reference_loss, reference_step = run.best_loss, run.step
            reference = [reference_loss, reference_step]
            run.mark({"raw": raw, "optimizer": optimizer.state_dict(), "reference": reference})

    return _say_if_lost(run.execute(loop))


def _say_if_lost(result: OptimResult) -> OptimResult:
    """A step size that throws the search out of its valley ends far above its start; the best point is still what returns."""
    losses = [point.loss for point in result.history if math.isfinite(point.loss)]
    if result.status not in (Status.BUDGET, Status.TIME_LIMIT, Status.CONVERGED) or not losses:
        return result
    told = ""
    if losses[-1] > _DIVERGED * abs(losses[0]):
        told = f"diverged from a loss of {losses[0]:.3g} to {losses[-1]:.3g}, the best ({result.loss:.3g}) is returned"
    elif len(losses) > 2 and result.loss == losses[0] > 0:
        told = f"no step of {len(losses) - 1} came below the start's loss of {losses[0]:.3g}"
    return replace(result, message=f"adam: {told}: lower the step size ({result.message})") if told else result
