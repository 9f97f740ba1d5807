import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial import ConvexHull, Delaunay

from difflpv.probes.barycentric import barycentric_weights
from difflpv.probes.tetrahedra import Tetrahedra, TetrahedralInterpolation
from difflpv.reference.tetrahedra import dense_weights

SEEDS = st.integers(0, 2**32 - 1)


def lattice(*shape, step=0.3):
    return np.stack(np.meshgrid(*[np.arange(k) * step for k in shape], indexing="ij"), -1).reshape(-1, 3)


def random_set(seed, count=20, points=60, spread=1.6):
    rng = np.random.default_rng(seed)
    return rng.random((count, 3)), torch.as_tensor((rng.random((points, 3)) - 0.5) * spread + 0.5)


def tensors(grid):
    return tuple(torch.from_numpy(np.ascontiguousarray(t)) for t in (grid.vertices, grid.neighbours, grid.hull))


def dense(position, points, **options):
    x = torch.as_tensor(position, dtype=torch.float64)
    return TetrahedralInterpolation(x, **options).rows(x, torch.as_tensor(points, dtype=torch.float64)).dense(len(x))


def twin_of(position, points):
    grid = Tetrahedra.of(position)
    vertices, _, hull = tensors(grid)
    return dense_weights(torch.as_tensor(position), points, vertices, hull)


# Connectivity


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.integers(4, 60))
def test_tetrahedra_fill_the_convex_hull_and_are_those_of_delaunay(seed, count):
    x, _ = random_set(seed, count)
    grid = Tetrahedra.of(x)
    assert (grid.volumes(x) > 0).all()
    np.testing.assert_allclose(grid.volumes(x).sum(), ConvexHull(x).volume, rtol=1e-9)
    assert grid.is_convex(x)
    ours, scipys = ({tuple(sorted(s)) for s in table.tolist()} for table in (grid.vertices, Delaunay(x).simplices))
    flat = {s for s in scipys - ours if np.linalg.det(x[list(s[1:])] - x[s[0]]) < 1e-6}
    assert len((scipys - flat) ^ ours) <= 0.02 * len(ours)  # the shift of 1e-10 may decide a near tie


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("shape", [(2, 2, 2), (3, 3, 3), (4, 4, 4), (2, 5, 3)])
def test_a_regular_grid_has_no_flat_tetrahedra_and_every_face_has_two_sides(shape, turned):
    x = lattice(*shape)
    if turned:
        x = x @ np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0] + 7
    grid = Tetrahedra.of(x)
    cell = 0.3**3
    assert grid.volumes(x).min() > cell / 7
    np.testing.assert_allclose(grid.volumes(x).sum(), cell * np.prod(np.array(shape) - 1), rtol=1e-12)
    for t, k in itertools.product(range(len(grid.vertices)), range(4)):
        face = set(np.delete(grid.vertices[t], k))
        other = grid.neighbours[t, k]
        if other >= 0:
            assert face < set(grid.vertices[other])
            assert t in grid.neighbours[other]
        else:
            assert face == set(grid.hull[-1 - other])


def test_the_hull_looks_outward_and_edges_are_listed_once():
    x, _ = random_set(0)
    grid = Tetrahedra.of(x)
    a, b, c = (x[grid.hull[:, k]] for k in range(3))
    assert (((a - x.mean(0)) * np.cross(b - a, c - a)).sum(1) > 0).all()
    assert len(grid.hull) == 2 * len(np.unique(grid.hull)) - 4  # Euler
    expected = {tuple(sorted(pair)) for cell in grid.vertices.tolist() for pair in itertools.combinations(cell, 2)}
    assert grid.edges.tolist() == [list(pair) for pair in sorted(expected)]
    assert all(p in grid.vertices[grid.first[p]] for p in range(len(x)))


@pytest.mark.parametrize(
    ("position", "valid", "message"),
    [
        (np.zeros((3, 2)), None, r"probe position: expected shape \[n,3\], got \[3, 2\]"),
        (np.zeros((0, 3)), None, "probes: expected at least one that is valid, got none"),
        (np.zeros((2, 3)), np.zeros(2, bool), "probes: expected at least one that is valid, got none"),
        (np.full((2, 3), np.nan), None, "probe position: expected finite numbers"),
        (np.zeros((2, 3)), np.ones(3, bool), r"probe valid: expected 2 booleans, got shape \[3\]"),
    ],
)
def test_bad_probes_are_named(position, valid, message):
    with pytest.raises(ValueError, match=message):
        Tetrahedra.of(position, valid=valid)


# Weights


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.integers(1, 40))
def test_weights_sum_to_one_and_are_the_twins(seed, count):
    x, points = random_set(seed, count)
    weight = dense(x, points)
    torch.testing.assert_close(weight.sum(1), torch.ones(len(points), dtype=torch.float64))
    assert weight.min() > -1e-11
    torch.testing.assert_close(weight, twin_of(x, points), rtol=0, atol=1e-8)


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_linear_functions_are_reproduced_inside_the_hull(seed):
    x, points = random_set(seed, 30)
    inside = torch.as_tensor(Delaunay(x).find_simplex(points.numpy()) >= 0)
    torch.testing.assert_close((dense(x, points) @ torch.as_tensor(x))[inside], points[inside], rtol=0, atol=1e-10)


def test_outside_the_closest_point_of_the_hull_answers():
    x, points = random_set(3, 12, 25, spread=3)
    found = (dense(x, points) @ torch.as_tensor(x)).numpy()
    for p, near in zip(points.numpy(), found, strict=True):
        simplex = {"type": "eq", "fun": lambda w: w.sum() - 1}
        start = np.full(12, 1 / 12)
        best = minimize(
            lambda w, p=p: ((w @ x - p) ** 2).sum(), start, bounds=[(0, 1)] * 12, constraints=simplex, tol=1e-14
        )
        assert np.linalg.norm(near - p) <= np.sqrt(best.fun) + 1e-5
        if np.linalg.norm(near - p) > 1e-6:  # no probe lies beyond the plane through the closest point
            assert ((x - near) @ (p - near)).max() < 1e-10


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.booleans())
def test_no_result_depends_on_where_the_walk_starts(seed, regular):
    rng = np.random.default_rng(seed)
    x = lattice(3, 3, 3) if regular else rng.random((30, 3))
    spots = rng.integers(-1, 9, (80, 3)) * 0.1 if regular else rng.random((80, 3)) * 1.4 - 0.2  # on faces, too
    points = torch.as_tensor(spots)
    grid = Tetrahedra.of(x)
    start = torch.as_tensor(rng.integers(0, len(grid.vertices), 80).astype(np.int32))
    results = []
    for first in (None, start):
        probe, weight, _ = barycentric_weights(torch.as_tensor(x), points, *tensors(grid), start=first)
        results.append(torch.zeros(80, len(x), dtype=torch.float64).scatter_add(1, probe.long(), weight))
    torch.testing.assert_close(*results, rtol=0, atol=1e-10)
    torch.testing.assert_close(results[1], twin_of(x, points), rtol=0, atol=1e-10)


def test_walks_cross_connectivity_that_is_no_longer_convex():
    rng = np.random.default_rng(5)
    x = lattice(4, 4, 4)
    points = torch.as_tensor(rng.random((300, 3)) * 1.1 - 0.1)
    held = TetrahedralInterpolation(x, connectivity="held")
    moved = x + rng.uniform(-0.02, 0.02, x.shape)
    assert not held.tetrahedra.is_convex(moved)
    vertices, _, hull = tensors(held.tetrahedra)
    expected = dense_weights(torch.as_tensor(moved), points, vertices, hull)
    torch.testing.assert_close(held.rows(torch.as_tensor(moved), points).dense(64), expected, rtol=0, atol=1e-8)
    assert held.triangulations == 1


def test_single_precision_and_strided_input():
    x, points = random_set(2)
    single = TetrahedralInterpolation(x).rows(torch.as_tensor(x).float(), points.float().T.contiguous().T)
    torch.testing.assert_close(single.dense(20).double(), dense(x, points), rtol=0, atol=1e-3)
    assert single.weight.dtype == torch.float32


def test_no_points():
    x, _ = random_set(0)
    rows = TetrahedralInterpolation(x).rows(torch.as_tensor(x), torch.empty(0, 3, dtype=torch.float64))
    assert rows.weight.shape == (0, 4)


# Degenerate sets


DEGENERATE = {
    "one probe": np.array([[0.2, 0.3, 0.4]]),
    "one place": np.full((5, 3), 0.25),
    "two probes": np.array([[0.0, 0, 0], [1, 1, 0]]),
    "three probes": np.array([[0.0, 0, 0], [1, 1, 0], [0, 1, 1]]),
    "a line": np.linspace(0, 1, 6)[[3, 0, 5, 1, 2, 4], None] * [1.0, 2, 3],
    "a line with duplicates": np.repeat(np.linspace(0, 1, 3)[:, None] * [1.0, 2, 3], 2, axis=0),
    "a plane": lattice(3, 4, 1) @ np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0],
    "a plane on an axis": lattice(1, 3, 3),
    "duplicates": np.repeat(lattice(2, 2, 2), 2, axis=0),
    "a grid": lattice(3, 3, 3),
    "nearly a plane": lattice(3, 4, 1) + np.random.default_rng(2).normal(size=(12, 3)) * 1e-9,
    "nearly a line": np.linspace(0, 1, 7)[:, None] * [1.0, 1, 1] + np.random.default_rng(2).normal(size=(7, 3)) * 1e-9,
    "far away": lattice(3, 2, 2) + 1e4,
    "near duplicates": np.concatenate([lattice(2, 2, 2), lattice(2, 2, 2) + 1e-9]),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_every_set_has_an_answer_with_finite_gradients(name):
    x = torch.as_tensor(DEGENERATE[name]).clone().requires_grad_()
    points = torch.as_tensor(np.random.default_rng(0).random((40, 3)) * 1.5 - 0.25) + x.detach().mean(0).floor()
    points = torch.cat([points, x.detach()]).requires_grad_()
    rows = TetrahedralInterpolation(x).rows(x, points)
    torch.testing.assert_close(rows.weight.sum(1), torch.ones(len(points), dtype=torch.float64))
    (rows.weight.square().sum() + rows.apply(x).square().sum()).backward()
    assert x.grad.isfinite().all()
    assert points.grad.isfinite().all()
    near = rows.apply(x).detach()
    torch.testing.assert_close(near[40:], x.detach(), rtol=0, atol=1e-6)  # at a probe, that probe (or its duplicate)
    away = (points[:40].detach() - near[:40]).norm(dim=1)
    assert (away <= torch.cdist(points[:40].detach(), x.detach()).amin(1) + 1e-6).all()


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.integers(1, 30), st.integers(1, 4))
def test_probes_on_few_coordinates_have_answers(seed, count, levels):
    rng = np.random.default_rng(seed)
    x = rng.integers(0, levels, (count, 3)).astype(float)  # duplicates, lines, planes, co-spherical sets
    points = torch.as_tensor(rng.integers(-2, 2 * levels + 2, (30, 3)) / 2)
    weight = dense(x, points)
    torch.testing.assert_close(weight.sum(1), torch.ones(30, dtype=torch.float64))
    near = (weight @ torch.as_tensor(x)).numpy()
    beyond = ((x[None] - near[:, None]) * (points.numpy() - near)[:, None]).sum(-1)
    assert beyond.max() < 1e-9  # the closest point of a convex set (points inside are their own)


# Gradients


@pytest.mark.parametrize("name", ["random", "a plane", "a line", "two probes", "one probe", "a grid"])
def test_gradients(name):
    rng = np.random.default_rng(4)
    x = torch.as_tensor(rng.random((9, 3)) if name == "random" else DEGENERATE[name]).clone().requires_grad_()
    points = torch.as_tensor(rng.random((12, 3)) * 1.6 - 0.3).requires_grad_()
    grid = Tetrahedra.of(x.detach().numpy())

    def weights(position, read):
        probe, weight, _ = barycentric_weights(position, read, *tensors(grid))
        return position.new_zeros(len(read), len(position)).scatter_add(1, probe.long(), weight)  # order may change

    assert torch.autograd.gradcheck(weights, (x, points))
    if name != "random":
        return
    twin = torch.autograd.grad(dense_weights(x, points, *tensors(grid)[::2]).square().sum(), (x, points))
    result = TetrahedralInterpolation(x).rows(x, points).dense(9).square().sum()
    ours, again = (torch.autograd.grad(result, (x, points), retain_graph=True) for _ in range(2))
    for a, b, c in zip(ours, twin, again, strict=True):
        assert a.abs().max() > 0.1
        torch.testing.assert_close(a, b, rtol=1e-8, atol=1e-8)
        assert torch.equal(a, c)


def test_forward_mode_and_second_derivatives_are_refused():
    x, points = random_set(0)
    grid, position = Tetrahedra.of(x), torch.as_tensor(x).requires_grad_()
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(points, points)
        with pytest.raises(NotImplementedError, match="barycentric weights: forward-mode"):
            barycentric_weights(position, dual, *tensors(grid))
    weight = barycentric_weights(position, points, *tensors(grid))[1]
    (bar,) = torch.autograd.grad(weight.square().sum(), position, create_graph=True)
    with pytest.raises(NotImplementedError, match="barycentric weights: second derivatives"):
        bar.sum().backward()


# The interpolation


def test_connectivity_is_fresh_or_held():
    x, points = random_set(7, 12)
    moved = torch.as_tensor(x + np.random.default_rng(1).normal(size=x.shape) * 0.003)
    fresh, held = TetrahedralInterpolation(x), TetrahedralInterpolation(x, connectivity="held")
    before = held.tetrahedra
    for each in (fresh, held):
        each.rows(moved, points)
    assert (fresh.triangulations, held.triangulations) == (2, 1)
    assert held.tetrahedra is before
    held.retriangulate(moved)
    torch.testing.assert_close(held.rows(moved, points).dense(12), fresh.rows(moved, points).dense(12), rtol=0, atol=1e-10)
    turned = torch.as_tensor(x[::-1].copy())
    held.rows(turned, points)
    assert (held.tetrahedra.volumes(turned.numpy()) > 0).all()


def test_invalid_probes_are_left_out():
    x, points = random_set(1)
    valid = np.random.default_rng(0).random(20) > 0.4
    x[~valid] = np.where(np.arange(3) == 1, 0.5, x[~valid])
    weight = dense(x, points, valid=valid)
    assert not weight[:, ~valid].any()
    torch.testing.assert_close(weight[:, valid], dense(x[valid], points), rtol=0, atol=1e-10)


def test_a_box_of_artificial_probes_holds_the_nearest_probes_content():
    x, _ = random_set(1)
    low, high = np.full(3, -1.0), np.full(3, 2.0)
    corners = np.array(list(itertools.product((-1.0, 2.0), repeat=3)))
    weight = dense(x, np.concatenate([corners, corners * 3, x]), box=(low, high))
    nearest = np.linalg.norm(corners[:, None] - x[None], axis=2).argmin(1)
    for rows in (weight[:8], weight[8:16]):
        torch.testing.assert_close(rows, torch.eye(20, dtype=torch.float64)[nearest], rtol=0, atol=1e-12)
    torch.testing.assert_close(weight[16:], torch.eye(20, dtype=torch.float64), rtol=0, atol=1e-10)
    outside = torch.tensor([[-0.9, 0.4, 0.6]], dtype=torch.float64)
    assert not torch.allclose(dense(x, outside), dense(x, outside, box=(low, high)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"connectivity": "loose"}, "connectivity: expected 'fresh' or 'held', got 'loose'"),
        ({"box": ([0, 0, 0], [1, 1, 0])}, r"box: expected a lower and a higher corner \[3\]"),
    ],
)
def test_bad_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        TetrahedralInterpolation(np.zeros((1, 3)), **options)


def test_bad_arguments_are_named():
    x, points = random_set(0)
    grid = Tetrahedra.of(x)
    position, (vertices, neighbours, hull) = torch.as_tensor(x), tensors(grid)
    bad = [
        ((position, points[:, :2], vertices, neighbours, hull), r"points: expected shape \[n, 3\]"),
        ((position, points, vertices.long(), neighbours, hull), r"vertices: expected int32 of shape \[t, 4\], got torch.int64"),
        ((position[:5], points, vertices, neighbours, hull), r"vertices: expected indices 0\.\.4"),
        ((position, points, vertices, neighbours, hull[:0]), "neighbours: expected indices"),
        ((position, points, vertices[:0], neighbours[:0], hull[:0]), "hull: expected at least one triangle"),
        ((position, points, vertices, neighbours[:3], hull), "neighbours: expected one row for each of"),
    ]
    for arguments, message in bad:
        with pytest.raises(ValueError, match=message):
            barycentric_weights(*arguments)
    with pytest.raises(ValueError, match="start: expected tetrahedra"):
        barycentric_weights(position, points, vertices, neighbours, hull, start=torch.full((60,), 999, dtype=torch.int32))
    with pytest.raises(ValueError, match="position: expected 20 probes, got 19"):
        TetrahedralInterpolation(x).rows(position[:19], points)
