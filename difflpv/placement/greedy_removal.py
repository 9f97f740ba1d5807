"""Greedy removal: from a dense set, always the probes whose loss does least damage at the evaluation points.

Source: Vardis, Vasilakis and Papaioannou, "Illumination-driven light probe placement", Eurographics 2021 posters. Damage is
what the removal adds to the symmetric mean absolute percentage error of irradiance over the evaluation points and 26 normals,

    SMAPE = mean of |E - T| / (|E| + |T|),

with content by the field and tetrahedral interpolation. Only points that read a probe notice its removal, and the hole that it
leaves is filled by the tetrahedra of its neighbours alone: one small triangulation for each candidate, not a large one. Probes
that share no edge do not disturb each other's damage, so several go in one round.
"""

from __future__ import annotations

import numpy as np
import torch

from difflpv.placement.journal import Journal
from difflpv.placement.task import Placement, PlacementTask, Progress
from difflpv.placement.uniform import first_grid
from difflpv.probes.probe_set import DIRECTIONS_26, irradiance_of
from difflpv.probes.tetrahedra import Tetrahedra, TetrahedralInterpolation

__all__ = ["place_greedy_removal"]


def place_greedy_removal(
    task: PlacementTask,
    count: int,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    dense: float = 4.0,
    most: int = 1000,
    batch: float = 0.05,
    points: int = 2000,
) -> Placement:
    """Greedy removal from a dense uniform grid.

    Args:
        task: what is known.
        count: probes in the end.
        seed: of the choice of evaluation points, where the task has more than ``points``.
        progress: told about each round, with the SMAPE.
        dense: probes of the dense set as a multiple of ``count``.
        most: probes of the dense set at most; never fewer than ``count``.
        batch: share of the probes that may go in one round; 0 for one at a time.
        points: evaluation points at most.

    Raises:
        ValueError: an option out of range, or no probe lies in free space.
    """
    journal = Journal(task, "greedy_removal", count, progress)
    if not 1 <= dense <= 64 or most < 1 or points < 1 or not 0 <= batch <= 0.5:
        raise ValueError(
            "greedy_removal: expected dense in [1, 64], most >= 1, points >= 1, batch in [0, 0.5], "
            f"got {dense}, {most}, {points}, {batch}"
        )
    position = first_grid(journal, max(count, min(most, round(dense * count)))).position
    reader = _Reader(task, journal.radiance(position), points, seed)
    alive, rounds = np.arange(len(position)), 0
    while len(alive) > count:
        here = reader.read(position[alive], alive)
        edges = Tetrahedra.of(position[alive]).edges
        neighbours = _neighbours(edges, len(alive))
        damage = np.array([reader.damage(position[alive], alive, k, neighbours[k], here) for k in range(len(alive))])
        wanted = min(len(alive) - count, max(1, int(batch * len(alive))))
        alive = np.delete(alive, _independent(damage, neighbours, wanted))
        rounds += 1
        journal.note(len(alive), here.smape)
    final = reader.read(position[alive], alive).smape
    journal.note(len(alive), final)
    return journal.placement(position[alive], dense_probes=len(position), rounds=rounds, smape=final)


class _Reading:
    """What the evaluation points read: probes [m,k], weights [m,k], each point's error [m], and their mean."""

    def __init__(self, probe: np.ndarray, weight: np.ndarray, error: np.ndarray, total: float) -> None:
        self.probe, self.weight, self.error = probe, weight, error
        self.smape = float(error.sum() / total)
        reads, self._column = np.nonzero(weight > 0)
        order = np.argsort(probe[reads, self._column], kind="stable")
        self._point, self._probe = reads[order], probe[reads, self._column][order]

    def readers(self, probe: int) -> np.ndarray:
        """Points that read a probe."""
        first, last = np.searchsorted(self._probe, [probe, probe + 1])
        return self._point[first:last]


class _Reader:
    """Irradiance of all probes of the dense set, and the truth at the evaluation points, ready to be compared."""

    def __init__(self, task: PlacementTask, radiance: np.ndarray, points: int, seed: int) -> None:
        chosen = np.arange(len(task.points))
        if len(chosen) > points:
            chosen = np.sort(np.random.default_rng(seed).choice(len(chosen), points, replace=False))
        self._points = task.points[chosen]
        self._weight = task.weights[chosen].numpy()
        self._truth = irradiance_of(task.radiance[chosen].numpy(), DIRECTIONS_26).reshape(len(chosen), -1)
        self._content = irradiance_of(radiance, DIRECTIONS_26).reshape(len(radiance), -1)

    def _errors(self, position: np.ndarray, alive: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Probes, weights and weighted error of points, read from the probes ``alive`` at ``position``."""
        with torch.no_grad():
            rows = TetrahedralInterpolation(position).rows(torch.as_tensor(position), self._points[point])
        probe, weight = rows.probe.numpy(), rows.weight.numpy()
        E, T = np.einsum("mk,mkc->mc", weight, self._content[alive[probe]]), self._truth[point]
        error = np.abs(E - T) / np.maximum(np.abs(E) + np.abs(T), 1e-12)
        return probe, weight, self._weight[point] * error.mean(1)

    def read(self, position: np.ndarray, alive: np.ndarray) -> _Reading:
        """All points from all probes that are left."""
        return _Reading(*self._errors(position, alive, np.arange(len(self._points))), float(self._weight.sum()))

    def damage(
        self, position: np.ndarray, alive: np.ndarray, probe: int, neighbours: np.ndarray, here: _Reading
    ) -> float:
        """What the sum of errors gains if a probe goes and its neighbours fill the hole."""
        point = here.readers(probe)
        if not len(point) or not len(neighbours):
            return 0.0
        return float((self._errors(position[neighbours], alive[neighbours], point)[2] - here.error[point]).sum())


def _neighbours(edges: np.ndarray, count: int) -> list[np.ndarray]:
    """Probes that share an edge with each of ``count`` probes."""
    both = np.concatenate([edges, edges[:, ::-1]])
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    return np.split(both[:, 1], np.searchsorted(both[:, 0], np.arange(1, count)))


def _independent(damage: np.ndarray, neighbours: list[np.ndarray], wanted: int) -> list[int]:
    """At most ``wanted`` probes of least damage, no two of which share an edge; ties by index."""
    chosen: list[int] = []
    touched = np.zeros(len(damage), bool)
    for k in np.argsort(damage, kind="stable"):
        if not touched[k]:
            chosen.append(int(k))
            touched[neighbours[k]] = True
            if len(chosen) == wanted:
                break
    return chosen
