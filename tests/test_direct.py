import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hand_scenes import box_scene, panel_scene, random_emitters, random_receivers, rectangle
from hypothesis import given, settings
from hypothesis import strategies as st

from difflpv import direct
from difflpv.direct import (
    Emitters,
    area_light_vpls,
    direct_irradiance,
    drop_unlit,
    emitters_of,
    lit_surface_vpls,
    visibility,
)
from difflpv.raycast import Raycaster
from difflpv.reference import direct as twin
from difflpv.scene import DirectionalLight, PointLight, Scene, SpotLight
from difflpv.surface import sample_surfaces


def tensors_of(e):
    return e.kind, e.position, e.direction, e.power, e.cone


def one_emitter(kind, dtype=torch.float64, **values):
    filled = {"position": (0.0, 0, 0), "direction": (0.0, 0, -1), "power": (1.0, 2, 3), "cone": (1.0, 0.0)} | values
    tensors = {k: torch.tensor([v], dtype=dtype) for k, v in filled.items()}
    return Emitters(torch.tensor([kind], dtype=torch.int32), light_index=torch.zeros(1, dtype=torch.int64), **tensors)


def irradiance_at(emitters, point, normal):
    dtype = emitters.position.dtype
    x, n = torch.tensor([point], dtype=dtype), torch.tensor([normal], dtype=dtype)
    return direct_irradiance(x, n, emitters, torch.ones(1, len(emitters), dtype=torch.bool))[0]


def test_equals_twin(generator, dtype, relative_tolerance):
    points, normals = random_receivers(600, generator, dtype)  # more than two blocks of the adjoint
    emitters = random_emitters(9, generator, dtype)
    seen = (torch.rand(600, 9, generator=generator) < 0.7).to(torch.uint8)
    position, power = emitters.position.requires_grad_(), emitters.power.requires_grad_()
    ours = direct_irradiance(points, normals, emitters, seen)
    theirs = twin.direct_irradiance(points, normals, *tensors_of(emitters), seen)
    assert ours.shape == (600, 3)
    cotangent = torch.randn(ours.shape, generator=generator, dtype=dtype)
    gradients = (torch.autograd.grad(value, (position, power), cotangent) for value in (ours, theirs))
    for a, b in [(ours, theirs), *zip(*gradients, strict=True)]:
        torch.testing.assert_close(a, b, rtol=0, atol=relative_tolerance(dtype) * float(b.detach().abs().max()))


@settings(max_examples=30, deadline=None)
@given(distance=st.floats(0.01, 100), angle=st.floats(0, math.pi / 2 - 0.01))
def test_point_light_closed_form(distance, angle):
    # E = I cos(theta) / d^2
    normal = (math.sin(angle), 0.0, math.cos(angle))
    measured = irradiance_at(one_emitter(direct.POINT, position=(0.0, 0, distance)), (0.0, 0, 0), normal)
    expected = np.array([1.0, 2, 3]) * math.cos(angle) / distance**2
    np.testing.assert_allclose(measured, expected, rtol=1e-12)


def test_directional_light_closed_form(dtype):
    # E cos(theta), whatever the receiver's position
    angle = 0.7
    emitter = one_emitter(direct.DIRECTIONAL, dtype, direction=(math.sin(angle), 0.0, -math.cos(angle)))
    measured = irradiance_at(emitter, (50.0, 3, -2), (0.0, 0, 1))
    np.testing.assert_allclose(measured, np.array([1.0, 2, 3]) * math.cos(angle), rtol=1e-6)


def test_spot_light_falloff():
    light = SpotLight(np.zeros(3), np.array([0.0, 0, -2]), np.array([1.0, 2, 3]), 0.2, 0.6)
    emitters = emitters_of(Scene("spot", box_scene().meshes, (light,)), dtype=torch.float64)
    for angle in (0.0, 0.1, 0.3, 0.5, 0.59, 0.7):
        point = (math.sin(angle) * 2, 0.0, -math.cos(angle) * 2)
        measured = irradiance_at(emitters, point, (0.0, 0, 1))
        expected = light.intensity * light.falloff(np.cos(angle)) * math.cos(angle) / 4
        np.testing.assert_allclose(measured, expected, rtol=1e-12, atol=1e-15)


def polygon_irradiance(corners, point, normal):
    """Lambert's formula for a convex polygon of unit radiance above the receiver's plane: E = sum theta_k n.g_k / 2."""
    rays = corners - point
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    total = 0.0
    for a, b in zip(rays, np.roll(rays, -1, axis=0), strict=True):
        cross = np.cross(a, b)
        total += np.arccos(a @ b) / 2 * (cross / np.linalg.norm(cross)) @ normal
    return abs(total)


@pytest.mark.parametrize(("samples", "tolerance"), [(16, 0.03), (64, 0.01), (400, 0.002)])
def test_rectangle_light_closed_form(samples, tolerance):
    scene = panel_scene()
    points = torch.tensor([[0.0, 0, 0], [1.3, 0, 0.4], [-0.6, 0.2, 0.1], [0.2, 0, -1.5]], dtype=torch.float64)
    normals = torch.tensor([[0.0, 1, 0]], dtype=torch.float64).expand(4, 3)
    emitters = emitters_of(scene, area_samples=samples, dtype=torch.float64)
    measured = direct_irradiance(points, normals, emitters, visibility(points, normals, emitters, Raycaster(scene)))
    corners = scene.meshes[1].vertices
    shape = np.array([polygon_irradiance(corners, p, np.array([0.0, 1, 0])) for p in points.numpy()])
    np.testing.assert_allclose(measured, shape[:, None] * [5.0, 3, 1], rtol=tolerance)


def test_area_light_emits_on_its_own_side_only():
    points, normals = torch.tensor([[0.0, 0.5, 0], [0, 1.5, 0]]), torch.tensor([[0.0, 1, 0], [0, -1, 0]])
    for two_sided in (False, True):
        scene = panel_scene(two_sided=two_sided)
        emitters = emitters_of(scene)
        result = direct_irradiance(points, normals, emitters, visibility(points, normals, emitters, Raycaster(scene)))
        assert float(result[0].min()) > 0
        assert bool((result[1] > 0).all()) is two_sided
        if two_sided:
            torch.testing.assert_close(result[0], result[1], rtol=1e-5, atol=0)


def test_shadows():
    # A plate of 1 x 1 m half way between a light and the floor: a shadow of 2 x 2 m.
    floor = rectangle("floor", (-4, 0, -4), (0, 0, 8), (8, 0, 0))
    plate = rectangle("plate", (-0.5, 1, -0.5), (0, 0, 1), (1, 0, 0))
    lamp = PointLight(np.array([0.0, 2, 0]), np.ones(3))
    sun = DirectionalLight(np.array([0.0, -1, 0]), np.ones(3))
    scene = Scene("plate", (floor, plate), (lamp, sun))
    x = torch.linspace(-3.93, 3.93, 40)
    points = torch.stack([x, torch.zeros(40), torch.zeros(40)], 1)
    up = torch.tensor([[0.0, 1, 0]]).expand(40, 3)
    emitters = emitters_of(scene)
    seen = visibility(points, up, emitters, Raycaster(scene))
    assert seen.dtype == torch.uint8
    assert torch.equal(seen[:, 0].bool(), x.abs() > 1)
    assert torch.equal(seen[:, 1].bool(), x.abs() > 0.5)
    assert not visibility(points, -up, emitters, Raycaster(scene)).any()
    assert visibility(points[:0], up[:0], emitters, Raycaster(scene)).shape == (0, 2)


def test_emitters_of_every_light():
    lamp = PointLight(np.array([0.0, 0.5, 0]), np.array([1.0, 2, 3]))
    spot = SpotLight(np.array([0.1, 0.5, 0]), np.array([0.0, -3, 0]), np.array([1.0, 0, 0]), 0.1, 0.5)
    sun = DirectionalLight(np.array([0.0, -2, 0]), np.array([4.0, 4, 4]))
    scene = panel_scene()
    emitters = emitters_of(replace(scene, lights=(lamp, *scene.lights, spot, sun)), area_samples=4, dtype=torch.float64)
    assert emitters.kind.tolist() == [0, 3, 3, 3, 3, 1, 2]
    assert emitters.light_index.tolist() == [0, 1, 1, 1, 1, 2, 3]
    torch.testing.assert_close(emitters.power[1], torch.tensor([5.0, 3, 1], dtype=torch.float64) * 0.6 / 4)
    torch.testing.assert_close(emitters.cone[5], torch.tensor([0.1, 0.5], dtype=torch.float64).cos())
    assert emitters.direction[5:].tolist() == [[0, -1, 0], [0, -1, 0]]


def test_adjusted_scales_and_moves_each_light(generator, dtype):
    emitters = random_emitters(6, generator, dtype)  # lights 0 0 1 1 2 2
    scale = torch.tensor([[1.0], [2], [3]], dtype=dtype)
    offset = torch.rand(3, 3, generator=generator, dtype=dtype)
    moved = emitters.adjusted(scale=scale, offset=offset)
    torch.testing.assert_close(moved.power, emitters.power * scale.repeat_interleave(2, 0))
    torch.testing.assert_close(moved.position, emitters.position + offset.repeat_interleave(2, 0))
    assert torch.equal(emitters.adjusted().power, emitters.power)


def test_panel_vpls_carry_the_panels_flux():
    scene = panel_scene()  # flux of a Lambert panel: pi L A
    vpls = area_light_vpls(emitters_of(scene, dtype=torch.float64))
    np.testing.assert_allclose(vpls.flux.sum(0), math.pi * 0.6 * np.array([5.0, 3, 1]), rtol=1e-12)
    assert vpls.normal[:, 1].unique().tolist() == [-1.0]


def test_lit_surfaces_of_a_closed_box_reflect_all_flux():
    # Every photon of a point light in a closed box meets a wall: sum Phi = sum_walls rho 4 pi I share, equal rho.
    scene = box_scene(albedo=np.array([0.5, 0.25, 0.75]))
    samples = sample_surfaces(scene, 6000, dtype=torch.float64)
    emitters = emitters_of(scene, dtype=torch.float64)
    seen = visibility(samples.position, samples.normal, emitters, Raycaster(scene))
    lit, lit_seen = drop_unlit(samples, seen)
    assert len(lit) == len(samples) // 2  # only inner sides are lit
    full, kept = lit_surface_vpls(samples, emitters, seen), lit_surface_vpls(lit, emitters, lit_seen)
    torch.testing.assert_close(full.flux.sum(0), kept.flux.sum(0))
    expected = 4 * math.pi * scene.lights[0].intensity * [0.5, 0.25, 0.75]
    np.testing.assert_allclose(kept.flux.sum(0), expected, rtol=2e-3)


def test_lit_surface_gradients(generator):
    scene = box_scene()
    samples = sample_surfaces(scene, 30, dtype=torch.float64, both_sides=False)
    emitters = emitters_of(scene, dtype=torch.float64)
    seen = visibility(samples.position, samples.normal, emitters, Raycaster(scene))

    def flux(position, power, albedo):
        lights = replace(emitters, position=position, power=power)
        return lit_surface_vpls(samples, lights, seen, albedo=samples.albedo_from(albedo)).flux

    inputs = [emitters.position, emitters.power, torch.rand(6, 3, generator=generator, dtype=torch.float64)]
    assert torch.autograd.gradcheck(flux, [t.clone().requires_grad_() for t in inputs])


def test_promises_of_a_differentiable_op(generator, check_op):
    points, normals = random_receivers(12, generator, torch.float64)
    emitters = random_emitters(8, generator, torch.float64)
    seen = torch.ones(12, 8, dtype=torch.uint8)

    def function(position, power):
        return direct_irradiance(points, normals, replace(emitters, position=position, power=power), seen)

    check_op(function, [emitters.position, emitters.power])


def test_opcheck(generator, dtype):
    points, normals = random_receivers(5, generator, dtype)
    e = random_emitters(4, generator, dtype)
    seen = torch.ones(5, 4, dtype=torch.uint8)
    inputs = (points, normals, e.kind, e.position.requires_grad_(), e.direction, e.power.requires_grad_(), e.cone, seen)
    torch.library.opcheck(direct._irradiance, inputs)
    detached = tuple(t.detach() for t in inputs)
    torch.library.opcheck(direct._irradiance_adjoint, (torch.ones_like(points), *detached))


def test_non_contiguous_and_bool_visibility(generator, dtype):
    points, normals = random_receivers(20, generator, dtype)
    emitters = random_emitters(8, generator, dtype)
    seen = torch.rand(20, 8, generator=generator) < 0.5
    expected = direct_irradiance(points, normals, emitters, seen.to(torch.uint8))
    strided = [t.t().contiguous().t() for t in (points, normals, emitters.position, emitters.power, seen)]
    moved = replace(emitters, position=strided[2], power=strided[3])
    assert torch.equal(direct_irradiance(strided[0], strided[1], moved, strided[4]), expected)


def test_empty_input(generator, dtype):
    points, normals = random_receivers(3, generator, dtype)
    emitters = random_emitters(4, generator, dtype)
    none = emitters.select(torch.zeros(0, dtype=torch.long))
    assert not direct_irradiance(points, normals, none, torch.zeros(3, 0, dtype=torch.uint8)).any()
    power = emitters.power.requires_grad_()
    nothing = direct_irradiance(points[:0], normals[:0], emitters, torch.zeros(0, 4, dtype=torch.uint8))
    assert nothing.shape == (0, 3)
    nothing.sum().backward()
    assert power.grad.shape == (4, 3) and not power.grad.any()


def test_receiver_on_an_emitter_gets_nothing(dtype):
    for kind in (direct.POINT, direct.SPOT, direct.AREA):
        emitter = one_emitter(kind, dtype)
        emitter.position.requires_grad_()
        result = irradiance_at(emitter, (0.0, 0, 0), (0.0, 0, 1))
        result.sum().backward()
        assert not result.any() and not emitter.position.grad.any()


def test_errors(generator):
    points, normals = random_receivers(3, generator, torch.float32)
    emitters = random_emitters(4, generator, torch.float32)
    seen = torch.ones(3, 4, dtype=torch.uint8)
    with pytest.raises(TypeError, match="emitters: expected difflpv.direct.Emitters, got list"):
        direct_irradiance(points, normals, [], seen)
    with pytest.raises(ValueError, match=r"normals: expected shape \[3, 3\], got \[2, 3\]"):
        direct_irradiance(points, normals[:2], emitters, seen)
    with pytest.raises(TypeError, match="emitters.position: expected torch.float64"):
        direct_irradiance(points.double(), normals.double(), emitters, seen)
    with pytest.raises(TypeError, match="visible: expected torch.uint8 or torch.bool, got torch.float32"):
        direct_irradiance(points, normals, emitters, seen.float())
    with pytest.raises(ValueError, match=r"visible: expected shape \[3, 4\], got \[3, 3\]"):
        direct_irradiance(points, normals, emitters, seen[:, :3])
    with pytest.raises(ValueError, match="points: expected no requires_grad"):
        direct_irradiance(points.clone().requires_grad_(), normals, emitters, seen)
    with pytest.raises(ValueError, match="emitters.power.*finite"):
        direct_irradiance(points, normals, replace(emitters, power=emitters.power * float("nan")), seen)
    with pytest.raises(ValueError, match="points.*finite"):
        visibility(points * float("inf"), normals, emitters, Raycaster(box_scene()))
    with pytest.raises(ValueError, match=r"cone: expected shape \[4, 2\]"):
        replace(emitters, cone=emitters.cone[:, :1])
    with pytest.raises(ValueError, match=r"kind: expected torch.int32 of shape \[4\]"):
        replace(emitters, kind=emitters.kind.long())
    samples = sample_surfaces(box_scene(), 24)
    with pytest.raises(ValueError, match=r"albedo: expected shape \[48, 3\], got \[3\]"):
        lit_surface_vpls(samples, emitters, torch.ones(48, 4, dtype=torch.uint8), albedo=torch.ones(3))


@pytest.mark.gpu
def test_cuda_equals_cpu(generator, cuda):
    points, normals = random_receivers(700, generator, torch.float64)
    emitters = random_emitters(8, generator, torch.float64)
    seen = torch.rand(700, 8, generator=generator) < 0.5
    results = []
    for device in (torch.device("cpu"), cuda):
        moved = {f: getattr(emitters, f).to(device) for f in ("kind", "direction", "cone", "light_index")}
        inputs = [t.detach().to(device).requires_grad_() for t in (emitters.position, emitters.power)]
        there = Emitters(position=inputs[0], power=inputs[1], **moved)
        value = direct_irradiance(points.to(device), normals.to(device), there, seen.to(device))
        (value / (1 + value)).sum().backward()
        results.append([value, *(t.grad for t in inputs)])
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b.cpu(), rtol=1e-9, atol=1e-9)
