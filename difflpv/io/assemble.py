"""What every scene format shares: collecting meshes, lights and cameras, and telling what was dropped."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from difflpv.grid import Grid
from difflpv.io.default_camera import default_camera
from difflpv.scene import AreaLight, Camera, Light, Material, Mesh, Scene, SceneError

__all__ = ["DEFAULT_ALBEDO", "SceneBuilder"]

DEFAULT_ALBEDO = 0.8  # of a material that names none
_MAX_CORNERS = 60_000_000  # triangle corners plus vertices of one scene: about 2 GB while loading
_MAX_COORDINATE = 1e15  # m: squares still fit the ray caster's float32
_MAX_UV = 1e6


@dataclass
class SceneBuilder:
    """Collects the parts of one scene file; ``build`` checks the whole."""

    name: str
    meshes: list[Mesh] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    cameras: list[Camera] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    grid: Grid | None = None
    _taken: dict[str, int] = field(default_factory=dict)
    _corners: int = 0

    def default_material(self, where: str) -> Material:
        """The surface of a mesh that names none, told."""
        self.warnings.append(f"{where}: no material, the albedo is {DEFAULT_ALBEDO}")
        return Material("default", np.full(3, DEFAULT_ALBEDO))

    def reserve(self, count: int) -> None:
        """Count ``count`` triangle corners or vertices that are about to be made; refuse to grow without bound."""
        self._corners += count
        if self._corners > _MAX_CORNERS:
            raise SceneError(f"more than {_MAX_CORNERS} triangle corners and vertices in one scene")

    def add_mesh(
        self,
        name: str,
        vertices: np.ndarray,
        triangles: np.ndarray,
        material: Material,
        *,
        uv: np.ndarray | None = None,
        two_sided: bool = False,
    ) -> None:
        """Add triangles in world space; zero-area ones are dropped, an emissive material makes an area light.

        Args:
            name: name of the mesh; made unique by a number.
            vertices: positions [m], shape [V,3].
            triangles: vertex indices, shape [T,3].
            material: its surface.
            uv: texture coordinates, v down, shape [V,2].
            two_sided: the area light emits on both sides.
        """
        name = self._unique(name)
        if uv is not None:
            bad = np.flatnonzero(~(np.isfinite(uv) & (np.abs(uv) <= _MAX_UV)).all(1))
            if bad.size:
                raise SceneError(f"mesh '{name}': texture coordinate {bad[0]} is out of range: {uv[bad[0]].tolist()}")
        mesh = Mesh(name, vertices, triangles, material, uv)
        far = np.flatnonzero((np.abs(mesh.vertices) > _MAX_COORDINATE).any(1))
        if far.size:
            raise SceneError(f"mesh '{name}': vertex {far[0]} is out of range: {mesh.vertices[far[0]].tolist()}")
        if material.texture is not None and uv is None:
            self.warnings.append(f"mesh '{name}': no texture coordinates, the texture of '{material.name}' is not used")
        keep = _has_area(mesh)
        dropped = int((~keep).sum())
        if dropped:
            self.warnings.append(f"mesh '{name}': {dropped} of {len(keep)} triangles have no area and were dropped")
            mesh = Mesh(name, mesh.vertices, mesh.triangles[keep], material, uv)
        if not len(mesh.triangles):
            self.warnings.append(f"mesh '{name}': no triangle is left, the mesh was dropped")
            return
        self.meshes.append(mesh)
        if material.emission.any():
            self.lights.append(AreaLight(name, material.emission, two_sided))

    def _unique(self, name: str) -> str:
        base = " ".join(name.split())[:200] or "mesh"
        name = base
        while name in self._taken:
            self._taken[base] += 1
            name = f"{base}_{self._taken[base]}"
        self._taken[name] = 0
        return name

    def build(self) -> Scene:
        """The checked scene; one without a camera gets a default one that looks into its bounds."""
        scene = Scene(self.name, tuple(self.meshes), tuple(self.lights), tuple(self.cameras), self.grid)
        if not self.cameras:
            self.cameras.append(default_camera(scene))
            self.warnings.append("no camera in the file: a default one looks into the scene's bounds")
        return Scene(
            self.name, scene.meshes, scene.lights, tuple(self.cameras), self.grid, tuple(dict.fromkeys(self.warnings))
        )


def _has_area(mesh: Mesh) -> np.ndarray:
    """False for triangles whose area vanishes beside their longest edge: they have no normal."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    edges = np.stack([b - a, c - b, a - c])
    longest = (edges**2).sum(-1).max(0, initial=0.0)
    twice_area = np.linalg.norm(np.cross(edges[0], -edges[2]), axis=-1)
    return (twice_area > 1e-12 * longest) & (twice_area > 1e-30)
