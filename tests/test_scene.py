import dataclasses
import math

import numpy as np
import pytest

from difflpv.scene import (
    AreaLight,
    Camera,
    DirectionalLight,
    Material,
    Mesh,
    PointLight,
    Scene,
    SceneError,
    SpotLight,
    Texture,
)

QUAD = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0.0]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])
GREY = Material("grey", [0.5, 0.5, 0.5])
POINT = PointLight([0, 0, 1], [1, 1, 1])


def quad(name="quad", material=GREY, offset=(0, 0, 0), uv=None):
    return Mesh(name, QUAD + offset, TRIANGLES, material, uv)


def test_texture_lookup_by_hand():
    image = np.array([[[1, 0, 0], [0, 1, 0]], [[0, 0, 1], [1, 1, 1]]], np.float32)
    texture = Texture(image)
    uv = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75], [0.5, 0.25], [0.5, 0.5], [0.0, 0.25]])
    mean = image.mean((0, 1))
    expected = [image[0, 0], image[0, 1], image[1, 0], image[1, 1], [0.5, 0.5, 0], mean, [0.5, 0.5, 0]]
    np.testing.assert_allclose(texture.lookup(uv), expected, atol=1e-6)  # texel centres, halves, the seam at u = 0
    np.testing.assert_allclose(texture.lookup(uv + [3, -2]), texture.lookup(uv), atol=1e-6)  # repeats


def test_texture_lookup_is_bilinear():
    # A bilinear lookup gives back a linear function exactly, away from the seam.
    height, width = 5, 7
    j, i = np.mgrid[:height, :width]
    image = np.stack([i, j, 2 * i - 3 * j], -1).astype(np.float64)
    uv = np.random.default_rng(0).uniform([0.5 / width, 0.5 / height], [1 - 0.5 / width, 1 - 0.5 / height], (100, 2))
    x, y = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
    np.testing.assert_allclose(Texture(image).lookup(uv), np.stack([x, y, 2 * x - 3 * y], 1), atol=1e-12)


def test_albedo_at_looks_up_textures_by_uv():
    image = np.zeros((1, 2, 3), np.float32)
    image[0, 0], image[0, 1] = [1, 0, 0], [0, 1, 0]
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    tiled = quad("tiled", Material("tiles", [0.5, 0.25, 1.0], Texture(image)), uv=uv)
    scene = Scene("s", (quad("plain"), tiled), (POINT,))
    # Triangle 2 is (0, 0), (1, 0), (1, 1) in uv; at u = 0.25 + v the red texel's centre is at u = 0.25.
    albedo = scene.albedo_at(np.array([0, 2, 2, 3]), np.array([[0.2, 0.3], [0.25, 0.0], [0.5, 0.25], [0.0, 0.75]]))
    np.testing.assert_allclose(albedo, [[0.5] * 3, [0.5, 0, 0], [0, 0.25, 0], [0.25, 0.125, 0]], atol=1e-6)


def test_derived_arrays():
    lamp = quad("lamp", offset=(0, 0, 3))
    scene = Scene("s", (quad(), lamp), (AreaLight("lamp", [1, 2, 3], two_sided=True), POINT))
    np.testing.assert_allclose(scene.triangle_areas, [1, 1, 1, 1])
    np.testing.assert_allclose(scene.triangle_normals, [[0, 0, 1]] * 4)
    np.testing.assert_array_equal(scene.triangle_mesh, [0, 0, 1, 1])
    np.testing.assert_allclose(scene.bounds, [[0, 0, 0], [2, 1, 3]])
    np.testing.assert_allclose(scene.mesh_emission, [[0, 0, 0], [1, 2, 3]])
    np.testing.assert_array_equal(scene.mesh_two_sided_emission, [False, True])
    assert scene.triangle_vertices.shape == (4, 3, 3)


def test_with_lights_replaces_lights_and_moves_meshes():
    scene = Scene("s", (quad(), quad("lamp")), (AreaLight("lamp", [1, 1, 1]),))
    moved = scene.with_lights([AreaLight("lamp", [2, 2, 2])], {"lamp": quad("lamp", offset=(0, 0, 5))})
    np.testing.assert_allclose(moved.mesh_emission, [[0, 0, 0], [2, 2, 2]])
    assert moved.bounds[1][2] == 5 and scene.bounds[1][2] == 0
    dark = scene.with_lights([POINT])
    assert not dark.mesh_emission.any() and len(dark.meshes) == 2
    with pytest.raises(SceneError, match=r"no mesh 'lmp', meshes are \['quad', 'lamp'\]"):
        scene.with_lights([POINT], {"lmp": quad("lmp")})


def test_hash_sees_geometry_albedo_and_lights():
    base = Scene("s", (quad(),), (POINT,))
    same = Scene("other name", (quad(),), (PointLight([0, 0, 1], [1, 1, 1]),))
    assert base.hash == same.hash
    others = [
        Scene("s", (quad(offset=(1e-9, 0, 0)),), (POINT,)),
        Scene("s", (quad(material=Material("grey", [0.5, 0.5, 0.6])),), (POINT,)),
        base.with_lights([PointLight([0, 0, 1], [1, 1, 1.0000001])]),
        base.with_lights([PointLight([0, 0, 2], [1, 1, 1])]),
        base.with_lights([AreaLight("quad", [1, 1, 1])]),
        base.with_lights([AreaLight("quad", [1, 1, 1], two_sided=True)]),
    ]
    assert len({base.hash, *(scene.hash for scene in others)}) == 7


def test_spot_falloff():
    spot = SpotLight([0, 0, 0], [0, 0, -2], [1, 1, 1], 0.2, 0.5)
    np.testing.assert_allclose(spot.direction, [0, 0, -1])
    inner, outer = math.cos(0.2), math.cos(0.5)
    found = spot.falloff(np.array([1.0, inner, (inner + outer) / 2, outer, -1.0]))
    np.testing.assert_allclose(found, [1, 1, 0.25, 0, 0], atol=1e-12)


def test_camera_rays():
    to_world = np.eye(4)
    to_world[:3, 3] = [1, 2, 3]
    camera = Camera(to_world, math.pi / 2, 200, 100)
    origins, directions = camera.rays(np.array([[100, 50], [100, 0], [200, 50], [0, 100.0]]))
    np.testing.assert_allclose(origins, [[1, 2, 3]] * 4)
    # 90 degrees from top to bottom, square pixels: the right edge is twice as far out as the top.
    expected = np.array([[0, 0, -1], [0, 1, -1], [2, 0, -1], [-2, -1, -1]], float)
    np.testing.assert_allclose(directions, expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=1e-12)


ERRORS = [
    (lambda: Material("m", [0.5, 1.2, 0]), r"material 'm': albedo must lie in \[0, 1\], got \[0.5, 1.2, 0.0\]"),
    (lambda: Material("m", [0.5, np.nan, 0]), "material 'm': albedo"),
    (lambda: Material("m", [0.5]), "material 'm': albedo"),
    (lambda: Material("m", [0, 0, 0], emission=[1, -1, 1]), "material 'm': emission must be finite and >= 0"),
    (lambda: Mesh("q", QUAD[:, :2], TRIANGLES, GREY), r"mesh 'q': vertices must have shape \[V, 3\], got \[4, 2\]"),
    (lambda: Mesh("q", QUAD, TRIANGLES[:, :2], GREY), r"mesh 'q': triangles must have shape \[T, 3\], got \[2, 2\]"),
    (lambda: Mesh("q", QUAD + [0, np.inf, 0], TRIANGLES, GREY), "mesh 'q': vertex 0 is not finite"),
    (lambda: Mesh("q", QUAD, TRIANGLES + 2, GREY), "mesh 'q': index 5 is out of range for 4 vertices"),
    (lambda: Mesh("q", QUAD, TRIANGLES - 1, GREY), "mesh 'q': index -1 is out of range for 4 vertices"),
    (lambda: Mesh("q", QUAD, TRIANGLES, GREY, np.zeros((3, 2))), r"mesh 'q': uv must have shape \[V, 2\], got"),
    (lambda: Scene("s", (), (POINT,)), "scene 's': no mesh"),
    (lambda: Scene("s", (quad(),), ()), "scene 's': no light"),
    (lambda: Scene("s", (quad(),), (AreaLight("x", [1, 1, 1]),)), r"area light names mesh 'x', meshes are \['quad'\]"),
    (lambda: Scene("s", (quad(), quad()), (AreaLight("quad", [1, 1, 1]),)), "area light names mesh 'quad'"),
    (lambda: PointLight([0, 0, np.nan], [1, 1, 1]), "light 'point': position must be three finite numbers"),
    (lambda: PointLight([0, 0, 0], [1, 1, -1]), "light 'point': intensity must be >= 0"),
    (lambda: AreaLight("lamp", [1, 1]), "light 'lamp': radiance must be three finite numbers"),
    (lambda: DirectionalLight([0, 0, 0], [1, 1, 1]), "light 'directional': direction has no length"),
    (lambda: SpotLight([0, 0, 0], [1, 0, 0], [1, 1, 1], 0.5, 0.5), "light 'spot': angles must satisfy"),
    (lambda: SpotLight([0, 0, 0], [1, 0, 0], [1, 1, 1], 0.5, 2.0), "light 'spot': angles must satisfy"),
    (lambda: Scene("s", (Mesh("q", QUAD, [[0, 0, 1]], GREY),), (POINT,)).triangle_normals, "mesh 'q' has a triangle"),
]


@pytest.mark.parametrize(("call", "expected"), ERRORS)
def test_errors(call, expected):
    with pytest.raises(SceneError, match=expected) as info:
        call()
    assert "\n" not in str(info.value)


def test_values_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        POINT.name = "other"
