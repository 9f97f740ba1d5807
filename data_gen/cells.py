"""The true field in the cells of a volume: what a perfect propagation of degree 2 would hold.

Read like any other volume it gives the error that no kernel of this degree on this grid can be expected to beat by much: the
floor of every table. ``kept_volume`` path-traces it once and finds it again on disk.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from data_gen.blocks import round_samples
from data_gen.components import Components
from data_gen.estimators import REPLICATES, probe_block
from data_gen.pathtracer import PathTracer
from data_gen.workers import start_pool
from difflpv.grid import Grid
from difflpv.io.tables import TableError, load_table, save_table
from difflpv.scene import AreaLight, Scene

__all__ = ["TrueVolume", "find_volume", "kept_volume", "kept_volumes", "trace_volume"]

_STREAM = 104
_PATHS = 2**17


@dataclass(frozen=True, eq=False)
class TrueVolume:
    """Path-traced radiance at the centres of all cells, in the form of an accumulated volume.

    A cell of edge h stores h^2 times the radiance that passes its centre, by direction of travel (physics.md, "The chain" 7).

    Attributes:
        halves: two independent estimates [W/sr], shape [2, 3, 9, n_z, n_y, n_x]; half their difference shows the noise of
            their mean.
        spp: paths per cell, both halves together.
        seed: equal seeds give equal bits.
    """

    halves: np.ndarray
    spp: int
    seed: int

    @property
    def mean(self) -> np.ndarray:
        """Intensity [W/sr], shape [3, 9, n_z, n_y, n_x]."""
        return self.halves.mean(0)


def trace_volume(scene: Scene, grid: Grid, component: str, *, spp: int = 1024, seed: int = 0) -> TrueVolume:
    """Path-trace the light in the cells of a volume: 7 s for 32^3 cells and one bounce, on one core.

    Args:
        scene: with its lights.
        grid: cells of the volume.
        component: "direct" (area lights only: the light of others is exact where it is sampled), "bounce1", ...
        spp: paths per cell, at least; 32 or a multiple are taken.
        seed: equal seeds give equal bits.
    """
    samples, rounds = round_samples(spp)
    paths = samples * rounds * REPLICATES
    if component == "direct":
        area = tuple(light for light in scene.lights if isinstance(light, AreaLight))
        if not area:
            return TrueVolume(np.zeros((2, 3, 9, *grid.shape)), paths, seed)
        scene = replace(scene, lights=area)
    tracer, wanted = PathTracer(scene), Components.of([component])
    centers = grid.cell_centers().reshape(-1, 3)
    chunk = max(1, _PATHS // (REPLICATES * samples))
    found = np.zeros((2, len(centers), 9, 3))
    for number, begin in enumerate(range(0, len(centers), chunk)):
        for part in range(rounds):
            cells = centers[begin : begin + chunk]
            address = (_STREAM, number)
            block = probe_block(tracer, cells, wanted, samples=samples, seed=seed, address=address, round=part)
            replicates = block[:, :, 0].reshape(2, REPLICATES // 2, len(cells), 9, 3)
            found[:, begin : begin + chunk] += replicates.mean(1) / rounds
    found[:, :, 1:4] *= -1  # toward the light -> direction of travel
    halves = grid.cell_size**2 * found.transpose(0, 3, 2, 1).reshape(2, 3, 9, *grid.shape)
    return TrueVolume(halves, paths, seed)


def kept_volume(
    folder: str | Path, scene: Scene, grid: Grid, component: str, *, spp: int | None = None, seed: int | None = None
) -> TrueVolume:
    """The true volume of a scene under its lights, from ``folder`` if it lies there, else path-traced and written there.

    Args:
        folder: one file per scene, lights, grid and component.
        scene: as for ``trace_volume``.
        grid: as for ``trace_volume``.
        component: as for ``trace_volume``.
        spp: paths per cell; None takes what lies there, else 1024.
        seed: None takes what lies there, else 0.
    """
    samples, rounds = round_samples(spp or 1024)
    found = find_volume(folder, scene, grid, component)
    if found is not None and (spp is None or found.spp == samples * rounds * REPLICATES) and seed in (None, found.seed):
        return found
    made = trace_volume(scene, grid, component, spp=spp or 1024, seed=seed or 0)
    path = _file(folder, scene, grid, component)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_table(path, halves=made.halves.astype(np.float32), spp=made.spp, seed=made.seed)
    return find_volume(folder, scene, grid, component) or made  # read back: the same bits as the next run's


def kept_volumes(
    folder: str | Path, scenes: Sequence[Scene], grid: Grid, component: str, *, spp: int, seed: int = 0, workers: int = 1
) -> list[TrueVolume]:
    """``kept_volume`` of a scene under several sets of lights, a process for each up to ``workers``; the same bits for any.

    Raises:
        KeyboardInterrupt: passed on; volumes that are finished are kept.
    """
    if workers > 1 and len(scenes) > 1:
        pool = start_pool(min(workers, len(scenes)))
        try:
            jobs = [pool.submit(kept_volume, folder, scene, grid, component, spp=spp, seed=seed) for scene in scenes]
            for job in jobs:
                job.result()
        finally:
            pool.shutdown(cancel_futures=True)
    return [kept_volume(folder, scene, grid, component, spp=spp, seed=seed) for scene in scenes]


def find_volume(folder: str | Path, scene: Scene, grid: Grid, component: str) -> TrueVolume | None:
    """What ``kept_volume`` wrote for these, or None where nothing usable lies there."""
    try:
        table = load_table(_file(folder, scene, grid, component))
        halves, spp, seed = table["halves"], int(table["spp"]), int(table["seed"])
    except (TableError, KeyError, TypeError):
        return None  # never made, or damaged since
    return TrueVolume(halves.astype(np.float64), spp, seed) if halves.shape == (2, 3, 9, *grid.shape) else None


def _file(folder: str | Path, scene: Scene, grid: Grid, component: str) -> Path:
    text = f"{scene.hash} {tuple(map(float, grid.minimum))} {float(grid.cell_size)} {tuple(map(int, grid.resolution))}"
    cells = "x".join(map(str, grid.resolution))
    return Path(folder) / f"{component}_{cells}_{hashlib.sha256(text.encode()).hexdigest()[:16]}.npz"
