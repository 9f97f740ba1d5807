"""Which probes a set can do without, and where it lacks some: removal by least damage, spawning at the largest residual."""

from __future__ import annotations

import numpy as np
import torch

from difflpv.placement.descent import Descent, Probes
from difflpv.probes.gaussian import isotropic_metric
from difflpv.probes.rows import Rows

__all__ = ["removal_damage", "with_spawned", "without_least"]


def removal_damage(descent: Descent, probes: Probes) -> np.ndarray:
    """What the points' squared error would gain if a probe went and the others took over its weights [n].

    Relative to the square of the truth. The others keep what they hold; fitted anew, the damage is smaller.
    """
    return _damage(descent, len(probes), *descent.read(probes))


def _damage(descent: Descent, count: int, rows: Rows, held: torch.Tensor, found: torch.Tensor) -> np.ndarray:
    truth, task = descent.reconstruction.truth, descent.task
    before = (found - truth).square().sum(1)
    damage = torch.zeros(count, dtype=torch.float64)
    for probe, weight in zip(rows.probe.T, rows.weight.T[:, :, None], strict=True):
        rest = (found - weight * held[probe]) / (1 - weight).clamp_min(1e-3)
        damage.index_add_(0, probe, task.weights * ((rest - truth).square().sum(1) - before))
    return (damage / (task.weights[:, None] * truth.square()).sum()).numpy()


def without_least(descent: Descent, probes: Probes, count: int) -> Probes:
    """The probes without the ``count`` whose removal does least damage, no two of which are neighbours where that can be.

    What goes is merged into the nearest probe that stays: where nothing is in the way, this one moves to the middle of the
    two, by the weights they are read with.

    Args:
        descent: says what points read.
        probes: more than ``count``.
        count: how many go.
    """
    from scipy.spatial import KDTree

    rows, held, found = descent.read(probes)
    order = np.argsort(_damage(descent, len(probes), rows, held, found), kind="stable")
    position = np.array(probes.position)
    tree = KDTree(position)
    gone = np.zeros(len(probes), bool)
    touched = np.zeros(len(probes), bool)
    for strict in (True, False):
        for probe in order:
            if gone.sum() == count:
                break
            if not gone[probe] and not (strict and touched[probe]):
                gone[probe] = True
                touched[tree.query(position[probe], min(3, len(probes)))[1]] = True
    load = torch.zeros(len(probes), dtype=torch.float64)
    load.index_add_(0, rows.probe.flatten(), rows.weight.flatten())
    stay = np.flatnonzero(~gone)
    for probe in np.flatnonzero(gone):
        other = stay[np.linalg.norm(position[stay] - position[probe], axis=1).argmin()]
        share = float(load[probe] / (load[probe] + load[other]).clamp_min(1e-9))
        wanted = position[other] + share * (position[probe] - position[other])
        position[other] = descent.moves.moved(position[other][None], wanted[None])[0][0]
    return Probes(position, probes.metric).kept(np.flatnonzero(~gone))


def with_spawned(descent: Descent, probes: Probes, count: int) -> Probes:
    """The probes and up to ``count`` new ones at points around which most squared error lies, apart from one another."""
    from scipy.spatial import KDTree

    task = descent.task
    points = task.points.numpy()
    found = descent.read(probes)[2]
    energy = (task.weights * (found - descent.reconstruction.truth).square().sum(1)).numpy()
    low, high = task.bounds
    reach = 0.5 * float((np.prod(high - low) / (len(probes) + count)) ** (1 / 3))
    near = KDTree(points).query_ball_point(points, reach)
    around = np.array([energy[group].sum() for group in near])
    around[~descent.moves.allowed(points) | (KDTree(probes.position).query(points)[0] == 0)] = -1.0
    chosen: list[int] = []
    while len(chosen) < count and around.max() >= 0:
        chosen.append(int(around.argmax()))
        around[near[chosen[-1]]] = -1.0
    position = np.concatenate([probes.position, points[chosen]])
    if probes.metric is None:
        return Probes(position)
    fresh = isotropic_metric(torch.tensor(position)).numpy()[len(probes) :]
    return Probes(position, np.concatenate([probes.metric, fresh]))
