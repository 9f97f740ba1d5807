"""Light in scenes made by hand: fluxes and irradiance against closed forms."""

import math

import numpy as np
import pytest
import torch
from hand_scenes import LIGHT, box_scene, panel_scene, rectangle

from difflpv.config import LpvConfig
from difflpv.grid import Grid
from difflpv.illumination import LightValues, illuminate
from difflpv.scene import AreaLight, DirectionalLight, PointLight, Scene, SpotLight

GRID = Grid((-1.5, -1.5, -1.5), 0.25, (12, 12, 12))
CONFIG = LpvConfig(steps=2)


def lit(scene, component, config=CONFIG, **options):
    return illuminate(scene, GRID, config, component, **({"dtype": torch.float64} | options))


def closed_room(albedo=0.5):
    """An inward box with a small panel under its ceiling."""
    panel = rectangle("panel", (-0.2, 0.9, -0.2), (0.4, 0, 0), (0, 0, 0.4), albedo=(0, 0, 0))
    box = box_scene(albedo=np.full((6, 3), albedo))
    return Scene("room", (*box.meshes, panel), (AreaLight("panel", np.array([3.0, 2.0, 1.0])),))


def test_direct_area_light_carries_pi_times_radiance_times_area():
    vpls = lit(closed_room(), "direct").vpls()
    torch.testing.assert_close(vpls.flux.sum(0), torch.tensor([3.0, 2, 1], dtype=torch.float64) * math.pi * 0.16)
    assert (vpls.normal[:, 1] == -1).all()


def test_first_bounce_of_a_point_light_in_a_closed_box_is_albedo_times_its_flux():
    light = lit(box_scene(albedo=np.full((6, 3), 0.3)), "bounce1")
    expected = 0.3 * 4 * math.pi * torch.as_tensor(LIGHT.intensity)
    torch.testing.assert_close(light.vpls().flux.sum(0), expected, rtol=1e-6, atol=0)
    assert light.samples is None and len(light.rsms) == 1


def test_one_light_that_stands_there_twice_is_two():
    """The same value twice in ``Scene.lights``: each has an intensity of its own, in the bounce as in the direct light."""
    twice = lit(box_scene([LIGHT, LIGHT]), "bounce1", rsm_resolution=8)
    flux = twice.vpls(LightValues(intensity=torch.tensor([1.0, 3.0], dtype=torch.float64))).flux.sum(0)
    once = lit(box_scene(), "bounce1", rsm_resolution=8).vpls().flux.sum(0)
    torch.testing.assert_close(flux, 4 * once)


def test_first_bounce_of_an_area_light_in_a_closed_box_is_albedo_times_its_flux():
    """By 8192 surface points and 64 light samples: 1 %."""
    light = lit(closed_room(0.3), "bounce1")
    expected = 0.3 * math.pi * 0.16 * torch.tensor([3.0, 2, 1], dtype=torch.float64)
    torch.testing.assert_close(light.vpls().flux.sum(0), expected, rtol=1e-2, atol=0)
    assert not light.rsms


def test_punctual_lights_are_exact_in_the_direct_component():
    """E = I cos / d2 for a point light, E cos for a directional one, and shadows."""
    sun = DirectionalLight(np.array([0.0, -1, 0]), np.array([1.0, 1, 1]))
    floor = rectangle("floor", (-2, 0, -2), (0, 0, 4), (4, 0, 0))
    roof = rectangle("roof", (0, 1, -2), (0, 0, 4), (2, 0, 0))
    lamp = PointLight(np.array([-1.0, 2.0, 0]), np.array([5.0, 4, 3]))
    light = lit(Scene("half roof", (floor, roof), (sun, lamp)), "direct")
    position = np.array([[-1.0, 0, 0], [-1, 0, 1], [1.0, 0, 0]])
    receivers = light.receivers(position, np.array([[0.0, 1, 0]] * 3))
    expected = np.array([lamp.intensity / 4 + 1, lamp.intensity * 2 / 5**1.5 + 1, np.zeros(3)])
    np.testing.assert_allclose(light.punctual_irradiance(receivers), expected, rtol=1e-12)
    assert len(light.vpls().flux) == 0  # nothing is left for the volume


def test_where_the_direct_part_belongs():
    bounce = lit(box_scene(), "bounce1")
    receivers = bounce.receivers(np.zeros((1, 3)), np.array([[0.0, 1, 0]]))
    assert receivers.visible is None and bounce.punctual_irradiance(receivers) is None and len(receivers) == 1
    direct = lit(panel_scene(), "direct")
    assert direct.receivers(np.zeros((1, 3)), np.array([[0.0, 1, 0]])).visible is None


def test_values_scale_move_and_recolour():
    light = lit(box_scene(), "bounce1", rsm_resolution=8)
    one = torch.ones(1, dtype=torch.float64)
    base = light.vpls()
    twice = light.vpls(LightValues(intensity=2 * one))
    torch.testing.assert_close(twice.flux, 2 * base.flux)
    red = light.vpls(LightValues(intensity=2 * one, color=torch.tensor([[1.0, 0, 0]], dtype=torch.float64)))
    torch.testing.assert_close(red.flux[:, 0], 2 * base.flux[:, 0])
    assert not red.flux[:, 1:].any()
    black = light.vpls(LightValues(albedo=torch.zeros(6, 3, dtype=torch.float64)))
    assert not black.flux.any()
    same = light.vpls(LightValues(albedo=torch.full((6, 3), 0.5, dtype=torch.float64)))
    torch.testing.assert_close(same.flux, base.flux)


def test_a_moved_area_light_moves_its_samples():
    light = lit(panel_scene(), "direct", area_samples=4)
    moved = light.vpls(LightValues(position=torch.tensor([[0.1, -0.2, 0.3]], dtype=torch.float64)))
    difference = moved.position - light.vpls().position
    torch.testing.assert_close(difference, torch.tensor([[0.1, -0.2, 0.3]], dtype=torch.float64).expand(4, 3))


def test_scales_of_values():
    intensity, color = torch.tensor([2.0, 3.0]), torch.tensor([[1.0, 2, 3], [4, 5, 6]])
    assert LightValues().scale() is None and not LightValues()
    assert torch.equal(LightValues(color=color).scale(), color)
    assert LightValues(intensity=intensity).scale().tolist() == [[2, 2, 2], [3, 3, 3]]
    assert LightValues(intensity=intensity, color=color).scale().tolist() == [[2, 4, 6], [12, 15, 18]]


def test_vpls_of_the_scene_are_shaded_once():
    light = lit(box_scene(), "bounce1", rsm_resolution=8)
    assert light.vpls() is light.vpls(LightValues())


def test_same_seed_same_bits():
    first, again, other = (lit(closed_room(), "bounce1", seed=s, surface_samples=64).vpls() for s in (3, 3, 4))
    assert torch.equal(first.flux, again.flux) and torch.equal(first.position, again.position)
    assert not torch.equal(first.position, other.position)


def test_blockers_from_the_maps_or_from_all_surfaces():
    config = LpvConfig(steps=2, occlusion="exp")
    scene = box_scene()
    walls = lit(scene, "bounce1", config).blocking[0].potential
    maps = lit(scene, "bounce1", config, blockers="rsm").blocking[0].potential
    assert walls.shape == maps.shape and maps.any()
    # the light sees all of the box, so both hold the same area; the maps' surfels have one side only
    degree0 = [p.sum().item() for p in (walls, maps)]
    assert 0.3 < degree0[1] / degree0[0] < 0.7
    direct = lit(scene, "direct", config, blockers="rsm")
    torch.testing.assert_close(direct.blocking[0].potential, maps)
    assert not direct.rsms
    assert lit(scene, "bounce1").blocking[0].potential is None


@pytest.mark.parametrize(
    ("component", "options", "message"),
    [
        ("bounce2", {}, "component: expected 'direct' or 'bounce1', got 'bounce2'"),
        ("direct", {"blockers": "all"}, "blockers: expected 'surface' or 'rsm', got 'all'"),
        ("direct", {"blockers": "rsm"}, "blockers: 'rsm' needs a point, spot or directional light; use 'surface'"),
    ],
)
def test_messages(component, options, message):
    with pytest.raises(ValueError, match=message):
        lit(panel_scene(), component, LpvConfig(occlusion="exp"), **options)


def test_mixed_lights_keep_their_order():
    """Power of light 1 is scaled by entry 1 of the intensities, whatever is an RSM and what a surface sample."""
    spot = SpotLight(np.array([0.5, 0.5, 0.0]), np.array([0.0, -1, 0]), np.array([1.0, 1, 1]))
    room = closed_room()
    mixed = room.with_lights([LIGHT, room.lights[0], spot])
    light = lit(mixed, "bounce1", rsm_resolution=16, surface_samples=256)
    parts = []
    for k in range(3):
        only = torch.zeros(3, dtype=torch.float64)
        only[k] = 1
        parts.append(light.vpls(LightValues(intensity=only)).flux.sum(0))
    alone = [
        lit(room.with_lights([one]), "bounce1", rsm_resolution=16, surface_samples=256).vpls().flux.sum(0)
        for one in mixed.lights
    ]
    for part, expected in zip(parts, alone, strict=True):
        torch.testing.assert_close(part, expected, rtol=1e-9, atol=0)
