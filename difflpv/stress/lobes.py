"""Negative lobes and the clamp; white rooms, where one bounce is little."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from difflpv.pipeline import Lpv
from difflpv.simulate import solve_irradiance
from difflpv.stress.measure import Bench, Lit, read
from difflpv.stress.results import Experiment, Limit, Reading, last_good
from difflpv.stress.scenes import Case, bundled_case, room_scene, traced_case

__all__ = ["albedo", "clamp"]

_ALBEDOS = (0.1, 0.3, 0.5, 0.7, 0.85, 0.89, 0.91, 0.95, 0.99)


def clamp(bench: Bench) -> Experiment:
    """How much negative light the lobes make, with the clamp and without."""
    case = bundled_case("cornell", bench.settings, bench.folder)
    grid = case.grid.with_cells(bench.settings.cells)
    configs = {}
    for name, config in bench.methods.items():
        configs[name] = config
        if config.clamp:
            configs[f"{name}, no clamp"] = replace(config, clamp=False)
    counts = [n for n in bench.settings.steps if n <= 64]
    readings, limits = [], []
    for name, config in configs.items():
        lit = Lit.of(case, config, "direct", grid=grid, seed=bench.settings.seed)
        own = []
        for n in counts:
            own.append(_negative(name, n, lit, Lpv(grid, replace(config, steps=n))))
        readings += own
        told = [r for r in own if "irradiance is negative" in r.message]
        worst = max(own, key=lambda r: r.error or 0)
        limits.append(
            Limit(
                name,
                "negative lobes",
                f"at most {100 * (worst.error or 0):.1f} % of the light is negative (at {worst.knob:g} steps), "
                f"{100 * (own[-1].error or 0):.2g} % after {own[-1].knob:g}",
                f"mean irradiance {own[-1].energy:.2f} times the truth in the end",
                f"warning above 5 % ({len(told)} of {len(own)} settings here)",
                "none needed" if not told else "more steps" + (", or the clamp" if "no clamp" in name else ""),
            )
        )
    return Experiment(
        "clamp",
        "Negative lobes and the clamp",
        "propagation steps",
        "",
        f"cornell, direct light of its panel, {grid.resolution[0]}³ cells. The error is the negative part of the absolute "
        "irradiance; the gradient that of the relative L2 error.",
        tuple(readings),
        tuple(limits),
        _clamp_finding(readings),
        log_knob=True,
        error_label="negative share of irradiance",
    )


def _negative(name: str, n: int, lit: Lit, lpv: Lpv) -> Reading:
    reading = read(name, n, lit, lpv.config)
    found = solve_irradiance(lpv, lit.light, lit.case.position, lit.case.normal).irradiance * lit.case.weight[:, None]
    return replace(reading, error=float(np.maximum(-found, 0).sum() / max(np.abs(found).sum(), 1e-300)))


def _clamp_finding(readings: list[Reading]) -> str:
    last = {r.method: r for r in readings}
    added = {
        name: last[name].energy / last[f"{name}, no clamp"].energy - 1  # type: ignore[operator]
        for name in last
        if f"{name}, no clamp" in last
    }
    parts = ", ".join(f"{100 * share:.0f} % for {name}" for name, share in added.items())
    return (
        "The clamp keeps light positive and pays with energy: it cuts off the negative half of every lobe's ripple and so adds "
        f"mean irradiance, {parts}. A stencil without it stays linear and shows a little negative light."
    )


def albedo(bench: Bench) -> Experiment:
    """A closed room from dark to white: the bounce that is carried against all reflected light."""
    readings, limits, noise = [], [], 0.0
    cases: dict[float, Case] = {}
    few = replace(bench.settings, receivers=min(bench.settings.receivers, 100))
    for value in _ALBEDOS:
        scene = room_scene(albedo=value, cells=bench.settings.cells, name=f"room-albedo-{value:g}")
        cases[value] = traced_case(scene, few, bench.folder, ("bounce1", "full_indirect"))
        noise = max(noise, cases[value].noise["full_indirect"])
    for name, config in bench.methods.items():
        own = []
        for value, case in cases.items():
            lit = Lit.of(case, config, "bounce1", seed=bench.settings.seed)
            whole = replace(case, truth={"bounce1": case.truth["full_indirect"]})
            own.append(read(name, value, replace(lit, case=whole), replace(config, steps=bench.settings.cells)))
        readings += own
        quiet, beyond = last_good(own, lambda r: "the mean albedo is" in r.message)
        if quiet is not None and beyond is not None:
            limits.append(
                Limit(
                    name,
                    "albedo of a closed room",
                    f"one bounce (error {own[0].error:.2f} at {own[0].knob:g}, {own[-1].error:.2f} at {own[-1].knob:g})",
                    f"at {own[-1].knob:g} the solve holds {100 * (own[-1].energy or 0):.1f} % of the reflected light",
                    f"warning above a mean of 0.9 (silent at {quiet.knob:g}, told at {beyond.knob:g})",
                    "none: further bounces are outside of this solve; judge it against 'bounce1'",
                )
            )
    share = {a: float(c.truth["bounce1"].sum() / c.truth["full_indirect"].sum()) for a, c in cases.items()}
    shares = ", ".join(f"{100 * share[a]:.1f} % at {a:g}" for a in (0.5, 0.85, 0.99))
    return Experiment(
        "albedo",
        "Albedo near 1 in a closed room",
        "albedo",
        "",
        f"A closed cube of 4 m, {bench.settings.cells}³ cells; the truth is all reflected light (1 to 64 bounces), its noise "
        f"at most {noise:.3f}.",
        tuple(readings),
        tuple(limits),
        f"The first bounce is {shares} of all reflected light by path tracing; the solves follow that share, and nothing "
        "grows: the volume carries one bounce, whatever the albedo.",
        energy_label="mean irradiance / all reflected light",
    )
