"""Units and magnitudes: scenes in millimetres and kilometres, radiance over many decades, float32 against float64."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from difflpv.config import LpvConfig
from difflpv.pipeline import Lpv
from difflpv.scene import AreaLight
from difflpv.stress.measure import Bench, Lit
from difflpv.stress.results import Experiment, Limit, Reading
from difflpv.stress.scenes import Case, bundled_case, scaled
from difflpv.trouble import describe_trouble

__all__ = ["length", "radiance"]

_LENGTHS = (1e-6, 2e-6, 1e-3, 1e-2, 1.0, 1e2, 1e3, 1e6, 1.5e8, 1e9)
_RADIANCES = (1e-44, 1e-40, 1e-36, 1e-30, 1e-6, 1e-3, 1.0, 1e3, 1e6, 1e30, 1e36, 1e38)
_OFF = 1e-3
_SURFACE_SAMPLES = 2048


def length(bench: Bench) -> Experiment:
    """The same scene in other units of length."""
    case = bundled_case("cornell", bench.settings, bench.folder)
    case = replace(case, scene=replace(case.scene, grid=case.grid.with_cells(bench.settings.cells)))
    return _experiment(
        bench,
        "length",
        "Units of length",
        "factor on all lengths",
        _LENGTHS,
        lambda f: (scaled(case, f), 1.0),
        "cornell, one bounce. Irradiance under area lights does not depend on the unit of length.",
        "use metres",
    )


def radiance(bench: Bench) -> Experiment:
    """The same scene under brighter and dimmer lights."""
    case = bundled_case("cornell", bench.settings, bench.folder)
    case = replace(case, scene=replace(case.scene, grid=case.grid.with_cells(bench.settings.cells)))

    def lit(f: float) -> tuple[Case, float]:
        lights = [replace(v, radiance=f * v.radiance) for v in case.scene.lights if isinstance(v, AreaLight)]
        return replace(case, scene=case.scene.with_lights(lights)), f

    return _experiment(
        bench,
        "radiance",
        "Radiance",
        "factor on the radiance",
        _RADIANCES,
        lit,
        "cornell, one bounce. Irradiance is proportional to the radiance.",
        "scale the lights to about 1 and the result back",
    )


def _experiment(
    bench: Bench,
    name: str,
    title: str,
    knob: str,
    factors: Sequence[float],
    make: Callable[[float], tuple[Case, float]],
    setup: str,
    cure: str,
) -> Experiment:
    readings, limits = [], []
    for dtype in (torch.float32, torch.float64):
        kind = str(dtype).removeprefix("torch.")
        for method, config in bench.methods.items():
            config, label = replace(config, steps=bench.settings.cells), f"{method}, {kind}"
            reference = _solved(make(1.0), config, dtype)[0]
            assert reference is not None
            own = []
            for f in factors:
                found, gradient, message = _solved(make(f), config, dtype)
                if found is None:
                    own.append(Reading(label, f, message=message))
                    continue
                change = float(np.linalg.norm(found - reference) / np.linalg.norm(reference))
                own.append(Reading(label, f, change, gradient, float(found.mean() / reference.mean()), message))
            readings += own
        limits.append(_limit(f"all, {kind}", knob, _worst([r for r in readings if r.method.endswith(kind)]), cure))
    return Experiment(
        name,
        title,
        knob,
        "",
        f"{setup} {bench.settings.cells}³ cells, {bench.settings.cells} steps. The error is the relative L2 difference from "
        "the solve at factor 1, scaled back; the gradient that of the mean irradiance by the propagation factor over the mean.",
        tuple(readings),
        tuple(limits),
        log_knob=True,
        error_label="difference from factor 1",
        energy_label="mean irradiance / that at factor 1",
        gradient_label="|d mean / d p| / mean",
    )


def _solved(made: tuple[Case, float], config: LpvConfig, dtype: torch.dtype) -> tuple[np.ndarray | None, float, str]:
    """Irradiance [n,3] over the unit, the relative gradient of its mean by the factor, and what the library said."""
    case, unit = made
    try:
        lit = Lit.of(case, config, "bounce1", dtype=dtype, surface_samples=_SURFACE_SAMPLES)
        lpv = Lpv(lit.light.grid, config)
        p = torch.ones((), dtype=torch.float64, requires_grad=True)
        irradiance = lpv(lit.light, lit.light.receivers(case.position, case.normal), {"propagation": p})
        total = (irradiance.double() / unit).mean()
        slope = float(torch.autograd.grad(total, p)[0])
    except (FloatingPointError, ValueError) as problem:
        return None, np.nan, f"{type(problem).__name__}: {problem}"
    found = irradiance.detach().double().numpy()
    message = "\n".join(describe_trouble(lpv, lit.light, case.position, case.normal, found))
    mean = float(total.detach())
    return found / unit, abs(slope) / abs(mean) if mean else np.nan, message


def _worst(readings: list[Reading]) -> list[Reading]:
    """The reading of the worst method at each setting; one without a result is the worst of all."""
    knobs = dict.fromkeys(r.knob for r in readings)
    return [max((r for r in readings if r.knob == k), key=lambda r: np.inf if r.error is None else r.error) for k in knobs]


def _limit(label: str, knob: str, own: list[Reading], cure: str) -> Limit:
    good = [r for r in own if r.error is not None and r.error < _OFF]
    silent = [r for r in own if r.error is not None and r.error >= _OFF and not r.message]
    said = [r for r in own if r.message]
    worst = max(good, key=lambda r: r.error or 0.0)
    off = [f"at {r.knob:g} " + (f"{100 * r.error:.2g} % off" if r.error else "no result") for r in own if r not in good]
    return Limit(
        label,
        knob,
        f"every method right from {good[0].knob:g} to {good[-1].knob:g} (difference at most {worst.error:.1g})",
        "; ".join(off) or "not reached",
        (f"told at {', '.join(f'{r.knob:g}' for r in said)}" if said else "nothing to tell")
        + (f"; silent at {', '.join(f'{r.knob:g}' for r in silent)}" if silent else ""),
        cure if len(good) < len(own) else "none needed",
    )
