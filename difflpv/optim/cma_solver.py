"""CMA-ES (Hansen 2016, "The CMA evolution strategy: a tutorial") on physical values, by the optional package ``cma``.

A population is drawn from a Gaussian whose covariance follows the better half of each generation: no gradient is needed,
and noise or several optima hurt less than they hurt a local search, at the price of many more evaluations. The best point,
the budget and the clock are kept on this side, as for NLopt.
"""

from __future__ import annotations

import math
import os
import warnings
from typing import Any

import numpy as np

from difflpv.optim.box import Box
from difflpv.optim.problem import Problem
from difflpv.optim.result import OptimResult, Status
from difflpv.optim.run import Callback, Run

__all__ = ["solve_cma"]


def solve_cma(
    problem: Problem,
    *,
    budget: float,
    seconds: float | None = None,
    seed: int = 0,
    tolerance: float = 1e-8,
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_seconds: float = 10.0,
    callback: Callback | None = None,
    initial_step: float = 0.2,
    population: int | None = None,
) -> OptimResult:
    """Minimise with CMA-ES, on physical values and their bounds.

    A value that is not finite counts as worse than all others, unless it is the first one. A checkpoint holds the best point
    and the history, not the covariance: a resumed run starts a new search from the best point.

    Args:
        problem: what to minimise.
        budget: forward-equivalents to spend at most.
        seconds: wall time to spend at most, None for no limit.
        seed: seeds the population and ``problem.generator``.
        tolerance: spread of losses and of scaled parameters under which the search has converged.
        checkpoint: file to restart from, if it exists, and to write to.
        checkpoint_seconds: how often to write it [s]; it is always written at the end.
        callback: told about each evaluation.
        initial_step: standard deviation of the first generation, as a share of a parameter's interval, or of its scale where
            it has none.
        population: points of a generation, None for the default of 4 + 3 log n.

    Returns:
        The best point seen.

    Raises:
        ValueError: the package ``cma`` is not installed, or an option out of range.
        CheckpointError: a checkpoint of another fit.
    """
    cma = _package()
    if not 0 < initial_step <= 0.5:
        raise ValueError(f"initial_step: expected a share in (0, 0.5], got {initial_step}")
    if population is not None and population < 2:
        raise ValueError(f"population: expected at least 2 points, got {population}")
    run = Run(
        problem,
        "cma",
        budget=budget,
        least=1.0,
        seconds=seconds,
        seed=seed,
        tolerance=tolerance,
        checkpoint=checkpoint,
        checkpoint_seconds=checkpoint_seconds,
        callback=callback,
        options={"initial_step": initial_step, "population": population},
    )
    box = Box(problem)
    # A single number has no covariance, and the package refuses it: a second coordinate that nothing depends on goes along.
    idle = problem.size == 1

    def loop() -> tuple[Status, str]:
        run.value(run.best)
        run.step += 1
        run.mark({})
        search = cma.CMAEvolutionStrategy(
            _with_idle(box.to_unit(run.best), idle, 0.5), initial_step, _options(box, idle, seed, tolerance, population)
        )
        worst = run.best_loss
        while not search.stop():
            points, losses = search.ask(), []
            for u in points:
                loss = run.value(box.to_physical(np.asarray(u)[: problem.size]), refuse=False)
                worst = worst if math.isnan(loss) else max(worst, loss)
                losses.append(loss)
                run.step += 1
                run.mark({})
            # Only ranks count: anything above the worst value says "never again".
            search.tell(points, [2 * abs(worst) + 1 if math.isnan(loss) else loss for loss in losses])
        return Status.CONVERGED, run.told(f"converged after {run.step} evaluations ({', '.join(search.stop())})")

    return run.execute(loop)


def _package() -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it looks for optional packages of its own as it loads
            import cma
    except ModuleNotFoundError:
        raise ValueError("solver: 'cma' needs the optional package cma: pip install 'difflpv[cma]'") from None
    return cma


def _with_idle(u: np.ndarray, idle: bool, value: float) -> np.ndarray:
    return np.append(u, value) if idle else u


def _options(box: Box, idle: bool, seed: int, tolerance: float, population: int | None) -> dict[str, Any]:
    """The package's options: silent, no files, our bounds and random numbers."""
    low, high = _with_idle(box.lower, idle, 0.0), _with_idle(box.upper, idle, 1.0)
    options = {
        "bounds": [_plain(low), _plain(high)],
        "seed": math.nan,  # leave numpy's own generator alone
        "randn": np.random.RandomState(seed + 1).randn,
        "tolfun": tolerance,
        "tolx": tolerance,
        "verbose": -9,
        "verb_disp": 0,
        "verb_log": 0,
        "CMA_diagonal": False,
    }
    return options if population is None else options | {"popsize": population}


def _plain(bounds: np.ndarray) -> list[float | None]:
    return [float(b) if math.isfinite(b) else None for b in bounds]
