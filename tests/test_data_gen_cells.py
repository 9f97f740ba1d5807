import math
from dataclasses import replace

import numpy as np
import pytest
from hand_scenes import box_scene, panel_scene

from data_gen.cells import find_volume, kept_volume, kept_volumes, trace_volume
from difflpv.grid import Grid

GRID = Grid((-0.6, 0.2, -0.6), 0.4, (3, 2, 3))


def panel_solid_angle(x):
    """Of panel_scene's 1 x 0.6 m rectangle at y = 1 from points [n,3] below it [sr]."""
    d = 1.0 - x[:, 1]

    def corner(a, b):
        return np.arctan2(a * b, d * np.sqrt(a * a + b * b + d * d))

    low_x, high_x, low_z, high_z = -0.5 - x[:, 0], 0.5 - x[:, 0], -0.3 - x[:, 2], 0.3 - x[:, 2]
    return corner(high_x, high_z) - corner(low_x, high_z) - corner(high_x, low_z) + corner(low_x, low_z)


def test_fluence_of_a_panel_against_its_solid_angle():
    """c_00 = Y_00 times the integral of radiance over directions = Y_00 L Omega; below the panel all of it travels down."""
    true = trace_volume(panel_scene(), GRID, "direct", spp=4096)
    volume = true.mean
    assert volume.shape == (3, 9, *GRID.shape)
    omega = panel_solid_angle(GRID.cell_centers().reshape(-1, 3)).reshape(GRID.shape)
    radiance = np.array([5.0, 3.0, 1.0])[:, None, None, None]
    expected = 0.4**2 * 0.5 / math.sqrt(math.pi) * radiance * omega
    np.testing.assert_allclose(volume[:, 0], expected, rtol=0.02)
    assert (volume[:, 1] < 0).all()  # Y_1-1 = y: the light travels towards -y
    z = (volume[:, 0] - expected) / (np.abs(true.halves[0] - true.halves[1])[:, 0] / 2).mean((1, 2, 3), keepdims=True)
    assert 0.3 < np.sqrt((z**2).mean()) < 3  # the halves tell the noise


def test_punctual_lights_are_left_to_the_exact_part_and_seeds_repeat():
    assert not trace_volume(box_scene(), GRID, "direct").mean.any()
    first, again = (trace_volume(box_scene(), GRID, "bounce1", spp=32, seed=3).mean for _ in range(2))
    assert np.array_equal(first, again) and first[:, 0].min() > 0
    with pytest.raises(ValueError, match="component 'bounce'"):
        trace_volume(box_scene(), GRID, "bounce")


def test_a_volume_is_traced_once_and_known_by_scene_lights_grid_and_component(tmp_path, monkeypatch):
    scene = box_scene()
    made = kept_volume(tmp_path, scene, GRID, "bounce1", spp=32, seed=3)
    assert np.allclose(made.halves, trace_volume(scene, GRID, "bounce1", spp=32, seed=3).halves, rtol=1e-6)
    assert kept_volume(tmp_path, scene, GRID, "bounce1", spp=64, seed=3).spp == 64  # asked for by number: made anew
    monkeypatch.setattr("data_gen.cells.trace_volume", None)
    again = kept_volume(tmp_path, scene, GRID, "bounce1")
    assert again.spp == 64 and np.array_equal(again.halves, find_volume(tmp_path, scene, GRID, "bounce1").halves)
    finer = Grid(GRID.minimum, 0.3, GRID.resolution)
    for other in ((_dimmer(scene), GRID, "bounce1"), (scene, GRID, "direct"), (scene, finer, "bounce1")):
        assert find_volume(tmp_path, *other) is None
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:200])
    assert find_volume(tmp_path, scene, GRID, "bounce1") is None


def _dimmer(scene):
    return replace(scene, lights=tuple(replace(light, intensity=light.intensity / 2) for light in scene.lights))


def test_any_number_of_workers_gives_the_same_bits(tmp_path):
    scenes = [box_scene(), _dimmer(box_scene())]
    one, two = (kept_volumes(tmp_path / str(k), scenes, GRID, "bounce1", spp=32, seed=1, workers=k) for k in (1, 2))
    assert one[1].mean.sum() < 0.6 * one[0].mean.sum()
    assert all(np.array_equal(a.halves, b.halves) for a, b in zip(one, two, strict=True))
