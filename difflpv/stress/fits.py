"""Fits that start beyond the critical factor, or are pushed over it by a large learning rate."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from difflpv.config import LpvConfig
from difflpv.fit import LightTarget, fit
from difflpv.pipeline import Lpv
from difflpv.stress.measure import Bench, Lit
from difflpv.stress.results import Experiment, Limit, Reading
from difflpv.stress.scenes import Case, room_scene

__all__ = ["fit_rate", "fit_start"]

_TRUE_FACTOR = 0.9
_STARTS = (0.1, 0.5, 0.99, 1.01, 1.05, 1.2, 1.5, 1.9)
_RATES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0)
_TOLD = ("not finite", "diverged", "no step of", "started from", "loss is", "gradient is")


def fit_start(bench: Bench) -> Experiment:
    """Where the fit starts."""
    solvers = ("adam", "lbfgs", "nlopt-bobyqa", "nlopt-lbfgs")
    runs = {
        f"{solver}, {steps} steps": [
            (p, {"solver": solver, "initial": {"propagation": p}, "steps": steps}) for p in _STARTS
        ]
        for steps in bench.settings.fit_steps
        for solver in solvers
    }
    return _experiment(
        bench,
        "fit_start",
        "Fits that start beyond the limit",
        "start of the propagation factor",
        runs,
        "where the solve overflows, the fit starts from the critical factor and says so; the best finite point returns",
        "start at or below the critical factor",
    )


def fit_rate(bench: Bench) -> Experiment:
    """How large a step Adam takes."""
    runs = {
        f"adam, {steps} steps": [
            (r, {"solver": "adam", "lr": r, "initial": {"propagation": 0.8}, "steps": steps}) for r in _RATES
        ]
        for steps in bench.settings.fit_steps
    }
    return _experiment(
        bench,
        "fit_rate",
        "Fits pushed over the limit by their learning rate",
        "learning rate",
        runs,
        "status non_finite, or 'diverged', or 'no step came below the start'; the best finite point returns",
        "a learning rate of 0.1 or less, or L-BFGS",
    )


def _experiment(
    bench: Bench,
    name: str,
    title: str,
    knob: str,
    runs: dict[str, list[tuple[float, dict[str, Any]]]],
    detected: str,
    cure: str,
) -> Experiment:
    targets = {steps: _target(steps, bench.settings.seed) for steps in bench.settings.fit_steps}
    readings, limits = [], []
    for method, settings in runs.items():
        own = []
        for value, options in settings:
            steps = options.pop("steps")
            options["budget"] = bench.settings.fit_budget
            own.append(_fitted(method, value, targets[steps], LpvConfig(method="lpv", steps=steps), options))
        readings += own
        found = [r for r in own if r.error is not None and r.error < 0.05]
        rest = [r for r in own if r not in found]
        told = [r for r in own if r.message]
        limits.append(
            Limit(
                method,
                knob,
                f"finds the factor from {', '.join(f'{r.knob:g}' for r in found) or 'nowhere'}",
                "; ".join(f"from {r.knob:g} comes back with {r.energy:.3g} times the true factor" for r in rest if r.energy)
                or "not reached",
                f"told at {', '.join(f'{r.knob:g}' for r in told)}: {detected}" if told else "the status: converged or budget",
                cure,
            )
        )
    bad = [r for r in readings if r.error is None]
    return Experiment(
        name,
        title,
        knob,
        "",
        f"A closed cube, 8³ cells, lpv; the target is the solve itself with the factor {_TRUE_FACTOR}; "
        f"{bench.settings.fit_budget:g} forward-equivalents. The error is the loss at the point that comes back; beside it the "
        "last evaluation's loss over the first's, and the factor that comes back over the true one.",
        tuple(readings),
        tuple(limits),
        f"{len(readings) - len(bad)} of {len(readings)} fits come back with a finite point.",
        log_knob=name == "fit_rate",
        error_label="loss at the returned point",
        energy_label="returned factor / true factor",
        gradient_label="last loss / first loss",
    )


def _target(steps: int, seed: int) -> LightTarget:
    scene = room_scene(cells=8, name="fit-room")
    u = np.linspace(-1.6, 1.6, 6)
    x, z = (a.ravel() for a in np.meshgrid(u, u))
    position = np.stack([x, np.zeros(36), z], 1)
    normal, weight = np.tile([0.0, 1, 0], (36, 1)), np.ones(36)
    case, config = Case(scene, position, normal, weight, {}, {}), LpvConfig(method="lpv", steps=steps)
    lit = Lit.of(case, config, "bounce1", seed=seed)
    receivers = lit.light.receivers(position, normal)
    with torch.no_grad():
        truth = Lpv(case.grid, config)(lit.light, receivers, {"propagation": torch.tensor(_TRUE_FACTOR, dtype=torch.float64)})
    return LightTarget(0, lit.light, receivers, truth, torch.ones(36))


def _fitted(method: str, value: float, target: LightTarget, config: LpvConfig, options: dict[str, Any]) -> Reading:
    outcome = fit(
        target.illumination.scene,
        [target],
        config=config,
        learn=["propagation"],
        train=[0],
        test=[],
        **options,
    )
    result = outcome.result
    losses = [p.loss for p in result.history if np.isfinite(p.loss)]
    growth = losses[-1] / max(losses[0], 1e-300) if losses else None
    told = any(word in result.message for word in _TOLD)
    p = float(result.parameters["propagation"])
    return Reading(method, value, result.loss, growth, p / _TRUE_FACTOR, result.message if told else "")
