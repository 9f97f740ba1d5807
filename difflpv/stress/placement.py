"""Where a thing lies within its cell: a light moved through one cell, a scene turned in its grid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from difflpv.config import LpvConfig
from difflpv.loss import relative_l2
from difflpv.pipeline import Lpv
from difflpv.stress.measure import Bench, Lit, read
from difflpv.stress.results import Experiment, Limit, Reading
from difflpv.stress.scenes import bundled_case, room_scene, rotated, traced_case

__all__ = ["rotation", "translation"]


def _deposits(bench: Bench) -> dict[str, LpvConfig]:
    """Each method without occlusion, as published (nearest) and with a trilinear deposit."""
    configs = {}
    for name, config in bench.methods.items():
        if config.occlusion == "none":
            configs[f"{name}, nearest"] = replace(config, deposit="nearest")
            configs[f"{name}, trilinear"] = replace(config, deposit="trilinear")
    return configs


def translation(bench: Bench) -> Experiment:
    """A small light on its way through one cell."""
    cells = bench.settings.cells
    size = 4.0 / (cells - 4)
    # Off the lattice, half a cell below a cell's floor after the injection bias, so that one border lies on the way.
    scene = room_scene(cells=cells, lamp=(0.3 * size, 2.6, 0.3 * size), lamp_edge=0.02 * size, name="room-small-lamp")
    case = traced_case(scene, bench.settings, bench.folder, ("direct",))
    shifts = np.linspace(0, 1, bench.settings.moves + 1)
    readings, limits = [], []
    for name, config in _deposits(bench).items():
        lit = Lit.of(case, replace(config, steps=cells), "direct", seed=bench.settings.seed)
        own = _moved(name, lit, replace(config, steps=cells), shifts, size)
        readings += own
        changes = np.array([r.error or 0.0 for r in own[1:]])
        trilinear = config.deposit == "trilinear"
        limits.append(
            Limit(
                name,
                "sub-cell position",
                f"largest change over 1/{bench.settings.moves} cell {100 * changes.max():.1f} % of the irradiance, median "
                f"{100 * np.median(changes):.2f} %",
                "smooth, with a kink where the light crosses a cell's centre" if trilinear else "one jump, flat elsewhere",
                "gradient everywhere" if trilinear else "learning a position is refused: ValueError, needs deposit='trilinear'",
                "none needed" if trilinear else "deposit='trilinear'",
            )
        )
    return Experiment(
        "translation",
        "A light moved through one cell",
        "shift",
        "cells",
        f"A closed cube, direct light of a panel of a fiftieth of a cell, {cells}³ cells, {bench.settings.moves} moves. The "
        "error is the change of the irradiance since the move before, relative L2; the gradient that of the mean irradiance by "
        f"the shift. Targets' noise {case.noise['direct']:.3f} (mean at shift 0).",
        tuple(readings),
        tuple(limits),
        "A nearest deposit moves light in whole cells: no change, then all at once, and never a gradient.",
        error_label="change since the move before",
        gradient_label="|d mean / d shift| / mean",
    )


def _moved(name: str, lit: Lit, config: LpvConfig, shifts: np.ndarray, size: float) -> list[Reading]:
    lpv, case = Lpv(lit.light.grid, config), lit.case
    receivers = lit.light.receivers(case.position, case.normal)
    weight = torch.as_tensor(case.weight)[:, None]
    truth = float((weight * torch.as_tensor(case.truth["direct"])).sum())
    readings: list[Reading] = []
    before: torch.Tensor | None = None
    for shift in shifts:
        along = torch.tensor(float(shift), dtype=torch.float64, requires_grad=True)
        position = (along * size * torch.tensor([1.0, 0, 0], dtype=torch.float64))[None]
        irradiance = lpv(lit.light, receivers, {"light_position": position}).double()
        total = (weight * irradiance).sum()
        slope = torch.autograd.grad(total, along, allow_unused=True)[0] if total.requires_grad else None
        now = irradiance.detach()
        change = None if before is None else float(relative_l2(now, before, weight[:, 0]))
        mean = float(total.detach())
        readings.append(Reading(name, float(shift), change, 0.0 if slope is None else abs(float(slope) / mean), mean / truth))
        before = now
    return readings


def rotation(bench: Bench) -> Experiment:
    """The scene turned in its grid by 0 to 45 degrees."""
    case = bundled_case("cornell", bench.settings, bench.folder)
    cells, readings, limits = bench.settings.cells, [], []
    for name, config in {**_deposits(bench), **{n: c for n, c in bench.methods.items() if c.occlusion != "none"}}.items():
        own = []
        for angle in bench.settings.angles:
            turned = rotated(case, angle, cells)
            lit = Lit.of(turned, config, "bounce1", seed=bench.settings.seed)
            own.append(read(name, angle, lit, replace(config, steps=cells)))
        readings += own
        errors = np.array([r.error or np.nan for r in own])
        energies = np.array([r.energy or np.nan for r in own])
        limits.append(
            Limit(
                name,
                "rotation of the grid",
                f"error {errors.min():.2f} to {errors.max():.2f}, worst at {own[int(errors.argmax())].knob:g}°",
                f"mean irradiance changes by {100 * (energies.max() / energies.min() - 1):.0f} % over the turn",
                "not detected: needs a truth",
                "align the grid with the walls, or fit at the angle that is used",
            )
        )
    return Experiment(
        "rotation",
        "Rotation of the grid",
        "angle",
        "degrees",
        f"cornell turned about its vertical axis in a grid of {cells}³ cells that holds it at every angle, one bounce. "
        f"Targets' noise {case.noise['bounce1']:.3f}.",
        tuple(readings),
        tuple(limits),
    )
