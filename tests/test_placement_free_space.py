"""Probes stay off surfaces that no lattice resolves: plates thinner than its cells, and the inside of closed boxes."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hand_scenes import box_walls
from hypothesis import given, settings
from hypothesis import strategies as st
from placement_tasks import analytic_task

from difflpv.placement.free_moves import FreeMoves
from difflpv.placement.place import place
from difflpv.placement.task import PlacementTask
from difflpv.scene import Scene
from difflpv.triangle_distance import TriangleDistance, triangle_distance

LOW, HIGH = np.array([0.499, -0.8, -0.8]), np.array([0.501, 0.8, 0.8])


def beside_a_plate() -> PlacementTask:
    """An empty room with a closed plate of 2 mm in it, of which the lattice of 125 mm knows nothing, bright at its sides."""

    def light(x: np.ndarray) -> np.ndarray:
        found = np.zeros((*x.shape[:-1], 9, 3))
        found[..., 0, :] = 0.1 + np.exp(-np.abs(x[..., :1] - 0.5) / 0.1)
        return found

    task = analytic_task(wall=False, radiance=light, points=300)
    plate = tuple(replace(mesh, name=f"plate {mesh.name}") for mesh in box_walls(LOW, HIGH))
    scene = Scene("plate", task.scene.meshes + plate, task.scene.lights)
    off = triangle_distance(scene.triangle_vertices, task.points.numpy()) > 0.03
    return replace(task.part(points=torch.from_numpy(off)), scene=scene)


TASK = beside_a_plate()


def off_surfaces(position: np.ndarray) -> np.ndarray:
    return triangle_distance(TASK.scene.triangle_vertices, position)


def inside(position: np.ndarray) -> np.ndarray:
    return ((position > LOW) & (position < HIGH)).all(1)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_no_move_ends_at_a_surface_or_in_a_plate(seed):
    random = np.random.default_rng(seed)
    moves = FreeMoves(TASK)
    old = TASK.points.numpy()[random.permutation(len(TASK.points))[:20]]
    aim = random.uniform(-0.7, 0.7, (20, 3))
    aim[:, 0] = 0.5 + random.choice([-1, 1], 20) * (0.001 + 10 ** random.uniform(-7, -3, 20))
    new, stay = moves.moved(old, aim)
    assert 0.0005 < moves.clearance < 0.002  # of 4 m
    assert off_surfaces(new).min() >= moves.clearance and moves.allowed(new).all()
    assert not inside(new).any() and ((old[:, 0] < 0.5) == (new[:, 0] < 0.5))[np.abs(new[:, 1:]).max(1) < 0.5].all()
    assert np.array_equal(new[stay], old[stay])
    assert not moves.allowed(aim).any()
    assert FreeMoves(TASK, clearance=1e-9).allowed(aim).any()  # which the distance alone forbids


def test_what_a_plate_bars_goes_along_it_and_into_a_corner():
    moves = FreeMoves(TASK)
    off = 1.01 * moves.clearance
    old = np.array([[0.4, 0.1, 0.1], [0.6, -0.3, 0.2], [0.45, 0.7, 0.0], [0.3, 0.9, 0.1]])
    aim = np.array([[0.6, 0.3, 0.0], [0.5005, -0.2, 0.2], [0.55, 0.75, 0.1], [0.5, 1.2, 0.1]])
    expected = np.array([[0.499 - off, 0.3, 0.0], [0.501 + off, -0.2, 0.2], [0.499 - off, 0.75, 0.1]])
    new, stay = moves.moved(old, aim)
    assert not stay.any()
    np.testing.assert_allclose(new[:3], expected, atol=1e-12)
    assert 0.9 < new[3, 1] <= 1 - moves.clearance  # the region ends at the outermost points


def test_a_place_that_hardly_any_near_point_sees_is_none():
    task = analytic_task()  # two rooms
    left, right = (torch.nonzero(side).flatten() for side in (task.points[:, 0] < 0, task.points[:, 0] > 0.2))
    place_right = np.array([[1.0, 0.0, 0.0]])
    for seeing in (1, 3, 4, 16):
        few = task.part(points=torch.cat([right[:seeing], left[: 16 - seeing]]))
        assert few.seen(place_right).all() and few.in_free_space(place_right).all()
        assert FreeMoves(few).allowed(place_right).all() == (seeing >= 4)


@pytest.mark.parametrize("interpolation", ["tetrahedra", "gaussian"])
def test_probes_that_a_plate_attracts_keep_off_it(interpolation):
    options = {"interpolation": interpolation, "steps": 40, "relocations": 1, "barrier": 0.0}
    loose, held = (place(TASK, 24, "gradient", clearance=least, **options) for least in (1e-9, 0.02))
    assert off_surfaces(loose.position).min() < 0.01  # they do go there
    assert off_surfaces(held.position).min() >= 0.02 and not inside(held.position).any()


def test_distances_up_to_a_limit_are_those_without_one():
    random = np.random.default_rng(0)
    scale = 10 ** random.uniform(-2, 0.5, (60, 1, 1))
    corners = random.normal(size=(60, 1, 3)) + scale * random.normal(size=(60, 3, 3))
    points = random.normal(size=(200, 3))
    distance = TriangleDistance(corners)
    exact = distance(points)
    for limit in (0.01, 0.1, 1.0, 10.0):
        np.testing.assert_array_equal(distance(points, limit), np.minimum(exact, limit))
    assert (np.quantile(exact, [0.1, 0.9]) > [0.0, 0.1]).all()
