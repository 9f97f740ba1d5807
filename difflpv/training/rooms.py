"""Rooms drawn at random, path-traced: what stencils and lookups learn occlusion from.

A room is a box of 9 to 16 cells with blocks, sometimes a dividing wall with a doorway, lit by one area light. Every room is
moved against the grid by some part of a cell; one in five is turned about the vertical (the others lie along the grid, as a
grid laid for a room does). None of the bundled scenes is among them: those stay
unseen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from data_gen.targets import make_targets
from difflpv.grid import Grid
from difflpv.io.tables import ReceiverTable
from difflpv.scene import AreaLight, Material, Mesh, Scene
from difflpv.triangle_distance import triangle_distance

__all__ = ["ROOM_CELLS", "TrainingRoom", "draw_room", "traced_room"]

ROOM_CELLS = 22
_CELL = 0.3  # edge of a cell [m]; everything below is drawn in cells
_STREAM = 4409
_TURNED = 0.2  # share of the rooms that do not lie along the axes of their grid
_WALL = 0.3  # thickness of a dividing wall [cells]


@dataclass(frozen=True, eq=False)
class TrainingRoom:
    """A room with its truth.

    Attributes:
        scene: with its light.
        grid: its cells.
        receivers: points on surfaces, with the area [m2] that each stands for, 0 within a cell of the light.
        irradiance: truth by component, "direct" and "bounce1", each [n,3] W/m2.
    """

    scene: Scene
    grid: Grid
    receivers: ReceiverTable
    irradiance: dict[str, np.ndarray]


def draw_room(seed: int, index: int) -> tuple[Scene, Grid]:
    """Room number ``index`` of a seed, and its grid of ``ROOM_CELLS``^3 cells."""
    rng = np.random.default_rng((seed, _STREAM, index))
    size = rng.uniform((9.0, 7.0, 9.0), (16.0, 12.0, 16.0))
    meshes = _walls(rng, size)
    if rng.random() < 0.4:
        meshes += _divider(rng, size)
    for number in range(int(rng.integers(0, 4))):
        extent = rng.uniform(1.2, (4.5, 0.7 * size[1], 4.5))
        center = rng.uniform(-0.5, 0.5, 3) * (size - 1.5 * extent)
        center[1] = -size[1] / 2 + extent[1] / 2 if rng.random() < 0.7 else center[1]
        turn = rng.uniform(0, np.pi / 2) if rng.random() < 0.6 else 0.0
        meshes.append(_block(f"block{number}", center, extent, turn, rng.uniform(0.1, 0.8, 3)))
    panel = _panel(rng, size)
    light = AreaLight("light", np.exp(rng.uniform(-0.5, 0.5, 3)) * 10)
    turn = rng.uniform(0, np.pi / 2) if rng.random() < _TURNED else 0.0
    shift = rng.uniform(-0.5, 0.5, 3)
    placed = tuple(_moved(mesh, turn, shift) for mesh in [*meshes, panel])
    half = _CELL * ROOM_CELLS / 2
    return Scene(f"room{index}", placed, (light,)), Grid((-half, -half, -half), _CELL, (ROOM_CELLS,) * 3)


def _walls(rng: np.random.Generator, size: np.ndarray) -> list[Mesh]:
    meshes = []
    grey = rng.uniform(0.4, 0.8)
    for axis in range(3):
        for sign in (-1, 1):
            first, second = np.zeros(3), np.zeros(3)
            i, j = ((axis + 1) % 3, (axis + 2) % 3) if sign < 0 else ((axis + 2) % 3, (axis + 1) % 3)
            first[i], second[j] = size[i], size[j]
            corner = -size / 2
            corner[axis] *= -sign
            albedo = rng.uniform(0.05, 0.8, 3) if rng.random() < 0.4 else np.full(3, grey)
            meshes.append(_quad(f"wall{axis}{sign:+d}", corner, first, second, albedo))
    return meshes


def _divider(rng: np.random.Generator, size: np.ndarray) -> list[Mesh]:
    """A wall across x with a doorway: two slabs beside it and one above."""
    x = rng.uniform(-0.2, 0.2) * size[0]
    width, height = rng.uniform(1.5, 3.5), rng.uniform(0.4, 0.9) * size[1]
    z = rng.uniform(-0.5, 0.5) * (size[2] - width - 1.0)
    low, high = -size[2] / 2, size[2] / 2
    albedo = rng.uniform(0.3, 0.8, 3)
    parts = [(low, z - width / 2, -size[1] / 2, size[1] / 2), (z + width / 2, high, -size[1] / 2, size[1] / 2)]
    parts.append((z - width / 2, z + width / 2, -size[1] / 2 + height, size[1] / 2))
    return [
        _block(f"divider{k}", np.array([x, (b0 + b1) / 2, (a0 + a1) / 2]), np.array([_WALL, b1 - b0, a1 - a0]), 0.0, albedo)
        for k, (a0, a1, b0, b1) in enumerate(parts)
    ]


def _panel(rng: np.random.Generator, size: np.ndarray) -> Mesh:
    """The light: under the ceiling or, in one of four rooms, before a wall; faces into the room."""
    extent = rng.uniform(1.0, 4.0, 2)
    normal = np.array([0.0, -1, 0])
    if rng.random() < 0.25:
        normal = np.eye(3)[rng.choice([0, 2])] * rng.choice([-1, 1])
    first = np.eye(3)[(int(np.abs(normal).argmax()) + 1) % 3]
    second = np.cross(normal, first)
    reach = np.abs(np.stack([first, second]) * extent[:, None] / 2).sum(0)
    center = rng.uniform(-1, 1, 3) * (size / 2 - 0.5 - reach)
    away = np.abs(normal) > 0.5
    center[away] = (-normal * (size / 2 - rng.uniform(0.03, 0.4)))[away]
    corner = center - first * extent[0] / 2 - second * extent[1] / 2
    return _quad("light", corner, first * extent[0], second * extent[1], np.zeros(3))


def _quad(name: str, corner: np.ndarray, first: np.ndarray, second: np.ndarray, albedo: np.ndarray) -> Mesh:
    """Parallelogram with the normal along first x second."""
    vertices = np.stack([corner, corner + first, corner + first + second, corner + second])
    return Mesh(name, vertices, np.array([[0, 1, 2], [0, 2, 3]]), Material(name, albedo))


def _block(name: str, center: np.ndarray, extent: np.ndarray, turn: float, albedo: np.ndarray) -> Mesh:
    """Closed box, normals outwards, turned about the vertical."""
    unit = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]) / 2
    faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    triangles = [t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))]
    return Mesh(name, (unit * extent) @ _rotation(turn).T + center, np.array(triangles), Material(name, albedo))


def _rotation(turn: float) -> np.ndarray:
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def _moved(mesh: Mesh, turn: float, shift: np.ndarray) -> Mesh:
    return Mesh(mesh.name, _CELL * (mesh.vertices @ _rotation(turn).T + shift), mesh.triangles, mesh.material)


def traced_room(
    seed: int, index: int, folder: str | Path, *, receivers: int = 400, spp: int = 512, workers: int = 1
) -> TrainingRoom:
    """Room number ``index`` with path-traced targets in ``folder/room<index>``: made once, then read.

    Args:
        seed: of rooms and targets.
        index: number of the room.
        folder: where targets are kept.
        receivers: points on surfaces.
        spp: paths per receiver.
        workers: processes.
    """
    scene, grid = draw_room(seed, index)
    targets = make_targets(
        scene, Path(folder) / f"room{index}", receiver_count=receivers, components=("direct", "bounce1"), spp=spp, seed=seed,
        workers=workers, progress=False,
    )  # fmt: skip
    light = targets.lights[0]
    table = targets.receivers
    panel = scene.triangle_vertices[scene.triangle_mesh == len(scene.meshes) - 1]
    resolved = triangle_distance(panel, table.position) > grid.cell_size  # a cell next to the light can not hold its field
    return TrainingRoom(scene, grid, replace(table, area_weight=light.area_weight * resolved), light.irradiance)
