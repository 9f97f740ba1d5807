"""Placement tasks with analytic light: a point light of degree 2 in a box of two rooms. Nothing is path traced."""

import numpy as np
import torch
from hand_scenes import box_walls, rectangle

from difflpv.grid import Grid
from difflpv.placement.task import PlacementTask
from difflpv.probes.lattice import LatticeField
from difflpv.scene import PointLight, Scene
from difflpv.sh import sh_basis

LOW, HIGH = np.array([-2.0, -1.0, -1.0]), np.array([2.0, 1.0, 1.0])
WALL = 0.1
LIGHT = np.array([-1.0, 0.3, 0.2])


def two_rooms(*, wall: bool = True, block: bool = False) -> Scene:
    """A box of 4 x 2 x 2 m, a wall without thickness at x = ``WALL``, and if asked for a solid block in the right half."""
    meshes = box_walls(LOW, HIGH)
    if wall:
        meshes += (rectangle("wall", (WALL, -1, -1), (0, 2, 0), (0, 0, 2)),)
    if block:
        meshes += tuple(
            rectangle(f"block {name}", corner, last - corner, first - corner)  # normals outwards
            for name, (corner, first, _, last) in (
                (mesh.name, mesh.vertices) for mesh in box_walls((0.6, -0.7, -0.7), (1.6, 0.4, 0.5))
            )
        )
    return Scene("two rooms", meshes, (PointLight(LIGHT, np.ones(3)),))


def clearance(x: np.ndarray, *, wall: bool, block: bool) -> np.ndarray:
    """Signed distance to the nearest surface [m], exact up to the block's edges."""
    distance = np.minimum(x - LOW, HIGH - x).min(-1)
    if wall:
        distance = np.where(distance > 0, np.minimum(distance, np.abs(x[..., 0] - WALL)), distance)
    if block:
        outside = np.maximum(np.array([0.6, -0.7, -0.7]) - x, x - np.array([1.6, 0.4, 0.5])).max(-1)
        distance = np.minimum(distance, outside)
    return distance


def point_light(x: np.ndarray, *, wall: bool = True, ambient: float = 0.0, size: float = 0.15) -> np.ndarray:
    """Radiance SH [..., 9, 3] of a point light seen through degree 2, nothing of it behind the wall."""
    toward = LIGHT - x
    square = (toward**2).sum(-1, keepdims=True)
    irradiance = 1 / (square + size**2)
    lit = (x[..., :1] < WALL) | (not wall)
    coefficients = sh_basis(toward / np.sqrt(square + 1e-12), 2) * irradiance * lit
    coefficients[..., 0] += ambient
    return coefficients[..., None] * np.array([1.0, 0.8, 0.6])


def analytic_task(
    *, wall: bool = True, block: bool = False, ambient: float = 0.0, points: int = 400, cell: float = 0.125, radiance=None
) -> PlacementTask:
    """A task on these rooms; ``radiance`` (positions [...,3] -> [...,9,3]) replaces the point light."""
    light = radiance or (lambda x: point_light(x, wall=wall, ambient=ambient))
    grid = Grid.from_bounds(LOW - cell, HIGH + cell, np.round((HIGH - LOW) / cell + 2).astype(int))
    centers = grid.cell_centers()
    x = np.random.default_rng(5).uniform(LOW + 0.05, HIGH - 0.05, (4 * points, 3))
    x = x[clearance(x, wall=wall, block=block) > 0.03][:points]
    return PlacementTask(
        two_rooms(wall=wall, block=block),
        torch.as_tensor(x),
        torch.as_tensor(light(x)),
        LatticeField(grid, torch.as_tensor(light(centers))),
        LatticeField(grid, torch.as_tensor(clearance(centers, wall=wall, block=block))),
    )
