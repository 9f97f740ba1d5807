"""Judges rungs on a scene: path-traced truth at held-out receivers under held-out lights, a level at a time.

What rungs or levels share is computed once: what rays decide (what stands between cells, what lights and receivers see), and
each rung's solve under a light, which a later level reads at more receivers.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from difflpv.bench.configuration import Configuration
from difflpv.blocking import Blocking
from difflpv.config import LpvConfig, grid_for
from difflpv.evaluate import predict_constant
from difflpv.grid import Grid
from difflpv.illumination import Component, Illumination, Receivers, illuminate
from difflpv.pipeline import Lpv
from difflpv.planning.estimate import ErrorSamples, Estimate
from difflpv.planning.ladder import work_of
from difflpv.planning.truth import LEVELS, HeldOutTruth, Level, LevelTruth
from difflpv.scene import Scene
from difflpv.stencil import LinearStencil

__all__ = ["SceneJudge"]

_REPEATS = 5  # of a solve whose time is asked for
_SHORT = 0.02  # s: what is shorter is timed twice
_KEPT = 256 * 2**20  # bytes of solved volumes


class SceneJudge:
    """``difflpv.planning.race.Judge`` of one component of a scene's light.

    Attributes:
        slack: of each level.
        spent: seconds so far, by "truth" and "rungs".
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
        """Set up; truth is traced level by level when it is first needed, into ``folder``.

        Raises:
            ValueError: a level with fewer receivers or lights than the one before.
        """
        self.scene, self.component, self.confidence, self.seed = scene, component, confidence, seed
        self.truth = HeldOutTruth(scene, component, light_sets, folder, levels=levels, seed=seed, workers=workers)
        self.slack: Sequence[float] = [level.slack for level in levels]
        self.spent = {"truth": 0.0, "rungs": 0.0}
        self._levels: dict[int, LevelTruth] = {}
        self._blocking: dict[Any, tuple[Blocking, ...]] = {}
        self._lights: dict[tuple[int, Grid | None], Illumination] = {}
        self._receivers: dict[Any, Receivers] = {}
        self._solved: OrderedDict[tuple[str, int], tuple[torch.Tensor, ...]] = OrderedDict()
        self._seconds: dict[str, float] = {}
        self._warm: set[tuple[Any, ...]] = set()

    def grid(self, rung: Configuration) -> Grid:
        """The cells of a rung."""
        return grid_for(self.scene, rung.cells)

    def work(self, rung: Configuration) -> float:
        """Products of one solve."""
        return work_of(rung, self.grid(rung))

    def judge(self, rung: Configuration, level: int) -> tuple[Estimate, float]:
        """Error over the level's receivers and lights, and the time of a solve [s], the least so far.

        Raises:
            ValueError: a kind of rung that this judge cannot measure, or a scene whose component is dark.
        """
        truth = self._truth_of(level)
        begin = time.perf_counter()
        if rung.kind == "constant":
            pairs = zip(truth.irradiance, truth.weight, strict=True)
            found = np.stack([predict_constant(t, w) for t, w in pairs])
        elif rung.config is not None and rung.kind == "volume":
            found = np.stack([self._predicted(rung, rung.config, truth, number) for number in truth.sets])
        else:
            raise ValueError(f"rung '{rung.name}': no way to judge kind '{rung.kind}'")
        samples = ErrorSamples.of(found, truth.irradiance, truth.standard_error, truth.weight)
        estimate = samples.estimate(confidence=self.confidence, seed=self.seed)
        self.spent["rungs"] += time.perf_counter() - begin
        return estimate, self._seconds.get(rung.name, 0.0)

    @torch.no_grad()
    def retime(self, rung: Configuration) -> float:
        """Seconds of one solve (inject, propagate), the least of all and of several more; 0 for what solves nothing."""
        begin = time.perf_counter()
        if rung.config is not None:
            number = min(self._levels[min(self._levels)].sets) if self._levels else 0
            light = self._illuminate(rung.config, self.grid(rung), number)
            for _ in range(_REPEATS):
                self._timed(rung, rung.config, light)
        self.spent["rungs"] += time.perf_counter() - begin
        return self._seconds.get(rung.name, 0.0)

    @torch.no_grad()
    def _predicted(self, rung: Configuration, config: LpvConfig, truth: LevelTruth, number: int) -> np.ndarray:
        grid = self.grid(rung)
        light = self._illuminate(config, grid, number)
        key = (rung.name, number)
        if key not in self._solved:
            self._solved[key] = self._timed(rung, config, light)
            kind = (config.method, config.occlusion, config.coarsen_after is None)
            if self._seconds[rung.name] < _SHORT or kind not in self._warm:  # the first of a kind loads its kernels
                self._warm.add(kind)
                self._timed(rung, config, light)
            while len(self._solved) > 1 and sum(map(_size, self._solved.values())) > _KEPT:
                self._solved.popitem(last=False)
        lpv, solved = Lpv(grid, config), self._solved[key]
        parts = [lpv.gather(solved, light, self._seen(config, grid, light, part, number)) for part in truth.parts]
        return torch.cat(parts).double().numpy()

    def _timed(self, rung: Configuration, config: LpvConfig, light: Illumination) -> tuple[torch.Tensor, ...]:
        # other processes take from the wall's time, not from ours; of several threads only the wall tells how they overlap
        clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
        lpv, begin = Lpv(light.grid, config), clock()
        solved = lpv.accumulate(light)
        self._seconds[rung.name] = min(clock() - begin, self._seconds.get(rung.name, np.inf))  # what disturbs can only add
        return solved

    def _illuminate(self, config: LpvConfig, grid: Grid, number: int) -> Illumination:
        """The scene under a light set; VPLs and the cells that they give to are ready: no part of a solve."""
        stencil = config.stencil
        offsets = stencil.pair_count if isinstance(stencil, LinearStencil) else stencil.name
        key = (grid, config.occlusion, offsets, len(config.grids(grid)), self._geometry(number))
        known = self._lights.get((number, grid)) or self._lights.get((number, None))
        if known is None:
            lit = self.truth.lit(number)
            light = illuminate(lit, grid, config, self.component, blocking=self._blocking.get(key), seed=self.seed)
            self._lights[number, None] = light
        else:
            light = known.on(grid, config, blocking=self._blocking.get(key), seed=self.seed)
        self._blocking[key] = light.blocking
        vpls = light.vpls()
        if config.deposit == "visible":
            light.vpl_cells(vpls)
            self._lights[number, grid] = light
        return light

    def _geometry(self, number: int) -> int:
        """-1 where a light set leaves all surfaces in place, else its number."""
        moved = not np.array_equal(self.truth.lit(number).triangle_vertices, self.scene.triangle_vertices)
        return number if moved else -1

    def _seen(self, config: LpvConfig, grid: Grid, light: Illumination, part: int, number: int) -> Receivers:
        lights = number if self.component == "direct" else self._geometry(number)  # direct: shadow rays to each light
        key = (part, lights, grid, config.lookup, len(config.grids(grid)))
        if key not in self._receivers:
            table = self.truth.receivers(part)
            self._receivers[key] = light.receivers(table.position.astype(float), table.normal.astype(float))
        return self._receivers[key]

    def _truth_of(self, level: int) -> LevelTruth:
        if level not in self._levels:
            begin = time.perf_counter()
            self._levels[level] = self.truth.level(level)
            self.spent["truth"] += time.perf_counter() - begin
        return self._levels[level]


def _size(volumes: Sequence[torch.Tensor]) -> int:
    return sum(v.numel() * v.element_size() for v in volumes)
