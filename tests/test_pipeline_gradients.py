"""Finite differences over the whole chain for everything that an ``Lpv`` can learn, in float64.

Per-stage checks cannot see a mistake at a boundary between stages. Central differences are taken in the raw parameters,
through bounds, shading, injection, occlusion, propagation and sampling at once.

Kinks are avoided by where things stand, not by luck. The walls of the box lie at -1 and 1 and the panel at y = 1; the
grid's corner and cell size (0.39 m from -1.33, -1.27, -1.41) put no wall, and no wall shifted by half a cell, on a plane
of cell centres, where trilinear weights bend for all points of that wall at once. The lights stand at crooked places: at
y = 0.13 a row of texels of the regular map would hit the wall z = -1 on the very plane y = -0.295 of cell centres. What
may bend between the two points of a difference (the clamp of a face's flux, a VPL that slides over a plane, s B = 1 of
the clamped transmittance) are single terms; with steps of 1e-5 they stay far below the tolerance.
"""

import numpy as np
import pytest
import torch
from hand_scenes import box_scene, box_walls, panel_scene, rectangle

from difflpv.config import LpvConfig
from difflpv.grid import Grid
from difflpv.illumination import illuminate
from difflpv.pipeline import Lpv
from difflpv.scene import DirectionalLight, PointLight, Scene, SpotLight

GRID = Grid((-1.33, -1.27, -1.41), 0.39, (7, 7, 7))
STEPS = 3
TOLERANCE = 1e-4
POINT = PointLight(np.array([0.2137, 0.1291, -0.3173]), np.array([2.0, 3.0, 4.0]))
SPOT = SpotLight(
    np.array([0.1319, 0.7243, -0.2117]), np.array([0.2, -1.0, 0.3]), np.array([3.0, 2.0, 1.0]), inner_angle=0.3, outer_angle=0.9
)
SUN = DirectionalLight(np.array([0.3, -1.0, 0.2]), np.array([1.0, 2.0, 3.0]))
# Receivers on three walls and one in mid-air, off every plane of cell centres at the starting bias of half a cell.
POSITION = np.array([[0.31, -1.0, 0.22], [-1.0, 0.17, -0.35], [0.44, 0.27, 1.0], [0.05, 0.11, 0.61], [-0.4, -1.0, -0.63]])
NORMAL = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1], [0.6, 0.0, 0.8], [0, 1, 0]])

# Its top ends within a row of cells, so that some pairs there are blocked in part.
BLOCK = tuple(
    rectangle(f"block{k}", corner, first, second)
    for k, (corner, first, second) in enumerate(
        [
            ((-0.52, -1.0, 0.31), (0.71, 0, 0), (0, 0.83, 0)),
            ((-0.52, -0.17, 0.31), (0.71, 0, 0), (0, 0, 0.44)),
            ((-0.52, -1.0, 0.31), (0, 0.83, 0), (0, 0, 0.44)),
        ]
    )
)
SCENES = {
    "block bounce1": (Scene("block", (*box_walls(), *BLOCK), (POINT,)), "bounce1"),
    "point bounce1": (box_scene([POINT]), "bounce1"),
    "spot bounce1": (box_scene([SPOT]), "bounce1"),
    "area direct": (panel_scene(floor=2.1), "direct"),
    "area bounce1": (panel_scene(floor=2.1), "bounce1"),
    "point and spot direct": (box_scene([POINT, SPOT]), "direct"),
    "all bounce1": (box_scene([POINT, SPOT, SUN]), "bounce1"),
}


def set_up(name, learn, *, method="holpv", initial=None, **options):
    scene, component = SCENES[name]
    config = LpvConfig(method=method, steps=STEPS, **options)
    light = illuminate(
        scene, GRID, config, component, surface_samples=96, area_samples=9, rsm_resolution=8, dtype=torch.float64
    )
    lpv = Lpv(GRID, config, learn=learn, scene=scene, initial=initial)
    receivers = light.receivers(POSITION, NORMAL)
    cotangent = torch.rand(len(POSITION), 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64) + 0.2
    return lpv, lambda: (lpv(light, receivers) * cotangent).sum()


def analytic(lpv, loss):
    gradients = torch.autograd.grad(loss(), list(lpv.parameters()))
    return dict(zip(lpv.learned, gradients, strict=True))


@torch.no_grad()
def central(parameter, loss, step=1e-5):
    flat, found = parameter.view(-1), []
    for i in range(flat.numel()):
        here = flat[i].item()
        values = []
        for sign in (1, -1):
            flat[i] = here + sign * step
            values.append(loss().item())
        flat[i] = here
        found.append((values[0] - values[1]) / (2 * step))
    return torch.tensor(found, dtype=torch.float64).view(parameter.shape)


def check(lpv, loss, *, zero_rows=()):
    for name, gradient in analytic(lpv, loss).items():
        expected = central(getattr(lpv, f"raw_{name}"), loss)
        assert float(expected.norm()) > 1e-6, f"{name}: nothing to compare"
        difference = float((gradient - expected).norm() / expected.norm())
        assert difference < TOLERANCE, f"{name}: {gradient.tolist()} against {expected.tolist()}"
        for row in zero_rows:
            assert not gradient[row].any()


GLOBAL = {
    "propagation": {},
    "propagation_steps": {},
    "sampling_bias": {},
    "injection_bias": {"deposit": "trilinear"},
}


@pytest.mark.parametrize("method", ["lpv", "holpv"])
@pytest.mark.parametrize("learn", GLOBAL)
@pytest.mark.parametrize("name", ["point bounce1", "area direct"])
def test_what_belongs_to_the_volume(name, learn, method):
    # 0.37 cells: the floor of the panel scene lies a cell below its receivers at the default bias of one half
    lpv, loss = set_up(name, [learn], method=method, initial={learn: 0.37} if learn.endswith("bias") else None, **GLOBAL[learn])
    check(lpv, loss)


@pytest.mark.parametrize("learn", ["propagation", "propagation_steps", "sampling_bias", "light_position", "albedo"])
@pytest.mark.parametrize("method", ["lpv", "holpv", "learned_9x26"])
def test_linear_transport_on_convolutions(method, learn):
    options = {"occlusion": "none", "lookup": "trilinear", "deposit": "trilinear"}
    lpv, loss = set_up("point bounce1", [learn], method=method, clamp=False, **options)
    check(lpv, loss)


LEARNED = (
    "stencil", "lookup_gains", "occlusion", "occlusion_correction", "cell_propagation", "cell_occlusion", "propagation_steps",
    "injection_bias", "light_position", "albedo",
)  # fmt: skip


@pytest.mark.parametrize("learn", LEARNED)
@pytest.mark.parametrize("method", ["learned_4x6", "learned_9x26"])
def test_learned_stencils_behind_traced_occlusion(method, learn):
    """A room with a block in it: some pairs of cells see each other in part, so that strength has something to act on."""
    lpv, loss = set_up("block bounce1", [learn], method=method)
    check(lpv, loss)


def test_everything_of_a_learned_stencil_at_once():
    lpv, loss = set_up("block bounce1", list(LEARNED), method="learned_4x6")
    check(lpv, loss)


@pytest.mark.parametrize("method", ["lpv", "holpv"])
@pytest.mark.parametrize("learn", ["occlusion", "occlusion_correction", "cell_propagation", "cell_occlusion", "lookup_gains"])
def test_traced_occlusion_of_the_published_kernels(method, learn):
    lpv, loss = set_up("block bounce1", [learn], method=method, occlusion="traced", lookup="affine")
    check(lpv, loss)


@pytest.mark.parametrize("model", ["clamp", "exp"])
def test_geometry_volume_of_a_learned_stencil(model):
    options = {"method": "learned_9x6", "occlusion": model, "initial": {"occlusion": 0.43}}
    lpv, loss = set_up("block bounce1", ["occlusion", "stencil"], **options)
    check(lpv, loss)


@pytest.mark.parametrize("method", ["lpv", "holpv"])
@pytest.mark.parametrize(("model", "strength"), [("exp", 1.0), ("clamp", 0.43)])
def test_occlusion(model, strength, method):
    lpv, loss = set_up("point bounce1", ["occlusion"], method=method, occlusion=model, initial={"occlusion": strength})
    check(lpv, loss)


@pytest.mark.parametrize("method", ["lpv", "holpv"])
def test_everything_of_the_volume_at_once(method):
    learn = ["propagation", "propagation_steps", "occlusion", "sampling_bias", "injection_bias"]
    lpv, loss = set_up("point bounce1", learn, method=method, occlusion="exp", deposit="trilinear", occlude_first_step=True)
    check(lpv, loss)


@pytest.mark.parametrize("method", ["lpv", "holpv"])
@pytest.mark.parametrize("learn", ["light_intensity", "light_color"])
@pytest.mark.parametrize("name", [name for name in SCENES if name != "block bounce1"])
def test_power_of_lights(name, learn, method):
    lpv, loss = set_up(name, [learn], method=method)
    check(lpv, loss)


@pytest.mark.parametrize("method", ["lpv", "holpv"])
@pytest.mark.parametrize("name", ["point bounce1", "spot bounce1", "area direct", "area bounce1", "point and spot direct"])
def test_position_of_lights(name, method):
    lpv, loss = set_up(name, ["light_position"], method=method, deposit="trilinear")
    check(lpv, loss)


def test_a_directional_light_has_no_position():
    lpv, loss = set_up("all bounce1", ["light_position"], deposit="trilinear")
    check(lpv, loss, zero_rows=[2])


@pytest.mark.parametrize("method", ["lpv", "holpv"])
@pytest.mark.parametrize("name", ["point bounce1", "area bounce1"])
def test_albedo(name, method):
    lpv, loss = set_up(name, ["albedo"], method=method)
    check(lpv, loss)


def test_lights_and_albedo_at_once_behind_occlusion():
    learn = ["light_intensity", "light_color", "light_position", "albedo", "occlusion", "propagation"]
    lpv, loss = set_up("all bounce1", learn, occlusion="exp", deposit="trilinear")
    check(lpv, loss)


def test_power_is_linear_without_the_clamp():
    """E(2 I) = 2 E(I); with the clamp too, since all of S scales alike. So the gradient of E . c is E . c itself."""
    for clamp in (True, False):
        lpv, loss = set_up("area bounce1", ["light_intensity"], clamp=clamp)
        gradient = analytic(lpv, loss)["light_intensity"]
        physical = lpv.described[0]
        raw = lpv.raw_light_intensity.detach().requires_grad_()
        slope = torch.autograd.grad(physical.to_physical(raw).sum(), raw)[0]
        torch.testing.assert_close(gradient / slope, loss().detach().reshape(1), rtol=1e-10, atol=0)


@pytest.mark.parametrize("learn", [["propagation", "occlusion", "sampling_bias"], ["light_position", "albedo"]])
def test_two_backwards_through_one_forward_agree(learn):
    lpv, loss = set_up("point bounce1", learn, occlusion="exp", deposit="trilinear")
    value = loss()
    first = torch.autograd.grad(value, list(lpv.parameters()), retain_graph=True)
    again = torch.autograd.grad(value, list(lpv.parameters()))
    for a, b in zip(first, again, strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize(
    "learn", ["propagation", "occlusion", "sampling_bias", "injection_bias", "light_intensity", "light_position", "albedo"]
)
def test_a_second_derivative_raises(learn):
    lpv, loss = set_up("point bounce1", [learn], occlusion="exp", deposit="trilinear")
    (gradient,) = torch.autograd.grad(loss().square(), list(lpv.parameters()), create_graph=True)
    with pytest.raises(NotImplementedError, match="second derivatives are not supported"):
        torch.autograd.grad(gradient.sum(), list(lpv.parameters()))


def test_checkpoints_do_not_change_a_gradient():
    lpv, loss = set_up("point bounce1", ["propagation_steps", "occlusion"], occlusion="exp")
    stored = analytic(lpv, loss)
    lpv.checkpoint_every = 2
    for name, gradient in analytic(lpv, loss).items():
        torch.testing.assert_close(gradient, stored[name], rtol=1e-12, atol=0)
