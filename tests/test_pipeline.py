"""The ``Lpv`` module: what it accepts, what it reports, and how it fails."""

import numpy as np
import pytest
import torch
from hand_scenes import box_scene, panel_scene

from difflpv.config import LpvConfig
from difflpv.grid import Grid
from difflpv.illumination import illuminate
from difflpv.pipeline import Lpv
from difflpv.propagation import propagate
from difflpv.scene import PointLight

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


@pytest.mark.parametrize("name", ["propogation", "stencil"])
def test_values_of_nothing_are_refused(name):
    """A misspelt one would change nothing, and so would a stencil's numbers where none is learned."""
    lpv, light, receivers = solved(LpvConfig(method="learned_4x6", steps=3), learn=["propagation"])
    with pytest.raises(ValueError, match=f"values: expected names of learnables .*, got '{name}'"):
        lpv(light, receivers, {name: torch.zeros((), dtype=torch.float64)})


def test_values_on_their_bounds_are_put_just_inside():
    lpv = Lpv(GRID, LpvConfig(steps=3), learn=["propagation", "sampling_bias"])
    ends = {"propagation": torch.tensor(0.0, dtype=torch.float64), "sampling_bias": torch.tensor(2.0, dtype=torch.float64)}
    lpv.set_values(ends)
    assert 0 < lpv.values()["propagation"].item() < 1e-5 and 2 > lpv.values()["sampling_bias"].item() > 2 - 1e-5


def test_it_moves_to_another_device():
    """Without a GPU, torch's device without memory tells as well."""
    lpv = Lpv(GRID, LpvConfig(steps=3), learn=["propagation_steps", "light_color", "albedo"], scene=box_scene())
    assert {value.device.type for value in lpv.to("meta").values().values()} == {"meta"}


def test_no_step_is_the_injected_volume():
    """Without propagation a receiver sees only the VPLs next to it."""
    lpv, light, receivers = solved(LpvConfig(steps=0))
    assert lpv(light, receivers).shape == (2, 3)
    (volume,) = lpv.accumulate(light)
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
    message = "illumination: made for 'holpv' with occlusion 'none' on 1 grid.*, this solve needs 'holpv' with 'exp'"
    with pytest.raises(ValueError, match=message):
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


def test_two_cell_sizes_read_both_grids_and_carry_the_rest_on():
    """After 2 of 5 steps light goes on in cells of twice the edge: the two solves put together by hand."""
    config = LpvConfig(method="learned_4x6", steps=5, coarsen_after=2)
    lpv, light, receivers = solved(config)
    fine, coarse = lpv.accumulate(light)
    assert coarse.shape[2:] == tuple(-(-n // 2) for n in fine.shape[2:])
    one, two = (
        Lpv(GRID, LpvConfig(method="learned_4x6", steps=n)).accumulate(light)[0] for n in (1, 2)
    )
    moving = two - one
    torch.testing.assert_close(fine, one, rtol=1e-5, atol=1e-6 * float(one.abs().max()))
    padded = torch.nn.functional.pad(moving, [v for n in reversed(moving.shape[2:]) for v in (0, n % 2)])
    sums = sum(padded[:, :, i::2, j::2, k::2] for i in (0, 1) for j in (0, 1) for k in (0, 1))
    rest = Lpv(GRID.coarser(), LpvConfig(method="learned_4x6", steps=3))
    again = illuminate(light.scene, GRID.coarser(), rest.config, light.component)
    expected = propagate(
        sums, rest.config.stencil, steps=3, transmittance=again.blocking[0].passed, occlude_first_step=True
    )
    torch.testing.assert_close(coarse, expected, rtol=1e-5, atol=1e-7)
    seen = [Lpv(GRID, LpvConfig(method="learned_4x6", steps=1)).read((fine,), receivers)]
    seen.append(rest.read((coarse,), again.receivers(receivers.position, receivers.normal)))
    torch.testing.assert_close(lpv(light, receivers), sum(seen), rtol=1e-4, atol=1e-6)


def test_two_cell_sizes_without_steps_left_are_one():
    config = LpvConfig(method="learned_4x6", steps=3)
    lpv, light, receivers = solved(config)
    same = Lpv(GRID, LpvConfig(method="learned_4x6", steps=3, coarsen_after=3))
    assert torch.equal(same(light, receivers), lpv(light, receivers))
    with pytest.raises(ValueError, match="on 1 grid.*this solve needs 'learned_4x6' with 'traced' on 2 or more"):
        Lpv(GRID, LpvConfig(method="learned_4x6", steps=3, coarsen_after=2))(light, receivers)
    with pytest.raises(ValueError, match="coarsen_after: expected an integer >= 1, got 0"):
        LpvConfig(coarsen_after=0)
    with pytest.raises(ValueError, match="learn: 'cell_propagation' belongs to one grid, coarsen_after=2 makes two"):
        Lpv(GRID, LpvConfig(method="learned_4x6", steps=3, coarsen_after=2), learn=["cell_propagation"])


@pytest.mark.parametrize(
    "config",
    [
        LpvConfig(method="lpv", steps=5),
        LpvConfig(steps=4, occlusion="exp", occlude_first_step=False),
        LpvConfig(method="learned_9x6", steps=5),
        LpvConfig(method="learned_9x6", steps=5, coarsen_after=2),
        LpvConfig(steps=4, occlusion="clamp", coarsen_after=3),
        LpvConfig(steps=0),
    ],
    ids=lambda c: f"{c.method}-{c.occlusion}-{c.coarsen_after}-{c.steps}",
)
def test_what_moves_in_each_step_adds_up_to_the_solve(config):
    lpv, light, _ = solved(config)
    values = {"propagation": torch.tensor(0.9, dtype=torch.float64), "occlusion": torch.tensor(0.6, dtype=torch.float64)}
    moving = list(lpv.moving(light, values))
    assert len(moving) == config.steps + 1
    torch.testing.assert_close(moving[0], solved(LpvConfig(**{**config.to_json(), "steps": 0}))[0].accumulate(light)[0])
    for volume in lpv.accumulate(light, values):
        parts = [m for m in moving if m.shape == volume.shape]
        torch.testing.assert_close(torch.stack(parts).sum(0), volume, rtol=1e-4, atol=1e-6 * float(volume.abs().max()))


def test_a_symmetric_room_stays_symmetric_where_walls_lie_on_coarse_centres():
    """An even grid around a box puts two walls on planes of coarse cell centres, and two not: all four read the same."""
    scene = box_scene([PointLight(np.zeros(3), np.ones(3))])
    config = LpvConfig(method="learned_9x26", steps=16, coarsen_after=4)
    grid = Grid.around(*scene.bounds, 16)
    lpv, light, _ = solved(config, scene=scene, grid=grid)
    walls = np.array([[-1.0, 0, 0], [1, 0, 0], [0, 0, -1], [0, 0, 1]])
    found = lpv(light, light.receivers(0.999999 * walls, -walls)).mean(1)
    torch.testing.assert_close(found, found.mean().expand(4), rtol=0.35, atol=0)


def test_a_light_that_moves_out_of_its_cells_is_followed():
    """VPLs are given to the cells they see where they are now, and their gradient does not end a cell away."""
    config = LpvConfig(method="learned_4x6", steps=0)
    lpv, light, _ = solved(config, scene=panel_scene(), component="direct", learn=["light_position"])
    heights = torch.arange(7, dtype=torch.float32) + 0.5
    for down in (0.0, 0.5, 1.1):
        value = torch.tensor([[0.0, -down, 0.0]], dtype=torch.float64, requires_grad=True)
        (volume,) = lpv.accumulate(light, {"light_position": value})
        flux = volume[:, 0].sum((0, 1, 3))
        mean = (flux * heights).sum() / flux.sum() * 0.39 - 1.27
        assert float(mean.detach()) == pytest.approx(1.0 - down - 0.5 * 0.39, abs=0.3 * 0.39)
        (gradient,) = torch.autograd.grad(mean, value)
        assert float(gradient[0, 1]) == pytest.approx(1.0, abs=0.5)


def test_normals_that_are_no_unit_vectors_are_named():
    """They would be read with another cosine, and elsewhere: a plausible number."""
    _, light, _ = solved(LpvConfig(steps=1))
    with pytest.raises(ValueError, match=r"normal: expected unit length, got 0\.5 in row 1"):
        light.receivers(POSITION, NORMAL * [[1.0], [0.5]])


def test_points_that_are_not_finite_are_named():
    _, light, _ = solved(LpvConfig(method="learned_4x6", steps=1))
    with pytest.raises(ValueError, match="position: expected finite numbers, got .*nan.* in row 1"):
        light.receivers(np.array([[0.0, 0, 0], [0, np.nan, 0]]), np.array([[0.0, 1, 0]] * 2))
    moving = torch.zeros(1, 3, requires_grad=True)
    assert len(light.receivers(moving, torch.tensor([[0.0, 1, 0]]))) == 1
