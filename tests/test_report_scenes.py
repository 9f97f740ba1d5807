"""Figures of scenes: what is where in them, and how large."""

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from difflpv.grid import Grid
from difflpv.io import load_scene
from difflpv.probes.probe_set import ProbeSet
from difflpv.report.picture import axis_camera, picture
from difflpv.report.scene_figures import LobeSlice, draw_pictures, lobe_picture, probe_figure, probe_picture
from difflpv.scene import Camera, DirectionalLight
from difflpv.sh import cosine_lobe
from difflpv.shapes.overview import outside_camera
from difflpv.shapes.shape import Shape
from difflpv.shapes.spheres import sphere_normals, sphere_shape

LOW, HIGH = np.array([-1.0, 0, 2]), np.array([3.0, 2, 5])


def ball(center, radius, color=(1.0, 0, 0), detail=3):
    count = len(sphere_normals(detail))
    return sphere_shape(np.array([center], float), radius, np.broadcast_to(color, (1, count, 3)))


def test_a_ball_has_the_size_of_its_projection():
    camera = Camera(np.eye(4), np.pi / 2, width=200, height=200)
    image = picture(ball((0, 0, -4), 1.0), camera, width=200, background=(0, 0, 0), samples=2)
    seen = image[..., 0].sum() / 200**2
    tangent = 1 / np.sqrt(4**2 - 1)  # of the angle of the cone that touches the ball; the image is 2 wide at distance 1
    assert seen == pytest.approx(np.pi * tangent**2 / 4, rel=0.02)
    assert not image[..., 1:].any()


def test_backs_are_not_seen():
    camera = Camera(np.eye(4), np.pi / 2, width=20, height=20)
    inside = ball((0, 0, 0), 1.0)
    assert np.allclose(picture(inside, camera, width=20), 1.0), "from within all fronts face away"
    turned = Shape(inside.vertices, inside.triangles[:, ::-1], inside.color)
    assert np.allclose(picture(turned, camera, width=20), [1.0, 0, 0])


@pytest.mark.parametrize(("axis", "right", "up"), [(0, -2, 1), (1, 0, -2), (2, 0, 1)])
def test_a_plan_is_framed_by_its_box_and_turned_as_said(axis, right, up):
    """A dot near the corner that is said to be right and up lies there, in the plane of the slice."""
    height = float((LOW + HIGH)[axis] / 2)
    camera = axis_camera(LOW, HIGH, axis, height)
    spot = (LOW + HIGH) / 2
    for direction in (right, up):
        a = abs(direction)
        sign = -1 if direction < 0 else 1
        spot[a] += sign * 0.45 * (HIGH - LOW)[a]
    image = picture(ball(spot, 0.02, (0, 0, 0)), camera, width=200)
    y, x = np.argwhere(image.mean(2) < 0.5).mean(0)
    assert x / image.shape[1] == pytest.approx(0.95, abs=0.01) and y / image.shape[0] == pytest.approx(0.05, abs=0.01)


def test_probes_are_lit_from_where_their_light_comes(tmp_path):
    scene = load_scene("cornell")
    radiance = np.zeros((2, 9, 3))
    radiance[0] = cosine_lobe(np.array([0.0, 1, 0]), 2)[:, None] * [0.2, 1.0, 0.2]  # green from above
    radiance[1] = cosine_lobe(np.array([0.0, -1, 0]), 2)[:, None] * [0.2, 0.2, 1.0]  # blue from below
    probes = ProbeSet(np.array([[-1.0, 4.2, 1.0], [1.0, 4.2, 1.0]]), radiance)
    image = probe_picture(scene, probes, width=320)
    empty = probe_picture(scene, ProbeSet(np.zeros((0, 3)), np.zeros((0, 9, 3))), width=320)
    y, x = np.argwhere(np.abs(image - empty).max(2) > 0.02).T
    left, right = x < 160, x > 160
    assert left.sum() > 100 and right.sum() > 100
    for side, channel, above in ((left, 1, True), (right, 2, False)):
        ys, color = y[side], image[y[side], x[side]]
        upper, lower = color[ys < ys.mean()].mean(0), color[ys > ys.mean()].mean(0)
        bright, dark = (upper, lower) if above else (lower, upper)
        assert bright[channel] > 2 * dark[channel] and bright.argmax() == channel
    edges = np.array([probes.position])
    probe_figure(scene, probes, tmp_path / "probes.png", edges=edges)
    with Image.open(tmp_path / "probes.png") as shown:
        assert shown.size[0] > 400
    joined = probe_picture(scene, probes, edges=edges, width=320)
    assert (np.abs(joined - image).max(2) > 0.02).sum() > 30, "the edge between them is drawn"


def test_a_slice_points_where_its_light_goes():
    scene = load_scene("cornell")
    grid = Grid((-3, -0.25, -3), 2.0, (3, 3, 3))
    coeffs = cosine_lobe(np.array([[1.0, 0, 0]]), 2)[:, :, None] * np.ones(3)
    layer = LobeSlice(np.array([[0.0, 2.75, 0]]), coeffs, grid, 2, 0.0)
    plain = lobe_picture(scene, LobeSlice(np.zeros((0, 3)), np.zeros((0, 9, 3)), grid, 2, 0.0), width=200)
    changed = np.abs(lobe_picture(scene, layer, width=200) - plain).max(2) > 0.05
    y, x = np.argwhere(changed).T
    assert x.mean() > 100 + 10 and abs(y.mean() - changed.shape[0] / 2) < 3
    assert plain.min() < 0.05, "the walls are outlined"


def test_a_slice_of_a_flat_scene_is_more_than_a_line():
    scene = load_scene("cornell")
    sun = DirectionalLight(np.array([0.0, -1, 0]), np.ones(3))
    flat = replace(scene, meshes=tuple(m for m in scene.meshes if m.name == "floor"), lights=(sun,))
    layer = LobeSlice(np.zeros((0, 3)), np.zeros((0, 9, 3)), Grid((-3, -0.25, -3), 2.0, (3, 3, 3)), 2, 0.0)
    height, width, _ = lobe_picture(flat, layer, width=200).shape
    assert height > 0.3 * width


def test_titles_have_room_over_narrow_pictures():
    def inked(*titles):
        """Columns of pixels that the titles fill."""
        images = [np.zeros((400, 1200, 3)), *[np.zeros((400, 100, 3))] * (len(titles) - 1)]
        with Image.open(io.BytesIO(draw_pictures(images, titles))) as shown:
            return int((np.asarray(shown.convert("L"))[:22] < 200).any(0).sum())

    title = "moves after 4 steps, z = 0.667 m"
    assert inked("a", title, title) == pytest.approx(inked("a") + 2 * inked(title), rel=0.05), "no title covers another"


@pytest.mark.parametrize("name", ["two_rooms_90", "planter"])
def test_an_overview_sees_all_corners_of_a_room_whose_camera_is_inside(name):
    scene = load_scene(name)
    camera = outside_camera(scene)
    low, high = scene.bounds
    corners = np.array([[(low, high)[k >> a & 1][a] for a in range(3)] for k in range(8)])
    local = (corners - camera.to_world[:3, 3]) @ camera.to_world[:3, :3]
    slope = np.tan(camera.yfov / 2)
    x, y = local[:, 0] / -local[:, 2] / slope * camera.height / camera.width, local[:, 1] / -local[:, 2] / slope
    assert (local[:, 2] < 0).all() and max(np.abs(x).max(), np.abs(y).max()) == pytest.approx(1 / 1.05, rel=1e-6)
    np.testing.assert_allclose(camera.to_world[:3, :3] @ camera.to_world[:3, :3].T, np.eye(3), atol=1e-12)


def test_a_camera_that_stands_outside_is_kept():
    scene = load_scene("cornell")
    assert outside_camera(scene) is scene.cameras[0]
