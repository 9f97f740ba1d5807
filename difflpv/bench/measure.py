"""Measure configurations on one scene: errors, then times in turns, gradients and memory.

    scene = bench_scenes("cornell", "out/truth/cornell")[0]
    points = measure(chosen(["learned_9x26"]), scene)

The time of a point is that of ``solve`` plus ``lookup`` after a warm-up: what must be done anew when a light's power
changes. ``lights_seconds`` comes on top where lights move; ``setup_seconds`` belong to geometry and receivers: spent once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np

from data_gen.few_paths import PathPool
from difflpv.bench.configuration import Configuration
from difflpv.bench.images import BenchView, image_errors
from difflpv.bench.mitsuba_peer import MitsubaRun
from difflpv.bench.probes import LitProbes, ProbeRun, TracedProbes
from difflpv.bench.scenes import BenchScene
from difflpv.bench.timing import Timing, interleaved, peak_bytes
from difflpv.bench.tracers import ConstantRun, PathRun
from difflpv.bench.volume import FloorRun, VolumeRun
from difflpv.evaluate import score
from difflpv.leakage import leak

__all__ = ["Point", "BenchRun", "errors", "measure", "prepare"]


class BenchRun(Protocol):
    """One configuration on one scene, ready to be repeated."""

    configuration: Configuration
    setup: dict[str, float]
    lights: float

    def solve(self) -> Any:
        """What must be done anew when a light's power changes."""

    def lookup(self, solved: Any) -> np.ndarray:
        """Irradiance [n,3] of the scene's receivers from what was solved."""

    def predict(self, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Irradiance [n,3] of other receivers."""


@dataclass(frozen=True)
class Point:
    """One configuration on one scene.

    Attributes:
        scene: key of the scene, light and component.
        name: of the configuration.
        family: of the configuration.
        error: area-weighted relative L2 error.
        scaled_error: the same at the best single scale.
        percentile_95: 95th percentile of the error over the mean truth.
        leak: mean error in the dark region over the mean of the lit one; None where none is defined.
        ssim: structural dissimilarity (1 - SSIM)/2 of the picture; None without a camera.
        flip: mean FLIP of the picture; None without a camera or the package.
        receivers: how many.
        solve: time of one solve; None for what is no solve (constant, floor).
        lookup: time of reading the receivers; None where the solve has them already.
        both: time of forward and backward; None without gradients.
        setup_seconds: of what is done once, by name.
        lights_seconds: what moved lights cost besides the solve.
        memory_bytes: peak of one solve without gradients; None where it was not measured.
        memory_volumes: the same in volumes of the finest grid; None without a volume.
    """

    scene: str
    name: str
    family: str
    error: float
    scaled_error: float
    percentile_95: float
    leak: float | None
    ssim: float | None
    flip: float | None
    receivers: int
    solve: Timing | None
    lookup: Timing | None
    both: Timing | None
    setup_seconds: dict[str, float]
    lights_seconds: float
    memory_bytes: int | None
    memory_volumes: float | None

    @property
    def seconds(self) -> float | None:
        """Median time of one solve with its lookup."""
        return None if self.solve is None else self.solve.median + (self.lookup.median if self.lookup else 0.0)

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Point:
        """From ``to_json``."""
        times = {k: None if values[k] is None else Timing(**values[k]) for k in ("solve", "lookup", "both")}
        return cls(**{**values, **times})


def prepare(
    configuration: Configuration,
    scene: BenchScene,
    *,
    tuning: BenchScene | None = None,
    pool: PathPool | None = None,
    cell_spp: int = 1024,
) -> BenchRun:
    """Everything up to the first solve.

    Args:
        configuration: what to prepare.
        scene: where.
        tuning: the same scene with other receivers, for configurations that tune something.
        pool: path tracers of this scene that wait for work; one in this process by default.
        cell_spp: paths per cell of the floor.

    Raises:
        ImportError: a library that this configuration needs is not there.
        ValueError: no receivers to tune on, a light that Mitsuba has not, or no free space for probes.
    """
    if configuration.kind == "constant":
        return ConstantRun(configuration, scene)
    if configuration.kind == "volume":
        return VolumeRun(configuration, scene, tuning=tuning)
    if configuration.kind == "floor":
        return FloorRun(configuration, scene, spp=cell_spp)
    if configuration.kind == "paths":
        return PathRun(configuration, scene, pool or PathPool(scene.scene))
    if configuration.kind == "mitsuba":
        return MitsubaRun(configuration, scene)
    if configuration.kind == "traced probes":
        return TracedProbes(configuration, scene, pool or PathPool(scene.scene))
    if configuration.kind == "lit probes":
        return LitProbes(configuration, scene, tuning=tuning)
    raise ValueError(f"configuration '{configuration.name}': no way to solve kind '{configuration.kind}'")


def errors(found: np.ndarray, scene: BenchScene) -> dict[str, float | None]:
    """Errors of irradiance [n,3] at the scene's receivers, by name of ``Point``'s attribute."""
    s = score(found, scene.truth, scene.weight, method="", component=scene.component, light=0)
    leaked = None if scene.dark is None else leak(found, scene.truth, scene.dark, scene.weight)
    return {"error": s.relative_l2, "scaled_error": s.scaled_l2, "percentile_95": s.percentile_95, "leak": leaked}


def measure(
    configurations: Sequence[Configuration],
    scene: BenchScene,
    *,
    repeats: int = 5,
    patience: float = 10.0,
    gradients: bool = True,
    memory: bool = True,
    tuning: BenchScene | None = None,
    view: BenchView | None = None,
    pool: PathPool | None = None,
    cell_spp: int = 1024,
    progress: Callable[[str], object] = lambda line: None,
) -> list[Point]:
    """Measure configurations on one scene; their repeats take turns.

    Args:
        configurations: what to measure; their names are unique.
        scene: where.
        repeats: of every timed call.
        patience: a call that has taken so many seconds in all is not repeated any more [s].
        gradients: time forward and backward too.
        memory: measure the peak memory of a solve too.
        tuning: the same scene with other receivers, for configurations that tune something.
        view: the picture of the scene, for SSIM and FLIP.
        pool: path tracers of this scene that wait for work; one in this process by default.
        cell_spp: paths per cell of the floor.
        progress: told the name of every configuration.
    """
    runs: dict[str, BenchRun] = {}
    found: dict[str, dict[str, float | None]] = {}
    calls: dict[str, Callable[[], object]] = {}
    for c in configurations:
        progress(c.name)
        run = runs[c.name] = prepare(c, scene, tuning=tuning, pool=pool, cell_spp=cell_spp)
        solved = run.solve()
        found[c.name] = {**errors(run.lookup(solved), scene), "ssim": None, "flip": None}
        if view is not None:
            found[c.name] |= image_errors(run, view, direct=scene.component == "direct")
        if c.kind not in ("constant", "floor"):
            calls[f"solve {c.name}"] = run.solve
        if isinstance(run, VolumeRun | ProbeRun):
            calls[f"lookup {c.name}"] = lambda run=run, solved=solved: run.lookup(solved)  # type: ignore[misc]
            if gradients and isinstance(run, VolumeRun) and c.kind == "volume":
                calls[f"both {c.name}"] = run.both
    times = interleaved(calls, repeats, patience=patience)
    points = []
    for name, run in runs.items():
        own = {part: times.get(f"{part} {name}") for part in ("solve", "lookup", "both")}
        bytes_, volumes = None, None
        if memory and isinstance(run, VolumeRun) and run.configuration.kind == "volume":
            bytes_ = peak_bytes(run.solve)
            volumes = bytes_ / run.volume_bytes
        points.append(
            Point(
                scene=scene.key, name=name, family=run.configuration.family, receivers=len(scene.position),
                setup_seconds=run.setup, lights_seconds=run.lights, memory_bytes=bytes_, memory_volumes=volumes,
                **found[name], **own,  # type: ignore[arg-type]
            )
        )  # fmt: skip
    return points
