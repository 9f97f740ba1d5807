"""Points in free space: inside the scene's bounds, off every surface, not inside a solid.

A point is free when light reaches it within six reflections in the grey twin of the scene, or when at least one ray in
eight leaves the scene; the inside of a closed object has neither. Independent of the triangles' winding.
"""

from __future__ import annotations

import numpy as np

from data_gen.components import Components
from data_gen.distance import triangle_distance
from data_gen.estimators import probe_block
from data_gen.pathtracer import PathTracer
from data_gen.receivers import grey_twin
from data_gen.rng import generator
from data_gen.samplers import uniform_sphere
from difflpv.scene import Scene

__all__ = ["draw_probes"]

_STREAM = 102
_RAYS = 64
_ESCAPE_SHARE = 1 / 8
_CLEARANCE_SHARE = 0.004


def draw_probes(
    scene: Scene,
    count: int,
    seed: int = 0,
    *,
    clearance: float | None = None,
    bounds: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Draw points uniformly in free space.

    Args:
        scene: the scene.
        count: number of points.
        seed: equal seeds draw equal points.
        clearance: least distance to any surface [m]; 0.4 % of the longest edge of the bounds if None.
        bounds: lowest and highest corner [m]; those of the scene's triangles if None.

    Returns:
        Positions [count, 3] m.

    Raises:
        ValueError: a bad argument, or hardly any free space in the bounds.
    """
    low, high = (np.asarray(corner, np.float64) for corner in (scene.bounds if bounds is None else bounds))
    if count < 1:
        raise ValueError(f"probe count: expected at least 1, got {count}")
    if not (high - low > 0).all():
        raise ValueError(f"probe bounds: expected a box with a volume, got {low.tolist()}..{high.tolist()}")
    if clearance is None:
        clearance = _CLEARANCE_SHARE * float((high - low).max())
    if not clearance >= 0:
        raise ValueError(f"clearance: expected a length >= 0, got {clearance}")
    tracer = PathTracer(grey_twin(scene))
    found = np.empty((0, 3))
    for attempt in range(64):
        points = low + generator(seed, _STREAM, 0, attempt).random((max(count, 64), 3)) * (high - low)
        points = points[triangle_distance(scene.triangle_vertices, points) >= clearance]
        points = points[_free(tracer, points, seed, attempt)]
        found = np.concatenate([found, points])
        if len(found) >= count:
            return found[:count]
        if attempt == 7 and not len(found):
            break
    raise ValueError(f"scene '{scene.name}': hardly any free space, found {len(found)} of {count} probes")


def _free(tracer: PathTracer, points: np.ndarray, seed: int, attempt: int) -> np.ndarray:
    if not len(points):
        return np.zeros(0, bool)
    address = (_STREAM, 1, attempt)
    light = probe_block(tracer, points, Components.of(["upto6"]), samples=2, seed=seed, address=address)
    escaped = np.zeros(len(points))
    for row in generator(seed, _STREAM, 2, attempt).random((_RAYS, 2, len(points))):
        escaped += ~tracer.raycaster.closest(points, uniform_sphere(row).T).valid
    return (light[:, :, 0, 0].max((0, 2)) > 0) | (escaped >= _ESCAPE_SHARE * _RAYS)
