"""What a camera sees, as receivers: primary hits, their albedo and their own emission."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from difflpv.raycast import Raycaster
from difflpv.scene import Camera, Scene, SceneError

__all__ = ["CameraView", "camera_view"]


@dataclass(frozen=True, eq=False)
class CameraView:
    """Primary hits of the rays through the pixel centres.

    Attributes:
        width: pixels.
        height: pixels.
        hit: index of the pixels (row-major) that see a surface, [m].
        position: [m,3] m.
        normal: unit normals towards the camera, [m,3].
        albedo: [m,3], textures included: the mesh's factor times ``texture``.
        texture: value of the albedo texture, 1 where there is none, [m,3].
        mesh_index: index into ``scene.meshes``, [m].
        emission: radiance of a light's own surface towards the camera [W/(m2 sr)], [m,3].
    """

    width: int
    height: int
    hit: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    albedo: np.ndarray
    texture: np.ndarray
    mesh_index: np.ndarray
    emission: np.ndarray

    def with_albedo(self, factors: np.ndarray) -> CameraView:
        """The same view of surfaces with another untextured albedo per mesh [M,3], such as a learned one."""
        return replace(self, albedo=np.asarray(factors)[self.mesh_index] * self.texture)

    def image(self, irradiance: np.ndarray, *, emission: bool = True) -> np.ndarray:
        """Radiance image [H,W,3] of irradiance [m,3]: albedo E / pi, plus what lights emit; 0 where nothing is hit."""
        pixels = np.zeros((self.height * self.width, 3))
        pixels[self.hit] = self.albedo * irradiance / np.pi + (self.emission if emission else 0.0)
        return pixels.reshape(self.height, self.width, 3)


def camera_view(scene: Scene, raycaster: Raycaster, camera: Camera | None = None) -> CameraView:
    """Cast the rays of ``camera`` (the scene's first by default) through the pixel centres.

    Raises:
        SceneError: the scene has no camera.
    """
    if camera is None:
        if not scene.cameras:
            raise SceneError(f"scene '{scene.name}': no camera: expected one to render from")
        camera = scene.cameras[0]
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    origins, directions = camera.rays(np.stack([x.ravel(), y.ravel()], -1))
    hits = raycaster.closest(origins, directions)
    hit = np.flatnonzero(hits.valid)
    triangle, away = hits.triangle[hit], directions[hit]
    normal = scene.triangle_normals[triangle]
    front = (normal * away).sum(1) < 0
    mesh = scene.triangle_mesh[triangle]
    texture = scene.texture_at(triangle, hits.barycentric[hit])
    shines = front | scene.mesh_two_sided_emission[mesh]
    return CameraView(
        camera.width,
        camera.height,
        hit,
        origins[hit] + hits.distance[hit, None] * away,
        np.where(front[:, None], normal, -normal),
        scene.mesh_albedo[mesh] * texture,
        texture,
        mesh,
        np.where(shines[:, None], scene.mesh_emission[mesh], 0.0),
    )
