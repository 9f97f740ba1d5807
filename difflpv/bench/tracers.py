"""The peers that need no volume: the mean of the truth, and this project's path tracer at a few paths per receiver."""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

from data_gen.components import Components
from data_gen.estimators import irradiance_block
from data_gen.pathtracer import PathTracer
from difflpv.bench.configuration import Configuration
from difflpv.bench.scenes import BenchScene
from difflpv.evaluate import predict_constant
from difflpv.scene import Scene

__all__ = ["ConstantRun", "PathRun", "trace_paths"]

_PATHS_PER_CALL = 1 << 16
_SEED = 1_000_003  # added to that of the truth: its paths must not judge themselves


class ConstantRun:
    """The mean of the truth at every receiver."""

    def __init__(self, configuration: Configuration, bench: BenchScene) -> None:
        self.configuration, self.bench = configuration, bench
        self.setup: dict[str, float] = {}
        self.lights = 0.0

    def solve(self) -> np.ndarray:
        """The mean, at every receiver."""
        return predict_constant(self.bench.truth, self.bench.weight)

    def lookup(self, solved: np.ndarray) -> np.ndarray:
        """What was solved."""
        return solved

    def predict(self, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """The mean, at other receivers."""
        return np.broadcast_to(self.solve()[:1], position.shape).copy()


def trace_paths(
    tracer: PathTracer, position: np.ndarray, normal: np.ndarray, component: str, *, samples: int, seed: int
) -> np.ndarray:
    """Irradiance [n,3] of receivers [n,3] by so many paths each, a power of two."""
    wanted, parts = Components.of([component]), []
    step = max(1, _PATHS_PER_CALL // samples)
    for begin in range(0, len(position), step):
        rows = slice(begin, begin + step)
        means = irradiance_block(
            tracer, position[rows], normal[rows], wanted, samples=samples, seed=seed, address=(begin,), replicates=1
        )
        parts.append(means[0, :, 0])
    return np.concatenate(parts) if parts else np.zeros((0, 3))


class PathRun:
    """This project's path tracer, in as many processes as are given; they start, and build their scene, once."""

    def __init__(self, configuration: Configuration, bench: BenchScene, *, workers: int = 1) -> None:
        assert configuration.samples is not None
        self.configuration, self.bench, self.samples = configuration, bench, configuration.samples
        self.workers = workers
        self.setup: dict[str, float] = {}
        self.lights = 0.0
        self._tracer = PathTracer(bench.scene)
        self._pool: ProcessPoolExecutor | None = None

    def solve(self) -> np.ndarray:
        """Trace every receiver."""
        return self.predict(self.bench.position, self.bench.normal)

    def lookup(self, solved: np.ndarray) -> np.ndarray:
        """What was solved."""
        return solved

    def predict(self, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Trace other receivers."""
        seed = self.bench.seed + _SEED
        options: dict[str, Any] = {"samples": self.samples, "seed": seed}
        if self.workers == 1:
            return trace_paths(self._tracer, position, normal, self.bench.component, **options)
        if self._pool is None:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self.workers, context, _start_worker, (self.bench.scene,))
        bounds = np.linspace(0, len(position), self.workers + 1).astype(int)
        waiting = [
            self._pool.submit(_work, position[a:b], normal[a:b], self.bench.component, self.samples, seed + i)
            for i, (a, b) in enumerate(zip(bounds[:-1], bounds[1:], strict=True))
        ]
        return np.concatenate([w.result() for w in waiting])

    def close(self) -> None:
        """End the processes."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None


_worker_tracer: PathTracer | None = None


def _start_worker(scene: Scene) -> None:
    global _worker_tracer
    _worker_tracer = PathTracer(scene)


def _work(position: np.ndarray, normal: np.ndarray, component: str, samples: int, seed: int) -> np.ndarray:
    assert _worker_tracer is not None
    return trace_paths(_worker_tracer, position, normal, component, samples=samples, seed=seed)
