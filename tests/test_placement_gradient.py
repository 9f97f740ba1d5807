"""Placement by gradients: the error that is differentiated, moves that stay free, relocation, tolerance, resuming."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from placement_tasks import HIGH, LIGHT, LOW, WALL, analytic_task

from difflpv.optim.checkpoint import CheckpointError
from difflpv.placement.descent import Descent, Probes
from difflpv.placement.free_moves import FreeMoves
from difflpv.placement.penalties import Penalties
from difflpv.placement.place import place
from difflpv.placement.population import removal_damage, with_spawned, without_least
from difflpv.placement.reconstruction import Reconstruction, irradiance_coordinates, reconstruction_error
from difflpv.placement.uniform import place_grid
from difflpv.placement.unseen import Unseen
from difflpv.probes.gaussian import isotropic_metric
from difflpv.probes.lattice import LatticeField
from difflpv.probes.probe_set import DIRECTIONS_26, irradiance_of
from difflpv.probes.visible import Sight

QUICK = {"steps": 16, "relocations": 1}


@pytest.fixture(scope="module")
def task():
    return analytic_task(ambient=0.05, points=200)


def descent(task, interpolation="tetrahedra", *, content="fitted", neighbours=8, **penalties):
    return Descent(
        Reconstruction(task, content), Penalties(**penalties), FreeMoves(task), interpolation, neighbours=neighbours
    )


def some_probes(task, count=12, *, footprints=False, seed=1):
    random = np.random.default_rng(seed)
    position = random.permutation(task.points.numpy())[:count] + random.uniform(-0.01, 0.01, (count, 3))  # no kinks: off points
    return Probes(position, isotropic_metric(torch.as_tensor(position)).numpy() if footprints else None)


def test_irradiance_coordinates_keep_squares_over_the_26_normals():
    radiance = torch.randn(5, 9, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    squares = irradiance_of(radiance, DIRECTIONS_26).square().sum((1, 2))
    torch.testing.assert_close(irradiance_coordinates(radiance).square().sum((1, 2)), squares, rtol=1e-12, atol=0)


@pytest.mark.parametrize("content", ["field", "fitted"])
def test_principal_channels_change_the_error_by_no_more_than_what_they_leave_out(task, content):
    position = torch.as_tensor(some_probes(task).position)
    whole = float(reconstruction_error(task, position, content=content, ridge=0.02))
    for kept in (1.0, 1 - 1e-9, 0.999):
        part = Reconstruction(task, content, ridge=0.02, kept=kept)
        rows = descent(task).reader(position, None).rows(position, task.points)
        # the energy left out is error in the worst case: |whole^2 - part^2| <= what probes read there, of both
        assert float(part.error(position, rows)) == pytest.approx(whole, abs=1e-10 + 2 * (1 - kept) ** 0.5)


@pytest.mark.parametrize("interpolation", ["tetrahedra", "gaussian"])
@pytest.mark.parametrize("content", ["field", "fitted"])
def test_gradient_against_finite_differences(task, interpolation, content):
    down = descent(task, interpolation, content=content, barrier=0.1, margin=0.3, leak=0.2, coverage=0.3, reach=0.4)
    probes = some_probes(task, footprints=interpolation == "gaussian")
    eyes = Sight(task.scene)

    def total(position, metric):
        rows = down.reader(position, metric).rows(position, task.points)
        return down.reconstruction.error(position, rows) + down.penalties.total(task, position, rows, eyes)

    position = torch.tensor(probes.position, requires_grad=True)
    metric = None if probes.metric is None else torch.tensor(probes.metric, requires_grad=True)
    total(position, metric).backward()
    random = torch.Generator().manual_seed(3)
    for tensor in (position, metric):
        if tensor is None:
            continue
        way = torch.randn(tensor.shape, generator=random, dtype=torch.float64)
        step = 1e-6 * way
        moved = [[t if t is not tensor else (t + sign * step) for t in (position, metric)] for sign in (1, -1)]
        with torch.no_grad():
            slope = (total(*moved[0]) - total(*moved[1])) / 2e-6
        assert float((tensor.grad * way).sum()) == pytest.approx(float(slope), rel=2e-4, abs=1e-7)


def test_moves_never_cross_a_wall_nor_leave_a_region(task):
    random = np.random.default_rng(0)
    old = some_probes(task, 40).position
    moves = FreeMoves(task)
    new, stay = moves.moved(old, old + random.normal(0, 1.0, old.shape))
    assert ((old[:, 0] < WALL) == (new[:, 0] < WALL)).all()
    assert np.array_equal(new[stay], old[stay]) and not stay.all() and (np.linalg.norm(new - old, axis=1)[~stay] > 0).all()
    assert ((new >= LOW) & (new <= HIGH)).all()
    corner = FreeMoves(task, [((-1.9, -0.9, -0.9), (-1.0, 0.9, 0.9))])
    inside = np.array([[-1.5, 0.0, 0.0]])
    np.testing.assert_allclose(corner.moved(inside, np.array([[-0.4, 0.2, 0.0]]))[0], [[-1.0, 0.2, 0.0]])
    with pytest.raises(ValueError, match="region: expected a lower and a higher corner"):
        FreeMoves(task, [((0, 0, 0), (0, 1, 1))])


def test_a_region_between_the_probes_of_every_grid_gets_probes(task):
    low, high = task.points[7].numpy() - 0.02, task.points[7].numpy() + 0.02
    placement = place(task, 3, "gradient", regions=[(low, high)], **QUICK)
    assert len(placement) >= 1 and ((placement.position >= low) & (placement.position <= high)).all()
    with pytest.raises(ValueError, match="no probe lies in free space"):
        place(task, 3, "gradient", regions=[((7, 7, 7), (8, 8, 8))], **QUICK)


def test_a_probe_that_no_point_sees_counts_as_inside_a_solid():
    task = analytic_task(block=True)
    position = np.array([[1.1, -0.15, -0.1], [-1.0, 0.0, 0.0]])
    assert task.seen(position).tolist() == [False, True]
    missed = replace(task, clearance=LatticeField(task.clearance.grid, torch.ones_like(task.clearance.values)))
    assert missed.in_free_space(position).tolist() == [False, True]  # a lattice too coarse for the block
    assert (missed.clearance(torch.as_tensor(position)) > 0).all()


def test_each_penalty_falls_where_it_is_obeyed(task):
    down = descent(task)
    eyes = Sight(task.scene)

    def term(position, **weights):
        position = torch.tensor(position, dtype=torch.float64)
        return float(Penalties(**{"barrier": 0.0} | weights).total(
            task, position, down.reader(position, None).rows(position, task.points), eyes
        ))  # fmt: skip

    middle, by_wall = [[-1.0, 0.0, 0.0]], [[-1.0, 0.0, 0.98]]
    assert term(middle, barrier=1.0, margin=0.1) == 0 < term(by_wall, barrier=1.0, margin=0.1)
    both = [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    assert term(middle, coverage=1.0, reach=1.0) > 2 * term(both, coverage=1.0, reach=1.0)
    assert term(middle, leak=1.0) == pytest.approx(float((task.points[:, 0] > WALL).double().mean()), abs=0.05)
    with pytest.raises(ValueError, match="coverage: expected a reach"):
        Penalties(coverage=1.0)


@pytest.mark.parametrize("interpolation", ["tetrahedra", "gaussian"])
def test_descent_beats_its_start_and_the_grid_on_other_points(interpolation):
    unseen = Unseen.of(analytic_task(ambient=0.05, points=600))  # of one light, of which none can be held out
    train, judge = unseen.train, unseen.judge
    placements = [
        place(train, 24, "gradient", interpolation=interpolation, steps=60, relocations=1, seed=seed) for seed in range(3)
    ]
    for placement in placements:
        assert placement.details["training_error"] < 0.7 * placement.history[0][1]
    grid = place_grid(train, 24)

    def error(placed):
        position = torch.as_tensor(placed.position)
        with torch.no_grad():
            rows = placed.reader.over(placed.position, judge.scene).rows(position, judge.points)
            held = train.field(position) if placed.radiance is None else torch.as_tensor(placed.radiance)
            wrong = irradiance_coordinates(rows.apply(held)) - irradiance_coordinates(judge.radiance)
        return float(wrong.norm() / irradiance_coordinates(judge.radiance).norm())

    assert np.mean([error(placement) for placement in placements]) < 0.7 * error(grid)


def test_removal_damage_is_exact_where_content_stays(task):
    probes = some_probes(task, 6, footprints=True)
    down = descent(task, "gaussian", content="field", neighbours=6)
    damage = removal_damage(down, probes)
    rows, held, _ = down.read(probes)
    truth = down.reconstruction.truth
    for gone in range(6):
        weight = rows.dense(6).clone()
        weight[:, gone] = 0
        weight /= weight.sum(1, keepdim=True)
        squares = [((w @ held - truth) ** 2).sum() / (truth**2).sum() for w in (weight, rows.dense(6))]
        assert damage[gone] == pytest.approx(float(squares[0] - squares[1]), rel=1e-6, abs=1e-9)


def test_relocation_takes_a_redundant_probe_to_where_the_error_is(task):
    right = np.array([[x, y, z] for x in (0.5, 1.0, 1.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    probes = Probes(np.concatenate([[[-1.5, -0.5, -0.5]], right]))
    down = descent(task, content="field")  # the right room is dark: its twelve probes do the work of one
    fewer = without_least(down, probes, 2)
    assert len(fewer) == 11 and (fewer.position[:, 0] < WALL).sum() == 1
    more = with_spawned(down, fewer, 2)
    assert len(more) == 13
    assert np.linalg.norm(more.position[11] - LIGHT) < 0.8 and (more.position[11:, 0] < WALL).all()


def test_no_probe_is_spawned_where_one_stands(task):
    """Most error is where the field that they hold is far from the truth: more of them there would take none of it away."""
    bright = task.radiance.clone()
    bright[7] *= 1000
    down = descent(replace(task, radiance=bright), content="field")
    probes = Probes(task.points.numpy()[:1])
    for _ in range(3):
        probes = with_spawned(down, probes, 1)
    assert len(np.unique(probes.position, axis=0)) == len(probes) == 4


def test_interrupted_work_keeps_the_best_and_goes_on_to_the_same_bits(task, tmp_path, monkeypatch):
    whole = place(task, 10, "gradient", interpolation="gaussian", **QUICK)
    run, calls = Descent.run, []

    def interrupted(self, *args, **kwargs):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return run(self, *args, **kwargs)

    options = {"interpolation": "gaussian", "checkpoint": tmp_path / "checkpoint.pt"} | QUICK
    monkeypatch.setattr(Descent, "run", interrupted)
    part = place(task, 10, "gradient", **options)
    assert part.details["interrupted"] and len(part) == 10
    assert part.details["training_error"] < whole.history[0][1]
    resumed = place(task, 10, "gradient", **options)
    assert not resumed.details["interrupted"] and len(calls) == 4  # one done, one broken off, that one and the last anew
    assert np.array_equal(resumed.position, whole.position) and np.array_equal(resumed.reader.metric, whole.reader.metric)
    assert resumed.evaluations == whole.evaluations  # of all runs together
    with pytest.raises(CheckpointError, match="seed"):
        place(task, 10, "gradient", seed=1, **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 0}, "expected steps >= 1"),
        ({"tolerance": 2.0}, "relative error between 0 and 1"),
        ({"confidence": 0.2}, "confidence: expected a number in"),
        ({"clearance": 0.0}, "probe clearance: expected a length > 0 m, got 0.0"),
        ({"interpolation": "cubic"}, "interpolation: expected tetrahedra or gaussian"),
        ({"content": "guess"}, "content: expected field or fitted"),
        ({"leak": -1.0}, "penalty leak"),
        ({"neighbours": 0, "interpolation": "gaussian"}, "neighbours: expected a number > 0"),
    ],
)
def test_bad_options_are_refused_in_one_line(task, options, message):
    with pytest.raises(ValueError, match=message) as error:
        place(task, 5, "gradient", **QUICK | options)
    assert "\n" not in str(error.value)
