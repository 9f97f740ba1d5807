"""Judgements against closed forms: nothing, a constant, a wall, and the definition itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from placement_tasks import HIGH, LOW, WALL, analytic_task

from difflpv.placement.judge import judge, lookup_rate, point_errors, probe_bytes
from difflpv.probes.gaussian import isotropic_metric
from difflpv.probes.probe_set import DIRECTIONS_26, irradiance_of
from difflpv.probes.reader import ProbeReader
from difflpv.probes.tetrahedra import TetrahedralInterpolation

TETRAHEDRA = ProbeReader()


def linear(x):
    """Radiance SH that is linear in the position: tetrahedra inside their hull reproduce it."""
    base = np.arange(1.0, 10.0)[:, None] * np.array([1.0, 0.5, 0.25])
    return base * (3 + x[..., :1, None] - 0.5 * x[..., 1:2, None])


def corner_probes():
    return np.array([[a, b, c] for a in (LOW[0], HIGH[0]) for b in (LOW[1], HIGH[1]) for c in (LOW[2], HIGH[2])])


@pytest.fixture(scope="module")
def task():
    return analytic_task(wall=False, points=120, radiance=linear)


def test_probes_at_the_points_with_their_truth_have_no_error(task):
    found = judge(task, task.points.numpy(), TETRAHEDRA, task.radiance, timed=False)
    assert found.error < 1e-9 and found.p95 < 1e-9 and found.leak == 0 and found.cut_share == 0
    assert found.count == 120 and found.seconds is None and found.lookups_per_second is None


def test_linear_light_is_exact_and_a_constant_factor_is_known(task):
    """Content times 1 + a: the relative error is a at every point, in every part."""
    x = corner_probes()
    assert judge(task, x, TETRAHEDRA, linear(x), timed=False).error < 1e-12
    surface = task.points[:, 0].numpy() > 0
    found = judge(task, x, TETRAHEDRA, 1.3 * linear(x), surface=surface, seconds=2.0, timed=False)
    for value in (found.error, found.free_error, found.surface_error):
        assert value == pytest.approx(0.3, rel=1e-9)
    assert found.seconds == 2.0
    size = irradiance_of(linear(task.points.numpy()), DIRECTIONS_26)
    expected = 0.3 * np.sqrt((size**2).mean((1, 2)) / (size**2).mean())
    assert found.p95 == pytest.approx(np.percentile(expected, 95), rel=1e-9)
    np.testing.assert_allclose(point_errors(task, x, TETRAHEDRA, 1.3 * linear(x)), expected, rtol=1e-9)


def test_a_constant_offset_of_the_mean_radiance_is_known(task):
    """Radiance c more everywhere: E = pi c more for every normal, c_00 = c sqrt(4 pi)."""
    x, content = corner_probes(), linear(corner_probes())
    content[:, 0] += 2 * np.sqrt(4 * np.pi)
    truth = irradiance_of(task.radiance.numpy(), DIRECTIONS_26)
    expected = 2 * np.pi / np.sqrt((truth**2).mean())
    found = judge(task, x, TETRAHEDRA, content, timed=False)
    assert found.error == pytest.approx(expected, rel=1e-9) and found.p95 == pytest.approx(expected, rel=1e-9)


def test_leak_is_the_error_where_tetrahedra_reach_through_the_wall():
    """The wall fills the box's section: a tetrahedron is cut where it has probes on both sides."""
    task = analytic_task(points=300)
    inner = 0.9 * corner_probes()
    x = np.concatenate([inner, inner * [0.2, 1, 1] + [0.7, 0, 0]])
    content = task.field(torch.as_tensor(x)).numpy()
    found = judge(task, x, TETRAHEDRA, content, timed=False)
    rows = TetrahedralInterpolation(x).rows(torch.as_tensor(x), task.points)
    read = x[rows.probe.numpy()][..., 0]
    cut = (read.min(1) < WALL) & (read.max(1) > WALL)
    assert 0.1 < cut.mean() < 0.9 and found.cut_share == pytest.approx(cut.mean())
    truth = irradiance_of(task.radiance, DIRECTIONS_26).numpy()
    error = irradiance_of(rows.apply(torch.as_tensor(content)), DIRECTIONS_26).numpy() - truth
    assert found.leak == pytest.approx(np.linalg.norm(error[cut]) / np.linalg.norm(truth[cut]), rel=1e-9)
    metric = isotropic_metric(torch.as_tensor(x)).numpy()
    by_footprints = judge(task, x, ProbeReader("gaussian", metric), content, timed=False)
    assert by_footprints.cut_share == found.cut_share and by_footprints.leak != found.leak  # at the same points


def test_weights_of_the_task_do_not_count(task):
    content = linear(corner_probes()) * np.linspace(0.5, 1.5, 8)[:, None, None]
    weighted = replace(task, weight=torch.arange(1.0, 121.0, dtype=torch.float64))
    both = [judge(t, corner_probes(), TETRAHEDRA, content, timed=False) for t in (task, weighted)]
    assert both[0] == both[1] and both[0].error > 0.01


def test_bytes_and_lookups():
    assert probe_bytes(64, TETRAHEDRA) == 64 * 30 * 4
    metric = np.broadcast_to(np.eye(3), (8, 3, 3)).copy()
    assert probe_bytes(8, ProbeReader("gaussian", metric)) == 8 * 39 * 4
    task = analytic_task(wall=False, points=20)
    for reader in (TETRAHEDRA, ProbeReader("gaussian", metric)):
        assert 1e3 < lookup_rate(task, corner_probes(), reader, repeats=1) < 1e10


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position": np.zeros((0, 3))}, "probe position: expected shape"),
        ({"position": np.full((8, 3), np.nan)}, "probe position: expected finite"),
        ({"radiance": np.zeros((8, 9, 6))}, r"probe radiance: expected shape \[8, 9, 3\]"),
        ({"radiance": np.full((8, 9, 3), np.inf)}, "probe radiance: expected finite"),
        ({"surface": np.zeros(3, bool)}, "surface: expected 120 booleans"),
    ],
)
def test_bad_arguments_are_named(change, message, task):
    given = {"position": corner_probes(), "reader": TETRAHEDRA, "radiance": np.zeros((8, 9, 3))} | change
    with pytest.raises(ValueError, match=message):
        judge(task, given.pop("position"), given.pop("reader"), given.pop("radiance"), timed=False, **given)


def test_black_truth_has_no_relative_error(task):
    black = replace(task, radiance=torch.zeros_like(task.radiance))
    with pytest.raises(ValueError, match="black"):
        judge(black, corner_probes(), TETRAHEDRA, np.zeros((8, 9, 3)), timed=False)
