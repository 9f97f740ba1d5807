"""Scenes to push the methods with, and their truth: bundled ones, and rooms made of rectangles.

Truth is path traced (``data_gen``); its own noise is stated beside every error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from data_gen.targets import make_targets
from difflpv.evaluate import relative_noise
from difflpv.grid import Grid
from difflpv.io import load_scene
from difflpv.scene import AreaLight, Material, Mesh, Scene
from difflpv.stress.settings import StressSettings

__all__ = ["Case", "bundled_case", "rectangle", "room_scene", "rotated", "scaled", "traced_case", "walled_rooms"]


@dataclass(frozen=True, eq=False)
class Case:
    """A scene with receivers and the truth there.

    Attributes:
        scene: the scene, with a grid.
        position: receivers [n,3] m.
        normal: unit normals [n,3].
        weight: area weights [n] m2.
        truth: irradiance by component [W/m2], each [n,3].
        noise: relative L2 error that a perfect prediction would show, by component.
    """

    scene: Scene
    position: np.ndarray
    normal: np.ndarray
    weight: np.ndarray
    truth: dict[str, np.ndarray]
    noise: dict[str, float]

    @property
    def grid(self) -> Grid:
        """The scene's own grid."""
        assert self.scene.grid is not None
        return self.scene.grid


def traced_case(
    scene: Scene, settings: StressSettings, folder: Path, components: Sequence[str] = ("direct", "bounce1")
) -> Case:
    """Path-trace a scene's receivers into ``folder/<name>``; targets that lie there already are read."""
    targets = make_targets(
        scene,
        folder / scene.name,
        receiver_count=settings.receivers,
        components=tuple(components),
        spp=settings.spp,
        seed=settings.seed,
        workers=1,
        overwrite=True,
        progress=False,
    )
    light, receivers = targets.lights[0], targets.receivers
    weight = light.area_weight.astype(float)
    truth = {c: light.irradiance[c].astype(float) for c in components}
    noise = {c: relative_noise(light.standard_error[c], truth[c], weight) for c in components}
    return Case(scene, receivers.position.astype(float), receivers.normal.astype(float), weight, truth, noise)


def bundled_case(name: str, settings: StressSettings, folder: Path) -> Case:
    """A bundled scene with its truth."""
    return traced_case(load_scene(name), settings, folder)


def rectangle(
    name: str, corner: Sequence[float], first: Sequence[float], second: Sequence[float], albedo: float | Sequence[float] = 0.5
) -> Mesh:
    """Parallelogram of two triangles, its normal along first x second [m]."""
    a, u, v = (np.asarray(p, float) for p in (corner, first, second))
    material = Material(name, np.broadcast_to(np.asarray(albedo, float), (3,)).copy())
    return Mesh(name, np.stack([a, a + u, a + u + v, a + v]), np.array([[0, 1, 2], [0, 2, 3]]), material)


def _box(name: str, low: Sequence[float], high: Sequence[float], albedo: float, *, inward: bool) -> list[Mesh]:
    """Six faces of a box."""
    size, meshes = np.subtract(high, low), []
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        first, second = size * np.eye(3)[i], size * np.eye(3)[j]
        far = np.array(low, float) + size * np.eye(3)[axis]
        pairs = [(low, first, second), (far, second, first)]  # normals inwards
        for side, (corner, u, v) in zip("-+", pairs, strict=True):
            u, v = (u, v) if inward else (v, u)
            meshes.append(rectangle(f"{name}{'xyz'[axis]}{side}", corner, u, v, albedo))
    return meshes


def _lamp(centre: Sequence[float], edge: float) -> Mesh:
    x, y, z = centre
    return rectangle("lamp", (x - edge / 2, y, z - edge / 2), (edge, 0, 0), (0, 0, edge), 0.0)  # normal -y: downwards


def room_scene(
    *,
    edge: float = 4.0,
    albedo: float = 0.5,
    lamp: Sequence[float] = (0.0, 3.9, 0.0),
    lamp_edge: float = 1.0,
    cells: int = 16,
    name: str = "room",
) -> Scene:
    """A closed cube over the floor y = 0 with a panel that shines down; its grid has two cells of margin on each side.

    Args:
        edge: of the cube [m].
        albedo: of all walls.
        lamp: centre of the panel [m].
        lamp_edge: of the panel [m].
        cells: along the grid's edge.
        name: of the scene.
    """
    walls = _box("wall", (-edge / 2, 0, -edge / 2), (edge / 2, edge, edge / 2), albedo, inward=True)
    light = AreaLight("lamp", np.array([10.0, 9.0, 8.0]))
    size = edge / (cells - 4)
    grid = Grid((-edge / 2 - 2 * size, -2 * size, -edge / 2 - 2 * size), size, (cells,) * 3)
    return Scene(name, (*walls, _lamp(lamp, lamp_edge)), (light,), grid=grid)


def walled_rooms(*, thickness: float, cells: int, name: str) -> Scene:
    """Two closed rooms of 4 x 3 x 4 m side by side, the lamp in the left one, no door: what arrives at the right has leaked.

    Args:
        thickness: of the wall between them [m].
        cells: along x; the grid spans 10 m.
        name: of the scene.
    """
    half = thickness / 2
    left = _box("left", (-4 - half, 0, -2), (-half, 3, 2), 0.6, inward=True)
    right = _box("right", (half, 0, -2), (4 + half, 3, 2), 0.6, inward=True)
    light = AreaLight("lamp", np.array([15.0, 14.0, 12.0]))
    grid = Grid((-5.0, -3.5, -5.0), 10.0 / cells, (cells,) * 3)
    return Scene(name, (*left, *right, _lamp((-2 - half, 2.98, 0), 0.8)), (light,), grid=grid)


def _moved(case: Case, matrix: np.ndarray, grid: Grid) -> Case:
    """Vertices and receivers times ``matrix`` [3,3]; irradiance under area lights does not change."""
    scale = float(abs(np.linalg.det(matrix))) ** (1 / 3)
    meshes = tuple(replace(m, vertices=m.vertices @ matrix.T) for m in case.scene.meshes)
    scene = replace(case.scene, meshes=meshes, grid=grid, cameras=())
    position, normal = case.position @ matrix.T, case.normal @ (matrix / scale).T
    return replace(case, scene=scene, position=position, normal=normal, weight=case.weight * scale**2)


def rotated(case: Case, degrees: float, cells: int) -> Case:
    """The scene turned about the y axis through the middle of a grid that holds it at every angle.

    Args:
        case: to be turned.
        degrees: by how much.
        cells: along the grid's edge.
    """
    a = np.radians(degrees)
    turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    low, high = case.scene.bounds
    middle, edge = (low + high) / 2, float(np.hypot(high[0] - low[0], high[2] - low[2]))
    edge = max(edge, float(high[1] - low[1])) * cells / (cells - 2)
    centre = turn @ middle
    return _moved(case, turn, Grid(tuple(centre - edge / 2), edge / cells, (cells,) * 3))


def scaled(case: Case, factor: float) -> Case:
    """The scene in another unit of length."""
    grid = case.grid
    low = tuple(factor * v for v in grid.minimum)
    return _moved(case, factor * np.eye(3), Grid((low[0], low[1], low[2]), factor * grid.cell_size, grid.resolution))
