"""Targets for placing light probes: path-traced radiance at points in free space, and as a field on a lattice.

    targets = make_probe_targets(load_scene("cornell"), "out/cornell_probes", component="bounce1", workers=2)

The points judge what probes reconstruct; the field fills probes wherever they go. The two have random numbers of their own,
so that noise of the field is not taken for light that the points confirm. As with ``data_gen.targets``: an interrupted run
goes on where it stopped, a finished one is recognised, the same request gives the same bits for any number of workers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_gen.blocks import BlockRunner, BlockStore, Job, JobPart, Quantity, round_samples
from data_gen.components import Components, Estimate
from data_gen.estimators import REPLICATES
from data_gen.freespace import default_clearance, draw_probes, is_free
from data_gen.load import FORMAT, TargetsError, check_files, check_made_for
from data_gen.receivers import draw_receivers
from data_gen.request import alone_in, check_counts, find_finished, finish, make_folder, relit, request_digest
from data_gen.rng import generator
from data_gen.run import JobRun
from data_gen.targets import MAX_SPP
from difflpv.grid import Grid
from difflpv.io.tables import TableError, load_table, save_table
from difflpv.raycast import Raycaster
from difflpv.scene import Scene
from difflpv.triangle_distance import triangle_distance

__all__ = ["ProbeTargets", "load_probe_targets", "make_probe_targets"]

_KIND = "difflpv-probe-targets"
_TABLE = "probe_targets.npz"
_STREAM = 105
_ATTEMPTS = 8


@dataclass(frozen=True, eq=False)
class ProbeTargets:
    """A folder of targets for placing probes.

    Attributes:
        folder: where they lie.
        points: [m,3] m within the scene's bounds, at least ``data_gen.freespace.default_clearance`` off every surface and in
            no solid: first those uniform in the free space, then those over surfaces, uniform by area. Neither part is sorted
            along the scene.
        surface_count: how many of the last points lie over surfaces.
        radiance: radiance SH of each light set at the points, toward the incoming light [L,m,9,3] W/m2, float32.
        standard_error: of ``radiance``.
        grid: cells over the scene's bounds and one more on every side.
        lattice: radiance SH at the centres of cells [L,n_z,n_y,n_x,9,3] W/m2, float32; 0 where they are not free.
        clearance: distance of the centres to the nearest triangle [n_z,n_y,n_x] m. Negative in solids; beyond the scene's
            bounds it is the distance to these, negative; -0 on a surface.
        component: share of the light: direct, bounce1, uptoK, full, full_indirect.
        light_sets: lights in the form that ``difflpv.lights.apply_light_set`` takes, for each L.
        manifest: scene, request, samples, noise, versions, seconds, files.
    """

    folder: Path
    points: np.ndarray
    surface_count: int
    radiance: np.ndarray
    standard_error: np.ndarray
    grid: Grid
    lattice: np.ndarray
    clearance: np.ndarray
    component: str
    light_sets: tuple[list[dict[str, Any]], ...]
    manifest: dict[str, Any]

    def __post_init__(self) -> None:
        lights, count = len(self.light_sets), len(self.points)
        for name, shape in (
            ("points", (count, 3)),
            ("radiance", (lights, count, 9, 3)),
            ("standard_error", (lights, count, 9, 3)),
            ("lattice", (lights, *self.grid.shape, 9, 3)),
            ("clearance", self.grid.shape),
        ):
            found = getattr(self, name)
            if found.shape != shape:
                raise TargetsError(f"{self.folder}: {name}: expected shape {list(shape)}, got {list(found.shape)}")
            if not np.isfinite(found).all():
                raise TargetsError(f"{self.folder}: {name}: expected finite numbers")
        if not 0 <= self.surface_count <= count:
            raise TargetsError(f"{self.folder}: surface_count: expected 0 to {count}, got {self.surface_count}")

    @property
    def free(self) -> np.ndarray:
        """True for the cells that hold light [n_z,n_y,n_x]."""
        return self.clearance > 0

    def check_scene(self, scene: Scene) -> None:
        """Raise a ``TargetsError`` unless these targets were made for ``scene``."""
        check_made_for(scene, self.folder, self.manifest)


def make_probe_targets(
    scene: Scene,
    out_dir: str | Path,
    *,
    count: int = 4000,
    surface_share: float = 0.25,
    cells: int = 32,
    component: str = "bounce1",
    spp: int = 1024,
    lattice_spp: int = 256,
    light_sets: Sequence[Sequence[Mapping[str, Any]]] | None = None,
    seed: int = 0,
    workers: int = 1,
    overwrite: bool = False,
    progress: bool | None = None,
) -> ProbeTargets:
    """Path-trace targets for placing probes into a folder.

    Where free space is, is decided by the scene under its own lights; a panel that a light set moves changes no point.

    Args:
        scene: the scene.
        out_dir: folder for the targets; made if missing.
        count: number of points m.
        surface_share: share of them that lie over surfaces, 0 to 1.
        cells: cells of the lattice along the longest edge of the scene's bounds.
        component: direct (point-like lights are exact), bounce1, uptoK, full, full_indirect.
        spp: paths per point, rounded up to a multiple of 512 (of 32 times a power of two below that).
        lattice_spp: paths per cell, rounded up likewise.
        light_sets: light sets for ``difflpv.lights.apply_light_set``; None for the scene's own lights.
        seed: equal seeds give equal bits.
        workers: number of processes.
        overwrite: replace finished targets of another request instead of raising.
        progress: force the progress bar on or off; None shows it on a terminal only.

    Returns:
        The finished targets.

    Raises:
        TargetsError: the folder holds targets of another request, an argument is out of range, or the scene has no place
            for the points.
        WorkerError: a worker process died; finished blocks are kept.
    """
    check_counts(
        ("count", count, 1, None),
        ("cells", cells, 1, None),
        ("spp", spp, 1, MAX_SPP),
        ("lattice_spp", lattice_spp, 1, MAX_SPP),
        ("seed", seed, 0, None),
        ("workers", workers, 1, None),
    )
    if not 0 <= surface_share <= 1:
        raise TargetsError(f"surface_share: expected a share from 0 to 1, got {surface_share}")
    try:
        wanted = Components.of([component])
    except ValueError as error:
        raise TargetsError(str(error)) from None
    entries, lit_scenes = relit(scene, light_sets)
    request = {
        "format": FORMAT,
        "scene": {"name": scene.name, "hash": scene.hash},
        "lights": [lit.hash for lit in lit_scenes],
        "points": {"count": int(count), "surface_share": float(surface_share), "spp": int(spp)},
        "lattice": {"cells": int(cells), "spp": int(lattice_spp)},
        "component": component,
        "seed": int(seed),
    }
    out = Path(out_dir)
    finished = find_finished(out, request, overwrite, load_probe_targets, _KIND)
    if finished is not None:
        return finished
    surface_count = round(count * surface_share)
    try:
        points = _draw_points(scene, count - surface_count, surface_count, seed)
        grid, clearance = _lattice(scene, cells, seed)
    except ValueError as error:  # hardly any free space, no surface that does not emit
        raise TargetsError(f"probe targets: {error}") from None
    free = clearance > 0
    if not free.any():
        raise TargetsError(f"probe targets: scene '{scene.name}': no cell of {grid.cell_size:.3g} m is free, take more cells")
    make_folder(out)
    with alone_in(out):
        finished = find_finished(out, request, overwrite, load_probe_targets, _KIND)  # by another process meanwhile
        if finished is not None:
            return finished
        samples, rounds = round_samples(spp)
        cell_samples, cell_rounds = round_samples(lattice_spp)
        job = Job(
            scenes=lit_scenes,
            parts={
                "probes": JobPart(wanted, len(points), samples),
                "lattice": JobPart(wanted, int(free.sum()), cell_samples),
            },
            seed=seed,
            positions=np.empty((0, 3)),
            normals=np.empty((0, 3)),
            probes=points,
            lattice=grid.cell_centers()[free],
        )
        store = BlockStore(out / f".blocks-{request_digest(request)[:16]}")
        with BlockRunner(job, store, workers=workers, progress=progress) as runner:
            run = JobRun(runner)
            run.compute("probes", [rounds] * len(lit_scenes))
            run.compute("lattice", [cell_rounds] * len(lit_scenes))
        radiance, spread = np.empty((2, len(lit_scenes), len(points), 9, 3), np.float32)
        lattice = np.zeros((len(lit_scenes), *grid.shape, 9, 3), np.float32)
        summary: list[dict[str, Any]] = []
        for light, lit in enumerate(lit_scenes):
            at_points = _estimate(run, light, "probes", rounds)
            at_cells = _estimate(run, light, "lattice", cell_rounds)
            radiance[light], spread[light], lattice[light, free] = at_points.mean, at_points.standard_error, at_cells.mean
            summary.append(
                {
                    "hash": lit.hash,
                    "entries": entries[light],
                    "spp": rounds * REPLICATES * samples,
                    "lattice_spp": cell_rounds * REPLICATES * cell_samples,
                    "noise": {"points": _noise(at_points), "lattice": _noise(at_cells)},
                }
            )
        table = out / _TABLE
        save_table(
            table,
            points=points,
            surface_count=surface_count,
            radiance=radiance,
            standard_error=spread,
            grid_minimum=grid.minimum,
            cell_size=grid.cell_size,
            lattice=lattice,
            clearance=clearance,
        )
        finish(out, request, summary, [table], rays=run.rays, seconds=run.seconds, kind=_KIND)
        return load_probe_targets(out)


def load_probe_targets(folder: str | Path) -> ProbeTargets:
    """Load what ``make_probe_targets`` finished.

    Raises:
        TargetsError: no probe targets there, or their file is missing, damaged or changed.
    """
    folder = Path(folder)
    manifest = check_files(folder, _KIND)
    try:
        table = load_table(folder / _TABLE)
        resolution = table["clearance"].shape[::-1]
        return ProbeTargets(
            folder=folder,
            points=table["points"],
            surface_count=int(table["surface_count"]),
            radiance=table["radiance"],
            standard_error=table["standard_error"],
            grid=Grid(tuple(table["grid_minimum"]), float(table["cell_size"]), resolution),
            lattice=table["lattice"],
            clearance=table["clearance"],
            component=manifest["request"]["component"],
            light_sets=tuple(light["entries"] for light in manifest["lights"]),
            manifest=manifest,
        )
    except (TableError, KeyError, TypeError) as error:
        raise TargetsError(f"{folder}: damaged probe targets: {' '.join(str(error).split())}") from None


def _draw_points(scene: Scene, in_space: int, on_surfaces: int, seed: int) -> np.ndarray:
    """Points in free space, then points over surfaces [m,3] m."""
    points = draw_probes(scene, in_space, seed) if in_space else np.empty((0, 3))
    if not on_surfaces:
        return points
    (low, high), drawn = scene.bounds, on_surfaces
    clearance = default_clearance((low, high))
    for attempt in range(_ATTEMPTS):
        receivers = draw_receivers(scene, drawn, seed)
        lifted = receivers.position + clearance * receivers.normal
        # their own surface is that far away up to rounding; corners and gaps have others nearer
        clear = triangle_distance(scene.triangle_vertices, lifted) >= (1 - 1e-6) * clearance
        clear &= ((lifted >= low) & (lifted <= high)).all(1)  # the sunlit outside of a house is not where probes are wanted
        clear[clear] = is_free(scene, lifted[clear], seed)
        kept = np.flatnonzero(clear)
        if len(kept) >= on_surfaces:
            # receivers lie in the order of the triangles: shuffled, any part of them is as good as another
            chosen = generator(seed, _STREAM, attempt).permutation(kept)[:on_surfaces]
            return np.concatenate([points, lifted[chosen]])
        drawn = int(np.ceil(drawn * min(1.05 * on_surfaces / max(len(kept), 1), 4))) + 8
    raise ValueError(f"scene '{scene.name}': found {len(kept)} of {on_surfaces} points free over surfaces")


def _lattice(scene: Scene, cells: int, seed: int) -> tuple[Grid, np.ndarray]:
    """Cells over the bounds and one more on every side, so that the clearance turns negative beyond them; its values."""
    low, high = scene.bounds
    size = float((high - low).max()) / cells
    count = np.maximum(np.round((high - low) / size), 1).astype(int) + 2
    grid = Grid(tuple((low + high - count * size) / 2), size, tuple(count))
    centers = grid.cell_centers().reshape(-1, 3)
    beyond = np.linalg.norm(np.maximum(np.maximum(low - centers, centers - high), 0), axis=1)
    inside = np.flatnonzero(beyond == 0)
    distance = triangle_distance(scene.triangle_vertices, centers[inside])
    free = distance > 2 * Raycaster(scene).offset  # else on the surface: rays see either side of it, or both
    free[free] = is_free(scene, centers[inside[free]], seed)
    clearance = -beyond
    clearance[inside] = np.where(free, distance, -distance)
    return grid, clearance.reshape(grid.shape)


def _estimate(run: JobRun, light: int, quantity: Quantity, rounds: int) -> Estimate:
    """Of the one component [n,9,3]."""
    found = run.estimate(light, quantity, rounds, count_rays=True)
    return Estimate(found.mean[:, 0], found.standard_error[:, 0])


def _noise(estimate: Estimate) -> float:
    """Standard error over value, both as root mean square over positions, coefficients and channels."""
    value = float(np.sqrt((estimate.mean**2).mean()))
    return float(np.sqrt((estimate.standard_error**2).mean())) / value if value > 0 else 0.0
