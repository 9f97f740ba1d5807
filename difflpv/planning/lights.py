"""Light sets that a plan is judged on: those bundled with a scene, or its own lights moved a little within free space."""

from __future__ import annotations

from typing import Any

import numpy as np

from difflpv.lights import load_light_sets
from difflpv.raycast import Raycaster
from difflpv.scene import AreaLight, DirectionalLight, Scene, SceneError, SpotLight

__all__ = ["held_out_lights", "moved_light_sets", "moved_lights"]

_TURN = 0.3  # rad, the largest turn of a directional light
_SHIFT = 0.12  # of the scene's extent, the largest shift of the others
_SMALLEST = 0.6  # of a panel's edges, so that one which touches the scene's bounds can move too
_ATTEMPTS = 20
_LIFT = 0.05  # of the scene's extent


def held_out_lights(scene: Scene, count: int, *, seed: int = 0) -> list[list[dict[str, Any]]]:
    """Light sets for ``difflpv.lights.apply_light_set``: ``count`` spread over the bundled ones, or as many moved ones.

    Args:
        scene: under its own lights.
        count: how many, >= 1; fewer come back where the scene has fewer.
        seed: of the moves.
    """
    try:
        bundled = [[dict(entry) for entry in entries] for entries in load_light_sets(None, scene.name)]
    except SceneError:
        bundled = []
    meshes = {mesh.name for mesh in scene.meshes}
    if bundled and all(entry.get("mesh", next(iter(meshes))) in meshes for entries in bundled for entry in entries):
        picked = np.unique(np.linspace(0, len(bundled) - 1, count).round().astype(int))
        return [bundled[i] for i in picked]
    return moved_light_sets(scene, count, seed=seed)


def moved_light_sets(scene: Scene, count: int, *, seed: int = 0) -> list[list[dict[str, Any]]]:
    """The scene's own lights, then moved ones (``moved_lights``): ``count`` sets, fewer where lights cannot be moved."""
    random = np.random.default_rng([seed, 7])
    sets = [moved_lights(scene, random, moved=k > 0) for k in range(count)]
    unique = {repr(entries): entries for entries in sets}  # lights that cannot be moved come once
    return list(unique.values())


def moved_lights(scene: Scene, random: np.random.Generator, *, moved: bool = True) -> list[dict[str, Any]]:
    """The scene's own lights as a light set, moved: directional lights turn, others shift to where nothing is in between.

    An area light is moved and shrunk where its mesh is a parallelogram, in its own plane; another one stays.
    """
    raycaster, (low, high) = Raycaster(scene), scene.bounds
    meshes = {mesh.name: mesh for mesh in scene.meshes}
    entries: list[dict[str, Any]] = []
    for light in scene.lights:
        if isinstance(light, AreaLight):
            entry: dict[str, Any] = {
                "type": "area", "mesh": light.mesh, "radiance": light.radiance.tolist(), "one_sided": not light.two_sided,
            }  # fmt: skip
            corners = _parallelogram(meshes[light.mesh].vertices, meshes[light.mesh].triangles) if moved else None
            if corners is not None:
                entry["vertices"] = _shifted(corners, raycaster, low, high, random, in_plane=True).tolist()
        elif isinstance(light, DirectionalLight):
            entry = {"type": "directional", "irradiance": light.irradiance.tolist(), "name": light.name}
            direction = _turned(light.direction, random) if moved else light.direction
            entry["direction"] = direction.tolist()
        else:
            position = light.position[None]
            if moved:
                position = _shifted(position, raycaster, low, high, random, in_plane=False)
            entry = {"type": "point", "intensity": light.intensity.tolist(), "name": light.name}
            entry["position"] = position[0].tolist()
            if isinstance(light, SpotLight):
                angles = {"inner_angle": light.inner_angle, "outer_angle": light.outer_angle}
                entry |= {"type": "spot", "direction": light.direction.tolist(), **angles}
        entries.append(entry)
    return entries


def _turned(direction: np.ndarray, random: np.random.Generator) -> np.ndarray:
    axis = np.cross(direction, random.normal(size=3))
    turned = direction + np.tan(_TURN * random.uniform(0.3, 1)) * np.linalg.norm(direction) * axis / np.linalg.norm(axis)
    return turned / np.linalg.norm(turned)


def _shifted(
    points: np.ndarray, raycaster: Raycaster, low: np.ndarray, high: np.ndarray, random: np.random.Generator, *, in_plane: bool
) -> np.ndarray:
    """Points [n,3] moved together to where all stay inside the scene's bounds and nothing stands in their way."""
    extent, center = float((high - low).max()), points.mean(0)
    unit = None
    if in_plane:
        normal = np.cross(points[1] - points[0], points[-1] - points[0])
        unit = normal / np.linalg.norm(normal)
    # off the light's own surface; where it is set into a frame, off that too
    for lift in (4 * raycaster.offset, _LIFT * extent) if in_plane else (0.0,):
        for attempt in range(_ATTEMPTS):
            shift = random.uniform(-_SHIFT * extent, _SHIFT * extent, 3) * 0.8**attempt
            size = random.uniform(_SMALLEST, 1)
            if unit is not None:
                shift -= unit * (shift @ unit)
            moved = center + size * (points - center) + shift
            above = np.zeros(3) if unit is None else lift * unit
            free = not raycaster.blocked(points + above, moved + above, shortened=False).any()
            if free and (moved > low - 1e-6).all() and (moved < high + 1e-6).all():
                return moved
    return points


def _parallelogram(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray | None:
    """Corners a, b, c, d of a mesh of two triangles (a, b, c), (a, c, d), turned as these are; None where it is another."""
    if len(triangles) != 2:
        return None
    first, second = (np.asarray(vertices[t], float) for t in triangles)
    for k in range(3):  # the second triangle's corner that the first has not, put into the first's order
        a, b, c = np.roll(first, -k, axis=0)
        d = a + c - b
        shared = [any(np.allclose(v, corner, atol=1e-6 * np.ptp(first)) for v in second) for corner in (a, c, d)]
        if all(shared):
            return np.stack([a, b, c, d])
    return None
