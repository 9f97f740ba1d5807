"""How runs end and go on: budget, time, Ctrl-C, NaN, checkpoints, and NLopt's own failures."""

import math
import time

import pytest
import torch

from difflpv.optim import SOLVERS, solve
from difflpv.optim.checkpoint import CheckpointError
from difflpv.optim.problem import Problem
from difflpv.optim.result import Status
from difflpv.parameters import Parameter

F64 = torch.float64
DESCENT = [name for name in SOLVERS if name != "nnls"]
WITH_GRADIENT = ["adam", "lbfgs", "nlopt-mma", "nlopt-lbfgs"]
WITHOUT_GRADIENT = [name for name in DESCENT if name not in WITH_GRADIENT]


class Loss:
    """Rosenbrock's valley that does something else at its k-th evaluation."""

    def __init__(self, at=None, act=None, generator=None):
        self.calls, self.at, self.act, self.generator = 0, at, act, generator

    def __call__(self, p):
        self.calls += 1
        x, y = p["x"], p["y"]
        loss = 100 * (y - x**2).square().sum() + (1 - x).square().sum()
        if self.generator is not None:
            loss = loss + 0.1 * torch.rand((), generator=self.generator, dtype=F64) * x.sum()
        return self.act(loss) if self.calls == self.at else loss


def interrupt(loss):
    raise KeyboardInterrupt


def make(at=None, act=None, *, draws=False, **changes):
    generator = torch.Generator() if draws else None
    x = {"initial": [-0.5, 0.4], "lower": -2, "upper": 2} | changes
    parameters = [Parameter("x", **x), Parameter("y", [0.5, 0.6], -2, 2)]
    return Problem(Loss(at, act, generator), parameters, backward_cost=1.5, generator=generator)


def trace(result):
    return [(point.forward_equivalents, point.loss) for point in result.history]


@pytest.mark.parametrize("solver", DESCENT)
@pytest.mark.parametrize("budget", [2.5, 20, 44.9])
def test_budget_is_exact(solver, budget):
    problem = make()
    result = solve(problem, solver, budget=budget, tolerance=0)
    cost = 2.5 if solver in WITH_GRADIENT else 1.0
    assert result.status is Status.BUDGET and "budget" in result.message
    assert result.evaluations == problem.value_count == math.floor(budget / cost)
    assert result.forward_equivalents == problem.forward_equivalents == cost * result.evaluations
    assert [point.forward_equivalents for point in result.history] == [
        cost * (k + 1) for k in range(result.evaluations)
    ]
    assert result.loss == min(point.loss for point in result.history)


@pytest.mark.parametrize("solver", DESCENT)
def test_time_limit(solver):
    def slow(p):
        time.sleep(0.02)
        return (p["x"] ** 2).sum()

    problem = Problem(slow, [Parameter("x", [0.5, 0.4], -1, 1)])
    result = solve(problem, solver, budget=1e4, seconds=0.03, tolerance=0, **adam_steps(solver))
    assert result.status is Status.TIME_LIMIT and 1 <= result.evaluations <= 4
    assert math.isfinite(result.loss)


def adam_steps(solver):
    return {"schedule_steps": 100} if solver == "adam" else {}


@pytest.mark.parametrize("solver", DESCENT)
def test_ctrl_c_returns_and_saves_the_best_so_far(solver, tmp_path):
    path = tmp_path / "run.pt"
    result = solve(make(13, interrupt), solver, budget=100, tolerance=0, checkpoint=path)
    assert result.status is Status.INTERRUPTED and "same checkpoint" in result.message
    assert result.evaluations == 12 and result.loss == min(point.loss for point in result.history)
    saved = torch.load(path, weights_only=True)["content"]
    assert saved["best_loss"] == result.loss and saved["best"].tolist() == make().pack(result.parameters).tolist()
    resumed = solve(make(), solver, budget=100, tolerance=0, checkpoint=path)
    assert resumed.loss <= result.loss and resumed.status is Status.BUDGET
    done = len(saved["history"])
    assert trace(resumed)[:done] == trace(result)[:done]
    assert resumed.forward_equivalents <= 100


@pytest.mark.parametrize("solver", ["adam", "lbfgs"])
@pytest.mark.parametrize("at", [1, 2, 7, 19])
@pytest.mark.parametrize("draws", [False, True])
def test_resumed_run_equals_an_uninterrupted_one_bit_for_bit(solver, at, draws, tmp_path):
    whole = solve(make(draws=draws), solver, budget=90, seed=3)
    path = tmp_path / "run.pt"
    part = solve(make(at, interrupt, draws=draws), solver, budget=90, seed=3, checkpoint=path)
    assert part.status is Status.INTERRUPTED
    resumed = solve(make(draws=draws), solver, budget=90, seed=3, checkpoint=path)
    assert trace(resumed) == trace(whole)
    assert resumed.loss == whole.loss and resumed.status == whole.status
    for name, value in whole.parameters.items():
        assert torch.equal(resumed.parameters[name], value)
    seconds = [point.seconds for point in resumed.history]
    assert seconds == sorted(seconds)


def test_lbfgs_resumed_after_every_budget(tmp_path):
    whole = solve(make(), "lbfgs", budget=150)
    path = tmp_path / "run.pt"
    for budget in (5, 22, 60, 61, 97, 150):
        result = solve(make(), "lbfgs", budget=budget, checkpoint=path)
    assert trace(result) == trace(whole) and result.loss == whole.loss


def test_adam_with_a_constant_rate_can_be_extended_and_a_cosine_says_why_not(tmp_path):
    whole = solve(make(), "adam", budget=100, schedule="constant")
    solve(make(), "adam", budget=40, schedule="constant", checkpoint=tmp_path / "a.pt")
    assert trace(solve(make(), "adam", budget=100, schedule="constant", checkpoint=tmp_path / "a.pt")) == trace(whole)
    solve(make(), "adam", budget=40, checkpoint=tmp_path / "b.pt")
    with pytest.raises(CheckpointError, match="schedule_steps is 16 there and 40 here"):
        solve(make(), "adam", budget=100, checkpoint=tmp_path / "b.pt")
    solve(make(), "adam", budget=40, schedule_steps=40, checkpoint=tmp_path / "c.pt")
    cosine = solve(make(), "adam", budget=100, schedule_steps=40, checkpoint=tmp_path / "c.pt")
    assert trace(cosine) == trace(solve(make(), "adam", budget=100))


@pytest.mark.parametrize("solver", DESCENT)
def test_another_error_is_passed_on_after_a_save(solver, tmp_path):
    def fail(loss):
        raise RuntimeError("out of memory")

    path = tmp_path / "run.pt"
    with pytest.raises(RuntimeError, match="out of memory"):
        solve(make(8, fail), solver, budget=100, checkpoint=path)
    assert math.isfinite(torch.load(path, weights_only=True)["content"]["best_loss"])


@pytest.mark.parametrize("solver", DESCENT)
def test_finished_run_is_not_repeated(solver, tmp_path):
    def quadratic():
        return Problem(lambda p: ((p["x"] - 0.1) ** 2).sum(), [Parameter("x", [0.5, 0.4], -1, 1)])

    options = {"budget": 6000, "tolerance": 1e-4, "checkpoint": tmp_path / "run.pt"}
    options |= {"patience": 5, "schedule": "constant"} if solver == "adam" else {}
    first = solve(quadratic(), solver, **options)
    assert first.status is Status.CONVERGED
    problem = quadratic()
    again = solve(problem, solver, **options)
    assert problem.value_count == 0 and again.message == first.message and trace(again) == trace(first)


def test_periodic_saves_survive_a_kill(tmp_path):
    path = tmp_path / "run.pt"
    seen = []

    def look(point):
        if path.exists():
            seen.append(len(torch.load(path, weights_only=True)["content"]["history"]))

    solve(make(), "adam", budget=25, checkpoint=path, checkpoint_seconds=0.0, callback=look)
    assert seen == list(range(0, 10))  # at the k-th evaluation the k steps before it are on the disk
    assert [file.name for file in tmp_path.iterdir()] == ["run.pt"]


def poison(loss):
    return loss * math.nan


@pytest.mark.parametrize("solver", WITH_GRADIENT)
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_gradient_solvers_stop_at_a_nan(solver, value, tmp_path):
    problem = make(6, lambda loss: loss * value)
    result = solve(problem, solver, budget=200, checkpoint=tmp_path / "run.pt")
    assert result.status is Status.NON_FINITE and result.evaluations == 6
    assert f"loss is {value} at step" in result.message
    assert math.isnan(result.history[-1].loss)
    assert result.loss == min(point.loss for point in result.history[:-1])
    assert all(v.isfinite().all() for v in result.parameters.values())


@pytest.mark.parametrize("solver", WITH_GRADIENT)
def test_the_message_names_parameter_and_step(solver):
    # x slides towards 0.7, from where on the square root is NaN; y has nothing to do with it.
    problem = Problem(
        lambda p: (p["x"] - 2) ** 2 * (1 + (p["y"] - 1) ** 2) + 0 * torch.sqrt(0.7 - p["x"]),
        [Parameter("x", 0.5, 0, 1), Parameter("y", 0.5, 0, 2)],
    )
    result = solve(problem, solver, budget=3000)
    assert result.status is Status.NON_FINITE
    assert "because of parameter 'x' = " in result.message and "'y'" not in result.message
    assert float(result.parameters["x"]) <= 0.7
    if solver == "adam":
        assert f"at step {result.evaluations - 1}," in result.message


def test_a_gradient_that_is_not_finite_stops_too():
    parameters = [Parameter("x", 0.5, 0, 1), Parameter("y", 1.0)]
    problem = Problem(lambda p: (p["x"] - 0.5).abs().sqrt() + p["y"] ** 2, parameters)
    result = solve(problem, "adam", budget=30)
    assert result.status is Status.NON_FINITE
    assert "gradient is not finite at step 0, because of parameter 'x' = 0.5" in result.message


@pytest.mark.parametrize("solver", WITHOUT_GRADIENT)
def test_derivative_free_solvers_avoid_what_is_not_finite(solver):
    # log(x) is NaN on the left half; the optimum lies close to that border.
    def loss(p):
        return (torch.log(p["x"]) - math.log(0.2)).square() + (p["y"] - 0.3) ** 2

    problem = Problem(loss, [Parameter("x", 0.5, -1, 1), Parameter("y", 0.8, 0, 1)])
    result = solve(problem, solver, budget=1500, initial_step=0.4)
    assert result.status in (Status.CONVERGED, Status.ROUNDOFF_LIMITED, Status.BUDGET)
    bad = sum(math.isnan(point.loss) for point in result.history)
    if bad and result.status is not Status.BUDGET:
        assert f"{bad} of {result.evaluations} evaluations were not finite" in result.message
    assert math.isfinite(result.loss) and float(result.parameters["x"]) > 0
    if solver != "nlopt-bobyqa":  # a quadratic model through a cliff may end early, but at a point it really saw
        assert bad > 0 and result.loss < 1e-2


@pytest.mark.parametrize("solver", WITHOUT_GRADIENT)
def test_a_bad_start_is_refused(solver):
    result = solve(make(1, poison), solver, budget=50)
    assert result.status is Status.NON_FINITE and result.evaluations == 1 and result.loss == math.inf
    assert "loss is nan at step 0, at 'x' = [-0.5, 0.4], 'y'" in result.message
    assert result.parameters["x"].tolist() == [-0.5, 0.4]


@pytest.mark.parametrize("solver", ["nlopt-bobyqa", "nlopt-cobyla"])
def test_roundoff_limited_ends_in_a_status(solver):
    # Steps of 1e-3 hide all progress of a search without tolerance.
    def steps(p):
        return torch.round(((p["x"] - 0.3) ** 2).sum() * 1e3) / 1e3

    result = solve(Problem(steps, [Parameter("x", [0.6, 0.9, 0.1], 0, 1)]), solver, budget=3000, tolerance=0)
    assert result.status is Status.ROUNDOFF_LIMITED and result.evaluations < 3000
    assert result.loss <= 0.01 and "rounding" in result.message


def test_nlopt_giving_up_ends_in_a_status():
    def kink(p):
        return (p["x"] - 0.3).abs().sum()

    result = solve(Problem(kink, [Parameter("x", [0.6, 0.9, 0.1], 0, 1)]), "nlopt-lbfgs", budget=2000, tolerance=0)
    assert result.status in (Status.FAILED, Status.CONVERGED) and result.loss < 1.1


def test_damaged_and_foreign_checkpoints_are_refused(tmp_path):
    path = tmp_path / "run.pt"
    path.write_bytes(b"not a checkpoint")
    with pytest.raises(CheckpointError, match=r"run.pt: cannot be read \(.*\); delete it"):
        solve(make(), "adam", budget=30, checkpoint=path)
    torch.save({"weights": torch.zeros(3)}, path)
    with pytest.raises(CheckpointError, match="expected format difflpv-fit-1, got another file"):
        solve(make(), "adam", budget=30, checkpoint=path)


@pytest.mark.parametrize(
    ("changes", "options", "message"),
    [
        ({"upper": 3}, {}, r"bounds of 'x' is \[\[-2.0, -2.0\], \[2.0, 2.0\]\] there and .* here"),
        ({"initial": [0.5, 0.6]}, {}, "initial value of 'x'"),
        ({"initial": [0.5]}, {}, "shape of 'x'|initial value"),
        ({}, {"lr": 0.01}, "lr is 0.05 there and 0.01 here; choose another path or delete it$"),
        ({}, {"seed": 1}, "seed is 0 there and 1 here"),
        ({}, {"tolerance": 1e-3}, "tolerance is"),
    ],
)
def test_checkpoint_of_another_fit_is_refused(changes, options, message, tmp_path):
    path = tmp_path / "run.pt"
    solve(make(), "adam", budget=30, checkpoint=path)
    before = path.read_bytes()
    if changes.get("initial") == [0.5]:
        parameters = [Parameter("x", [0.5], -2, 2), Parameter("y", [0.5, 0.6], -2, 2)]
        problem = Problem(Loss(), parameters, backward_cost=1.5)
    else:
        problem = make(**changes)
    with pytest.raises(CheckpointError, match=message) as raised:
        solve(problem, "adam", budget=30, checkpoint=path, **options)
    assert "\n" not in str(raised.value) and path.read_bytes() == before


def test_checkpoint_of_another_solver_or_label_is_refused(tmp_path):
    path = tmp_path / "run.pt"
    solve(make(), "nlopt-bobyqa", budget=30, checkpoint=path)
    with pytest.raises(CheckpointError, match="solver is 'nlopt-bobyqa' there and 'nlopt-sbplx' here"):
        solve(make(), "nlopt-sbplx", budget=30, checkpoint=path)
    problem = make()
    problem.label = "another scene"
    with pytest.raises(CheckpointError, match="label is '' there and 'another scene' here"):
        solve(problem, "nlopt-bobyqa", budget=30, checkpoint=path)


def test_callback_sees_every_evaluation_and_may_interrupt():
    for solver in DESCENT:
        seen = []

        def watch(point, seen=seen):
            seen.append(point)
            if len(seen) == 9:
                raise KeyboardInterrupt

        result = solve(make(), solver, budget=100, tolerance=0, callback=watch)
        assert result.status is Status.INTERRUPTED and tuple(seen) == result.history


def valley(p):
    """With a plateau around it."""
    return (1 - torch.exp(-(p["x"] ** 2))).sum()


def bowl(p):
    """Steeper and steeper."""
    return (p["x"] ** 4).sum()


@pytest.mark.parametrize(
    ("loss", "rate", "word"),
    [(valley, 0.1, None), (valley, 30.0, "no step of 29"), (bowl, 0.1, None), (bowl, 30.0, "diverged from a loss of 1 to")],
)
def test_adam_says_when_its_step_size_loses_the_valley(loss, rate, word):
    result = solve(Problem(loss, [Parameter("x", [1.0])]), "adam", budget=90, lr=rate, schedule="constant")
    assert ("lower the step size (adam: " in result.message) is (word is not None)
    assert word is None or f"adam: {word}" in result.message
    assert result.loss <= result.history[0].loss
