"""Least squares with bounds for what the residual is linear in: light intensities and colours.

Transport is linear in the light, so that the irradiance of unit lights, one column each, gives the best non-negative
intensities in one solve (Lawson and Hanson 1974, "Solving least squares problems", ch. 23), without any descent.
"""

from __future__ import annotations

import os

import numpy as np
import torch
from torch import Tensor

from difflpv.optim.problem import Problem
from difflpv.optim.result import OptimResult, Status
from difflpv.optim.run import Callback, Run, StopRun

__all__ = ["nonnegative_least_squares", "solve_nnls"]


def nonnegative_least_squares(response: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """The x >= 0 that makes ||sqrt(w)(A x - b)|| smallest.

    Args:
        response: A, column k is what light k gives at unit intensity, shape [m, k].
        target: b, shape [m].
        weight: w >= 0, shape [m]; None counts all alike.

    Returns:
        x, float64, shape [k]; 0 for a light without any response.

    Raises:
        ValueError: shapes disagree, a value is not finite, or a weight is negative.
    """
    a, b = (t.detach().to("cpu", torch.float64) for t in (response, target))
    w = torch.ones_like(b) if weight is None else weight.detach().to("cpu", torch.float64)
    if a.ndim != 2 or 0 in a.shape:
        raise ValueError(f"response: expected shape [m, k] with at least one row and column, got {list(a.shape)}")
    for name, tensor in (("target", b), ("weight", w)):
        if tensor.shape != a.shape[:1]:
            raise ValueError(f"{name}: expected shape [{a.shape[0]}], got {list(tensor.shape)}")
    for name, tensor in (("response", a), ("target", b), ("weight", w)):
        if not tensor.isfinite().all():
            raise ValueError(f"{name}: expected finite values, got {int((~tensor.isfinite()).sum())} that are not")
    if (w < 0).any():
        raise ValueError(f"weight: expected values >= 0, got {w.min().item():g}")
    root = w.sqrt().numpy()
    return torch.from_numpy(_bounded(root[:, None] * a.numpy(), root * b.numpy(), 0.0, np.inf))


def solve_nnls(
    problem: Problem,
    *,
    budget: float,
    seconds: float | None = None,
    seed: int = 0,
    tolerance: float = 1e-3,
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_seconds: float = 10.0,
    callback: Callback | None = None,
) -> OptimResult:
    """Solve a problem whose residual is affine in its parameters; parameters without bounds may be negative.

    One residual per entry (the response of each unit light), one without light, one to check the result, and the loss
    there: n + 3 forward-equivalents.

    Args:
        problem: made with ``residual``.
        budget: at least n + 3 forward-equivalents.
        seconds: wall time to spend at most, None for no limit.
        seed: seeds ``problem.generator``; the solver itself draws nothing.
        tolerance: largest deviation of the residual from its affine form, relative to the target.
        checkpoint: file for the result; the solve itself cannot be continued half-way and starts again.
        checkpoint_seconds: how often to write it [s]; it is always written at the end.
        callback: told about the evaluation of the loss.

    Returns:
        The optimum; status ``failed`` if the residual turns out not to be affine.

    Raises:
        ValueError: an option out of range, or a problem without residual.
        CheckpointError: a checkpoint of another fit.
    """
    run = Run(
        problem,
        "nnls",
        budget=budget,
        least=problem.size + 3.0,
        seconds=seconds,
        seed=seed,
        tolerance=tolerance,
        checkpoint=checkpoint,
        checkpoint_seconds=checkpoint_seconds,
        callback=callback,
        options={},
    )

    def loop() -> tuple[Status, str]:
        zeros = torch.zeros_like(problem.initial)
        base = zeros.clamp(problem.lower, problem.upper)
        at_base = _residual(run, base)
        columns = []
        for k in range(problem.size):
            probe = base.clone()
            room_above = float(problem.upper[k] - base[k])
            room_below = float(base[k] - problem.lower[k])
            probe[k] += min(1.0, room_above) if room_above >= min(1.0, room_below) else -min(1.0, room_below)
            columns.append((_residual(run, probe) - at_base) / (probe[k] - base[k]))
        response = torch.stack(columns, 1)
        target = response @ base - at_base
        try:
            solution = _bounded(response.numpy(), target.numpy(), problem.lower.numpy(), problem.upper.numpy())
        except RuntimeError as error:
            raise StopRun(Status.FAILED, f"scipy gave up ({error})") from None
        x = torch.from_numpy(solution)
        run.step += 1
        run.value(x)
        deviation = float((_residual(run, x) - (response @ x - target)).norm())
        if deviation > tolerance * max(float(target.norm()), float((response @ x).norm())):
            return Status.FAILED, "the residual is not affine in the parameters: use another solver for them"
        return Status.CONVERGED, "solved"

    return run.execute(loop)


def _residual(run: Run, x: Tensor) -> Tensor:
    run.admit(1.0)
    residual = run.problem.residual_at(x)
    if not residual.isfinite().all():
        where = ", ".join(f"'{name}' = {value.tolist()}" for name, value in run.problem.unpack(x).items())
        raise StopRun(Status.NON_FINITE, f"residual is not finite at step {run.step}: parameter {where}")
    return residual


def _bounded(a: np.ndarray, b: np.ndarray, lower: float | np.ndarray, upper: float | np.ndarray) -> np.ndarray:
    """The x in [lower, upper] that makes ||a x - b|| smallest."""
    from scipy.optimize import lsq_linear, nnls

    # Columns of unit length, so that a bright light does not set the tolerance of a dim one.
    length = np.linalg.norm(a, axis=0)
    scale = np.where(length > 0, length, 1.0)
    # The triangular factor has the same normal equations in a handful of rows.
    q, r = np.linalg.qr(a / scale)
    b = q.T @ b
    if np.all(np.asarray(lower) == 0) and np.all(np.asarray(upper) == np.inf):
        x = np.where(length > 0, nnls(r, b)[0], 0.0)
    else:
        x = lsq_linear(r, b, bounds=(lower * scale, upper * scale), method="bvls", tol=1e-14).x
    return np.clip(x / scale, lower, upper)
