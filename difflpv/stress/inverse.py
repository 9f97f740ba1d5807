"""Inverse problems that gradients lose, and who finds them all the same: success over random starts at equal cost.

Each problem asks for a few numbers from the irradiance that the solve itself made with the true ones, so that a perfect answer
has the loss 0 (but for the problem with too few VPLs, whose target is another discretisation of the light).
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import median

import numpy as np
import torch

from difflpv.config import LpvConfig
from difflpv.grid import Grid
from difflpv.illumination import Illumination, Receivers, illuminate
from difflpv.loss import relative_l2
from difflpv.optim import SOLVERS, solve
from difflpv.optim.problem import Problem
from difflpv.optim.result import Status
from difflpv.parameters import Parameter
from difflpv.pipeline import Lpv
from difflpv.scene import AreaLight, Scene
from difflpv.stress.measure import Bench
from difflpv.stress.results import Experiment, Limit, Reading
from difflpv.stress.scenes import rectangle, room_scene
from difflpv.stress.settings import StressSettings

__all__ = ["inverse"]

_CELLS, _STEPS = 8, 8
_CONFIG = LpvConfig(method="holpv", occlusion="exp", deposit="trilinear", steps=_STEPS)
_CONTROL, _WALL, _FAR, _SYMMETRIC, _FEW = "near start", "behind a wall", "far start", "symmetric", "too few VPLs"
_CATEGORIES = (_CONTROL, _WALL, _FAR, _SYMMETRIC, _FEW)
_WHY = {
    _CONTROL: "a lamp's x and z; it starts within a cell of the true place, the control",
    _WALL: "a lamp's x and z; it starts on the other side of a wall (occlusion strength 8) from the true place",
    _FAR: "a lamp's x and z; it starts in the corner farthest from the true place",
    _SYMMETRIC: "a lamp's x and z; receivers on the mirror plane x = 0 cannot tell left from right, and starts lie within a "
    "tenth of a cell of that plane, where the gradient vanishes",
    _FEW: "a lamp's x and z; one VPL has to explain a lamp of three cells",
}


@dataclass(frozen=True, eq=False)
class _Task:
    """A problem, how its starts are drawn, and when it is solved."""

    parameters: tuple[Parameter, ...]
    loss: Callable[[dict[str, torch.Tensor]], torch.Tensor]
    start: Callable[[np.random.Generator], dict[str, np.ndarray]]
    solved: Callable[[dict[str, torch.Tensor]], bool]


def inverse(bench: Bench) -> Experiment:
    """Success rates of every solver on every problem."""
    settings, readings, limits = bench.settings, [], []
    tasks = _tasks(settings.seed)
    for solver in SOLVERS:
        if solver == "nnls":
            continue  # for losses that are linear least squares: none of these is
        if solver == "cma" and importlib.util.find_spec("cma") is None:
            missing = "not installed: pip install 'difflpv[cma]'"
            readings += [Reading("cma", k, message=missing) for k in range(len(_CATEGORIES))]
            limits.append(_not_installed())
            continue
        own = [_rate(solver, k, tasks[name], settings) for k, name in enumerate(_CATEGORIES)]
        readings += own
        limits.append(_solver_limit(solver, own, settings.starts))
    return Experiment(
        "inverse",
        "Inverse problems that gradients lose",
        "problem",
        "",
        f"A room of 6 m, {_CELLS}³ cells, holpv with occlusion, direct light of a lamp of half a cell; {settings.starts} "
        f"random starts each, {settings.budget:g} forward-equivalents (a gradient costs two more). Solved: the lamp within a "
        "cell of its place. " + "; ".join(f"{name}: {why}" for name, why in _WHY.items()) + ".",
        tuple(readings),
        tuple(limits),
        _finding(readings),
        error_label="share of starts that fail",
        gradient_label="median loss at the end",
        energy_label="median share of the budget used",
        categories=_CATEGORIES,
    )


def _rate(solver: str, index: int, task: _Task, settings: StressSettings) -> Reading:
    starts, budget, seed = settings.starts, settings.budget, settings.seed
    generator = np.random.default_rng([seed, index])
    hits, losses, spent, bad = 0, [], [], 0
    for k in range(starts):
        begin = task.start(generator)
        parameters = [replace(p, initial=begin[p.name], scale=None) for p in task.parameters]
        options = {"lr": 0.2} if solver == "adam" else {}
        result = solve(Problem(task.loss, parameters), solver, budget=budget, seed=seed + k, **options)
        hits += task.solved(result.parameters)
        losses.append(result.loss)
        spent.append(result.forward_equivalents / budget)
        bad += result.status in (Status.NON_FINITE, Status.FAILED)
    message = f"{hits} of {starts} solved" + (f", {bad} ended in a failure that was told" if bad else "")
    return Reading(solver, index, 1 - hits / starts, median(losses), median(spent), message)


def _tasks(seed: int) -> dict[str, _Task]:
    scene, walled = _room(), _room(wall=True)
    everywhere = _points()
    mirror = (everywhere[0] * [0.0, 1, 1], everywhere[1])
    left = (everywhere[0] * [-0.5, 1, 1] - [1.4, 0, 0], everywhere[1])  # the true side of the wall

    def near(g: np.random.Generator) -> dict[str, np.ndarray]:
        return {"place": np.array([1.6, -1.6]) + g.uniform(-0.6, 0.6, 2)}

    def corner(g: np.random.Generator) -> dict[str, np.ndarray]:
        return {"place": np.array([-1.9, 1.9]) + g.uniform(-0.4, 0.4, 2)}

    def behind(g: np.random.Generator) -> dict[str, np.ndarray]:
        return {"place": np.array([g.uniform(0.8, 2.0), g.uniform(-2, 2)])}

    def on_plane(g: np.random.Generator) -> dict[str, np.ndarray]:
        return {"place": np.array([g.uniform(-0.06, 0.06), g.uniform(-2, 2)])}

    return {
        _CONTROL: _place(scene, everywhere, (1.6, -1.6), near, seed),
        _WALL: _place(walled, left, (-1.4, 0.7), behind, seed, strength=8.0),
        _FAR: _place(scene, everywhere, (1.6, -1.6), corner, seed),
        _SYMMETRIC: _place(scene, mirror, (1.5, 0.5), on_plane, seed, mirrored=True),
        _FEW: _place(scene, everywhere, (1.1, -0.6), corner, seed, wide=True),
    }


def _room(*, wall: bool = False, lamp_edge: float = 0.3) -> Scene:
    scene = room_scene(edge=6.0, lamp=(0.0, 4.5, 0.0), lamp_edge=lamp_edge, cells=14, name="inverse")
    parts = [rectangle("divider", (0, 0, -3), (0, 6, 0), (0, 0, 6))] if wall else []
    return replace(scene, meshes=(*scene.meshes, *parts), grid=Grid((-3.0, 0.0, -3.0), 6.0 / _CELLS, (_CELLS,) * 3))


def _points() -> tuple[np.ndarray, np.ndarray]:
    """Receivers on the floor."""
    u = np.linspace(-2.6, 2.6, 7)
    x, z = (a.ravel() for a in np.meshgrid(u, u))
    return np.stack([x, np.zeros(49), z], 1), np.tile([0.0, 1, 0], (49, 1))


def _lit(scene: Scene, points: tuple[np.ndarray, np.ndarray], seed: int, samples: int) -> tuple[Illumination, Receivers]:
    assert scene.grid is not None
    light = illuminate(scene, scene.grid, _CONFIG, "direct", area_samples=samples, seed=seed)
    return light, light.receivers(*points)


def _offset(place: torch.Tensor) -> torch.Tensor:
    """Place (x, z) of the lamp -> displacement [1,3] m."""
    return torch.stack([place[0], torch.zeros_like(place[0]), place[1]])[None]


def _place(
    scene: Scene,
    points: tuple[np.ndarray, np.ndarray],
    true: tuple[float, float],
    start: Callable[[np.random.Generator], dict[str, np.ndarray]],
    seed: int,
    *,
    mirrored: bool = False,
    wide: bool = False,
    strength: float = 1.0,
) -> _Task:
    light, receivers = _lit(scene, points, seed, 1 if wide else 9)
    lpv = Lpv(light.grid, _CONFIG)
    goal, occlusion = torch.tensor(true, dtype=torch.float64), torch.tensor(strength, dtype=torch.float64)
    with torch.no_grad():
        if wide:
            # The same flux from a lamp of three cells.
            broad = _room(lamp_edge=2.4)
            power = [replace(v, radiance=v.radiance / 64) for v in broad.lights if isinstance(v, AreaLight)]
            other, asked = _lit(broad.with_lights(power), points, seed, 64)
            target = lpv(other, asked, {"light_position": _offset(goal)})
        else:
            target = lpv(light, receivers, {"light_position": _offset(goal), "occlusion": occlusion})

    def loss(p: dict[str, torch.Tensor]) -> torch.Tensor:
        values = {"light_position": _offset(p["place"]), "occlusion": occlusion}
        return relative_l2(lpv(light, receivers, values), target).double()

    def solved(p: dict[str, torch.Tensor]) -> bool:
        found = p["place"].abs() * torch.tensor([1.0, 0]) + p["place"] * torch.tensor([0, 1.0]) if mirrored else p["place"]
        return float((found - goal).norm()) < light.grid.cell_size

    return _Task((Parameter("place", [0.0, 0.0], -2.6, 2.6),), loss, start, solved)


def _solver_limit(solver: str, own: list[Reading], starts: int) -> Limit:
    rates = [round(starts * (1 - (r.error or 0.0))) for r in own]
    lost = [name for name, rate in zip(_CATEGORIES, rates, strict=True) if rate < starts / 2]
    return Limit(
        solver,
        "inverse problems",
        ", ".join(f"{name} {rate}/{starts}" for name, rate in zip(_CATEGORIES, rates, strict=True)),
        f"loses {', '.join(lost)} more often than not" if lost else "finds all more often than not",
        "the loss that remains; status and message of the result",
        "other starts, nlopt-crs2 or cma" if lost else "none needed",
    )


def _not_installed() -> Limit:
    return Limit("cma", "inverse problems", "not measured", "", "ValueError: not installed", "pip install 'difflpv[cma]'")


def _finding(readings: list[Reading]) -> str:
    parts = []
    for k, name in enumerate(_CATEGORIES):
        rates = {r.method: 1 - r.error for r in readings if r.knob == k and r.error is not None}
        best = max(rates, key=lambda m: rates[m])
        shown = (f"{m} {100 * rates[m]:.0f} %" for m in (best, "adam", "lbfgs"))
        parts.append(f"{name}: best {', '.join(shown)}")
    return "; ".join(parts) + "."
