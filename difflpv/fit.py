"""Fit an LPV to path-traced targets: some lights to learn from, others to be judged on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch

from difflpv.camera_view import CameraView, camera_view
from difflpv.config import LpvConfig
from difflpv.evaluate import Score, mean_score, predict_constant, score
from difflpv.grid import Grid
from difflpv.illumination import Component, Illumination, Receivers, illuminate
from difflpv.learnables import CELL_LEARNABLES, SCENE_LEARNABLES
from difflpv.lights import apply_light_set
from difflpv.loss import image_l1, image_ssim, log_l2, relative_l2
from difflpv.optim import solve
from difflpv.optim.problem import Problem
from difflpv.optim.result import HistoryPoint, OptimResult
from difflpv.pipeline import Lpv
from difflpv.scene import Scene

__all__ = ["FitOutcome", "LightTarget", "Loss", "fit", "light_target", "score_lights"]

Loss = Literal["l2", "log", "image-l1", "image-ssim"]
_BACKWARD_COST = 2.0  # forwards; benchmarks/propagation.py measures 1.2 to 1.9 for what is learned here
_MOVED = "started from the critical propagation factor {limit:g}, because the solve overflows at the start given; "


@dataclass(frozen=True, eq=False)
class LightTarget:
    """One light set, ready to solve, and the truth under it.

    Attributes:
        index: number of the light set.
        illumination: the traced scene.
        receivers: where the truth is known.
        irradiance: the truth [W/m2], shape [n,3].
        weight: area weights [m2], shape [n].
        image: path-traced radiance [H,W,3] of the camera view, or None.
    """

    index: int
    illumination: Illumination
    receivers: Receivers
    irradiance: torch.Tensor
    weight: torch.Tensor
    image: torch.Tensor | None = None


@dataclass(frozen=True, eq=False)
class FitOutcome:
    """What a fit found, and how far it and its peers are from the truth.

    Attributes:
        lpv: the fitted model.
        result: how the solver went.
        train: light sets learned from.
        test: light sets judged on.
        scores: "constant", the untuned method and the fitted one, per light set.
    """

    lpv: Lpv
    result: OptimResult
    train: tuple[int, ...]
    test: tuple[int, ...]
    scores: tuple[Score, ...]

    def mean_scores(self, lights: Sequence[int]) -> list[Score]:
        """Mean over some light sets, a line per method."""
        methods = dict.fromkeys(s.method for s in self.scores)
        return [mean_score([s for s in self.scores if s.method == m and s.light in lights]) for m in methods]


def light_target(
    scene: Scene,
    entries: Sequence[Any] | None,
    grid: Grid,
    config: LpvConfig,
    component: Component,
    *,
    index: int,
    position: np.ndarray,
    normal: np.ndarray,
    irradiance: np.ndarray,
    weight: np.ndarray,
    image: np.ndarray | None = None,
    seed: int = 0,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
    **options: Any,
) -> LightTarget:
    """Trace one light set and put its truth beside it.

    Args:
        scene: the scene; ``entries`` (``difflpv.lights``) replace its lights unless None.
        entries: the light set.
        grid: cells of the volume.
        config: the solve.
        component: "direct" or "bounce1".
        index: number of the light set.
        position: receivers [n,3] m.
        normal: unit normals [n,3].
        irradiance: the truth [n,3] W/m2.
        weight: area weights [n] m2.
        image: path-traced radiance [H,W,3] of the scene's first camera, for image losses.
        seed: of the light samples.
        dtype: float32 to run, float64 to check.
        device: where to solve.
        **options: of ``illuminate``, such as its sample counts.
    """
    lit = scene if entries is None else apply_light_set(scene, entries)
    illumination = illuminate(lit, grid, config, component, seed=seed, dtype=dtype, device=device, **options)

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.asarray(values, np.float64), dtype=dtype, device=device)

    receivers = illumination.receivers(position, normal)
    picture = None if image is None else tensor(image)
    return LightTarget(index, illumination, receivers, tensor(irradiance), tensor(weight), picture)


def fit(
    scene: Scene,
    targets: Sequence[LightTarget],
    *,
    config: LpvConfig,
    learn: Sequence[str],
    train: Sequence[int],
    test: Sequence[int],
    solver: str = "lbfgs",
    loss: Loss = "l2",
    sparsity: float = 0.0,
    budget: float = 60.0,
    seconds: float | None = None,
    seed: int = 0,
    initial: Mapping[str, Any] | None = None,
    checkpoint: str | Path | None = None,
    callback: Callable[[HistoryPoint], None] | None = None,
    label: str = "",
    **options: Any,
) -> FitOutcome:
    """Fit learnables on the train lights and judge on both.

    Args:
        scene: needed where lights or albedo are learned.
        targets: from ``light_target``, all of one grid, component and configuration.
        config: the solve.
        learn: names from ``difflpv.learnables.LEARNABLES``.
        train: numbers of the light sets to learn from.
        test: numbers of the light sets to judge on; may be empty, must not overlap ``train``.
        solver: a name of ``difflpv.optim.SOLVERS``; "nnls" makes the squares of the losses of all train lights least.
        loss: "l2" (area-weighted relative), "log", or "image-l1" and "image-ssim" on the camera view; the mean over the
            train lights.
        sparsity: weight of the mean |log f| of per-cell fields f in the loss: cells that gain nothing stay at 1.
        budget: forward-equivalents, one being a solve of all train lights.
        seconds: wall-time limit.
        seed: of the solver.
        initial: where to start, by name, instead of the learnables' own starts. Where the solve overflows there because the
            propagation factor lies beyond its critical value, the fit starts from that value and says so.
        checkpoint: file that the solver writes and resumes from.
        callback: called with every evaluation.
        label: recognises a checkpoint of another fit, beside loss, train lights and sparsity.
        **options: of the solver.

    Returns:
        The fitted model with its scores; an interrupted or failed fit returns the best finite point so far.

    Raises:
        FloatingPointError: the solve is not finite where the fit starts, and the propagation factor is not to blame.
        ValueError: an empty or overlapping split, a light without a target, lights learned on several light sets, albedo
            learned from the component "direct", or a loss that the solver does not know.
    """
    by_index = {t.index: t for t in targets}
    missing = sorted({*train, *test} - set(by_index))
    if missing:
        raise ValueError(f"light sets: no target for {missing}, targets hold {sorted(by_index)}")
    if not train or set(train) & set(test):
        raise ValueError(f"light sets: train {list(train)} must not be empty and not overlap test {list(test)}")
    if loss not in get_args(Loss):
        raise ValueError(f"loss: expected one of {', '.join(get_args(Loss))}, got {loss!r}")
    if solver == "nnls" and loss != "l2":
        raise ValueError(f"loss: solver 'nnls' knows 'l2' alone, got {loss!r}")
    lights = [name for name in learn if name in SCENE_LEARNABLES and name != "albedo"]
    if lights and len(train) + len(test) > 1:
        raise ValueError(f"learn: {', '.join(lights)} belong to one light set: train on one and test on none")
    learned_on = [by_index[k] for k in train]
    if "albedo" in learn and learned_on[0].illumination.component == "direct":
        raise ValueError("learn: 'albedo' has no part in component 'direct', fit it to 'bounce1'")
    first = learned_on[0].illumination
    measure = _image_loss(loss, learned_on) if loss.startswith("image") else _irradiance_loss(loss, learned_on)

    fields = [name for name in learn if name in CELL_LEARNABLES]
    if not sparsity >= 0 or (sparsity and not fields):
        raise ValueError(f"sparsity: expected 0, or a number above it with {' or '.join(CELL_LEARNABLES)}, got {sparsity}")

    def problem_of(lpv: Lpv) -> Problem:
        def objective(values: dict[str, torch.Tensor]) -> torch.Tensor:
            penalty = sum((values[name].log().abs().mean() for name in fields), torch.zeros((), dtype=torch.float64))
            try:
                return measure(lpv, values) + sparsity * penalty
            except FloatingPointError:  # the solver says at which parameter and step
                return sum((v.sum() for v in values.values()), torch.zeros((), dtype=torch.float64)) * torch.nan

        def residual(values: dict[str, torch.Tensor]) -> torch.Tensor:
            parts = []
            for t in learned_on:  # relative, as the loss is: or a bright light set would count more than a dim one
                root = t.weight.sqrt()[:, None]
                gap = root * (lpv(t.illumination, t.receivers, values) - t.irradiance)
                parts.append((gap / torch.linalg.vector_norm(root * t.irradiance)).double().ravel())
            return torch.cat(parts)

        made_of = f"{label}; loss {loss}, train {list(train)}, sparsity {sparsity:g}"
        return Problem(objective, lpv.described, backward_cost=_BACKWARD_COST, residual=residual, label=made_of)

    lpv = Lpv(first.grid, config, learn=learn, scene=first.scene, initial=initial)
    moved, told = _start_within_the_limit(lpv, problem_of(lpv)), ""
    if moved is not None:
        lpv, told = Lpv(first.grid, config, learn=learn, scene=first.scene, initial={**(initial or {}), **moved}), _MOVED
    options |= {"budget": budget, "seconds": seconds, "seed": seed, "checkpoint": checkpoint, "callback": callback}
    result = solve(problem_of(lpv), solver, **options)
    result = replace(result, message=told.format(limit=config.critical_factor) + result.message)
    lpv.set_values(result.parameters)
    untuned = Lpv(lpv.grid, config)
    scores: list[Score] = []
    for k in (*train, *test):
        scores += score_lights(by_index[k], {config.method: untuned, f"{config.method} fitted": lpv})
    return FitOutcome(lpv, result, tuple(train), tuple(test), tuple(scores))


def _start_within_the_limit(lpv: Lpv, problem: Problem) -> dict[str, torch.Tensor] | None:
    """Values of the propagation factors to start from instead, where it is them who make the start overflow; else None."""
    limit = lpv.config.critical_factor
    if not lpv.config.steps or float(lpv.step_factors().max()) <= limit:
        return None
    loss, gradient = problem.value_and_grad(problem.initial)
    if math.isfinite(loss) and bool(gradient.isfinite().all()):
        return None
    start = {p.name: p.initial for p in lpv.described}
    moved = {}
    if "propagation" in start:
        moved["propagation"] = start["propagation"].clamp(max=limit)
    if "propagation_steps" in start:
        moved["propagation_steps"] = start["propagation_steps"].clamp(max=1.0)
    return moved or None


@torch.no_grad()
def score_lights(target: LightTarget, models: dict[str, Lpv]) -> list[Score]:
    """Scores of the constant and of each model under one light set."""
    truth, weight = target.irradiance.cpu().numpy().astype(float), target.weight.cpu().numpy().astype(float)
    component = target.illumination.component
    predictions = {"constant": predict_constant(truth, weight)}
    for name, lpv in models.items():
        predictions[name] = lpv(target.illumination, target.receivers).cpu().numpy()
    return [
        score(p, truth, weight, method=name, component=component, light=target.index) for name, p in predictions.items()
    ]


Measure = Callable[[Lpv, dict[str, torch.Tensor]], torch.Tensor]


def _irradiance_loss(loss: str, targets: Sequence[LightTarget]) -> Measure:
    distance = relative_l2 if loss == "l2" else log_l2

    def measure(lpv: Lpv, values: dict[str, torch.Tensor]) -> torch.Tensor:
        parts = [distance(lpv(t.illumination, t.receivers, values), t.irradiance, t.weight) for t in targets]
        return torch.stack(parts).mean().double()

    return measure


def _image_loss(loss: str, targets: Sequence[LightTarget]) -> Measure:
    """Loss on the camera view, over the pixels that see a surface which does not itself shine."""
    views: list[tuple[CameraView, Receivers, torch.Tensor, torch.Tensor]] = []
    for t in targets:
        if t.image is None:
            raise ValueError(f"loss: '{loss}' needs target images, light set {t.index} has none")
        view = camera_view(t.illumination.scene, t.illumination.raycaster)
        if t.image.shape != (view.height, view.width, 3):
            raise ValueError(f"image: expected [{view.height}, {view.width}, 3], got {list(t.image.shape)}")
        dark = torch.as_tensor(~(view.emission > 0).any(1), device=t.image.device)
        pixels = torch.as_tensor(view.hit, device=t.image.device)
        shown = torch.zeros(view.height * view.width, dtype=torch.bool, device=t.image.device)
        shown[pixels] = dark
        truth = t.image * shown.view(view.height, view.width, 1)
        receivers = t.illumination.receivers(view.position, view.normal)
        texture = torch.as_tensor(view.texture, dtype=t.image.dtype, device=t.image.device) * dark[:, None]
        views.append((view, receivers, texture, truth))

    def measure(lpv: Lpv, values: dict[str, torch.Tensor]) -> torch.Tensor:
        parts = []
        for t, (view, receivers, texture, truth) in zip(targets, views, strict=True):
            irradiance = lpv(t.illumination, receivers, values)
            factors = values.get("albedo", torch.as_tensor(t.illumination.scene.mesh_albedo)).to(truth)
            radiance = factors[torch.as_tensor(view.mesh_index, device=truth.device)] * texture * irradiance / np.pi
            pixels = torch.zeros(view.height * view.width, 3, dtype=truth.dtype, device=truth.device)
            image = pixels.index_put((torch.as_tensor(view.hit, device=truth.device),), radiance)
            image = image.view(view.height, view.width, 3)
            parts.append(image_l1(image, truth) if loss == "image-l1" else image_ssim(image, truth))
        return torch.stack(parts).mean().double()

    return measure
