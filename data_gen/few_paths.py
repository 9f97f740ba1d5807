"""Irradiance of receivers by a few paths each, in one process or several that wait for work: a peer to compare with.

Targets with their standard errors are ``data_gen.targets``.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor

import numpy as np

from data_gen.components import Components
from data_gen.estimators import irradiance_block
from data_gen.pathtracer import PathTracer
from data_gen.workers import start_pool
from difflpv.scene import Scene

__all__ = ["PathPool", "trace_paths"]

_PATHS_PER_CALL = 1 << 16
_tracer: PathTracer | None = None  # of a worker process


def trace_paths(
    tracer: PathTracer, position: np.ndarray, normal: np.ndarray, component: str, *, samples: int, seed: int
) -> np.ndarray:
    """Irradiance [n,3] W/m2 of receivers [n,3] m with normals [n,3] by so many paths each, a power of two."""
    wanted, parts = Components.of([component]), []
    step = max(1, _PATHS_PER_CALL // samples)
    for begin in range(0, len(position), step):
        rows = slice(begin, begin + step)
        means = irradiance_block(
            tracer, position[rows], normal[rows], wanted, samples=samples, seed=seed, address=(begin,), replicates=1
        )
        parts.append(means[0, :, 0])
    return np.concatenate(parts) if parts else np.zeros((0, 3))


class PathPool:
    """Path tracers of one scene, one per process; with a single worker no process is started."""

    def __init__(self, scene: Scene, workers: int = 1) -> None:
        self.scene, self.workers = scene, workers
        self._own = PathTracer(scene) if workers == 1 else None
        self._pool: ProcessPoolExecutor | None = None
        if workers > 1:
            self._pool = start_pool(workers, _start, scene)

    def trace(self, position: np.ndarray, normal: np.ndarray, component: str, *, samples: int, seed: int) -> np.ndarray:
        """As ``trace_paths``; the bits depend on the number of workers."""
        if self._own is not None:
            return trace_paths(self._own, position, normal, component, samples=samples, seed=seed)
        assert self._pool is not None
        bounds = np.linspace(0, len(position), self.workers + 1).astype(int)
        waiting = [
            self._pool.submit(_work, position[a:b], normal[a:b], component, samples, seed + i)
            for i, (a, b) in enumerate(zip(bounds[:-1], bounds[1:], strict=True))
        ]
        return np.concatenate([w.result() for w in waiting])

    def close(self) -> None:
        """End the processes."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)


def _start(scene: Scene) -> None:
    global _tracer
    _tracer = PathTracer(scene)


def _work(position: np.ndarray, normal: np.ndarray, component: str, samples: int, seed: int) -> np.ndarray:
    assert _tracer is not None
    return trace_paths(_tracer, position, normal, component, samples=samples, seed=seed)
