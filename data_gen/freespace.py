"""Points in free space: inside the scene's bounds, off every surface, not inside a solid.

A point is free when light reaches it within six reflections in the grey twin of the scene, or when at least one ray in
eight leaves the scene; the inside of a closed object has neither. Independent of the triangles' winding.
"""

from __future__ import annotations

import numpy as np

from data_gen.components import Components
from data_gen.estimators import probe_block
from data_gen.pathtracer import PathTracer
from data_gen.receivers import grey_twin
from data_gen.rng import generator
from data_gen.samplers import uniform_sphere
from difflpv.scene import Scene
from difflpv.triangle_distance import triangle_distance

__all__ = ["default_clearance", "draw_probes", "is_free"]

_STREAM = 102
_RAYS = 64
_ESCAPE_SHARE = 1 / 8
_CLEARANCE_SHARE = 0.004
_CHUNK = 2**12  # points at once: memory


def default_clearance(bounds: tuple[np.ndarray, np.ndarray]) -> float:
    """Least distance to any surface [m] of points drawn in a box (lowest, highest corner [3] m): 0.4 % of its longest edge."""
    low, high = bounds
    return _CLEARANCE_SHARE * float((np.asarray(high) - np.asarray(low)).max())


def is_free(scene: Scene, points: np.ndarray, seed: int = 0) -> np.ndarray:
    """True for points that are not inside a solid, by the rule at the top of this file.

    Args:
        scene: under its own lights.
        points: off every surface [n,3] m; on a surface either answer may come.
        seed: of the rays. A point decides on 64 paths and 64 rays of its own.

    Returns:
        Shape [n] bool. The distance to surfaces is no part of it: see ``difflpv.triangle_distance.triangle_distance``.
    """
    return _free(PathTracer(grey_twin(scene)), np.asarray(points, np.float64).reshape(-1, 3), seed, attempt=0)


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
        clearance: least distance to any surface [m]; ``default_clearance`` if None.
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
        clearance = default_clearance((low, high))
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
    free = np.zeros(len(points), bool)
    for start in range(0, len(points), _CHUNK):
        here = points[start : start + _CHUNK]
        escaped = np.zeros(len(here))
        for row in generator(seed, _STREAM, 2, attempt, start).random((_RAYS, 2, len(here))):
            escaped += ~tracer.raycaster.closest(here, uniform_sphere(row).T).valid
        found = escaped >= _ESCAPE_SHARE * _RAYS
        for bounces in (1, 6):  # one reflection shows most of what six do, at a third of the rays
            rest = np.flatnonzero(~found)
            if len(rest):
                address = (_STREAM, 1, attempt, start, bounces)
                wanted = Components.of([f"upto{bounces}"])
                light = probe_block(tracer, here[rest], wanted, samples=2, seed=seed, address=address)
                found[rest] = light[:, :, 0, 0].max((0, 2)) > 0
        free[start : start + _CHUNK] = found
    return free
