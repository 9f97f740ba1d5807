import numpy as np
import pytest

from difflpv.io import load_scene
from difflpv.raycast import Raycaster
from difflpv.scene import Material, Mesh, PointLight, Scene

GREY = Material("grey", np.full(3, 0.5))
LIGHT = PointLight(np.zeros(3), np.ones(3))


def scene_of(*meshes):
    return Scene("test", tuple(Mesh(f"m{k}", v, t, GREY) for k, (v, t) in enumerate(meshes)), (LIGHT,))


def random_triangles(count, seed=0):
    g = np.random.default_rng(seed)
    return g.random((count, 1, 3)) * 4 - 2 + g.normal(size=(count, 3, 3)) * 0.4


def moeller_trumbore(corners, origins, directions):
    """Closest hits in float64, every ray against every triangle: Moeller and Trumbore 1997."""
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(directions[:, None], e2)
    det = (p * e1).sum(-1)
    s = origins[:, None] - a
    u = (s * p).sum(-1) / det
    q = np.cross(s, e1)
    v = (directions[:, None] * q).sum(-1) / det
    t = (q * e2).sum(-1) / det
    t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
    k = t.argmin(1)
    rows = np.arange(len(origins))
    return np.where(np.isfinite(t[rows, k]), k, -1), t[rows, k], np.stack([u[rows, k], v[rows, k]], -1)


def test_closest_hits_agree_with_float64():
    corners = random_triangles(60)
    scene = scene_of((corners.reshape(-1, 3), np.arange(180).reshape(-1, 3)))
    g = np.random.default_rng(1)
    origins = g.normal(size=(2000, 3)) * 3
    directions = g.normal(size=(2000, 3)) * 0.8 - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = Raycaster(scene).closest(origins, directions)
    triangle, distance, barycentric = moeller_trumbore(corners, origins, directions)
    same = hits.triangle == triangle
    assert same.mean() > 0.998  # float32 may decide otherwise on an edge
    hit = same & hits.valid
    assert 300 < hit.sum() < 1900
    np.testing.assert_allclose(hits.distance[hit], distance[hit], rtol=1e-4)
    np.testing.assert_allclose(hits.barycentric[hit], barycentric[hit], atol=2e-3)
    assert np.isinf(hits.distance[~hits.valid]).all()


def test_plane_by_hand():
    quad = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1.0]])
    rays = Raycaster(scene_of((quad, [[0, 1, 2], [0, 2, 3]])))
    origins = np.array([[0.5, 2, 0.0], [0.5, -3, 0.0], [5, 2, 0]])
    hits = rays.closest(origins, np.array([[0, -1, 0], [0, 1, 0], [0, -1, 0.0]]))
    np.testing.assert_allclose(hits.distance[:2], [2, 3], rtol=1e-6)  # both sides
    np.testing.assert_array_equal(hits.valid, [True, True, False])
    # Triangle 0 is (-1, -1), (1, -1), (1, 1) in x, z: (0.5, 0) = corner 0 + u (2, 0) + v (2, 2).
    assert hits.triangle[0] == 0
    np.testing.assert_allclose(hits.barycentric[0], [0.25, 0.5], atol=1e-6)


def test_blocked_between_points_and_along_directions():
    quad = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1.0]])
    rays = Raycaster(scene_of((quad, [[0, 1, 2], [0, 2, 3]])))
    above = np.array([[0, 1, 0.0]])
    for target, expected in [((0, -1, 0), True), ((0, 0.5, 0), False), ((3, -1, 0), False), ((0.2, 0, 0.1), False)]:
        assert rays.blocked(above, np.array([target], float))[0] == expected, target
    down = np.array([[0, -1, 0.0]])
    for distance, expected in [(np.inf, True), (1.01, True), (0.99, False), (0.0, False), (-1.0, False)]:
        assert rays.blocked_along(above, down, distance)[0] == expected, distance
    many = rays.blocked_along(np.repeat(above, 3, 0), np.repeat(down, 3, 0), np.array([0.5, 2.0, np.inf]))
    np.testing.assert_array_equal(many, [False, True, True])
    assert not rays.blocked(above, above)[0]  # nothing lies between a point and itself


def test_blocked_agrees_with_closest():
    scene = load_scene("cornell")
    rays = Raycaster(scene)
    g = np.random.default_rng(2)
    low, high = scene.bounds
    a, b = (low + (high - low) * g.random((3000, 3)) for _ in range(2))
    length = np.linalg.norm(b - a, axis=1)
    distance = rays.closest(a, (b - a) / length[:, None]).distance
    clear = np.abs(distance - length) > 1e-3
    np.testing.assert_array_equal(rays.blocked(a, b)[clear], (distance < length)[clear])


def test_offset_leaves_the_surface():
    scene = load_scene("cornell")
    rays = Raycaster(scene)
    g = np.random.default_rng(3)
    triangle = g.integers(0, len(scene.triangle_areas), 2000)
    u = g.dirichlet([1, 1, 1], 2000)
    points = np.einsum("nk,nkc->nc", u, scene.triangle_vertices[triangle])
    normal = scene.triangle_normals[triangle]
    hits = rays.closest(points + rays.offset * normal, normal)
    assert not (hits.triangle == triangle).any()  # a ray that leaves a surface does not meet it again
    back = rays.closest(points + rays.offset * normal, -normal).distance
    np.testing.assert_allclose(back, rays.offset, rtol=0.1)


def test_empty_and_not_contiguous():
    rays = Raycaster(load_scene("diagonal"))
    empty = np.empty((0, 3))
    assert rays.closest(empty, empty).triangle.shape == (0,)
    assert rays.blocked(empty, empty).shape == (0,)
    assert rays.blocked_along(empty, empty, np.inf).shape == (0,)
    origins = np.tile([0.0, 5.0, 0.0], (6, 1))
    directions = np.tile([0.0, -1.0, 0.0], (6, 1))
    strided = rays.closest(origins[::2], np.asfortranarray(directions)[::2])
    np.testing.assert_allclose(strided.distance, [5, 5, 5], rtol=1e-6)
    assert rays.triangle_count == 4


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_offset_follows_the_extent(scale):
    corners = random_triangles(5) * scale
    assert Raycaster(scene_of((corners.reshape(-1, 3), np.arange(15).reshape(-1, 3)))).offset == pytest.approx(
        2e-5 * max(np.ptp(corners.reshape(-1, 3), axis=0).max(), np.abs(corners).max())
    )


def test_corners_alone_are_enough():
    corners = np.array([[[0.0, 0, 1], [4, 0, 1], [0, 4, 1]]])
    hits = Raycaster(corners).closest(np.array([[1.0, 1, 0], [9, 9, 0]]), np.array([[0.0, 0, 1]] * 2))
    assert hits.valid.tolist() == [True, False] and hits.distance[0] == pytest.approx(1.0)
