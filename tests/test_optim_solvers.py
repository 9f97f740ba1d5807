"""Each solver on problems whose optimum is known on paper."""

import numpy as np
import pytest
import torch

from difflpv.loss import relative_l2
from difflpv.optim import SOLVERS, solve
from difflpv.optim.problem import Problem
from difflpv.optim.result import OptimResult, Status
from difflpv.parameters import Parameter

F64 = torch.float64
DESCENT = [name for name in SOLVERS if name != "nnls"]
# What each may spend and how near it has to come, sum of absolute deviations from the optimum.
# Smooth maps only approach an active bound (adam, lbfgs); CRS2, COBYLA and MMA are slow on curved valleys.
QUADRATIC = {name: (900, 1e-3) for name in DESCENT} | {"adam": (1500, 0.04)}
ROSENBROCK = {
    "adam": (3000, 0.05),
    "lbfgs": (300, 1e-5),
    "nlopt-bobyqa": (400, 1e-5),
    "nlopt-sbplx": (600, 1e-5),
    "nlopt-cobyla": (3000, 0.2),
    "nlopt-crs2": (3000, 1e-2),
    "nlopt-mma": (3000, 0.3),
    "nlopt-lbfgs": (300, 1e-5),
    "cma": (1500, 1e-4),
}


def test_cma_draws_from_numbers_of_its_own():
    """Neither does it reseed numpy's generator, nor does it matter who else draws from that."""
    pytest.importorskip("cma")
    np.random.seed(5)
    expected = np.random.rand()

    def losses(**options):
        problem = Problem(lambda p: ((p["x"] - 0.3) ** 2).sum(), [Parameter("x", [0.5] * 3, 0, 1)])
        return [point.loss for point in solve(problem, "cma", budget=60, **options).history]

    np.random.seed(5)
    alone = losses()
    assert np.random.rand() == expected
    assert losses(callback=lambda point: np.random.rand()) == alone


@pytest.mark.parametrize("solver", DESCENT)
def test_quadratic_with_active_bounds(solver):
    centre = torch.tensor([2.0, 0.3, -1.0], dtype=F64)
    curvature = torch.tensor([1.0, 3.0, 10.0], dtype=F64)
    problem = Problem(lambda p: (curvature * (p["x"] - centre) ** 2).sum(), [Parameter("x", [0.5] * 3, 0, 1)])
    budget, near = QUADRATIC[solver]
    result = solve(problem, solver, budget=budget)
    optimum = torch.tensor([1.0, 0.3, 0.0], dtype=F64)  # separable: the centre, clipped
    assert float((result.parameters["x"] - optimum).abs().sum()) < near
    assert 11.0 <= result.loss < 11.0 + 25 * near
    check_result(result, problem, solver, budget)


@pytest.mark.parametrize("solver", DESCENT)
def test_rosenbrock_with_bounds(solver):
    problem = Problem(
        lambda p: 100 * (p["y"] - p["x"] ** 2) ** 2 + (1 - p["x"]) ** 2,
        [Parameter("x", -0.5, -2, 2), Parameter("y", 0.5, -2, 2)],
    )
    budget, near = ROSENBROCK[solver]
    result = solve(problem, solver, budget=budget, **({"lr": 0.2} if solver == "adam" else {}))
    assert abs(float(result.parameters["x"]) - 1) + abs(float(result.parameters["y"]) - 1) < near
    check_result(result, problem, solver, budget)


@pytest.mark.parametrize("solver", list(SOLVERS))
def test_one_light_recovery(solver):
    # Irradiance I cos/d^2 of one light over a floor: the intensity of each channel from values at 40 receivers.
    generator = torch.Generator().manual_seed(1)
    position = 4 * torch.rand(40, 2, generator=generator, dtype=F64) - 2
    distance = (position.square().sum(1) + 9).sqrt()
    unit = (3 / distance**3)[:, None]
    intensity = torch.tensor([20.0, 5.0, 11.0], dtype=F64)
    target = unit * intensity
    upper = 100.0 if solver == "nlopt-crs2" else torch.inf
    problem = Problem(
        lambda p: relative_l2(unit * p["intensity"], target),
        [Parameter("intensity", [10.0] * 3, 0.0, upper)],
        residual=lambda p: unit * p["intensity"] - target,
    )
    result = solve(problem, solver, budget=1800)
    torch.testing.assert_close(result.parameters["intensity"], intensity, rtol=1e-3, atol=0)
    check_result(result, problem, solver, 1800)


def check_result(result, problem, solver, budget):
    assert isinstance(result, OptimResult) and result.solver == solver and result.seed == 0
    assert result.status in (Status.CONVERGED, Status.BUDGET) and result.status.advice in result.message
    assert result.forward_equivalents == problem.forward_equivalents <= budget
    assert result.evaluations == len(result.history)
    assert result.loss == min(point.loss for point in result.history)
    spent = [point.forward_equivalents for point in result.history]
    assert spent == sorted(spent) and spent[-1] <= result.forward_equivalents
    x = problem.pack(result.parameters)
    assert (x >= problem.lower).all() and (x <= problem.upper).all()
    assert problem.value(x) == pytest.approx(result.loss, rel=1e-12)


def test_free_and_upper_bounded_parameters():
    parameters = [Parameter("free", 3.0), Parameter("below", -3.0, upper=-1.0), Parameter("one", [0.5], -1, 1)]
    for solver in ("lbfgs", "nlopt-bobyqa", "nlopt-sbplx", "nlopt-cobyla", "nlopt-lbfgs", "nlopt-mma"):
        problem = Problem(
            lambda p: (p["free"] + 7) ** 2 + (p["below"] + 2) ** 2 + (p["one"] - 2).square().sum(), parameters
        )
        result = solve(problem, solver, budget=900)
        near = 1e-2 if solver == "lbfgs" else 1e-3
        assert result.parameters["free"] == pytest.approx(-7, abs=near)
        assert result.parameters["below"] == pytest.approx(-2, abs=near)
        assert float(result.parameters["one"]) == pytest.approx(1, abs=near)


@pytest.mark.parametrize("solver", DESCENT)
def test_a_single_number(solver):
    problem = Problem(lambda p: (p["x"] - 0.3) ** 2, [Parameter("x", 0.6, 0, 1)])
    result = solve(problem, solver, budget=600)
    assert float(result.parameters["x"]) == pytest.approx(0.3, abs=1e-3)


def test_same_seed_same_bits_and_another_seed_another_search():
    def losses(solver, seed):
        problem = Problem(lambda p: ((p["x"] - 0.3) ** 2).sum(), [Parameter("x", [0.6, 0.7], 0, 1)])
        return [point.loss for point in solve(problem, solver, budget=90, seed=seed).history]

    for solver in DESCENT:
        assert losses(solver, 5) == losses(solver, 5)
    assert losses("nlopt-crs2", 5) != losses("nlopt-crs2", 6)


def test_a_loss_that_draws_is_seeded_by_the_solver():
    def losses(seed):
        generator = torch.Generator()
        problem = Problem(
            lambda p: (p["x"] - torch.rand(3, generator=generator, dtype=F64)).square().sum(),
            [Parameter("x", 0.5)],
            generator=generator,
        )
        return [point.loss for point in solve(problem, "adam", budget=30, seed=seed).history]

    assert losses(1) == losses(1) != losses(2)


def test_adam_schedules_clipping_and_early_stop():
    def quadratic():
        return Problem(lambda p: (p["x"] ** 2).sum(), [Parameter("x", [4.0])])

    def steps(**options):
        path = []

        def loss(p):
            path.append(float(p["x"].detach()))
            return (p["x"] ** 2).sum()

        solve(Problem(loss, [Parameter("x", [4.0])]), "adam", **({"budget": 30, "lr": 0.1} | options))
        return [a - b for a, b in zip(path, path[1:], strict=False)]

    # Adam's first step is lr whatever the gradient; a cosine ends near 0, a constant rate does not.
    assert steps()[0] == pytest.approx(0.1, rel=1e-6)
    assert abs(steps()[-1]) < 0.02 and abs(steps(schedule="constant")[-1]) > 0.09
    assert steps(clip_norm=1e-3)[0] == pytest.approx(0.1, rel=1e-4)
    early = solve(quadratic(), "adam", budget=30_000, tolerance=1e-3, schedule="constant", lr=0.1, patience=20)
    assert early.status is Status.CONVERGED and early.evaluations < 1000 and early.loss < 1e-3
