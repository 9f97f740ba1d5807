"""The demo scene's chart of speed against accuracy: untuned methods and the path tracer on the demo's own receivers."""

from __future__ import annotations

from data_gen.load import Targets
from difflpv.bench.configuration import chosen
from difflpv.bench.measure import measure
from difflpv.bench.pareto import pareto_front
from difflpv.bench.scenes import BenchScene
from difflpv.lights import apply_light_set
from difflpv.report.bench import draw_error_over_time, small_png
from difflpv.scene import Scene

__all__ = ["draw_speed"]

_NAMES = (
    "constant", "LPV as published", "HOLPV as published", "learned_9x6, 16 cells, 16 steps", "learned_9x26, 16 cells, 16 steps",
    "learned_9x6", "learned_9x26", "path tracer, 1", "path tracer, 4", "path tracer, 16", "path tracer, 64",
)  # fmt: skip
_REPEATS, _PATIENCE = 3, 0.5


def draw_speed(scene: Scene, targets: Targets, light: int, *, seed: int) -> bytes:
    """Error over time of one bounce under one light, as a PNG file; measured now, so no two are alike.

    Args:
        scene: the scene.
        targets: with the component "bounce1".
        light: number of the light set.
        seed: of the light samples.
    """
    own, receivers = targets.lights[light], targets.receivers
    bench = BenchScene(
        name=scene.name, component="bounce1", light=light, scene=apply_light_set(scene, own.entries),
        position=receivers.position.astype(float), normal=receivers.normal.astype(float), weight=own.area_weight.astype(float),
        truth=own.irradiance["bounce1"].astype(float), standard_error=own.standard_error["bounce1"].astype(float), dark=None,
        target_seconds=float(targets.manifest["seconds"]) / len(targets.lights), folder=targets.folder, seed=seed,
    )  # fmt: skip
    points = measure(chosen(_NAMES), bench, repeats=_REPEATS, patience=_PATIENCE, gradients=False, memory=False)
    shown = [{"name": p.name, "family": p.family, "error": p.error, "seconds": p.seconds} for p in points]
    title = f"{len(receivers)} receivers under light {light}"
    return small_png(draw_error_over_time(shown, [p.name for p in pareto_front(points)], title=title, noise=bench.noise))
