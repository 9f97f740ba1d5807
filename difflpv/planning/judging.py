"""Judges rungs on a scene: path-traced truth at held-out receivers under held-out lights, a level at a time.

Each level draws receivers of its own, so that the last one judges a choice by points that had no part in making it. What
rays decide (what stands between cells, what receivers see) is kept for rungs that share it.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from difflpv.bench.configuration import Configuration
from difflpv.bench.scenes import targets_in_grid
from difflpv.blocking import Blocking
from difflpv.config import grid_for
from difflpv.evaluate import predict_constant
from difflpv.grid import Grid
from difflpv.illumination import Component, Illumination, Receivers, illuminate
from difflpv.lights import apply_light_set
from difflpv.pipeline import Lpv
from difflpv.planning.estimate import ErrorSamples, Estimate
from difflpv.planning.ladder import work_of
from difflpv.scene import Scene
from difflpv.stencil import LinearStencil

__all__ = ["LEVELS", "Level", "SceneJudge"]


@dataclass(frozen=True)
class Level:
    """How closely rungs are judged.

    Attributes:
        receivers: how many.
        spp: paths per receiver of the truth.
        lights: light sets, the first of all.
        repeats: of the timed solve, besides one for every light.
        slack: see ``difflpv.planning.race.Judge``.
    """

    receivers: int
    spp: int
    lights: int
    repeats: int
    slack: float = 1.0


LEVELS = (Level(400, 64, 2, 0, 1.2), Level(1200, 64, 4, 2), Level(4000, 128, 4, 5))


@dataclass(frozen=True, eq=False)
class _Truth:
    position: np.ndarray
    normal: np.ndarray
    lit: list[Scene]
    irradiance: np.ndarray
    standard_error: np.ndarray
    weight: np.ndarray


class SceneJudge:
    """``difflpv.planning.race.Judge`` of one component of a scene's light.

    Attributes:
        slack: of each level.
        spent: seconds so far, by "truth" and "rungs".
        samples: of the last rung judged.
    """

    def __init__(
        self,
        scene: Scene,
        component: Component,
        light_sets: Sequence[Sequence[Mapping[str, Any]]],
        folder: str | Path,
        *,
        levels: Sequence[Level] = LEVELS,
        confidence: float = 0.95,
        seed: int = 0,
        workers: int = 1,
    ) -> None:
        """Set up; truth is traced level by level when it is first needed, into ``folder``."""
        self.scene, self.component, self.light_sets = scene, component, list(light_sets)
        self.folder, self.levels, self.confidence = Path(folder), tuple(levels), confidence
        self.seed, self.workers = seed, workers
        self.slack: Sequence[float] = [level.slack for level in levels]
        self.spent = {"truth": 0.0, "rungs": 0.0}
        self._truth: dict[int, _Truth] = {}
        self._blocking: dict[Any, tuple[Blocking, ...]] = {}
        self._lit: dict[str, Illumination] = {}
        self._receivers: dict[Any, Receivers] = {}

    def grid(self, rung: Configuration) -> Grid:
        """The cells of a rung."""
        return grid_for(self.scene, rung.cells)

    def work(self, rung: Configuration) -> float:
        """Products of one solve."""
        return work_of(rung, self.grid(rung))

    def judge(self, rung: Configuration, level: int) -> tuple[Estimate, float]:
        """Error over the level's receivers and lights, and the time of a solve [s], the least of several.

        Raises:
            ValueError: a kind of rung that this judge cannot measure, or a scene whose component is dark.
        """
        truth = self._truth_of(level)
        begin = time.perf_counter()
        if rung.kind == "constant":
            pairs = zip(truth.irradiance, truth.weight, strict=True)
            found, seconds = np.stack([predict_constant(t, w) for t, w in pairs]), 0.0
        elif rung.kind == "volume":
            found, seconds = self._solve(rung, level, truth)
        else:
            raise ValueError(f"rung '{rung.name}': no way to judge kind '{rung.kind}'")
        samples = ErrorSamples.of(found, truth.irradiance, truth.standard_error, truth.weight)
        estimate = samples.estimate(confidence=self.confidence, seed=self.seed)
        self.spent["rungs"] += time.perf_counter() - begin
        return estimate, seconds

    @torch.no_grad()
    def _solve(self, rung: Configuration, level: int, truth: _Truth) -> tuple[np.ndarray, float]:
        assert rung.config is not None
        grid, found, seconds = self.grid(rung), [], []
        lpv = Lpv(grid, rung.config)
        # other processes take from the wall's time, not from ours; of several threads only the wall tells how they overlap
        clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
        for number, lit in enumerate(truth.lit):
            light = self._illuminate(rung, grid, lit)
            receivers = self._seen(rung, grid, light, truth, level, number)
            if rung.config.deposit == "visible":
                light.vpl_cells(light.vpls())  # rays of a light that has moved, no part of a solve; kept by it
            for _ in range(1 + (self.levels[level].repeats if number == len(truth.lit) - 1 else 0)):
                begin = clock()
                solved = lpv.accumulate(light)
                seconds.append(clock() - begin)
            found.append(lpv.gather(solved, light, receivers).double().numpy())
        return np.stack(found), min(seconds)  # what disturbs can only add

    def _illuminate(self, rung: Configuration, grid: Grid, lit: Scene) -> Illumination:
        config = rung.config
        assert config is not None
        moved = not np.array_equal(lit.triangle_vertices, self.scene.triangle_vertices)
        stencil = config.stencil
        offsets = stencil.pair_count if isinstance(stencil, LinearStencil) else stencil.name
        key = (grid, config.occlusion, offsets, len(config.grids(grid)), lit.hash if moved else "")
        if key in self._blocking and lit.hash in self._lit:  # what the lights see does not depend on the cells
            return replace(self._lit[lit.hash], grid=grid, config=config, blocking=self._blocking[key])
        light = illuminate(lit, grid, config, self.component, blocking=self._blocking.get(key), seed=self.seed)
        self._blocking[key], self._lit[lit.hash] = light.blocking, light
        return light

    def _seen(
        self, rung: Configuration, grid: Grid, light: Illumination, truth: _Truth, level: int, number: int
    ) -> Receivers:
        assert rung.config is not None
        key = (level, number, grid, rung.config.lookup, len(rung.config.grids(grid)))
        if key not in self._receivers:
            self._receivers[key] = light.receivers(truth.position, truth.normal)
        return self._receivers[key]

    def _truth_of(self, level: int) -> _Truth:
        if level not in self._truth:
            begin = time.perf_counter()
            self._truth[level] = self._trace(level)
            self.spent["truth"] += time.perf_counter() - begin
        return self._truth[level]

    def _trace(self, level: int) -> _Truth:
        wanted, sets = self.levels[level], self.light_sets[: self.levels[level].lights]
        seed = self.seed + 1009 * (level + 1)
        targets = targets_in_grid(
            self.scene, self.folder / f"truth_{level}", components=(self.component,), receivers=wanted.receivers,
            spp=wanted.spp, light_sets=sets, seed=seed, workers=self.workers,
        )  # fmt: skip
        irradiance = np.stack([t.irradiance[self.component].astype(float) for t in targets.lights])
        kept = [i for i in range(len(sets)) if irradiance[i].any()]
        if not kept:
            raise ValueError(f"component: scene '{self.scene.name}' has no light in '{self.component}' to plan for")
        return _Truth(
            targets.receivers.position.astype(float),
            targets.receivers.normal.astype(float),
            [apply_light_set(self.scene, sets[i]) for i in kept],
            irradiance[kept],
            np.stack([targets.lights[i].standard_error[self.component].astype(float) for i in kept]),
            np.stack([targets.lights[i].area_weight.astype(float) for i in kept]),
        )
