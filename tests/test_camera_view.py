import dataclasses

import numpy as np
import pytest
from hand_scenes import LIGHT, panel_scene, rectangle

from difflpv.camera_view import camera_view
from difflpv.raycast import Raycaster
from difflpv.scene import Camera, Scene, SceneError, Texture

# Looks down from y = 4 on the floor at y = 0 (4 x 4 m): +x to the right, -z up in the image.
DOWN = np.array([[1.0, 0, 0, 0], [0, 0, 1, 4], [0, -1, 0, 0], [0, 0, 0, 1]])
YFOV = 2 * np.arctan(3 / 4)  # 6 m of the floor's plane: the floor fills the middle 4 of 6 rows


def view_of(scene, to_world=DOWN, **size):
    return camera_view(scene, Raycaster(scene), Camera(to_world, YFOV, **({"width": 12, "height": 6} | size)))


def test_hits_are_where_the_rays_meet_the_floor():
    view = view_of(panel_scene(floor=4.0))
    row, column = np.divmod(view.hit, 12)
    assert set(row) == {1, 2, 3, 4} and set(column) == {4, 5, 6, 7}
    on_floor = view.position[:, 1] < 0.5
    np.testing.assert_allclose(view.position[on_floor, 1], 0, atol=1e-5)
    np.testing.assert_allclose(view.position[on_floor, 0], (column[on_floor] + 0.5) - 6, atol=1e-5)
    np.testing.assert_allclose(view.position[on_floor, 2], (row[on_floor] + 0.5) - 3, atol=1e-5)
    np.testing.assert_allclose(view.normal, np.broadcast_to([0.0, 1, 0], view.normal.shape), atol=1e-12)


def test_image_is_radiance_and_zero_where_nothing_is():
    view = view_of(panel_scene(floor=4.0), width=24, height=12)
    image = view.image(np.full(view.position.shape, np.pi), emission=False)
    assert image.shape == (12, 24, 3)
    assert not image[0].any() and not image[:, 0].any()
    seen = image.reshape(-1, 3)[view.hit]
    np.testing.assert_allclose(seen, view.albedo)


def test_another_albedo_keeps_the_texture():
    texture = Texture(np.linspace(0.1, 0.9, 36).reshape(4, 3, 3).astype(np.float32))
    floor = rectangle("floor", (-2, 0, -2), (0, 0, 4), (4, 0, 0), (0.5, 0.5, 0.5), uv=True, texture=texture)
    view = view_of(Scene("textured", (floor,), (LIGHT,)))
    np.testing.assert_allclose(view.with_albedo(np.array([[0.5, 0.25, 1.0]])).albedo, view.albedo * [1, 0.5, 2], rtol=1e-12)


@pytest.mark.parametrize(("two_sided", "from_below"), [(False, False), (True, False), (False, True)])
def test_a_light_shows_itself_on_its_emitting_side(two_sided, from_below):
    scene = panel_scene(two_sided=two_sided)
    if from_below:  # between floor and panel, looking up
        to_world = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0.5], [0, 1, 0, 0], [0, 0, 0, 1]])
        view = camera_view(scene, Raycaster(scene), Camera(to_world, 0.5, 8, 8))
    else:
        view = view_of(scene, width=48, height=24)
    panel = view.position[:, 1] > 0.9
    assert panel.any()
    shines = two_sided or from_below
    expected = scene.lights[0].radiance if shines else np.zeros(3)
    np.testing.assert_allclose(view.emission[panel], np.broadcast_to(expected, (panel.sum(), 3)))
    assert not view.emission[~panel].any()
    with_light, without = (view.image(np.zeros_like(view.position), emission=e) for e in (True, False))
    assert with_light.any() == shines and not without.any()


def test_the_first_camera_is_the_default_and_none_is_an_error():
    scene = panel_scene()
    with pytest.raises(SceneError, match="scene 'panel': no camera"):
        camera_view(scene, Raycaster(scene))
    with_camera = dataclasses.replace(scene, cameras=(Camera(DOWN, YFOV, 5, 4),))
    assert (camera_view(with_camera, Raycaster(with_camera)).width, with_camera.cameras[0].height) == (5, 4)


def test_a_camera_that_sees_nothing():
    away = DOWN.copy()
    away[1, 3] = -4.0  # below the floor, looking down
    view = view_of(panel_scene(), away)
    assert not len(view.hit) and not view.image(np.zeros((0, 3))).any()
