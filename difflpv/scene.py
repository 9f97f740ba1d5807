"""What a scene is: meshes, materials, lights, cameras and the box that its volume covers.

Plain, frozen numpy values that check themselves; loaders live in ``difflpv.io``. Units: metres, radiometric. Every
triangle reflects as a Lambert surface on both sides; an area light emits on the side of its geometric normal
(b-a) x (c-a) unless it is two-sided.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from difflpv.grid import Grid

__all__ = [
    "AreaLight",
    "Camera",
    "DirectionalLight",
    "Light",
    "Material",
    "Mesh",
    "PointLight",
    "Scene",
    "SceneError",
    "SpotLight",
    "Texture",
]


class SceneError(ValueError):
    """A scene that cannot be used: one line naming file, element and reason."""


@dataclass(frozen=True, eq=False)
class Texture:
    """Linear RGB image [H, W, 3] float32; row 0 is the top (v = 0 in glTF's convention); repeats."""

    image: np.ndarray

    def lookup(self, uv: np.ndarray) -> np.ndarray:
        """Bilinear, repeating lookup at glTF UV coordinates [n,2]; linear RGB [n,3]."""
        height, width = self.image.shape[:2]
        s = uv[:, 0] * width - 0.5
        t = uv[:, 1] * height - 0.5
        i, j = np.floor(s).astype(np.int64), np.floor(t).astype(np.int64)
        fs, ft = (s - i)[:, None], (t - j)[:, None]
        i0, i1, j0, j1 = i % width, (i + 1) % width, j % height, (j + 1) % height
        top = self.image[j0, i0] * (1 - fs) + self.image[j0, i1] * fs
        bottom = self.image[j1, i0] * (1 - fs) + self.image[j1, i1] * fs
        return top * (1 - ft) + bottom * ft


@dataclass(frozen=True, eq=False)
class Material:
    """Lambert surface: albedo [3] in [0, 1], multiplied by an optional texture; emission is radiance [W/(m2 sr)]."""

    name: str
    albedo: np.ndarray
    texture: Texture | None = None
    emission: np.ndarray = field(default_factory=lambda: np.zeros(3))
    double_sided: bool = True

    def __post_init__(self) -> None:
        albedo = np.asarray(self.albedo, np.float64)
        object.__setattr__(self, "albedo", albedo)
        object.__setattr__(self, "emission", np.asarray(self.emission, np.float64))
        if albedo.shape != (3,) or not np.isfinite(albedo).all() or (albedo < 0).any() or (albedo > 1).any():
            raise SceneError(f"material '{self.name}': albedo must lie in [0, 1], got {albedo.tolist()}")
        if not np.isfinite(self.emission).all() or (self.emission < 0).any():
            raise SceneError(f"material '{self.name}': emission must be finite and >= 0, got {self.emission.tolist()}")


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in world space: vertices [V,3] m, triangles [T,3], uv [V,2] or None."""

    name: str
    vertices: np.ndarray
    triangles: np.ndarray
    material: Material
    uv: np.ndarray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", np.ascontiguousarray(self.vertices, np.float64))
        object.__setattr__(self, "triangles", np.ascontiguousarray(self.triangles, np.int64))
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3:
            raise SceneError(f"mesh '{self.name}': vertices must have shape [V, 3], got {list(self.vertices.shape)}")
        if self.triangles.ndim != 2 or self.triangles.shape[1] != 3:
            raise SceneError(f"mesh '{self.name}': triangles must have shape [T, 3], got {list(self.triangles.shape)}")
        bad = np.flatnonzero(~np.isfinite(self.vertices).all(1))
        if bad.size:
            raise SceneError(f"mesh '{self.name}': vertex {bad[0]} is not finite: {self.vertices[bad[0]].tolist()}")
        if self.triangles.size and (self.triangles.min() < 0 or self.triangles.max() >= len(self.vertices)):
            worst = int(self.triangles.max() if self.triangles.min() >= 0 else self.triangles.min())
            raise SceneError(f"mesh '{self.name}': index {worst} is out of range for {len(self.vertices)} vertices")
        if self.uv is not None and self.uv.shape != (len(self.vertices), 2):
            raise SceneError(f"mesh '{self.name}': uv must have shape [V, 2], got {list(self.uv.shape)}")


def _vector(light: object, name: str) -> np.ndarray:
    """Field ``name`` of a light as float64 [3], finite."""
    value = np.asarray(getattr(light, name), np.float64)
    label = getattr(light, "name", getattr(light, "mesh", ""))
    if value.shape != (3,) or not np.isfinite(value).all():
        raise SceneError(f"light '{label}': {name} must be three finite numbers, got {value.tolist()}")
    return value


def _check_light(light: object, power: str, position: bool = False, direction: bool = False) -> None:
    """Normalise a light's fields in place: float64 vectors, power >= 0, unit direction."""
    value = _vector(light, power)
    label = getattr(light, "name", getattr(light, "mesh", ""))
    if (value < 0).any():
        raise SceneError(f"light '{label}': {power} must be >= 0, got {value.tolist()}")
    object.__setattr__(light, power, value)
    if position:
        object.__setattr__(light, "position", _vector(light, "position"))
    if direction:
        vector = _vector(light, "direction")
        length = float(np.linalg.norm(vector))
        if not length > 0:
            raise SceneError(f"light '{label}': direction has no length")
        object.__setattr__(light, "direction", vector / length)


@dataclass(frozen=True, eq=False)
class AreaLight:
    """The triangles of mesh ``mesh`` (its name) emit ``radiance`` [3] W/(m2 sr), constant over surface and angle."""

    mesh: str
    radiance: np.ndarray
    two_sided: bool = False

    def __post_init__(self) -> None:
        _check_light(self, "radiance")


@dataclass(frozen=True, eq=False)
class PointLight:
    """Isotropic point light: position [3] m, intensity [3] W/sr."""

    position: np.ndarray
    intensity: np.ndarray
    name: str = "point"

    def __post_init__(self) -> None:
        _check_light(self, "intensity", position=True)


@dataclass(frozen=True, eq=False)
class SpotLight:
    """Spot light: glTF's falloff between two half-angles [rad]; intensity [3] W/sr on the axis ``direction`` [3]."""

    position: np.ndarray
    direction: np.ndarray
    intensity: np.ndarray
    inner_angle: float = 0.0
    outer_angle: float = float(np.pi / 4)
    name: str = "spot"

    def __post_init__(self) -> None:
        _check_light(self, "intensity", position=True, direction=True)
        if not 0 <= self.inner_angle < self.outer_angle <= np.pi / 2 + 1e-6:
            raise SceneError(
                f"light '{self.name}': angles must satisfy 0 <= inner < outer <= pi/2, "
                f"got inner {self.inner_angle}, outer {self.outer_angle}"
            )

    def falloff(self, cos_angle: np.ndarray) -> np.ndarray:
        """Angular attenuation of KHR_lights_punctual: clamp((cos - cos_outer)/(cos_inner - cos_outer))^2."""
        outer, inner = np.cos(self.outer_angle), np.cos(self.inner_angle)
        return np.clip((cos_angle - outer) / max(inner - outer, 1e-4), 0, 1) ** 2


@dataclass(frozen=True, eq=False)
class DirectionalLight:
    """Parallel light travelling along unit ``direction`` [3]; ``irradiance`` [3] W/m2 on a surface that faces it."""

    direction: np.ndarray
    irradiance: np.ndarray
    name: str = "directional"

    def __post_init__(self) -> None:
        _check_light(self, "irradiance", direction=True)


Light = AreaLight | PointLight | SpotLight | DirectionalLight


@dataclass(frozen=True, eq=False)
class Camera:
    """Perspective camera: ``to_world`` [4,4] (looks along its -z, y up), vertical field of view [rad], image size."""

    to_world: np.ndarray
    yfov: float
    width: int = 256
    height: int = 192

    def rays(self, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rays through image positions: ``offsets`` [n,2] in pixels from the top left -> origins, unit directions."""
        scale = np.tan(self.yfov / 2)
        x = (2 * offsets[:, 0] / self.width - 1) * scale * self.width / self.height
        y = (1 - 2 * offsets[:, 1] / self.height) * scale
        local = np.stack([x, y, -np.ones_like(x)], -1)
        directions = local @ self.to_world[:3, :3].T
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return np.broadcast_to(self.to_world[:3, 3], directions.shape).copy(), directions


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that light meets.

    Attributes:
        name: short name, for messages and manifests.
        meshes: in file order; area lights are meshes too.
        lights: punctual lights and area lights.
        cameras: perspective cameras, the first is the default.
        grid: box of the light propagation volume, None if the file names none.
        warnings: lines for the user (dropped triangles and the like), told by the commands.
    """

    name: str
    meshes: tuple[Mesh, ...]
    lights: tuple[Light, ...]
    cameras: tuple[Camera, ...] = ()
    grid: Grid | None = None
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.meshes or not sum(len(m.triangles) for m in self.meshes):
            raise SceneError(f"scene '{self.name}': no mesh: expected at least one triangle")
        if not self.lights:
            raise SceneError(f"scene '{self.name}': no light: expected an emissive material or a punctual light")
        names = [m.name for m in self.meshes]
        for light in self.lights:
            if isinstance(light, AreaLight) and names.count(light.mesh) != 1:
                raise SceneError(f"scene '{self.name}': area light names mesh '{light.mesh}', meshes are {names}")

    @cached_property
    def triangle_vertices(self) -> np.ndarray:
        """All triangles' corners in mesh order [m], shape [T,3,3]."""
        return np.concatenate([m.vertices[m.triangles] for m in self.meshes])

    @cached_property
    def triangle_mesh(self) -> np.ndarray:
        """Index of the mesh of each triangle, shape [T]."""
        return np.repeat(np.arange(len(self.meshes)), [len(m.triangles) for m in self.meshes])

    @cached_property
    def triangle_cross(self) -> np.ndarray:
        """(b-a) x (c-a) of each triangle [m2], shape [T,3]: twice the area along the geometric normal."""
        a, b, c = np.moveaxis(self.triangle_vertices, 1, 0)
        return np.cross(b - a, c - a)

    @cached_property
    def triangle_normals(self) -> np.ndarray:
        """Unit geometric normals, shape [T,3].

        Raises:
            SceneError: a triangle has no area (the loaders drop such triangles).
        """
        length = np.linalg.norm(self.triangle_cross, axis=1, keepdims=True)
        if not length.all():
            mesh = self.meshes[self.triangle_mesh[int(np.argmin(length))]].name
            raise SceneError(f"scene '{self.name}': mesh '{mesh}' has a triangle without area")
        return self.triangle_cross / length

    @cached_property
    def triangle_areas(self) -> np.ndarray:
        """Areas [m2], shape [T]."""
        return 0.5 * np.linalg.norm(self.triangle_cross, axis=1)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of all triangles [m]."""
        points = self.triangle_vertices.reshape(-1, 3)
        return points.min(0), points.max(0)

    @cached_property
    def mesh_emission(self) -> np.ndarray:
        """Radiance of each mesh's area light [W/(m2 sr)], zero for the others, shape [M,3]."""
        emission = np.zeros((len(self.meshes), 3))
        names = [m.name for m in self.meshes]
        for light in self.lights:
            if isinstance(light, AreaLight):
                emission[names.index(light.mesh)] += light.radiance
        return emission

    @cached_property
    def mesh_two_sided_emission(self) -> np.ndarray:
        """True for meshes whose area light emits on both sides, shape [M]."""
        two_sided = {light.mesh for light in self.lights if isinstance(light, AreaLight) and light.two_sided}
        return np.array([m.name in two_sided for m in self.meshes])

    @cached_property
    def mesh_albedo(self) -> np.ndarray:
        """Untextured albedo of each mesh, shape [M,3]."""
        return np.array([m.material.albedo for m in self.meshes])

    def albedo_at(self, triangle: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
        """Albedo at surface points, shape [n,3]: the mesh's factor times the texture (``texture_at``)."""
        return self.mesh_albedo[self.triangle_mesh[triangle]] * self.texture_at(triangle, barycentric)

    def texture_at(self, triangle: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
        """Value of the albedo texture at surface points, looked up by UV.

        Args:
            triangle: triangle index in mesh order, shape [n].
            barycentric: weights (u, v) of the second and third corner, shape [n,2].

        Returns:
            Shape [n,3]; 1 where there is no texture.
        """
        mesh_index = self.triangle_mesh[triangle]
        value = np.ones((len(mesh_index), 3))
        first = np.concatenate([[0], np.cumsum([len(m.triangles) for m in self.meshes])])
        for k, mesh in enumerate(self.meshes):
            if mesh.material.texture is None or mesh.uv is None:
                continue
            here = np.flatnonzero(mesh_index == k)
            if here.size:
                corners = mesh.uv[mesh.triangles[triangle[here] - first[k]]]
                u, v = barycentric[here, 0, None], barycentric[here, 1, None]
                uv = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
                value[here] = mesh.material.texture.lookup(uv)
        return value

    def with_lights(self, lights: Sequence[Light], moved: dict[str, Mesh] | None = None) -> Scene:
        """The same scene under other lights; ``moved`` replaces meshes by name (an area light's panel)."""
        moved = moved or {}
        unknown = set(moved) - {m.name for m in self.meshes}
        if unknown:
            names = [m.name for m in self.meshes]
            raise SceneError(f"scene '{self.name}': no mesh '{min(unknown)}', meshes are {names}")
        meshes = tuple(moved.get(m.name, m) for m in self.meshes)
        return replace(self, meshes=meshes, lights=tuple(lights))

    @cached_property
    def hash(self) -> str:
        """SHA-256 over geometry, materials and lights: recognises targets that belong to another scene."""
        digest = hashlib.sha256()
        for mesh in self.meshes:
            arrays = [mesh.vertices, mesh.triangles, mesh.material.albedo]
            if mesh.uv is not None:
                arrays.append(mesh.uv)
            if mesh.material.texture is not None:
                arrays.append(mesh.material.texture.image)
            for array in arrays:
                digest.update(np.ascontiguousarray(array).tobytes())
        for light in self.lights:
            for key, value in sorted(vars(light).items()):
                text = np.asarray(value, np.float64).tobytes() if not isinstance(value, str) else value.encode()
                digest.update(key.encode() + text)
        return digest.hexdigest()
