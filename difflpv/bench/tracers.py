"""The peers that need no volume: the mean of the truth, and this project's path tracer at a few paths per receiver."""

from __future__ import annotations

import numpy as np

from data_gen.few_paths import PathPool
from difflpv.bench.configuration import Configuration
from difflpv.bench.scenes import BenchScene
from difflpv.evaluate import predict_constant

__all__ = ["PEER_SEED", "ConstantRun", "PathRun"]

PEER_SEED = 1_000_003
"""Added to the seed of the truth: its paths must not judge themselves."""


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


class PathRun:
    """This project's path tracer, by processes that are started, and have built their scene, beforehand."""

    def __init__(self, configuration: Configuration, bench: BenchScene, pool: PathPool) -> None:
        assert configuration.samples is not None
        self.configuration, self.bench, self.samples, self.pool = configuration, bench, configuration.samples, pool
        self.setup: dict[str, float] = {}
        self.lights = 0.0

    def solve(self) -> np.ndarray:
        """Trace every receiver."""
        return self.predict(self.bench.position, self.bench.normal)

    def lookup(self, solved: np.ndarray) -> np.ndarray:
        """What was solved."""
        return solved

    def predict(self, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Trace other receivers."""
        seed = self.bench.seed + PEER_SEED
        return self.pool.trace(position, normal, self.bench.component, samples=self.samples, seed=seed)
