"""Spawn and merge: probes between probes that differ, one probe for two that are alike (light probe thesis 3.1.1, 3.1.3).

From a uniform grid on, in every iteration: two probes closer than the proximity threshold that are alike merge at their
midpoint; two that differ get another one at their midpoint. It ends when nothing changes, after a number of iterations, or
when the wanted number of probes is reached. In the hierarchical variant the eight probes at the corners of a cubic cell are
compared, and where any two differ, the cell is divided into eight with probes at all of their corners.

The thesis sets thresholds by hand. Here the contrast threshold is searched by bisection for the wanted number of probes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from difflpv.placement.contrast import Contrast, ContrastKind
from difflpv.placement.journal import Journal, distinct
from difflpv.placement.task import Placement, PlacementTask, Progress
from difflpv.placement.uniform import first_grid

__all__ = ["place_spawn_merge", "place_spawn_merge_hierarchical"]

_SEARCH = 14  # runs of the bisection
_CLOSE_ENOUGH = 0.97  # of the wanted count ends it


@dataclass(frozen=True, eq=False)
class _Outcome:
    """One run at one threshold: positions [n,3] m, why it stopped, how many iterations it took."""

    position: np.ndarray
    stop: str
    iterations: int


def place_spawn_merge(
    task: PlacementTask,
    count: int,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    contrast: ContrastKind = "samples26",
    initial: float = 1.5,
    proximity: float = 1.25,
    merge_ratio: float = 0.1,
    closest: float = 0.35,
    max_iterations: int = 12,
) -> Placement:
    """Spawn and merge from a uniform grid.

    Args:
        task: what is known. Only its field is looked at, never the truth at its points.
        count: probes at most; the contrast threshold is the one that comes nearest to it.
        seed: not used: the method has no chance in it.
        progress: told about each run of the search for the threshold.
        contrast: how two probes are compared.
        initial: probes of the initial grid as a share of ``count``.
        proximity: threshold in multiples of the initial grid's largest spacing: only pairs closer than it merge or spawn.
        closest: no two probes are nearer than this share of that spacing: without it, all pairs at a light spawn for ever.
        merge_ratio: pairs merge below this share of the contrast above which they spawn; at 1 the two undo each other.
        max_iterations: of one run.

    Raises:
        ValueError: an option out of range, or no probe lies in free space.
    """
    journal = Journal(task, "spawn_merge", count, progress)
    if not 0 < initial <= 4:
        raise ValueError(f"spawn_merge initial: expected a share of the count in (0, 4], got {initial}")
    if not 0 < closest < proximity or not 0 <= merge_ratio <= 1 or max_iterations < 1:
        raise ValueError(
            "spawn_merge: expected 0 < closest < proximity, merge_ratio in [0, 1], max_iterations >= 1, "
            f"got {closest}, {proximity}, {merge_ratio}, {max_iterations}"
        )
    grid = first_grid(journal, max(1, round(initial * count)))
    start, spacing = grid.position, float(grid.spacing.max())
    near, least = proximity * spacing, closest * spacing
    measure = Contrast(contrast, journal.radiance(start))

    def run(threshold: float, most: int) -> _Outcome:
        position, stop, step = start, "maximum of iterations", 0
        for step in range(1, max_iterations + 1):
            radiance = journal.radiance(position)
            pair = _pairs(position, near)
            differ = measure.pairs(radiance, pair)
            merged, gone = _merge(position, pair, differ, merge_ratio * threshold)
            alive = ~gone[pair].any(1)
            wanted = pair[alive & (differ > threshold)]
            order = np.argsort(-differ[alive & (differ > threshold)], kind="stable")
            spawned = position[wanted[order]].mean(1)
            apart = np.linalg.norm(position[wanted[order, 0]] - position[wanted[order, 1]], axis=1) > 2 * least
            kept = np.concatenate([position[~gone], merged])
            kept = kept[task.in_free_space(kept)]
            spawned = spawned[apart & task.in_free_space(spawned)]
            following = np.concatenate([kept, spawned])
            following = following[distinct(following, least)]
            if len(following) > most:
                return _Outcome(following[:most], "maximum of probes", step)
            if len(following) == len(position) and np.array_equal(following, position):
                stop = "no change"
                break
            position = following
        return _Outcome(position, stop, step)

    threshold, best = _meet_count(run, count, journal)
    return journal.placement(
        best.position,
        contrast=contrast,
        contrast_threshold=threshold,
        merge_threshold=merge_ratio * threshold,
        proximity_m=near,
        closest_m=least,
        initial_probes=len(start),
        iterations=best.iterations,
        stop=best.stop,
    )


def place_spawn_merge_hierarchical(
    task: PlacementTask,
    count: int,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    contrast: ContrastKind = "samples26",
    initial: float = 0.25,
    max_depth: int = 5,
) -> Placement:
    """The hierarchical variant: cells whose eight corner probes differ are divided into eight (thesis 3.1.3).

    Args:
        task: what is known. Only its field is looked at, never the truth at its points.
        count: probes at most; the contrast threshold is the one that comes nearest to it.
        seed: not used: the method has no chance in it.
        progress: told about each run of the search for the threshold.
        contrast: how two probes are compared.
        initial: vertices of the initial grid as a share of ``count``.
        max_depth: divisions of a cell at most.

    Raises:
        ValueError: an option out of range, or no probe lies in free space.
    """
    journal = Journal(task, "spawn_merge_hierarchical", count, progress)
    if not 0 < initial <= 1:
        raise ValueError(f"spawn_merge_hierarchical initial: expected a share of the count in (0, 1], got {initial}")
    if not 1 <= max_depth <= 10:
        raise ValueError(f"spawn_merge_hierarchical max_depth: expected 1 to 10, got {max_depth}")
    low, high = task.bounds
    cells = _initial_cells(high - low, max(1, round(initial * count)))
    unit = 2**max_depth  # lattice of the finest vertices: integers name the vertices that cells share
    finest = (high - low) / (np.asarray(cells) * unit)
    corner = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(8, 3)
    roots = np.stack(np.meshgrid(*[np.arange(n) for n in cells], indexing="ij"), -1).reshape(-1, 3) * unit
    seen: dict[tuple[int, ...], np.ndarray] = {}

    def fill(vertex: np.ndarray) -> np.ndarray:
        """Radiance at integer vertices [k,3]; each is captured once for all runs."""
        new = [v for v in dict.fromkeys(map(tuple, vertex.tolist())) if v not in seen]
        if new:
            seen.update(zip(new, journal.radiance(low + np.asarray(new) * finest), strict=True))
        return np.stack([seen[v] for v in map(tuple, vertex.tolist())])

    measure = Contrast(contrast, fill((roots[:, None] + unit * corner).reshape(-1, 3)))

    def run(threshold: float, most: int) -> _Outcome:
        cell, size, stop = roots, unit, "maximum of iterations"
        vertices = dict.fromkeys(map(tuple, (cell[:, None] + size * corner).reshape(-1, 3).tolist()))
        depth = 0
        for _ in range(max_depth):
            depth += 1
            around = (cell[:, None] + size * corner).reshape(-1, 3)
            differ = measure.groups(fill(around), np.arange(len(around)).reshape(-1, 8))
            order = np.argsort(-differ, kind="stable")
            divided = cell[order[differ[order] > threshold]]
            if not len(divided):
                stop = "no change"
                break
            size //= 2
            cell = (divided[:, None] + size * corner).reshape(-1, 3)
            vertices |= dict.fromkeys(map(tuple, (cell[:, None] + size * corner).reshape(-1, 3).tolist()))
            if len(vertices) > 8 * most + len(roots) * 8:  # far beyond the count, solids or not
                stop = "maximum of probes"
                break
        position = low + np.asarray(list(vertices)) * finest
        position = position[task.in_free_space(position)]
        return _Outcome(position[:most], "maximum of probes" if len(position) > most else stop, depth)

    threshold, best = _meet_count(run, count, journal)
    return journal.placement(
        best.position,
        contrast=contrast,
        contrast_threshold=threshold,
        initial_cells=cells,
        iterations=best.iterations,
        stop=best.stop,
    )


def _meet_count(run: Callable[[float, int], _Outcome], count: int, journal: Journal) -> tuple[float, _Outcome]:
    """Contrast threshold whose run ends by itself with the most probes, ``count`` at most.

    If no threshold comes near, because the number of probes jumps, the threshold below is taken: it stops at its maximum of
    probes, the pairs of largest contrast first. Bisection in the logarithm of the threshold.
    """
    low, high = 1e-4, 1e3
    few: tuple[float, _Outcome] | None = None
    for _ in range(_SEARCH):
        threshold = float(np.sqrt(low * high))
        outcome = run(threshold, 2 * count)
        journal.note(len(outcome.position))
        if outcome.stop == "maximum of probes" or len(outcome.position) > count:
            low = threshold
            continue
        high = threshold
        if few is None or len(outcome.position) > len(few[1].position):
            few = threshold, outcome
        if len(outcome.position) >= _CLOSE_ENOUGH * count:
            break
    if few is None or len(few[1].position) < _CLOSE_ENOUGH * count:
        capped = run(low, count)
        journal.note(len(capped.position))
        if few is None or len(capped.position) > len(few[1].position):
            return low, capped
    return few


def _pairs(position: np.ndarray, distance: float) -> np.ndarray:
    """Pairs of indices [p,2] closer than ``distance``, the closest first; ties by index."""
    from scipy.spatial import KDTree

    pair = KDTree(position).query_pairs(distance, output_type="ndarray").reshape(-1, 2)
    length = np.linalg.norm(position[pair[:, 0]] - position[pair[:, 1]], axis=1)
    return np.asarray(pair[np.lexsort((pair[:, 1], pair[:, 0], np.round(length, 9)))], np.int64)


def _merge(
    position: np.ndarray, pair: np.ndarray, differ: np.ndarray, threshold: float
) -> tuple[np.ndarray, np.ndarray]:
    """Midpoints [k,3] of pairs below the threshold, the closest first, each probe once; which probes are gone [n] bool."""
    gone = np.zeros(len(position), bool)
    merged = []
    for a, b in pair[differ < threshold]:
        if not gone[a] and not gone[b]:
            gone[[a, b]] = True
            merged.append((position[a] + position[b]) / 2)
    return np.asarray(merged).reshape(-1, 3), gone


def _initial_cells(extent: np.ndarray, vertices: int) -> tuple[int, int, int]:
    """Numbers of near-cubic cells whose corners are at most ``vertices``, one along each axis at least."""
    edge = float(extent.max())
    best = (1, 1, 1)
    for n in range(1, max(2, vertices)):
        cells = np.maximum(1, np.round(extent / (edge / n))).astype(int)
        if np.prod(cells + 1) > max(vertices, 8):
            break
        best = (int(cells[0]), int(cells[1]), int(cells[2]))
    return best
