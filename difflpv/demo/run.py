"""The demo's stages in order."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import difflpv
from data_gen.load import Targets
from data_gen.targets import make_targets
from difflpv.config import LpvConfig, Method, grid_for
from difflpv.demo.fits import fit_once
from difflpv.demo.floor import judge_floor
from difflpv.demo.settings import FITS, SCENE, UNFITTED, DemoSettings
from difflpv.demo.speed import draw_speed
from difflpv.demo.summary import (
    PRESENTATION,
    DemoSummary,
    code_digest,
    describe_machine,
    describe_targets,
    finished_summary,
    mean_rows,
)
from difflpv.demo.views import Views, render_views, trace_image
from difflpv.evaluate import Score
from difflpv.fit import LightTarget, light_target, score_lights
from difflpv.illumination import Component, Illumination
from difflpv.io import load_scene
from difflpv.io.atomic import write_bytes, write_json, write_text
from difflpv.lights import load_light_sets
from difflpv.pipeline import Lpv
from difflpv.report.figures import draw_convergence, draw_factors, draw_lights, draw_renders
from difflpv.report.page import build_page
from difflpv.scene import Scene

__all__ = ["run_demo"]

_METHODS: tuple[Method, ...] = tuple(UNFITTED.values())
_IN_TABLE = (
    "constant",
    "LPV",
    "LPV fitted",
    "LPV nlopt",
    "HOLPV",
    "HOLPV fitted",
    "HOLPV nlopt",
    "learned_9x26",
    "learned_9x26 fitted",
)  # the floor comes last
_IN_PICTURE = ("LPV fitted", "HOLPV", "HOLPV fitted", "learned_9x26", "learned_9x26 fitted")
_IN_README = ("HOLPV", "HOLPV fitted", "learned_9x26 fitted")
_README_DPI = 100  # keeps the file small
Progress = Callable[[str], object]


def run_demo(
    out: str | Path = "out/demo",
    *,
    quick: bool = False,
    seed: int = 0,
    workers: int | None = None,
    progress: Progress = print,
    settings: DemoSettings | None = None,
) -> DemoSummary:
    """Run the demo, or what is left of it.

    Args:
        out: folder for everything.
        quick: small sizes (``DemoSettings.quick``).
        seed: of the targets, the light samples and the solvers; equal seeds give equal numbers.
        workers: processes of the path tracer; by default one per processor that this process may use.
        progress: told lines of text, the table last.
        settings: other sizes than those of ``quick``.

    Returns:
        The errors, and where the report lies.

    Raises:
        KeyboardInterrupt: passed on; the same call goes on where it stopped.
        OSError: a file cannot be written.
    """
    begun, begun_at = time.perf_counter(), time.time()
    sizes = settings or (DemoSettings.quick() if quick else DemoSettings())
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    identity = {"settings": asdict(sizes), "seed": seed, "code": code_digest()}
    fit_code = code_digest(without=PRESENTATION)
    done = finished_summary(folder, identity)
    if done is not None:
        progress(f"{done.table}\n\nfinished before; report: {done.report}")
        return done
    count = workers or _processors()

    scene = load_scene(SCENE)
    sets = load_light_sets(None, SCENE)[: max(sizes.lights) + 1]
    progress(f"path tracing {sizes.receivers} receivers under {len(sets)} lights, {sizes.spp} paths each")
    targets = make_targets(
        scene,
        folder / "targets",
        receiver_count=sizes.receivers,
        components=("direct", "bounce1"),
        spp=sizes.spp,
        light_sets=sets,
        seed=seed,
        workers=count,
        overwrite=True,
    )
    progress(f"path tracing an image under light {sizes.image_light}, {sizes.image_spp} paths per pixel")
    truth, noise = trace_image(scene, sets[sizes.image_light], sizes, folder=folder / "image", seed=seed, workers=count)
    progress("tracing light onto surfaces, and surfaces into the geometry volume")
    traced = {m: _light_targets(scene, targets, sizes.fitted(m), "bounce1", sizes, seed) for m in _METHODS}

    grid = grid_for(scene, sizes.cells)
    models = {name: Lpv(grid, sizes.published(method)) for name, method in UNFITTED.items()}
    fits: dict[str, dict[str, Any]] = {}
    fit_identity = {"code": fit_code, "targets": targets.manifest["files"]}
    for plan in FITS:
        models[plan.name], fits[plan.name] = fit_once(
            plan,
            scene,
            traced[plan.method],
            sizes,
            folder=folder / "fits",
            identity=fit_identity,
            seed=seed,
            progress=progress,
        )
        fits[plan.name]["factors"] = models[plan.name].step_factors().tolist()

    progress(f"path tracing the true light in the cells, {sizes.floor_spp} paths each")
    floors, floor = judge_floor(
        traced["learned_9x26"], sizes, folder=folder / "targets" / "floor", seed=seed, workers=count
    )
    progress("judging and rendering")
    scores = _judge(models, traced) + floors
    direct = {m: _light_targets(scene, targets, sizes.published(m), "direct", sizes, seed) for m in _METHODS}
    scores += _judge({name: models[name] for name in UNFITTED}, direct)
    lit: dict[str, Illumination] = {method: lights[sizes.image_light].illumination for method, lights in traced.items()}
    views = render_views(lit, {name: models[name] for name in _IN_PICTURE}, sizes, truth, noise)
    values: dict[str, Any] = {
        "difflpv": difflpv.__version__,
        "command": f"difflpv demo --out {folder}{' --quick' if quick else ''} --seed {seed}",
        "folder": str(folder),
        "scene": SCENE,
        "quick": quick,
        "seed": seed,
        "settings": asdict(sizes),
        "train": sizes.train,
        "test": sizes.test,
        "targets": describe_targets(targets, sizes.train, sizes.test),
        "rows": mean_rows(scores, sizes.train, sizes.test),
        "scores": [score.to_json() for score in scores],
        "fits": fits,
        "floor": floor,
        "machine": describe_machine(),
        "resumed": any(path.stat().st_mtime < begun_at for path in _made(folder)),
        "identity": identity,
        "seconds": 0.0,
    }
    progress("timing every method on this machine")
    figures = {**_draw(values, views), "speed": draw_speed(scene, targets, sizes.image_light, seed=seed)}
    values["seconds"] = round(time.perf_counter() - begun, 1)
    _write(folder, values, figures)
    summary = DemoSummary.read(folder)
    progress(f"\n{summary.table}\n\nreport: {summary.report} ({values['seconds']:.0f} s)")
    return summary


def _made(folder: Path) -> list[Path]:
    """The last file of each costly part."""
    return [folder / "targets" / "manifest.json", *(folder / "fits" / plan.folder / "fitted.json" for plan in FITS)]


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _light_targets(
    scene: Scene, targets: Targets, config: LpvConfig, component: Component, sizes: DemoSettings, seed: int
) -> dict[int, LightTarget]:
    """Every light of the demo, traced and ready to solve."""
    return {
        k: light_target(
            scene,
            targets.lights[k].entries,
            grid_for(scene, sizes.cells),
            config,
            component,
            index=k,
            position=targets.receivers.position,
            normal=targets.receivers.normal,
            irradiance=targets.lights[k].irradiance[component],
            weight=targets.lights[k].area_weight,
            seed=seed,
        )
        for k in sizes.lights
    }


def _judge(models: Mapping[str, Lpv], lights: Mapping[Method, Mapping[int, LightTarget]]) -> list[Score]:
    """Scores in the order of the table, light by light."""
    scores: dict[tuple[str, int], Score] = {}
    for method, targets in lights.items():
        own = {name: lpv for name, lpv in models.items() if lpv.config.method == method}
        for k, target in targets.items():
            scores.update({(s.method, k): s for s in score_lights(target, own)})
    numbers = dict.fromkeys(k for _, k in scores)
    return [scores[name, k] for name in _IN_TABLE for k in numbers if (name, k) in scores]


def _draw(values: Mapping[str, Any], views: Views) -> dict[str, bytes]:
    """Figures as PNG files by name; "cornell" is the one for the README."""
    light = values["settings"]["image_light"]
    bounce = [s for s in values["scores"] if s["component"] == "bounce1"]
    errors = {s["method"]: s["relative_l2"] for s in bounce if s["light"] == light}
    captions = {name: f"relative error {errors[name]:.2f}" for name in views.predicted}
    constant = next(row["train"]["relative_l2"] for row in values["rows"] if row["method"] == "constant")
    titles = {name: "HOLPV as published" if name == "HOLPV" else name for name in _IN_README}
    few = {titles[name]: views.predicted[name] for name in _IN_README}
    few_captions = {titles[name]: captions[name] for name in _IN_README}
    return {
        "renders": draw_renders(views.truth, views.predicted, views.hit, captions),
        "convergence": draw_convergence(values["fits"], constant),
        "lights": draw_lights(bounce, values["train"], values["test"], values["targets"]["noise"]["bounce1"]["test"]),
        "factors": draw_factors({n: fit["factors"] for n, fit in values["fits"].items() if n.endswith("fitted")}),
        "cornell": draw_renders(views.truth, few, views.hit, few_captions, dpi=_README_DPI),
    }


def _write(folder: Path, values: dict[str, Any], figures: Mapping[str, bytes]) -> None:
    """Files, the summary last: where it lies, all others do."""
    (folder / "figures").mkdir(exist_ok=True)
    (folder / "summary.json").unlink(missing_ok=True)
    for name, png in figures.items():
        write_bytes(folder / "cornell.png" if name == "cornell" else folder / "figures" / f"{name}.png", png)
    write_text(folder / "report.html", build_page(values, figures))
    write_json(folder / "summary.json", values)
