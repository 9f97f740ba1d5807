import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hand_scenes import LIGHT, box_scene, panel_scene, rectangle

from difflpv import rsm as stage
from difflpv.direct import drop_unlit, emitters_of, lit_surface_vpls, visibility
from difflpv.raycast import Raycaster
from difflpv.reference import rsm as twin
from difflpv.rsm import Rsm, render_rsm, rsm_blockers, rsm_vpls, texel_solid_angle
from difflpv.scene import DirectionalLight, PointLight, Scene, SpotLight, Texture
from difflpv.surface import albedo_by_mesh, sample_surfaces

SPOT = SpotLight(np.array([0.2, 0.1, -0.3]), np.array([0.3, -1, 0.2]), np.array([2.0, 3, 4]), 0.3, 0.6)
SUN = DirectionalLight(np.array([0.0, -2, 0]), np.array([1.0, 2, 3]))
WALLS = np.linspace(0.2, 0.9, 18).reshape(6, 3)


def traced(light=LIGHT, **options):
    scene = box_scene((light,), albedo=WALLS)
    return render_rsm(scene, light, Raycaster(scene), **({"dtype": torch.float64, "resolution": 8} | options))


def fields_of(rsm):
    return rsm.offset, rsm.direction, rsm.normal, rsm.plane, rsm.size * rsm.attenuation


def flux_per_mesh(mesh_index, flux, meshes=6):
    return torch.zeros(meshes, 3, dtype=flux.dtype).index_add(0, mesh_index, flux)


@pytest.mark.parametrize("resolution", [1, 2, 7, 64])
def test_exact_texels_of_a_cube_face_sum_to_a_sixth_of_the_sphere(resolution):
    exact = texel_solid_angle(1.0, resolution)
    assert exact.shape == (resolution, resolution)
    assert exact.sum() == pytest.approx(4 * math.pi / 6, rel=1e-13)


def test_small_texel_form_converges_to_the_exact_one():
    # 4 cos^3 tan^2(FOV/2) / N^2 is the midpoint rule: its relative error falls with 1/N^2.
    for half_extent in (1.0, math.tan(0.3)):
        errors = []
        for resolution in (8, 16):
            exact = texel_solid_angle(half_extent, resolution)
            small = texel_solid_angle(half_extent, resolution, small_texel=True)
            errors.append(np.abs(small / exact - 1).max())
        assert errors[0] < 0.02
        assert errors[0] / errors[1] == pytest.approx(4, rel=0.3)
    centre = texel_solid_angle(1.0, 1, small_texel=True)
    assert float(centre[0, 0]) == pytest.approx(4)  # cos = 1, tan = 1


def test_perspective_face_covers_its_cone():
    # A face of half-angle a has the solid angle of a square pyramid, 4 asin(sin(a)^2).
    a = 0.6
    assert texel_solid_angle(math.tan(a), 32).sum() == pytest.approx(4 * math.asin(math.sin(a) ** 2), rel=1e-12)


def test_hits_lie_on_the_box_and_face_the_light(dtype):
    rsm = traced(dtype=dtype, resolution=16)
    vpls = rsm_vpls(rsm)
    assert len(rsm) == rsm.texel_count == 6 * 16 * 16
    assert (rsm.light, rsm.light_index, vpls.position.dtype) == ("point", 0, dtype)
    torch.testing.assert_close(vpls.position.abs().amax(1), torch.ones(len(rsm), dtype=dtype), rtol=0, atol=1e-5)
    assert float((rsm.normal * rsm.direction).sum(1).max()) < 0
    wall = vpls.position.gather(1, (rsm.mesh_index // 2)[:, None])[:, 0]
    torch.testing.assert_close(wall, 2.0 * (rsm.mesh_index % 2).to(dtype) - 1, rtol=0, atol=1e-5)


def test_box_reflects_all_flux_of_a_point_light():
    # sum Phi = rho 4 pi I, exactly: the solid angles of the texels sum to the sphere
    light = LIGHT
    scene = box_scene((light,), albedo=np.array([0.5, 0.25, 0.75]))
    vpls = rsm_vpls(render_rsm(scene, light, Raycaster(scene), resolution=9, dtype=torch.float64))
    np.testing.assert_allclose(vpls.flux.sum(0), 4 * math.pi * light.intensity * [0.5, 0.25, 0.75], rtol=1e-12)


def test_spot_light_flux():
    # Phi = rho I int falloff dw; int = 2 pi int s^2 dcos = 2 pi ((1 - c_i) + (c_i - c_o) / 3)
    inner, outer = math.cos(SPOT.inner_angle), math.cos(SPOT.outer_angle)
    expected = 0.5 * SPOT.intensity * 2 * math.pi * ((1 - inner) + (inner - outer) / 3)
    scene = box_scene((SPOT,))
    rsm = render_rsm(scene, SPOT, Raycaster(scene), resolution=64, dtype=torch.float64)
    assert rsm.texel_count == 64 * 64
    np.testing.assert_allclose(rsm_vpls(rsm).flux.sum(0), expected, rtol=1e-3)


def test_wide_spot_light_takes_the_cube():
    wide = replace(SPOT, outer_angle=math.pi / 2, inner_angle=math.pi / 2 - 1e-3)
    scene = box_scene((wide,))
    rsm = render_rsm(scene, wide, Raycaster(scene), resolution=64, dtype=torch.float64)
    assert rsm.texel_count == 6 * 64 * 64
    np.testing.assert_allclose(rsm_vpls(rsm).flux.sum(0), 0.5 * wide.intensity * 2 * math.pi, rtol=0.01)


def test_directional_light_flux():
    # A lone floor of 2 x 3 m under a tilted sun: Phi = rho E A cos, the map's edge texels apart
    floor = rectangle("floor", (-1, 0, -1.5), (0, 0, 3), (2, 0, 0), (0.5, 0.5, 0.5))
    sun = DirectionalLight(np.array([0.4, -1, 0.3]), np.array([1.0, 2, 3]))
    scene = Scene("floor", (floor,), (sun,))
    cosine = -sun.direction[1] / np.linalg.norm(sun.direction)
    rsm = render_rsm(scene, sun, Raycaster(scene), resolution=128, dtype=torch.float64)
    np.testing.assert_allclose(rsm_vpls(rsm).flux.sum(0), 0.5 * 6 * cosine * sun.irradiance, rtol=0.01)
    torch.testing.assert_close(rsm.normal, torch.tensor([[0.0, 1, 0]], dtype=torch.float64).expand(len(rsm), 3))
    thesis = render_rsm(scene, sun, Raycaster(scene), resolution=128, dtype=torch.float64, texel_flux="thesis")
    torch.testing.assert_close(rsm_vpls(thesis).flux, rsm_vpls(rsm).flux * cosine)


def test_thesis_option_counts_the_cosine_twice():
    exact, small, thesis = (traced(texel_flux=name, resolution=16) for name in ("exact", "small_texel", "thesis"))
    cosine = -(exact.normal * exact.direction).sum(1)
    torch.testing.assert_close(rsm_vpls(thesis).flux, rsm_vpls(small).flux * cosine[:, None])
    torch.testing.assert_close(rsm_vpls(small).flux, rsm_vpls(exact).flux, rtol=0.01, atol=0)
    assert not torch.allclose(small.size, exact.size, rtol=1e-4)


def test_misses_are_left_out():
    scene = panel_scene()
    lamp = PointLight(np.array([0.0, 0.5, 0]), np.ones(3))
    rsm = render_rsm(scene, lamp, Raycaster(scene), resolution=16)
    assert rsm.light_index == -1  # not one of the scene's lights
    assert 0 < len(rsm) < rsm.texel_count


@pytest.mark.parametrize("light", [LIGHT, SPOT, DirectionalLight(np.array([0.3, -1, 0.2]), np.ones(3))])
def test_agrees_with_lit_surface_samples(light):
    # Two independent estimates of the flux of each mesh: uniform rays against uniform surface samples. Plain Monte
    # Carlo of n terms has the standard error std(terms) sqrt(n); both sets are stratified, so 3 sigma is generous.
    # The directional light comes from outside: an open box.
    box = box_scene((light,), albedo=WALLS)
    block = rectangle("block", (-0.5, -0.4, -0.6), (0.9, 0.1, 0), (0, 0.2, 0.8), (0.6, 0.3, 0.9))
    walls = [m for m in box.meshes if m.name != "wall1+"]
    scene = replace(box, meshes=(*walls, block))
    raycaster = Raycaster(scene)
    rsm = render_rsm(scene, light, raycaster, resolution=32, dtype=torch.float64)
    samples = sample_surfaces(scene, 4000, seed=1, dtype=torch.float64)
    emitters = emitters_of(scene, dtype=torch.float64)
    seen = visibility(samples.position, samples.normal, emitters, raycaster)
    lit, seen = drop_unlit(samples, seen)
    sets = [(rsm.mesh_index, rsm_vpls(rsm).flux), (lit.mesh_index, lit_surface_vpls(lit, emitters, seen).flux)]
    everywhere = {"rsm": rsm.texel_count, "samples": len(samples)}
    sums, variances = [], []
    for (mesh, flux), n in zip(sets, everywhere.values(), strict=True):
        first, second = flux_per_mesh(mesh, flux), flux_per_mesh(mesh, flux**2)
        sums.append(first)
        variances.append(second - first**2 / n)
    sigma = (variances[0] + variances[1]).sqrt()
    assert bool(((sums[0] - sums[1]).abs() <= 3 * sigma + 1e-12).all())
    torch.testing.assert_close(sums[0].sum(0), sums[1].sum(0), rtol=0.02, atol=0)


def test_blockers_cover_the_box():
    # Areas d^2 Omega / cos add up to the six walls of 2 x 2 m, whatever the light's position.
    position, normal, area = rsm_blockers(traced(resolution=64))
    assert float(area.sum()) == pytest.approx(24, rel=2e-3)
    assert position.shape == normal.shape == (6 * 64 * 64, 3)
    lid_open = Scene("floor", (rectangle("floor", (-1, 0, -1), (0, 0, 2), (2, 0, 0)),), (SUN,))
    _, _, area = rsm_blockers(render_rsm(lid_open, SUN, Raycaster(lid_open), resolution=10))
    assert float(area.sum()) == pytest.approx(4, rel=1e-5)
    # what blocks does not depend on how bright a spot light is there
    narrow = traced(SPOT, resolution=32)
    dimmer = replace(narrow, attenuation=narrow.attenuation / 3)
    torch.testing.assert_close(rsm_blockers(narrow)[2], rsm_blockers(dimmer)[2])


@pytest.mark.parametrize("light", [LIGHT, SPOT, SUN])
def test_equals_twin(generator, dtype, relative_tolerance, light):
    rsm = traced(light, dtype=dtype)
    moved = None if light is SUN else (rsm.position + 0.05 * torch.randn(3, generator=generator, dtype=dtype))
    power = torch.rand(3, generator=generator, dtype=dtype)
    vpls = rsm_vpls(rsm, position=moved, power=power)
    position = rsm.position if moved is None else moved
    hit, flux = twin.rsm_vpls(*fields_of(rsm), rsm.albedo, position, power)
    for ours, theirs in ((vpls.position, hit), (vpls.flux, flux)):
        tolerance = relative_tolerance(dtype) * float(theirs.abs().max())
        torch.testing.assert_close(ours, theirs, rtol=0, atol=tolerance)


def test_gradients_equal_twin(generator, dtype, relative_tolerance):
    rsm = traced(dtype=dtype, resolution=12)  # more than two blocks of the adjoint
    inputs = [t.clone().requires_grad_() for t in (rsm.albedo, rsm.position, rsm.power)]
    vpls = rsm_vpls(rsm, albedo=inputs[0], position=inputs[1], power=inputs[2])
    expected = twin.rsm_vpls(*fields_of(rsm), *inputs)
    cotangents = [torch.randn(vpls.flux.shape, generator=generator, dtype=dtype) for _ in range(2)]
    ours = torch.autograd.grad((vpls.position, vpls.flux), inputs, cotangents)
    theirs = torch.autograd.grad(expected, inputs, cotangents)
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=10 * relative_tolerance(dtype) * float(b.abs().max()))


def test_slides_as_a_new_map_would():
    # A small move changes neither which wall a texel hits nor its plane: sliding equals tracing again.
    rsm = traced(resolution=16)
    step = np.array([0.01, -0.02, 0.015])
    again = traced(replace(LIGHT, position=LIGHT.position + step), resolution=16)
    same = rsm.mesh_index == again.mesh_index
    assert float(same.double().mean()) > 0.95
    slid = rsm_vpls(rsm, position=rsm.position + torch.tensor(step)).position
    torch.testing.assert_close(slid[same], rsm_vpls(again).position[same], rtol=0, atol=1e-12)


def test_promises_of_a_differentiable_op(check_op):
    rsm = traced(resolution=2)

    def function(position, power, albedo):
        vpls = rsm_vpls(rsm, position=position, power=power, albedo=albedo)
        return torch.cat([vpls.position, vpls.flux])

    check_op(function, [rsm.position, rsm.power, rsm.albedo])


def test_opcheck(dtype):
    rsm = traced(dtype=dtype, resolution=2)
    learnable = [t.clone().requires_grad_() for t in (rsm.albedo, rsm.position, rsm.power)]
    torch.library.opcheck(stage._texels, (*fields_of(rsm), *learnable))
    bar = torch.ones_like(rsm.albedo)
    weight = rsm.size * rsm.attenuation
    inputs = (bar, bar, rsm.direction, rsm.normal, weight, rsm.albedo, rsm.power)
    torch.library.opcheck(stage._texels_adjoint, inputs)


def test_non_contiguous_input(dtype):
    rsm = traced(dtype=dtype)
    strided = replace(rsm, direction=rsm.direction.t().contiguous().t(), normal=rsm.normal.t().contiguous().t())
    position = torch.stack([rsm.position, rsm.position], 1)[:, 0]
    assert not position.is_contiguous()
    ours, expected = rsm_vpls(strided, position=position), rsm_vpls(rsm)
    assert torch.equal(ours.position, expected.position)
    assert torch.equal(ours.flux, expected.flux)


def test_empty_map():
    floor = rectangle("floor", (-1, 0, -1), (0, 0, 2), (2, 0, 0))
    away = SpotLight(np.array([0.0, 1, 0]), np.array([0.0, 1, 0]), np.ones(3), 0.1, 0.4)
    scene = Scene("dark", (floor,), (away,))
    rsm = render_rsm(scene, away, Raycaster(scene), resolution=4)
    position, power = rsm.position.clone().requires_grad_(), rsm.power.clone().requires_grad_()
    vpls = rsm_vpls(rsm, position=position, power=power)
    assert len(vpls) == 0
    (vpls.flux.sum() + vpls.position.sum()).backward()
    assert position.grad.tolist() == power.grad.tolist() == [0, 0, 0]


def test_albedo_factors_on_a_textured_wall():
    image = np.array([[[0.2, 0.4, 0.6], [1.0, 0.5, 0.25]]])
    floor = rectangle("floor", (-1, 0, -1), (0, 0, 2), (2, 0, 0), (0.5, 0.8, 0.0), uv=True, texture=Texture(image))
    lamp = PointLight(np.array([0.0, 1, 0]), np.ones(3))
    scene = Scene("floor", (floor,), (lamp,))
    rsm = render_rsm(scene, lamp, Raycaster(scene), resolution=8, dtype=torch.float64)
    factors = albedo_by_mesh(scene, dtype=torch.float64).requires_grad_()
    torch.testing.assert_close(rsm.albedo_from(factors).detach(), rsm.albedo)
    rsm_vpls(rsm, albedo=rsm.albedo_from(factors)).flux.sum().backward()
    torch.testing.assert_close(factors.grad[0], (rsm.texture * rsm.size[:, None]).sum(0))
    assert float(rsm.texture[:, 2].min()) > 0.2  # known although the floor's blue factor is 0


def test_errors():
    scene = panel_scene()
    raycaster = Raycaster(scene)
    with pytest.raises(ValueError, match=r"light: an area light \('panel'\) has no single viewpoint.*lit_surface_vpls"):
        render_rsm(scene, scene.lights[0], raycaster)
    with pytest.raises(ValueError, match="resolution: expected at least 1 texel, got 0"):
        render_rsm(scene, LIGHT, raycaster, resolution=0)
    with pytest.raises(ValueError, match="texel_flux: expected 'exact', 'small_texel' or 'thesis', got 'paper'"):
        render_rsm(scene, LIGHT, raycaster, texel_flux="paper")
    rsm = traced()
    with pytest.raises(TypeError, match="rsm: expected difflpv.rsm.Rsm, got Scene"):
        rsm_vpls(scene)
    with pytest.raises(ValueError, match=r"position: expected shape \[3\], got \[1, 3\]"):
        rsm_vpls(rsm, position=rsm.position[None])
    with pytest.raises(TypeError, match="power: expected torch.float64"):
        rsm_vpls(rsm, power=rsm.power.float())
    with pytest.raises(ValueError, match="position.*finite"):
        rsm_vpls(rsm, position=rsm.position / 0)
    with pytest.raises(ValueError, match=r"albedo: expected shape \[384, 3\], got \[3\]"):
        rsm_vpls(rsm, albedo=rsm.albedo[0])
    with pytest.raises(ValueError, match="position: a directional light has none"):
        rsm_vpls(traced(SUN), position=rsm.position)
    with pytest.raises(ValueError, match=r"plane: expected shape \[384\], got \[383\]"):
        replace(rsm, plane=rsm.plane[1:])
    with pytest.raises(ValueError, match=r"mesh_index: expected int64 of shape \[384\]"):
        replace(rsm, mesh_index=rsm.mesh_index.int())
    assert isinstance(rsm, Rsm)


@pytest.mark.gpu
def test_cuda_equals_cpu(cuda):
    rsm = traced(resolution=16)
    there = traced(resolution=16, device=cuda)
    results = []
    for r in (rsm, there):
        inputs = [t.clone().requires_grad_() for t in (r.position, r.power, r.albedo)]
        vpls = rsm_vpls(r, position=inputs[0], power=inputs[1], albedo=inputs[2])
        (vpls.position.sin().sum() + vpls.flux.square().sum()).backward()
        results.append([vpls.position, vpls.flux, *(t.grad for t in inputs)])
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b.cpu(), rtol=1e-10, atol=1e-10)
