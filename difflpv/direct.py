"""Direct light: emitters, shadow rays, irradiance of surface points, and the VPLs that start a bounce.

Every light becomes a list of emitters: a point, spot or directional light is one, an area light one per sample of its
surface. Lit surface samples carry flux = albedo E_direct dA (Kaplanyan and Dachsbacher 2010 take it from an RSM; this
form works for every light and is the reference for ``difflpv.rsm``); the samples of an area light themselves carry
flux = pi L dA. Which emitter a point sees is traced once and held fixed: gradients pass through the geometry term only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch

from difflpv.bridge import check_float, launch, refuse_forward_mode, refuse_second_derivative, warp_scalar
from difflpv.coordinates import check_points
from difflpv.raycast import Raycaster
from difflpv.scene import AreaLight, DirectionalLight, PointLight, Scene, SpotLight
from difflpv.surface import SurfaceSamples, sample_area_light
from difflpv.vpl import Vpls
from warp_kernels.direct import AREA, DIRECTIONAL, POINT, RECEIVER_BLOCK, SPOT, direct_kernels

__all__ = [
    "Emitters",
    "area_light_vpls",
    "direct_irradiance",
    "drop_unlit",
    "emitters_of",
    "lit_surface_vpls",
    "visibility",
]

_PAIRS_PER_CHUNK = 1 << 20


@dataclass(frozen=True, eq=False)
class Emitters:
    """Lights as a flat list; replace ``position`` and ``power`` (``dataclasses.replace``, ``adjusted``) to learn them.

    Attributes:
        kind: 0 point, 1 spot, 2 directional, 3 area sample; [m] int32.
        position: [m,3] m; not read for directional lights.
        direction: unit vectors [m,3]: axis of a spot light, travel of a directional one, normal of the emitting side
            of an area sample; not read for point lights.
        power: [m,3]: W/sr for point, spot (on the axis) and area samples (radiance dA, along the normal), W/m2 on a
            surface that faces it for directional lights.
        cone: cosines of the inner and outer half-angle of spot lights, [m,2].
        light_index: index into ``scene.lights``, [m] int64.
    """

    kind: torch.Tensor
    position: torch.Tensor
    direction: torch.Tensor
    power: torch.Tensor
    cone: torch.Tensor
    light_index: torch.Tensor

    def __post_init__(self) -> None:
        check_float("position", self.position)
        count = len(self.position)
        for name, width in (("position", 3), ("direction", 3), ("power", 3), ("cone", 2)):
            tensor = getattr(self, name)
            check_float(name, tensor, like=self.position)
            if list(tensor.shape) != [count, width]:
                raise ValueError(f"{name}: expected shape [{count}, {width}], got {list(tensor.shape)}")
        for name, dtype in (("kind", torch.int32), ("light_index", torch.int64)):
            tensor = getattr(self, name)
            if tensor.dtype != dtype or list(tensor.shape) != [count]:
                got = f"{tensor.dtype} {list(tensor.shape)}"
                raise ValueError(f"{name}: expected {dtype} of shape [{count}], got {got}")

    def __len__(self) -> int:
        return len(self.position)

    def select(self, keep: torch.Tensor) -> Emitters:
        """The emitters that a boolean mask [m] or an index tensor names."""
        return replace(self, **{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    def adjusted(self, *, scale: torch.Tensor | None = None, offset: torch.Tensor | None = None) -> Emitters:
        """The same emitters with each light's power scaled and its position moved, differentiable in both.

        Args:
            scale: factor per light and channel, shape [lights, 3] (or [lights, 1]).
            offset: displacement per light [m], shape [lights, 3]; an area light moves as a whole.
        """
        power = self.power if scale is None else self.power * scale[self.light_index]
        position = self.position if offset is None else self.position + offset[self.light_index]
        return replace(self, power=power, position=position)


def emitters_of(
    scene: Scene,
    *,
    area_samples: int = 64,
    seed: int = 0,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Emitters:
    """All lights of a scene as emitters, in the order of ``scene.lights``.

    Args:
        scene: its point, spot, directional and area lights.
        area_samples: samples per area light and emitting side; a parallelogram gets a regular grid of about as many.
        seed: for area lights that are no parallelogram.
        dtype: float32 or float64.
        device: where the emitters are put.
    """
    rows: dict[str, list[Any]] = {field.name: [] for field in fields(Emitters)}

    def add(kind: int, light: int, position: Any, direction: Any, power: Any, cone: tuple[float, float]) -> None:
        position = np.asarray(position, np.float64).reshape(-1, 3)
        shape = position.shape
        rows["kind"].append(np.full(len(position), kind, np.int32))
        rows["position"].append(position)
        rows["direction"].append(np.broadcast_to(np.asarray(direction, np.float64), shape))
        rows["power"].append(np.broadcast_to(np.asarray(power, np.float64), shape))
        rows["cone"].append(np.broadcast_to(np.asarray(cone), (len(position), 2)))
        rows["light_index"].append(np.full(len(position), light, np.int64))

    for k, light in enumerate(scene.lights):
        if isinstance(light, PointLight):
            add(POINT, k, light.position, np.zeros(3), light.intensity, (1.0, 0.0))
        elif isinstance(light, SpotLight):
            cone = (math.cos(light.inner_angle), math.cos(light.outer_angle))
            add(SPOT, k, light.position, _unit(light.direction), light.intensity, cone)
        elif isinstance(light, DirectionalLight):
            add(DIRECTIONAL, k, np.zeros(3), _unit(light.direction), light.irradiance, (1.0, 0.0))
        elif isinstance(light, AreaLight):
            here = sample_area_light(scene, light, area_samples, seed=seed, dtype=torch.float64)
            power = here.area.numpy()[:, None] * np.asarray(light.radiance, np.float64)
            add(AREA, k, here.position.numpy(), here.normal.numpy(), power, (1.0, 0.0))
    tensors = {name: torch.from_numpy(np.concatenate(parts)).to(device) for name, parts in rows.items()}
    for name in ("position", "direction", "power", "cone"):
        tensors[name] = tensors[name].to(dtype)
    return Emitters(**tensors)


def _unit(vector: Any) -> np.ndarray:
    array = np.asarray(vector, np.float64)
    return array / np.linalg.norm(array)


def visibility(points: torch.Tensor, normals: torch.Tensor, emitters: Emitters, raycaster: Raycaster) -> torch.Tensor:
    """Which emitter a surface point sees, by one shadow ray each.

    Pairs where the point faces away from the emitter, or lies behind a one-sided area sample, count as not visible;
    the cone of a spot light does not. Refresh it after a light has moved far.

    Args:
        points: [n,3] m.
        normals: unit normals [n,3]; the rays start a little off the surface on their side.
        emitters: m emitters.
        raycaster: of the scene that blocks.

    Returns:
        0 or 1, uint8, shape [n,m], on the device of ``points``.

    Raises:
        TypeError: wrong type, dtype or device.
        ValueError: wrong shape, or a point that is not finite.
    """
    check_points("points", points)
    check_points("normals", normals, like=points, count=len(points))
    x, n = (t.detach().cpu().double().numpy() for t in (points, normals))
    kind, position, direction = (
        t.detach().cpu().numpy() for t in (emitters.kind, emitters.position.double(), emitters.direction.double())
    )
    start = x + raycaster.offset * n
    target = position + raycaster.offset * np.where(kind == AREA, 1.0, 0.0)[:, None] * direction
    seen = np.zeros((len(x), len(kind)), np.uint8)
    step = max(1, _PAIRS_PER_CHUNK // max(1, len(kind)))
    for begin in range(0, len(x), step):
        rows = slice(begin, begin + step)
        facing = n[rows] @ position.T - (n[rows] * x[rows]).sum(1)[:, None] > 0
        leaving = x[rows] @ direction.T - (position * direction).sum(1) > 0
        parallel = n[rows] @ direction.T < 0
        wanted = np.where(kind == DIRECTIONAL, parallel, facing & (leaving | (kind != AREA)))
        i, j = np.nonzero(wanted)
        far = kind[j] == DIRECTIONAL
        free = np.empty(len(i), bool)
        free[~far] = ~raycaster.blocked(start[rows][i[~far]], target[j[~far]])
        free[far] = ~raycaster.blocked_along(start[rows][i[far]], -direction[j[far]], np.inf)
        seen[begin + i[free], j[free]] = 1
    return torch.from_numpy(seen).to(points.device)


@torch.library.custom_op("difflpv::direct_irradiance", mutates_args=())
def _irradiance(
    points: torch.Tensor,
    normals: torch.Tensor,
    kind: torch.Tensor,
    position: torch.Tensor,
    direction: torch.Tensor,
    power: torch.Tensor,
    cone: torch.Tensor,
    visible: torch.Tensor,
) -> torch.Tensor:
    result = torch.zeros_like(points, memory_format=torch.contiguous_format)
    inputs = _kernel_inputs(points, normals, kind, position, direction, power, cone, visible)
    launch(direct_kernels(warp_scalar(points.dtype)).forward, len(points), [*inputs, result], points.device)
    return result


@_irradiance.register_fake
def _(points, normals, kind, position, direction, power, cone, visible):
    return torch.empty_like(points, memory_format=torch.contiguous_format)


@torch.library.custom_op("difflpv::direct_irradiance_adjoint", mutates_args=())
def _irradiance_adjoint(
    bar: torch.Tensor,
    points: torch.Tensor,
    normals: torch.Tensor,
    kind: torch.Tensor,
    position: torch.Tensor,
    direction: torch.Tensor,
    power: torch.Tensor,
    cone: torch.Tensor,
    visible: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    blocks = -(-len(points) // RECEIVER_BLOCK)
    partials = [position.new_zeros((blocks, len(kind), 3)) for _ in range(2)]
    inputs = _kernel_inputs(points, normals, kind, position, direction, power, cone, visible)
    kernel = direct_kernels(warp_scalar(points.dtype)).adjoint
    launch(kernel, (blocks, len(kind)), [*inputs, bar.contiguous(), *partials], points.device)
    return partials[0].sum(0), partials[1].sum(0)


@_irradiance_adjoint.register_fake
def _(bar, points, normals, kind, position, direction, power, cone, visible):
    return tuple(torch.empty_like(t, memory_format=torch.contiguous_format) for t in (position, power))


def _kernel_inputs(*tensors: torch.Tensor) -> list[torch.Tensor]:
    return [t.contiguous() for t in tensors]


def _setup(ctx: Any, inputs: tuple[torch.Tensor, ...], output: torch.Tensor) -> None:
    ctx.save_for_backward(*inputs)


def _backward(ctx: Any, bar: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    position_bar, power_bar = _irradiance_adjoint(bar, *ctx.saved_tensors)
    return None, None, None, position_bar, None, power_bar, None, None


_irradiance.register_autograd(_backward, setup_context=_setup)
refuse_second_derivative("direct_irradiance", _irradiance_adjoint)


def direct_irradiance(
    points: torch.Tensor, normals: torch.Tensor, emitters: Emitters, visible: torch.Tensor
) -> torch.Tensor:
    """Irradiance by all emitters: E = sum_j V_ij G_ij P_j (``warp_kernels.direct``).

    Args:
        points: [n,3] m.
        normals: unit normals [n,3].
        emitters: m emitters; ``position`` and ``power`` are differentiable, nothing else is.
        visible: ``visibility`` of the same points and emitters, uint8 or bool [n,m]; held fixed.

    Returns:
        Irradiance [W/m2], shape [n,3]. A pair closer than a micrometre adds nothing.

    Raises:
        TypeError: wrong type, dtype or device of an argument.
        ValueError: wrong shape, a number that is not finite, or a gradient asked for where there is none.
    """
    if not isinstance(emitters, Emitters):
        raise TypeError(f"emitters: expected difflpv.direct.Emitters, got {type(emitters).__name__}")
    check_points("points", points)
    check_points("normals", normals, like=points, count=len(points))
    check_points("emitters.position", emitters.position, like=points)
    check_points("emitters.power", emitters.power, like=points)
    if visible.dtype not in (torch.uint8, torch.bool):
        raise TypeError(f"visible: expected torch.uint8 or torch.bool, got {visible.dtype}")
    if list(visible.shape) != [len(points), len(emitters)]:
        raise ValueError(f"visible: expected shape [{len(points)}, {len(emitters)}], got {list(visible.shape)}")
    fixed = {"points": points, "normals": normals, "emitters.direction": emitters.direction}
    for name, tensor in fixed.items():
        if tensor.requires_grad:
            raise ValueError(f"{name}: expected no requires_grad: only emitters.position and .power have gradients")
    refuse_forward_mode("direct_irradiance", points, normals, emitters.position, emitters.power, emitters.direction)
    e = emitters
    return _irradiance(points, normals, e.kind, e.position, e.direction, e.power, e.cone, visible.to(torch.uint8))


def drop_unlit(samples: SurfaceSamples, visible: torch.Tensor) -> tuple[SurfaceSamples, torch.Tensor]:
    """The samples that some emitter reaches and their rows of ``visible``; once, before an optimisation."""
    keep = visible.bool().any(1)
    return samples.select(keep), visible[keep]


def lit_surface_vpls(
    samples: SurfaceSamples, emitters: Emitters, visible: torch.Tensor, *, albedo: torch.Tensor | None = None
) -> Vpls:
    """One VPL per surface sample with the flux that it reflects: albedo E_direct dA.

    Args:
        samples: n surface samples; none is dropped, so shapes stay fixed under ``torch.compile``.
        emitters: m emitters, see ``direct_irradiance`` for its gradients.
        visible: ``visibility`` of the samples, [n,m].
        albedo: differentiable albedo [n,3] (``samples.albedo_from``) in place of ``samples.albedo``.

    Returns:
        VPLs on the samples' sides, flux [W].

    Raises:
        TypeError: wrong type, dtype or device of an argument.
        ValueError: wrong shape, or a number that is not finite.
    """
    rho = samples.albedo if albedo is None else albedo
    check_points("albedo", rho, like=samples.position, count=len(samples))
    irradiance = direct_irradiance(samples.position, samples.normal, emitters, visible)
    return Vpls(samples.position, samples.normal, rho * irradiance * samples.area[:, None])


def area_light_vpls(emitters: Emitters) -> Vpls:
    """VPLs of the area-light samples among ``emitters``: flux = pi L dA [W], for the component ``direct``."""
    area = emitters.select(emitters.kind == AREA)
    return Vpls(area.position, area.direction, math.pi * area.power)
