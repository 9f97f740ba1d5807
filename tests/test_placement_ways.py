import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from placement_tasks import LIGHT, WALL, analytic_task, point_light

from difflpv.placement.contrast import Contrast, luminance
from difflpv.placement.greedy_removal import place_greedy_removal
from difflpv.placement.irradiance_ascent import place_irradiance_ascent
from difflpv.placement.place import PLACEMENT_METHODS, place
from difflpv.placement.reconstruction import reconstruction_error
from difflpv.placement.spawn_merge import place_spawn_merge
from difflpv.placement.uniform import MOVE_LIMIT, move_into_free_space, place_grid, uniform_grids
from difflpv.probes.probe_set import DIRECTIONS_26, irradiance_of
from difflpv.probes.tetrahedra import TetrahedralInterpolation
from difflpv.sh import sh_basis

QUICK = {name: {"budget": 30} for name in ("sbplx", "crs2", "bobyqa", "cma")} | {
    "greedy_removal": {"dense": 2.0},
    "gradient": {"steps": 16, "relocations": 1},
}


@pytest.fixture(scope="module")
def task():
    return analytic_task(block=True, ambient=0.05, points=150)


@pytest.mark.parametrize("method", PLACEMENT_METHODS)
def test_every_way_gives_free_distinct_positions_at_most_as_many_as_asked_for(method, task):
    if method == "cma":
        pytest.importorskip("cma")
    told = []
    options = QUICK.get(method, {})
    placement = place(task, 20, method, seed=3, progress=lambda *step: told.append(step), **options)
    again = place(task, 20, method, seed=3, **options)
    assert np.array_equal(placement.position, again.position)
    assert placement.method == method and 12 <= len(placement) <= 20
    assert task.in_free_space(placement.position).all()
    apart = np.linalg.norm(placement.position[:, None] - placement.position, axis=2)[np.triu_indices(len(placement), 1)]
    assert apart.min() > 1e-4
    assert placement.seconds > 0 and placement.evaluations > 0
    np.testing.assert_array_equal(np.array(placement.history), np.array(told))
    assert [step for step, _, _ in told] == list(range(len(told)))
    assert all(math.isnan(error) or error > 0 for _, error, _ in told)


@pytest.mark.parametrize("method", PLACEMENT_METHODS)
def test_points_without_light_are_refused(method):
    dark = analytic_task(points=20, radiance=lambda x: np.zeros((*x.shape[:-1], 9, 3)))
    with pytest.raises(ValueError, match=f"{method}: expected light at the task's points, got none"):
        place(dark, 4, method)


@pytest.mark.parametrize("method", ["sbplx", "crs2", "bobyqa", "cma"])
def test_a_solver_keeps_its_budget_and_never_ends_above_its_start(method, task):
    if method == "cma":
        pytest.importorskip("cma")
    placement = place(task, 8, method, budget=40)
    assert placement.evaluations <= 40
    assert placement.details["training_error"] <= placement.details["start_error"]


def test_a_solver_says_when_the_budget_ends_before_its_model(task):
    assert "40 evaluations" not in place(task, 8, "bobyqa", budget=80).details["limit"]
    assert "takes 49 for 24 coordinates" in place(task, 8, "bobyqa", budget=40).details["limit"]
    assert "random first population" in place(task, 8, "crs2", budget=40).details["limit"]


def test_grid_counts_what_lies_in_free_space_and_keeps_cubic_proportions():
    open_box = analytic_task(wall=False, ambient=1.0)
    (grid, *_), (low, high) = uniform_grids(open_box, 54), open_box.bounds
    (only,) = uniform_grids(open_box, 54, refinements=0)
    np.testing.assert_array_equal(only.position, grid.position)
    assert grid.shape == (6, 3, 3) and len(grid.position) == 54  # the box is twice as long as it is high
    np.testing.assert_allclose(grid.position.mean(0), (low + high) / 2)
    np.testing.assert_allclose(grid.position.max(0) - grid.position.min(0), (high - low) * (1 - 1 / np.array([6, 3, 3])))
    blocked = analytic_task(wall=False, block=True, ambient=1.0)
    kept = place_grid(blocked, 54)
    assert 50 <= len(kept) <= 54 and kept.details["dropped"] > 0


def test_grid_takes_the_spread_of_least_training_error(task):
    error = {s: place_grid(task, 27, spread=s).details["training_error"] for s in (1.0, 1.1, 1.2, 1.3)}
    best = place_grid(task, 27)
    assert best.details["training_error"] == min(error.values())
    again = reconstruction_error(task, torch.as_tensor(best.position))
    assert float(again) == pytest.approx(best.details["training_error"], rel=1e-12)


def test_probes_leave_solids_the_short_way_and_never_by_more_than_the_limit(task):
    inside = np.array([[0.7, 0.0, 0.0], [1.1, -0.1, -0.1], [-1.0, 0.0, 0.0]])
    limit = np.full(3, MOVE_LIMIT * 0.5)
    moved = move_into_free_space(task, inside, limit, margin=0.02)
    assert moved[0, 0] < 0.6 and abs(moved[0, 1:]).max() < 1e-12  # 0.1 m from the face at x = 0.6
    assert np.array_equal(moved[1:], inside[1:])  # too deep; and already free
    assert (np.abs(moved - inside) <= limit).all()


def test_contrast_functions_against_closed_forms():
    radiance = np.zeros((3, 9, 3))
    radiance[:, 0] = np.array([1.0, 2.0, 3.0])[:, None] * np.sqrt(4 * np.pi)  # uniform L = 1, 2, 3: E = pi L
    pair = np.array([[0, 1], [0, 2], [1, 1]])
    for kind in ("samples6", "samples26"):
        np.testing.assert_allclose(Contrast(kind, radiance).pairs(radiance, pair), [0.5, 1.0, 0.0])
    squares = np.array([1.0, 4.0, 9.0])
    np.testing.assert_allclose(Contrast("mse", radiance).pairs(radiance, pair), np.array([1.0, 4.0, 0.0]) / squares.mean())
    assert Contrast("samples6", radiance).groups(radiance, np.array([[0, 1, 2]]))[0] == pytest.approx(1.0)
    with pytest.raises(ValueError, match="contrast: expected samples6"):
        Contrast("fft", radiance)


def test_six_samples_miss_a_difference_that_26_see():
    # sqrt15 (xy): zero along every axis, largest along the edges of the cube
    radiance = np.zeros((2, 9, 3))
    radiance[:, 0] = 1.0
    radiance[1, 4] = 0.4
    pair = np.array([[0, 1]])
    assert Contrast("samples6", radiance).pairs(radiance, pair)[0] == pytest.approx(0.0, abs=1e-12)
    assert Contrast("samples26", radiance).pairs(radiance, pair)[0] > 0.05


def test_spawn_and_merge_refines_where_light_changes_and_thins_out_where_it_does_not(task):
    placement = place_spawn_merge(task, 60)
    assert placement.details["contrast_threshold"] > placement.details["merge_threshold"] > 0
    apart = np.linalg.norm(placement.position[:, None] - placement.position, axis=2)
    nearest = (apart + 9 * np.eye(len(apart))).min(1)
    assert nearest.min() >= placement.details["closest_m"] * (1 - 1e-9)
    near_light = np.linalg.norm(placement.position - LIGHT, axis=1) < 0.7
    assert nearest[near_light].mean() < 0.7 * nearest[placement.position[:, 0] > WALL].mean()


def test_spawn_and_merge_stops_when_nothing_changes():
    def uniform(x):
        return np.broadcast_to(np.eye(9)[0][:, None] * np.ones(3), (*x.shape[:-1], 9, 3)).copy()

    even = analytic_task(wall=False, radiance=uniform, points=50)
    placement = place_spawn_merge(even, 30)
    assert placement.details["stop"] == "no change" and len(placement) < 20  # nothing differs: all neighbours merge
    assert float(reconstruction_error(even, torch.as_tensor(placement.position))) < 1e-9


def test_gradient_of_a_point_light_leads_to_it():
    x = np.array([[-1.6, -0.5, 0.6]])
    Y = luminance(irradiance_of(point_light(x, wall=False), DIRECTIONS_26))[..., 0]
    gradient = (Y @ DIRECTIONS_26)[0]
    toward = (LIGHT - x)[0]
    assert gradient @ toward / np.linalg.norm(gradient) / np.linalg.norm(toward) > 0.999


def test_backtracking_keeps_probes_on_their_side_of_surfaces():
    def lit_wall(x):
        toward = np.array([1.0, 0.0, 0.0])
        strength = np.exp(x[..., :1]) * (x[..., :1] < WALL)
        return (sh_basis(toward[None], 2)[0] * strength)[..., None] * np.ones(3)

    task = analytic_task(radiance=lit_wall, points=50)
    options = {"until": "converged", "max_iterations": 40}
    free = place_irradiance_ascent(task, 20, backtrack=False, **options)
    kept = place_irradiance_ascent(task, 20, **options)
    assert free.details["behind_surfaces"] > 0 and kept.details["behind_surfaces"] == 0
    assert kept.details["steps_taken_back"] > 0
    assert (kept.position[:, 0] > WALL).sum() == kept.details["dark_probes"] == 2  # a tenth of 20, by k-means


def test_decoupled_direct_light_does_not_attract_probes(task):
    def even(x):
        return np.broadcast_to(np.eye(9)[0][:, None] * np.ones(3), (*x.shape[:-1], 9, 3)).copy()

    still = place_irradiance_ascent(task, 20, indirect=analytic_task(radiance=even, points=20).field, initial=1.0)
    start = uniform_grids(task, 20)[0].position
    apart = np.linalg.norm(still.position[:, None] - start, axis=2)
    assert len(still) == len(start) and apart.min(1).max() < 1e-6


def test_probes_without_any_light_to_climb_are_clustered(task):
    dark = replace(task.field, values=torch.zeros_like(task.field.values))
    placement = place_irradiance_ascent(task, 10, indirect=dark)
    assert len(placement) == placement.details["dark_probes"] == 10


def test_greedy_removal_keeps_what_matters(task):
    """One at a time and in batches alike, it beats the grid of as many probes in the error that it minimises."""
    grid = place_grid(task, 16).position
    for batch in (0.0, 0.1):
        placement = place_greedy_removal(task, 16, dense=2.0, batch=batch)
        assert len(placement) == 16
        assert placement.details["smape"] == pytest.approx(smape_of(task, placement.position), rel=1e-9)
        assert smape_of(task, placement.position) < 0.9 * smape_of(task, grid)


def smape_of(task, position):
    x = torch.as_tensor(position)
    E = irradiance_of(TetrahedralInterpolation(x).rows(x, task.points).apply(task.field(x)), DIRECTIONS_26).numpy()
    T = irradiance_of(task.radiance, DIRECTIONS_26).numpy()
    return float((np.abs(E - T) / (np.abs(E) + np.abs(T))).mean())


def test_wrong_calls_are_named(task):
    for call, message in [
        (lambda: place(task, 8, "magic"), "method: expected one of grid, .*, got 'magic'"),
        (lambda: place(task, 0, "grid"), "count: expected a whole number of probes above 0, got 0"),
        (lambda: place(task, 8, "grid", colour=1), "grid: no option 'colour'; its options are spread"),
        (lambda: place(task, 8, "grid", spread=9.0), r"grid spread: expected a scale in \[0.1, 3\], got 9.0"),
        (lambda: place(task, 8, "grid_moved", margin=1.0), "grid_moved margin"),
        (lambda: place(task, 8, "spawn_merge", merge_ratio=2.0), "spawn_merge: expected 0 < closest < proximity"),
        (lambda: place(task, 8, "spawn_merge", contrast="x"), "contrast: expected samples6, samples26 or mse, got 'x'"),
        (lambda: place(task, 8, "spawn_merge_hierarchical", max_depth=0), "max_depth: expected 1 to 10, got 0"),
        (lambda: place(task, 8, "irradiance_ascent", until="x"), "until: expected count or converged, got 'x'"),
        (lambda: place(task, 8, "greedy_removal", dense=0.5), "greedy_removal: expected dense in"),
        (lambda: place(task, 8, "sbplx", budget=1), "sbplx budget: expected at least 10 evaluations, got 1"),
    ]:
        with pytest.raises(ValueError, match=message):
            call()


