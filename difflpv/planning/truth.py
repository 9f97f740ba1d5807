"""Path-traced truth that rungs are judged by: a level adds lights and receivers to those of the level before it.

So nothing is traced twice, and an early "no" costs one light and few receivers. That a level's receivers had a part in the
levels before does not weaken its bounds: those could only reject, and to be chosen a rung needs the last level's bounds,
whatever it showed before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from data_gen.receivers import draw_receivers
from difflpv.bench.scenes import targets_in_grid
from difflpv.config import grid_for
from difflpv.illumination import Component
from difflpv.io.tables import ReceiverTable
from difflpv.lights import apply_light_set
from difflpv.scene import Scene

__all__ = ["LEVELS", "HeldOutTruth", "Level", "LevelTruth"]


@dataclass(frozen=True)
class Level:
    """How closely rungs are judged.

    Attributes:
        receivers: how many, those of the level before among them.
        spp: paths per receiver that is new on this level.
        lights: light sets, the first of all that bring light.
        slack: see ``difflpv.planning.race.Judge``.
    """

    receivers: int
    spp: int
    lights: int
    slack: float = 1.0


# 64 paths: on the bundled scenes twice as many narrow the bounds by 0 to 10 %, for the scatter is that of receivers
LEVELS = (Level(1000, 64, 1, 1.3), Level(1000, 64, 4), Level(2000, 64, 4), Level(4000, 64, 4))
_SEARCH = 256  # paths that look for light before a point counts as buried: what they miss, at most 2 % of a bundled
# scene's area, holds next to none
_FEW = 100  # receivers that tell how much of the area is buried
_SHARE_MARGIN = 0.93  # of it, so that a part is drawn once, not twice


@dataclass(frozen=True, eq=False)
class LevelTruth:
    """Truth of a level.

    Attributes:
        parts: numbers of its parts; the receivers of each are drawn by area.
        sets: numbers of its light sets.
        irradiance: W/m2, [sets, n, 3], the parts one after another.
        standard_error: of it, likewise.
        weight: area that each receiver stands for [m2], [sets, n].
    """

    parts: tuple[int, ...]
    sets: tuple[int, ...]
    irradiance: np.ndarray
    standard_error: np.ndarray
    weight: np.ndarray


@dataclass(eq=False)
class _Part:
    receivers: ReceiverTable
    irradiance: dict[int, np.ndarray] = field(default_factory=dict)
    standard_error: dict[int, np.ndarray] = field(default_factory=dict)
    weight: dict[int, np.ndarray] = field(default_factory=dict)


class HeldOutTruth:
    """Truth of one component of a scene's light, traced level by level when it is first needed."""

    def __init__(
        self,
        scene: Scene,
        component: Component,
        light_sets: Sequence[Sequence[Mapping[str, Any]]],
        folder: str | Path,
        *,
        levels: Sequence[Level] = LEVELS,
        seed: int = 0,
        workers: int = 1,
    ) -> None:
        """Set up, see ``difflpv.planning.judging.SceneJudge``.

        Raises:
            ValueError: a level with fewer receivers or lights than the one before.
        """
        for before, level in zip(levels, levels[1:], strict=False):
            if level.receivers < before.receivers or level.lights < before.lights:
                raise ValueError(f"levels: expected receivers and lights that never become fewer, got {level} after {before}")
        self.scene, self.component, self.light_sets = scene, component, list(light_sets)
        self.folder, self.levels, self.seed, self.workers = Path(folder), tuple(levels), seed, workers
        counts = [0, *(level.receivers for level in levels)]
        self._fresh = np.diff(counts).tolist()  # receivers that each level adds
        self._parts: dict[int, _Part] = {}
        self._lit: dict[int, Scene] = {}

    def receivers(self, part: int) -> ReceiverTable:
        """Those that level ``part`` adds."""
        return self._part(part).receivers

    def lit(self, number: int) -> Scene:
        """The scene under a light set."""
        if number not in self._lit:
            self._lit[number] = apply_light_set(self.scene, self.light_sets[number])
        return self._lit[number]

    def level(self, level: int) -> LevelTruth:
        """Truth of a level.

        Raises:
            ValueError: a component without light under all the sets.
        """
        sets, parts = self._sets(self.levels[level].lights), [p for p in range(level + 1) if self._fresh[p]]
        for part in parts:
            self._trace(part, [number for number in sets if number not in self._part(part).irradiance])
        found = [self._part(part) for part in parts]

        def joined(tables: Sequence[dict[int, np.ndarray]]) -> np.ndarray:
            return np.stack([np.concatenate([table[number] for table in tables]) for number in sets])

        shares = [self._fresh[part] / self.levels[level].receivers for part in parts]  # each part stands for the whole area
        weights = [{k: w * share for k, w in part.weight.items()} for part, share in zip(found, shares, strict=True)]
        irradiance, error = joined([p.irradiance for p in found]), joined([p.standard_error for p in found])
        return LevelTruth(tuple(parts), tuple(sets), irradiance, error, joined(weights))

    def _sets(self, wanted: int) -> list[int]:
        """The first light sets that bring light, more of it than their paths make noise."""
        part = self._part(0)

        def energy(values: np.ndarray, number: int) -> float:
            return float((part.weight[number][:, None] * values**2).sum())

        while True:
            lit = [k for k, found in part.irradiance.items() if energy(found, k) > 2 * energy(part.standard_error[k], k)]
            rest = [number for number in range(len(self.light_sets)) if number not in part.irradiance]
            if len(lit) >= wanted or not rest:
                break
            self._trace(0, rest[: wanted - len(lit)])
        if not lit:
            raise ValueError(f"component: scene '{self.scene.name}' has no light in '{self.component}' to plan for")
        return lit[:wanted]

    def _part(self, part: int) -> _Part:
        if part not in self._parts:
            self._parts[part] = _Part(self._drawn(self._fresh[part], self._seed(part), self._free_share))
        return self._parts[part]

    def _drawn(self, count: int, seed: int, share: float = 1.0) -> ReceiverTable:
        within = grid_for(self.scene)
        return draw_receivers(self.scene, count, seed, within=within, search=_SEARCH, expected_share=share)

    @cached_property
    def _free_share(self) -> float:
        """Share of the area that is neither buried nor outside the grid, roughly and rather too small: from a few receivers."""
        few = self._drawn(_FEW, self._seed(-1))
        assert few.area_weight is not None
        dark = self.scene.mesh_emission.max(1)[self.scene.triangle_mesh] == 0
        return min(1.0, _SHARE_MARGIN * float(few.area_weight.sum() / self.scene.triangle_areas[dark].sum()))

    def _seed(self, part: int) -> int:
        return self.seed + 1009 * (part + 1)

    def _trace(self, number: int, sets: Sequence[int]) -> None:
        part = self._part(number)
        for k in sets:  # each alone: which sets a level asks for, and when, changes no path
            targets = targets_in_grid(
                self.scene, self.folder / f"truth_{number}_{k}", components=(self.component,), receivers=part.receivers,
                spp=self.levels[number].spp, light_sets=[self.light_sets[k]], seed=self._seed(number) + k,
                workers=self.workers,
            )  # fmt: skip
            light = targets.lights[0]
            part.irradiance[k] = light.irradiance[self.component].astype(float)
            part.standard_error[k] = light.standard_error[self.component].astype(float)
            part.weight[k] = light.area_weight.astype(float)
