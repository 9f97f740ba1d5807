from dataclasses import replace

import numpy as np
import pytest
import torch
from hand_scenes import box_scene, box_walls, panel_scene, rectangle
from hypothesis import given, settings
from hypothesis import strategies as st

from difflpv.scene import AreaLight, Material, Mesh, Scene, Texture
from difflpv.surface import SurfaceSamples, albedo_by_mesh, sample_area_light, sample_surfaces

FIELDS = ("position", "normal", "albedo", "texture", "area", "mesh_index")


@settings(max_examples=25, deadline=None)
@given(count=st.integers(1, 400), size=st.tuples(*[st.floats(0.05, 20)] * 3), both_sides=st.booleans())
def test_areas_sum_to_the_meshes(count, size, both_sides):
    scene = box_scene(high=np.array(size) - 1)
    samples = sample_surfaces(scene, count, dtype=torch.float64, both_sides=both_sides)
    measured = torch.zeros(6, dtype=torch.float64).index_add(0, samples.mesh_index, samples.area)
    area = np.bincount(scene.triangle_mesh, scene.triangle_areas)
    np.testing.assert_allclose(measured, area * (2 if both_sides else 1), rtol=1e-12)
    assert np.bincount(samples.mesh_index, minlength=6).min() >= 4


def test_samples_lie_on_their_mesh(dtype):
    scene = box_scene()
    samples = sample_surfaces(scene, 300, dtype=dtype, both_sides=False)
    for mesh in range(6):
        axis, sign = mesh // 2, 2 * (mesh % 2) - 1
        here = samples.select(samples.mesh_index == mesh)
        assert here.position.dtype == dtype
        torch.testing.assert_close(here.position[:, axis], torch.full_like(here.area, sign))
        torch.testing.assert_close(here.normal[:, axis], torch.full_like(here.area, -sign))
        assert float(here.position.abs().max()) <= 1 + 1e-6


def test_both_sides_are_mirrored_pairs():
    samples = sample_surfaces(box_scene(), 100)
    front, back = (samples.select(half) for half in torch.arange(len(samples)).chunk(2))
    assert torch.equal(front.position, back.position)
    assert torch.equal(front.normal, -back.normal)
    assert torch.equal(front.area, back.area)


def test_even_by_area():
    # Quadrature of cos over the unit square: plain Monte Carlo of n points has error sigma / sqrt(n); stratified along
    # the area with a low-discrepancy second coordinate it has to do several times better.
    ground = rectangle("ground", (0, 0, 0), (1, 0, 0), (0, 1, 0))
    scene = Scene("ground", (ground,), box_scene().lights)
    n = 1000
    samples = sample_surfaces(scene, n, dtype=torch.float64, both_sides=False)
    x, y = samples.position[:, 0], samples.position[:, 1]
    for f, exact, deviation in ((torch.cos(3 * x) * y, np.sin(3) / 6, 0.4), (x * y * y, 1 / 6, 0.2)):
        assert abs(float((f * samples.area).sum()) - exact) < deviation / np.sqrt(n) / 4


def test_large_triangles_get_more():
    small = rectangle("small", (0, 0, 0), (1, 0, 0), (0, 1, 0))
    large = rectangle("large", (0, 0, 5), (3, 0, 0), (0, 3, 0))
    samples = sample_surfaces(Scene("two", (small, large), box_scene().lights), 1000, both_sides=False)
    assert np.bincount(samples.mesh_index).tolist() == [100, 900]
    assert float(samples.area.max() / samples.area.min()) == pytest.approx(1, abs=1e-5)


def test_same_seed_same_bits_and_meshes_are_independent():
    scene = box_scene()
    first, again, other = (sample_surfaces(scene, 200, seed=seed) for seed in (7, 7, 8))
    assert all(torch.equal(getattr(first, f), getattr(again, f)) for f in FIELDS)
    assert not torch.equal(first.position, other.position)
    alone = sample_surfaces(replace(scene, meshes=scene.meshes[:1]), 33, seed=7, both_sides=False)
    both = sample_surfaces(replace(scene, meshes=scene.meshes[:2]), 66, seed=7, both_sides=False)
    assert torch.equal(alone.position, both.select(both.mesh_index == 0).position)


def test_light_panels_only_when_asked():
    scene = panel_scene()
    assert sample_surfaces(scene, 50).mesh_index.unique().tolist() == [0]
    assert sample_surfaces(scene, 50, include_lights=True).mesh_index.unique().tolist() == [0, 1]


def test_albedo_is_mesh_factor_times_texture():
    image = np.array([[[0.2, 0.4, 0.6], [1.0, 0.5, 0.25]]])
    ground = rectangle("ground", (0, 0, 0), (1, 0, 0), (0, 1, 0), (0.5, 0.8, 0.0), uv=True, texture=Texture(image))
    scene = Scene("ground", (ground, *box_walls(low=(-3, -3, -3), high=(3, 3, 3))), box_scene().lights)
    samples = sample_surfaces(scene, 400, dtype=torch.float64)
    factors = albedo_by_mesh(scene, dtype=torch.float64).requires_grad_()
    torch.testing.assert_close(samples.albedo_from(factors).detach(), samples.albedo)
    textured = samples.select(samples.mesh_index == 0)
    assert float(textured.texture[:, 0].min()) >= 0.2
    # the texture's value is known even where the mesh's factor is 0, so that the factor can grow
    assert float(textured.texture[:, 2].min()) >= 0.25
    assert samples.texture[samples.mesh_index > 0].unique().tolist() == [1.0]
    samples.albedo_from(factors).sum().backward()
    expected = torch.zeros(7, 3, dtype=torch.float64).index_add(0, samples.mesh_index, samples.texture)
    torch.testing.assert_close(factors.grad, expected)


def test_texture_at_the_corners():
    image = np.array([[[0.0] * 3, [1.0] * 3], [[0.5] * 3, [0.25] * 3]])
    ground = rectangle("ground", (0, 0, 0), (1, 0, 0), (0, 1, 0), uv=True, texture=Texture(image))
    scene = Scene("ground", (ground,), box_scene().lights)
    middle = scene.texture_at(np.array([0]), np.array([[0.0, 0.5]]))  # uv (0.5, 0.5): between all four texels
    np.testing.assert_allclose(middle, 1.75 / 4)


def test_parallelogram_light_is_a_regular_grid(dtype):
    scene = panel_scene()
    samples = sample_area_light(scene, scene.lights[0], 17, dtype=dtype)
    assert len(samples) == 16
    assert float(samples.area.sum()) == pytest.approx(0.6)
    np.testing.assert_allclose(sorted(set(samples.position[:, 0].numpy().round(5))), [-0.375, -0.125, 0.125, 0.375])
    np.testing.assert_allclose(sorted(set(samples.position[:, 2].numpy().round(5))), [-0.225, -0.075, 0.075, 0.225])
    torch.testing.assert_close(samples.normal, torch.tensor([[0.0, -1, 0]], dtype=dtype).expand(16, 3))
    assert len(samples.position.unique(dim=0)) == 16


@pytest.mark.parametrize("order", [[[0, 1, 2], [0, 2, 3]], [[1, 2, 3], [3, 0, 1]], [[2, 0, 1], [3, 0, 2]]])
def test_parallelogram_is_found_for_every_triangle_order(order):
    scene = panel_scene()
    panel = replace(scene.meshes[1], triangles=np.array(order))
    samples = sample_area_light(replace(scene, meshes=(scene.meshes[0], panel)), scene.lights[0], 9)
    assert sorted(set(samples.position[:, 0].numpy().round(4).tolist())) == pytest.approx([-1 / 3, 0, 1 / 3], abs=1e-4)


def test_other_lights_are_sampled_by_area():
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 2, 0]])  # two triangles, but no parallelogram
    panel = Mesh("panel", corners, np.array([[0, 1, 2], [0, 2, 3]]), Material("panel", np.zeros(3)))
    light = AreaLight("panel", np.ones(3), two_sided=True)
    scene = Scene("odd", (panel,), (light,))
    samples = sample_area_light(scene, light, 90)
    assert len(samples) == 180
    assert float(samples.area.sum()) == pytest.approx(2 * 1.5)
    assert int((samples.position[:, 1] > samples.position[:, 0]).sum()) / 2 == pytest.approx(60, abs=1)
    assert float(samples.normal[:90, 2].min()) == 1
    assert float(samples.normal[90:, 2].max()) == -1


def test_errors():
    with pytest.raises(ValueError, match="count: expected at least 1 surface point, got 0"):
        sample_surfaces(box_scene(), 0)
    scene = panel_scene()
    with pytest.raises(ValueError, match="count: expected at least 1 sample per area light, got 0"):
        sample_area_light(scene, scene.lights[0], 0)
    with pytest.raises(ValueError, match="scene 'lamp': expected a surface that is not an area light's"):
        sample_surfaces(Scene("lamp", scene.meshes[1:], scene.lights), 10)
    samples = sample_surfaces(box_scene(), 10)
    with pytest.raises(ValueError, match=r"area: expected shape \[48\], got \[47\]"):
        replace(samples, area=samples.area[1:])
    with pytest.raises(ValueError, match=r"mesh_index: expected int64 of shape \[48\]"):
        replace(samples, mesh_index=samples.mesh_index.int())
    with pytest.raises(TypeError, match="albedo: expected torch.float32"):
        replace(samples, albedo=samples.albedo.double())
    assert isinstance(samples, SurfaceSamples)
