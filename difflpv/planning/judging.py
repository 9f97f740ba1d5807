"""Judges rungs on a scene: path-traced truth at held-out receivers under held-out lights, a level at a time.

What rungs or levels share is computed once: what rays decide (what stands between cells, what lights and receivers see), and
each volume under a light, which probes in it and a later level read too.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from difflpv.bench.configuration import Configuration
from difflpv.bench.probes import probe_grid
from difflpv.blocking import Blocking
from difflpv.config import LpvConfig, grid_for
from difflpv.evaluate import predict_constant
from difflpv.grid import Grid
from difflpv.illumination import Component, Illumination, Receivers, illuminate
from difflpv.lit_probes import probe_radiance
from difflpv.pipeline import Lpv
from difflpv.planning.estimate import ErrorSamples, Estimate
from difflpv.planning.ladder import work_of
from difflpv.planning.truth import LEVELS, HeldOutTruth, Level, LevelTruth
from difflpv.probes.probe_set import COEFFS
from difflpv.scene import Scene
from difflpv.stencil import LinearStencil

__all__ = ["SceneJudge"]

_Volume = tuple[LpvConfig, int | None]  # what is solved, but for its lookup, in so many cells

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
        self._probes: dict[str, LpvConfig] = {}
        self._lighting: dict[str, float] = {}  # s to light a rung's probes
        self._finding: dict[Any, float] = {}  # s a receiver, to find out what it sees
        self._reading: dict[str, float] = {}  # s a receiver, both
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
        if rung.name not in self._probes:
            position = probe_grid(self.scene, self.grid(rung), rung.probes, seed=self.seed, refinements=0)
            self._probes[rung.name] = replace(rung.config, probes=tuple(map(tuple, position.tolist())))
        return self._probes[rung.name]

    def seconds(self, rung: Configuration) -> float:
        """Time of a solve and its lookups [s], the least so far of each; 0 for what was not judged or solves nothing."""
        if rung.config is None:
            return 0.0
        parts = (self._seconds.get(self._volume(rung), 0.0), self._lighting.get(rung.name, 0.0))
        return sum(parts) + self.moving * self._reading.get(rung.name, 0.0)

    def _volume(self, rung: Configuration) -> _Volume:
        assert rung.config is not None
        return replace(rung.config, lookup="affine"), rung.cells  # however it is read

    @torch.no_grad()
    def retime(self, rung: Configuration, repeats: int = 5) -> float:
        """``seconds``, the least of all and of ``repeats`` more solves (inject, propagate, light probes)."""
        begin, config = time.perf_counter(), self.config(rung)
        if config is not None:
            number = min(self._levels[min(self._levels)].sets) if self._levels else 0
            light = self._illuminate(config, self.grid(rung), number)
            for _ in range(repeats):
                self._lit(rung, light, self._timed(rung, light))
        self.spent["rungs"] += time.perf_counter() - begin
        return self.seconds(rung)

    @torch.no_grad()
    def _predicted(self, rung: Configuration, truth: LevelTruth, number: int) -> np.ndarray:
        config, grid = self.config(rung), self.grid(rung)
        assert config is not None
        light = self._illuminate(config, grid, number)
        volume = self._volume(rung)
        key = (volume, number)
        if key not in self._solved:
            self._solved[key] = self._timed(rung, light)
            kind = (config.method, config.occlusion, config.coarsen_after is None)
            if self._seconds[volume] < _SHORT or kind not in self._warm:  # the first of a kind loads its kernels
                self._warm.add(kind)
                self._timed(rung, light)
            while len(self._solved) > 1 and sum(map(_size, self._solved.values())) > _KEPT:
                self._solved.popitem(last=False)
        lpv, solved, parts = Lpv(grid, config), self._solved[key], []
        self._lit(rung, light, solved)
        for part in truth.parts:
            seen, finding = self._seen(config, grid, light, part, number)
            begin = _clock()
            parts.append(lpv.gather(solved, light, seen))
            each = finding + (_clock() - begin) / len(seen)
            self._reading[rung.name] = min(each, self._reading.get(rung.name, np.inf))
        return torch.cat(parts).double().numpy()

    def _timed(self, rung: Configuration, light: Illumination) -> tuple[torch.Tensor, ...]:
        lpv, volume, begin = Lpv(light.grid, light.config), self._volume(rung), _clock()
        solved = lpv.accumulate(light)
        self._seconds[volume] = min(_clock() - begin, self._seconds.get(volume, np.inf))  # what disturbs can only add
        return solved

    def _lit(self, rung: Configuration, light: Illumination, solved: Sequence[torch.Tensor]) -> None:
        """Time the lighting of a rung's probes."""
        if rung.probes is not None:
            gains, reads = torch.ones(COEFFS), light.probes.reads
            begin = _clock()
            probe_radiance(solved, light.config.grids(light.grid), reads, gains)
            self._lighting[rung.name] = min(_clock() - begin, self._lighting.get(rung.name, np.inf))

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

    def _seen(
        self, config: LpvConfig, grid: Grid, light: Illumination, part: int, number: int
    ) -> tuple[Receivers, float]:
        """A part's receivers with what they see, and the seconds that one took to find out."""
        lights = number if self.component == "direct" else self._geometry(number)  # direct: shadow rays to each light
        key = (part, lights, grid, config.lookup, len(config.grids(grid)), config.probes)
        if key not in self._receivers:
            table = self.truth.receivers(part)
            if config.probes:
                _ = light.probes  # where they stand is no matter of the receivers
            begin = _clock()
            self._receivers[key] = light.receivers(table.position.astype(float), table.normal.astype(float))
            self._finding[key] = (_clock() - begin) / len(table)
        return self._receivers[key], self._finding[key]

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
