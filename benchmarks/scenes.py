"""Every method on every bundled scene, against path-traced truth: ``python benchmarks/scenes.py`` writes docs/scenes.md.

    python benchmarks/scenes.py [--scenes cornell two_rooms_90 ...] [--out out/benchmarks/scenes]

Targets, and the true light in the cells, are made once (2,000 receivers, 2,048 paths each; 1,024 a cell) and found again by
the next run. Nothing but the rows "fitted" is fitted to a scene, and these are judged on other lights or receivers. Also
timed and written: building the traced transmittance, beside one solve, and the leak, self-lighting and blocked share of
every occlusion model (``difflpv.leakage``).
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from data_gen.cells import kept_volume
from data_gen.targets import make_targets
from difflpv.config import LpvConfig, grid_for
from difflpv.evaluate import predict_constant, relative_noise, score
from difflpv.fit import LightTarget, fit, light_target
from difflpv.illumination import illuminate
from difflpv.io import load_scene
from difflpv.io.atomic import write_text
from difflpv.leakage import blocked_share, dark_receivers, leak, self_lighting
from difflpv.lights import apply_light_set, load_light_sets
from difflpv.pipeline import Lpv
from difflpv.raycast import Raycaster
from difflpv.scene import Scene
from difflpv.simulate import read_volume, simulate, solve_irradiance
from difflpv.stencil import pair_offsets
from difflpv.traced import pair_transmittance

ROOT = Path(__file__).resolve().parents[1]
SCENES = {
    "cornell": ("direct", "bounce1"),
    "two_rooms_90": ("direct", "bounce1"),
    "atrium": ("bounce1",),
    "planter": ("bounce1",),
    "bunny": ("bounce1",),
}  # floor repeats the hall of planter, diagonal is an open floor: ``difflpv bench`` has all seven
LIGHT_SETS = ("cornell", "two_rooms_90")
TRAIN = (0, 1, 2, 3, 4)
FIT_BUDGET = 30.0  # forward-equivalents


@dataclass(frozen=True)
class Row:
    """One line of the table; a grid of None is the scene's own."""

    name: str
    config: LpvConfig
    cells: int | None = None


ROWS = (
    Row("LPV as published", LpvConfig(method="lpv")),
    Row("HOLPV as published", LpvConfig(method="holpv")),
    Row("HOLPV, geometry volume (clamp)", LpvConfig(method="holpv", occlusion="clamp")),
    Row("HOLPV, damped lookup (thesis 3.2.4)", LpvConfig(method="holpv", lookup="damped")),
    Row("HOLPV, traced, affine lookup", LpvConfig(method="holpv", occlusion="traced", lookup="affine", deposit="visible")),
    Row(
        "learned_9x26, nothing blocks",
        LpvConfig(method="learned_9x26", occlusion="none", lookup="trilinear", deposit="nearest"),
    ),
    Row("learned_9x26, geometry volume (exp)", LpvConfig(method="learned_9x26", occlusion="exp")),
    Row("learned_9x26, traced, trilinear lookup", LpvConfig(method="learned_9x26", lookup="trilinear")),
    Row("learned_9x26, traced, front lookup", LpvConfig(method="learned_9x26", lookup="front")),
    Row("learned_9x26, traced, visible lookup", LpvConfig(method="learned_9x26", lookup="visible")),
    Row("**learned_9x26**", LpvConfig(method="learned_9x26")),
    Row("learned_4x6", LpvConfig(method="learned_4x6")),
    Row("learned_9x6", LpvConfig(method="learned_9x6")),
    Row("learned_4x26", LpvConfig(method="learned_4x26")),
    Row("learned_16x26", LpvConfig(method="learned_16x26")),
    Row("learned_9x26, two cell sizes (10 + 22 steps)", LpvConfig(method="learned_9x26", coarsen_after=10)),
    Row("learned_9x26, 16 cells", LpvConfig(method="learned_9x26"), 16),
    Row("learned_9x26, 64 cells, 32 steps", LpvConfig(method="learned_9x26"), 64),
    Row("learned_9x26, 64 cells, two sizes (6 + 26 steps)", LpvConfig(method="learned_9x26", coarsen_after=6), 64),
)


@dataclass(frozen=True)
class FitRow:
    """A fit: who learns what."""

    name: str
    config: LpvConfig
    learn: tuple[str, ...]
    solver: str


CLASSIC = ("propagation", "occlusion", "sampling_bias", "injection_bias")
FIT_ROWS = (
    *(
        FitRow(
            f"{method.upper()} fitted ({title}, 4 numbers)",
            LpvConfig(method=method, occlusion="exp", deposit="trilinear"),  # type: ignore[arg-type]
            CLASSIC,
            solver,
        )
        for method in ("lpv", "holpv")
        for title, solver in (("L-BFGS", "lbfgs"), ("NLopt BOBYQA", "nlopt-bobyqa"))
    ),
    FitRow(
        "learned_9x26 fitted (L-BFGS: stencil, lookup gains)",
        LpvConfig(method="learned_9x26"),
        ("stencil", "lookup_gains"),
        "lbfgs",
    ),
)
LEAKS = (
    *((method, occlusion) for method in ("lpv", "holpv") for occlusion in ("none", "clamp", "exp", "traced")),
    ("learned_9x6", "traced"),
    *(("learned_9x26", occlusion) for occlusion in ("none", "exp", "traced")),
)


def cell(found: np.ndarray, truth: np.ndarray, weight: np.ndarray, dark: np.ndarray | None) -> str:
    s = score(found, truth, weight, method="", component="", light=0)
    text = f"{s.relative_l2:.3f} / {s.scaled_l2:.3f} ({s.scale:.2f})"
    return text if dark is None else f"{text}, {leak(found, truth, dark, weight):.3f}"


def table_of(scene: Scene, components: tuple[str, ...], folder: Path) -> list[str]:
    targets = make_targets(scene, folder, receiver_count=2000, components=("direct", "bounce1"), spp=2048, progress=False)
    light, receivers = targets.lights[0], targets.receivers
    inside = grid_for(scene).contains(receivers.position)
    x, n, weight = receivers.position[inside], receivers.normal[inside], light.area_weight[inside]
    dark = dark_receivers(scene.name, x)
    truths = {c: light.irradiance[c][inside] for c in components}
    noise = [relative_noise(light.standard_error[c][inside], truths[c], weight) for c in components]
    grid = grid_for(scene)
    size = " x ".join(map(str, grid.resolution))
    lines = [
        f"## {scene.name}",
        "",
        f"{size} cells of {grid.cell_size:.4g} m; {inside.sum()} of {len(inside)} receivers lie in the grid; the truth's own "
        f"noise is {', '.join(f'{v:.3f} ({c})' for v, c in zip(noise, components, strict=True))}.",
        "",
        "| method | " + " | ".join(components) + " | seconds |",
        "|---|" + "---|" * (len(components) + 1),
    ]
    constant = [cell(predict_constant(t, weight), t, weight, dark) for t in truths.values()]
    lines.append("| constant | " + " | ".join(constant) + " | |")
    for row in ROWS:
        cells, begin = [], time.process_time()
        for component in components:
            found = simulate(scene, x, n, grid=grid_for(scene, row.cells), config=row.config, component=component)  # type: ignore[arg-type]
            cells.append(cell(found.irradiance, truths[component], weight, dark))
        seconds = (time.process_time() - begin) / len(components)
        lines.append(f"| {row.name} | " + " | ".join(cells) + f" | {seconds:.1f} |")
        print(lines[-1], flush=True)
    for plan in FIT_ROWS:
        cells = []
        for component in components:
            if scene.name in LIGHT_SETS:
                found = fitted_on_other_lights(scene, component, plan, folder / "light_sets", x, n)
            else:
                found = fitted_on_other_receivers(scene, component, plan, x, n, truths[component], weight)
            cells.append(cell(found, truths[component], weight, dark))
        lines.append(f"| {plan.name} | " + " | ".join(cells) + " | |")
        print(lines[-1], flush=True)
    volumes, floor_noise = {c: kept_volume(folder / "floor", scene, grid, c) for c in components}, {}
    for lookup in ("trilinear", "visible", "affine"):
        cells = []
        for component in components:
            config = LpvConfig(method="holpv", lookup=lookup)  # type: ignore[arg-type]
            traced = illuminate(scene, grid, config, component)  # type: ignore[arg-type]
            found, half = (
                read_volume(v, traced, x, n) for v in (volumes[component].mean, volumes[component].halves[0])
            )
            cells.append(cell(found, truths[component], weight, dark))
            floor_noise[component] = relative_noise(half - found, truths[component], weight)
        lines.append(f"| *floor: true SH in the cells, {lookup} lookup* | " + " | ".join(cells) + " | |")
        print(lines[-1], flush=True)
    told = ", ".join(f"{value:.3f} ({component})" for component, value in floor_noise.items())
    return [*lines, "", f"The floor's own noise (affine lookup): {told}.", ""]


def fitted_on_other_lights(
    scene: Scene, component: str, plan: FitRow, folder: Path, x: np.ndarray, n: np.ndarray
) -> np.ndarray:
    """Irradiance under the scene's own light by what was fitted on its light sets."""
    sets = load_light_sets(None, scene.name)[: max(TRAIN) + 1]
    targets = make_targets(
        scene, folder, receiver_count=1000, components=("direct", "bounce1"), spp=512, light_sets=sets, progress=False
    )
    grid = grid_for(scene)
    inside = grid.contains(targets.receivers.position)
    learned_on = [
        light_target(
            scene, sets[k], grid, plan.config, component, index=k, position=targets.receivers.position[inside],  # type: ignore[arg-type]
            normal=targets.receivers.normal[inside], irradiance=targets.lights[k].irradiance[component][inside],
            weight=targets.lights[k].area_weight[inside],
        )
        for k in TRAIN
    ]  # fmt: skip
    assert all(apply_light_set(scene, entries).hash != scene.hash for entries in sets)
    lpv = fitted(scene, plan, learned_on)
    own = illuminate(scene, grid, plan.config, component)  # type: ignore[arg-type]
    return solve_irradiance(lpv, own, x, n).irradiance


def fitted_on_other_receivers(
    scene: Scene, component: str, plan: FitRow, x: np.ndarray, n: np.ndarray, truth: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    """Irradiance of each half of the receivers by what was fitted on the other half."""
    first = np.random.default_rng(0).permutation(len(x)) < len(x) // 2
    found = np.zeros_like(truth)
    for half in (first, ~first):
        target = light_target(
            scene, None, grid_for(scene), plan.config, component, index=0, position=x[half], normal=n[half],  # type: ignore[arg-type]
            irradiance=truth[half], weight=weight[half],
        )  # fmt: skip
        lpv = fitted(scene, plan, [target])
        found[~half] = solve_irradiance(lpv, target.illumination, x[~half], n[~half]).irradiance
    return found


def fitted(scene: Scene, plan: FitRow, targets: list[LightTarget]) -> Lpv:
    numbers = [target.index for target in targets]
    outcome = fit(
        scene, targets, config=plan.config, learn=plan.learn, train=numbers, test=(), solver=plan.solver, budget=FIT_BUDGET
    )
    return outcome.lpv


def transmittance_build() -> list[str]:
    scene = load_scene("atrium")
    grid, pairs = grid_for(scene, 64), pair_offsets(LpvConfig(method="learned_9x26").stencil.offsets)
    caster, begin = Raycaster(scene), time.perf_counter()
    passed = pair_transmittance(caster, scene.triangle_vertices, grid, pairs)
    seconds = time.perf_counter() - begin
    return [
        "## Building the traced transmittance",
        "",
        f"atrium, {caster.triangle_count} triangles, {' x '.join(map(str, grid.resolution))} cells, 13 pairs a cell, 8",
        f"segments a pair: {seconds:.1f} s in one process; {100 * float((passed < 1).mean()):.1f} % of the pairs are blocked.",
        "",
    ]


def leaks() -> list[str]:
    lines = [
        "## Light where there should be none",
        "",
        "Self-lighting: irradiance that a lone lit plane throws on itself over its exitance. Blocked share: direct light",
        "behind a closed wall over that without it, for walls of three thicknesses in cells. All are 0 in truth; means over",
        "eight positions of the geometry against the cells.",
        "",
        "| method | occlusion | self-lighting | wall of 1 cell | 1/2 | 1/10 |",
        "|---|---|---|---|---|---|",
    ]
    for method, occlusion in LEAKS:
        config = LpvConfig(method=method, occlusion=occlusion)  # type: ignore[arg-type]
        shares = [blocked_share(config, thickness=t) for t in (1.0, 0.5, 0.1)]
        found = " | ".join(f"{value:.3f}" for value in (self_lighting(config), *shares))
        lines.append(f"| {method} | {occlusion} | {found} |")
        print(lines[-1], flush=True)
    return [*lines, ""]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "benchmarks" / "scenes")
    parser.add_argument("--markdown", type=Path, default=ROOT / "docs" / "scenes.md")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    lines = [
        "# Methods on the bundled scenes: fitted to none, and fitted",
        "",
        "Written by `python benchmarks/scenes.py`; do not edit. Each entry: area-weighted relative L2 error of irradiance,",
        "raw / at the best single scale (that scale); for two_rooms_90 also the leak, the mean error in the far room over the",
        "mean of the lit one. 32 steps, p = 1, unless said otherwise. *Floor*: the true radiance SH of degree 2 in every cell,",
        "path-traced, read by the same lookup: what a perfect propagation could do (`--method floor`). Seconds: processor",
        "time of one solve with all its rays, one thread.",
        "",
        "Only the rows *fitted* have seen their scene, and none of them what it is judged on: in cornell and two_rooms_90 they",
        f"were fitted under light sets {min(TRAIN)} to {max(TRAIN)} and are judged, as all rows, under the scene's own light; "
        "elsewhere on half of the",
        f"receivers and judged on the other half, both ways round. Each fit may spend {FIT_BUDGET:g} solves of all its lights, "
        "with",
        "gradients (a gradient counts as three) or without. Four numbers: propagation factor, occlusion strength (geometry",
        "volume, exp), sampling and injection bias. Published kernels as fitted deposit trilinearly.",
        "",
        "A learned method's defaults: traced occlusion, VPLs given to the cells they see, affine lookup.",
        "",
    ]
    for name in arguments.scenes:
        print(f"== {name}", flush=True)
        lines += table_of(load_scene(name), SCENES[name], arguments.out / name)
    lines += leaks() + transmittance_build()
    write_text(arguments.markdown, "\n".join(lines))


if __name__ == "__main__":
    main()
