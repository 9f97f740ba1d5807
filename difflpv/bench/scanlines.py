"""Irradiance along straight lines on floors, as the HOLPV thesis plots its scanlines (Martin 2012, Figures 5.4 and 5.18).

An error says how far off a method is, a line where: leaks, the width of a peak, steps at the borders of cells.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from data_gen.few_paths import PathPool
from difflpv.bench.configuration import chosen
from difflpv.bench.measure import prepare
from difflpv.bench.scenes import BenchScene
from difflpv.raycast import Raycaster
from difflpv.scene import Scene

__all__ = ["SCANLINES", "Scanline", "line_points", "measure_scanlines"]

_METHODS = ("LPV as published", "HOLPV as published", "learned_9x26", "floor")
_POINTS = 161
_REPLICATES = 8
_SEED = 4_000_037  # added to that of the truth


@dataclass(frozen=True)
class Scanline:
    """A line on a floor: ends [m] on the surface, whose normal points up (+y)."""

    name: str
    begin: tuple[float, float, float]
    end: tuple[float, float, float]

    @property
    def length(self) -> float:
        """Metres."""
        return math.dist(self.begin, self.end)


_ROOM = (
    Scanline("floor", (-2.7, 0.0, 2.4), (2.7, 0.0, 2.4)),  # in front of both blocks, from the red wall to the green one
    Scanline("diagonal", (-2.7, 0.0, 2.7), (2.7, 0.0, -2.7)),
)
# By key of a bench scene. The light of "diagonal" stands in a corner and shines along the diagonal.
SCANLINES: dict[str, tuple[Scanline, ...]] = {
    "cornell/bounce1": _ROOM,
    "cornell/direct": _ROOM,
    "diagonal/direct": (
        Scanline("floor", (-2.45, 0.0, 0.0), (2.45, 0.0, 0.0)),
        Scanline("diagonal", (-2.45, 0.0, -2.45), (2.45, 0.0, 2.45)),
    ),
}


def line_points(scene: Scene, line: Scanline, count: int = _POINTS) -> tuple[np.ndarray, np.ndarray]:
    """Points along a line that lie in the open.

    Args:
        scene: whose solid objects may stand on the line.
        line: where.
        count: points, evenly spaced, the ends among them.

    Returns:
        Distance from the line's begin [n] m and position [n,3] m, without the points that an object covers.
    """
    share = np.linspace(0, 1, count)
    position = (1 - share)[:, None] * np.array(line.begin) + share[:, None] * np.array(line.end)
    up = np.array([0.0, 1.0, 0.0])
    hits = Raycaster(scene).closest(position + 1e-3 * up, np.broadcast_to(up, position.shape))
    # inside a solid object the first surface above is seen from behind
    covered = hits.valid & (scene.triangle_normals[np.maximum(hits.triangle, 0)] @ up > 0)
    return share[~covered] * line.length, position[~covered]


def measure_scanlines(
    scene: BenchScene, *, spp: int, cell_spp: int, pool: PathPool | None = None
) -> list[dict[str, Any]]:
    """Truth and predictions along every line of a scene.

    Args:
        scene: one of ``SCANLINES``; others have no lines.
        spp: paths of the truth per point, a power of two, at least 8.
        cell_spp: paths per cell of the floor of the class.
        pool: path tracers of this scene that wait for work; one in this process by default.

    Returns:
        Rows of ``scene``, ``line``, ``cell_size``, ``distance`` [n], mean of the channels of irradiance ``truth`` [n] with its
        ``standard_error`` [n], ``methods`` by name [n], and ``errors`` by name: relative L2 along the line.
    """
    lines = SCANLINES.get(scene.key, ())
    if not lines:
        return []
    tracers = pool or PathPool(scene.scene)
    predict: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
        c.name: prepare(c, scene, cell_spp=cell_spp).predict for c in chosen(_METHODS)
    }
    rows = []
    for line in lines:
        distance, position = line_points(scene.scene, line)
        normal = np.broadcast_to([0.0, 1.0, 0.0], position.shape).copy()
        traced = np.stack([
            tracers.trace(
                position, normal, scene.component, samples=spp // _REPLICATES,
                seed=scene.seed + _SEED + tracers.workers * number,
            )
            for number in range(_REPLICATES)
        ])  # fmt: skip
        truth, each = traced.mean(0), traced.mean(2)
        found = {name: call(position, normal) for name, call in predict.items()}
        rows.append({
            "scene": scene.key, "line": line.name, "cell_size": scene.grid().cell_size, "distance": distance.tolist(),
            "truth": each.mean(0).tolist(), "standard_error": (each.std(0, ddof=1) / math.sqrt(_REPLICATES)).tolist(),
            "methods": {name: values.mean(1).tolist() for name, values in found.items()},
            "errors": {
                name: float(np.linalg.norm(values - truth) / np.linalg.norm(truth)) for name, values in found.items()
            },
        })  # fmt: skip
    return rows
