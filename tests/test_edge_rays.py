import numpy as np
import pytest
import torch
from placement_tasks import WALL, analytic_task

from difflpv.placement.edge_rays import tetrahedra_cut_by_walls, with_edge_rays
from difflpv.placement.reconstruction import reconstruction_error
from difflpv.placement.task import Placement
from difflpv.placement.uniform import place_grid
from difflpv.probes.reader import ProbeReader
from difflpv.probes.tetrahedra import Tetrahedra

# One tetrahedron, three of its edges through the wall at x = 0.1.
ACROSS = np.array([[-0.9, 0.0, 0.0], [0.9, -0.5, -0.4], [0.9, 0.6, -0.4], [0.9, 0.0, 0.6]])


@pytest.fixture(scope="module")
def task():
    return analytic_task(points=200)


def test_a_wall_that_cuts_an_edge_gets_a_probe_on_either_side(task):
    after = with_edge_rays(task, Placement("hand", ACROSS), separation=0.0)
    assert after.details["edges_cut"] == (3,) and after.details["edge_ray_probes"] == 6
    assert np.array_equal(after.position[:4], ACROSS)
    x = np.sort(after.position[4:, 0])
    assert (x[:3] < WALL).all() and (x[3:] > WALL).all() and np.abs(x - WALL).max() < 0.05
    for a, b in ((0, 1), (0, 2), (0, 3)):  # near where that edge meets the wall
        hit = ACROSS[a] + (WALL - ACROSS[a, 0]) / (ACROSS[b, 0] - ACROSS[a, 0]) * (ACROSS[b] - ACROSS[a])
        assert (np.linalg.norm(after.position[4:] - hit, axis=1) < 0.06).sum() >= 2
    assert task.in_free_space(after.position).all()


def test_the_rules_keep_clusters_away(task):
    hand = Placement("hand", ACROSS)
    free = len(with_edge_rays(task, hand, separation=0.0))
    ruled = with_edge_rays(task, hand, separation=0.4)
    assert 4 < len(ruled) < free and ruled.details["edge_ray_probes_refused"] > 0
    sides = np.sign(ruled.position[4:, 0] - WALL)
    assert set(sides) == {-1.0, 1.0}  # what is refused has a neighbour on its own side
    # Figure 14: an end that stands at the wall already gets no other probe beside it.
    at_wall = ACROSS.copy()
    at_wall[0, 0] = WALL - 0.05
    assert len(with_edge_rays(task, Placement("hand", at_wall), end_share=0.2)) == 4
    assert len(with_edge_rays(task, Placement("hand", at_wall), end_share=0.0, separation=0.0)) > 4
    # A ray along the surface does not count, whatever it hits.
    assert len(with_edge_rays(task, hand, grazing=0.999)) == 4
    assert len(with_edge_rays(task, hand, count=5)) == 5


def test_footprints_are_refused(task):
    hand = Placement("hand", ACROSS, reader=ProbeReader("gaussian", np.stack([np.eye(3)] * 4)))
    with pytest.raises(ValueError, match="edge rays: expected probes that are read in tetrahedra"):
        with_edge_rays(task, hand)


def test_more_rounds_than_walls_end_by_themselves(task):
    grid = place_grid(task, 27)
    after = with_edge_rays(task, grid, rounds=8)
    assert len(after.details["edges_cut"]) <= 8
    assert len(after) < 8 * len(grid)
    assert after.method == "grid+edge_rays" and after.seconds >= grid.seconds and after.radiance is None
    again = with_edge_rays(task, grid, rounds=8)
    assert np.array_equal(after.position, again.position)


def test_edge_rays_lower_the_error_of_probes_that_leak(task):
    corners = [[-1.7, -0.7, -0.7], [-1.7, 0.8, 0.7], [1.7, 0.7, -0.8], [1.7, -0.7, 0.8]]
    hand = Placement("hand", np.concatenate([ACROSS, corners]))
    after = with_edge_rays(task, hand)
    error = [float(reconstruction_error(task, torch.as_tensor(p.position))) for p in (hand, after)]
    assert error[1] < error[0]


def test_tetrahedra_are_cut_if_one_of_their_edges_is(task):
    left = ACROSS - [1.0, 0.0, 0.0]
    left[1:, 0] = -0.3
    position = np.concatenate([ACROSS, left])
    assert tetrahedra_cut_by_walls(task.raycaster, position, np.array([[0, 1, 2, 3], [4, 5, 6, 7]])).tolist() == [True, False]
    assert not tetrahedra_cut_by_walls(task.raycaster, position, np.empty((0, 4), int)).size
    grid = place_grid(task, 27).position
    cells = Tetrahedra.of(grid).vertices
    cut = tetrahedra_cut_by_walls(task.raycaster, grid, cells)
    sides = grid[cells][:, :, 0] > WALL
    assert np.array_equal(cut, sides.any(1) & ~sides.all(1))


def test_options_out_of_range_are_named(task):
    with pytest.raises(ValueError, match=r"edge rays: expected rounds >= 1, end_share in \[0, 0.5\)"):
        with_edge_rays(task, Placement("hand", ACROSS), end_share=0.7)
