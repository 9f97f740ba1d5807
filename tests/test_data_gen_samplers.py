"""Samplers against their stated densities (chi-square) and against exact geometry."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from data_gen.emitters import Emitters
from data_gen.rng import generator
from data_gen.samplers import (
    cosine_hemisphere,
    cosine_hemisphere_pdf,
    dot,
    pick,
    rotate_to,
    triangle_barycentric,
    triangle_pdf,
    uniform_sphere,
    uniform_sphere_pdf,
)
from difflpv.scene import AreaLight, Material, Mesh, Scene

N = 100_000
P_MIN = 1e-3  # fixed seeds: passes or fails for good


def uniforms(seed, n=N):
    return generator(seed).random((2, n), np.float32)


def chi_square(z, phi, density, z_range):
    """p-value of directions binned in (z, phi) against a density per solid angle that depends on z only."""
    counts, z_edges, _ = np.histogram2d(z, phi % (2 * np.pi), bins=(12, 10), range=[z_range, [0, 2 * np.pi]])
    fine = np.linspace(0, 1, 201)
    expected = []
    for low, high in zip(z_edges[:-1], z_edges[1:], strict=True):
        expected.append(np.trapezoid(density(low + (high - low) * fine), dx=(high - low) / 200) * 2 * np.pi / 10)
    expected = np.repeat(expected, 10).reshape(12, 10) * len(z)
    assert expected.sum() == pytest.approx(len(z), rel=1e-4)  # the stated density integrates to 1
    return stats.chisquare(counts.ravel(), expected.ravel() * counts.sum() / expected.sum()).pvalue


def test_cosine_hemisphere():
    d = cosine_hemisphere(uniforms(1))
    np.testing.assert_allclose(dot(d, d), 1, atol=1e-6)
    assert chi_square(d[2], np.arctan2(d[1], d[0]), cosine_hemisphere_pdf, [0, 1]) > P_MIN


def test_uniform_sphere():
    d = uniform_sphere(uniforms(2))
    np.testing.assert_allclose(dot(d, d), 1, atol=1e-6)
    assert chi_square(d[2], np.arctan2(d[1], d[0]), lambda z: np.full_like(z, uniform_sphere_pdf()), [-1, 1]) > P_MIN


def test_triangle():
    b, c = triangle_barycentric(uniforms(3))
    assert (b >= 0).all() and (c >= 0).all() and (b + c <= 1 + 1e-6).all()
    # 8 x 8 cells of the unit square below the diagonal have equal shares of the area 1/2
    i, j = np.minimum((b * 8).astype(int), 7), np.minimum((c * 8).astype(int), 7)
    counts = np.bincount(i * 8 + j, minlength=64).reshape(8, 8)
    below, diagonal = np.add.outer(range(8), range(8)) < 7, np.add.outer(range(8), range(8)) == 7
    expected = (below + 0.5 * diagonal) / 64 * float(triangle_pdf(np.float64(0.5))) * N
    inside = below | diagonal
    assert counts[inside].sum() == N
    assert stats.chisquare(counts[inside], expected[inside]).pvalue > P_MIN


def test_pick_keeps_the_rest_uniform():
    cumulative = np.cumsum([0.5, 0.1, 0.0, 0.4])
    index, rest = pick(cumulative, uniforms(4)[0])
    assert stats.chisquare(np.bincount(index, minlength=4)[[0, 1, 3]], N * np.array([0.5, 0.1, 0.4])).pvalue > P_MIN
    assert (index != 2).all()
    assert rest.min() >= 0 and rest.max() < 1
    for k in (0, 1, 3):
        assert stats.chisquare(np.histogram(rest[index == k], 10, (0, 1))[0]).pvalue > P_MIN


@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda n: np.linalg.norm(n) > 1e-3), st.integers(0, 1000))
def test_rotate_to_is_a_rotation_onto_the_normal(normal, seed):
    n = np.array(normal)[:, None] / np.linalg.norm(normal)
    axes = rotate_to(np.eye(3), np.repeat(n, 3, 1))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    np.testing.assert_allclose(axes[:, 2:], n, atol=1e-12)


def two_lights():
    """A bright small and a dim large emitter, and a dark floor."""
    material = Material("grey", np.full(3, 0.5))
    small = Mesh("small", [[0, 1, 0], [0, 1, 1], [1, 1, 0]], [[0, 1, 2]], material)
    large = Mesh("large", [[2, 3, 0], [2, 3, 4], [6, 3, 4], [6, 3, 0]], [[0, 1, 2], [0, 2, 3]], material)
    floor = Mesh("floor", [[-9, 0, -9], [-9, 0, 9], [9, 0, 9]], [[0, 1, 2]], material)
    lights = (AreaLight("small", np.array([8.0, 4, 2])), AreaLight("large", np.array([1.0, 1, 1]), two_sided=True))
    return Scene("two lights", (small, large, floor), lights)


def test_emitter_points_follow_the_stated_density():
    scene = two_lights()
    emitters = Emitters(scene)
    pdf = emitters.triangle_pdf
    assert pdf[3] == 0  # the floor
    assert (pdf[:3] * scene.triangle_areas[:3]).sum() == pytest.approx(1)
    luminance = np.array([0.2126, 0.7152, 0.0722]) @ [8, 4, 2]
    assert pdf[0] / pdf[1] == pytest.approx(luminance)  # density by radiance, so by power per area
    origin = np.array([[3.0], [-2.0], [1.0]], np.float32).repeat(N, 1)
    sample = emitters.sample_area(origin, uniforms(5))
    points = origin + sample.direction * sample.distance
    on_small = points[1] < 2
    np.testing.assert_allclose(points[1], np.where(on_small, 1, 3), atol=1e-4)
    x, z = points[0], points[2]
    counts = [np.sum(on_small)]
    counts += [np.sum(~on_small & (x // 1 == i) & (z // 2 == j)) for i in range(2, 6) for j in range(2)]
    expected = np.array([0.5 * pdf[0]] + [2 * pdf[1]] * 8, float)
    assert stats.chisquare(counts, expected / expected.sum() * N).pvalue > P_MIN
    # the solid-angle density of a sample equals what a ray to the same point is told
    cosine = np.abs(sample.direction[1])
    triangle = np.where(on_small, 0, 1)
    np.testing.assert_allclose(sample.pdf, emitters.solid_angle_pdf(triangle, cosine, sample.distance), rtol=1e-5)


def test_one_sided_light_is_dark_behind():
    emitters = Emitters(two_lights())
    above = np.array([[0.2], [2.0], [0.2]], np.float32).repeat(64, 1)
    below = np.array([[0.2], [0.5], [0.2]], np.float32).repeat(64, 1)
    u = np.stack([np.full(64, 0.01, np.float32), uniforms(6, 64)[1]])  # all on the first triangle
    normal_up = emitters.sample_area(above, u).radiance
    normal_down = emitters.sample_area(below, u).radiance
    bright = two_lights().triangle_normals[0][1] > 0
    assert (normal_up > 0).all() == bright and (normal_down > 0).all() != bright
    u[0] = 0.9  # the two-sided one, seen from above and below
    assert (emitters.sample_area(below, u).radiance > 0).all()
    assert (emitters.sample_area(above + np.float32(5), u).radiance > 0).all()
