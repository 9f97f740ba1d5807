"""Light that grows or dies out: the propagation factor, the number of steps, and gradients through many steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from difflpv.config import LpvConfig
from difflpv.loss import relative_l2
from difflpv.pipeline import Lpv
from difflpv.stress.measure import Bench, Lit, read
from difflpv.stress.results import Experiment, Limit, Reading, last_good
from difflpv.stress.scenes import bundled_case

__all__ = ["factor", "gradients", "steps"]

_STEPS = 64
_GRADIENT_FACTORS = (0.9, 1.0, 1.25)


def _beyond(reading: Reading) -> bool:
    return "beyond its critical value" in reading.message


def factor(bench: Bench) -> Experiment:
    """The propagation factor through its critical value, in both normalisations."""
    case = bundled_case("cornell", bench.settings, bench.folder)
    grid = case.grid.with_cells(bench.settings.cells)
    configs = {name: replace(c, steps=_STEPS) for name, c in bench.methods.items()}
    thesis = {f"{n}, thesis": replace(c, normalization="thesis") for n, c in configs.items() if n in ("lpv", "holpv")}
    readings, limits = [], []
    for name, config in {**configs, **thesis}.items():
        lit, critical = Lit.of(case, config, "bounce1", grid=grid, seed=bench.settings.seed), config.critical_factor
        own = [read(name, f, lit, config, values={"propagation": f * critical}) for f in bench.settings.factors]
        readings += own
        quiet, told = last_good(own, _beyond)
        at_one = min(own, key=lambda r: abs(r.knob - 1))
        worst = max((r for r in own if r.error is not None), key=lambda r: r.knob)
        if quiet is None or told is None:
            continue
        limits.append(
            Limit(
                name,
                "propagation factor",
                f"{critical:g} (silent at {quiet.knob * critical:g}, told at {told.knob * critical:g})",
                f"light grows with every step: at {worst.knob * critical:g}, {_STEPS} steps give {worst.energy:.2g} times the "
                f"true light, error {worst.error:.2g} (at {critical:g}: {at_one.error:.2f})",
                "warning with the growth; FloatingPointError once it overflows",
                f"keep the factor at or below {critical:g}",
            )
        )
    dark = {r.method: r for r in readings if r.method.endswith("thesis") and abs(r.knob - 0.25) < 1e-9}
    three = {r.method: r for r in readings if r.method.endswith("thesis") and abs(r.knob - 0.75) < 1e-9}
    finding = "The critical factor is where a uniform field keeps its light: 1, or 4 in the theses' normalisation."
    for name, r in dark.items():
        finding += f" {name}: the factor 1 of the publication keeps a quarter per step and brings {100 * (r.energy or 0):.0f} %"
        after = three.get(name)
        finding += f" of the light, the factor 3 of the octree thesis {100 * (after.energy or 0):.0f} %." if after else "."
    return Experiment(
        "factor",
        "Propagation factor through its critical value",
        "factor / critical factor",
        "",
        f"cornell, one bounce, {grid.resolution[0]}³ cells, {_STEPS} steps. Targets' noise {case.noise['bounce1']:.3f}.",
        tuple(readings),
        tuple(limits),
        finding,
    )


def steps(bench: Bench) -> Experiment:
    """From one step to many more than cross the scene."""
    case = bundled_case("cornell", bench.settings, bench.folder)
    grid = case.grid.with_cells(bench.settings.cells)
    low, high = case.scene.bounds
    span = int(np.ceil(float((high - low).max()) / grid.cell_size))
    readings, limits = [], []
    for name, config in bench.methods.items():
        lit = Lit.of(case, config, "bounce1", grid=grid, seed=bench.settings.seed)
        own = [read(name, n, lit, replace(config, steps=n)) for n in bench.settings.steps]
        readings += own
        settled = own[-1].error or np.nan
        enough = next((r for r in own if r.error is not None and abs(r.error - settled) < 0.02 + 0.05 * settled), own[-1])
        told, quiet = [r for r in own if "steps carry light" in r.message], [r for r in own if not r.message]
        limits.append(
            Limit(
                name,
                "steps",
                f"from {enough.knob:g} on the error has settled ({settled:.2f} at {own[-1].knob:g})",
                f"with one step, {100 * (own[0].energy or 0):.0f} % of the light arrives",
                f"warning below the {span} cells of the scene"
                + (f" (told at {told[-1].knob:g}, silent at {quiet[0].knob:g})" if told and quiet else ""),
                "as many steps as the scene spans cells; more do no harm at the critical factor",
            )
        )
    return Experiment(
        "steps",
        "Number of steps",
        "propagation steps",
        "",
        f"cornell, one bounce, {grid.resolution[0]}³ cells (the scene spans {span}), factor 1. "
        f"Targets' noise {case.noise['bounce1']:.3f}.",
        tuple(readings),
        tuple(limits),
        "At factor 1 the open sides of the grid take light away, so no method grows with the steps.",
        log_knob=True,
    )


def gradients(bench: Bench) -> Experiment:
    """The gradient by the factor of each step: does it vanish, does it explode, do checkpoints change it."""
    case = bundled_case("cornell", bench.settings, bench.folder)
    grid = case.grid.with_cells(max(8, bench.settings.cells // 2))
    counts = [n for n in bench.settings.steps if n >= 8]
    plain = {name: c for name, c in bench.methods.items() if c.occlusion == "none"}
    readings, limits = [], []
    for name, config in plain.items():
        lit = Lit.of(case, config, "bounce1", grid=grid, seed=bench.settings.seed)
        for p in _GRADIENT_FACTORS:
            own = [_through(f"{name} at {p:g}", n, lit, replace(config, steps=n), p) for n in counts]
            readings += own
            if p == 1.0:
                limits.append(_gradient_limit(name, own))
            elif p > 1:
                gone = [r for r in own if r.gradient is None]
                last = [r for r in own if r.gradient is not None][-1]
                limits.append(
                    Limit(
                        f"{name} at {p:g}",
                        "gradient over steps",
                        f"{last.knob:g} steps with a finite gradient of norm {last.gradient:.2g}"
                        + (f", overflow at {gone[0].knob:g}" if gone else ""),
                        "it grows with the light itself",
                        "warning; FloatingPointError where it overflows, a fit returns its best point and says so",
                        "keep the factor at or below its critical value, or start a fit there",
                    )
                )
    worst = max((r.error or 0.0) for r in readings)
    return Experiment(
        "gradients",
        "Gradients through many steps",
        "propagation steps",
        "",
        f"cornell, one bounce, {grid.resolution[0]}³ cells, at {', '.join(f'{p:g}' for p in _GRADIENT_FACTORS)} times the "
        "critical factor. The gradient is that of the relative L2 error by the factor of each step; the error is the relative "
        "difference between checkpointing every second volume and storing all.",
        tuple(readings),
        tuple(limits),
        f"Checkpointing changes the gradient by {worst:.1g} of its norm at most"
        + (": the same bits." if worst == 0 else ": rounding of float32."),
        log_knob=True,
        error_label="checkpointed against stored",
        energy_label="last step's part / first step's",
        gradient_label="norm of d error / d p by step",
    )


def _through(name: str, count: int, lit: Lit, config: LpvConfig, p: float) -> Reading:
    case = lit.case
    receivers = lit.light.receivers(case.position, case.normal)
    truth, weight = torch.as_tensor(case.truth[lit.component]), torch.as_tensor(case.weight)
    found = []
    for every in (1, 2):
        factors = torch.full((count,), p, dtype=torch.float64, requires_grad=True)
        try:
            irradiance = Lpv(lit.light.grid, config, checkpoint_every=every)(
                lit.light, receivers, {"propagation_steps": factors}
            )
        except FloatingPointError as problem:
            return Reading(name, count, message=f"FloatingPointError: {problem}")
        found.append(torch.autograd.grad(relative_l2(irradiance.double(), truth, weight), factors)[0])
    stored, checkpointed = found
    norm = float(stored.norm())
    change = float((stored - checkpointed).norm()) / norm if norm > 0 else 0.0
    return Reading(name, count, change, norm, abs(float(stored[-1])) / max(abs(float(stored[0])), 1e-300))


def _gradient_limit(name: str, own: list[Reading]) -> Limit:
    vanished, before = next((r for r in own if (r.energy or 0) < 1e-6), None), own[-1]
    where = f"the last of {vanished.knob:g} steps has less than a millionth of the first's part" if vanished else (
        f"at {before.knob:g} steps the last still has {before.energy:.1g} of the first's part"
    )
    return Limit(
        name,
        "gradient over steps",
        where,
        "late steps cannot be learned: the light has left the grid",
        "not an error: the whole gradient stays finite and of the same norm",
        "no more steps than the scene spans cells",
    )
