"""Work blocks: fixed pieces of the job, each with random numbers of its own, run by any number of processes.

A block is one chunk of entities (receivers, probes, pixels) times one round of samples under one light set. What it
computes depends on its own numbers and the seed alone, so the order and the number of workers change no bit; each
finished block is a file, so that an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from tqdm import tqdm

from data_gen.components import Components
from data_gen.estimators import REPLICATES, image_block, irradiance_block, probe_block
from data_gen.pathtracer import PathTracer
from data_gen.workers import start_pool
from difflpv.io.tables import TableError, load_table, save_table
from difflpv.scene import Camera, Scene

__all__ = ["Block", "BlockRunner", "BlockStore", "Job", "JobPart", "Quantity", "WorkerError", "round_samples"]

Quantity = Literal["surface", "probes", "image", "lattice"]
_QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)  # new ones go last: the place is part of a block's random numbers
_BLOCK_PATHS = 2**17
_MAX_SAMPLES = 16  # per replicate and round: 512 paths per entity


class WorkerError(RuntimeError):
    """A worker process died; finished blocks are kept."""


def round_samples(spp: int) -> tuple[int, int]:
    """Samples per replicate and number of rounds for at least ``spp`` paths per entity."""
    samples = 1
    while samples < _MAX_SAMPLES and 2 * samples * REPLICATES <= spp:
        samples *= 2
    return samples, -(-spp // (samples * REPLICATES))


@dataclass(frozen=True)
class JobPart:
    """One quantity: which components, of how many entities, with how many samples per replicate and round."""

    components: Components
    count: int
    samples: int

    @property
    def chunk(self) -> int:
        """Entities per block."""
        return max(1, _BLOCK_PATHS // (REPLICATES * self.samples))

    @property
    def chunk_count(self) -> int:
        """Number of chunks."""
        return -(-self.count // self.chunk)


@dataclass(frozen=True, eq=False)
class Job:
    """Everything a worker needs.

    Attributes:
        scenes: the scene under each light set.
        parts: quantities asked for.
        seed: seed of the run.
        positions: receivers [n,3] m.
        normals: receivers [n,3].
        probes: probe positions [m,3] m.
        camera: for images.
        lattice: further probe positions [c,3] m, with random numbers of their own.
    """

    scenes: tuple[Scene, ...]
    parts: dict[Quantity, JobPart]
    seed: int
    positions: np.ndarray
    normals: np.ndarray
    probes: np.ndarray
    camera: Camera | None = None
    lattice: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))


@dataclass(frozen=True, order=True)
class Block:
    """Address of a block: light set, quantity, round of samples, chunk of entities."""

    light: int
    quantity: Quantity
    round: int
    chunk: int

    @property
    def name(self) -> str:
        """File name without suffix."""
        return f"light{self.light}_{self.quantity}_round{self.round}_chunk{self.chunk}"


class BlockStore:
    """Finished blocks as files of one folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, block: Block) -> Path:
        """File of a block."""
        return self.folder / f"{block.name}.npz"

    def save(self, block: Block, means: np.ndarray, rays: int, seconds: float) -> None:
        """Write a finished block's replicate means, atomically."""
        save_table(self.path(block), means=means, rays=rays, seconds=seconds)

    def load(self, block: Block) -> tuple[np.ndarray, int, float] | None:
        """Replicate means, rays and seconds of a finished block; None where it has to be computed."""
        try:
            table = load_table(self.path(block))
            return table["means"], int(table["rays"]), float(table["seconds"])
        except (TableError, KeyError):  # never written, or damaged since
            return None


def compute_block(job: Job, tracers: dict[int, PathTracer], block: Block) -> tuple[np.ndarray, int, float]:
    """Replicate means, rays and seconds of one block; ``tracers`` keeps the path tracer of the light set in use."""
    start = time.perf_counter()
    if block.light not in tracers:
        tracers.clear()  # blocks come light by light: one acceleration structure at a time
        tracers[block.light] = PathTracer(job.scenes[block.light])
    tracer = tracers[block.light]
    before = tracer.rays
    part = job.parts[block.quantity]
    rows = slice(block.chunk * part.chunk, min((block.chunk + 1) * part.chunk, part.count))
    options: dict[str, Any] = {
        "samples": part.samples,
        "seed": job.seed,
        "address": (block.light, _QUANTITIES.index(block.quantity), block.chunk),
        "round": block.round,
    }
    if block.quantity == "surface":
        means = irradiance_block(tracer, job.positions[rows], job.normals[rows], part.components, **options)
    elif block.quantity in ("probes", "lattice"):
        positions = job.probes if block.quantity == "probes" else job.lattice
        means = probe_block(tracer, positions[rows], part.components, **options)
    else:
        if job.camera is None:
            raise ValueError("image block: the job has no camera")
        means = image_block(tracer, job.camera, np.arange(rows.start, rows.stop), part.components, **options)
    return means.astype(np.float32), tracer.rays - before, time.perf_counter() - start


_worker: tuple[Job, dict[int, PathTracer]] | None = None


def _start_worker(job: Job) -> None:
    global _worker
    _worker = (job, {})


def _work(block: Block) -> tuple[np.ndarray, int, float]:
    assert _worker is not None
    return compute_block(*_worker, block)


class _Progress:
    """Bar on stderr with rays/s and time left; nothing where stderr is no terminal."""

    def __init__(self, total: int, label: str, show: bool | None) -> None:
        self.bar = tqdm(
            total=total, desc=label, unit="block", file=sys.stderr, disable=None if show is None else not show
        )
        self.start = time.perf_counter()
        self.rays = 0

    def step(self, rays: int) -> None:
        self.rays += rays
        rate = self.rays / max(time.perf_counter() - self.start, 1e-9)
        self.bar.set_postfix_str(f"{rate / 1e6:.2f} M rays/s", refresh=False)
        self.bar.update()


class BlockRunner:
    """Computes blocks that are not in the store yet; a context manager that owns the worker processes.

    Args:
        job: the job.
        store: where finished blocks go, one by one.
        workers: number of processes; with 1 the caller's own.
        progress: force the bar on or off; None shows it on a terminal only.
    """

    def __init__(self, job: Job, store: BlockStore, *, workers: int = 1, progress: bool | None = None) -> None:
        self.job, self.store = job, store
        self._workers, self._progress = workers, progress
        self._pool: ProcessPoolExecutor | None = None
        self._tracers: dict[int, PathTracer] = {}

    def __enter__(self) -> BlockRunner:
        return self

    def __exit__(self, *error: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def run(self, blocks: Sequence[Block], label: str) -> None:
        """Have all ``blocks`` in the store.

        Raises:
            WorkerError: a worker process died.
            KeyboardInterrupt: passed on; finished blocks are in the store.
        """
        missing = sorted(block for block in blocks if self.store.load(block) is None)
        if not missing:
            return
        self.store.folder.mkdir(parents=True, exist_ok=True)
        bar = _Progress(len(missing), label, self._progress)
        try:
            for block, (means, rays, seconds) in self._computed(missing):
                self.store.save(block, means, rays, seconds)
                bar.step(rays)
        except BrokenProcessPool:
            raise WorkerError(
                f"a worker process died (out of memory, or killed); finished blocks are kept in '{self.store.folder}', "
                "run the same command again to go on"
            ) from None
        finally:
            bar.bar.close()

    def _computed(self, missing: Sequence[Block]) -> Iterator[tuple[Block, tuple[np.ndarray, int, float]]]:
        """Blocks with their results, as they are ready."""
        if self._workers == 1:
            for block in missing:
                yield block, compute_block(self.job, self._tracers, block)
            return
        if self._pool is None:
            self._pool = start_pool(self._workers, _start_worker, self.job)
        futures = {self._pool.submit(_work, block): block for block in missing}
        for future in as_completed(futures):
            yield futures.pop(future), future.result()  # popped: thousands of results would pile up here
