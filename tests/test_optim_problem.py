import math
import re
import subprocess
import sys

import pytest
import torch

from difflpv.optim import SOLVERS, solve
from difflpv.optim.nlopt_solver import NLOPT_ALGORITHMS
from difflpv.optim.problem import Problem
from difflpv.optim.result import Status
from difflpv.parameters import Parameter

F64 = torch.float64


def two():
    """Two parameters, loss a^2 + sum(b^3)."""
    parameters = [Parameter("a", 0.5, 0, 1), Parameter("b", [[1.0, 2.0]], 0.0)]
    return Problem(lambda p: p["a"] ** 2 + (p["b"] ** 3).sum(), parameters, backward_cost=2.5)


def test_pack_and_unpack_are_inverse():
    problem = two()
    x = torch.tensor([1.0, 2.0, 3.0], dtype=F64)
    values = problem.unpack(x)
    assert values["a"].shape == () and values["b"].tolist() == [[2.0, 3.0]]
    assert problem.pack(values).tolist() == x.tolist()
    assert problem.names == ("a", "b") and problem.size == 3
    assert problem.initial.tolist() == [0.5, 1.0, 2.0]
    assert problem.lower.tolist() == [0, 0, 0] and problem.upper.tolist() == [1, math.inf, math.inf]


def test_value_and_gradient_in_both_spaces():
    problem = two()
    x = problem.initial
    loss, gradient = problem.value_and_grad(x)
    assert loss == problem.value(x) == 0.25 + 1 + 8
    assert gradient.tolist() == [1.0, 3.0, 12.0]
    raw = problem.to_raw(x)
    torch.testing.assert_close(problem.to_physical(raw), x)
    loss, gradient = problem.value_and_grad(raw, space="raw")
    assert loss == pytest.approx(9.25)
    step = 1e-6
    for k in range(3):
        shift = step * torch.eye(3, dtype=F64)[k]
        low, high = (problem.value(raw + s, space="raw") for s in (-shift, shift))
        assert (high - low) / (2 * step) == pytest.approx(float(gradient[k]), rel=1e-8)


def test_cost_is_counted_in_forward_equivalents():
    problem = two()
    problem.value(problem.initial)
    problem.value_and_grad(problem.initial)
    problem.value_and_grad(problem.initial)
    assert (problem.value_count, problem.gradient_count) == (3, 2)
    assert problem.forward_equivalents == 3 + 2 * 2.5


def test_float32_loss_gives_a_float64_gradient():
    problem = Problem(lambda p: (p["a"].float() ** 2).sum(), [Parameter("a", [0.25, 0.5])])
    loss, gradient = problem.value_and_grad(problem.initial)
    assert isinstance(loss, float) and gradient.dtype == F64 and gradient.tolist() == [0.5, 1.0]


def test_blame_finds_the_parameter_in_a_product():
    # Both gradients are NaN at the bad point; only putting them back one at a time tells which one did it.
    problem = Problem(lambda p: p["a"] * torch.sqrt(1 - p["b"]), [Parameter("a", 1.0), Parameter("b", 0.5)])
    good, bad = torch.tensor([1.0, 0.5], dtype=F64), torch.tensor([2.0, 1.5], dtype=F64)
    _, gradient = problem.value_and_grad(bad)
    assert gradient.isnan().all()
    assert problem.blame(bad, gradient, good) == ["b"]
    assert problem.blame(torch.tensor([math.nan, 0.5], dtype=F64), None, None) == ["a"]


def test_bad_problems():
    parameter = Parameter("a", 0.5)
    with pytest.raises(ValueError, match="parameters: expected at least one, each of its own name"):
        Problem(lambda p: p["a"], [])
    with pytest.raises(ValueError, match=re.escape("each of its own name, got ['a', 'a']")):
        Problem(lambda p: p["a"], [parameter, parameter])
    with pytest.raises(TypeError, match="parameters: expected Parameter objects, got str"):
        Problem(lambda p: p["a"], ["a"])
    with pytest.raises(ValueError, match="backward_cost"):
        Problem(lambda p: p["a"], [parameter], backward_cost=-1)
    problem = Problem(lambda p: p["a"], [parameter])
    with pytest.raises(ValueError, match=re.escape("x: expected shape [1], got [2]")):
        problem.unpack(torch.zeros(2, dtype=F64))
    with pytest.raises(ValueError, match=re.escape("values: expected the names ['a'], got ['b']")):
        problem.pack({"b": torch.zeros(())})
    with pytest.raises(ValueError, match=re.escape("values 'a': expected shape [], got [2]")):
        problem.pack({"a": torch.zeros(2)})
    with pytest.raises(TypeError, match=re.escape("loss: expected a scalar tensor, got [2]")):
        Problem(lambda p: torch.zeros(2), [parameter]).value(problem.initial)
    with pytest.raises(TypeError, match="loss: expected a scalar tensor, got float"):
        Problem(lambda p: 1.0, [parameter]).value(problem.initial)
    with pytest.raises(ValueError, match="loss: expected a tensor that depends on the parameters"):
        Problem(lambda p: torch.ones(()), [parameter]).value_and_grad(problem.initial)
    with pytest.raises(ValueError, match="made with residual"):
        problem.residual_at(problem.initial)


def test_registry_names_and_their_error():
    assert set(NLOPT_ALGORITHMS) == {name for name in SOLVERS if name.startswith("nlopt-")}
    with pytest.raises(ValueError, match="solver: expected one of adam, lbfgs, nnls, nlopt-bobyqa.*, got 'sgd'"):
        solve(two(), "sgd", budget=1)


@pytest.mark.parametrize("solver", [name for name in SOLVERS if name != "nnls"])
def test_bad_shared_options(solver):
    with pytest.raises(ValueError, match=r"budget: expected at least [\d.]+ forward-equivalents for .*, got 0"):
        solve(two(), solver, budget=0) if solver != "nlopt-crs2" else solve(box(), solver, budget=0)
    with pytest.raises(ValueError, match="seconds: expected a positive number or None, got 0"):
        solve(box(), solver, budget=100, seconds=0)
    with pytest.raises(ValueError, match="tolerance: expected a finite number >= 0, got -1"):
        solve(box(), solver, budget=100, tolerance=-1)
    with pytest.raises(TypeError, match="problem: expected a Problem, got str"):
        solve("problem", solver, budget=100)


def box():
    return Problem(lambda p: (p["x"] ** 2).sum(), [Parameter("x", [0.5, 0.25], -1, 1)])


@pytest.mark.parametrize(
    ("solver", "options", "message"),
    [
        ("adam", dict(lr=0), "lr: expected a positive number, got 0"),
        ("adam", dict(schedule="step"), "schedule: expected 'cosine' or 'constant', got 'step'"),
        ("adam", dict(clip_norm=0), "clip_norm: expected a positive number or None, got 0"),
        ("adam", dict(schedule_steps=0), "schedule_steps: expected at least 1, got 0"),
        ("adam", dict(budget=math.inf), "schedule_steps: expected a number of steps for a cosine without a budget"),
        ("lbfgs", dict(lr=0), "lr: expected a positive number, got 0"),
        ("lbfgs", dict(memory=0), "memory, patience: expected at least 1, got 0, 2"),
        ("nlopt-bobyqa", dict(initial_step=0.9), "initial_step: expected a share"),
        ("nlopt-crs2", dict(population=2), "population: expected more than 2 points, got 2"),
        ("cma", dict(initial_step=0.0), r"initial_step: expected a share in \(0, 0.5\], got 0"),
        ("cma", dict(population=1), "population: expected at least 2 points, got 1"),
        ("nnls", {}, "problem: expected one made with residual"),
    ],
)
def test_bad_options_of_one_solver(solver, options, message):
    with pytest.raises(ValueError, match=message):
        solve(box(), solver, **({"budget": 100} | options))


def test_crs2_needs_finite_bounds():
    with pytest.raises(ValueError, match=r"nlopt-crs2: parameter 'b': expected finite bounds, got \[0, inf\]"):
        solve(two(), "nlopt-crs2", budget=100)


def test_every_status_has_advice():
    assert all(len(status.advice) > 20 for status in Status)


def test_naming_the_solvers_loads_neither_torch_nor_warp():
    code = "import sys, difflpv, difflpv.optim; assert not {'torch', 'warp', 'scipy', 'nlopt'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_cma_that_is_not_installed_says_how(monkeypatch):
    monkeypatch.setitem(sys.modules, "cma", None)
    with pytest.raises(ValueError, match=r"'cma' needs the optional package cma: pip install 'difflpv\[cma\]'"):
        solve(two(), "cma", budget=100)
