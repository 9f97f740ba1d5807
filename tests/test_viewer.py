"""What the page shows, without a browser: solves, slices, layers, files, and the thread between sliders and solver."""

import json
import struct
import threading

import numpy as np
import pytest
import torch
from hand_scenes import box_scene, panel_scene
from hypothesis import given, settings
from hypothesis import strategies as st

from difflpv.config import LpvConfig
from difflpv.grid import Grid
from difflpv.illumination import illuminate
from difflpv.io import load_scene
from difflpv.pipeline import Lpv
from difflpv.probes.probe_set import ProbeSet
from difflpv.scene import DirectionalLight, PointLight, SpotLight
from difflpv.shapes.spheres import sphere_normals
from difflpv.viewer.glb import filmic, shape_glb, undo_filmic
from difflpv.viewer.look import Look, layers
from difflpv.viewer.probe_view import ProbeView, lattice_positions
from difflpv.viewer.state import Knobs, Truth, ViewState, move_lights
from difflpv.viewer.still import draw_still
from difflpv.viewer.worker import LatestWorker

GRID = Grid((-2.2, -0.3, -2.2), 0.44, (10, 6, 10))
CONFIG = LpvConfig(method="learned_9x6", steps=6)
PROBES = np.array([[0.0, 0.5, 0.0], [1.2, 0.4, -0.3]])


def view_state(config=CONFIG, *, scene=None, grid=GRID, **options):
    scene = scene or panel_scene()
    return ViewState(scene, Lpv(grid, config), facets=200, **options)


def test_first_step_is_what_was_injected_and_the_last_sum_is_the_solve():
    state = view_state()
    solved = state.solve(Knobs.neutral(state.scene))
    injected = solved_volume = 0
    for component in ("direct", "bounce1"):
        light = illuminate(state.scene, GRID, CONFIG, component)
        injected = injected + Lpv(GRID, LpvConfig(method="learned_9x6", steps=0)).accumulate(light)[0]
        solved_volume = solved_volume + Lpv(GRID, CONFIG).accumulate(light)[0]
    assert float(injected.abs().max()) > 0
    for quantity in ("moving", "sum"):
        torch.testing.assert_close(solved.volume(0, quantity), injected)
    close = {"rtol": 1e-4, "atol": 1e-6 * float(solved_volume.abs().max())}
    torch.testing.assert_close(solved.volume(6, "sum"), solved_volume, **close)
    torch.testing.assert_close(solved.volume(5, "sum") + solved.volume(6, "moving"), solved_volume, **close)


def test_what_is_shown_is_what_the_pipeline_predicts():
    state = view_state(probe_position=PROBES)
    solved = state.solve(Knobs.neutral(state.scene))
    normals = sphere_normals()
    expected = probes = 0
    for component in ("direct", "bounce1"):
        light = illuminate(state.scene, GRID, CONFIG, component)
        lpv = Lpv(GRID, CONFIG)
        expected = expected + lpv(light, light.receivers(state.surfaces.receiver, state.surfaces.normal)).numpy()
        around = light.receivers(np.repeat(PROBES, len(normals), axis=0), np.tile(normals, (2, 1)))
        probes = probes + lpv(light, around).numpy().reshape(2, -1, 3)
    np.testing.assert_allclose(solved.surface, expected, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(solved.probes, probes, rtol=1e-4, atol=1e-6)
    up, down = normals[:, 1] > 0.9, normals[:, 1] < -0.9
    assert solved.probes[0, up].mean() > 2 * solved.probes[0, down].mean(), "the panel is above it"


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_a_slice_holds_the_cells_of_its_layer(axis):
    state = view_state()
    solved = state.solve(Knobs.neutral(state.scene))
    along, index = "xyz".index(axis), 4
    centers, coeffs = solved.slice(6, "sum", axis, index)
    np.testing.assert_allclose(centers[:, along], GRID.minimum[along] + GRID.cell_size * (index + 0.5))
    volume = solved.volume(6, "sum").numpy()
    cells = np.round((centers - GRID.minimum) / GRID.cell_size - 0.5).astype(int)
    assert len(np.unique(cells, axis=0)) == GRID.cell_count // GRID.resolution[along]
    for (x, y, z), found in zip(cells, coeffs, strict=True):
        np.testing.assert_allclose(found, volume[:, :, z, y, x].T, rtol=1e-6)


def test_a_slice_of_two_cell_sizes_follows_the_light_into_the_coarse_grid():
    state = view_state(LpvConfig(method="learned_9x6", steps=6, coarsen_after=3))
    solved = state.solve(Knobs.neutral(state.scene))
    assert solved.grid_of(2).cell_size == 0.44 and solved.grid_of(3).cell_size == 0.88
    centers, coeffs = solved.slice(6, "sum", "y", 4)
    np.testing.assert_allclose(centers[:, 1], GRID.minimum[1] + 0.88 * 2.5)
    assert len(centers) == 25 and coeffs.shape == (25, 9, 3)
    fine = sum(solved.volume(k, "moving").sum((2, 3, 4)) for k in range(7))
    torch.testing.assert_close(solved.volume(6, "sum").sum((2, 3, 4)), fine, rtol=1e-4, atol=1e-5)


def test_changed_knobs_are_a_fresh_solve_and_turning_back_is_exact():
    scene = panel_scene()
    state = view_state(scene=scene)
    first = state.solve(Knobs.neutral(scene))
    offset = ((0.3, 0.2, -0.4),)
    turned = state.solve(Knobs(0.8, 0.5, (2.0,), offset))
    lpv = Lpv(GRID, CONFIG, learn=("propagation", "occlusion"))
    lpv.set_values({k: torch.tensor(v, dtype=torch.float64) for k, v in (("propagation", 0.8), ("occlusion", 0.5))})
    moved = move_lights(scene, offset)
    fresh = ViewState(moved, lpv, facets=200).solve(Knobs(1.0, 1.0, (2.0,), ((0.0, 0.0, 0.0),)))
    np.testing.assert_allclose(turned.surface, fresh.surface, rtol=1e-5, atol=1e-6)
    assert not np.allclose(turned.surface, first.surface, rtol=0.05)
    np.testing.assert_array_equal(state.solve(Knobs.neutral(scene)).surface, first.surface)


def test_twice_the_light_is_twice_as_bright_and_the_exposure_stays():
    scene = box_scene((PointLight(np.array([0.2, 0.1, -0.3]), np.ones(3)),))
    state = view_state(scene=scene, grid=Grid((-1.2, -1.2, -1.2), 0.4, (6, 6, 6)))
    one = state.solve(Knobs.neutral(scene))
    exposure = state.exposure
    two = state.solve(Knobs(1.0, 1.0, (2.0,), ((0.0, 0.0, 0.0),)))
    np.testing.assert_allclose(two.surface, 2 * one.surface, rtol=1e-4, atol=1e-6)
    assert state.exposure == exposure != 0


def test_lights_move_with_their_mesh_and_directions_stay():
    by = (1.0, 2.0, 3.0)
    panel = panel_scene()
    moved = move_lights(panel, (by,))
    np.testing.assert_allclose(moved.meshes[1].vertices, panel.meshes[1].vertices + by)
    np.testing.assert_array_equal(moved.meshes[0].vertices, panel.meshes[0].vertices)
    spot = SpotLight(np.zeros(3), np.array([0.0, -1, 0]), np.ones(3))
    sun = DirectionalLight(np.array([0.0, -1, 0]), np.ones(3))
    scene = move_lights(box_scene((spot, sun)), (by, by))
    np.testing.assert_allclose(scene.lights[0].position, by)
    assert scene.lights[1] is sun
    assert move_lights(panel, ((0, 0, 0),)) is panel


def test_errors_are_of_the_light_as_it_was():
    scene = panel_scene()
    position, normal = np.array([[0.1, 0.0, 0.2], [0.8, 0.0, 0.5]]), np.array([[0.0, 1, 0]] * 2)
    truth = np.array([[3.0, 2, 1], [1, 1, 1]])
    state = view_state(scene=scene, truth=Truth(position, normal, truth, np.ones(2)), components=("direct",))
    solved = state.solve(Knobs.neutral(scene))
    light = illuminate(scene, GRID, CONFIG, "direct")
    predicted = Lpv(GRID, CONFIG)(light, light.receivers(position, normal)).numpy()
    assert solved.relative_l2 == pytest.approx(np.linalg.norm(predicted - truth) / np.linalg.norm(truth), rel=1e-4)
    off = np.linalg.norm(predicted - truth, axis=1) / np.linalg.norm(truth, axis=1).mean()
    np.testing.assert_allclose(solved.errors, off, rtol=1e-4)
    drawn = {name: make for name, _, make in layers(state, solved, Look(errors=True), ProbeView.of(np.zeros((0, 3))))}
    assert len(drawn["errors"]().vertices) == 2 * 12
    assert state.solve(Knobs(0.9, 1.0, (1.0,), ((0, 0, 0),))).relative_l2 is not None, "a factor is what is judged"
    other = state.solve(Knobs(1.0, 1.0, (2.0,), ((0, 0, 0),)))
    assert other.relative_l2 is None and other.errors is None


def test_only_layers_that_changed_have_another_key():
    state = view_state(probe_position=PROBES)
    solved = state.solve(Knobs.neutral(state.scene))
    content = ProbeSet(PROBES, np.ones((2, 9, 3)), np.array([True, False]))
    probes = ProbeView.of(content)

    def keys(look):
        return {name: key for name, key, _ in layers(state, solved, look, probes)}

    first = keys(Look())
    assert list(first) == ["surfaces", "lobes", "probes", "tetrahedra", "errors"]
    for change, expected in (
        ({"step": 3}, {"lobes"}),
        ({"surfaces": "albedo"}, {"surfaces"}),
        ({"stops": 1.0}, {"surfaces", "probes"}),
        ({"probe_light": "file"}, {"probes"}),
        ({"tetrahedra": True}, {"tetrahedra"}),
    ):
        now = keys(Look(**change))
        assert {name for name in now if now[name] != first[name]} == expected
    again = state.solve(Knobs.neutral(state.scene))
    assert next(iter(layers(state, again, Look(), probes)))[1] != first["surfaces"]


def test_layers_show_what_their_switches_say():
    state = view_state(probe_position=PROBES)
    solved = state.solve(Knobs.neutral(state.scene))
    probes = ProbeView.of(ProbeSet(PROBES, np.ones((2, 9, 3)), np.array([True, False])))

    def shapes(**look):
        return {name: make() for name, _, make in layers(state, solved, Look(**look), probes)}

    hidden = shapes(surfaces="hidden", lobes=False, probes=False)
    assert not any(hidden.values())
    assert shapes(index=4)["lobes"] and shapes()["surfaces"] and not shapes()["tetrahedra"]
    grey = shapes(probe_light="file")["probes"].color.reshape(2, -1, 3)
    assert grey[0].max() > 0.5 and np.ptp(grey[1]) == 0 and grey[1].max() < 0.05, "a probe that is not valid is dark"
    dim, brighter = shapes(stops=-3.0)["surfaces"].color, shapes(stops=-2.0)["surfaces"].color
    below = brighter < 1
    assert below.sum() > 100
    np.testing.assert_allclose(brighter[below], 2 * dim[below], rtol=1e-9)


def test_lattice_fills_the_bounds_and_edges_join_neighbours():
    points = lattice_positions(load_scene("two_rooms_90"), 8)
    assert len(points) == 8 * 3 * 4 and len(np.unique(points.round(6), axis=0)) == len(points)
    low, high = load_scene("two_rooms_90").bounds
    np.testing.assert_allclose([points.min(0) - low, high - points.max(0)], [(high - low) / [16, 6, 8]] * 2)
    corners = np.array([[x, y, z] for x in (0.0, 1) for y in (0.0, 1) for z in (0.0, 1)])
    view = ProbeView.of(corners)
    assert len(view.edges) >= 18, "a cube in tetrahedra has its 12 edges and a diagonal on each face"
    assert not len(ProbeView.of(np.zeros((0, 3))).edges)
    assert len(ProbeView.of(corners[:4]).edges) <= 6, "four in a plane"
    assert not len(ProbeView.of(corners, interpolation="gaussian").edges)


@pytest.mark.slow
def test_still_is_one_png_of_three_pictures():
    state = view_state(probe_position=PROBES)
    solved = state.solve(Knobs.neutral(state.scene))
    png = draw_still(state, solved, Look(step=2, axis="y", index=2, tetrahedra=True), ProbeView.of(PROBES))
    assert png.startswith(b"\x89PNG")
    width, height = struct.unpack(">II", png[16:24])
    assert width > 2.5 * height


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(*[st.floats(0, 1)] * 3), min_size=1, max_size=8))
def test_tone_mapping_of_the_page_is_undone(colors):
    np.testing.assert_allclose(filmic(undo_filmic(np.array(colors))), colors, atol=1e-6)


def test_glb_holds_the_triangles_and_reads_back():
    import io

    import trimesh

    state = view_state()
    shape = state.surfaces.plain()
    content = shape_glb(shape)
    magic, version, length = struct.unpack("<4sII", content[:12])
    assert (magic, version, length) == (b"glTF", 2, len(content))
    (size,) = struct.unpack("<I", content[12:16])
    document = json.loads(content[20 : 20 + size])
    assert document["materials"][0]["extensions"] == {"KHR_materials_unlit": {}}
    mesh = trimesh.load(io.BytesIO(content), file_type="glb", process=False).to_geometry()
    np.testing.assert_allclose(mesh.vertices, shape.vertices, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, shape.triangles)
    with pytest.raises(ValueError, match="at least one triangle"):
        shape_glb(type(shape)(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3))))


def test_worker_drops_what_is_stale_and_survives_failures():
    started, go, done, failures = threading.Event(), threading.Event(), [], []

    def work(request):
        started.set()
        assert go.wait(30)
        if request == "bad":
            raise FloatingPointError("overflow")
        done.append(request)

    worker = LatestWorker(work, failures.append)
    worker.submit(0)
    assert started.wait(30)
    for k in range(1, 50):  # a slider that moves while the first solve runs
        worker.submit(k)
    assert not worker.wait(0.01)
    go.set()
    assert worker.wait(30) and done == [0, 49]
    worker.submit("bad")
    assert worker.wait(30) and [str(f) for f in failures] == ["overflow"]
    worker.submit(50)
    assert worker.wait(30) and done[-1] == 50
    worker.close()


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda s: s.solve(Knobs(1, 1, (1.0, 1.0), ((0, 0, 0),))), "each of 1 lights"),
        (lambda s: s.solve(Knobs.neutral(s.scene)).volume(7, "sum"), "step: expected 0..6, got 7"),
        (lambda s: s.solve(Knobs.neutral(s.scene)).slice(0, "sum", "y", 6), "layer in 0..5, got 6"),
        (lambda s: lattice_positions(s.scene, 0), "at least 1"),
        (lambda s: ViewState(s.scene, s.lpv, components=()), "at least one"),
    ],
)
def test_errors_name_what_came(act, message):
    with pytest.raises(ValueError, match=message):
        act(view_state())
