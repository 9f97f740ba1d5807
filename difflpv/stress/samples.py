"""Fewer and fewer light samples: from many per cell to one for many cells."""

from __future__ import annotations

from dataclasses import replace

from difflpv.stress.measure import Bench, Lit, read
from difflpv.stress.results import Experiment, Limit, last_good
from difflpv.stress.scenes import bundled_case

__all__ = ["samples"]

_FACES_PER_SAMPLE = (0.1, 0.5, 1.0, 2.0, 3.5, 4.5, 8.0, 16.0, 32.0)


def samples(bench: Bench) -> Experiment:
    """The number of surface samples that carry the bounce and block light."""
    case = bundled_case("cornell", bench.settings, bench.folder)
    grid = case.grid.with_cells(2 * bench.settings.cells)
    area, readings, limits = float(case.scene.triangle_areas.sum()), [], []
    for name, config in bench.methods.items():
        config, own = replace(config, steps=2 * bench.settings.cells), []
        for faces in _FACES_PER_SAMPLE:
            count = max(8, round(area / (faces * grid.cell_size**2)))
            lit = Lit.of(case, config, "bounce1", grid=grid, seed=bench.settings.seed, surface_samples=count)
            own.append(read(name, faces, lit, config))
        readings += own
        quiet, told = last_good(own, lambda r: "VPLs are few" in r.message)
        if quiet is not None and told is not None:
            limits.append(
                Limit(
                    name,
                    "cell faces per light sample",
                    f"error {own[0].error:.2f} at {own[0].knob:g}, {quiet.error:.2f} at {quiet.knob:g}",
                    f"{told.error:.2f} at {told.knob:g}, {own[-1].error:.2f} at {own[-1].knob:g}",
                    f"warning above 4 (silent at {quiet.knob:g}, told at {told.knob:g})",
                    "more surface_samples and area_samples in illuminate, or larger cells",
                )
            )
    first = {r.method: r.error or 0.0 for r in reversed(readings)}
    changes = {r: abs((r.error or 0.0) - first[r.method]) for r in readings}
    change = max(c for r, c in changes.items() if "VPLs are few" not in r.message)
    beyond = max(c for r, c in changes.items() if "VPLs are few" in r.message)
    return Experiment(
        "samples",
        "Too few VPLs",
        "cell faces per light sample",
        "",
        f"cornell, one bounce, {grid.resolution[0]}³ cells. Targets' noise {case.noise['bounce1']:.3f}.",
        tuple(readings),
        tuple(limits),
        f"Largest change of the error while nothing is said: {change:.2f}; beyond the warning: {beyond:.2f}.",
        log_knob=True,
    )
