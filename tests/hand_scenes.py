"""Scenes made by hand: rectangles, an inward box with one mesh per wall, random emitters."""

import numpy as np
import torch

from difflpv.direct import Emitters
from difflpv.scene import AreaLight, Material, Mesh, PointLight, Scene

LIGHT = PointLight(np.array([0.2, 0.1, -0.3]), np.array([2.0, 3.0, 4.0]))


def rectangle(name, corner, first, second, albedo=(0.5, 0.5, 0.5), *, uv=False, texture=None):
    """Parallelogram of two triangles with the normal along first x second."""
    a, u, v = (np.asarray(p, float) for p in (corner, first, second))
    vertices = np.stack([a, a + u, a + u + v, a + v])
    coordinates = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]) if uv else None
    material = Material(name, np.asarray(albedo, float), texture)
    return Mesh(name, vertices, np.array([[0, 1, 2], [0, 2, 3]]), material, coordinates)


def box_walls(low=(-1, -1, -1), high=(1, 1, 1), albedo=None):
    """Six walls, normals inwards; ``albedo`` [6,3] or one for all."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    albedo = np.broadcast_to(np.full(3, 0.5) if albedo is None else albedo, (6, 3))
    walls = []
    for axis in range(3):
        first, second = np.zeros(3), np.zeros(3)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        first[i], second[j] = high[i] - low[i], high[j] - low[j]
        top = low.copy()
        top[axis] = high[axis]
        walls.append(rectangle(f"wall{axis}-", low, first, second, albedo[2 * axis]))
        walls.append(rectangle(f"wall{axis}+", top, second, first, albedo[2 * axis + 1]))
    return tuple(walls)


def box_scene(lights=(LIGHT,), **options):
    return Scene("box", box_walls(**options), tuple(lights))


def panel_scene(*, two_sided=False, floor=4.0):
    """A floor, and above it a panel of 1 x 0.6 m that emits downwards."""
    ground = rectangle("floor", (-floor / 2, 0, -floor / 2), (0, 0, floor), (floor, 0, 0))
    panel = rectangle("panel", (-0.5, 1.0, -0.3), (1, 0, 0), (0, 0, 0.6), albedo=(0, 0, 0))
    return Scene("panel", (ground, panel), (AreaLight("panel", np.array([5.0, 3.0, 1.0]), two_sided),))


def unit_vectors(count, generator, dtype):
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=dtype), dim=1)


def random_emitters(count, generator, dtype):
    """All four kinds in turn."""

    def uniform(columns):
        return torch.rand(count, columns, generator=generator, dtype=dtype)

    return Emitters(
        kind=(torch.arange(count) % 4).int(),
        position=uniform(3) * 2 - 1,
        direction=unit_vectors(count, generator, dtype),
        power=uniform(3) + 0.2,
        cone=torch.tensor([[0.9, -0.6]], dtype=dtype).repeat(count, 1),
        light_index=torch.arange(count) // 2,
    )


def random_receivers(count, generator, dtype):
    return torch.rand(count, 3, generator=generator, dtype=dtype) * 4 - 2, unit_vectors(count, generator, dtype)
