import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from difflpv.io import load_scene
from difflpv.raycast import Raycaster
from difflpv.scene import AreaLight, Material, Mesh, Scene
from difflpv.sh import cosine_lobe
from difflpv.shapes.colors import exposed, relative_errors, scale_color
from difflpv.shapes.lobes import lobe_shape
from difflpv.shapes.section import section
from difflpv.shapes.shape import Shape, icosphere, joined
from difflpv.shapes.spheres import probe_radius, sphere_normals, sphere_shape, tube_shape
from difflpv.shapes.surfaces import surfaces_of

QUAD = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
TWO = np.array([[0, 1, 2], [0, 2, 3]])


def areas(shape):
    a, b, c = np.moveaxis(shape.vertices[shape.triangles], 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def volume(shape):
    """By the divergence theorem: positive for a closed surface of outward triangles."""
    a, b, c = np.moveaxis(shape.vertices[shape.triangles], 1, 0)
    return float((a * np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("detail", range(4))
def test_icosphere_is_closed_outward_and_on_the_unit_sphere(detail):
    points, triangles = icosphere(detail)
    assert (len(points), len(triangles)) == (10 * 4**detail + 2, 20 * 4**detail)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, rtol=1e-12)
    edges, count = np.unique(np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)), axis=0, return_counts=True)
    assert (count == 2).all() and len(points) - len(edges) + len(triangles) == 2
    ball = volume(Shape(points, triangles, points))
    assert 1 - 0.6 / 4**detail < ball / (4 / 3 * np.pi) < 1


def test_lobe_of_a_cosine_has_the_radius_of_its_expansion_in_every_direction():
    normal, center = np.array([0.6, 0.0, 0.8]), np.array([1.0, 2.0, 3.0])
    coeffs = cosine_lobe(normal[None], 2)[:, :, None] * np.ones(3)
    shape = lobe_shape(center[None], coeffs, 0.7, detail=2)
    c = icosphere(2)[0] @ normal
    expansion = 1 / 4 + c / 2 + 5 / 32 * (3 * c * c - 1)  # sum of (2l+1)/4pi A_l P_l, A = pi, 2 pi/3, pi/4
    radius = np.linalg.norm(shape.vertices - center, axis=1)
    np.testing.assert_allclose(radius, 0.7 * np.abs(expansion) / np.abs(expansion).max(), rtol=1e-12)
    away = shape.vertices - center
    np.testing.assert_allclose(away, radius[:, None] * icosphere(2)[0], atol=1e-12)
    assert (shape.color[expansion < 0, 2] > shape.color[expansion < 0, 0]).all(), "negative light is blue"
    lit = shape.color[expansion > 0]
    assert np.ptp(lit / lit.max(1, keepdims=True)) < 1e-12, "light without colour is grey"


@settings(max_examples=25, deadline=None)
@given(contrast=st.floats(0, 2), factor=st.floats(0.3, 1.0), count=st.sampled_from([1, 4, 9, 16]), seed=st.integers(0, 99))
def test_length_goes_with_the_power_of_the_light_and_form_does_not(contrast, factor, count, seed):
    coeffs = np.random.default_rng(seed).normal(size=(1, count, 1)) * np.ones(3)
    both = lobe_shape(np.zeros((2, 3)), np.concatenate([coeffs, factor * coeffs]), 2.0, contrast=contrast, detail=1)
    first, second = np.linalg.norm(both.vertices, axis=1).reshape(2, -1)
    np.testing.assert_allclose(second, first * factor**contrast, rtol=1e-9, atol=1e-12)


def test_lobes_carry_the_colour_of_their_light_and_darkness_draws_nothing():
    coeffs = np.zeros((2, 4, 3))
    coeffs[0, 0] = [0.2, 0.1, 0.0]
    shape = lobe_shape(np.array([[0.0, 0, 0], [5, 0, 0]]), coeffs, 1.0, detail=1)
    assert len(shape.vertices) == 42, "the dark cell has no lobe"
    np.testing.assert_allclose(shape.color[:, 1], shape.color[:, 0] / 2)
    assert not shape.color[:, 2].any()
    assert not lobe_shape(np.zeros((2, 3)), np.zeros((2, 4, 3)), 1.0)


def test_spheres_have_the_colour_of_their_normals():
    normals = sphere_normals(1)
    centers = np.array([[0.0, 0, 0], [3, 0, 0]])
    color = np.stack([np.abs(normals), 1 - np.abs(normals)])
    shape = sphere_shape(centers, np.array([0.5, 1.0]), color)
    back = (shape.vertices.reshape(2, -1, 3) - centers[:, None]) / np.array([0.5, 1.0])[:, None, None]
    np.testing.assert_allclose(back, np.stack([normals, normals]), atol=1e-12)
    np.testing.assert_array_equal(shape.color.reshape(2, -1, 3), color)


def test_probe_radius_follows_the_spacing_and_survives_duplicates():
    line = np.arange(5.0)[:, None] * [1, 0, 0]
    assert probe_radius(line, 9.0) == pytest.approx(0.2)
    assert probe_radius(line, 0.1) == 0.1
    assert probe_radius(np.zeros((3, 3)), 0.3) == 0.3
    assert probe_radius(np.zeros((1, 3)), 0.3) == 0.3


def test_tubes_have_the_length_of_their_edges():
    ends = np.array([[[0.0, 0, 0], [2, 0, 0]], [[0, 0, 0], [0, 0, 0]], [[1, 1, 1], [1, 3, 1]]])
    shape = tube_shape(ends, 0.1, (1, 0, 0))
    assert areas(shape).sum() == pytest.approx((2 + 2) * 4 * 0.1 * np.sqrt(2))  # four sides of chord r sqrt 2
    assert volume(shape) > 0


@settings(max_examples=25, deadline=None)
@given(height=st.floats(0.01, 0.99), axis=st.integers(0, 2))
def test_section_of_a_box_is_its_outline(height, axis):
    size = np.array([1.0, 2.0, 3.0])
    faces = []
    for a in range(3):
        for side in (0.0, 1.0):
            corners = np.insert(QUAD[:, :2], a, side, axis=1) * size
            faces += [corners[t] for t in TWO]
    ends = section(np.array(faces), axis, height * size[axis])
    assert np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum() == pytest.approx(2 * (size.sum() - size[axis]))
    np.testing.assert_allclose(ends[..., axis], height * size[axis])


def lit_scene(*meshes):
    lamp = Mesh("lamp", QUAD * 0.2 + [0.4, 0.4, 0.9], TWO[:, ::-1], Material("lamp", np.zeros(3), emission=np.ones(3)))
    return Scene("made", (*meshes, lamp), (AreaLight("lamp", np.ones(3)),))


def test_facets_cover_the_surfaces_on_the_sides_that_face_the_scene():
    scene = load_scene("cornell")
    surfaces = surfaces_of(scene, Raycaster(scene), facets=4000)
    a, b, c = np.moveaxis(surfaces.vertices[surfaces.triangles], 1, 0)
    cross = np.cross(b - a, c - a)
    area, normal = np.linalg.norm(cross, axis=1) / 2, surfaces.normal[surfaces.triangles[:, 0]]
    np.testing.assert_allclose(cross / (2 * area)[:, None], normal, atol=1e-6)
    walls = (np.abs(a[:, 0]) > 2.74) & (np.abs(normal[:, 0]) > 0.9)
    assert area[walls].sum() == pytest.approx(2 * 5.5**2, rel=1e-3), "each wall once"
    assert (normal[walls, 0] * a[walls, 0] < 0).all(), "and from within"
    red = surfaces.albedo[(surfaces.vertices[:, 0] < -2.74) & (surfaces.normal[:, 0] > 0.9)]
    assert (red[:, 0] > 3 * red[:, 1]).all()
    assert 3000 < len(surfaces.triangles) < 9000


def test_a_lone_sheet_is_seen_from_both_sides():
    white = Material("white", np.full(3, 0.5))
    scene = lit_scene(Mesh("sheet", QUAD + [0, 0, 5e4], TWO, white))  # so far off that no ray finds it
    surfaces = surfaces_of(scene, Raycaster(scene), facets=1)
    there = surfaces.vertices[:, 2] > 10
    assert set(surfaces.normal[there, 2]) == {1.0, -1.0}


def test_floor_under_a_box_is_covered_and_takes_the_light_beside_it():
    white = Material("white", np.full(3, 0.5))
    sides = []
    for a in range(3):
        for side in (0.0, 1.0):
            corners = np.insert(QUAD[:, :2], a, side, axis=1)
            outward = np.zeros(3)
            outward[a] = 2 * side - 1
            turn = np.cross(corners[1] - corners[0], corners[2] - corners[0]) @ outward > 0
            sides += [corners[t if turn else t[::-1]] for t in TWO]
    box = Mesh("box", np.concatenate(sides) * 0.3 + [0.35, 0.35, 0.0], np.arange(36).reshape(-1, 3), white)
    scene = lit_scene(Mesh("floor", QUAD, TWO, white), box)
    surfaces = surfaces_of(scene, Raycaster(scene), facets=4000)
    x, y, z = surfaces.vertices.T
    floor = (z == 0) & (surfaces.normal[:, 2] > 0.9)
    under = floor & (np.maximum(np.abs(x - 0.5), np.abs(y - 0.5)) < 0.145)
    beside = floor & (np.maximum(np.abs(x - 0.5), np.abs(y - 0.5)) > 0.155)
    assert surfaces.covered[under].all() and not surfaces.covered[beside].any()
    light = np.where(surfaces.covered, 0.0, 1.0)[:, None] * np.ones(3)
    shown = surfaces.radiance(light, white=True, emission=False) * np.pi
    edge = np.unique(surfaces.triangles[(~surfaces.covered[surfaces.triangles]).any(1)])
    np.testing.assert_allclose(shown[edge], 1.0, err_msg="dark shows through a facet that is seen")


def test_radiance_is_lambert_plus_emission():
    scene = load_scene("cornell")
    surfaces = surfaces_of(scene, Raycaster(scene), facets=500)
    e = np.full(surfaces.vertices.shape, 2.0)
    np.testing.assert_allclose(surfaces.radiance(e, emission=False), surfaces.albedo * 2 / np.pi)
    lamp = surfaces.emission.any(1)
    np.testing.assert_allclose((surfaces.radiance(e) - surfaces.radiance(e, emission=False))[lamp], [[17, 12, 4]] * lamp.sum())


def test_colours_of_errors_and_exposure():
    black, white = scale_color(np.array([0.0, 5.0]))
    assert black.max() < 0.01 and white.min() > 0.3
    assert (np.diff(scale_color(np.linspace(0, 1, 9)).sum(1)) > 0).all()
    np.testing.assert_allclose(exposed(np.array([[0.1, 0.3, 9.0]]), 1.0), [[0.2, 0.6, 1.0]])
    truth = np.array([[3.0, 4, 0], [0, 0, 15]])
    np.testing.assert_allclose(relative_errors(np.zeros((2, 3)), truth), [0.5, 1.5])
    np.testing.assert_allclose(relative_errors(truth, truth), 0)
    with pytest.raises(ValueError, match="black"):
        relative_errors(truth, 0 * truth)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Shape(np.zeros((2, 3)), np.zeros((0, 3), int), np.zeros((1, 3))), "equal number"),
        (lambda: Shape(np.zeros((2, 3)), np.array([[0, 1, 2]]), np.zeros((2, 3))), "indices below 2"),
        (lambda: Shape(np.full((1, 3), np.nan), np.zeros((0, 3), int), np.zeros((1, 3))), "finite"),
        (lambda: lobe_shape(np.zeros((1, 3)), np.zeros((1, 5, 3)), 1.0), "1, 4, 9 or 16"),
        (lambda: lobe_shape(np.zeros((2, 3)), np.zeros((1, 4, 3)), 1.0), "lobes: expected centres"),
        (lambda: lobe_shape(np.zeros((1, 3)), np.zeros((1, 4, 3)), 0.0), "length above 0"),
        (lambda: sphere_shape(np.zeros((1, 3)), 1.0, np.zeros((1, 5, 3))), "spheres: expected"),
    ],
)
def test_errors_name_what_came(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_joined_shapes_keep_their_triangles():
    a = tube_shape(np.array([[[0.0, 0, 0], [1, 0, 0]]]), 0.1, (1, 0, 0))
    b = sphere_shape(np.zeros((1, 3)), 1.0, np.ones((1, 12, 3)))
    both = joined([a, b])
    assert areas(both).sum() == pytest.approx(areas(a).sum() + areas(b).sum())
    assert not joined([])
