"""Path-traced radiance of light probes where they stand: what a game bakes into them.

    content = trace_probes(load_scene("cornell"), position, component="bounce1", workers=2)

The same estimator as that of the targets, with random numbers of its own: a probe that stands where a target point is does not
share its noise.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from data_gen.blocks import BlockRunner, BlockStore, Job, JobPart, round_samples
from data_gen.components import Components, Estimate
from data_gen.load import TargetsError
from data_gen.request import check_counts, relit
from data_gen.rng import generator
from data_gen.run import JobRun
from data_gen.targets import MAX_SPP
from difflpv.scene import Scene

__all__ = ["trace_probes"]

_STREAM = 106


def trace_probes(
    scene: Scene,
    position: np.ndarray,
    *,
    light_sets: Sequence[Sequence[Mapping[str, Any]]] | None = None,
    component: str = "bounce1",
    spp: int = 4096,
    seed: int = 0,
    workers: int = 1,
    progress: bool | None = None,
) -> Estimate:
    """Path-trace what probes see.

    Args:
        scene: the scene.
        position: probes [n,3] m, off every surface.
        light_sets: as ``data_gen.probe_targets.make_probe_targets`` takes them; None for the scene's own lights.
        component: direct, bounce1, uptoK, full, full_indirect.
        spp: paths per probe and light set, rounded up as there.
        seed: equal seeds give equal bits for any number of workers.
        workers: number of processes.
        progress: force the progress bar on or off; None shows it on a terminal only.

    Returns:
        Radiance SH toward the incoming light, ``mean`` and ``standard_error`` [L,n,9,3] W/m2.

    Raises:
        TargetsError: an argument is out of range.
        WorkerError: a worker process died.
    """
    check_counts(("spp", spp, 1, MAX_SPP), ("seed", seed, 0, None), ("workers", workers, 1, None))
    position = np.asarray(position, np.float64)
    if position.ndim != 2 or position.shape[1] != 3 or not len(position) or not np.isfinite(position).all():
        raise TargetsError(f"probe positions: expected finite numbers [n,3] with n > 0, got shape {list(position.shape)}")
    try:
        wanted = Components.of([component])
    except ValueError as error:
        raise TargetsError(str(error)) from None
    lit_scenes = relit(scene, light_sets)[1]
    samples, rounds = round_samples(spp)
    job = Job(
        scenes=lit_scenes,
        parts={"probes": JobPart(wanted, len(position), samples)},
        seed=int(generator(seed, _STREAM).integers(2**63)),
        positions=np.empty((0, 3)),
        normals=np.empty((0, 3)),
        probes=position,
    )
    with tempfile.TemporaryDirectory() as folder:
        with BlockRunner(job, BlockStore(Path(folder)), workers=workers, progress=progress) as runner:
            run = JobRun(runner)
            run.compute("probes", [rounds] * len(lit_scenes))
        found = [run.estimate(light, "probes", rounds) for light in range(len(lit_scenes))]
    return Estimate(np.stack([e.mean[:, 0] for e in found]), np.stack([e.standard_error[:, 0] for e in found]))
