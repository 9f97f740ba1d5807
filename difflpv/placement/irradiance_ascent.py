"""Gradient ascent of irradiance: probes climb toward the brightest side (light probe thesis 3.1.2 and 3.1.3).

    x <- x + s min(1, |g| / g_0) g / |g|,     g = sum over 26 directions d of Y(d) d

with Y the luminance of the irradiance, s a step and g_0 the median of |g| at the start. The "irradiance gradient" of Chajdas,
Weis and Westermann (SIGRAD 2011) is this sum at one point; no derivative is taken. Probes that climb onto a light or through a
wall are what the thesis found next: hence direct light is left out (``indirect``), and a step into darkness is taken back and
halved (``backtrack``). Probes that start in the dark do not move: k-means makes a few of them. What ends together is merged.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from difflpv.placement.contrast import luminance
from difflpv.placement.journal import Journal
from difflpv.placement.task import Placement, PlacementTask, Progress
from difflpv.placement.uniform import first_grid
from difflpv.probes.lattice import LatticeField
from difflpv.probes.probe_set import DIRECTIONS_26, irradiance_of

__all__ = ["place_irradiance_ascent"]


def place_irradiance_ascent(
    task: PlacementTask,
    count: int,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    indirect: LatticeField | None = None,
    backtrack: bool = True,
    initial: float = 1.5,
    dark: float = 0.01,
    dark_share: float = 0.1,
    max_iterations: int = 60,
    step: float = 0.25,
    stop_step: float = 0.02,
    until: Literal["count", "converged"] = "count",
    together: float = 0.5,
) -> Placement:
    """Gradient ascent of irradiance from a uniform grid.

    Args:
        task: what is known. Only its field is looked at, never the truth at its points.
        count: probes at most: probes that end nearest to each other are merged until so many are left.
        seed: of the k-means clustering.
        progress: told about each iteration.
        indirect: radiance SH [9,C] without direct light, which is what probes climb ("light decoupling"); the task's field,
            with whatever light it holds, if None.
        backtrack: take a step back, and halve it, where it leads into darkness, into a solid or through a surface.
        initial: probes of the initial grid as a share of ``count``.
        dark: a probe is dark below this share of the mean luminance.
        dark_share: of ``count``, at most, are probes of dark areas.
        max_iterations: of the ascent.
        step: first step of probes of median gradient or more, as a share of the grid's smallest spacing.
        stop_step: the ascent ends when no probe moves by this share of the spacing.
        until: end the ascent when so many probes have met that ``count`` are left, or go on until they stand still, when all
            of them may have met at the lights.
        together: probes nearer than this share of the spacing have met and are merged.

    Raises:
        ValueError: an option out of range, or no probe lies in free space.
    """
    journal = Journal(task, "irradiance_ascent", count, progress)
    if not 0 < initial <= 8:
        raise ValueError(f"irradiance_ascent initial: expected a share of the count in (0, 8], got {initial}")
    if not 0 <= dark < 1 or not 0 <= dark_share <= 1:
        raise ValueError(f"irradiance_ascent: expected dark in [0, 1) and dark_share in [0, 1], got {dark}, {dark_share}")
    if until not in ("count", "converged"):
        raise ValueError(f"irradiance_ascent until: expected count or converged, got '{until}'")
    if not 0 < together <= 1:
        raise ValueError(f"irradiance_ascent together: expected a share of the spacing in (0, 1], got {together}")
    if max_iterations < 0 or not 0 < stop_step <= step:
        raise ValueError(
            "irradiance_ascent: expected max_iterations >= 0 and 0 < stop_step <= step, "
            f"got {max_iterations}, {stop_step}, {step}"
        )
    grid = first_grid(journal, max(1, round(initial * count)))
    start, spacing = grid.position, float(grid.spacing.min())
    climbed = task.field if indirect is None else indirect

    def look(position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean luminance [n] and summed gradient [n,3] of all lights."""
        Y = luminance(irradiance_of(journal.radiance(position, climbed), DIRECTIONS_26)).sum(-1)
        return Y.mean(1), Y @ DIRECTIONS_26

    brightness, gradient = look(start)
    limit = dark * float(brightness.mean())
    unlit = brightness <= limit
    position, fell = start[~unlit], np.zeros(int((~unlit).sum()), bool)
    gradient = gradient[~unlit]
    length = np.full(len(position), step * spacing)
    # Even light has no direction: rounding must not become one.
    typical = max(float(np.median(np.linalg.norm(gradient, axis=1))) if len(gradient) else 0.0, 1e-6 * float(brightness.max()))
    dark_count = min(int(unlit.sum()), int(dark_share * count) if len(position) else count)
    stop, iteration, reverted = "maximum of iterations", 0, 0
    for _ in range(max_iterations):
        iteration += 1
        move = length[:, None] * gradient / max(typical, 1e-30)
        move *= np.minimum(1.0, length / np.maximum(np.linalg.norm(move, axis=1), 1e-30))[:, None]
        there = position + move
        bright, slope = look(there)
        behind = ~task.in_free_space(there) | task.raycaster.blocked(position, there, shortened=False)
        if backtrack:
            bad = behind | (bright <= limit)
            there[bad], slope[bad] = position[bad], gradient[bad]
            reverted += int(bad.sum())
        else:
            bad = np.zeros(len(there), bool)
            fell |= behind
        turned = (slope * gradient).sum(1) < 0  # beyond the summit
        length[bad | turned] /= 2
        moved = np.linalg.norm(there - position, axis=1)
        position, gradient = there, slope
        journal.note(len(position) + int(unlit.sum()))
        if not bad.any() and (moved < stop_step * spacing).all() or (length < stop_step * spacing).all():
            stop = "steps below the threshold"
            break
        if until == "count" and len(_groups(position, together * spacing)) <= count - dark_count:
            stop = "wanted number of probes"
            break
    free = task.in_free_space(position)
    lit, lost = position[free], int((~free).sum())
    darkness = _cluster_dark(start[unlit], dark_count, seed)
    lit = _merge_together(task, lit, count - len(darkness), together * spacing)
    return journal.placement(
        np.concatenate([lit, darkness]),
        initial_probes=len(start),
        dark_start=int(unlit.sum()),
        dark_probes=len(darkness),
        steps_taken_back=reverted,
        behind_surfaces=int(fell.sum()),
        lost_in_solids=lost,
        iterations=iteration,
        stop=stop,
    )


def _cluster_dark(position: np.ndarray, clusters: int, seed: int) -> np.ndarray:
    """One position [k,3] of those given for each k-means cluster: the one nearest to its centre, which is in free space."""
    from scipy.cluster.vq import kmeans2

    if clusters < 1:
        return np.empty((0, 3))
    if len(position) <= clusters:
        return position
    centers, label = kmeans2(position, clusters, minit="++", rng=np.random.default_rng(seed), missing="warn")
    nearest = []
    for k in range(clusters):
        own = np.flatnonzero(label == k)
        if len(own):
            nearest.append(own[np.linalg.norm(position[own] - centers[k], axis=1).argmin()])
    return position[sorted(nearest)]


def _groups(position: np.ndarray, distance: float, most: int | None = None) -> list[np.ndarray]:
    """Probes [n,3] grouped by average linkage up to ``distance`` m, and beyond it until at most ``most`` groups are left."""
    from scipy.cluster.hierarchy import fcluster, linkage

    if len(position) < 2:
        return [position] if len(position) else []
    tree = linkage(position, "average")
    label = fcluster(tree, distance, "distance")
    if most is not None and label.max() > most:
        label = fcluster(tree, most, "maxclust")
    return [position[label == k] for k in range(1, label.max() + 1)]


def _merge_together(task: PlacementTask, position: np.ndarray, count: int, distance: float) -> np.ndarray:
    """Merge probes [n,3] within ``distance`` m, and the nearest ones beyond it until ``count`` are left.

    A group becomes its mean, or the member nearest to it where the mean is not in free space.
    """
    groups = _groups(position, distance, count) if count > 0 else []
    if not groups:
        return np.empty((0, 3))
    mean = np.stack([group.mean(0) for group in groups])
    member = np.stack([g[np.linalg.norm(g - m, axis=1).argmin()] for g, m in zip(groups, mean, strict=True)])
    return np.where(task.in_free_space(mean)[:, None], mean, member)
