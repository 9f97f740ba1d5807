"""L-BFGS on raw values with a strong Wolfe line search (Nocedal and Wright 2006, ch. 7), by ``torch.optim.LBFGS``."""

from __future__ import annotations

import os

import torch
from torch import Tensor

from difflpv.optim.problem import Problem
from difflpv.optim.result import OptimResult, Status
from difflpv.optim.run import Callback, Run

__all__ = ["solve_lbfgs"]

# torch gives a line search what is left of a step's evaluations; its default for a single step is none.
_LINE_SEARCH_EVALUATIONS = 26


def solve_lbfgs(
    problem: Problem,
    *,
    budget: float,
    seconds: float | None = None,
    seed: int = 0,
    tolerance: float = 1e-9,
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_seconds: float = 10.0,
    callback: Callback | None = None,
    lr: float = 1.0,
    memory: int = 10,
    patience: int = 2,
) -> OptimResult:
    """Minimise with L-BFGS.

    The budget is respected inside a line search too. A checkpoint continues bit for bit from the last completed step:
    a line search that was interrupted starts again.

    Args:
        problem: what to minimise.
        budget: forward-equivalents to spend at most; an evaluation costs 1 + ``problem.backward_cost``.
        seconds: wall time to spend at most, None for no limit.
        seed: seeds ``problem.generator``; L-BFGS itself draws nothing.
        tolerance: converged when the loss falls by at most this, relatively, ``patience`` steps in a row.
        checkpoint: file to resume from, if it exists, and to write to.
        checkpoint_seconds: how often to write it [s]; it is always written at the end.
        callback: told about each evaluation.
        lr: first trial length of a line search, in units of the quasi-Newton step.
        memory: number of steps that the approximate Hessian remembers.
        patience: see ``tolerance``.

    Returns:
        The best point seen.

    Raises:
        ValueError: an option out of range.
        CheckpointError: a checkpoint of another fit.
    """
    if not lr > 0:
        raise ValueError(f"lr: expected a positive number, got {lr}")
    if memory < 1 or patience < 1:
        raise ValueError(f"memory, patience: expected at least 1, got {memory}, {patience}")
    run = Run(
        problem,
        "lbfgs",
        budget=budget,
        least=1.0 + problem.backward_cost,
        seconds=seconds,
        seed=seed,
        tolerance=tolerance,
        checkpoint=checkpoint,
        checkpoint_seconds=checkpoint_seconds,
        callback=callback,
        options={"lr": lr, "memory": memory, "patience": patience},
    )

    def loop() -> tuple[Status, str]:
        # In here, because torch loads its compiler with its first optimiser: seconds in which Ctrl-C must count too.
        raw = problem.to_raw(problem.initial)
        optimizer = torch.optim.LBFGS(
            [raw],
            lr=lr,
            max_iter=1,
            max_eval=_LINE_SEARCH_EVALUATIONS,
            history_size=memory,
            tolerance_grad=0.0,
            tolerance_change=1e-15,
            line_search_fn="strong_wolfe",
        )
        # Each step of torch's L-BFGS begins by evaluating the point where the last one ended: remembered, not repeated.
        known: dict[bytes, tuple[float, Tensor]] = {}
        stalled = 0
        if run.state is not None:
            raw.copy_(run.state["raw"])
            optimizer.load_state_dict(run.state["optimizer"])
            known[_key(raw)] = run.state["loss"], run.state["gradient"]
            stalled = run.state["stalled"]

        def closure() -> float:
            key = _key(raw)
            if key not in known:
                known[key] = run.value_and_grad(raw, space="raw")
            raw.grad = known[key][1].clone()
            return known[key][0]

        while True:
            if stalled >= patience:
                return Status.CONVERGED, f"converged after {run.step} steps"
            before = closure()
            optimizer.step(closure)
            after = closure()
            here = _key(raw)
            for key in [k for k in known if k != here]:
                del known[key]
            stalled = stalled + 1 if before - after <= tolerance * abs(before) else 0
            run.step += 1
            state = {"raw": raw, "optimizer": optimizer.state_dict(), "stalled": stalled}
            run.mark(state | {"loss": after, "gradient": known[here][1]})

    return run.execute(loop)


def _key(raw: Tensor) -> bytes:
    return raw.detach().numpy().tobytes()
