"""Fits that are made once: each ends as a folder that ``Lpv.load`` reads, with its history beside the values."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from difflpv.demo.settings import DemoSettings, FitPlan
from difflpv.fit import LightTarget, fit
from difflpv.fitted import FittedError, read_fitted
from difflpv.optim.result import HistoryPoint, OptimResult, Status
from difflpv.pipeline import Lpv
from difflpv.scene import Scene

__all__ = ["fit_once"]

_TOLD_EVERY = 5.0  # s


def fit_once(
    plan: FitPlan,
    scene: Scene,
    lights: Mapping[int, LightTarget],
    settings: DemoSettings,
    *,
    folder: Path,
    identity: Mapping[str, Any],
    seed: int,
    progress: Callable[[str], object],
) -> tuple[Lpv, dict[str, Any]]:
    """A fitted model and how its fit went, from ``folder`` if they lie there.

    Args:
        plan: the fit.
        scene: the scene.
        lights: targets by number of the light set.
        settings: sizes, and which lights to learn from.
        folder: of all fits.
        identity: JSON values; a fit of another identity is made anew.
        seed: of the solver.
        progress: told lines of text.

    Raises:
        KeyboardInterrupt: the user stopped it; a fit by gradients has saved its checkpoint.
    """
    own = folder / plan.folder
    sizes = {name: asdict(settings)[name] for name in ("train", "test", "cells", "steps")}
    label = _digest({**identity, **sizes, "plan": asdict(plan), "budget": settings.budget(plan.method), "seed": seed})
    try:
        record = read_fitted(own).provenance
        if record.get("identity") == label:
            return Lpv.load(own), record["fit"]
    except FittedError:
        pass  # nothing there, or damaged: made anew
    own.mkdir(parents=True, exist_ok=True)
    # NLopt cannot continue a search, only start another from the best point so far, which would give other numbers.
    checkpoint = None if plan.solver.startswith("nlopt") else own / f"checkpoint-{label[:12]}.pt"
    outcome = fit(
        scene,
        list(lights.values()),
        config=settings.fitted(plan.method),
        learn=plan.learn,
        train=settings.train,
        test=settings.test,
        solver=plan.solver,
        budget=settings.budget(plan.method),
        seed=seed,
        checkpoint=checkpoint,
        callback=_Teller(plan, settings, progress),
        label=label,
    )
    if outcome.result.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    outcome.lpv.save(own, provenance={"identity": label, "fit": _plain_result(outcome.result)})
    for stale in own.glob("checkpoint-*.pt"):
        stale.unlink()
    # Read back, so that a run that finds the fit here and the run that made it go on with the same bits.
    return Lpv.load(own), read_fitted(own).provenance["fit"]


class _Teller:
    """Tells how a fit is going, every few seconds."""

    def __init__(self, plan: FitPlan, settings: DemoSettings, progress: Callable[[str], object]) -> None:
        self._name, self._budget, self._progress = f"{plan.name} ({plan.solver})", settings.budget(plan.method), progress
        self._best, self._told = math.inf, -math.inf

    def __call__(self, point: HistoryPoint) -> None:
        if point.loss < self._best:
            self._best = point.loss
        if time.monotonic() - self._told >= _TOLD_EVERY:
            self._told = time.monotonic()
            spent = f"{point.forward_equivalents:3.0f} of {self._budget:g} forward-equivalents"
            self._progress(f"fitting {self._name}: {spent}, loss {self._best:.4f}")


def _plain_result(result: OptimResult) -> dict[str, Any]:
    """A result as JSON values."""
    return {
        "solver": result.solver,
        "status": result.status.value,
        "message": result.message,
        "loss": result.loss if math.isfinite(result.loss) else None,
        "evaluations": result.evaluations,
        "forward_equivalents": result.forward_equivalents,
        "seconds": round(result.seconds, 3),
        "parameters": {name: value.tolist() for name, value in result.parameters.items()},
        "history": [[p.forward_equivalents, p.seconds, p.loss if math.isfinite(p.loss) else None] for p in result.history],
    }


def _digest(values: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
