"""NLopt's algorithms (S. G. Johnson, "The NLopt nonlinear-optimization package") behind a shell that loses nothing.

NLopt raises where it should stop, loses the best point with the exception, may step outside its bounds by a rounding
error, and returns uninitialised memory after a NaN. So the best point, the budget and the clock are kept on this side;
its algorithms see coordinates scaled to the bounds and only finite values.
"""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
from torch import Tensor

from difflpv.optim.box import Box
from difflpv.optim.problem import Problem
from difflpv.optim.result import OptimResult, Status
from difflpv.optim.run import Callback, Run, StopRun

__all__ = ["NLOPT_ALGORITHMS", "solve_nlopt"]

NLOPT_ALGORITHMS = {
    "nlopt-bobyqa": "LN_BOBYQA",
    "nlopt-sbplx": "LN_SBPLX",
    "nlopt-cobyla": "LN_COBYLA",
    "nlopt-crs2": "GN_CRS2_LM",
    "nlopt-mma": "LD_MMA",
    "nlopt-lbfgs": "LD_LBFGS",
}


def solve_nlopt(
    problem: Problem,
    *,
    algorithm: str,
    budget: float,
    seconds: float | None = None,
    seed: int = 0,
    tolerance: float = 1e-8,
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_seconds: float = 10.0,
    callback: Callback | None = None,
    initial_step: float = 0.1,
    population: int | None = None,
) -> OptimResult:
    """Minimise with one of NLopt's algorithms, on physical values and their bounds.

    ``nlopt-mma`` and ``nlopt-lbfgs`` use gradients and refuse to go on after a value that is not finite. The others do
    not: such a value becomes a large finite penalty there, unless it is the first one. A checkpoint holds the best
    point and the history, not the algorithm's inner state: a resumed run starts a new search from the best point.

    Args:
        problem: what to minimise.
        algorithm: a name of ``NLOPT_ALGORITHMS``.
        budget: forward-equivalents to spend at most.
        seconds: wall time to spend at most, None for no limit.
        seed: seeds NLopt's generator (``nlopt-crs2``) and ``problem.generator``.
        tolerance: relative change of loss or scaled parameters under which the search has converged.
        checkpoint: file to restart from, if it exists, and to write to.
        checkpoint_seconds: how often to write it [s]; it is always written at the end.
        callback: told about each evaluation.
        initial_step: first step of the algorithms without gradients, as a share of a parameter's interval, or of its
            scale where it has none.
        population: points that ``nlopt-crs2`` keeps, None for its default of 10 (n + 1).

    Returns:
        The best point seen.

    Raises:
        ValueError: an unknown algorithm, an option out of range, or a parameter without finite bounds for
            ``nlopt-crs2``.
        CheckpointError: a checkpoint of another fit.
    """
    import nlopt

    if algorithm not in NLOPT_ALGORITHMS:
        raise ValueError(f"algorithm: expected one of {', '.join(NLOPT_ALGORITHMS)}, got '{algorithm}'")
    if not 0 < initial_step <= 0.5:
        raise ValueError(f"initial_step: expected a share in (0, 0.5], got {initial_step}")
    if population is not None and population <= problem.size:
        raise ValueError(f"population: expected more than {problem.size} points, got {population}")
    for parameter in problem.parameters:
        if algorithm == "nlopt-crs2" and parameter.map != "interval":
            got = f"[{parameter.lower.min().item():g}, {parameter.upper.max().item():g}]"
            raise ValueError(f"nlopt-crs2: parameter '{parameter.name}': expected finite bounds, got {got}")
    with_gradient = algorithm in ("nlopt-mma", "nlopt-lbfgs")
    run = Run(
        problem,
        algorithm,
        budget=budget,
        least=1.0 + problem.backward_cost * with_gradient,
        seconds=seconds,
        seed=seed,
        tolerance=tolerance,
        checkpoint=checkpoint,
        checkpoint_seconds=checkpoint_seconds,
        callback=callback,
        options={"initial_step": initial_step, "population": population},
    )
    box = Box(problem)
    objective = _Objective(run, box, with_gradient)
    optimizer = nlopt.opt(getattr(nlopt, NLOPT_ALGORITHMS[algorithm]), problem.size)
    optimizer.set_min_objective(objective)
    optimizer.set_lower_bounds(box.lower)
    optimizer.set_upper_bounds(box.upper)
    optimizer.set_ftol_rel(tolerance)
    optimizer.set_xtol_rel(tolerance)
    if seconds is not None:
        optimizer.set_maxtime(max(seconds - run.elapsed, 1e-3))
    if population is not None:
        optimizer.set_population(population)
    if not with_gradient:
        optimizer.set_initial_step(initial_step)
    nlopt.srand(seed)

    def loop() -> tuple[Status, str]:
        start = box.to_unit(run.best)
        objective.begin(start, run.best)
        try:
            optimizer.optimize(start)
        except nlopt.RoundoffLimited:
            return Status.ROUNDOFF_LIMITED, run.told("rounding errors limit the progress")
        except Exception as error:
            # Whatever left the objective goes on as it is; the rest is NLopt's own way of giving up.
            if objective.raised is not None:
                raise objective.raised from None
            return Status.FAILED, run.told(f"NLopt gave up ({optimizer.get_errmsg() or type(error).__name__})")
        if objective.raised is not None:
            raise objective.raised
        code = optimizer.last_optimize_result()
        if code == nlopt.MAXTIME_REACHED:
            return Status.TIME_LIMIT, ""
        return Status.CONVERGED, run.told(f"converged after {run.step} evaluations")

    return run.execute(loop)


class _Objective:
    """NLopt's callback: a plain float for every call, whatever the loss does."""

    def __init__(self, run: Run, box: Box, with_gradient: bool) -> None:
        self._run, self._box, self._with_gradient = run, box, with_gradient
        self._first: tuple[bytes, float, np.ndarray | None] | None = None
        self._penalty = 0.0
        self.raised: BaseException | None = None

    def begin(self, u: np.ndarray, x: Tensor) -> None:
        """Evaluate the start ``x``, which some algorithms move away from a bound before they look at it."""
        loss, gradient = self._evaluate(x, refuse=True)
        self._first = u.tobytes(), loss, gradient

    def __call__(self, u: np.ndarray, gradient: np.ndarray) -> float:
        # CRS2 goes on calling while it builds its population, whatever was raised before.
        if self.raised is not None:
            raise self.raised
        try:
            # NLopt reuses the memory behind u; BOBYQA may leave the box by a rounding error.
            u = np.clip(np.array(u), self._box.lower, self._box.upper)
            if not np.isfinite(u).all():  # COBYLA, once its simplex has collapsed
                raise StopRun(Status.ROUNDOFF_LIMITED, self._run.told("the algorithm proposed a point that is not finite"))
            if self._first is not None and self._first[0] == u.tobytes():
                (_, loss, slope), self._first = self._first, None
            else:
                loss, slope = self._evaluate(self._box.to_physical(u), refuse=False)
            if slope is not None and gradient.size:
                gradient[:] = slope
            return loss
        except BaseException as error:
            self.raised = error
            raise

    def _evaluate(self, x: Tensor, *, refuse: bool) -> tuple[float, Any]:
        slope = None
        if self._with_gradient:
            loss, gradient = self._run.value_and_grad(x)
            slope = self._box.gradient(gradient)
        else:
            loss = self._run.value(x, refuse=refuse)
        if math.isnan(loss):
            loss = self._penalty
        # Above everything seen so far, yet not so far above that a quadratic model through it becomes useless.
        self._penalty = max(self._penalty, 1e3 * max(1.0, abs(loss))) if refuse else max(self._penalty, loss)
        self._run.step += 1
        self._run.mark({})
        return loss, slope
