"""Uniform grids of probes: what games use today, and the ground that every other way starts from.

A grid that keeps its probes out of solids follows the relocation of dynamic diffuse global illumination: a probe may move by at
most 45 % of a cell along each axis, so that the order of the grid stays (Majercik et al., "Scaling probe-based real-time
dynamic global illumination for production", JCGT 2021).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from difflpv.placement.journal import Journal
from difflpv.placement.task import Placement, PlacementTask, Progress

__all__ = [
    "SPREADS", "FreeSpace", "UniformGrid", "first_grid", "move_into_free_space", "place_grid", "place_grid_moved",
    "uniform_grids",
]  # fmt: skip

SPREADS = (1.0, 1.1, 1.2, 1.3)
"""Scales about the centre that are tried: probes at the centres of cells leave half a cell at the border uncovered."""

MOVE_LIMIT = 0.45
_SHAPES = 3  # as many shapes are tried by their training error
_REFINEMENTS = 24  # finer grids that are tried, up to
_MOVED_REFINEMENTS = 4  # where probes move out of solids, which few lose and takes long to find out
_FINEST = 4.0  # times the probes asked for


class FreeSpace(Protocol):
    """Where probes may be: all that a grid asks of a ``PlacementTask``."""

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner [3] m of the box that is filled."""

    def in_free_space(self, position: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """True for positions [n,3] m at least ``margin`` m off every surface and in no solid."""


@dataclass(frozen=True, eq=False)
class UniformGrid:
    """A grid of probes: its positions [n,3] m, x slowest; the numbers along each axis; the spacing [3] m; its scale."""

    position: np.ndarray
    shape: tuple[int, int, int]
    spacing: np.ndarray
    spread: float


def uniform_grids(
    task: FreeSpace, count: int, spread: float = 1.0, *, margin: float | None = None, refinements: int | None = None
) -> list[UniformGrid]:
    """The finest grids of near-cubic spacing of which at most ``count`` probes lie in free space, best proportions first.

    Where probes fall into solids, finer grids come first, so that none is wasted.

    Args:
        task: says what box to fill (that of a placement's points), and where free space is.
        count: probes at most.
        spread: scale about the centre of the box.
        margin: if given, probes in solids are first moved out of them, this share of the smallest spacing off the surface.
        refinements: finer grids that are tried; enough to miss hardly any by default, which takes seconds where a scene has
            many triangles. 0: one grid of the best proportions and ``count`` probes alone, with those of them that are free.

    Returns:
        Up to three such grids, and up to three of ``count`` probes, with their free probes alone; none if no grid has any.
    """
    low, high = task.bounds

    def fitting(total: int) -> list[UniformGrid]:
        shapes = _shapes(high - low, total)[: 1 if refinements == 0 else _SHAPES]
        grids = [_free(task, _grid(low, high, shape, spread), margin) for shape in shapes]
        return [grid for grid in grids if 0 < len(grid.position) <= count]

    plain = best = fitting(count)
    kept = max((len(grid.position) for grid in best), default=0)
    tried, enough = (_REFINEMENTS, count) if margin is None else (_MOVED_REFINEMENTS, 0.95 * count)
    tried = tried if refinements is None else refinements
    for total in sorted({round(count * _FINEST ** (k / tried)) for k in range(1, tried + 1)} - {count}):
        if kept >= enough:
            break
        finer = fitting(total)
        most = max((len(grid.position) for grid in finer), default=0)
        if most > kept:
            best, kept = finer, most
    return best if best is plain else best + plain


def first_grid(journal: Journal, count: int) -> UniformGrid:
    """The grid that an iteration starts from: the first of ``uniform_grids``.

    Raises:
        ValueError: no probe lies in free space.
    """
    grids = uniform_grids(journal.task, count)
    if not grids:
        raise journal.nothing_free()
    return grids[0]


def _grid(low: np.ndarray, high: np.ndarray, shape: tuple[int, int, int], spread: float) -> UniformGrid:
    spacing = spread * (high - low) / np.asarray(shape)
    axes = [(low[a] + high[a]) / 2 + (np.arange(n) - (n - 1) / 2) * spacing[a] for a, n in enumerate(shape)]
    return UniformGrid(np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3), shape, spacing, spread)


def _free(task: FreeSpace, grid: UniformGrid, margin: float | None) -> UniformGrid:
    position = grid.position
    if margin is not None:
        position = move_into_free_space(
            task, position, MOVE_LIMIT * grid.spacing, margin=margin * float(grid.spacing.min())
        )
    return replace(grid, position=position[task.in_free_space(position)])


def _shapes(extent: np.ndarray, count: int) -> list[tuple[int, int, int]]:
    """Shapes of at most ``count`` probes, best first: near-cubic spacing, and a product near ``count``.

    Where 0.9 count can be met with two or more probes along each axis, other shapes are left out.
    """
    found = []
    for a in range(1, count + 1):
        for b in range(1, count // a + 1):
            shape = (a, b, count // (a * b))
            spacing = extent / np.asarray(shape)
            poor = min(shape) < 2 or np.prod(shape) < 0.9 * count
            found.append((poor, spacing.max() / max(spacing.min(), 1e-30) + count / np.prod(shape), shape))
    found.sort()
    return [shape for poor, _, shape in found if poor == found[0][0]]


def move_into_free_space(
    task: FreeSpace, position: np.ndarray, limit: np.ndarray, *, margin: float = 0.0, steps: int = 4
) -> np.ndarray:
    """Move positions [n,3] m that are not in free space the shortest way into it, at most ``limit`` [3] m along each axis.

    Args:
        task: says where free space is.
        position: [n,3] m; those in free space stay as they are.
        limit: [3] m.
        margin: wanted distance to surfaces [m].
        steps: candidates on each side along each axis.

    Returns:
        Positions [n,3] m; those that cannot be moved into free space stay where they were.
    """
    position = np.array(position, np.float64)
    stuck = np.flatnonzero(~task.in_free_space(position))
    if not len(stuck):
        return position
    axis = np.arange(-steps, steps + 1) / steps
    offset = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3) * limit
    offset = offset[np.argsort(np.linalg.norm(offset, axis=1), kind="stable")]
    for wanted in dict.fromkeys((margin, 0.0)):  # a probe close to a surface is better than one inside of it
        if not len(stuck):
            break
        moved = position[stuck, None] + offset
        free = task.in_free_space(moved.reshape(-1, 3), wanted).reshape(len(stuck), -1)
        able = free.any(1)
        position[stuck[able]] = moved[able, free[able].argmax(1)]
        stuck = stuck[~able]
    return position


def place_grid(
    task: PlacementTask,
    count: int,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    spread: float | None = None,
) -> Placement:
    """A uniform grid over the box of the points; probes in solids are dropped.

    Args:
        task: what is known.
        count: probes at most. Of the shapes that come nearest to it with near-cubic spacing, the best by training error.
        seed: not used: a grid has no chance in it.
        progress: told about each grid that was tried.
        spread: scale about the centre, 1 for probes at the centres of cells; the best of ``SPREADS`` by training error if None.

    Raises:
        ValueError: an option out of range, or no probe lies in free space.
    """
    return _place(task, count, "grid", progress, spread)


def place_grid_moved(
    task: PlacementTask,
    count: int,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    spread: float | None = None,
    margin: float = 0.1,
) -> Placement:
    """A uniform grid whose probes in solids are moved out by at most 45 % of a cell along each axis; the rest is dropped.

    Args:
        task: what is known.
        count: probes at most.
        seed: not used: a grid has no chance in it.
        progress: told about each grid that was tried.
        spread: as for ``place_grid``.
        margin: wanted distance of moved probes to surfaces, as a share of the smallest spacing.

    Raises:
        ValueError: an option out of range, or no probe lies in free space.
    """
    if not 0 <= margin < MOVE_LIMIT:
        raise ValueError(f"grid_moved margin: expected a share of a cell in [0, {MOVE_LIMIT}), got {margin}")
    return _place(task, count, "grid_moved", progress, spread, margin=margin)


def _place(
    task: PlacementTask,
    count: int,
    method: str,
    progress: Progress | None,
    spread: float | None,
    *,
    margin: float | None = None,
) -> Placement:
    journal = Journal(task, method, count, progress)
    if spread is not None and not 0.1 <= spread <= 3:
        raise ValueError(f"{method} spread: expected a scale in [0.1, 3], got {spread}")
    best: tuple[float, UniformGrid] | None = None
    for scale in SPREADS if spread is None else (spread,):
        for grid in uniform_grids(task, count, scale, margin=margin):
            error = journal.error(grid.position)
            journal.note(len(grid.position), error)
            if best is None or error < best[0]:
                best = error, grid
    if best is None:
        raise journal.nothing_free()
    error, grid = best
    dropped = int(np.prod(grid.shape)) - len(grid.position)
    return journal.placement(
        grid.position, shape=grid.shape, spread=grid.spread, dropped=dropped, training_error=error
    )
