"""Plan a scene: judge the ladder, choose, and keep what was learned on the way."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from difflpv.bench.configuration import Configuration
from difflpv.config import LpvConfig
from difflpv.illumination import Component
from difflpv.io.atomic import write_json
from difflpv.planning.judging import SceneJudge
from difflpv.planning.ladder import PLAN_LADDER
from difflpv.planning.lights import held_out_lights
from difflpv.planning.race import Judge, Runner, cheapest, most_accurate
from difflpv.planning.truth import LEVELS, Level
from difflpv.scene import Scene

__all__ = ["Plan", "make_plan", "plan_with"]

_FORMAT = 1


@dataclass(eq=False)
class Plan:
    """What to solve a scene with, and why.

    Attributes:
        chosen: the rung that meets the goal, or None.
        runners: the whole ladder, with what is known of each rung.
        tolerance: of the relative error, or None.
        budget: seconds of a solve, or None.
        confidence: of every bound, one-sided.
        last_level: the level on which a choice was made.
        interrupted: True where the race was broken off.
        seconds: spent on planning, by "truth" and "rungs".
        about: scene, component, lights and levels, for the file.
        moving: receivers whose lookups are part of a rung's time.
        probes: where the probes of the best rung stand (x, y, z) [m], if it has any.
    """

    chosen: Runner | None
    runners: list[Runner]
    tolerance: float | None
    budget: float | None
    confidence: float
    last_level: int
    interrupted: bool = False
    seconds: dict[str, float] = field(default_factory=dict)
    about: dict[str, Any] = field(default_factory=dict)
    moving: int = 0
    probes: tuple[tuple[float, float, float], ...] = ()

    @property
    def best(self) -> Runner | None:
        """What is chosen; after an interruption the cheapest that surely meets the tolerance.

        Or else the most accurate rung judged (within the budget), by the level that all were judged on.
        """
        if self.chosen is not None:
            return self.chosen
        met = [r for r in self.runners if r.state == "met"]
        if met:
            return min(met, key=lambda r: (r.seconds, r.work))
        judged = [r for r in self.runners if r.estimates and r.state != "dear"]
        return min(judged, key=lambda r: r.estimates[0].error, default=None)

    @property
    def config(self) -> LpvConfig | None:
        """Of the best rung; None for the constant, or where nothing was judged."""
        best = None if self.best is None else self.best.rung.config
        return best if best is None or not self.probes else replace(best, probes=self.probes)

    def foreseen(self, runner: Runner) -> float:
        """Error to be expected of a judged rung on the level that the best one reached: as that changed from level to level."""
        best, level = self.best, runner.level
        if best is None or best.level <= level:
            return _error(runner)
        return _error(runner) * _error(best) / max(best.estimates[level].error, 1e-12)

    @property
    def front(self) -> list[Runner]:
        """Judged rungs that are more accurate than all cheaper ones, cheapest first, and the best one after them.

        That one may show a larger error than a cheaper one that was judged less closely.
        """
        found: list[Runner] = []
        judged = [r for r in self.runners if r.estimate is not None and r.seconds is not None]
        for runner in sorted(judged, key=lambda r: (r.seconds, r.work)):
            if runner is self.best:
                return [*found, runner]
            if not found or _error(runner) < _error(found[-1]):
                found.append(runner)
        return found

    def to_json(self) -> dict[str, Any]:
        """Plain values; ``difflpv.config_file`` reads them."""
        best, config = self.best, self.config
        return {
            "format": _FORMAT,
            "method": None if best is None else config.method if config else "constant",
            "cells": None if best is None else best.rung.cells,
            "config": None if config is None else config.to_json(),
            "met": self.chosen is not None,
            "interrupted": self.interrupted,
            "tolerance": self.tolerance,
            "budget_seconds": self.budget,
            "moving_receivers": self.moving,
            "confidence": self.confidence,
            "planning_seconds": self.seconds,
            **self.about,
            "rungs": [_runner_json(r) for r in self.runners],
        }

    def save(self, path: str | Path) -> None:
        """Write the file for ``--config``."""
        write_json(path, self.to_json())


def _error(runner: Runner) -> float:
    assert runner.estimate is not None
    return runner.estimate.error


def _runner_json(runner: Runner) -> dict[str, Any]:
    known = {} if runner.estimate is None else runner.estimate.to_json()
    return {"name": runner.rung.name, "state": runner.state, "level": runner.level, "seconds": runner.seconds, **known}


def plan_with(
    judge: Judge,
    rungs: Sequence[Configuration],
    *,
    tolerance: float | None = None,
    budget: float | None = None,
    confidence: float = 0.95,
    tell: Callable[[Runner], object] = lambda runner: None,
) -> Plan:
    """Plan with any judge; an interruption (Ctrl-C) keeps what is known. Arguments as for ``make_plan``."""
    if (tolerance is None) == (budget is None):
        raise ValueError("plan: expected a tolerance or a budget, one of the two")
    runners: list[Runner] = []
    chosen, interrupted = None, False
    try:
        if tolerance is not None:
            chosen = cheapest(rungs, judge, tolerance, runners=runners, tell=tell)
        elif budget is not None:
            chosen = most_accurate(rungs, judge, budget, runners=runners, tell=tell)
    except KeyboardInterrupt:
        interrupted = True
    return Plan(chosen, runners, tolerance, budget, confidence, len(judge.slack) - 1, interrupted, moving=judge.moving)


def make_plan(
    scene: Scene,
    folder: str | Path,
    *,
    tolerance: float | None = None,
    budget: float | None = None,
    component: Component = "bounce1",
    rungs: Sequence[Configuration] = PLAN_LADDER,
    levels: Sequence[Level] = LEVELS,
    confidence: float = 0.95,
    seed: int = 0,
    workers: int = 1,
    moving: int = 0,
    tell: Callable[[Runner], object] = lambda runner: None,
) -> Plan:
    """The cheapest model of a scene within a tolerance, or the most accurate one within a budget.

    Args:
        scene: under its own lights.
        folder: for the path-traced truth.
        tolerance: of the relative L2 error over receivers and lights, surely met with ``confidence``.
        budget: seconds that one solve may take on this machine.
        component: "direct" or "bounce1".
        rungs: the ladder.
        levels: how closely rungs are judged, coarsest first.
        confidence: of every bound, one-sided.
        seed: of receivers, paths and moved lights.
        workers: processes of the path tracer.
        moving: receivers that move, as on objects: what it takes to find out anew what they see, and to read it, is part of
            every rung's time. 0: receivers stay, and only the solve counts.
        tell: told every runner that was judged.

    Raises:
        ValueError: neither or both of tolerance and budget, one that is not positive, a negative number of receivers, or a
            component that is dark.
    """
    if moving < 0:
        raise ValueError(f"moving: expected a number of receivers >= 0, got {moving}")
    begin = time.perf_counter()
    lights = held_out_lights(scene, max(level.lights for level in levels), seed=seed)
    judge = SceneJudge(
        scene, component, lights, folder, levels=levels, confidence=confidence, seed=seed, workers=workers,
        moving=moving,
    )  # fmt: skip
    plan = plan_with(judge, rungs, tolerance=tolerance, budget=budget, confidence=confidence, tell=tell)
    config = None if plan.best is None else judge.config(plan.best.rung)
    plan.probes = config.probes if config is not None else ()
    plan.seconds = {**judge.spent, "all": time.perf_counter() - begin}
    plan.about = {
        "scene": scene.name, "scene_hash": scene.hash, "component": component, "light_sets": len(lights), "seed": seed,
        "levels": [{"receivers": level.receivers, "paths": level.spp, "lights": level.lights} for level in levels],
    }  # fmt: skip
    return plan
