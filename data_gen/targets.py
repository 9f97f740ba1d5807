"""Make targets: path-traced irradiance, probes and images of a scene under one or several light sets.

    targets = make_targets(load_scene("cornell"), "out/cornell", receiver_count=4000, target_error=0.01, workers=2)

An interrupted run goes on where it stopped, a finished one is recognised and not repeated; the same request gives the
same tables, bit for bit, for any number of workers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from data_gen.blocks import BlockRunner, BlockStore, Job, JobPart, Quantity, round_samples
from data_gen.components import Components
from data_gen.estimators import REPLICATES
from data_gen.freespace import draw_probes
from data_gen.load import Targets, TargetsError, load_targets
from data_gen.receivers import draw_receivers
from data_gen.request import alone_in, check_counts, describe_request, find_finished, finish, make_folder, relit, request_digest
from data_gen.rng import MAX_SAMPLES
from data_gen.run import TargetRun
from difflpv.io.tables import ReceiverTable
from difflpv.scene import Scene

__all__ = ["DEFAULT_COMPONENTS", "MAX_SPP", "PROBE_COMPONENTS", "make_targets"]

DEFAULT_COMPONENTS = ("direct", "bounce1", "full")
PROBE_COMPONENTS = ("direct", "bounce1", "full_indirect")
MAX_SPP = MAX_SAMPLES * REPLICATES


def make_targets(
    scene: Scene,
    out_dir: str | Path,
    *,
    receivers: ReceiverTable | None = None,
    receiver_count: int | None = None,
    components: Sequence[str] = DEFAULT_COMPONENTS,
    spp: int | None = None,
    target_error: float | None = None,
    max_spp: int = 65536,
    light_sets: Sequence[Sequence[Mapping[str, Any]]] | None = None,
    probes: int = 0,
    probe_spp: int = 4096,
    images: bool = False,
    image_spp: int = 256,
    seed: int = 0,
    workers: int = 1,
    overwrite: bool = False,
    progress: bool | None = None,
) -> Targets:
    """Path-trace targets into a folder.

    Args:
        scene: the scene.
        out_dir: folder for the targets; made if missing.
        receivers: where irradiance is asked for. Normals are taken as they are.
        receiver_count: instead of ``receivers``, how many to draw by area (4,000 if neither is given).
        components: direct, bounce1, uptoK, full, full_indirect.
        spp: paths per receiver, rounded up to a multiple of 512 (of 32 times a power of two below that).
        target_error: instead of ``spp``, go on until the mean standard error is below this share of the mean, for
            ``full`` if it is asked for, else for every component (0.01 if neither is given).
        max_spp: where ``target_error`` gives up; the manifest tells the error reached.
        light_sets: light sets for ``difflpv.lights.apply_light_set``; None for the scene's own lights.
        probes: number of free-space points with incident radiance SH (direct, bounce1, full_indirect).
        probe_spp: paths per probe.
        images: render the scene's first camera, one EXR and PNG per component; visible emitters show their radiance.
        image_spp: paths per pixel.
        seed: equal seeds give equal bits.
        workers: number of processes.
        overwrite: replace finished targets of another request instead of raising.
        progress: force the progress bar on or off; None shows it on a terminal only.

    Returns:
        The finished targets.

    Raises:
        TargetsError: the folder holds targets of another request, or an argument is out of range.
        WorkerError: a worker process died; finished blocks are kept.
    """
    if receivers is not None and receiver_count is not None:
        raise TargetsError("receivers: give a table or a count, not both")
    if spp is not None and target_error is not None:
        raise TargetsError("samples: give spp or target_error, not both")
    if spp is None and target_error is None:
        target_error = 0.01
    _check_counts(spp, target_error, max_spp, probes, probe_spp, image_spp, seed, workers, receiver_count)
    try:
        wanted = Components.of(components)
    except ValueError as error:
        raise TargetsError(str(error)) from None
    if images and not scene.cameras:
        raise TargetsError(f"scene '{scene.name}': no camera, images need one")
    entries, lit_scenes = relit(scene, light_sets)
    camera = scene.cameras[0] if images else None
    request = describe_request(
        scene,
        lit_scenes,
        receivers=receivers if receivers is not None else receiver_count or 4000,
        components=wanted.names,
        spp=spp,
        target_error=target_error,
        max_spp=max_spp,
        probes=probes,
        probe_spp=probe_spp,
        camera=camera,
        image_spp=image_spp,
        seed=seed,
    )
    out = Path(out_dir)
    finished = find_finished(out, request, overwrite, load_targets)
    if finished is not None:
        return finished
    make_folder(out)
    with alone_in(out):
        finished = find_finished(out, request, overwrite, load_targets)  # by another process meanwhile
        if finished is not None:
            return finished
        if receivers is None:
            receivers = draw_receivers(scene, receiver_count or 4000, seed)
        samples, rounds = round_samples(spp if spp is not None else max_spp)
        parts: dict[Quantity, JobPart] = {"surface": JobPart(wanted, len(receivers), samples)}
        extra_rounds: dict[Quantity, int] = {}
        if probes:
            probe_samples, extra_rounds["probes"] = round_samples(probe_spp)
            parts["probes"] = JobPart(Components.of(PROBE_COMPONENTS), probes, probe_samples)
        if camera is not None:
            image_samples, extra_rounds["image"] = round_samples(image_spp)
            parts["image"] = JobPart(wanted, camera.width * camera.height, image_samples)
        job = Job(
            scenes=lit_scenes,
            parts=parts,
            seed=seed,
            positions=receivers.position,
            normals=receivers.normal / np.linalg.norm(receivers.normal, axis=1, keepdims=True),
            probes=draw_probes(scene, probes, seed) if probes else np.empty((0, 3)),
            camera=camera,
        )
        store = BlockStore(out / f".blocks-{request_digest(request)[:16]}")
        with BlockRunner(job, store, workers=workers, progress=progress) as runner:
            run = TargetRun(runner, receivers)
            if spp is not None:
                surface_rounds = [rounds] * len(lit_scenes)
                run.compute("surface", surface_rounds)
            else:
                assert target_error is not None
                surface_rounds = run.until(target_error, rounds)
            for quantity, count in extra_rounds.items():
                run.compute(quantity, [count] * len(lit_scenes))
        files, summary = run.write(out, surface_rounds, extra_rounds)
        for light, light_summary in enumerate(summary):
            light_summary["entries"] = entries[light]
        finish(out, request, summary, files, rays=run.rays, seconds=run.seconds)
        return load_targets(out)


def _check_counts(spp, target_error, max_spp, probes, probe_spp, image_spp, seed, workers, receiver_count) -> None:
    check_counts(
        ("spp", spp, 1, MAX_SPP),
        ("max_spp", max_spp, 1, MAX_SPP),
        ("probes", probes, 0, None),
        ("probe_spp", probe_spp, 1, MAX_SPP),
        ("image_spp", image_spp, 1, MAX_SPP),
        ("seed", seed, 0, None),
        ("workers", workers, 1, None),
        ("receiver_count", receiver_count, 1, None),
    )
    if target_error is not None and not 0 < target_error < 1:
        raise TargetsError(f"target_error: expected a share between 0 and 1, got {target_error}")
