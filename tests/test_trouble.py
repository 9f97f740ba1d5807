"""Each limit of a solve from both sides: no word just below, one line with its cure just above."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hand_scenes import box_scene, panel_scene, rectangle

from difflpv.config import LpvConfig
from difflpv.grid import Grid
from difflpv.illumination import illuminate
from difflpv.pipeline import Lpv
from difflpv.scene import AreaLight, Scene, SceneError
from difflpv.simulate import simulate
from difflpv.trouble import describe_trouble, free_space

FEW = {"surface_samples": 200, "area_samples": 9}


def room(*, edge=2.0, albedo=0.5, cells=8, divider=None):
    """A closed box with a panel under its ceiling and receivers on its floor; the grid has a cell of margin."""
    half = edge / 2
    box = box_scene(low=(-half,) * 3, high=(half,) * 3, albedo=np.full((6, 3), albedo))
    x = -0.2 * half if divider is None else -0.7 * half  # on one side of a divider
    lamp = rectangle("lamp", (x, 0.9 * half, -0.2 * half), (0.4 * half, 0, 0), (0, 0, 0.4 * half), (0, 0, 0))
    meshes = [*box.meshes, lamp]
    if divider is not None:  # two faces that look away from each other, across the room
        faces = ((divider / 2, "near"), (-divider / 2, "far"))
        meshes += [rectangle(name, (x, -half, -half), (0, edge, 0), (0, 0, edge)) for x, name in faces]
    scene = Scene("room", tuple(meshes), (AreaLight("lamp", np.array([5.0, 4.0, 3.0])),))
    return scene, Grid.around(*scene.bounds, cells)


def receivers(edge=2.0, divider=None):
    u = np.linspace(-0.4, 0.4, 5) * edge
    x, z = (a.ravel() for a in np.meshgrid(u, u))
    position, normal = np.stack([x, np.full(25, -edge / 2), z], 1), np.tile([0.0, 1, 0], (25, 1))
    if divider is not None:
        position = np.concatenate([position, np.stack([np.full(25, divider / 2), x, z], 1)])
        normal = np.concatenate([normal, np.tile([1.0, 0, 0], (25, 1))])
    return position, normal


def told(config, *, component="bounce1", values=None, **options):
    divider, edge = options.get("divider"), options.get("edge", 2.0)
    scene, grid = room(**options)
    position, normal = receivers(edge, divider)
    light = illuminate(scene, grid, config, component, **FEW)
    lpv = Lpv(grid, config)
    irradiance = lpv(light, light.receivers(position, normal), values).detach().numpy()
    return describe_trouble(lpv, light, position, normal, irradiance, values)


def test_a_sound_solve_has_nothing_to_tell():
    for method in ("lpv", "holpv", "learned_9x26"):
        assert told(LpvConfig(method=method, steps=8)) == ()


@pytest.mark.parametrize(("normalization", "critical"), [("energy", 1.0), ("thesis", 4.0)])
def test_factor_at_its_critical_value(normalization, critical):
    config = LpvConfig(steps=8, normalization=normalization)

    def with_factor(p):
        return told(config, values={"propagation": torch.tensor(p, dtype=torch.float64)})

    assert with_factor(critical) == ()
    (line,) = with_factor(1.001 * critical)
    assert f"lies beyond its critical value {critical:g}: light grows up to 1.01 times" in line and "lower the factor" in line


def test_factors_of_single_steps_count_by_their_product():
    config = LpvConfig(steps=8)

    def with_factors(*factors):
        return told(config, values={"propagation_steps": torch.tensor(factors, dtype=torch.float64)})

    assert with_factors(2, 2, 2, *[0.5] * 5) == ()  # a fit that gives back what it takes
    assert len(with_factors(2, 2, 2, *[0.9] * 5)) == 1  # 4.7 times at the end
    (line,) = with_factors(2, 2, 2, 2, *[0.1] * 4)  # dark in the end, 16 times too bright on the way
    assert "(2 on average over 4 steps)" in line and "up to 16 times" in line


def test_steps_that_cannot_cross_the_room():
    """A room of 6 cells between the margins of a grid of 8."""
    assert told(LpvConfig(steps=5)) == ()
    (line,) = told(LpvConfig(steps=4))
    assert "4 steps carry light 4 cells at most, the scene spans 6" in line and "take at least 5 steps" in line


def test_cells_larger_than_the_room():
    """A room of 2 m in a grid of three cells: its receivers need one and a half cells in front of them."""
    scene, _ = room()
    config, (position, normal) = LpvConfig(steps=3), receivers()
    for size, expected in ((1.32, False), (1.34, True)):
        grid = Grid((-1.5 * size,) * 3, size, (3, 3, 3))
        lines = simulate(scene, position, normal, grid=grid, config=config).warnings
        assert any(f"cells of {size:.4g} m are too large for the rooms: 100 % of the receivers" in w for w in lines) is expected


@pytest.mark.parametrize(("thickness", "thin"), [(0.35, False), (0.32, True)])
def test_walls_thinner_than_a_cell(thickness, thin):
    """Cells of a third of a metre."""
    lines = told(LpvConfig(steps=8), divider=thickness)
    found = [line for line in lines if line.startswith("walls are thinner than a cell of 0.3333 m: 50 % of the receivers")]
    assert bool(found) is thin
    assert not found or f"(thinnest {thickness:.2g} m)" in found[0]


def test_free_space_is_measured_along_the_normal():
    scene, grid = room(divider=0.3)
    light = illuminate(scene, grid, LpvConfig(steps=1), "direct", **FEW)
    position, normal = np.array([[0.15, 0.0, 0], [1.0, 0, 0]]), np.array([[1.0, 0, 0], [-1, 0, 0]])
    front, behind = free_space(light, position, normal)
    np.testing.assert_allclose(front, [0.85, 0.85], atol=1e-4)
    np.testing.assert_allclose(behind, [0.3, np.inf], atol=1e-4)


@pytest.mark.parametrize("component", ["direct", "bounce1"])
def test_a_wall_of_one_sheet_has_no_thickness(component):
    """Told of a lone quad across the room; not of outer walls, behind which there is nothing, nor of solids."""
    scene, grid = room(divider=1e-6)
    lone = replace(scene, meshes=tuple(m for m in scene.meshes if m.name != "far"))
    place, normal = np.array([[0.0, 0.3, 0.4], [0, -1, 0.3]]), np.array([[1.0, 0, 0], [0, 1, 0]])
    light = illuminate(lone, grid, LpvConfig(steps=1), component, **FEW)
    x, n = np.repeat(place, 25, 0), np.repeat(normal, 25, 0)
    np.testing.assert_allclose(free_space(light, place, normal)[1], [0, np.inf])
    lpv = Lpv(grid, LpvConfig(steps=8))
    lpv(light, light.receivers(x, n))
    lines = describe_trouble(lpv, light, x, n, np.ones((50, 3)))
    assert any("50 % of the receivers lie on less than a cell of matter (thinnest 0 m)" in line for line in lines)
    solid, _ = room(divider=0.6)
    light = illuminate(solid, grid, LpvConfig(steps=1), component, **FEW)
    np.testing.assert_allclose(free_space(light, place + [[0.3, 0, 0], [0, 0, 0]], normal)[1], [0.6, np.inf], atol=1e-4)


def test_negative_light_is_told_where_it_counts():
    scene, grid = room()
    config = LpvConfig(steps=8)
    light, lpv = illuminate(scene, grid, config, **FEW), Lpv(grid, config)
    position, normal = receivers()
    lpv(light, light.receivers(position, normal))
    irradiance = np.ones((25, 3))
    for value, expected in ((-3.5, False), (-3.8, True)):  # of 75 - 1: 4.7 and 5.1 %
        irradiance[0, 0] = value
        lines = describe_trouble(lpv, light, position, normal, irradiance)
        assert any("irradiance is negative at 1 of 25 receivers" in line for line in lines) is expected
    assert any("use clamp" in line for line in describe_trouble(lpv, light, position, normal, -irradiance))


@pytest.mark.parametrize(("albedo", "high"), [(0.9, False), (0.91, True)])
def test_one_bounce_in_a_white_room(albedo, high):
    lines = told(LpvConfig(steps=8), albedo=albedo)
    assert bool(lines) is high
    assert not high or "first bounce is about 9 % of all reflected light" in lines[0]
    assert told(LpvConfig(steps=8), albedo=albedo, component="direct") == ()


@pytest.mark.parametrize(("dtype", "limit"), [(torch.float32, 9.9e-32), (torch.float64, 1e-292)])
def test_lights_too_dim_for_their_precision(dtype, limit):
    scene, grid = room()
    position, normal = receivers()
    for factor, dim in ((2.0, False), (0.5, True)):
        # The panel's 9 VPLs have pi L A / 9 W, A = 0.16 m2.
        lights = [AreaLight("lamp", np.full(3, factor * limit * 9 / (np.pi * 0.16)))]
        light = illuminate(scene.with_lights(lights), grid, LpvConfig(steps=8), "direct", dtype=dtype, **FEW)
        lpv = Lpv(grid, LpvConfig(steps=8))
        irradiance = lpv(light, light.receivers(position, normal)).numpy()
        lines = describe_trouble(lpv, light, position, normal, irradiance)
        assert any("too dim for float" in line and "scale the lights" in line for line in lines) is dim


@pytest.mark.parametrize(("cells", "far"), [(34, False), (35, True)])
def test_a_learned_stencil_beyond_its_training(cells, far):
    """The room fills all cells but two."""
    for method, expected in (("learned_4x6", far), ("lpv", False)):
        lines = told(LpvConfig(method=method, steps=40), cells=cells)
        assert any("'learned_4x6' was trained to 16 and holds to about 32" in line for line in lines) is expected


@pytest.mark.parametrize(("samples", "few"), [(72, False), (40, True)])
def test_vpls_that_are_few_for_their_cells(samples, few):
    """Six walls of 4 m2 on cells of a third of a metre: 216 cell faces."""
    scene, grid = room()
    config, (position, normal) = LpvConfig(steps=8), receivers()
    light = illuminate(scene, grid, config, surface_samples=samples, area_samples=9)
    lpv = Lpv(grid, config)
    irradiance = lpv(light, light.receivers(position, normal)).numpy()
    lines = describe_trouble(lpv, light, position, normal, irradiance)
    assert any("VPLs are few for cells of 0.333 m" in line and "more surface_samples" in line for line in lines) is few


def test_a_light_that_is_off_is_not_dim():
    scene, grid = room()
    light = illuminate(scene.with_lights([AreaLight("lamp", np.zeros(3))]), grid, LpvConfig(steps=8), "direct", **FEW)
    lpv, (position, normal) = Lpv(grid, LpvConfig(steps=8)), receivers()
    irradiance = lpv(light, light.receivers(position, normal)).numpy()
    assert describe_trouble(lpv, light, position, normal, irradiance) == ()


def moved(scene, factor=1.0, offset=0.0):
    meshes = tuple(replace(m, vertices=factor * m.vertices + [offset, 0, 0]) for m in scene.meshes)
    return replace(scene, meshes=meshes)


@pytest.mark.parametrize(("edge", "refused"), [(2e-5, False), (9e-6, True), (9e8, False), (2e9, True)])
def test_scenes_of_a_size_that_float32_cannot_hold(edge, refused):
    """At each size that is let through the answer is that of a room of 2 m: irradiance under a panel has no length in it."""
    scene, grid = room()
    position, normal = receivers()
    small = moved(scene, edge / 2)
    own = Grid(tuple(edge / 2 * v for v in grid.minimum), edge / 2 * grid.cell_size, grid.resolution)
    config = LpvConfig(steps=8, occlusion="exp")
    if refused:
        with pytest.raises(SceneError, match=r"m across, rays and form factors work from 1e-05 to 1e\+09 m: rescale it"):
            illuminate(small, own, config)
        return
    expected = simulate(scene, position, normal, grid=grid, config=config).irradiance
    found = simulate(small, edge / 2 * position, normal, grid=own, config=config).irradiance
    np.testing.assert_allclose(found, expected, rtol=1e-4)


@pytest.mark.parametrize(("offset", "refused"), [(1900.0, False), (2100.0, True)])
def test_scenes_far_from_the_origin(offset, refused):
    scene, grid = room()
    position, normal = receivers()
    away = moved(scene, offset=offset)
    own = Grid((grid.minimum[0] + offset, *grid.minimum[1:]), grid.cell_size, grid.resolution)
    config = LpvConfig(steps=8)
    if refused:
        with pytest.raises(SceneError, match="more than 1000 times its size: float32 rays cannot tell"):
            illuminate(away, own, config)
        return
    expected = simulate(scene, position, normal, grid=grid, config=config).irradiance
    found = simulate(away, position + [offset, 0, 0], normal, grid=own, config=config).irradiance
    assert np.linalg.norm(found - expected) < 0.02 * np.linalg.norm(expected)


def test_light_that_needs_no_volume_is_not_judged_by_it():
    scene = box_scene()
    position, normal = np.array([[0.3, -1.0, 0.2]]), np.array([[0.0, 1, 0]])
    prediction = simulate(scene, position, normal, grid=Grid((-2,) * 3, 4.0, (1, 1, 1)), config=LpvConfig(steps=0),
                          component="direct")  # fmt: skip
    assert prediction.warnings == ()


def test_a_grid_that_misses_the_scene_is_told_first():
    scene = panel_scene(floor=2.0)
    grid = Grid((-1.2, -1.2, -1.2), 0.4, (3, 6, 6))
    lines = simulate(scene, *receivers(), grid=grid, config=LpvConfig(steps=6), component="direct").warnings
    assert "32 VPLs with 50 % of the flux are lost" in lines[0] and "receivers lie outside the grid" in lines[1]
