"""Gaussian footprints against their dense twin, at cut-offs and ties, and where sets of probes are degenerate."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hand_scenes import LIGHT, box_walls, rectangle
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from difflpv.probes.footprints import nearest_footprints
from difflpv.probes.gaussian import GaussianInterpolation, isotropic_metric
from difflpv.probes.reader import ProbeReader
from difflpv.probes.tetrahedra import TetrahedralInterpolation
from difflpv.probes.visible import Sight, VisibleInterpolation
from difflpv.reference.gaussian import dense_footprint_weights
from difflpv.reference.gaussian import nearest_footprints as reference_footprints
from difflpv.scene import Scene

SEEDS = st.integers(0, 2**32 - 1)


def footprints(count, seed, points=40):
    """Probes in the unit box, matrices that are neither symmetric nor round, and points around the box."""
    rng = np.random.default_rng(seed)
    x = torch.from_numpy(rng.random((count, 3)))
    metric = isotropic_metric(x) + torch.from_numpy(rng.normal(size=(count, 3, 3)))
    return x, metric, torch.from_numpy(rng.uniform(-0.2, 1.2, (points, 3)))


def dense(position, metric, points, neighbours=8):
    return GaussianInterpolation(metric, neighbours=neighbours).rows(position, points).dense(len(position))


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.integers(1, 40), st.integers(1, 20))
def test_weights_are_the_twins_and_sum_to_one(seed, count, neighbours):
    x, metric, points = footprints(count, seed)
    rows = GaussianInterpolation(metric, neighbours=neighbours).rows(x, points)
    assert rows.probe.shape == (40, min(count, neighbours))
    assert rows.weight.min() >= 0
    weight = rows.dense(count)
    torch.testing.assert_close(weight.sum(1), torch.ones(40, dtype=torch.float64))
    torch.testing.assert_close(weight, dense_footprint_weights(x, metric, points, neighbours), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(rows.apply(torch.full((count, 2), 7.0, dtype=torch.float64)), torch.full((40, 2), 7.0).double())
    single = dense(x.float(), metric.float(), points.float(), neighbours)
    torch.testing.assert_close(single.double(), weight, rtol=0, atol=2e-4)


def test_probes_that_are_all_read_share_by_a_softmax():
    x, metric, points = footprints(5, 0)
    distance = np.einsum("nij,mnj->mni", metric.numpy(), points.numpy()[:, None] - x.numpy())
    share = np.exp(-(distance**2).sum(-1) / 2)
    np.testing.assert_allclose(dense(x, metric, points).numpy(), share / share.sum(1, keepdims=True), rtol=1e-9)


def test_a_footprint_that_is_flat_along_a_wall_ends_at_it():
    x = torch.tensor([[-0.1, 0, 0], [0.1, 0, 0]], dtype=torch.float64)
    metric = torch.diag(torch.tensor([60.0, 1.0, 1.0], dtype=torch.float64)).expand(2, 3, 3)
    points = torch.tensor([[-0.1, 3.0, 0], [0.05, -2.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(dense(x, metric, points), torch.eye(2, dtype=torch.float64), rtol=0, atol=1e-6)


@pytest.mark.parametrize("count", [3, 12])
def test_gradients_in_positions_metrics_and_points(count):
    x, metric, points = footprints(count, 3, points=5)
    inputs = tuple(t.clone().requires_grad_() for t in (x, metric, points))
    assert torch.autograd.gradcheck(lambda p, m, q: dense(p, m, q, 4), inputs)
    ours = torch.autograd.grad(dense(*inputs, 4).square().sum(), inputs)
    twins = torch.autograd.grad(dense_footprint_weights(*inputs, 4).square().sum(), inputs)
    for a, b in zip(ours, twins, strict=True):
        torch.testing.assert_close(a, b)


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.integers(3, 6))
def test_weights_have_no_jump_where_the_neighbours_change(seed, neighbours):
    rng = np.random.default_rng(seed)
    x, metric, _ = footprints(15, seed)
    start, end = torch.from_numpy(rng.uniform(-0.2, 1.2, (2, 3)))
    reader = GaussianInterpolation(metric, neighbours=neighbours)

    def at(share):
        rows = reader.rows(x, start + (end - start) * share[:, None])
        return rows.probe.sort(1).values, rows.dense(15)

    share = torch.linspace(0, 1, 401, dtype=torch.float64)
    read = at(share)[0]
    changes = (read[1:] != read[:-1]).any(1)
    assume(bool(changes.any()))
    low, high = share[:-1][changes], share[1:][changes]
    before = read[:-1][changes]
    for _ in range(45):  # down to rounding: whatever is left is a jump
        middle = (low + high) / 2
        same = (at(middle)[0] == before).all(1)
        low, high = torch.where(same, middle, low), torch.where(same, high, middle)
    assert (at(high)[0] != before).any(1).all()
    torch.testing.assert_close(at(low)[1], at(high)[1], rtol=0, atol=1e-5)


def test_the_neighbour_that_drops_out_has_lost_its_weight():
    x = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]], dtype=torch.float64)
    metric = torch.eye(3, dtype=torch.float64).expand(3, 3, 3)
    sides = torch.tensor([[1 - 1e-7, 0, 0], [1 + 1e-7, 0, 0]], dtype=torch.float64)
    before, after = dense(x, metric, sides, 2)
    assert before[2] == 0
    assert after[0] == 0  # another probe is left out on either side
    torch.testing.assert_close(before, after, rtol=0, atol=1e-6)


LINE = torch.linspace(0, 1, 12, dtype=torch.float64)
DEGENERATE = {
    "single": torch.tensor([[0.3, 0.4, 0.5]], dtype=torch.float64),
    "duplicates": torch.full((12, 3), 0.5, dtype=torch.float64),
    "pairs": torch.linspace(0, 1, 6, dtype=torch.float64).repeat(2)[:, None].expand(12, 3),
    "line": torch.stack([LINE, 0 * LINE, 0 * LINE], 1),
    "plane": torch.stack([LINE, LINE.flip(0) ** 2, 0 * LINE], 1),
    # Its centre, which is one of the points, is equally far from all.
    "sphere": torch.nn.functional.normalize(torch.randn(12, 3, dtype=torch.float64, generator=torch.manual_seed(0)), dim=1),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_probes_have_finite_weights_and_gradients(name):
    x = DEGENERATE[name].clone().requires_grad_()
    metric = torch.eye(3, dtype=torch.float64).repeat(len(x), 1, 1).requires_grad_()
    points = torch.cat([torch.zeros(1, 3), torch.full((1, 3), 0.5), torch.rand(5, 3), torch.full((1, 3), 1e3)]).double()
    points.requires_grad_()
    weight = dense(x, metric, points, 4)
    torch.testing.assert_close(weight.sum(1), torch.ones(8, dtype=torch.float64))
    weight.square().sum().backward()
    assert all(t.grad.isfinite().all() for t in (x, metric, points))
    assert isotropic_metric(x.detach()).isfinite().all()


def test_probes_in_one_place_with_one_footprint_share_alike():
    x = DEGENERATE["duplicates"][:4]
    metric = torch.eye(3, dtype=torch.float64).repeat(4, 1, 1)
    torch.testing.assert_close(dense(x, metric, torch.rand(5, 3).double()), torch.full((5, 4), 0.25, dtype=torch.float64))
    x = DEGENERATE["duplicates"]  # more of them than are read: each that is read counts the same
    rows = GaussianInterpolation(metric[:1].repeat(12, 1, 1), neighbours=4).rows(x, torch.rand(5, 3).double())
    torch.testing.assert_close(rows.weight, torch.full((5, 4), 0.25, dtype=torch.float64))


def test_round_footprints_are_as_wide_as_the_probes_are_apart():
    x = torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [0.5, 0, 2.0], [0.5, 0, 2.0]], dtype=torch.float64)
    expected = torch.eye(3, dtype=torch.float64) / (0.5 * torch.tensor([0.5, 0.5, 0.5, 0.5]).double())[:, None, None]
    torch.testing.assert_close(isotropic_metric(x, width=0.5), expected)
    torch.testing.assert_close(isotropic_metric(x[1:3], width=0.5), expected[:2] / 4)


def test_no_points_and_bad_arguments():
    x, metric, points = footprints(4, 0)
    assert GaussianInterpolation(metric).rows(x, points[:0]).weight.shape == (0, 4)
    with pytest.raises(ValueError, match=r"metric: expected shape \[n,3,3\] with n > 0, got \[4, 3\]"):
        GaussianInterpolation(metric[:, 0])
    with pytest.raises(ValueError, match="metric: expected finite numbers"):
        GaussianInterpolation(metric * torch.nan)
    with pytest.raises(ValueError, match="neighbours: expected a number > 0, got 0"):
        GaussianInterpolation(metric, neighbours=0)
    with pytest.raises(ValueError, match="position: expected 4 probes, got 3"):
        GaussianInterpolation(metric).rows(x[:3], points)
    with pytest.raises(ValueError, match="points: expected finite numbers"):
        GaussianInterpolation(metric).rows(x, points * torch.nan)


# The kernel


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("count", "wanted"), [(1, 1), (9, 9), (60, 9), (300, 16), (60, 17)])
def test_nearest_are_the_twins_whether_points_come_in_cells_or_not(count, wanted, dtype):
    x, metric, points = footprints(count, 5, points=3000)
    points[:, 1] *= 0.2
    inputs = [t.to(dtype) for t in (x, metric, points)]
    near, distance = nearest_footprints(*inputs, wanted)
    expected = reference_footprints(x, metric, points, wanted)[1].to(dtype)
    tolerance = {"rtol": 1e-3, "atol": 1e-4} if dtype is torch.float32 else {"rtol": 1e-11, "atol": 1e-11}
    torch.testing.assert_close(distance, expected, **tolerance)
    assert (near.sort(1).values.diff(dim=1) > 0).all()  # nobody twice
    own = torch.einsum("mkij,mkj->mki", inputs[1][near], inputs[2][:, None] - inputs[0][near]).square().sum(-1)
    torch.testing.assert_close(distance, own, **tolerance)
    assert (distance.diff(dim=1) >= 0).all()
    one_by_one = [nearest_footprints(*inputs[:2], part, wanted) for part in inputs[2].split(100)]  # too few for cells
    assert torch.equal(near, torch.cat([part[0] for part in one_by_one]))
    assert torch.equal(distance, torch.cat([part[1] for part in one_by_one]))


@settings(max_examples=25, deadline=None)
@given(
    SEEDS, st.sampled_from([torch.float32, torch.float64]), st.floats(-3, 4), st.floats(-3, 5), st.sampled_from([0, 1, 2, 3])
)
def test_no_result_depends_on_the_cells(seed, dtype, stretch, away, flat):
    rng = np.random.default_rng(seed)
    x = rng.random((40, 3)) + 10**away
    x[:10] = x[10:20]  # ties, which the first ones win
    metric = np.linalg.qr(rng.normal(size=(40, 3, 3)))[0] * rng.choice([1.0, 10**stretch], (40, 3, 1))
    metric[:5] = metric[10:15]
    points = rng.uniform(-0.5, 1.5, (600, 3)) + 10**away
    points[:, :flat] = points[0, :flat]
    inputs = [torch.as_tensor(t, dtype=dtype) for t in (x, metric)]
    read = torch.as_tensor(points, dtype=dtype)
    together = nearest_footprints(*inputs, read, 5)
    parts = [nearest_footprints(*inputs, part, 5) for part in read.split(60)]
    for a, b in zip(together, zip(*parts, strict=True), strict=True):
        assert torch.equal(a, torch.cat(b))


def test_what_is_beyond_the_range_of_numbers_is_far():
    x, metric, points = footprints(4, 0)
    near, distance = nearest_footprints(x.float(), 1e25 * metric.float(), points.float(), 3)
    assert torch.equal(distance, torch.full((40, 3), 1e30))
    assert torch.equal(near, torch.arange(3, dtype=torch.int32).expand(40, 3))
    weight = GaussianInterpolation(1e25 * metric.float(), neighbours=3).rows(x.float(), points.float()).weight
    torch.testing.assert_close(weight, torch.full((40, 3), 1 / 3))


def test_views_are_read_and_gradients_come_again():
    x, metric, points = footprints(12, 1)
    expected = nearest_footprints(x, metric, points, 3)[1]
    views = x.T.contiguous().T, metric.mT.contiguous().mT, points.repeat_interleave(2, 0)[::2]
    inputs = tuple(t.requires_grad_() for t in views)
    found = nearest_footprints(*inputs, 3)[1]
    assert torch.equal(found, expected)
    loss = found.square().sum()
    first = torch.autograd.grad(loss, inputs, retain_graph=True)
    for a, b in zip(first, torch.autograd.grad(loss, inputs), strict=True):
        assert torch.equal(a, b)
    (bar,) = torch.autograd.grad(nearest_footprints(*inputs, 3)[1].square().sum(), inputs[0], create_graph=True)
    with pytest.raises(NotImplementedError, match="nearest footprints: second derivatives are not supported"):
        bar.sum().backward()
    torch.library.opcheck(torch.ops.difflpv.footprints, (x, metric, points, 3))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda x, m, p: nearest_footprints(x, m, p, 0), "count: expected 1 to 4 probes, got 0"),
        (lambda x, m, p: nearest_footprints(x, m, p, 5), "count: expected 1 to 4 probes, got 5"),
        (lambda x, m, p: nearest_footprints(x, m[:3], p, 1), r"metric: expected shape \[4, 3, 3\], got \[3, 3, 3\]"),
        (lambda x, m, p: nearest_footprints(x, m * torch.inf, p, 1), "metric: expected finite numbers"),
        (lambda x, m, p: nearest_footprints(x[:, :2], m, p, 1), r"position: expected shape \[n, 3\], got \[4, 2\]"),
    ],
)
def test_bad_arguments_of_nearest_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(*footprints(4, 0))


# How a set of probes is read


def divided_box():
    """A box of 2 m with a wall of no thickness at x = 0."""
    return Scene("divided", (*box_walls(), rectangle("wall", (0, -1, -1), (0, 2, 0), (0, 0, 2))), (LIGHT,))


def test_readers_make_the_interpolation_that_they_name():
    x, metric, points = footprints(12, 1)
    scene = divided_box()
    by_cells, plain = ProbeReader().over(x.numpy(), scene), TetrahedralInterpolation(x)
    assert isinstance(by_cells, TetrahedralInterpolation)
    assert torch.equal(by_cells.rows(x, points).weight, plain.rows(x, points).weight)
    by_footprints = ProbeReader("gaussian", metric.numpy(), neighbours=3).over(x.numpy(), scene)
    assert torch.equal(by_footprints.rows(x, points).dense(12), dense(x, metric, points, 3))


def test_readers_of_some_probes_keep_their_footprints():
    metric = np.random.default_rng(0).normal(size=(4, 3, 3))
    reader = ProbeReader("gaussian", metric, neighbours=3, sight=True)
    kept = reader.kept(np.array([True, False, True, False]))
    np.testing.assert_array_equal(kept.metric, metric[::2])
    assert (kept.neighbours, kept.sight, kept.described) == (3, True, "Gaussian footprints of 3 neighbours, weighted by sight")
    assert ProbeReader(sight=True).kept(np.array([0])).described == "tetrahedra, weighted by sight"
    metric[0] = 7  # the reader has its own
    assert reader.metric[0, 0, 0] != 7


def test_readers_with_sight_read_nothing_through_a_wall():
    rng = np.random.default_rng(0)
    x = rng.uniform(-0.9, 0.9, (10, 3))
    points = torch.from_numpy(rng.uniform(0.1, 0.9, (20, 3)))
    metric = isotropic_metric(torch.from_numpy(x), width=2).numpy()
    behind = torch.from_numpy(x[:, 0] < 0)
    for sight, low, high in ((False, 0.1, 1), (True, 0, 0.02)):
        reader = ProbeReader("gaussian", metric, sight=sight).over(x, divided_box())
        through = reader.rows(torch.from_numpy(x), points).dense(10)[:, behind].sum(1)
        assert low <= through.max() <= high


def test_eyes_over_another_interpolation_share_what_was_seen(monkeypatch):
    x, metric, _ = footprints(10, 2)
    points = torch.from_numpy(np.random.default_rng(3).uniform(-0.8, 0.8, (15, 3)))
    eyes = Sight(divided_box())
    sight = VisibleInterpolation(GaussianInterpolation(metric), eyes)
    rays = []
    closest = eyes._raycaster.closest
    monkeypatch.setattr(eyes._raycaster, "closest", lambda o, d: rays.append(len(o)) or closest(o, d))
    sight.rows(x, points)
    other = VisibleInterpolation(GaussianInterpolation(metric * 1.5), eyes)
    assert torch.equal(other.rows(x, points).weight, VisibleInterpolation(
        GaussianInterpolation(metric * 1.5), Sight(divided_box())).rows(x, points).weight)  # fmt: skip
    assert rays[0] > 0
    assert sum(rays[1:]) < 0.5 * rays[0]  # only for probes that the first one did not read
    before = len(rays)
    sight.rows(x, points)
    assert sum(rays[before:]) == 0
    assert isinstance(sight._inner, GaussianInterpolation)
    assert sight._inner.metric is metric


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda m: ProbeReader("trilinear"), "interpolation: expected tetrahedra or gaussian, got 'trilinear'"),
        (lambda m: ProbeReader("gaussian"), "metric: expected one a probe with gaussian footprints"),
        (lambda m: ProbeReader("tetrahedra", m), "none with tetrahedra"),
        (lambda m: ProbeReader("gaussian", m[0]), r"metric: expected shape \[n,3,3\] with n > 0, got \[3, 3\]"),
        (lambda m: ProbeReader("gaussian", m * np.nan), "metric: expected finite numbers"),
        (lambda m: ProbeReader("gaussian", m, sight=1), "sight: expected True or False, got 1"),
        (lambda m: ProbeReader("gaussian", m, neighbours=2.5), "neighbours: expected a whole number > 0, got 2.5"),
        (lambda m: ProbeReader("gaussian", m, neighbours=0), "neighbours: expected a whole number > 0, got 0"),
    ],
)
def test_readers_check_themselves(make, message):
    with pytest.raises(ValueError, match=message):
        make(np.eye(3)[None])
