"""Positions by solvers that need no derivative: NLopt's SBPLX, CRS2 and BOBYQA, and CMA-ES, at the budget of the gradient way.

They minimise the same training error over all 3n coordinates at once, from the best uniform grid, with a penalty for probes in
solids. Sources: Rowan 1990 (Subplex), Kaelo and Ali 2006 (CRS2), Powell 2009 (BOBYQA), Hansen 2016 (CMA-ES).

Useful sizes. BOBYQA first takes 2 x 3n + 1 values for its quadratic model: with fewer evaluations than that it only tries each
coordinate up and down once. CRS2 first draws 10 (3n + 1) positions at random: below that budget it is a random search.
CMA-ES learns a covariance of 3n x 3n numbers, which takes many more evaluations than 3n. ``details["limit"]`` says so where it
happened.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch

from difflpv.optim import solve
from difflpv.optim.problem import Problem
from difflpv.optim.result import HistoryPoint
from difflpv.parameters import Parameter
from difflpv.placement.journal import Journal, distinct
from difflpv.placement.reconstruction import Content, reconstruction_error
from difflpv.placement.task import Placement, PlacementTask, Progress
from difflpv.placement.uniform import SPREADS, move_into_free_space, uniform_grids

__all__ = ["DerivativeFree", "place_derivative_free"]

DerivativeFree = Literal["sbplx", "crs2", "bobyqa", "cma"]

_SOLVERS = {"sbplx": "nlopt-sbplx", "crs2": "nlopt-crs2", "bobyqa": "nlopt-bobyqa", "cma": "cma"}


def place_derivative_free(
    task: PlacementTask,
    count: int,
    *,
    solver: DerivativeFree,
    seed: int = 0,
    progress: Progress | None = None,
    budget: int = 750,
    seconds: float | None = None,
    initial_step: float = 0.05,
    solid_penalty: float = 1.0,
    content: Content = "field",
) -> Placement:
    """Minimise the training error over positions without derivatives.

    Args:
        task: what is known.
        count: probes at most.
        solver: which of them.
        seed: of CRS2 and CMA-ES.
        progress: told about each evaluation, with the best error so far.
        budget: evaluations of the error, the start's included; the default is that of 250 steps with gradients (3 each).
        seconds: wall time at most.
        initial_step: first step as a share of the working volume's edges.
        solid_penalty: added to the error for a mean depth of the probes in solids of one grid spacing.
        content: what probes hold while they are moved: the field's values, or the solution by least squares.

    Raises:
        ValueError: an option out of range, no probe in free space, or CMA-ES without the package ``cma``.
    """
    journal = Journal(task, solver, count, progress)
    if solver not in _SOLVERS:
        raise ValueError(f"solver: expected one of {', '.join(_SOLVERS)}, got '{solver}'")
    if budget < 10:
        raise ValueError(f"{solver} budget: expected at least 10 evaluations, got {budget}")
    grids = [grid for spread in SPREADS for grid in uniform_grids(task, count, spread, margin=0.1)[:1]]
    if not grids:
        raise journal.nothing_free()
    grid = min(grids, key=lambda g: journal.error(g.position))
    low, high = task.bounds
    edge = 1e-3 * (high - low).max()
    lower, upper = np.minimum(low, grid.position.min(0)) - edge, np.maximum(high, grid.position.max(0)) + edge
    spacing = float(grid.spacing.min())

    def loss(values: dict[str, torch.Tensor]) -> torch.Tensor:
        position = values["position"]
        depth = (-task.clearance(position)).clamp_min(0).mean() / spacing
        return reconstruction_error(task, position, content=content) + solid_penalty * depth

    best = np.inf

    def note(point: HistoryPoint) -> None:
        nonlocal best
        best = min(best, point.loss) if point.loss == point.loss else best
        journal.note(len(grid.position), best)

    problem = Problem(loss, [Parameter("position", grid.position, lower, upper)], label=f"probes by {solver}")
    options = {} if solver == "crs2" else {"initial_step": initial_step}
    left = budget - journal.evaluations
    result = solve(problem, _SOLVERS[solver], budget=left, seconds=seconds, seed=seed, callback=note, **options)
    journal.evaluations += result.evaluations
    position = move_into_free_space(task, result.parameters["position"].numpy(), 0.45 * grid.spacing, margin=0.1 * spacing)
    position = position[task.in_free_space(position)]
    position = position[distinct(position, 1e-6 * spacing)]
    return journal.placement(
        position,
        solver=_SOLVERS[solver],
        status=str(result.status),
        message=result.message,
        training_error=result.loss,
        start_error=result.history[0].loss,
        dropped=len(grid.position) - len(position),
        limit=_limit(solver, problem.size, left),
    )


def _limit(solver: str, size: int, budget: int) -> str:
    """What keeps a solver from doing its work with so many unknowns and so few evaluations; empty if nothing does."""
    first = {"bobyqa": 2 * size + 1, "crs2": 10 * (size + 1)}.get(solver, 0)
    if budget > first:
        return ""
    reached = {"bobyqa": "its quadratic model", "crs2": "its random first population"}[solver]
    return f"{budget} evaluations end within {reached}, which takes {first} for {size} coordinates"
