import math
import re

import numpy as np
import pytest
import scipy.optimize
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from difflpv.optim import solve
from difflpv.optim.nnls import nonnegative_least_squares
from difflpv.optim.problem import Problem
from difflpv.optim.result import Status
from difflpv.parameters import Parameter

F64 = torch.float64


def system(seed, rows=30, columns=4):
    generator = torch.Generator().manual_seed(seed)
    a = torch.rand(rows, columns, generator=generator, dtype=F64)
    b = torch.randn(rows, generator=generator, dtype=F64)
    w = torch.rand(rows, generator=generator, dtype=F64)
    return a, b, w


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 10_000))
def test_against_scipy_and_the_optimality_conditions(seed):
    a, b, w = system(seed)
    x = nonnegative_least_squares(a, b, w)
    root = w.sqrt().numpy()
    expected, _ = scipy.optimize.nnls(root[:, None] * a.numpy(), root * b.numpy())
    np.testing.assert_allclose(x.numpy(), expected, atol=1e-10)
    # Karush-Kuhn-Tucker: x >= 0, slope >= 0, and one of the two is 0.
    slope = a.T @ (w * (a @ x - b))
    assert (x >= 0).all() and (slope > -1e-10).all() and float((x * slope).abs().max()) < 1e-10


def test_columns_of_very_different_brightness_and_a_dark_one():
    a, _, _ = system(1)
    a = a * torch.tensor([1e-9, 1.0, 1e6, 0.0], dtype=F64)
    truth = torch.tensor([3e9, 2.0, 0.0, 5.0], dtype=F64)
    x = nonnegative_least_squares(a, a @ truth)
    torch.testing.assert_close(x[:2], truth[:2], rtol=1e-6, atol=0)
    assert abs(float(x[2])) < 1e-12 and float(x[3]) == 0


def test_fewer_receivers_than_lights():
    a, _, _ = system(2, rows=2, columns=4)
    b = a @ torch.ones(4, dtype=F64)
    assert float((a @ nonnegative_least_squares(a, b) - b).norm()) < 1e-12


def test_bad_matrices():
    a, b, w = system(3)
    with pytest.raises(ValueError, match=re.escape("response: expected shape [m, k]")):
        nonnegative_least_squares(b, b)
    with pytest.raises(ValueError, match=re.escape("target: expected shape [30], got [29]")):
        nonnegative_least_squares(a, b[:-1])
    with pytest.raises(ValueError, match=re.escape("weight: expected shape [30], got [29]")):
        nonnegative_least_squares(a, b, w[:-1])
    with pytest.raises(ValueError, match="response: expected finite values, got 120 that are not"):
        nonnegative_least_squares(a * math.nan, b)
    with pytest.raises(ValueError, match="weight: expected values >= 0"):
        nonnegative_least_squares(a, b, -w)


def linear(a, b, parameters):
    def residual(p):
        return a @ torch.cat([p[q.name].reshape(-1) for q in parameters]) - b

    return Problem(lambda p: residual(p).square().sum(), parameters, residual=residual)


def test_solver_recovers_lights_and_counts_its_cost():
    a, _, _ = system(4)
    truth = torch.tensor([1.0, 0.0, 2.0, 0.5], dtype=F64)
    parameters = [Parameter("panel", [0.5] * 3, 0.0), Parameter("lamp", 0.5, 0.0)]
    problem = linear(a, a @ truth, parameters)
    result = solve(problem, "nnls", budget=7)
    assert result.status is Status.CONVERGED and result.loss < 1e-25
    torch.testing.assert_close(problem.pack(result.parameters), truth, rtol=0, atol=1e-13)
    assert result.forward_equivalents == 7 == problem.forward_equivalents
    with pytest.raises(ValueError, match="budget: expected at least 7 forward-equivalents for nnls, got 6"):
        solve(linear(a, a @ truth, parameters), "nnls", budget=6)


@pytest.mark.parametrize("bounds", [(-1.0, 0.2), (0.0, 0.3), (-math.inf, math.inf), (-math.inf, 5.0), (0.25, math.inf)])
def test_other_bounds_against_scipy(bounds):
    a, b, _ = system(5)
    start = max(min(0.27, bounds[1] - 0.05), bounds[0] + 0.02)
    result = solve(linear(a, b, [Parameter("x", [start] * 4, *bounds)]), "nnls", budget=7)
    expected = scipy.optimize.lsq_linear(a.numpy(), b.numpy(), bounds=bounds, method="bvls", tol=1e-14).x
    np.testing.assert_allclose(result.parameters["x"].numpy(), expected, atol=1e-9)


def test_a_residual_that_is_not_affine_is_found_out():
    problem = Problem(
        lambda p: p["x"].square().sum(),
        [Parameter("x", [0.5], 0.0)],
        residual=lambda p: torch.stack([p["x"][0] ** 2 - 4, p["x"][0] - 4]),
    )
    result = solve(problem, "nnls", budget=10)
    assert result.status is Status.FAILED and "not affine" in result.message


def test_a_response_that_is_not_finite_is_named():
    problem = Problem(
        lambda p: p["x"], [Parameter("x", 0.5, 0.0)], residual=lambda p: torch.stack([1 / (1 - p["x"]), p["x"]])
    )
    result = solve(problem, "nnls", budget=10)
    assert result.status is Status.NON_FINITE and "'x' = 1.0" in result.message and result.loss == math.inf


def test_bounded_solution_on_its_bound_and_checkpoint(tmp_path):
    a, b, _ = system(6)
    path = tmp_path / "nnls.pt"
    first = solve(linear(a, b, [Parameter("x", [0.5] * 4, 0.0)]), "nnls", budget=7, checkpoint=path)
    problem = linear(a, b, [Parameter("x", [0.5] * 4, 0.0)])
    again = solve(problem, "nnls", budget=7, checkpoint=path)
    assert problem.forward_equivalents == 0  # a finished solve is not repeated
    assert again.loss == first.loss and torch.equal(again.parameters["x"], first.parameters["x"])
