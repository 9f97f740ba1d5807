"""The ``Lpv`` module: what it accepts, what it reports, and how it fails."""

import numpy as np
import pytest
import torch
from hand_scenes import box_scene, panel_scene

from difflpv.config import LpvConfig
from difflpv.grid import Grid
from difflpv.illumination import illuminate
from difflpv.pipeline import Lpv

GRID = Grid((-1.33, -1.27, -1.41), 0.39, (7, 7, 7))
POSITION, NORMAL = np.array([[0.31, -1.0, 0.22], [-1.0, 0.17, -0.35]]), np.array([[0.0, 1, 0], [1, 0, 0]])


def solved(config, *, scene=None, component="bounce1", grid=GRID, **options):
    scene = scene or box_scene()
    light = illuminate(scene, grid, config, component, rsm_resolution=8, surface_samples=64)
    lpv = Lpv(grid, config, scene=scene, **options)
    return lpv, light, light.receivers(POSITION, NORMAL)


def test_switching_a_learnable_on_changes_nothing():
    config = LpvConfig(steps=3, occlusion="exp", deposit="trilinear")
    names = ["propagation", "propagation_steps", "occlusion", "sampling_bias", "injection_bias", "light_color", "albedo"]
    plain, light, receivers = solved(config)
    learning = Lpv(GRID, config, learn=names, scene=light.scene)
    torch.testing.assert_close(learning(light, receivers), plain(light, receivers), rtol=1e-5, atol=0)
    assert learning.learned == tuple(names) and not list(plain.parameters())
    assert {n for n, _ in learning.named_parameters()} == {f"raw_{n}" for n in names}


def test_given_values_take_the_place_of_its_own():
    lpv, light, receivers = solved(LpvConfig(steps=3), learn=["propagation"])
    half = {"propagation": torch.tensor(0.5, dtype=torch.float64)}
    given = lpv(light, receivers, half)
    assert not torch.equal(given, lpv(light, receivers))
    lpv.set_values(half)
    torch.testing.assert_close(lpv(light, receivers), given, rtol=1e-6, atol=0)


def test_values_on_their_bounds_are_put_just_inside():
    lpv = Lpv(GRID, LpvConfig(steps=3), learn=["propagation", "sampling_bias"])
    ends = {"propagation": torch.tensor(0.0, dtype=torch.float64), "sampling_bias": torch.tensor(2.0, dtype=torch.float64)}
    lpv.set_values(ends)
    assert 0 < lpv.values()["propagation"].item() < 1e-5 and 2 > lpv.values()["sampling_bias"].item() > 2 - 1e-5


def test_no_step_is_the_injected_volume():
    """Without propagation a receiver sees only the VPLs next to it."""
    lpv, light, receivers = solved(LpvConfig(steps=0))
    assert lpv(light, receivers).shape == (2, 3)
    volume = lpv.accumulate(light)
    flux = volume[:, 0].sum((1, 2, 3)) * 2 * np.sqrt(np.pi)
    torch.testing.assert_close(flux, light.vpls().flux.sum(0), rtol=1e-5, atol=0)


def test_report_of_lost_light():
    """Half of the panel's samples lie outside a grid that ends at x = 0."""
    half = Grid((-0.8, -0.2, -0.6), 0.2, (4, 8, 6))
    config = LpvConfig(steps=1)
    lpv, light, receivers = solved(config, scene=panel_scene(), component="direct", grid=half)
    lpv(light, receivers)
    assert int(lpv.report.lost_count) == 32 and float(lpv.report.lost_share) == pytest.approx(0.5)


def test_an_illumination_of_another_grid_or_without_occlusion():
    lpv, light, receivers = solved(LpvConfig(steps=2))
    with pytest.raises(ValueError, match=r"illumination: expected one made for Grid\(minimum=.*got Grid"):
        Lpv(Grid((0.0, 0, 0), 1.0, (3, 3, 3)), lpv.config)(light, receivers)
    with pytest.raises(ValueError, match="illumination: made without occlusion, this solve needs 'exp'"):
        Lpv(GRID, LpvConfig(steps=2, occlusion="exp"))(light, receivers)


def test_a_propagation_factor_far_beyond_its_critical_value():
    lpv, light, receivers = solved(LpvConfig(steps=500), learn=["propagation"], initial={"propagation": 1.9})
    with pytest.raises(
        FloatingPointError,
        match="the propagation factor 1.9 lies beyond its critical value 1, so 500 steps overflow; lower it or take fewer",
    ):
        lpv(light, receivers)


def test_other_overflows_name_the_values():
    fine = Grid((-1.33, -1.27, -1.41), 0.1, (28, 28, 28))
    lpv, light, _ = solved(LpvConfig(steps=1), grid=fine)
    vpls = light.vpls()
    receivers = light.receivers(vpls.position + 0.1 * vpls.normal, -vpls.normal)  # lit from the wall behind
    values = {"light_intensity": torch.tensor([8e37]), "albedo": torch.full((6, 3), 0.9)}
    with pytest.raises(FloatingPointError, match=r"not finite: check the values .*light_intensity = 8e\+37, albedo = 0.9"):
        lpv(light, receivers, values)


def test_a_torch_optimiser_moves_it():
    lpv, light, receivers = solved(LpvConfig(steps=3), learn=["propagation"])
    optimizer = torch.optim.SGD(lpv.parameters(), lr=0.5)
    losses = []
    for _ in range(3):
        loss = lpv(light, receivers).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[0] > losses[1] > losses[2]
