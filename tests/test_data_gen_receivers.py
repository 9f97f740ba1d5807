"""Receivers and probes: areas, lit sides, buried surfaces, free space, exact distances."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from data_gen import receivers
from data_gen.freespace import draw_probes
from data_gen.receivers import draw_receivers
from difflpv.io import load_scene
from difflpv.scene import AreaLight, Material, Mesh, Scene
from difflpv.triangle_distance import triangle_distance


def box(name, low, high, *, inside_out=False):
    v = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    t = np.array([t for a, b, c, d in faces for t in ([a, b, c], [a, c, d])])
    normals = np.cross(v[t[:, 1]] - v[t[:, 0]], v[t[:, 2]] - v[t[:, 0]])
    wrong = (((v[t].mean(1) - 0.5) * normals).sum(1) < 0) != inside_out
    t[wrong] = t[wrong][:, ::-1]
    low, high = np.array(low, float), np.array(high, float)
    return Mesh(name, low + v * (high - low), t, Material(name, np.full(3, 0.3)))


def room(*, block_inside_out=False, room_inside_out=True):
    """A closed 4 m room with a 1 m block on its floor and a panel under its ceiling."""
    panel = Mesh("panel", [[-1, 3.9, -1], [1, 3.9, -1], [1, 3.9, 1], [-1, 3.9, 1]], [[0, 1, 2], [0, 2, 3]],
                 Material("black", np.zeros(3)))  # fmt: skip
    meshes = (
        box("room", [-2, 0, -2], [2, 4, 2], inside_out=room_inside_out),
        box("block", [0, 0, 0], [1, 1, 1], inside_out=block_inside_out),
        panel,
    )
    return Scene("room", meshes, (AreaLight("panel", np.ones(3)),))


@pytest.mark.parametrize("block_inside_out", [False, True])
@pytest.mark.parametrize("room_inside_out", [False, True])
def test_normals_point_into_the_lit_room_whatever_the_winding(block_inside_out, room_inside_out):
    scene = room(block_inside_out=block_inside_out, room_inside_out=room_inside_out)
    table = draw_receivers(scene, 800, 3)
    of_block = table.extras["mesh_id"] == 1
    center = np.where(of_block[:, None], [0.5, 0.5, 0.5], [0, 2, 0])
    outward = ((table.position - center) * table.normal).sum(1) > 0
    np.testing.assert_array_equal(outward, of_block)
    np.testing.assert_allclose(np.linalg.norm(table.normal, axis=1), 1)
    assert (table.extras["mesh_id"] != 2).all()  # none on the light
    np.testing.assert_allclose(table.albedo, 0.3)


def test_buried_area_is_left_out():
    table = draw_receivers(room(), 2000, 0)
    on_floor = (table.extras["mesh_id"] == 0) & (table.position[:, 1] < 1e-9)
    under_block = on_floor & (table.position[:, [0, 2]] > 0.01).all(1) & (table.position[:, [0, 2]] < 0.99).all(1)
    assert on_floor.sum() > 200 and not under_block.any()
    bottom = (table.extras["mesh_id"] == 1) & (table.position[:, 1] < 1e-9)
    assert not bottom.any()
    # 6 walls of 16 m2 less the square metre under the block, 5 sides of the block
    weight = table.area_weight
    assert (weight == weight[0]).all()
    assert weight.sum() == pytest.approx(96 - 1 + 5, rel=0.01)
    assert weight[table.extras["mesh_id"] == 1].sum() == pytest.approx(5, rel=0.1)


def test_what_is_known_to_be_buried_saves_a_second_draw(monkeypatch):
    """Of 102 m2, the block's bottom and the floor below it are buried: one draw instead of two, for the same area."""
    drawn, real = [], receivers._draw_points
    monkeypatch.setattr(receivers, "_draw_points", lambda *args: drawn.append(args[2]) or real(*args))
    plain = draw_receivers(room(), 2000, 0)
    assert drawn[0] == 2000 and len(drawn) == 2
    drawn.clear()
    known = draw_receivers(room(), 2000, 0, expected_share=0.95, search=256)
    assert drawn == [2106]  # ceil(2000 / 0.95)
    for table in (plain, known):
        assert len(table) == 2000
        np.testing.assert_allclose(table.area_weight.sum(), 100.0, rtol=0.01)  # 96 - 1 and 6 - 1 m2
        share = (table.extras["mesh_id"] == 1).mean()  # 5 of 100 m2
        assert abs(share - 0.05) < 4 * np.sqrt(0.05 * 0.95 / 2000)


@pytest.mark.parametrize("options, message", [
    ({"search": 8}, "search: expected a multiple of 32 paths, got 8"),
    ({"search": 100}, "search: expected a multiple of 32 paths, got 100"),
    ({"expected_share": 0.0}, r"expected_share: expected a number in \(0, 1\], got 0"),
    ({"expected_share": 1.5}, r"expected_share: expected a number in \(0, 1\], got 1.5"),
])  # fmt: skip
def test_options_of_a_draw(options, message):
    with pytest.raises(ValueError, match=message):
        draw_receivers(room(), 10, 0, **options)


def test_unlit_back_of_an_object_in_the_open_is_kept():
    panel = Mesh("panel", [[-1, 3, -1], [1, 3, -1], [1, 3, 1], [-1, 3, 1]], [[0, 1, 2], [0, 2, 3]],
                 Material("black", np.zeros(3)))  # fmt: skip
    scene = Scene("s", (box("cube", [-1, 0, -1], [1, 1, 1]), panel), (AreaLight("panel", np.ones(3)),))
    table = draw_receivers(scene, 400, 1)
    assert table.area_weight.sum() == pytest.approx(16)
    assert ((table.position - [0, 0.5, 0]) * table.normal).sum(1).min() > 0


def test_seeds():
    scene = load_scene("diagonal")
    a, b, c = (draw_receivers(scene, 50, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(a.position, b.position)
    assert not np.array_equal(a.position, c.position)
    with pytest.raises(ValueError, match="receiver count: expected at least 1"):
        draw_receivers(scene, 0)


def test_scene_of_lights_alone_has_no_receivers():
    scene = room()
    lamp = replace(scene, meshes=scene.meshes[2:])
    with pytest.raises(ValueError, match="every surface emits"):
        draw_receivers(lamp, 10)


def test_probes_are_in_free_space():
    scene = room()
    probes = draw_probes(scene, 500, 0, clearance=0.05)
    assert probes.shape == (500, 3)
    assert (probes > [-2, 0, -2]).all() and (probes < [2, 4, 2]).all()
    assert not ((probes > 0) & (probes < 1)).all(1).any()  # none in the block
    assert triangle_distance(scene.triangle_vertices, probes).min() >= 0.05
    # uniform: the share left of x = 0 is that of the free volume
    share = (probes[:, 0] < 0).mean()
    assert abs(share - 32 / 63) < 4 * np.sqrt(0.25 / 500)
    np.testing.assert_array_equal(probes, draw_probes(scene, 500, 0, clearance=0.05))


def test_probe_arguments():
    scene = room()
    with pytest.raises(ValueError, match="a box with a volume"):
        draw_probes(scene, 5, bounds=(np.zeros(3), np.array([1.0, 0, 1])))
    with pytest.raises(ValueError, match="clearance"):
        draw_probes(scene, 5, clearance=-1)
    with pytest.raises(ValueError, match="probe count"):
        draw_probes(scene, 0)
    with pytest.raises(ValueError, match="hardly any free space"):
        draw_probes(scene, 5, bounds=(np.full(3, 0.2), np.full(3, 0.8)))


def test_bunny_is_solid():
    scene = load_scene("bunny")
    low, high = (np.array(corner) for corner in ([-1.2, -1.2, -0.9], [1.2, 1.2, 0.9]))
    probes = draw_probes(scene, 400, 1, bounds=(low, high))
    # along every axis direction from an inner point the bunny is hit; from a free one some direction is open
    assert len(probes) == 400
    inside = np.array([[-0.2, -0.5, 0.0]])
    with pytest.raises(ValueError, match="hardly any free space"):
        draw_probes(scene, 4, 1, bounds=(inside[0] - 0.01, inside[0] + 0.01))


def brute_force(corners, p):
    """Distance to a triangle by minimising over a fine barycentric grid: an upper bound, close."""
    u = np.linspace(0, 1, 201)
    b, c = np.meshgrid(u, u)
    keep = b + c <= 1 + 1e-12
    w = np.stack([1 - b[keep] - c[keep], b[keep], c[keep]], -1)
    return min(np.linalg.norm(w @ triangle - p, axis=1).min() for triangle in corners)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6))
def test_distance_against_a_grid_search(seed):
    rng = np.random.default_rng(seed)
    scale = 10 ** rng.uniform(-2, 1, (5, 1, 1))
    corners = rng.normal(size=(5, 1, 3)) + scale * rng.normal(size=(5, 3, 3))
    p = 2 * rng.normal(size=3)
    exact = triangle_distance(corners, p[None])[0]
    upper = brute_force(corners, p)
    assert exact <= upper + 1e-9
    assert upper - exact <= 0.03 * np.abs(corners).max()


def test_distance_without_triangles_is_infinite():
    assert np.isinf(triangle_distance(np.empty((0, 3, 3)), np.zeros((2, 3)))).all()
