"""Runs the bench, or what is left of it: every configuration on every scene, how cost grows, and from where on it pays."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch

from data_gen.few_paths import PathPool
from difflpv.bench.breakeven import measure_break_even
from difflpv.bench.configuration import Configuration, chosen
from difflpv.bench.gradients import measure_gradients
from difflpv.bench.growth import machine_rates, measure_growth, measure_step
from difflpv.bench.images import bench_view, flip_unavailable
from difflpv.bench.measure import Point, measure
from difflpv.bench.mitsuba_peer import unavailable
from difflpv.bench.payoff import measure_pay_off
from difflpv.bench.scanlines import SCANLINES, measure_scanlines
from difflpv.bench.scenes import BUNDLED, BenchScene, bench_scenes
from difflpv.bench.settings import BenchSettings
from difflpv.bench.store import Store, pay_off_csv, points_csv
from difflpv.demo.summary import PRESENTATION, code_digest, describe_machine
from difflpv.io.atomic import write_json, write_text

__all__ = ["BenchResult", "run_bench"]

# Sources that change no number.
_PRESENTATION = (
    *PRESENTATION, "difflpv/stress/", "difflpv/bench/page.py", "difflpv/bench/run.py", "difflpv/bench/store.py",
    "difflpv/bench/pareto.py", "difflpv/bench/baseline.py", "difflpv/bench/published.py",
)  # fmt: skip


@dataclass
class BenchResult:
    """What a run found.

    Attributes:
        points: all scenes, in order.
        scenes: by key: noise of the truth, seconds of the truth, cells.
        break_even: one per scene that meets the tolerance.
        gradients: rows of ``measure_gradients``.
        pay_off: rows of ``measure_pay_off``.
        scanlines: rows of ``measure_scanlines``.
        growth: rows of ``measure_growth``.
        step: ``measure_step``; empty where it was not asked for.
        rates: ``machine_rates``.
        skipped: what was left out, a line each.
        machine: processor, versions, date.
        settings: sizes.
        published: names of configurations as in a publication.
    """

    points: list[Point] = field(default_factory=list)
    scenes: dict[str, dict[str, Any]] = field(default_factory=dict)
    break_even: list[dict[str, Any]] = field(default_factory=list)
    gradients: list[dict[str, Any]] = field(default_factory=list)
    pay_off: list[dict[str, Any]] = field(default_factory=list)
    scanlines: list[dict[str, Any]] = field(default_factory=list)
    growth: list[dict[str, Any]] = field(default_factory=list)
    step: dict[str, Any] = field(default_factory=dict)
    rates: dict[str, float] = field(default_factory=dict)
    skipped: list[str] = field(default_factory=list)
    machine: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    published: list[str] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {**asdict(self), "points": [p.to_json() for p in self.points]}


def run_bench(
    out: str | Path = "out/bench",
    *,
    scenes: Sequence[str] | None = None,
    names: Sequence[str] | None = None,
    settings: BenchSettings | None = None,
    threads: int | None = None,
    growth: bool = True,
    break_even: bool = True,
    scanlines: bool = True,
    progress: Callable[[str], object] = print,
) -> BenchResult:
    """Measure, or find what was measured, and write ``points.jsonl``, ``points.csv``, ``pay_off.csv`` and ``bench.json``.

    Args:
        out: folder for results and truth.
        scenes: bundled names or files; all bundled ones by default.
        names: configurations (``difflpv.bench.configuration.LADDER``); all by default, or those of a quick run.
        settings: sizes.
        threads: of torch, of Mitsuba, and processes of the path tracer; all processors of this process by default.
        growth: measure how cost grows, and peers of a step.
        break_even: measure time over receivers, gradients, and after how many solves fits pay off.
        scanlines: measure irradiance along lines where a scene has some.
        progress: told lines of text.

    Raises:
        ValueError: an unknown configuration.
        SceneError: a scene that cannot be used.
        KeyboardInterrupt: passed on; what is finished is kept.
    """
    sizes = settings or BenchSettings()
    count = threads or (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
    rows = chosen(names, quick=sizes.quick)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    identity = {"code": code_digest(without=_PRESENTATION), "settings": asdict(sizes), "threads": count}
    store = Store(folder / "points.jsonl", identity)
    result = BenchResult(machine={**describe_machine(), "threads": count}, settings=asdict(sizes))
    result.published = [c.name for c in rows if c.published]
    rows = _without_missing(rows, result)
    kept = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        for name in scenes or BUNDLED:
            for scene in _truth(name, folder, sizes, count, progress):
                pool = PathPool(scene.scene, count)  # its processes start with their first work
                try:
                    _one_scene(scene, rows, sizes, store, result, pool, progress)
                    if scanlines and scene.key in SCANLINES:
                        make = partial(measure_scanlines, scene, spp=sizes.spp, cell_spp=sizes.cell_spp, pool=pool)
                        result.scanlines += _once(store, f"scanlines {scene.key}", make, progress)
                    if break_even and not (sizes.quick and scene.component == "direct"):
                        own = [p for p in result.points if p.scene == scene.key]
                        from_where = partial(measure_break_even, own, scene, sizes, pool=pool)
                        even = _once(store, f"break-even {scene.key}", from_where, progress)
                        result.break_even += [even] if even else []
                        slopes = partial(measure_gradients, own, scene, sizes, pool=pool)
                        result.gradients += _once(store, f"gradients {scene.key}", slopes, progress) or []
                        paid = partial(_pay_off, own, scene, sizes, pool)
                        result.pay_off += _once(store, f"pay-off {scene.key}", paid, progress) or []
                finally:
                    pool.close()
                if growth and not result.growth:
                    result.growth = _once(store, "growth", partial(measure_growth, scene, sizes), progress)
                    result.step = _once(store, "step", lambda: measure_step(sizes, compiled=not sizes.quick), progress)
                    result.rates = _once(store, "machine", lambda: machine_rates(sizes), progress)
    finally:
        torch.set_num_threads(kept)
    result.skipped += [why for why in result.step.get("skipped", {}).values()]
    write_text(folder / "points.csv", points_csv(result.points))
    write_text(folder / "pay_off.csv", pay_off_csv(result.pay_off))
    write_json(folder / "bench.json", result.to_json())
    return result


def _without_missing(rows: Sequence[Configuration], result: BenchResult) -> tuple[Configuration, ...]:
    """The rows that can be measured here; what is left out is said in one line."""
    if any(c.kind == "mitsuba" for c in rows) and (why := unavailable()):
        result.skipped.append(f"left out: {why}")
        rows = [c for c in rows if c.kind != "mitsuba"]
    if why := flip_unavailable():
        result.skipped.append(f"left out: {why}")
    return tuple(rows)


def _truth(
    name: str, folder: Path, sizes: BenchSettings, workers: int, progress: Callable[[str], object]
) -> tuple[BenchScene, ...]:
    progress(f"{name}: path tracing {sizes.receivers} receivers, {sizes.spp} paths each, unless they are there")
    own = folder / "truth" / Path(name).stem
    found = bench_scenes(name, own, receivers=sizes.receivers, spp=sizes.spp, seed=sizes.seed, workers=workers)
    if not found:
        progress(f"{name}: no light for a volume to carry, left out")
    return found


def _tuning(scene: BenchScene, sizes: BenchSettings, workers: int) -> BenchScene | None:
    found = bench_scenes(
        scene.scene, scene.folder / "tuning", components=(scene.component,), receivers=sizes.tuning_receivers,
        spp=max(512, sizes.spp // 4), seed=sizes.seed + 1, workers=workers,
    )  # fmt: skip
    return found[0] if found else None


def _pay_off(own: Sequence[Point], scene: BenchScene, sizes: BenchSettings, pool: PathPool) -> list[dict[str, Any]]:
    if not any("fit" in p.setup_seconds for p in own):
        return []
    tuning = _tuning(scene, sizes, pool.workers)
    return measure_pay_off(own, scene, tuning, sizes, pool=pool) if tuning else []


def _one_scene(
    scene: BenchScene, rows: Sequence[Configuration], sizes: BenchSettings, store: Store, result: BenchResult,
    pool: PathPool, progress: Callable[[str], object],
) -> None:  # fmt: skip
    keys = {c.name: f"{scene.key} {c.to_json()}" for c in rows}
    missing = [c for c in rows if store.get(keys[c.name]) is None]
    if missing:
        progress(f"{scene.key}: measuring {len(missing)} of {len(rows)} configurations")
        tuning = _tuning(scene, sizes, pool.workers) if any(c.learn for c in missing) else None
        view = bench_view(scene, width=sizes.image_width, spp=sizes.image_spp, workers=pool.workers)
        points = measure(
            missing, scene, repeats=sizes.repeats, patience=sizes.patience, tuning=tuning, view=view, pool=pool,
            cell_spp=sizes.cell_spp,
        )
        store.put({keys[p.name]: p.to_json() for p in points})
    result.points += [Point.from_json(store.get(keys[c.name])) for c in rows]
    result.scenes[scene.key] = {
        "noise": scene.noise,
        "target_seconds": scene.target_seconds,
        "receivers": len(scene.position),
        "cells": list(scene.grid().resolution),
        "cell_size": scene.grid().cell_size,
    }


def _once(store: Store, key: str, make: Callable[[], Any], progress: Callable[[str], object]) -> Any:
    found = store.get(key)
    if found is None:
        progress(f"measuring {key}")
        store.put({key: make() or {}})
        found = store.get(key)
    return found
