"""Samples of a scene's surfaces and of its area lights, spread evenly by area.

A mesh's samples are stratified along its cumulative triangle area and follow a low-discrepancy sequence inside the
triangles, so that a few thousand of them stand for the scene; an area light that is a parallelogram gets a regular
grid. Sampling is set-up work in float64 numpy: the same seed gives the same bits, whatever the other meshes are.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import torch

from difflpv.bridge import check_float
from difflpv.scene import AreaLight, Mesh, Scene

__all__ = ["SurfaceSamples", "albedo_by_mesh", "sample_area_light", "sample_surfaces"]

_SAMPLES_PER_MESH = 4  # a small mesh still blocks and reflects
_GOLDEN = (np.sqrt(5.0) - 1) / 2


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points that each stand for a piece of one side of a surface.

    Attributes:
        position: [n,3] m.
        normal: unit normal of the side that the sample stands for, [n,3].
        albedo: [n,3], textures included: the mesh's factor times ``texture``.
        texture: value of the albedo texture, 1 where there is none, [n,3].
        area: m2 that each sample stands for, [n].
        mesh_index: index into ``scene.meshes``, [n] int64.
    """

    position: torch.Tensor
    normal: torch.Tensor
    albedo: torch.Tensor
    texture: torch.Tensor
    area: torch.Tensor
    mesh_index: torch.Tensor

    def __post_init__(self) -> None:
        check_float("position", self.position)
        count = len(self.position)
        for name in ("position", "normal", "albedo", "texture", "area"):
            tensor = getattr(self, name)
            check_float(name, tensor, like=self.position)
            expected = [count] if name == "area" else [count, 3]
            if list(tensor.shape) != expected:
                raise ValueError(f"{name}: expected shape {expected}, got {list(tensor.shape)}")
        if self.mesh_index.dtype != torch.int64 or list(self.mesh_index.shape) != [count]:
            got = f"{self.mesh_index.dtype} {list(self.mesh_index.shape)}"
            raise ValueError(f"mesh_index: expected int64 of shape [{count}], got {got}")

    def __len__(self) -> int:
        return len(self.position)

    def select(self, keep: torch.Tensor) -> SurfaceSamples:
        """The samples that a boolean mask [n] or an index tensor names."""
        return replace(self, **{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    def albedo_from(self, factors: torch.Tensor) -> torch.Tensor:
        """Albedo [n,3] from one factor per mesh [M,3] (as ``albedo_by_mesh`` gives), differentiable in the factors."""
        return factors[self.mesh_index] * self.texture


def albedo_by_mesh(
    scene: Scene, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> torch.Tensor:
    """Untextured albedo of each mesh, shape [M,3]: the factor that can be learned on textured surfaces too."""
    return torch.as_tensor(scene.mesh_albedo, dtype=dtype, device=device)


def sample_surfaces(
    scene: Scene,
    count: int,
    *,
    seed: int = 0,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
    both_sides: bool = True,
    include_lights: bool = False,
) -> SurfaceSamples:
    """Sample the scene's surfaces evenly by area.

    Args:
        scene: what to sample; meshes of area lights are left out unless ``include_lights``.
        count: number of surface points, at least 1; every mesh gets a few, so slightly more may come.
        seed: same seed, same bits.
        dtype: float32 or float64.
        device: where the samples are put.
        both_sides: every triangle reflects on both sides: two samples per point, first all front sides (the geometric
            normal), then all back sides in the same order.
        include_lights: add the meshes of area lights (they block light).

    Returns:
        Samples; over one side of a mesh the areas sum to the mesh's area.

    Raises:
        ValueError: ``count`` below 1, or nothing but light panels to sample.
    """
    if count < 1:
        raise ValueError(f"count: expected at least 1 surface point, got {count}")
    emissive = (scene.mesh_emission > 0).any(1)
    meshes = np.flatnonzero(~emissive | include_lights)
    area = np.bincount(scene.triangle_mesh, scene.triangle_areas, minlength=len(scene.meshes))
    meshes = meshes[area[meshes] > 0]
    if not len(meshes):
        raise ValueError(f"scene '{scene.name}': expected a surface that is not an area light's, got none")
    share = np.round(count * area[meshes] / area[meshes].sum()).astype(int)
    triangle, barycentric, weight = [], [], []
    for mesh, wanted in zip(meshes, np.maximum(share, _SAMPLES_PER_MESH), strict=True):
        t, uv = _stratified(scene, int(mesh), int(wanted), seed)
        triangle.append(t)
        barycentric.append(uv)
        weight.append(np.full(wanted, area[mesh] / wanted))
    return _samples(
        scene, np.concatenate(triangle), np.concatenate(barycentric), np.concatenate(weight), both_sides, dtype, device
    )


def sample_area_light(
    scene: Scene,
    light: AreaLight,
    count: int,
    *,
    seed: int = 0,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> SurfaceSamples:
    """Sample the emitting side (both, if two-sided) of an area light.

    A parallelogram gets a regular grid of k x k points, k^2 nearest to ``count``; any other mesh ``count`` points,
    stratified by area.

    Args:
        scene: that the light belongs to.
        light: names its mesh.
        count: samples per side, at least 1.
        seed: for a mesh that is no parallelogram.
        dtype: float32 or float64.
        device: where the samples are put.

    Raises:
        ValueError: ``count`` below 1.
    """
    if count < 1:
        raise ValueError(f"count: expected at least 1 sample per area light, got {count}")
    mesh = [m.name for m in scene.meshes].index(light.mesh)
    members = np.flatnonzero(scene.triangle_mesh == mesh)
    points = _parallelogram_grid(scene.meshes[mesh], max(1, round(np.sqrt(count))))
    if points is None:
        triangle, barycentric = _stratified(scene, mesh, count, seed)
    else:
        triangle, barycentric = members[points[0]], points[1]
    weight = np.full(len(triangle), scene.triangle_areas[members].sum() / len(triangle))
    return _samples(scene, triangle, barycentric, weight, light.two_sided, dtype, device)


def _stratified(scene: Scene, mesh: int, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Triangle index [count] and barycentric weights [count,2] of points spread evenly over one mesh."""
    members = np.flatnonzero(scene.triangle_mesh == mesh)
    cumulative = np.cumsum(scene.triangle_areas[members])
    shift = np.random.default_rng([seed, mesh]).random(2)
    along = (np.arange(count) + shift[0]) / count * cumulative[-1]
    chosen = np.minimum(np.searchsorted(cumulative, along, side="right"), len(members) - 1)
    start = np.concatenate([[0.0], cumulative[:-1]])[chosen]
    # what is left of the stratified number is uniform within the triangle and is used again
    first = np.clip((along - start) / scene.triangle_areas[members[chosen]], 0, 1)
    second = (shift[1] + np.arange(count) * _GOLDEN) % 1
    root = np.sqrt(first)
    return members[chosen], np.stack([root * (1 - second), root * second], -1)


def _parallelogram_grid(mesh: Mesh, k: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Centres of k x k equal cells as (triangle 0 or 1, barycentric), or None if the mesh is no parallelogram."""
    if len(mesh.triangles) != 2:
        return None
    first, second = mesh.vertices[mesh.triangles]
    scale = np.ptp(first, axis=0).max()
    for corner in range(3):
        a, b, c = np.roll(first, -corner, axis=0)  # the diagonal would be b-c, the fourth corner b + c - a
        fourth = b + c - a
        expected = np.stack([fourth, c, b])  # with the same winding
        if any(np.abs(np.roll(second, -s, axis=0) - expected).max() < 1e-5 * scale for s in range(3)):
            break
    else:
        return None
    centre = (np.arange(k) + 0.5) / k
    u, v = (grid.reshape(-1) for grid in np.meshgrid(centre, centre, indexing="ij"))
    points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    triangle = (u + v > 1).astype(np.int64)
    corners = np.stack([first, second])[triangle]
    edges = corners[:, 1:] - corners[:, :1]
    solve = np.linalg.pinv(edges.transpose(0, 2, 1))  # points lie in the plane: the least-squares weights are exact
    return triangle, np.einsum("nij,nj->ni", solve, points - corners[:, 0])


def _samples(
    scene: Scene,
    triangle: np.ndarray,
    barycentric: np.ndarray,
    weight: np.ndarray,
    both_sides: bool,
    dtype: torch.dtype,
    device: torch.device | str,
) -> SurfaceSamples:
    corners = scene.triangle_vertices[triangle]
    u, v = barycentric[:, 0, None], barycentric[:, 1, None]
    position = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
    texture = scene.texture_at(triangle, barycentric)
    mesh = scene.triangle_mesh[triangle]
    normal = scene.triangle_normals[triangle]
    arrays = [position, normal, scene.mesh_albedo[mesh] * texture, texture, weight]
    if both_sides:
        arrays = [np.concatenate([a, -a if a is normal else a]) for a in arrays]
        mesh = np.concatenate([mesh, mesh])
    names = ("position", "normal", "albedo", "texture", "area")
    tensors = {k: torch.as_tensor(a, dtype=dtype, device=device) for k, a in zip(names, arrays, strict=True)}
    return SurfaceSamples(**tensors, mesh_index=torch.as_tensor(mesh, device=device))
