"""Ours: probes where the gradient of the reconstruction error takes them, with what they hold solved for inside.

Variable projection (Golub and Pereyra 1973): for given positions the best content is a linear least-squares problem, so the
error is minimised over positions (and footprints) alone, through that solution. Descents alternate with relocations: the probes
that can be spared most go, new ones are spawned where most error is left, and the better of before and after stays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from difflpv.placement.descent import Descent, Probes
from difflpv.placement.fewest import fewest
from difflpv.placement.free_moves import FreeMoves, Region
from difflpv.placement.journal import Journal, distinct
from difflpv.placement.penalties import Penalties
from difflpv.placement.population import with_spawned, without_least
from difflpv.placement.reconstruction import Content, Reconstruction
from difflpv.placement.segments import Segments, task_digest
from difflpv.placement.task import Placement, PlacementTask, Progress
from difflpv.placement.uniform import SPREADS, uniform_grids
from difflpv.placement.unseen import Unseen
from difflpv.probes.gaussian import isotropic_metric
from difflpv.probes.reader import InterpolationName

__all__ = ["place_gradient"]

_SHAKE = 0.1  # of the distance to the nearest other probe
_KEPT = 0.9995  # of the truth's energy: 36 to 61 of 243 channels of nine light sets, the rest is noise for the most part
_SLOWEST = 0.02  # of the first step length, at the end


def place_gradient(
    task: PlacementTask,
    count: int,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    interpolation: InterpolationName = "tetrahedra",
    content: Content = "fitted",
    sight: bool = False,
    neighbours: int = 8,
    steps: int = 300,
    relocations: int = 3,
    share: float = 0.1,
    rate: float = 0.03,
    ridge: float = 0.005,
    barrier: float = 0.1,
    margin: float | None = None,
    leak: float = 0.0,
    coverage: float = 0.0,
    reach: float | None = None,
    regions: Sequence[Region] = (),
    clearance: float | None = None,
    tolerance: float | None = None,
    confidence: float = 0.95,
    checkpoint: str | Path | None = None,
) -> Placement:
    """Move probes down the gradient of the reconstruction error.

    Ctrl-C ends the work with the best probes so far; ``details["interrupted"]`` tells.

    Args:
        task: what is known.
        count: probes; with ``tolerance``, at most.
        seed: of the start, a grid whose probes are shaken by a tenth of their distance.
        progress: told every few steps.
        interpolation: points read probes in "tetrahedra", or by "gaussian" footprints that are fitted with the positions.
        content: probes hold what is "fitted" to the points, or the "field" where they are.
        sight: points read only probes that they see.
        neighbours: probes that a point reads at most, of the footprints.
        steps: of descent in all; with ``tolerance``, for each number of probes that is tried.
        relocations: how often probes are removed and spawned in between.
        share: of the probes that are relocated the first time; fewer later.
        rate: first step length as a share of the longest edge of the points' box.
        ridge: of the least squares (``fitted_content``).
        barrier: see ``Penalties``, as for the next four.
        margin: [m].
        leak: weight of reading through walls.
        coverage: weight of a minimum density.
        reach: farthest that a point may be from a probe [m], for ``coverage``.
        regions: boxes that probes may stand in; the box of the points if empty.
        clearance: least distance of probes to any triangle [m]; see ``FreeMoves``.
        tolerance: if given, end with the fewest probes whose error meets it at points and under lights that were held out
            (``Unseen``).
        confidence: with which that error is below the tolerance, in [0.5, 1).
        checkpoint: file that is written after each part and read when the same work is started again; None for none.

    Returns:
        Probes in free space. ``radiance`` is None for content "field".

    Raises:
        ValueError: an option out of range, or no probe lies in free space.
        CheckpointError: the checkpoint cannot be read, or belongs to other work.
    """
    if steps < 1 or relocations < 0 or not 0 <= share <= 0.5 or not 0 < rate <= 0.5:
        raise ValueError(
            "gradient: expected steps >= 1, relocations >= 0, share in [0, 0.5], rate in (0, 0.5], "
            f"got {steps}, {relocations}, {share}, {rate}"
        )
    if tolerance is not None and not 0 < tolerance < 1:
        raise ValueError(f"gradient tolerance: expected a relative error between 0 and 1, got {tolerance}")
    if not 0.5 <= confidence < 1:
        raise ValueError(f"gradient confidence: expected a number in [0.5, 1), got {confidence}")
    journal = Journal(task, "gradient", count, progress)
    penalties = Penalties(barrier=barrier, margin=margin, leak=leak, coverage=coverage, reach=reach)

    def descent_on(part: PlacementTask) -> Descent:
        error = Reconstruction(part, content, ridge=ridge, kept=_KEPT)
        return Descent(error, penalties, FreeMoves(task, regions, clearance=clearance), interpolation, neighbours, sight)

    identity = {
        "task": task_digest(task), "count": count, "seed": seed, "interpolation": interpolation, "content": content,
        "sight": sight, "neighbours": neighbours, "steps": steps, "relocations": relocations, "share": share, "rate": rate,
        "ridge": ridge, "barrier": barrier, "margin": margin, "leak": leak, "coverage": coverage, "reach": reach,
        "regions": [[list(map(float, corner)) for corner in region] for region in regions], "tolerance": tolerance,
        "clearance": clearance, "confidence": confidence,
    }  # fmt: skip
    segments = Segments(journal, checkpoint, identity)
    work = _Work(segments, steps, relocations, share, rate, seed)
    details: dict[str, Any] = {"interrupted": False}
    try:
        if tolerance is None:
            work.placed(descent_on(task), count)
        else:
            unseen = Unseen.of(task)
            details |= fewest(
                descent_on(unseen.train), unseen, work.placed, segments, most=count, tolerance=tolerance, confidence=confidence
            )
    except KeyboardInterrupt:
        if segments.best is None:
            raise
        details["interrupted"] = True
    assert segments.best is not None
    best = segments.best.kept(distinct(segments.best.position, 0.0))  # a region's corner may have caught several
    descent = replace(descent_on(task), reconstruction=Reconstruction(task, content, ridge=ridge))
    details["training_error"] = descent.error(best)
    radiance = None if content == "field" else descent.content(best)
    return journal.placement(best.position, radiance=radiance, reader=descent.settled(best), **details)


@dataclass(frozen=True)
class _Work:
    """Places so many probes by segments of descent and relocations between them."""

    segments: Segments
    steps: int
    relocations: int
    share: float
    rate: float
    seed: int

    def placed(self, descent: Descent, count: int, start: Probes | None = None) -> Probes:
        """So many probes, from ``start`` (a shaken grid, if None)."""
        best = _start(descent, self.segments.journal, count, self.seed) if start is None else start
        self.segments.best, least = best, math.inf

        def descended(probes: Probes, steps: int, first: float, last: float) -> None:
            nonlocal best, least
            found, error = self.segments.run(descent, probes, steps, first, last)
            if error < least:
                self.segments.best = best = found
                least = error

        each = max(1, self.steps // (2 * self.relocations + 2))
        for number in range(self.relocations):
            length = self.rate * (1 - number / (self.relocations + 1))
            descended(best, each, length, 0.5 * length)
            gone = round(self.share * len(best) * (1 - number / self.relocations))
            if gone and len(best) > gone:
                fewer = without_least(descent, best, gone)
                descended(with_spawned(descent, fewer, gone), each, length, 0.5 * length)
        descended(best, 2 * each, self.rate / (self.relocations + 1), _SLOWEST * self.rate)
        return best


def _start(descent: Descent, journal: Journal, count: int, seed: int) -> Probes:
    """The grid of least error, shaken, filled up where most error is."""
    best: tuple[float, Probes] | None = None
    random = np.random.default_rng(seed)
    for spread in SPREADS:
        for grid in uniform_grids(journal.task, count, spread):
            position = grid.position[descent.moves.allowed(grid.position)]
            if not len(position):
                continue
            shaken = position + _SHAKE * grid.spacing * random.uniform(-1, 1, position.shape)
            position = descent.moves.moved(position, shaken)[0]
            probes = _with_footprints(descent, position)
            error = descent.error(probes)
            journal.evaluations += 1
            if best is None or error < best[0]:
                best = error, probes
    if best is None:  # narrow regions between the probes of all grids: one at a point in them, more are spawned
        inside = journal.task.points.numpy()
        inside = inside[descent.moves.allowed(inside)]
        if not len(inside):
            raise journal.nothing_free()
        best = math.inf, _with_footprints(descent, inside[:1])
    missing = count - len(best[1])
    return with_spawned(descent, best[1], missing) if missing else best[1]


def _with_footprints(descent: Descent, position: np.ndarray) -> Probes:
    if descent.interpolation == "tetrahedra":
        return Probes(position)
    return Probes(position, isotropic_metric(torch.as_tensor(position)).numpy())
