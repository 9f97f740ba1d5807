import dataclasses

import numpy as np
import pytest
import torch
from hand_scenes import box_scene, rectangle

from difflpv import lookup
from difflpv.grid import Grid
from difflpv.lookup import open_cells
from difflpv.raycast import Raycaster
from difflpv.scene import PointLight, Scene

GRID = Grid((-1.0, -1, -1), 0.25, (8, 8, 8))
SKY = PointLight(np.array([0.0, 5, 0]), np.ones(3))


def wall_scene(x=0.0):
    """A wall across x, larger than the grid."""
    return Scene("wall", (rectangle("wall", (x, -2, -2), (0, 4, 0), (0, 0, 4)),), (SKY,))


def points_on_wall(x, count=50, seed=0):
    rng = np.random.default_rng(seed)
    position = np.concatenate([np.full((count, 1), x), rng.uniform(-0.9, 0.9, (count, 2))], 1)
    return position, np.tile([1.0, 0, 0], (count, 1))


def used(cells, weights):
    """Indices (x, y, z) of the cells with weight."""
    flat = cells[weights != 0].numpy()
    return np.stack([flat % 8, flat // 8 % 8, flat // 64], -1)


@pytest.mark.parametrize("mode", ["front", "visible", "affine"])
@pytest.mark.parametrize("x", [-0.12, -0.05, 0.0, 0.04, 0.11])
def test_no_light_from_behind_a_wall_wherever_it_cuts_the_cells(mode, x):
    position, normal = points_on_wall(x)
    found = open_cells(position, normal, GRID, mode=mode, raycaster=Raycaster(wall_scene(x)))
    weights = found.weights(torch.tensor(position).float(), torch.tensor(normal).float(), GRID)
    torch.testing.assert_close(weights.sum(1), torch.ones(50))
    centers = -1 + (used(found.cells, weights) + 0.5) * 0.25
    assert (centers[:, 0] > x).all()
    assert bool((found.backed == 1).all())


def test_a_second_wall_hides_cells_from_the_visible_lookup_only():
    """A thin wall 0.05 m before the receivers' plane: all but the cells between the two are out of sight."""
    scene = Scene("two", (*wall_scene(0.0).meshes, rectangle("near", (0.05, -2, -2), (0, 4, 0), (0, 0, 4))), (SKY,))
    position, normal = points_on_wall(0.0)
    front = open_cells(position, normal, GRID, mode="front")
    visible = open_cells(position, normal, GRID, mode="visible", raycaster=Raycaster(scene))
    assert bool((front.open.sum(1) > 0).all())
    # nothing is in sight: every cell counts, rather than none
    assert bool((visible.open == 1).all())


def test_thin_air_is_not_a_wall():
    scene = box_scene(low=(-5, -5, -5), high=(5, 5, 5))
    position, normal = points_on_wall(0.03)
    for mode in ("visible", "affine"):
        found = open_cells(position, normal, GRID, mode=mode, raycaster=Raycaster(scene))
        assert not found.backed.any()
        assert mode == "affine" or bool((found.open == 1).all())


def test_a_point_without_a_usable_cell_among_its_eight_takes_the_nearest_of_27():
    """In the gap between a wall and a panel that hides the centres right before it."""
    panel = rectangle("panel", (0.05, -0.2, -0.2), (0, 0.4, 0), (0, 0, 0.4))
    scene = Scene("panel", (*wall_scene(0.0).meshes, panel), (SKY,))
    position, normal = np.array([[0.0, 0.0, 0.0]]), np.array([[1.0, 0, 0]])
    found = open_cells(position, normal, GRID, mode="visible", raycaster=Raycaster(scene))
    weights = found.weights(torch.tensor(position), torch.tensor(normal), GRID)
    assert float(weights.sum()) == 1 and bool(found.open.sum() in (1, 8))


def test_weights_are_trilinear_in_the_open():
    scene = box_scene(low=(-5, -5, -5), high=(5, 5, 5))
    rng = np.random.default_rng(1)
    position, normal = rng.uniform(-0.8, 0.8, (20, 3)), np.tile([0.0, 0, 1], (20, 1))
    found = open_cells(position, normal, GRID, mode="visible", raycaster=Raycaster(scene), bias=1.0)
    x, n = torch.tensor(position), torch.tensor(normal)
    weights = found.weights(x, n, GRID, bias=1.0)
    u = (position + 0.25 * normal + 1) / 0.25
    # with a bias of one cell every centre is in front, and a linear function is reproduced exactly
    torch.testing.assert_close((weights[..., None] * found.centers).sum(1), torch.tensor(u).clamp(0.5, 7.5))


def corner_scene():
    """Three walls that meet at (-0.41, -0.4, -0.43): everything but one octant is behind one of them."""
    low = np.array([-0.41, -0.4, -0.43])
    walls = [
        rectangle(f"wall{a}", low - 3 * (1 - np.eye(3)[a]), 8 * np.eye(3)[(a + 1) % 3], 8 * np.eye(3)[(a + 2) % 3])
        for a in range(3)
    ]
    return low, Scene("corner", tuple(walls), (SKY,))


def test_affine_weights_read_an_even_slope_in_a_corner(monkeypatch):
    """Exactly without the ridge; with it, still better than the trilinear mean of what is seen."""
    low, scene = corner_scene()
    rng = np.random.default_rng(4)
    position = low + rng.uniform(0.0, 0.12, (40, 3))
    position[:, 0] = low[0]
    normal, x = np.tile([1.0, 0, 0], (40, 1)), torch.tensor(position)
    errors = {}
    for mode, ridge in (("visible", None), ("affine", lookup._RIDGE), ("affine", 1e-8)):
        monkeypatch.setattr(lookup, "_RIDGE", ridge)
        found = open_cells(position, normal, GRID, mode=mode, raycaster=Raycaster(scene), dtype=torch.float64)
        weights = found.weights(x, torch.tensor(normal), GRID)
        torch.testing.assert_close(weights.sum(1), torch.ones(40, dtype=torch.float64), rtol=0, atol=1e-6)
        read = (weights[..., None] * found.centers).sum(1)  # the field is the position itself, in cells
        errors[mode, ridge] = float((read - (x + 1) / 0.25).abs().mean())
    visible, affine, exact = errors.values()
    assert exact < 1e-3 < affine < 0.9 * visible


def test_affine_weights_are_exact_in_the_open_at_a_cell_centre():
    """There the block is symmetric: whatever the ridge, an affine field is read exactly."""
    scene = box_scene(low=(-5, -5, -5), high=(5, 5, 5))
    position = np.array([[0.125, 0.375, -0.125]])
    found = open_cells(position, np.array([[0.0, 1, 0]]), GRID, mode="affine", raycaster=Raycaster(scene), bias=0.0)
    weights = found.weights(torch.tensor(position).float(), torch.zeros(1, 3), GRID)
    torch.testing.assert_close((weights[..., None] * found.centers).sum(1), torch.tensor(position + 1).float() / 0.25)


@pytest.mark.parametrize("far", [1.0, 30.0, 1e4])
def test_affine_weights_stay_finite_far_from_the_grid(far):
    position, normal = np.array([[far, 0.0, 0.0]]), np.array([[1.0, 0, 0]])
    scene = box_scene(low=(-2e4, -5, -5), high=(2e4, 5, 5))
    found = open_cells(position, normal, GRID, mode="affine", raycaster=Raycaster(scene))
    assert bool(torch.isfinite(found.weights(torch.tensor(position).float(), torch.tensor(normal).float(), GRID)).all())


def test_affine_weights_outside_are_those_of_the_nearest_point_of_the_grid():
    """Float32, one cell in sight: read at the point itself 48 cells away the fit was NaN."""
    grid = Grid((-3.5, -2.5, -8.3), 0.3125, (32, 32, 32))
    far, normal = np.array([[-18.6, 13.8, 10.1]]), np.array([[1.0, 0, 0]])
    seen = open_cells(far, normal, grid, mode="affine", raycaster=Raycaster(box_scene()))
    opened = torch.zeros_like(seen.open)
    opened[:, 19] = 1.0  # the only one of the block in sight
    seen = dataclasses.replace(seen, open=opened)
    x, n = torch.tensor(far, dtype=torch.float32), torch.tensor(normal, dtype=torch.float32)
    near = torch.tensor(np.clip(far, grid.minimum, grid.maximum), dtype=torch.float32)
    weights = seen.weights(x, n, grid)
    assert bool(weights.isfinite().all())
    torch.testing.assert_close(weights, seen.weights(near, n, grid))


def test_edge_cells_answer_beyond_the_outermost_centres_and_outside():
    position = np.array([[-0.99, 0, 0], [-3.0, 0, 0], [3.0, 3.0, 3.0]])
    normal = np.array([[1.0, 0, 0]] * 3)
    found = open_cells(position, normal, GRID, mode="front")
    weights = found.weights(torch.tensor(position), torch.tensor(normal), GRID)
    assert bool(torch.isfinite(weights).all()) and int(found.cells.min()) >= 0 and int(found.cells.max()) < 512
    torch.testing.assert_close(weights.sum(1), torch.ones(3, dtype=torch.float64))


def test_gradients_reach_position_normal_and_bias():
    rng = np.random.default_rng(2)
    position, normal = rng.uniform(-0.6, 0.6, (6, 3)), np.tile([0.0, 1, 0], (6, 1))
    found = open_cells(position, normal, GRID, mode="front", dtype=torch.float64)
    arguments = torch.tensor(position), torch.tensor(normal), torch.tensor(0.5, dtype=torch.float64)
    for tensor in arguments:
        tensor.requires_grad_()
    assert torch.autograd.gradcheck(lambda x, n, b: found.weights(x, n, GRID, bias=b), arguments)
    low, scene = corner_scene()
    position = low + rng.uniform(0.02, 0.3, (6, 3))
    found = open_cells(position, normal, GRID, mode="affine", raycaster=Raycaster(scene), dtype=torch.float64)
    x = torch.tensor(position, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: found.weights(x, torch.tensor(normal), GRID), x)


def test_a_grid_of_one_cell():
    grid = Grid((0.0, 0, 0), 1.0, (1, 1, 1))
    found = open_cells(np.array([[0.5, 0.0, 0.5]]), np.array([[0.0, 1, 0]]), grid, mode="front")
    weights = found.weights(torch.tensor([[0.5, 0.0, 0.5]]), torch.tensor([[0.0, 1, 0]]), grid)
    assert bool((found.cells == 0).all()) and float(weights.sum()) == pytest.approx(1)


def test_messages():
    point = np.zeros((1, 3))
    with pytest.raises(ValueError, match="lookup: expected 'front', 'visible' or 'affine', got 'all'"):
        open_cells(point, point, GRID, mode="all")
    with pytest.raises(ValueError, match="lookup: 'visible' needs a raycaster"):
        open_cells(point, point, GRID, mode="visible")
    assert open_cells(np.empty((0, 3)), np.empty((0, 3)), GRID, mode="front").cells.shape == (0, 8)


@pytest.mark.parametrize("mode", ["visible", "affine"])
def test_a_wall_exactly_on_a_plane_of_centres_has_one_side_per_centre(mode):
    """The centres on it belong to one side, the one that traced occlusion gives them: nobody else reads them."""
    x = 0.125  # a plane of centres
    caster = Raycaster(wall_scene(x))
    position, normal = points_on_wall(x)
    sides = []
    for sign in (1, -1):
        found = open_cells(position, sign * normal, GRID, mode=mode, raycaster=caster)
        weights = found.weights(torch.tensor(position).float(), torch.tensor(sign * normal).float(), GRID)
        sides.append(set(used(found.cells, weights)[:, 0]))
    assert not sides[0] & sides[1]
    sight = GRID.sight_centers(np.array([[4, 4, 4]]))[0, 0]
    assert (4 in sides[0]) == (sight > x) and (4 in sides[1]) == (sight < x)
