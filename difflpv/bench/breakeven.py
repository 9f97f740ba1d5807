"""From how many receivers on a solve pays: time over their number at equal error, against path tracers.

The cheapest learned configuration that meets ``EQUAL_ERROR`` is compared with as many paths per receiver as give the error
that it has (``difflpv.bench.equal_error``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from data_gen.few_paths import PathPool
from difflpv.bench.configuration import LADDER
from difflpv.bench.equal_error import EqualTracer
from difflpv.bench.measure import Point, prepare
from difflpv.bench.scenes import BenchScene
from difflpv.bench.settings import BenchSettings
from difflpv.bench.timing import interleaved, timed
from difflpv.bench.volume import VolumeRun

__all__ = ["EQUAL_ERROR", "crossing", "learned_that_meet", "measure_break_even"]

EQUAL_ERROR = 0.2
COUNTS = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000, 10_000_000)
_CHUNK = 1 << 18


def crossing(counts: Sequence[int], ours: Sequence[float], theirs: Sequence[float]) -> float | None:
    """Number of receivers from which on ours is the faster one, by log-log interpolation; None where it never is."""
    gap = np.log(theirs) - np.log(ours)
    if gap[-1] <= 0:
        return None
    below = np.flatnonzero(gap <= 0)
    if not len(below):
        return float(counts[0])
    k = below[-1]
    share = -gap[k] / (gap[k + 1] - gap[k])
    return float(np.exp(np.log(counts[k]) + share * (np.log(counts[k + 1]) - np.log(counts[k]))))


def learned_that_meet(points: Sequence[Point]) -> list[Point]:
    """Learned configurations with an error of at most ``EQUAL_ERROR``; fits are the pay-off's question."""
    able = [p for p in points if p.family == "learned" and p.solve and "fit" not in p.setup_seconds]
    return [p for p in able if p.error <= EQUAL_ERROR]


def measure_break_even(
    points: Sequence[Point], scene: BenchScene, settings: BenchSettings, *, pool: PathPool | None = None
) -> dict[str, Any] | None:
    """Time over receivers at equal error.

    Args:
        points: of this scene.
        scene: where.
        settings: sizes and repeats.
        pool: path tracers of this scene that wait for work; one in this process by default.

    Returns:
        ``configuration``, ``error``, ``counts``, ``measured`` (the largest count that was), seconds of ``ours`` by
        what has changed, ``peers`` with their paths, seconds, break-even and speed-up; None where nothing meets 0.2.
    """
    by_name = {c.name: c for c in LADDER}
    able = learned_that_meet(points)
    if not able:
        return None
    best = min(able, key=lambda p: (p.seconds or 0) + p.lights_seconds)
    run = prepare(by_name[best.name], scene)
    assert isinstance(run, VolumeRun)
    counts = COUNTS
    measured = [n for n in counts if n <= settings.most_receivers]
    solved, rng = run.solve(), np.random.default_rng(scene.seed)
    chunk = min(_CHUNK, measured[-1])
    rows = rng.integers(0, len(scene.position), chunk)
    seen, sight = timed(lambda: run.light.receivers(scene.position[rows], scene.normal[rows]))
    parts = {n: run.light.receivers(scene.position[rows[:n]], scene.normal[rows[:n]]) for n in measured if n < chunk}
    calls: dict[str, Any] = {"solve": run.solve, "lights": run.relight}
    calls |= {f"lookup {n}": lambda part=part: run.lookup(solved, part) for n, part in parts.items()}
    calls[f"lookup {chunk}"] = lambda: run.lookup(solved, seen)
    tracers: dict[str, EqualTracer] = {}
    for family in ("path tracer", "Mitsuba 3"):
        tracer = EqualTracer.of(points, family, best.error, scene, most=settings.most_receivers, pool=pool)
        if tracer is None:
            continue
        tracers[family] = tracer
        for n in {n for n in measured if n <= tracer.most} | {tracer.most}:
            pick = rng.integers(0, len(scene.position), n)
            x, normal = scene.position[pick], scene.normal[pick]
            calls[f"{family} {n}"] = lambda tracer=tracer, x=x, normal=normal: tracer.run.predict(x, normal)
    times = interleaved(calls, max(3, settings.repeats // 2), patience=settings.patience)
    solve, lights = times["solve"].median, times["lights"].median

    def scaled(n: int, name: str, most: int) -> float:
        known = times.get(f"{name} {n}")
        return known.median if known else times[f"{name} {most}"].median * n / most

    lookups = [scaled(n, "lookup", chunk) for n in counts]
    once = [run.setup["geometry"] + sight * n / chunk for n in counts]
    ours = {
        "power changes": [solve + t for t in lookups],
        "lights move": [solve + lights + t for t in lookups],
        "all anew": [solve + lights + t + rest for t, rest in zip(lookups, once, strict=True)],
    }
    peers: dict[str, dict[str, Any]] = {}
    for family, tracer in tracers.items():
        peer = peers[family] = {"paths": tracer.paths, "traced_paths": tracer.power}
        peer["seconds"] = [tracer.ratio * scaled(n, family, tracer.most) for n in counts]
        peer["break_even"] = {what: crossing(counts, t, peer["seconds"]) for what, t in ours.items()}
        at = counts.index(1_000_000)
        peer["speedup_at_million"] = {what: peer["seconds"][at] / t[at] for what, t in ours.items()}
    return {
        "scene": scene.key, "configuration": best.name, "error": best.error, "counts": list(counts),
        "measured": measured[-1], "ours": ours, "peers": peers,
        "geometry_seconds": run.setup["geometry"], "sight_seconds_per_receiver": sight / chunk,
    }  # fmt: skip
