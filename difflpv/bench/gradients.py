"""One forward and backward pass for power and place of lights: ours against path replay at equal noise in the gradient.

The loss is that of an inverse problem at its start: half the squared distance of irradiance to that under other lights (moved,
and a fifth weaker), over the squared irradiance. Its residual is path traced and the same for all, so that every method has to
find the gradient of one linear function of irradiance.

The reference are path-traced central differences with the same random numbers on both sides; power needs none, irradiance
being proportional to it. Ours is exact for what it solves and wrong by its model; path replay is right on average. "Equal
noise" is where its standard error is as large as our error, each over the length of the gradient. Differences by this
project's path tracer are a peer as well: one render and six more for each light's place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from data_gen.few_paths import PathPool, trace_paths
from data_gen.pathtracer import PathTracer
from data_gen.workers import start_pool
from difflpv.bench.breakeven import learned_that_meet
from difflpv.bench.configuration import chosen
from difflpv.bench.measure import Point, prepare
from difflpv.bench.mitsuba_gradient import PathReplay
from difflpv.bench.mitsuba_peer import unavailable
from difflpv.bench.scenes import BenchScene
from difflpv.bench.settings import BenchSettings
from difflpv.bench.timing import interleaved
from difflpv.bench.volume import VolumeRun
from difflpv.scene import AreaLight, Mesh, Scene

__all__ = ["GradientTask", "equal_samples", "gradient_task", "measure_gradients", "moved_light"]

_GOAL_MOVE, _GOAL_POWER = (0.05, 0.0, 0.05), 0.8  # of the scene's extent, of the power
_STEP = 1e-3  # of the scene's extent: bundled panels hang a centimetre under their ceilings
_AT_LIGHT = 0.02  # of the scene's extent: receivers so near to a light do not count, it would move through them
_PILOT = 64  # paths and edges per receiver that path replay's noise is measured with
_MOST = 1 << 20  # paths at a time
_SEED = 3_000_017  # added to that of the truth
_COUNTS = (10_000, 100_000)


@dataclass(frozen=True, eq=False)
class GradientTask:
    """A linear function of irradiance and its true gradient.

    Attributes:
        weight: of the function, by receiver and channel [n,3].
        power: true gradient by a factor of each light's power [lights].
        place: by each light's place [lights,3] 1/m.
        power_error: standard error of ``power`` over its length.
        place_error: of ``place``.
        place_noise: the same of one difference at ``samples`` paths per receiver.
        samples: of the differences.
    """

    weight: np.ndarray
    power: np.ndarray
    place: np.ndarray
    power_error: float
    place_error: float
    place_noise: float
    samples: int


def moved_light(scene: Scene, light: int, offset: np.ndarray) -> Scene:
    """The scene with one area light moved by ``offset`` [3] m."""
    return _with_moved(scene, {light: offset})


def _with_moved(scene: Scene, offsets: dict[int, np.ndarray]) -> Scene:
    moved = {}
    for light, offset in offsets.items():
        mesh = _mesh_of(scene, light)
        moved[mesh.name] = replace(mesh, vertices=mesh.vertices + offset)
    return scene.with_lights(scene.lights, moved)


def _mesh_of(scene: Scene, light: int) -> Mesh:
    own = scene.lights[light]
    assert isinstance(own, AreaLight)
    return next(mesh for mesh in scene.meshes if mesh.name == own.mesh)


def gradient_task(bench: BenchScene, *, samples: int, workers: int = 1, replicates: int = 2) -> GradientTask:
    """The task of a scene whose lights are area lights.

    Args:
        bench: the scene.
        samples: paths per receiver of each side of a difference, a power of two.
        workers: processes of the path tracer.
        replicates: independent repetitions, at least two.
    """
    scene = bench.scene
    count, extent = len(scene.lights), float(np.subtract(*scene.bounds[::-1]).max())
    kept = np.ones(len(bench.position), bool)
    for light in range(count):
        corners = _mesh_of(scene, light).vertices
        low, high = corners.min(0) - _AT_LIGHT * extent, corners.max(0) + _AT_LIGHT * extent
        kept &= ((bench.position < low) | (bench.position > high)).any(1)

    first, step = bench.seed + _SEED, _STEP * extent
    jobs: dict[tuple[int, ...], tuple[Scene, int]] = {(): (scene, first)}
    jobs[(-1,)] = (_with_moved(scene, dict.fromkeys(range(count), extent * np.array(_GOAL_MOVE))), first)
    for number in range(replicates):
        for light in range(count):
            seed, alone = first + 1 + number, scene if count == 1 else scene.with_lights((scene.lights[light],))
            jobs[number, light] = (alone, seed)
            for axis in range(3):
                for sign in (1, -1):
                    jobs[number, light, axis, sign] = (moved_light(scene, light, sign * step * np.eye(3)[axis]), seed)
    traced = _traced(jobs, bench, samples, workers)
    here, area = traced[()], (bench.weight * kept)[:, None]
    weight = area * (here - _GOAL_POWER * traced[-1,]) / (area * here**2).sum()
    aims = {key: float((weight * found).sum()) for key, found in traced.items()}
    each = range(replicates), range(count)
    power = np.array([[aims[r, k] for k in each[1]] for r in each[0]])
    place = np.array(
        [[[(aims[r, k, a, 1] - aims[r, k, a, -1]) / (2 * step) for a in range(3)] for k in each[1]] for r in each[0]]
    )

    def noise(found: np.ndarray) -> float:
        return float(np.linalg.norm(found.std(0, ddof=1)) / np.linalg.norm(found.mean(0)))

    errors = noise(power) / math.sqrt(replicates), noise(place) / math.sqrt(replicates)
    return GradientTask(weight, power.mean(0), place.mean(0), *errors, noise(place), samples)


def _traced(
    jobs: dict[tuple[int, ...], tuple[Scene, int]], bench: BenchScene, samples: int, workers: int
) -> dict[tuple[int, ...], np.ndarray]:
    """Irradiance [n,3] of every job: a scene and a seed."""
    work = partial(_trace, bench.position, bench.normal, bench.component, samples)
    if workers == 1:
        return {key: work(job) for key, job in jobs.items()}
    pool = start_pool(workers)
    try:
        return dict(zip(jobs, pool.map(work, jobs.values()), strict=True))
    finally:
        pool.shutdown(cancel_futures=True)


def _trace(position: np.ndarray, normal: np.ndarray, component: str, samples: int, job: tuple[Scene, int]) -> np.ndarray:
    scene, seed = job
    return trace_paths(PathTracer(scene), position, normal, component, samples=samples, seed=seed)


def equal_samples(pilot: int, noise: float, error: float) -> float:
    """Samples at which noise, measured at ``pilot`` of them, has fallen to ``error``: as one over the root of their number."""
    return pilot * (noise / error) ** 2


def _off(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


def measure_gradients(
    points: Sequence[Point], scene: BenchScene, settings: BenchSettings, *, pool: PathPool | None = None
) -> list[dict[str, Any]]:
    """Gradients of the cheapest learned solve that meets 0.2, but for a quick run of the most accurate too, and of its peers.

    Args:
        points: of this scene.
        scene: where.
        settings: sizes and repeats.
        pool: path tracers of this scene that wait for work; one in this process by default.

    Returns:
        Rows of ``scene``, ``configuration``; for "power" and "place" each ``error`` (ours), ``reference_error``, ``samples``
        of equal noise per receiver of the scene, ``bias`` of path replay and its ``bias_error`` (None where unavailable);
        ``difference_samples`` of equal noise; and by number of receivers (``counts``) the seconds of a forward and backward
        pass, ``ours`` and ``replay``, and of ``differences``. Empty
        where nothing meets 0.2, where a light is no area light, or for direct light.
    """
    fits = learned_that_meet(points)
    areas = all(isinstance(light, AreaLight) for light in scene.scene.lights)
    if not fits or not areas or scene.component != "bounce1":
        return []
    cheapest, nearest = min(fits, key=lambda p: p.seconds or 0), min(fits, key=lambda p: p.error)
    names = dict.fromkeys([cheapest.name] if settings.quick else [cheapest.name, nearest.name])
    tracers = pool or PathPool(scene.scene)
    task = gradient_task(scene, samples=settings.gradient_samples, workers=tracers.workers)
    counts = [len(scene.position), *(n for n in _COUNTS if n <= settings.costly_receivers)]
    rng = np.random.default_rng(scene.seed)
    rows = {n: rng.integers(0, len(scene.position), n) if n > len(scene.position) else np.arange(n) for n in counts}
    replays = {} if unavailable() else {
        n: PathReplay(scene, scene.position[own], scene.normal[own], task.weight[own] * len(scene.position) / n)
        for n, own in rows.items()
    }  # fmt: skip
    known = _noise(replays[counts[0]], task, settings.gradient_replicates, scene.seed) if replays else {}
    return [_row(name, scene, task, rows, replays, known, settings, tracers) for name in names]


def _noise(replay: PathReplay, task: GradientTask, replicates: int, seed: int) -> dict[str, tuple[float, float, float]]:
    """Noise of one gradient by path replay at the pilot's samples, its bias and the bias's standard error; all relative."""
    found = [
        replay.gradient(power_samples=_PILOT, place_samples=_PILOT, seed=seed + number, forward=False)
        for number in range(replicates)
    ]
    result = {}
    for part, name, truth in (("power", "light_intensity", task.power), ("place", "light_position", task.place)):
        own, length = np.stack([f[name] for f in found]), np.linalg.norm(truth)
        noise = float(np.linalg.norm(own.std(0, ddof=1)) / length)
        result[part] = (noise, _off(own.mean(0), truth), noise / math.sqrt(replicates))
    return result


def _row(
    name: str, scene: BenchScene, task: GradientTask, rows: dict[int, np.ndarray], replays: dict[int, PathReplay],
    known: dict[str, tuple[float, float, float]], settings: BenchSettings, pool: PathPool,
) -> dict[str, Any]:  # fmt: skip
    run = prepare(chosen([name])[0], scene)
    assert isinstance(run, VolumeRun)
    base, calls = len(scene.position), dict[str, Callable[[], object]]()
    ours = run.both(run.receivers, task.weight)
    errors = {
        "power": _off(ours["light_intensity"].numpy(), task.power), "place": _off(ours["light_position"].numpy(), task.place)
    }  # fmt: skip
    samples = {part: equal_samples(_PILOT, known[part][0], errors[part]) for part in known}
    differed, renders = equal_samples(task.samples, task.place_noise, errors["place"]), 1 + 6 * len(scene.scene.lights)
    scale, share = {}, {}
    for n, own in rows.items():
        seen = run.receivers if n == base else run.light.receivers(scene.position[own], scene.normal[own])
        calls[f"ours {n}"] = partial(run.both, seen, task.weight[own] * base / n)
        x, normal, paths = scene.position[own], scene.normal[own], max(1.0, differed * base / n)
        power = min(1 << round(math.log2(paths)), 1 << max(0, (_MOST // n).bit_length() - 1))
        share[n] = renders * paths / power
        calls[f"differences {n}"] = partial(pool.trace, x, normal, scene.component, samples=power, seed=scene.seed + _SEED)
        for part, known_samples in samples.items():
            wanted = max(1, math.ceil(known_samples * base / n))
            traced = min(wanted, max(1, _MOST // n))
            scale[n, part] = wanted / traced
            sizes = (traced, 0) if part == "power" else (0, traced)
            calls[f"{part} {n}"] = partial(
                replays[n].gradient, power_samples=sizes[0], place_samples=sizes[1], seed=scene.seed + 1
            )
    times = interleaved(calls, max(2, settings.repeats // 2), patience=settings.patience)
    row: dict[str, Any] = {
        "scene": scene.key, "configuration": name, "counts": list(rows),
        "ours": [times[f"ours {n}"].median for n in rows],
        "differences": [share[n] * times[f"differences {n}"].median for n in rows], "difference_samples": differed,
        "replay": [sum(scale[n, part] * times[f"{part} {n}"].median for part in samples) for n in rows] if replays else None,
    }  # fmt: skip
    for part, reference in (("power", task.power_error), ("place", task.place_error)):
        _, bias, bias_error = known.get(part, (None, None, None))
        row[part] = {
            "error": errors[part], "reference_error": reference, "samples": samples.get(part), "bias": bias,
            "bias_error": bias_error,
        }  # fmt: skip
    return row
