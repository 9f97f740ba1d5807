"""Reflective shadow maps: what a point, spot or directional light sees, as VPLs that follow the light.

The map is traced once (Embree) at the light's pose; each texel keeps the plane that it hit. ``rsm_vpls`` then moves and
recolours the light differentiably: hits slide on their planes along fixed directions. That is exact for small moves;
trace again after large ones, for a grazing texel slides far beyond its triangle.

Source: Dachsbacher and Stamminger 2005, Reflective Shadow Maps; Kaplanyan and Dachsbacher 2010, section 4.1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from difflpv.bridge import check_float, launch, refuse_forward_mode, refuse_second_derivative, warp_scalar
from difflpv.coordinates import check_points
from difflpv.raycast import Raycaster
from difflpv.scene import AreaLight, DirectionalLight, Light, Scene, SpotLight
from difflpv.vpl import Vpls
from warp_kernels.rsm import TEXEL_BLOCK, rsm_kernels

__all__ = ["Rsm", "TexelFlux", "render_rsm", "rsm_blockers", "rsm_vpls", "texel_solid_angle"]

TexelFlux = Literal["exact", "small_texel", "thesis"]

_WIDE_SPOT = math.radians(70)  # from here on one perspective face would waste its texels: six cube faces instead
_MIN_COSINE = 1e-2  # a texel seen more edge-on than this would stand for more surface than its triangle has


@dataclass(frozen=True, eq=False)
class Rsm:
    """The lit texels of a reflective shadow map (misses are left out).

    Attributes:
        light: ``"point"``, ``"spot"`` or ``"directional"``.
        light_index: index of the light into ``scene.lights``, -1 if it is none of them.
        texel_count: texels of the whole map, hits and misses.
        position: where the light stood [m], [3]; zero for a directional light.
        power: its intensity [W/sr], for a directional light its irradiance [W/m2], [3].
        offset: ray origins relative to ``position`` [m], [t,3]; zero for a point or spot light.
        direction: unit ray directions, [t,3].
        normal: unit normal of the hit triangle on its lit side, [t,3].
        plane: offset c of the hit triangle's plane normal.x = c [m], [t].
        size: solid angle [sr], for a directional light area across the light [m2], [t].
        attenuation: falloff of a spot light; times the cosine for ``texel_flux="thesis"``; else 1; [t].
        albedo: [t,3], textures included: the mesh's factor times ``texture``.
        texture: value of the albedo texture, 1 where there is none, [t,3].
        mesh_index: index into ``scene.meshes``, [t] int64.
    """

    light: Literal["point", "spot", "directional"]
    light_index: int
    texel_count: int
    position: torch.Tensor
    power: torch.Tensor
    offset: torch.Tensor
    direction: torch.Tensor
    normal: torch.Tensor
    plane: torch.Tensor
    size: torch.Tensor
    attenuation: torch.Tensor
    albedo: torch.Tensor
    texture: torch.Tensor
    mesh_index: torch.Tensor

    def __post_init__(self) -> None:
        check_float("direction", self.direction)
        count = len(self.direction)
        shapes = dict.fromkeys(("position", "power"), [3])
        shapes |= dict.fromkeys(("offset", "direction", "normal", "albedo", "texture"), [count, 3])
        shapes |= dict.fromkeys(("plane", "size", "attenuation"), [count])
        for name, shape in shapes.items():
            tensor = getattr(self, name)
            check_float(name, tensor, like=self.direction)
            if list(tensor.shape) != shape:
                raise ValueError(f"{name}: expected shape {shape}, got {list(tensor.shape)}")
        if self.mesh_index.dtype != torch.int64 or list(self.mesh_index.shape) != [count]:
            got = f"{self.mesh_index.dtype} {list(self.mesh_index.shape)}"
            raise ValueError(f"mesh_index: expected int64 of shape [{count}], got {got}")

    def __len__(self) -> int:
        return len(self.direction)

    def albedo_from(self, factors: torch.Tensor) -> torch.Tensor:
        """Albedo [t,3] from one factor per mesh [M,3] (``surface.albedo_by_mesh``), differentiable in the factors."""
        return factors[self.mesh_index] * self.texture


def texel_solid_angle(half_extent: float, resolution: int, *, small_texel: bool = False) -> np.ndarray:
    """Solid angles of a square perspective face's texels.

    Args:
        half_extent: tangent of half the field of view; 1 for a cube face, whose exact texels sum to 4 pi / 6.
        resolution: texels along an edge.
        small_texel: 4 cos^3 tan^2(FOV/2) / N^2 at the texel's centre in place of the exact form.

    Returns:
        Solid angle [sr], shape [resolution, resolution].
    """
    if small_texel:
        centre = _centres(resolution) * half_extent
        square = 1 + centre[:, None] ** 2 + centre[None, :] ** 2
        return 4 * half_extent**2 / resolution**2 * square**-1.5
    edge = np.linspace(-half_extent, half_extent, resolution + 1)
    x, y = edge[:, None], edge[None, :]
    corner = np.arctan2(x * y, np.sqrt(1 + x * x + y * y))
    return corner[1:, 1:] - corner[:-1, 1:] - corner[1:, :-1] + corner[:-1, :-1]


def render_rsm(
    scene: Scene,
    light: Light,
    raycaster: Raycaster,
    *,
    resolution: int = 64,
    texel_flux: TexelFlux = "exact",
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Rsm:
    """Trace the map of a light: six cube faces (point), one perspective face (spot), orthographic (directional).

    Args:
        scene: what the light shines on.
        light: a point, spot or directional light. A spot light wider than 70 degrees takes six cube faces.
        raycaster: of the same scene.
        resolution: texels along the edge of a face, at least 1.
        texel_flux: what a texel receives. ``"exact"``: intensity x exact solid angle; ``"small_texel"``: its
            approximation 4 cos^3 tan^2(FOV/2) / N^2; ``"thesis"``: that times the cosine at the surface, which counts
            the cosine twice, only to reproduce published numbers. A directional light's texel receives irradiance x
            area across the light (``"thesis"``: times the cosine).
        dtype: float32 or float64.
        device: where the map is put.

    Returns:
        The texels that hit a surface.

    Raises:
        ValueError: an area light, ``resolution`` below 1, an unknown ``texel_flux``.
    """
    if isinstance(light, AreaLight):
        raise ValueError(
            f"light: an area light ('{light.mesh}') has no single viewpoint, so no RSM; use "
            "difflpv.direct.lit_surface_vpls for its first bounce"
        )
    if resolution < 1:
        raise ValueError(f"resolution: expected at least 1 texel, got {resolution}")
    if texel_flux not in ("exact", "small_texel", "thesis"):
        raise ValueError(f"texel_flux: expected 'exact', 'small_texel' or 'thesis', got {texel_flux!r}")
    kind: Literal["point", "spot", "directional"]
    if isinstance(light, DirectionalLight):
        kind, power, position = "directional", light.irradiance, np.zeros(3)
        offset, direction, size = _parallel_rays(scene, _unit(light.direction), resolution)
        attenuation = np.ones(len(size))
    else:
        power, position = light.intensity, np.asarray(light.position, np.float64)
        small = texel_flux != "exact"
        if isinstance(light, SpotLight):
            kind = "spot"
            direction, size = _spot_rays(light, resolution, small)
            attenuation = light.falloff(direction @ _unit(light.direction))
        else:
            kind = "point"
            direction, size = _cube_rays(resolution, small)
            attenuation = np.ones(len(size))
        offset = np.zeros_like(direction)
    texel_count = len(size)
    hits = raycaster.closest(position + offset, direction)
    lit = hits.valid & (attenuation > 0)
    triangle = hits.triangle[lit]
    offset, direction, size, attenuation = (a[lit] for a in (offset, direction, size, attenuation))
    normal = scene.triangle_normals[triangle]
    cosine = (normal * direction).sum(1)
    normal = np.where(cosine > 0, -1.0, 1.0)[:, None] * normal
    if texel_flux == "thesis":
        attenuation = attenuation * np.abs(cosine)
    mesh = scene.triangle_mesh[triangle]
    texture = scene.texture_at(triangle, hits.barycentric[lit])
    arrays = {
        "position": position, "power": power, "offset": offset, "direction": direction, "normal": normal,
        "plane": (normal * scene.triangle_vertices[triangle, 0]).sum(1), "size": size, "attenuation": attenuation,
        "albedo": scene.mesh_albedo[mesh] * texture, "texture": texture,
    }  # fmt: skip
    index = next((k for k, other in enumerate(scene.lights) if other is light), -1)
    tensors = {k: torch.as_tensor(np.asarray(a, np.float64), dtype=dtype, device=device) for k, a in arrays.items()}
    return Rsm(kind, index, texel_count, mesh_index=torch.as_tensor(mesh, device=device), **tensors)


def _unit(vector: Any) -> np.ndarray:
    array = np.asarray(vector, np.float64)
    return array / np.linalg.norm(array)


def _centres(resolution: int) -> np.ndarray:
    return (2 * np.arange(resolution) + 1) / resolution - 1


def _frame(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors that complete ``axis`` to an orthogonal frame."""
    first = _unit(np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))]))
    return first, np.cross(axis, first)


def _face_rays(axis: np.ndarray, half_extent: float, resolution: int, small: bool) -> tuple[np.ndarray, np.ndarray]:
    u, v = _frame(axis)
    x, y = np.meshgrid(_centres(resolution) * half_extent, _centres(resolution) * half_extent, indexing="ij")
    rays = axis + x.reshape(-1, 1) * u + y.reshape(-1, 1) * v
    size = texel_solid_angle(half_extent, resolution, small_texel=small).reshape(-1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True), size


def _cube_rays(resolution: int, small: bool) -> tuple[np.ndarray, np.ndarray]:
    axes = [sign * np.eye(3)[axis] for axis in range(3) for sign in (1.0, -1.0)]
    faces = [_face_rays(axis, 1.0, resolution, small) for axis in axes]
    return np.concatenate([f[0] for f in faces]), np.concatenate([f[1] for f in faces])


def _spot_rays(light: SpotLight, resolution: int, small: bool) -> tuple[np.ndarray, np.ndarray]:
    if light.outer_angle > _WIDE_SPOT:
        return _cube_rays(resolution, small)
    return _face_rays(_unit(light.direction), math.tan(light.outer_angle), resolution, small)


def _parallel_rays(scene: Scene, axis: np.ndarray, resolution: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins before the scene's bounds, directions and texel areas of an orthographic map over them."""
    u, v = _frame(axis)
    bounds = np.stack(scene.bounds)
    corners = np.stack(np.meshgrid(*bounds.T, indexing="ij"), -1).reshape(-1, 3) @ np.stack([u, v, axis], -1)
    low, high = corners.min(0), corners.max(0)
    extent = high - low
    x, y = np.meshgrid(*(low[k] + (_centres(resolution) + 1) / 2 * extent[k] for k in range(2)), indexing="ij")
    start = low[2] - 1e-3 * extent.max()
    origins = x.reshape(-1, 1) * u + y.reshape(-1, 1) * v + start * axis
    return origins, np.broadcast_to(axis, origins.shape), np.full(len(origins), extent[0] * extent[1] / resolution**2)


@torch.library.custom_op("difflpv::rsm_texels", mutates_args=())
def _texels(
    offset: torch.Tensor,
    direction: torch.Tensor,
    normal: torch.Tensor,
    plane: torch.Tensor,
    weight: torch.Tensor,
    albedo: torch.Tensor,
    position: torch.Tensor,
    power: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    outputs = [torch.zeros_like(direction, memory_format=torch.contiguous_format) for _ in range(2)]
    inputs = [t.contiguous() for t in (offset, direction, normal, plane, weight, albedo, position, power)]
    launch(rsm_kernels(warp_scalar(direction.dtype)).forward, len(direction), [*inputs, *outputs], direction.device)
    return outputs[0], outputs[1]


@_texels.register_fake
def _(offset, direction, normal, plane, weight, albedo, position, power):
    return tuple(torch.empty_like(direction, memory_format=torch.contiguous_format) for _ in range(2))


@torch.library.custom_op("difflpv::rsm_texels_adjoint", mutates_args=())
def _texels_adjoint(
    hit_bar: torch.Tensor,
    flux_bar: torch.Tensor,
    direction: torch.Tensor,
    normal: torch.Tensor,
    weight: torch.Tensor,
    albedo: torch.Tensor,
    power: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    blocks = -(-len(direction) // TEXEL_BLOCK)
    partials = [direction.new_zeros((blocks, 3)) for _ in range(2)]
    albedo_bar = torch.zeros_like(albedo, memory_format=torch.contiguous_format)
    inputs = [t.contiguous() for t in (direction, normal, weight, albedo, power, hit_bar, flux_bar)]
    kernel = rsm_kernels(warp_scalar(direction.dtype)).adjoint
    launch(kernel, blocks, [*inputs, *partials, albedo_bar], direction.device)
    return albedo_bar, partials[0].sum(0), partials[1].sum(0)


@_texels_adjoint.register_fake
def _(hit_bar, flux_bar, direction, normal, weight, albedo, power):
    bars = (albedo, power.new_empty(3), power.new_empty(3))
    return tuple(torch.empty_like(t, memory_format=torch.contiguous_format) for t in bars)


def _setup(ctx: Any, inputs: Sequence[torch.Tensor], output: Any) -> None:
    _, direction, normal, _, weight, albedo, _, power = inputs
    ctx.save_for_backward(direction, normal, weight, albedo, power)


def _backward(ctx: Any, hit_bar: torch.Tensor, flux_bar: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    albedo_bar, position_bar, power_bar = _texels_adjoint(hit_bar, flux_bar, *ctx.saved_tensors)
    return None, None, None, None, None, albedo_bar, position_bar, power_bar


_texels.register_autograd(_backward, setup_context=_setup)
refuse_second_derivative("rsm_vpls", _texels_adjoint)


def rsm_vpls(
    rsm: Rsm,
    *,
    position: torch.Tensor | None = None,
    power: torch.Tensor | None = None,
    albedo: torch.Tensor | None = None,
) -> Vpls:
    """One VPL per texel, with the flux that it reflects: albedo x power x size x attenuation.

    Args:
        rsm: the traced map.
        position: where the light stands now [m], shape [3]; default: where it was traced. Hits slide along fixed
            directions on the planes that they hit; a spot light keeps its axis. A directional light has none.
        power: intensity [W/sr] or, for a directional light, irradiance [W/m2], shape [3]; default: the light's.
        albedo: shape [t,3] (``rsm.albedo_from``); default: ``rsm.albedo``.

    Returns:
        VPLs on the lit sides, flux [W]; differentiable in ``position``, ``power`` and ``albedo``.

    Raises:
        TypeError: wrong type, dtype or device of an argument.
        ValueError: wrong shape, a number that is not finite, or a position for a directional light.
    """
    if not isinstance(rsm, Rsm):
        raise TypeError(f"rsm: expected difflpv.rsm.Rsm, got {type(rsm).__name__}")
    if position is not None and rsm.light == "directional":
        raise ValueError("position: a directional light has none; expected None")
    position = rsm.position if position is None else position
    power = rsm.power if power is None else power
    albedo = rsm.albedo if albedo is None else albedo
    for name, tensor in (("position", position), ("power", power)):
        check_float(name, tensor, like=rsm.direction)
        if list(tensor.shape) != [3]:
            raise ValueError(f"{name}: expected shape [3], got {list(tensor.shape)}")
        check_points(name, tensor[None], like=rsm.direction)
    check_points("albedo", albedo, like=rsm.direction, count=len(rsm))
    refuse_forward_mode("rsm_vpls", position, power, albedo)
    weight = rsm.size * rsm.attenuation
    hit, flux = _texels(rsm.offset, rsm.direction, rsm.normal, rsm.plane, weight, albedo, position, power)
    return Vpls(hit, rsm.normal, flux)


def rsm_blockers(rsm: Rsm) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Surfels for a geometry volume from the map alone, as published: only what the light sees blocks.

    Returns:
        Positions [t,3] m, unit normals on the lit side [t,3], and areas [t] m2: distance^2 x solid angle / cosine, for
        a directional light texel area / cosine; the cosine is bounded by 0.01 from below.
    """
    vpls = rsm_vpls(rsm)
    cosine = -(rsm.normal * rsm.direction).sum(1)
    square = ((vpls.position - rsm.position) ** 2).sum(1) if rsm.light != "directional" else 1.0
    return vpls.position.detach(), rsm.normal, square * rsm.size / cosine.clamp_min(_MIN_COSINE)
