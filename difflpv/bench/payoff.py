"""After how many solves targets and a fit have paid off, against tracing paths at an equal error each time.

What a fit costs is spent once: the path-traced targets that it learns from, and the fit itself. Each later solve saves what
the paths would have taken at the error that the fitted model has.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from data_gen.few_paths import PathPool
from difflpv.bench.configuration import chosen
from difflpv.bench.equal_error import EqualTracer
from difflpv.bench.measure import Point, errors, prepare
from difflpv.bench.scenes import BenchScene
from difflpv.bench.settings import BenchSettings
from difflpv.bench.timing import interleaved, timed
from difflpv.bench.volume import VolumeRun

__all__ = ["PAY_OFF_COUNTS", "measure_pay_off", "solves_to_pay_off"]

PAY_OFF_COUNTS = (1_000, 10_000, 100_000, 1_000_000)


def solves_to_pay_off(once: float, solve: float, traced: float) -> float | None:
    """Number of solves after which ``once`` [s] is saved, if each takes ``solve`` [s] instead of ``traced``; None: never."""
    return None if traced <= solve else once / (traced - solve)


def measure_pay_off(
    points: Sequence[Point], scene: BenchScene, tuning: BenchScene, settings: BenchSettings, *, pool: PathPool | None = None
) -> list[dict[str, Any]]:
    """What fits to this scene cost and what they save, a row per fitted configuration.

    Args:
        points: of this scene.
        scene: where.
        tuning: what the fits learned from.
        settings: sizes and repeats.
        pool: path tracers of this scene that wait for work; one in this process by default.

    Returns:
        Rows of ``scene``, ``configuration``, ``error`` with the fit and ``error_before``, ``targets_seconds`` (processor
        time), ``fit_seconds``, ``paths`` of equal error, and by number of receivers (``counts``): ``solve_seconds`` (lights
        moved, solved, looked up), ``traced_seconds``, ``setup_seconds`` (what stands between cells, what receivers see),
        ``solves`` that pay targets and fit off, ``solves_with_setup`` that pay the set-up off too (None: never).
    """
    found = [
        (p, EqualTracer.of(points, "path tracer", p.error, scene, most=settings.costly_receivers, pool=pool))
        for p in points
        if "fit" in p.setup_seconds
    ]
    return [_row(p, tracer, scene, tuning, settings) for p, tracer in found if tracer is not None]


def _row(point: Point, tracer: EqualTracer, scene: BenchScene, tuning: BenchScene, settings: BenchSettings) -> dict[str, Any]:
    assert point.solve is not None
    (configuration,) = chosen([point.name])
    run = prepare(replace(configuration, learn=()), scene)
    assert isinstance(run, VolumeRun)
    counts = [n for n in PAY_OFF_COUNTS if n <= settings.costly_receivers]
    rng, solved = np.random.default_rng(scene.seed), run.solve()
    rows = {n: rng.integers(0, len(scene.position), n) for n in {*PAY_OFF_COUNTS, tracer.most}}
    place = run.light.receivers
    seen = {n: timed(partial(place, scene.position[rows[n]], scene.normal[rows[n]])) for n in counts}
    calls: dict[str, Callable[[], object]] = {}
    for n in counts:
        calls[f"lookup {n}"] = partial(run.lookup, solved, seen[n][0])
    for n in {n for n in counts if n < tracer.most} | {tracer.most}:
        calls[f"traced {n}"] = partial(tracer.run.predict, scene.position[rows[n]], scene.normal[rows[n]])
    times = interleaved(calls, max(2, settings.repeats // 2), patience=settings.patience)

    def scaled(name: str, most: int) -> list[float]:
        """Measured, or proportional from the largest number that was."""
        own = [(times.get(f"{name} {n}"), n) for n in PAY_OFF_COUNTS]
        return [known.median if known else times[f"{name} {most}"].median * n / most for known, n in own]

    solve = [point.solve.median + point.lights_seconds + t for t in scaled("lookup", counts[-1])]
    traced = [tracer.ratio * t for t in scaled("traced", tracer.most)]
    farthest = seen[counts[-1]][1] / counts[-1]
    setup = [run.setup["geometry"] + (seen[n][1] if n in seen else farthest * n) for n in PAY_OFF_COUNTS]
    fit = point.setup_seconds["fit"]
    once = tuning.target_seconds + fit
    return {
        "scene": scene.key, "configuration": point.name, "error": point.error,
        "error_before": errors(run.lookup(solved), scene)["error"], "targets_seconds": tuning.target_seconds,
        "fit_seconds": fit, "paths": tracer.paths, "counts": list(PAY_OFF_COUNTS), "solve_seconds": solve,
        "traced_seconds": traced, "setup_seconds": setup,
        "solves": [solves_to_pay_off(once, s, t) for s, t in zip(solve, traced, strict=True)],
        "solves_with_setup": [solves_to_pay_off(once + m, s, t) for s, t, m in zip(solve, traced, setup, strict=True)],
    }  # fmt: skip
