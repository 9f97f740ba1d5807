"""Judges rungs on a scene: path-traced truth at held-out receivers under held-out lights, a level at a time.

What rungs or levels share is computed once: what rays decide (what stands between cells, what lights and receivers see), and
each volume under a light, which probes in it and a later level read too.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from difflpv.bench.configuration import Configuration
from difflpv.bench.probes import probe_grid
from difflpv.blocking import Blocking
from difflpv.config import LpvConfig, grid_for
from difflpv.error_bounds import ErrorSamples, Estimate
from difflpv.evaluate import predict_constant
from difflpv.grid import Grid
from difflpv.illumination import Component, Illumination, Receivers, illuminate
from difflpv.lit_probes import probe_radiance
from difflpv.pipeline import Lpv
from difflpv.planning.ladder import work_of
from difflpv.planning.truth import LEVELS, HeldOutTruth, Level, LevelTruth
from difflpv.probes.probe_set import COEFFS
from difflpv.scene import Scene
from difflpv.stencil import LinearStencil

__all__ = ["SceneJudge"]

_Volume = tuple[LpvConfig, int | None]  # what is solved, but for its lookup, in so many cells

_MANY = 4000  # receivers whose lookups are timed
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
        moving: int = 0,
    ) -> None:
        """Set up; truth is traced level by level when it is first needed, into ``folder``.

        Args:
            scene: under its own lights.
            component: "direct" or "bounce1".
            light_sets: for ``difflpv.lights.apply_light_set``.
            folder: for the truth.
            levels: how closely rungs are judged, coarsest first.
            confidence: of every bound, one-sided.
            seed: of receivers and paths.
            workers: processes of the path tracer.
            moving: so many receivers find out anew what they see, and read it, after every solve: part of a rung's time.

        Raises:
            ValueError: a level with fewer receivers or lights than the one before.
        """
        self.scene, self.component, self.confidence, self.seed, self.moving = scene, component, confidence, seed, moving
        self.truth = HeldOutTruth(scene, component, light_sets, folder, levels=levels, seed=seed, workers=workers)
        self.slack: Sequence[float] = [level.slack for level in levels]
        self.spent = {"truth": 0.0, "rungs": 0.0}
        self._levels: dict[int, LevelTruth] = {}
        self._blocking: dict[Any, tuple[Blocking, ...]] = {}
        self._lights: dict[tuple[int, Grid | None], Illumination] = {}
        self._receivers: dict[Any, Receivers] = {}
        self._solved: OrderedDict[tuple[_Volume, int], tuple[torch.Tensor, ...]] = OrderedDict()
        self._seconds: dict[_Volume, float] = {}  # of a solve
        self._probes: dict[int, tuple[tuple[float, float, float], ...]] = {}  # positions by number
        self._lighting: dict[str, float] = {}  # s to light a rung's probes
        self._reading: dict[str, float] = {}  # s a receiver of a rung, to find out what it sees and read it
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
        elif rung.config is not None and rung.kind in ("volume", "lit probes"):
            found = np.stack([self._predicted(rung, truth, number) for number in truth.sets])
        else:
            raise ValueError(f"rung '{rung.name}': no way to judge kind '{rung.kind}'")
        samples = ErrorSamples.of(found, truth.irradiance, truth.standard_error, truth.weight)
        estimate = samples.estimate(confidence=self.confidence, seed=self.seed)
        self.spent["rungs"] += time.perf_counter() - begin
        return estimate, self.seconds(rung)

    def config(self, rung: Configuration) -> LpvConfig | None:
        """What solves a rung, with the places of its probes in this scene; None for what solves nothing."""
        if rung.config is None or rung.probes is None:
            return rung.config
        if rung.probes not in self._probes:
            position = probe_grid(self.scene, grid_for(self.scene), rung.probes, seed=self.seed, refinements=0)
            self._probes[rung.probes] = tuple((x, y, z) for x, y, z in position.tolist())
        return replace(rung.config, probes=self._probes[rung.probes])

    def seconds(self, rung: Configuration) -> float:
        """Time of a solve and its lookups [s], the least so far of each; 0 for what was not judged or solves nothing."""
        if rung.config is None:
            return 0.0
        parts = (self._seconds.get(self._volume(rung), 0.0), self._lighting.get(rung.name, 0.0))
        return sum(parts) + self.moving * self._reading.get(rung.name, 0.0)

    def _volume(self, rung: Configuration) -> _Volume:
        assert rung.config is not None
        return replace(rung.config, lookup="affine"), rung.cells  # however it is read

    def solve_of(self, rung: Configuration) -> Callable[[], float]:
        """What solves a judged rung once more under the first light, with its lookups, and returns its seconds.

        That is: inject, propagate, light probes; 0 for what solves nothing. Its set-up is done here.
        """
        config = self.config(rung)
        if config is None:
            return lambda: 0.0
        begin, light = time.perf_counter(), self._illuminate(config, self.grid(rung), self._truth_of(0).sets[0])
        self.spent["rungs"] += time.perf_counter() - begin

        @torch.no_grad()
        def solve() -> float:
            begin = time.perf_counter()
            solved, seconds = self._timed(rung, light)
            seconds += self._time_reading(rung, light, solved)
            self.spent["rungs"] += time.perf_counter() - begin
            return seconds

        return solve

    @torch.no_grad()
    def _predicted(self, rung: Configuration, truth: LevelTruth, number: int) -> np.ndarray:
        config, grid = self.config(rung), self.grid(rung)
        assert config is not None
        light = self._illuminate(config, grid, number)
        volume = self._volume(rung)
        key = (volume, number)
        if key not in self._solved:
            first = volume not in self._seconds
            self._solved[key], _ = self._timed(rung, light)
            kind = (config.method, config.occlusion, config.coarsen_after is None)
            if (first and self._seconds[volume] < _SHORT) or kind not in self._warm:  # the first of a kind loads its kernels
                self._warm.add(kind)
                self._timed(rung, light)
            while len(self._solved) > 1 and sum(map(_size, self._solved.values())) > _KEPT:
                self._solved.popitem(last=False)
        lpv, solved = Lpv(grid, config), self._solved[key]
        if number == truth.sets[0]:
            self._time_reading(rung, light, solved)
        parts = [lpv.gather(solved, light, self._seen(config, grid, light, part, number)) for part in truth.parts]
        return torch.cat(parts).double().numpy()

    def _timed(self, rung: Configuration, light: Illumination) -> tuple[tuple[torch.Tensor, ...], float]:
        lpv, volume, begin = Lpv(light.grid, light.config), self._volume(rung), _clock()
        solved = lpv.accumulate(light)
        seconds = _clock() - begin
        self._seconds[volume] = min(seconds, self._seconds.get(volume, np.inf))  # what disturbs can only add
        return solved, seconds

    def _time_reading(self, rung: Configuration, light: Illumination, solved: Sequence[torch.Tensor]) -> float:
        """Time [s] of what lights a rung's probes and, where receivers move, of their lookups."""
        seconds = 0.0
        if rung.probes is not None:
            grids, reads, gains = light.config.grids(light.grid), light.probes.reads, torch.ones(COEFFS)
            seconds += self._one(self._lighting, rung.name, lambda: probe_radiance(solved, grids, reads, gains))
        if self.moving:
            table, lpv = self.truth.receivers(0), Lpv(light.grid, light.config)
            position, normal = (np.resize(a, (_MANY, 3)).astype(float) for a in (table.position, table.normal))
            seconds += self.moving * self._one(
                self._reading, rung.name, lambda: lpv.gather(solved, light, light.receivers(position, normal)), count=_MANY
            )
        return seconds

    def _one(self, known: dict[str, float], name: str, work: Callable[[], object], *, count: int = 1) -> float:
        """Time of ``work`` over ``count``; keeps the least. The first is not counted, for it loads kernels and tables."""
        if name not in known:
            work()
        begin = _clock()
        work()
        seconds = (_clock() - begin) / count
        known[name] = min(seconds, known.get(name, np.inf))
        return seconds

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
        key = (part, lights, grid, config.lookup, len(config.grids(grid)), config.probes)
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


def _clock() -> float:
    """Seconds: other processes take from the wall's time, not from ours; of several threads only the wall tells the overlap."""
    return time.process_time() if torch.get_num_threads() == 1 else time.perf_counter()


def _size(volumes: Sequence[torch.Tensor]) -> int:
    return sum(v.numel() * v.element_size() for v in volumes)
