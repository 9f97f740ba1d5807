"""The path tracer against closed forms: point, spot and directional light, form factors, the white furnace."""

import numpy as np
import pytest

from data_gen.components import Components, Estimate, bounce_range
from data_gen.estimators import image_block, irradiance_block, probe_block
from data_gen.pathtracer import PathTracer
from difflpv.scene import AreaLight, Camera, DirectionalLight, Material, Mesh, PointLight, Scene, SpotLight, Texture
from difflpv.sh import lobe_factors, sh_basis

GREY = Material("grey", np.full(3, 0.5))


def quad(name, corner, edge1, edge2, material=GREY, uv=None):
    a, e, f = np.array(corner, float), np.array(edge1, float), np.array(edge2, float)
    return Mesh(name, np.stack([a, a + e, a + e + f, a + f]), np.array([[0, 1, 2], [0, 2, 3]]), material, uv)


def floor(material=GREY):
    return quad("floor", [-5, 0, -5], [0, 0, 10], [10, 0, 0], material)


def estimate(scene, positions, normals, names=("direct",), *, samples=16, seed=0, rounds=1, **options):
    tracer, components = PathTracer(scene, **options), Components.of(names)
    total = sum(
        irradiance_block(
            tracer, np.asarray(positions, float), np.asarray(normals, float), components,
            samples=samples, seed=seed, address=(0,), round=r,
        )
        for r in range(rounds)
    )  # fmt: skip
    return Estimate.of(total / rounds)


def on_floor(n, seed=0):
    p = np.random.default_rng(seed).uniform(-3, 3, (n, 3)) * [1, 0, 1]
    return p, np.tile([0.0, 1, 0], (n, 1))


def test_point_light_is_exact():
    light = PointLight(np.array([0.5, 2.0, -0.3]), np.array([3.0, 2, 1]))
    x, n = on_floor(50)
    got = estimate(Scene("s", (floor(),), (light,)), x, n, samples=1)
    delta = light.position - x
    d2 = (delta**2).sum(1)
    expected = light.intensity * (delta[:, 1] / d2**1.5)[:, None]
    np.testing.assert_allclose(got.mean[:, 0], expected, rtol=1e-9)
    assert (got.standard_error == 0).all()


def test_point_light_is_blocked():
    lid = quad("lid", [-1, 1, -1], [0, 0, 2], [2, 0, 0])
    scene = Scene("s", (floor(), lid), (PointLight(np.array([0.0, 2, 0]), np.ones(3)),))
    got = estimate(scene, [[0, 0, 0], [1.9, 0, 0], [2.1, 0, 0]], [[0, 1, 0]] * 3, samples=1).mean[:, 0, 0]
    assert got[0] == 0 and got[1] == 0 and got[2] > 0


def test_directional_light_is_exact():
    direction = np.array([1.0, -2, 0.5]) / np.linalg.norm([1.0, -2, 0.5])
    light = DirectionalLight(direction, np.array([5.0, 4, 3]))
    x, n = on_floor(20)
    got = estimate(Scene("s", (floor(),), (light,)), x, n, samples=1).mean[:, 0]
    np.testing.assert_allclose(got, np.tile(light.irradiance * -direction[1], (20, 1)), rtol=1e-12)


def test_spot_light_falls_off():
    light = SpotLight(np.array([0.0, 2, 0]), np.array([0.0, -1, 0]), np.ones(3), inner_angle=0.2, outer_angle=0.5)
    angles = np.array([0.0, 0.1, 0.3, 0.45, 0.6])
    x = np.stack([2 * np.tan(angles), 0 * angles, 0 * angles], -1)
    got = estimate(Scene("s", (floor(),), (light,)), x, np.tile([0.0, 1, 0], (5, 1)), samples=1).mean[:, 0, 0]
    falloff = np.clip((np.cos(angles) - np.cos(0.5)) / (np.cos(0.2) - np.cos(0.5)), 0, 1) ** 2
    np.testing.assert_allclose(got, falloff * np.cos(angles) ** 3 / 4, rtol=1e-9, atol=1e-15)
    assert got[-1] == 0


def rectangle_irradiance(corners, x, n, radiance):
    """Lambert's formula for a wholly visible polygon."""
    p = corners - x
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    q = np.roll(p, -1, 0)
    axis = np.cross(p, q)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    return abs((np.arccos((p * q).sum(1))[:, None] * axis).sum(0) @ n) / 2 * radiance


def test_area_light_matches_lamberts_formula_near_and_far():
    # 3 mm to 3 m in front of the panel: light sampling alone has no usable variance at the near end
    panel = quad("panel", [-0.5, 0, -0.5], [0, 0, 1], [1, 0, 0])
    scene = Scene("s", (panel,), (AreaLight("panel", np.array([2.0, 1, 4])),))
    heights = np.geomspace(0.003, 3, 12)
    x = np.stack([0.1 + 0 * heights, heights, 0.2 + 0 * heights], -1)
    got = estimate(scene, x, np.tile([0.0, -1, 0], (12, 1)), samples=256)
    expected = np.array([rectangle_irradiance(panel.vertices, p, np.array([0, 1.0, 0]), 2.0) for p in x])
    assert (got.standard_error[:, 0, 0] < 0.02 * expected).all()
    assert (np.abs(got.mean[:, 0, 0] - expected) < 3.5 * got.standard_error[:, 0, 0] + 2e-4 * expected).all()
    behind = estimate(scene, x * [1, -1, 1], np.tile([0.0, 1, 0], (12, 1)))
    assert (behind.mean == 0).all()


def parallel_form_factor(a, b, c):
    """Two equal, opposite a x b rectangles at distance c (Howell, Catalog of Configuration Factors, C-11)."""
    x, y = a / c, b / c
    sx, sy = np.sqrt(1 + x * x), np.sqrt(1 + y * y)
    return 2 / (np.pi * x * y) * (
        np.log(np.sqrt((sx * sy) ** 2 / (1 + x * x + y * y)))
        + x * sy * np.arctan(x / sy) + y * sx * np.arctan(y / sx) - x * np.arctan(x) - y * np.arctan(y)
    )  # fmt: skip


def perpendicular_form_factor(h, w):
    """From a rectangle 1 x w to one 1 x h at right angles along their common edge 1 (Howell, C-14)."""
    h2, w2 = h * h, w * w
    log = (1 + w2) * (1 + h2) / (1 + w2 + h2)
    log *= (w2 * (1 + w2 + h2) / ((1 + w2) * (w2 + h2))) ** w2
    log *= (h2 * (1 + h2 + w2) / ((1 + h2) * (h2 + w2))) ** h2
    root = np.sqrt(h2 + w2)
    return (w * np.arctan(1 / w) + h * np.arctan(1 / h) - root * np.arctan(1 / root) + np.log(log) / 4) / (np.pi * w)


@pytest.mark.parametrize("case", ["parallel", "perpendicular"])
def test_form_factor_between_rectangles(case):
    nodes, weights = np.polynomial.legendre.leggauss(16)
    u, w = (nodes + 1) / 2, weights / 2
    receiver = np.stack([np.repeat(u, 16), np.zeros(256), np.tile(u, 16)], -1)
    if case == "parallel":
        light, factor = quad("light", [0, 1, 0], [1, 0, 0], [0, 0, 1]), parallel_form_factor(1.0, 1.0, 1.0)
    else:
        light, factor = quad("light", [0, 0, 0], [0, 0.7, 0], [0, 0, 1]), perpendicular_form_factor(0.7, 1.0)
    scene = Scene("s", (quad("floor", [0, 0, 0], [0, 0, 1], [1, 0, 0]), light), (AreaLight("light", np.ones(3), True),))
    got = estimate(scene, receiver, np.tile([0.0, 1, 0], (256, 1)), samples=32)
    share = np.outer(w, w).ravel()
    mean = share @ got.mean[:, 0, 0] / np.pi
    error = np.sqrt((share**2) @ got.standard_error[:, 0, 0] ** 2) / np.pi
    assert error < 1e-3 * factor
    assert abs(mean - factor) < 3 * error + 2e-4 * factor  # the second term: quadrature along the common edge


def furnace(albedo):
    """A closed unit cube whose six walls all emit radiance 1 inward and reflect ``albedo``."""
    v = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    triangles = np.array([t for a, b, c, d in faces for t in ([a, b, c], [a, c, d])])
    normals = np.cross(v[triangles[:, 1]] - v[triangles[:, 0]], v[triangles[:, 2]] - v[triangles[:, 0]])
    outward = ((v[triangles].mean(1) - 0.5) * normals).sum(1) > 0
    triangles[outward] = triangles[outward][:, ::-1]
    mesh = Mesh("walls", v, triangles, Material("wall", np.array(albedo)))
    return Scene("furnace", (mesh,), (AreaLight("walls", np.ones(3)),))


def test_white_furnace_gives_the_geometric_series():
    albedo = np.array([0.2, 0.5, 0.8])
    rng = np.random.default_rng(3)
    x, n = rng.random((64, 3)), np.zeros((64, 3))
    x[:, 1], n[:, 1] = 0, 1
    names = ("direct", "bounce1", "upto2", "upto5", "full")
    got = estimate(furnace(albedo), x, n, names, samples=16)
    for index, name in enumerate(names):
        first, last = bounce_range(name)
        exact = np.pi * (albedo[:, None] ** np.arange(first, last + 1)).sum(1)
        if name == "full":
            np.testing.assert_allclose(exact, np.pi / (1 - albedo), rtol=1e-5)
        error = np.sqrt((got.standard_error[:, index] ** 2).sum(0)) / 64
        assert (error < 0.01 * exact).all()
        assert (np.abs(got.mean[:, index].mean(0) - exact) < 3 * error).all(), name


def test_furnace_probe_and_pixel_see_constant_radiance():
    albedo = np.full(3, 0.5)
    tracer = PathTracer(furnace(albedo))
    names = Components.of(["direct", "full"])
    probe = Estimate.of(
        probe_block(tracer, np.array([[0.5, 0.4, 0.6]]), names, samples=64, seed=1, address=(0,))
    )
    # direct at a probe is emission alone, L = 1; full is L/(1 - albedo) = 2: only the l = 0 coefficient, sqrt(4 pi) L
    expected = np.zeros((2, 9, 3))
    expected[:, 0] = np.sqrt(4 * np.pi) * np.array([1.0, 2.0])[:, None]
    assert (np.abs(probe.mean[0] - expected) < 4 * probe.standard_error[0] + 1e-6).all()
    to_world = np.eye(4)
    to_world[:3, 3] = 0.5
    camera = Camera(to_world, 0.8, 4, 3)
    # an image's direct is emission and the light reflected once: 1 + albedo
    image = Estimate.of(image_block(tracer, camera, np.arange(12), names, samples=16, seed=1, address=(0,)))
    assert (np.abs(image.mean - np.array([1.5, 2.0])[:, None]) < 4 * image.standard_error + 1e-6).all()


def test_probe_of_point_like_lights_is_exact():
    lights = (PointLight(np.array([1.0, 2, 0]), np.ones(3)), DirectionalLight(np.array([0.0, -1, 0]), np.full(3, 2.0)))
    tracer = PathTracer(Scene("s", (floor(Material("black", np.zeros(3))),), lights))
    got = Estimate.of(
        probe_block(tracer, np.array([[0.0, 1, 0]]), Components.of(["direct"]), samples=1, seed=0, address=(0,))
    )
    toward = np.array([1.0, 1, 0]) / np.sqrt(2)
    expected = sh_basis(toward, 2) / 2 + 2 * sh_basis(np.array([0.0, 1, 0]), 2)
    np.testing.assert_allclose(got.mean[0, 0, :, 1], expected, atol=1e-12)
    assert (got.standard_error == 0).all()
    # three bands of a delta facing the normal hold 17/16 of its irradiance
    up = sh_basis(np.array([0.0, 1, 0]), 2)
    assert (lobe_factors(2) * up * up).sum() == pytest.approx(17 / 16)


def test_constant_texture_multiplies_the_albedo():
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    wall = [[-5, 0, -5], [0, 6, 0], [0, 0, 10]]
    light = (PointLight(np.array([0.0, 2, 0]), np.ones(3)),)
    tint = np.array([0.5, 0.25, 0.75])
    textured = Material("t", np.full(3, 0.8), Texture(np.tile(tint, (4, 4, 1)).astype(np.float32)))
    plain = Material("p", 0.8 * tint)
    x, n = on_floor(8)
    a, b = (
        estimate(Scene("s", (floor(), quad("wall", *wall, m, uv)), light), x, n, ("bounce1",)) for m in (textured, plain)
    )
    assert (b.mean > 0).all()
    np.testing.assert_allclose(a.mean, b.mean, rtol=1e-5)


def test_many_point_lights_add_up():
    # more than four: one is drawn per vertex, the expectation is the sum over all
    rng = np.random.default_rng(5)
    lights = tuple(
        PointLight(p, i) for p, i in zip(rng.uniform([-2, 1, -2], [2, 3, 2], (6, 3)), rng.random((6, 3)), strict=True)
    )
    meshes = (floor(), quad("wall", [-4, 0, -4], [0, 6, 0], [0, 0, 8]))
    x, n = on_floor(16)
    together = estimate(Scene("s", meshes, lights), x, n, ("bounce1",), samples=64)
    alone = [estimate(Scene("s", meshes, (light,)), x, n, ("bounce1",), samples=64, seed=9) for light in lights]
    error = np.sqrt(together.standard_error**2 + sum(e.standard_error**2 for e in alone))
    z = (together.mean - sum(e.mean for e in alone)) / error
    assert (np.abs(z) < 4).all()


def test_roulette_depth_does_not_change_the_mean():
    scene = furnace(np.full(3, 0.7))
    x, n = np.array([[0.3, 0, 0.6]]), np.array([[0.0, 1, 0]])
    early, late = (estimate(scene, x, n, ("full",), samples=256, roulette_depth=d, seed=d) for d in (1, 20))
    assert (np.abs(early.mean - late.mean) < 3.5 * np.hypot(early.standard_error, late.standard_error)).all()
    assert (early.standard_error > late.standard_error).all()


@pytest.mark.parametrize("name", ["bounce2", "upto0", "upto65", "Direct", ""])
def test_unknown_component(name):
    with pytest.raises(ValueError, match="expected direct, bounce1"):
        Components.of([name])


def test_components_share_buckets():
    components = Components.of(["bounce1", "upto2", "full_indirect"])
    assert components.bucket_of_bounce[0] >= 0 and len(components.bucket_of_bounce) == 65
    per_bounce = components.membership[:, components.bucket_of_bounce]
    for row, name in zip(per_bounce, components.names, strict=True):
        first, last = bounce_range(name)
        np.testing.assert_array_equal(row, (np.arange(65) >= first) & (np.arange(65) <= last))
    only = Components.of(["bounce1"])
    assert only.bucket_of_bounce.tolist() == [-1, 0]


def test_estimate_of_equal_replicates_has_no_error():
    got = Estimate.of(np.full((32, 3), 0.1))
    assert (got.standard_error == 0).all() and (got.mean == 0.1).all()
    values = np.random.default_rng(0).normal(size=(32, 5))
    got = Estimate.of(values)
    np.testing.assert_allclose(got.mean, values.mean(0))
    np.testing.assert_allclose(got.standard_error, values.std(0, ddof=1) / np.sqrt(32))
