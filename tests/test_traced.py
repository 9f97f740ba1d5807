import itertools

import numpy as np
import pytest
import torch
from hand_scenes import box_scene, rectangle
from hypothesis import example, given, settings
from hypothesis import strategies as st

from difflpv.attenuation import attenuate_pairs, pair_mean, strengthen
from difflpv.grid import Grid
from difflpv.raycast import Raycaster
from difflpv.scene import PointLight, Scene
from difflpv.stencil import holpv_stencil, pair_offsets
from difflpv.traced import face_transmittance, pair_transmittance

GRID = Grid((-1.0, -1, -1), 0.25, (8, 8, 8))
PAIRS = pair_offsets(np.array(list(itertools.product((-1, 0, 1), repeat=3))))
SKY = PointLight(np.array([0.0, 5, 0]), np.ones(3))


def traced(*meshes, grid=GRID, **options):
    scene = Scene("scene", meshes, (SKY,))
    return pair_transmittance(Raycaster(scene), scene.triangle_vertices, grid, PAIRS, **options)


def wall(x, low=-2.0, high=2.0):
    return rectangle("wall", (x, low, low), (0, high - low, 0), (0, 0, high - low))


def test_pairs_are_one_of_each_two_opposites():
    assert PAIRS.shape == (13, 3)
    assert len({tuple(n) for n in PAIRS} | {tuple(-n) for n in PAIRS}) == 26
    axes = np.eye(3, dtype=int)
    assert pair_offsets(np.concatenate([axes, -axes])).tolist() == [[0, 0, 1], [0, 1, 0], [1, 0, 0]]


@pytest.mark.parametrize("rays_per_axis", [1, 2])
@pytest.mark.parametrize("x", [-0.25, -0.2, -0.125, -0.06, 0.0, 0.1])
def test_a_closed_wall_lets_nothing_through_wherever_it_cuts_the_cells(x, rays_per_axis):
    passed = traced(wall(x), rays_per_axis=rays_per_axis)
    centers = GRID.sight_centers()
    before = centers[..., 0] < x
    for row, offset in zip(passed, PAIRS, strict=True):
        beyond = centers[..., 0] + 0.25 * offset[0] < x
        assert not row[before != beyond].any(), offset
        assert (row[before == beyond] == 1).all(), offset


@given(st.floats(-0.9, 0.9), st.floats(0, np.pi), st.floats(-1, 1))
@example(-0.07161770406451207, 0.14767704385124966, -0.158524301056979)  # a start less than an ulp behind the plane
@settings(max_examples=15, deadline=None)
def test_no_way_round_an_endless_plane(offset, azimuth, height):
    """Whatever plane cuts the grid: cells on both sides of it are joined by no pair that lets light through."""
    normal = np.array([np.cos(azimuth) * np.sqrt(1 - height**2), np.sin(azimuth) * np.sqrt(1 - height**2), height])
    first = np.cross(normal, [1.0, 0, 0] if abs(normal[0]) < 0.9 else [0, 1.0, 0])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    passed = traced(rectangle("plane", offset * normal - 10 * (first + second), 20 * first, 20 * second))
    side = (GRID.sight_centers() @ normal > offset).astype(int)
    for row, n in zip(passed, PAIRS, strict=True):
        inside = tuple(slice(max(-int(v), 0), 8 - max(int(v), 0)) for v in n[::-1])
        moved = tuple(slice(max(int(v), 0), 8 + min(int(v), 0)) for v in n[::-1])
        assert not row[inside][side[inside] != side[moved]].any()


def test_an_edge_lets_a_share_through_and_empty_space_everything():
    half = traced(wall(0.0, low=0.0))  # covers y > 0, z > 0 only
    assert ((half > 0) & (half < 1)).any()
    assert (half[:, :2, :2] == 1).all()  # far from the wall
    assert (traced(wall(5.0)) == 1).all()


def test_both_ways_and_both_sides_are_alike():
    turned = rectangle("wall", (0.0, -2, -2), (0, 0, 4), (0, 4, 0))
    assert np.array_equal(traced(wall(0.0)), traced(turned))


def test_faces_read_the_pair_of_their_neighbour():
    rng = np.random.default_rng(0)
    pairs = torch.tensor(rng.random((13, 3, 4, 5)))
    stencil = holpv_stencil()
    faces = face_transmittance(pairs, PAIRS, stencil.offsets)
    assert faces.shape == (54, 3, 4, 5)
    index = {tuple(n): i for i, n in enumerate(PAIRS.tolist())}
    for f, offset in enumerate(stencil.offsets.tolist()):
        for z, y, x in itertools.product(range(3), range(4), range(5)):
            to = (x + offset[0], y + offset[1], z + offset[2])
            if not all(0 <= v < n for v, n in zip(to, (5, 4, 3), strict=True)):
                assert faces[f, z, y, x] == 1
            elif tuple(offset) in index:
                assert faces[f, z, y, x] == pairs[index[tuple(offset)], z, y, x]
            else:
                assert faces[f, z, y, x] == pairs[index[tuple(-v for v in offset)], to[2], to[1], to[0]]


def test_strength_is_smooth_monotone_and_keeps_what_is_certain():
    passed = torch.tensor([0.0, 0.25, 0.5, 1.0], dtype=torch.float64)
    one = torch.ones((), dtype=torch.float64)
    torch.testing.assert_close(strengthen(passed, one), passed)
    weak, strong = strengthen(passed, 0.5 * one), strengthen(passed, 2 * one)
    assert bool((weak[1:3] > passed[1:3]).all()) and bool((strong[1:3] < passed[1:3]).all())
    assert weak[[0, 3]].tolist() == strong[[0, 3]].tolist() == [0, 1]
    assert torch.autograd.gradcheck(strengthen, (passed[1:3].clone().requires_grad_(), one.clone().requires_grad_()))
    with pytest.raises(ValueError, match="strength: expected finite numbers > 0, got 0"):
        strengthen(passed, 0 * one)


def test_attenuation_of_pairs_and_its_gradients():
    rng = np.random.default_rng(1)
    passed = torch.tensor(rng.uniform(0.1, 0.9, (13, 2, 3, 2)))
    one = torch.ones((), dtype=torch.float64)
    assert attenuate_pairs(PAIRS, strength=one) is None
    torch.testing.assert_close(attenuate_pairs(PAIRS, passed=passed, strength=one), passed)
    correction = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
    corrected = attenuate_pairs(PAIRS, passed=passed, strength=one, correction=correction)
    kind = np.abs(PAIRS).sum(1)
    assert bool((corrected[kind == 1] > passed[kind == 1]).all()) and bool((corrected[kind == 3] < passed[kind == 3]).all())
    torch.testing.assert_close(corrected[kind == 2], passed[kind == 2])
    field = torch.tensor(rng.uniform(0.5, 1.5, (2, 3, 2)))
    inputs = [t.clone().requires_grad_() for t in (passed, 1.3 * one, correction, field, field + 0.1)]

    def everything(passed, strength, correction, occlusion, propagation):
        fields = {"cell_occlusion": occlusion, "cell_propagation": propagation}
        return attenuate_pairs(PAIRS, passed=passed, strength=strength, correction=correction, **fields)

    assert torch.autograd.gradcheck(everything, inputs)
    only_moved = attenuate_pairs(PAIRS, strength=one, cell_propagation=field)
    torch.testing.assert_close(only_moved, pair_mean(field, PAIRS))


def test_pair_mean_is_geometric_and_goes_on_at_the_edge():
    field = torch.tensor([[[1.0, 4.0, 9.0]]], dtype=torch.float64)
    mean = pair_mean(field, np.array([[1, 0, 0], [0, 1, 0]]))
    torch.testing.assert_close(mean[0, 0, 0], torch.tensor([2.0, 6.0, 9.0], dtype=torch.float64))
    torch.testing.assert_close(mean[1], field)


def test_solids_and_rooms(tmp_path):
    """Nothing leaves a closed room: no pair joins a cell inside to one outside."""
    scene = box_scene(low=(-0.6, -0.7, -0.55), high=(0.62, 0.51, 0.66))
    passed = pair_transmittance(Raycaster(scene), scene.triangle_vertices, GRID, PAIRS)
    centers = GRID.cell_centers()
    inside = ((centers > [-0.6, -0.7, -0.55]) & (centers < [0.62, 0.51, 0.66])).all(-1)
    for row, n in zip(passed, PAIRS, strict=True):
        near = tuple(slice(max(-int(v), 0), 8 - max(int(v), 0)) for v in n[::-1])
        far = tuple(slice(max(int(v), 0), 8 + min(int(v), 0)) for v in n[::-1])
        assert not row[near][inside[near] != inside[far]].any()


def test_shares_are_those_of_every_pair_traced_by_itself():
    """What centres see is traced once for all pairs of a cell; here the definition, ray by ray, of pairs within the grid."""
    scene = box_scene(low=(-0.6, -1.3, -0.55), high=(0.62, 0.51, 1.4))
    grid, raycaster = Grid((-1.0, -1, -1), 0.5, (4, 3, 4)), Raycaster(scene)
    passed = pair_transmittance(raycaster, scene.triangle_vertices, grid, PAIRS)
    starts = np.array(list(itertools.product((-0.125, 0.125), repeat=3)))

    def free(a, b):
        return not raycaster.blocked(a[None], b[None], shortened=False)[0]

    for row, n in zip(passed, PAIRS, strict=True):
        for (z, y, x), share in np.ndenumerate(row):
            cell = np.array([x, y, z])
            if ((cell + n < 0) | (cell + n >= grid.resolution)).any():
                continue
            here = grid.sight_centers(cell)
            there = here + 0.5 * n
            usable = [s for s in starts if free(here, here + s) and free(there, there + s)]
            expected = np.mean([free(here + s, there + s) for s in usable]) if usable else free(here, there)
            assert share == np.float32(expected), (n, x, y, z)
    assert 0 < passed.mean() < 1


def test_messages():
    with pytest.raises(ValueError, match="rays_per_axis: expected at least 1, got 0"):
        traced(wall(0.0), rays_per_axis=0)
