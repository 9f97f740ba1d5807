"""Traced content of probes: closed forms, noise that targets do not share, equal bits."""

import numpy as np
import pytest
from hand_scenes import box_scene, box_walls

from data_gen.load import TargetsError
from data_gen.probe_content import trace_probes
from data_gen.probe_targets import make_probe_targets
from difflpv.lights import apply_light_set
from difflpv.scene import AreaLight, Scene


def test_enclosure_of_equal_radiance_is_constant():
    """Every direction shows L: c_00 = L sqrt(4 pi), the others 0."""
    walls, radiance = box_walls(albedo=(0, 0, 0)), np.array([1.0, 2.0, 0.5])
    furnace = Scene("furnace", walls, tuple(AreaLight(wall.name, radiance) for wall in walls))
    found = trace_probes(furnace, np.random.default_rng(0).uniform(-0.5, 0.5, (5, 3)), component="direct", spp=2048)
    expected = np.zeros((9, 3))
    expected[0] = radiance * np.sqrt(4 * np.pi)
    assert found.mean.shape == (1, 5, 9, 3)
    assert np.abs((found.mean[0] - expected) / np.maximum(found.standard_error[0], 1e-6)).max() < 6


@pytest.fixture(scope="module")
def targets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("content")
    return make_probe_targets(box_scene(), folder, count=12, surface_share=0, cells=2, spp=256, lattice_spp=32, seed=4)


def test_at_target_points_it_is_their_light_with_other_noise(targets):
    found = trace_probes(box_scene(), targets.points, light_sets=targets.light_sets, spp=256, seed=4)
    spread = np.hypot(found.standard_error, targets.standard_error)
    z = (found.mean - targets.radiance)[spread > 0] / spread[spread > 0]
    assert 0.7 < z.std() < 1.4 and abs(z.mean()) < 0.3  # independent: were the numbers shared, it would be 0


def test_light_sets_come_in_order_and_workers_change_no_bit(targets):
    entry = targets.light_sets[0][0]
    sets = [[entry], [entry | {"intensity": [5.0, 1.0, 2.0]}]]
    options = {"light_sets": sets, "spp": 256, "seed": 1}
    found = trace_probes(box_scene(), targets.points, **options)
    alone = trace_probes(apply_light_set(box_scene(), sets[0]), targets.points, spp=256, seed=1)
    np.testing.assert_array_equal(found.mean[0], alone.mean[0])
    per_power = found.mean[:, :, 0].sum(1) / [entry["intensity"], [5.0, 1.0, 2.0]]  # light sets differ in nothing else
    np.testing.assert_allclose(per_power[1], per_power[0], rtol=0.1)
    again = trace_probes(box_scene(), targets.points, workers=2, **options)
    np.testing.assert_array_equal(again.mean, found.mean)


def test_bad_arguments_are_named():
    x = np.zeros((1, 3))
    for change, message in (
        ({"spp": 0}, "spp"), ({"component": "bounce"}, "expected direct"), ({"light_sets": []}, "light_sets")
    ):  # fmt: skip
        with pytest.raises(TargetsError, match=message):
            trace_probes(box_scene(), x, **change)
    for position in (np.zeros((0, 3)), np.full((1, 3), np.nan), np.zeros(3)):
        with pytest.raises(TargetsError, match="probe positions: expected finite"):
            trace_probes(box_scene(), position)
