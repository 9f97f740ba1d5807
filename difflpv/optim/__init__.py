"""Fitting: problems, solvers and their results. Importing this names the solvers; calling one loads torch."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from difflpv.optim.problem import Problem
    from difflpv.optim.result import OptimResult

__all__ = ["SOLVERS", "solve"]


def _solver(module: str, function: str, **fixed: Any) -> Callable[..., OptimResult]:
    """The solver ``function`` of ``difflpv.optim.<module>``, imported on its first call."""

    def call(problem: Problem, **options: Any) -> OptimResult:
        if not isinstance(problem, import_module("difflpv.optim.problem").Problem):
            raise TypeError(f"problem: expected a Problem, got {type(problem).__name__}")
        solver = getattr(import_module(f"difflpv.optim.{module}"), function)
        return solver(problem, **fixed, **options)

    return call


def _nlopt(name: str) -> Callable[..., OptimResult]:
    return _solver("nlopt_solver", "solve_nlopt", algorithm=name)


SOLVERS: dict[str, Callable[..., OptimResult]] = {
    "adam": _solver("adam", "solve_adam"),
    "lbfgs": _solver("lbfgs", "solve_lbfgs"),
    "nnls": _solver("nnls", "solve_nnls"),
} | {f"nlopt-{name}": _nlopt(f"nlopt-{name}") for name in ("bobyqa", "sbplx", "cobyla", "crs2", "mma", "lbfgs")}
SOLVERS["cma"] = _solver("cma_solver", "solve_cma")  # an extra: pip install 'difflpv[cma]'


def solve(problem: Problem, solver: str, **options: Any) -> OptimResult:
    """Minimise a problem with a solver by name.

    Args:
        problem: what to minimise.
        solver: a name of ``SOLVERS``.
        **options: ``budget`` (forward-equivalents, required), ``seconds``, ``seed``, ``tolerance``, ``checkpoint``,
            ``checkpoint_seconds``, ``callback`` and the solver's own.

    Returns:
        The best point seen and how the run went.

    Raises:
        TypeError: ``problem`` is something else.
        ValueError: no solver of this name, or an option out of range.
    """
    if solver not in SOLVERS:
        raise ValueError(f"solver: expected one of {', '.join(SOLVERS)}, got '{solver}'")
    return SOLVERS[solver](problem, **options)
