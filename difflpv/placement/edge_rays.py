"""Rays along the edges of tetrahedra against leaking (light probe thesis 3.2.2).

Where a wall cuts an edge, the light on its two sides has nothing to do with each other, and interpolation across it leaks. A
ray from each end of the edge finds the side of the wall that faces it, and a probe is put there. Three rules keep clusters
away: a surface that the ray grazes does not count; nor does one that is nearer to an end of the edge than a share of its length
(figure 14 of the thesis); and no probe is put where another one that sees it stands already (ours: the tetrahedra around one
vertex behind a wall cut it in almost one place many times over, "Oversampling and dense clusters").
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from difflpv.placement.task import Placement, PlacementTask, Progress
from difflpv.probes.tetrahedra import Tetrahedra
from difflpv.raycast import Raycaster

__all__ = ["tetrahedra_cut_by_walls", "with_edge_rays"]

_OFFSET_SHARE = 0.02  # of an edge's length: how far off a wall its probes stand


def tetrahedra_cut_by_walls(raycaster: Raycaster, position: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """True for tetrahedra [t,4] of probes at ``position`` [n,3] m with an edge that meets a surface, either way: shape [t].

    Any simplices will do: rows of the probes that points read [m,k] say which of these points read across a wall.
    """
    first, second = np.triu_indices(tetrahedra.shape[1], 1)
    pairs = np.sort(np.stack([tetrahedra[:, first], tetrahedra[:, second]], -1), -1)
    edges, of_cell = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
    a, b = position[edges[:, 0]], position[edges[:, 1]]
    cut = raycaster.blocked_from_either_end(a, b)
    return np.asarray(cut[of_cell.reshape(len(tetrahedra), len(first))].any(1))


def with_edge_rays(
    task: PlacementTask,
    placement: Placement,
    *,
    count: int | None = None,
    rounds: int = 1,
    end_share: float = 0.1,
    separation: float = 0.25,
    grazing: float = 0.1,
    progress: Progress | None = None,
) -> Placement:
    """Put a probe on either side of every wall that cuts an edge of the probes' tetrahedra.

    Args:
        task: its scene has the walls.
        placement: probes as any method left them. Their content is given up for the field's values: fit it again.
        count: probes in the end at most, no limit if None; the longest edges come first.
        rounds: how often the tetrahedra of all probes are made anew and looked at; new edges may be cut again.
        end_share: a wall nearer to an end of the edge than this share of its length adds no probe there.
        separation: no probe is put where another that sees it is nearer than this share of the edge's length.
        grazing: cosine between ray and normal below which a ray runs along the surface.
        progress: told about each round.

    Returns:
        The placement with the new probes after the old ones; ``details`` says how many edges were cut and probes refused.

    Raises:
        ValueError: an option out of range, or footprints, which new probes would not have.
    """
    if placement.reader.metric is not None:
        raise ValueError("edge rays: expected probes that are read in tetrahedra, got gaussian footprints")
    if rounds < 1 or not 0 <= end_share < 0.5 or not 0 <= separation <= 1 or not 0 <= grazing < 1:
        raise ValueError(
            "edge rays: expected rounds >= 1, end_share in [0, 0.5), separation in [0, 1], grazing in [0, 1), "
            f"got {rounds}, {end_share}, {separation}, {grazing}"
        )
    start = time.perf_counter()
    position, cut, refused = np.array(placement.position), [], 0
    for step in range(rounds):
        before = len(position)
        position, edges_cut, no = _one_round(task, position, count, end_share, separation, grazing)
        cut.append(edges_cut)
        refused += no
        if progress is not None:
            progress(step, float("nan"), len(position))
        if len(position) == before:
            break
    details = dict(placement.details) | {
        "edge_ray_probes": len(position) - len(placement),
        "edges_cut": tuple(cut),
        "edge_ray_probes_refused": refused,
    }
    return replace(
        placement,
        method=f"{placement.method}+edge_rays",
        position=position,
        radiance=None,
        seconds=placement.seconds + time.perf_counter() - start,
        details=details,
    )


def _one_round(
    task: PlacementTask,
    position: np.ndarray,
    count: int | None,
    end_share: float,
    separation: float,
    grazing: float,
) -> tuple[np.ndarray, int, int]:
    """Old and new positions, edges cut, and probes that the rules refused."""
    edges = Tetrahedra.of(position).edges
    rays = np.concatenate([edges, edges[:, ::-1]])
    origin, delta = position[rays[:, 0]], position[rays[:, 1]] - position[rays[:, 0]]
    length = np.linalg.norm(delta, axis=1)
    direction = delta / np.maximum(length, 1e-30)[:, None]
    hits = task.raycaster.closest(origin, direction)
    met = hits.valid & (hits.distance < length)
    edges_cut = int(met.reshape(2, -1).any(0).sum())
    normal = task.scene.triangle_normals[np.where(met, hits.triangle, 0)]
    across = np.abs((normal * direction).sum(1)) > grazing
    inside = (hits.distance > end_share * length) & (hits.distance < (1 - end_share) * length)
    chosen = np.flatnonzero(met & across & inside)
    chosen = chosen[np.lexsort((rays[chosen, 1], rays[chosen, 0], -np.round(length[chosen], 9)))]
    refused = int(met.sum()) - len(chosen)
    most = np.inf if count is None else count
    # A little off the surface, on the side that the ray comes from.
    facing = normal * -np.sign((normal * direction).sum(1))[:, None]
    room = np.minimum(_OFFSET_SHARE * length, 0.5 * hits.distance)[:, None]
    placed = np.where(met[:, None], origin + np.where(met, hits.distance, 0.0)[:, None] * direction + room * facing, 0.0)
    free = task.in_free_space(placed[chosen]) & ~task.raycaster.blocked(origin[chosen], placed[chosen], shortened=False)
    everything = list(position)
    for ray, is_free in zip(chosen, free, strict=True):
        if len(everything) >= most:
            break
        near = np.asarray(everything)
        near = near[np.linalg.norm(near - placed[ray], axis=1) < separation * length[ray]]
        from_here = np.broadcast_to(placed[ray], near.shape)
        if not is_free or not task.raycaster.blocked(from_here, near, shortened=False).all():
            refused += 1
            continue
        everything.append(placed[ray])
    return np.asarray(everything), edges_cut, refused
