"""Irradiance of receivers, or radiance of probes, by a few paths each, in processes that wait for work: peers to compare with.

Targets with their standard errors are ``data_gen.targets``.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

from data_gen.components import Components
from data_gen.estimators import irradiance_block, probe_block
from data_gen.pathtracer import PathTracer
from data_gen.workers import start_pool
from difflpv.scene import Scene

__all__ = ["PathPool", "trace_paths", "trace_probe_paths"]

_PATHS_PER_CALL = 1 << 16
_tracer: PathTracer | None = None  # of a worker process


def trace_paths(
    tracer: PathTracer, position: np.ndarray, normal: np.ndarray, component: str, *, samples: int, seed: int
) -> np.ndarray:
    """Irradiance [n,3] W/m2 of receivers [n,3] m with normals [n,3] by so many paths each, a power of two."""
    return _in_parts(irradiance_block, tracer, (position, normal), component, samples, seed, (3,))


def trace_probe_paths(tracer: PathTracer, position: np.ndarray, component: str, *, samples: int, seed: int) -> np.ndarray:
    """Radiance SH toward the incoming light [n,9,3] W/m2 of probes [n,3] m by so many paths each, a power of two."""
    return _in_parts(probe_block, tracer, (position,), component, samples, seed, (9, 3))


def _in_parts(
    block: Callable[..., np.ndarray],
    tracer: PathTracer,
    entities: tuple[np.ndarray, ...],
    component: str,
    samples: int,
    seed: int,
    shape: tuple[int, ...],
) -> np.ndarray:
    """What a block of ``data_gen.estimators`` finds [n, *shape] for ``entities`` [n,3], so many at a time."""
    wanted, parts = Components.of([component]), [np.zeros((0, *shape))]
    step = max(1, _PATHS_PER_CALL // samples)
    for begin in range(0, len(entities[0]), step):
        rows = [part[begin : begin + step] for part in entities]
        means = block(tracer, *rows, wanted, samples=samples, seed=seed, address=(begin,), replicates=1)
        parts.append(means[0, :, 0])
    return np.concatenate(parts)


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
        return self._share(trace_paths, (position, normal), component, samples, seed)

    def trace_probes(self, position: np.ndarray, component: str, *, samples: int, seed: int) -> np.ndarray:
        """As ``trace_probe_paths``; the bits depend on the number of workers."""
        return self._share(trace_probe_paths, (position,), component, samples, seed)

    def _share(
        self, trace: Callable[..., np.ndarray], rows: tuple[np.ndarray, ...], component: str, samples: int, seed: int
    ) -> np.ndarray:
        if self._own is not None:
            return trace(self._own, *rows, component, samples=samples, seed=seed)
        assert self._pool is not None
        bounds = np.linspace(0, len(rows[0]), self.workers + 1).astype(int)
        waiting = [
            self._pool.submit(_work, trace, [part[a:b] for part in rows], component, samples, seed + i)
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


def _work(trace: Callable[..., np.ndarray], rows: list[Any], component: str, samples: int, seed: int) -> np.ndarray:
    assert _tracer is not None
    return trace(_tracer, *rows, component, samples=samples, seed=seed)
