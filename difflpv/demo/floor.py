"""The floor of the table: the true light in the cells, path-traced, read as every learned volume is."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from data_gen.cells import kept_volumes
from difflpv.demo.settings import DemoSettings
from difflpv.evaluate import Score, relative_noise, score
from difflpv.fit import LightTarget
from difflpv.simulate import read_volume

__all__ = ["judge_floor"]


def judge_floor(
    lights: Mapping[int, LightTarget], settings: DemoSettings, *, folder: Path, seed: int, workers: int
) -> tuple[list[Score], dict[str, Any]]:
    """Scores under every light, and paths and noise for the report.

    Args:
        lights: targets by number of the light set, traced with the lookup to read by.
        settings: paths per cell, and which lights are whose.
        folder: where true volumes are kept.
        seed: of the paths.
        workers: processes.

    Returns:
        The scores, and ``spp`` with ``noise``: the part of the error that is the volume's own noise, by split.
    """
    scenes, first = [t.illumination.scene for t in lights.values()], next(iter(lights.values())).illumination
    volumes = kept_volumes(
        folder, scenes, first.grid, first.component, spp=settings.floor_spp, seed=seed, workers=workers
    )
    scores, noise = [], {}
    for (k, target), volume in zip(lights.items(), volumes, strict=True):
        seen = target.receivers
        arrays = (seen.position, seen.normal, target.irradiance, target.weight)
        x, n, truth, weight = (a.double().cpu().numpy() for a in arrays)
        read = read_volume(volume.mean, target.illumination, x, n)
        off = read_volume(volume.halves[0], target.illumination, x, n) - read
        noise[k] = relative_noise(off, truth, weight)
        scores.append(score(read, truth, weight, method="floor", component=first.component, light=k))
    splits = {"train": settings.train, "test": settings.test}
    means = {split: float(np.mean([noise[k] for k in own])) for split, own in splits.items()}
    return scores, {"spp": volumes[0].spp, "noise": means}
