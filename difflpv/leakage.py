"""Light where there should be none: three numbers that a whole-scene error hides.

- ``leak``: mean error of receivers in a region that the truth says is dark, over the mean irradiance of the others.
- ``self_lighting``: irradiance that a single lit plane throws onto itself, over its exitance; the truth is 0.
- ``blocked_share``: irradiance behind a closed wall over what arrives there without the wall; the truth is 0.

The last two are means over eight positions of the geometry against the cells, so that no lucky alignment hides a leak.
"""

from __future__ import annotations

import numpy as np

from difflpv.config import LpvConfig
from difflpv.grid import Grid
from difflpv.scene import AreaLight, DirectionalLight, Material, Mesh, Scene
from difflpv.simulate import simulate

__all__ = ["blocked_share", "dark_receivers", "leak", "self_lighting"]

_CELLS = 16
_DARK = {"two_rooms_90": (0, 0.06)}  # axis and bound [m] beyond which the far room lies
_SHIFTS = (np.arange(8) + 0.5) / 8 - 0.5


def leak(prediction: np.ndarray, target: np.ndarray, dark: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Mean absolute error in a dark region over the mean irradiance elsewhere.

    Args:
        prediction: irradiance [n,3] W/m2.
        target: the truth [n,3].
        dark: which receivers lie in the dark region, bool [n].
        weight: area weights [n]; equal if None.

    Raises:
        ValueError: no receiver on one of the two sides, or no light on the lit one.
    """
    dark = np.asarray(dark, bool)
    weight = np.ones(len(dark)) if weight is None else np.asarray(weight, float)
    lit = np.average(target[~dark].mean(1), weights=weight[~dark]) if (weight * ~dark).any() else 0.0
    if not (weight * dark).any() or not lit > 0:
        raise ValueError("dark: expected receivers in the dark and in the light, and light there")
    return float(np.average(np.abs(prediction - target)[dark].mean(1), weights=weight[dark]) / lit)


def dark_receivers(scene_name: str, position: np.ndarray) -> np.ndarray | None:
    """Which receivers [n,3] m of a bundled scene lie in its dark region, bool [n]; None where it has none."""
    if scene_name not in _DARK:
        return None
    axis, bound = _DARK[scene_name]
    return np.asarray(position[:, axis] > bound)


def self_lighting(config: LpvConfig) -> float:
    """Irradiance after one bounce on a lone plane lit by the sun, over its exitance (area mean over its inner half)."""
    albedo, half, found = 0.5, _CELLS / 2, []
    rng = np.random.default_rng(0)
    for shift in _SHIFTS:
        height = -2.0 + shift
        plane = _quad("plane", (-half + 1, height, -half + 1), (0, 0, _CELLS - 2), (_CELLS - 2, 0, 0), albedo)
        scene = Scene("plane", (plane,), (DirectionalLight(np.array([0.0, -1, 0]), np.ones(3)),))
        position = np.stack([rng.uniform(-3, 3, 64), np.full(64, height), rng.uniform(-3, 3, 64)], -1)
        up = np.tile([0.0, 1, 0], (64, 1))
        found.append(simulate(scene, position, up, grid=_grid(), config=config, component="bounce1").irradiance.mean())
    return float(np.mean(found) / albedo)


def blocked_share(config: LpvConfig, *, thickness: float) -> float:
    """Irradiance of direct light behind a closed wall over that without the wall.

    Args:
        config: the solve.
        thickness: of the wall, in cells.

    Returns:
        Share, 0 in truth. The light is a panel of 4 x 4 cells, 4 cells before the wall; receivers face it on a wall 4 cells
        behind. Walls on all sides keep light from going round.
    """
    half, rng = _CELLS / 2, np.random.default_rng(0)
    blocked: list[float] = []
    free: list[float] = []
    for shift in _SHIFTS:
        room = [
            _quad("floor", (-half + 1, -half + 1, -half + 1), (0, 0, _CELLS - 2), (_CELLS - 2, 0, 0), 0.5),
            _quad("ceiling", (-half + 1, half - 1, -half + 1), (_CELLS - 2, 0, 0), (0, 0, _CELLS - 2), 0.5),
            _quad("side", (-half + 1, -half + 1, -half + 1), (_CELLS - 2, 0, 0), (0, _CELLS - 2, 0), 0.5),
            _quad("other", (-half + 1, -half + 1, half - 1), (0, _CELLS - 2, 0), (_CELLS - 2, 0, 0), 0.5),
            _quad("end", (4.0 + shift, -half, -half), (0, 0, _CELLS), (0, _CELLS, 0), 0.5),
            _quad("panel", (-4.0 + shift, -2, -2), (0, 4, 0), (0, 0, 4), 0.0),
        ]
        wall = [
            _quad(f"wall{k}", (shift + (k - 0.5) * thickness, -half, -half), (0, _CELLS, 0), (0, 0, _CELLS), 0.5)
            for k in (0, 1)
        ]
        position = np.concatenate([np.full((64, 1), 4.0 + shift), rng.uniform(-4, 4, (64, 2))], 1)
        facing = np.tile([-1.0, 0, 0], (64, 1))
        light = (AreaLight("panel", np.ones(3)),)
        for meshes, into in ((room + wall, blocked), (room, free)):
            scene = Scene("wall", tuple(meshes), light)
            found = simulate(scene, position, facing, grid=_grid(), config=config, component="direct")
            into.append(float(found.irradiance.mean()))
    return float(np.mean(blocked) / np.mean(free))


def _grid() -> Grid:
    half = _CELLS / 2
    return Grid((-half, -half, -half), 1.0, (_CELLS,) * 3)


def _quad(name: str, corner: tuple[float, ...], first: tuple[float, ...], second: tuple[float, ...], albedo: float) -> Mesh:
    a, u, v = (np.asarray(p, float) for p in (corner, first, second))
    vertices = np.stack([a, a + u, a + u + v, a + v])
    return Mesh(name, vertices, np.array([[0, 1, 2], [0, 2, 3]]), Material(name, np.full(3, albedo)))
