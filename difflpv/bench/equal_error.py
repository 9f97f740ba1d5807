"""Path tracers that are as wrong as another method: how many paths that takes, and a tracer of so many.

Paths come in powers of two: the time of other numbers is scaled from the nearest power, to which it is proportional.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_gen.few_paths import PathPool
from difflpv.bench.configuration import LADDER, Configuration, Family, Kind
from difflpv.bench.measure import Point, prepare
from difflpv.bench.mitsuba_peer import MitsubaRun, unavailable
from difflpv.bench.scenes import BenchScene
from difflpv.bench.tracers import PathRun

__all__ = ["EqualTracer", "equal_paths"]

_MOST_PATHS = 1 << 20  # traced at a time: beyond that, time is proportional to receivers
_KINDS: dict[Family, Kind] = {"path tracer": "paths", "Mitsuba 3": "mitsuba"}


def equal_paths(points: Sequence[Point], family: str, error: float) -> float | None:
    """Paths per receiver at which a path tracer has this error, by log-log interpolation of its points; None without any.

    Beyond its points noise falls as one over the root of the paths.
    """
    samples = {c.name: c.samples for c in LADDER}
    own = sorted((samples[p.name] or 1, p.error) for p in points if p.family == family)
    if not own:
        return None
    n, e = np.log([k for k, _ in own]), np.log([v for _, v in own])
    if np.log(error) < e[-1]:
        return float(np.exp(n[-1] + 2 * (e[-1] - np.log(error))))
    return float(np.exp(np.interp(-np.log(error), -e, n)))


@dataclass(frozen=True, eq=False)
class EqualTracer:
    """A path tracer at the power of two of paths that is nearest to an equal error.

    Attributes:
        run: the tracer.
        paths: per receiver, at which it has this error.
        power: paths per receiver that it traces.
        most: receivers beyond which its time is proportional to their number.
    """

    run: PathRun | MitsubaRun
    paths: float
    power: int
    most: int

    @classmethod
    def of(
        cls, points: Sequence[Point], family: Family, error: float, scene: BenchScene, *, most: int,
        pool: PathPool | None = None,
    ) -> EqualTracer | None:
        """A tracer of a family, None where it was not measured or cannot be used.

        Args:
            points: of this scene, the tracer's among them.
            family: "path tracer" or "Mitsuba 3".
            error: to be equal to.
            scene: where.
            most: receivers to trace at a time, unless so many paths are too many.
            pool: path tracers of this scene that wait for work; one in this process by default.
        """
        paths = equal_paths(points, family, error)
        if paths is None or (family == "Mitsuba 3" and unavailable()):
            return None
        power = max(1, 1 << round(np.log2(paths)))
        run = prepare(Configuration(family, _KINDS[family], family, samples=power), scene, pool=pool)
        assert isinstance(run, (PathRun, MitsubaRun))
        return cls(run, paths, power, max(1000, min(_MOST_PATHS // power, most)))

    @property
    def ratio(self) -> float:
        """Time at an equal error over the time of the paths that are traced."""
        return self.paths / self.power
