import numpy as np
import pytest
import torch
from hand_scenes import LIGHT, box_walls, rectangle
from hypothesis import given, settings
from hypothesis import strategies as st

from difflpv.probes.flips import FlipJumps, flip_jumps
from difflpv.probes.inverse_distance import InverseDistanceInterpolation
from difflpv.probes.lookup import probe_irradiance
from difflpv.probes.probe_set import DIRECTIONS_26, irradiance_of
from difflpv.probes.tetrahedra import TetrahedralInterpolation
from difflpv.probes.trilinear import GridInterpolation
from difflpv.probes.visible import Sight, VisibleInterpolation
from difflpv.scene import Scene

SEEDS = st.integers(0, 2**32 - 1)
LOW, HIGH, SHAPE = (-0.8, -0.8, -0.8), (0.8, 0.8, 0.8), (3, 4, 2)


def nodes(shape=SHAPE):
    axes = [np.linspace(a, b, k) for a, b, k in zip(LOW, HIGH, shape, strict=True)]
    return torch.from_numpy(np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3))


def random_points(count, seed, spread=1.8):
    return torch.from_numpy((np.random.default_rng(seed).random((count, 3)) - 0.5) * spread)


def divided_box(hole=0.0):
    """A box of 2 m with a wall of no thickness at x = 0, open for z > 1 - hole."""
    wall = rectangle("wall", (0, -1, -1), (0, 2, 0), (0, 0, 2 - hole))
    return Scene("divided", (*box_walls(), wall), (LIGHT,))


def flips(radiance=None, **options):
    x = nodes().numpy()
    return flip_jumps(x, np.ones((24, 9, 3)) if radiance is None else radiance, x, **options)


def dense(interpolation, position, points):
    return interpolation.rows(position, points).dense(len(position))


def dense_gradcheck(interpolation, position, points):
    inputs = (position.clone().requires_grad_(), points.clone().requires_grad_())
    return torch.autograd.gradcheck(lambda x, p: dense(interpolation, x, p), inputs, check_undefined_grad=False)


# Trilinear


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_grid_reproduces_trilinear_functions_and_is_constant_beyond(seed):
    x, points = nodes(), random_points(30, seed, 2.4)

    def function(p):
        return 1 + p[:, 0] - 2 * p[:, 1] * p[:, 2] + p[:, 0] * p[:, 1] * p[:, 2]

    rows = GridInterpolation(LOW, HIGH, SHAPE).rows(x, points)
    nearest = torch.minimum(torch.maximum(points, points.new_tensor(LOW)), points.new_tensor(HIGH))
    torch.testing.assert_close(rows.apply(function(x)), function(nearest))
    torch.testing.assert_close(rows.weight.sum(1), torch.ones(30, dtype=torch.float64))


def test_displaced_probes_keep_their_nodes_weights():
    x, points = nodes(), random_points(10, 0)
    grid = GridInterpolation(LOW, HIGH, SHAPE)
    assert torch.equal(dense(grid, x + 0.1, points), dense(grid, x, points))
    assert torch.autograd.gradcheck(lambda p: grid.rows(x, p).weight, (points.clone().requires_grad_(),))


def test_nodes_without_a_usable_probe_hold_the_nearest_one():
    valid = np.ones(24, bool)
    valid[5] = False
    weight = dense(GridInterpolation(LOW, HIGH, SHAPE, valid=valid), nodes(), random_points(40, 1, 2.4))
    assert not weight[:, 5].any()
    torch.testing.assert_close(weight.sum(1), torch.ones(40, dtype=torch.float64))
    listed = np.arange(24).reshape(SHAPE)[::-1].copy()
    listed[0, 0, 0] = -1
    turned = GridInterpolation(LOW, HIGH, SHAPE, probe=listed)
    assert dense(turned, nodes(), torch.tensor([HIGH], dtype=torch.float64))[0, 7] == 1  # the last node holds probe 7
    assert dense(turned, nodes(), torch.tensor([LOW], dtype=torch.float64))[0, 16] == 0  # the first one holds a neighbour's


def test_a_flat_grid():
    weight = dense(GridInterpolation(LOW, (0.8, -0.8, 0.8), (2, 1, 3)), nodes((2, 1, 3)), random_points(5, 0))
    torch.testing.assert_close(weight.sum(1), torch.ones(5, dtype=torch.float64))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: GridInterpolation(LOW, HIGH, (3, 0, 2)), r"grid shape: expected three numbers > 0"),
        (lambda: GridInterpolation(HIGH, LOW, SHAPE), "grid corners: expected a lower and a higher one"),
        (lambda: GridInterpolation(LOW, HIGH, SHAPE, probe=np.zeros((2, 2, 2))), r"grid probe: expected shape \[3, 4, 2\]"),
        (lambda: GridInterpolation(LOW, HIGH, SHAPE, valid=np.ones(3, bool)), "grid valid: expected a boolean for each of 24"),
        (lambda: GridInterpolation(LOW, HIGH, SHAPE, valid=np.zeros(24, bool)), "grid: expected at least one node"),
        (lambda: GridInterpolation(LOW, HIGH, SHAPE).rows(nodes()[:3], nodes()), "position: expected at least 24 probes"),
        (lambda: InverseDistanceInterpolation(neighbours=0), "neighbours: expected a number > 0"),
        (lambda: InverseDistanceInterpolation(power=0), "power: expected a number > 0"),
        (lambda: InverseDistanceInterpolation(valid=np.zeros(2, bool)), "probes: expected at least one that is valid"),
        (lambda: InverseDistanceInterpolation().rows(nodes()[:0], nodes()), "position: expected the probes"),
        (lambda: visible(softness=0.0), "softness: expected a length > 0 m"),
        (lambda: visible(resolution=1), "resolution: expected at least 2"),
        (lambda: visible(floor=0.0), "floor: expected a number in"),
        (lambda: flips(length=0.0), "flips: expected a length > 0 m"),
        (lambda: flips(np.zeros((24, 9, 3)), length=0.1), "flips: expected light"),
        (lambda: flips(length=9.0, steps=3), "flips: every step of 9 m"),
    ],
)
def test_bad_arguments_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# Inverse distance


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.integers(1, 12), st.integers(1, 6))
def test_inverse_distance_weights_are_a_partition_and_meet_the_probes(seed, count, neighbours):
    x = random_points(count, seed, 2)
    weight = dense(InverseDistanceInterpolation(neighbours=neighbours), x, torch.cat([random_points(20, seed + 1), x]))
    torch.testing.assert_close(weight.sum(1), torch.ones(20 + count, dtype=torch.float64))
    assert (weight >= 0).all()
    assert ((weight > 0).sum(1) >= min(neighbours, count)).all()
    apart = torch.cdist(x, x) + 9 * torch.eye(count)
    own = weight[20:].diagonal()[apart.amin(1) > 0.1]
    assert (own > 0.99).all()


def test_inverse_distance_is_continuous_where_neighbours_change():
    x = random_points(30, 3, 2)
    inverse = InverseDistanceInterpolation(neighbours=3)
    path = torch.linspace(-0.9, 0.9, 20001, dtype=torch.float64)[:, None] * torch.tensor([[1.0, 0.7, -0.5]])
    weight = dense(inverse, x, path.double())
    assert len(torch.unique((weight > 0).long(), dim=0)) > 10  # neighbours do change on the way
    assert (weight[1:] - weight[:-1]).abs().max() < 0.01  # the step is 1e-4 m; the plain nearest three would jump by 1 / 3


def test_inverse_distance_gradients_and_coincident_probes():
    x, points = random_points(8, 4, 2), random_points(6, 5)
    valid = np.arange(8) != 2
    assert dense_gradcheck(InverseDistanceInterpolation(neighbours=3, power=3.0, valid=valid), x, points)
    assert not dense(InverseDistanceInterpolation(valid=valid), x, points)[:, 2].any()
    same = torch.zeros(5, 3, dtype=torch.float64, requires_grad=True)
    weight = dense(InverseDistanceInterpolation(), same, torch.zeros(1, 3, dtype=torch.float64))
    torch.testing.assert_close(weight, torch.full((1, 5), 0.2, dtype=torch.float64))
    weight.square().sum().backward()
    assert same.grad.isfinite().all()


# Visibility


def eyes(*, hole=0.0, **options):
    return Sight(divided_box(hole), **options)


def visible(inner=None, *, floor=1e-3, **options):
    return VisibleInterpolation(inner or InverseDistanceInterpolation(neighbours=8), eyes(**options), floor=floor)


INNER = {
    "tetrahedra": lambda x: TetrahedralInterpolation(x),
    "grid": lambda x: GridInterpolation(LOW, HIGH, (2, 2, 2)),
    "inverse distance": lambda x: InverseDistanceInterpolation(neighbours=8),
}


@pytest.mark.parametrize("name", INNER)
def test_a_wall_takes_the_weight_of_the_probes_behind_it(name):
    x = nodes((2, 2, 2))
    points = torch.tensor([[-0.3, 0.1, 0.2], [-0.02, -0.4, 0.5], [0.02, 0.3, -0.6]], dtype=torch.float64)
    inner = INNER[name](x)
    before, after = (dense(i, x, points) for i in (inner, visible(inner)))
    behind = (points[:, :1] < 0) != (x[:, 0] < 0)
    assert (before * behind).sum(1).min() > 0.2
    assert (after * behind).sum(1).max() < 0.02
    ratio = after / before
    for row, hidden in zip(ratio, behind, strict=True):  # those in sight keep their proportions
        kept = row[~hidden & row.isfinite()]
        torch.testing.assert_close(kept, kept[:1].expand_as(kept), rtol=1e-6, atol=0)
    torch.testing.assert_close(after.sum(1), torch.ones(3, dtype=torch.float64))


def test_visibility_is_one_before_a_wall_however_slanted_and_softly_ends_behind_it():
    height = torch.tensor([-1e-3, 0.0, 0.02, 0.05], dtype=torch.float64)
    position = torch.stack([height, torch.full_like(height, 0.3), torch.full_like(height, 0.3)], 1)
    points = torch.tensor([[-0.3, -0.5, -0.1]], dtype=torch.float64)  # 19 degrees from the wall
    seen = eyes(softness=0.04).visibility(position, points, torch.tensor([[0, 1, 2, 3]]))[0]
    torch.testing.assert_close(seen, torch.tensor([1.0, 1.0, 0.5, 0.0], dtype=torch.float64), rtol=0, atol=1e-6)


def test_a_receiver_that_sees_no_probe_falls_back():
    x = nodes((2, 2, 2))[4:]  # all on one side
    points = torch.tensor([[-0.5, 0.1, 0.3]], dtype=torch.float64)
    inner = InverseDistanceInterpolation()
    torch.testing.assert_close(dense(visible(inner), x, points), dense(inner, x, points), rtol=1e-6, atol=0)


def test_visibility_changes_smoothly_as_a_probe_passes_an_opening():
    height = torch.linspace(-0.9, 0.9, 4001, dtype=torch.float64)
    position = torch.stack([torch.full_like(height, 0.5), torch.full_like(height, 0.1), height], 1)
    points = torch.tensor([[-0.5, 0.1, 0.4]], dtype=torch.float64)
    seen = eyes(hole=0.8).visibility(position, points, torch.arange(4001)[None])[0]
    assert (seen[0], seen[-1]) == (0, 1)
    assert (seen[1:] - seen[:-1]).abs().max() < 0.02  # in steps of 0.45 mm; a single ray would jump by 1
    middle = height[(seen - 0.5).abs().argmin()]
    assert abs(float(middle) - 0.0) < 0.3  # the line from the receiver over the wall's edge at z = 0.2 ends at z = 0


def test_visibility_gradients():
    rng = np.random.default_rng(0)
    x = torch.from_numpy(rng.uniform(-0.9, 0.9, (10, 3)))
    x[::2, 0] = torch.from_numpy(rng.uniform(0.005, 0.035, 5))  # within the softness behind the wall
    points = torch.from_numpy(rng.uniform(-0.9, -0.2, (6, 3)))
    sight = eyes(hole=0.8, softness=0.05)
    assert dense_gradcheck(VisibleInterpolation(InverseDistanceInterpolation(neighbours=10), sight), x, points)
    x.requires_grad_()
    probe = torch.arange(10).expand(6, 10)
    (bar,) = torch.autograd.grad(sight.visibility(x, points, probe).sum(), x)
    assert (bar[::2, 0] < 0).all()  # back before the wall, more is seen


def test_receivers_look_once_for_each_direction(monkeypatch):
    look, x, points = eyes(), random_points(20, 0), random_points(30, 1)
    sight = VisibleInterpolation(InverseDistanceInterpolation(neighbours=8), look)
    rays = []
    closest = look._raycaster.closest
    monkeypatch.setattr(look._raycaster, "closest", lambda o, d: rays.append(len(o)) or closest(o, d))
    first = dense(sight, x, points)
    assert torch.equal(dense(sight, x, points), first)
    assert 0 < rays[0] <= 30 * 256
    assert rays[1] == 0
    dense(sight, x, points + 0.01)
    assert rays[2] > 0
    at_probe = dense(sight, x, x.clone())
    assert at_probe.isfinite().all()


# Irradiance of rows, and flips


def test_probe_irradiance_is_that_of_the_mixed_radiance():
    rng = np.random.default_rng(0)
    x, points = torch.from_numpy(rng.random((12, 3))), torch.from_numpy(rng.random((26, 3)))
    radiance = torch.from_numpy(rng.normal(size=(12, 9, 6))).requires_grad_()
    rows = TetrahedralInterpolation(x).rows(x.requires_grad_(), points)
    normals = torch.from_numpy(DIRECTIONS_26)
    ours = probe_irradiance(rows, radiance, normals)
    expected = irradiance_of(rows.apply(radiance), DIRECTIONS_26)[torch.arange(26), torch.arange(26)]
    torch.testing.assert_close(ours, expected)
    both = [torch.autograd.grad(e.square().sum(), (x, radiance), retain_graph=True) for e in (ours, expected)]
    for a, b in zip(*both, strict=True):
        torch.testing.assert_close(a, b)
    with pytest.raises(ValueError, match=r"radiance: expected shape \[n,9,C\]"):
        probe_irradiance(rows, radiance[:, :4], normals)


def test_flips_part_motion_from_connectivity():
    rng = np.random.default_rng(2)
    x, points = rng.random((30, 3)), rng.random((300, 3))
    radiance = rng.random((30, 9, 3)) + np.array([3.0] + [0] * 8)[:, None]
    found = flip_jumps(x, radiance, points, length=2e-3, steps=60, seed=1)
    again = flip_jumps(x, radiance, points, length=2e-3, steps=60, seed=1)
    assert np.array_equal(found.jump, again.jump)
    still = found.tetrahedra == 0
    assert 0 < still.sum() < len(still)
    np.testing.assert_allclose(found.jump[still], 0, atol=1e-12)  # nothing jumps where nothing flips
    assert found.jump[~still].max() > 1e-5
    short = flip_jumps(x, radiance, points, length=2e-4, steps=60, seed=1)
    assert short.step[0] == pytest.approx(found.step[0] / 10, rel=0.1)  # motion is smooth, flips are rarer
    assert (short.tetrahedra > 0).mean() < (~still).mean()
    none = FlipJumps(np.zeros(2, int), np.ones(2), np.zeros(2)).summary
    assert (none["flipping_steps"], none["jump_over_step"]) == (0, 0)
    assert found.summary["worst"] >= found.summary["jump_over_step"] > 0


def test_linear_light_has_no_jump():
    rng = np.random.default_rng(3)
    x = np.concatenate([rng.random((20, 3)), np.stack(np.meshgrid(*[[-1.0, 2.0]] * 3), -1).reshape(-1, 3)])
    radiance = np.zeros((28, 9, 3))
    radiance[:, 0] = 5 + x  # any tetrahedra agree on it, as long as it is held at x
    points = torch.from_numpy(rng.random((50, 3)))
    turned = x + rng.normal(size=x.shape) * 1e-3
    grids = [TetrahedralInterpolation(x), TetrahedralInterpolation(turned, connectivity="held")]
    cells = [{tuple(c) for c in g.tetrahedra.vertices.tolist()} for g in grids]
    assert cells[0] != cells[1]
    results = [g.rows(torch.from_numpy(x), points).apply(torch.from_numpy(radiance)) for g in grids]
    torch.testing.assert_close(*results)
