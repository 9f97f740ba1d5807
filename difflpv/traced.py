"""Traced occlusion: the share of light that passes between neighbouring cells, by rays between them.

For an offset n the transmittance T[n,c] of the pair of cells c and c + n is the share of unblocked segments p -> p + h n
over a regular grid of points p in c, among those whose ends both see their own cell's centre: a wall through a cell then
belongs to the side that the centre is not on, so that a closed wall has T = 0 exactly, wherever it cuts the cells, and an
edge, a grille or a column thinner than a cell a share between 0 and 1. Where no point sees its centre, the segment between
the centres decides. T is the same both ways: 13 numbers a cell for 26 neighbours. It multiplies whole offsets of a linear
stencil, and every face towards the neighbour of a face stencil.
``difflpv.attenuation`` makes it tunable.
"""

from __future__ import annotations

import itertools

import numpy as np
import torch

from difflpv.grid import Grid
from difflpv.raycast import Raycaster

__all__ = ["face_transmittance", "pair_transmittance"]

_PAIRS_PER_CHUNK = 1 << 19
_CLEARANCE = 0.05  # of the ray caster's offset, eight float32 ulps: closer behind a wall a start passes for one before it


def pair_transmittance(
    raycaster: Raycaster, triangles: np.ndarray, grid: Grid, offsets: np.ndarray, *, rays_per_axis: int = 2
) -> np.ndarray:
    """Transmittance of every pair of neighbouring cells.

    Args:
        raycaster: over the scene.
        triangles: the scene's triangles [t,3,3] m: pairs that come near none of them are free without a ray.
        grid: the volume's cells.
        offsets: one offset (x, y, z) of each pair, shape [P,3] (``difflpv.stencil.pair_offsets``).
        rays_per_axis: segments per pair start on a grid of so many points along each edge of the cell: 1, 8 or 27 segments.

    Returns:
        Share that passes between cell c and c + offset, shape [P, n_z, n_y, n_x] float32, towards cells outside the grid
        too.

    Raises:
        ValueError: fewer than one ray.
    """
    if rays_per_axis < 1:
        raise ValueError(f"rays_per_axis: expected at least 1, got {rays_per_axis}")
    around = _with_margin(grid)
    near_around = _near_geometry(triangles, around)
    near = np.ascontiguousarray(near_around[1:-1, 1:-1, 1:-1])
    centers = grid.sight_centers().reshape(-1, 3)
    passed = np.ones((len(offsets), *grid.shape), np.float32)
    axis = (np.arange(rays_per_axis) + 0.5) / rays_per_axis - 0.5
    starts = np.array(list(itertools.product(axis, repeat=3))) * grid.cell_size
    sees = _seen_from_centers(raycaster, around, near_around, starts)
    padded = np.arange(sees[0].size).reshape(sees.shape[1:])[1:-1, 1:-1, 1:-1].ravel()  # of each cell, in ``sees``
    sees = sees.reshape(len(starts), -1)
    strides = np.array([1, grid.resolution[0] + 2, (grid.resolution[0] + 2) * (grid.resolution[1] + 2)])
    for row, offset in zip(passed, np.asarray(offsets), strict=True):
        where = np.flatnonzero(_any_in_block(near, offset))
        for begin in range(0, len(where), _PAIRS_PER_CHUNK):
            chosen = where[begin : begin + _PAIRS_PER_CHUNK]
            both = sees[:, padded[chosen]] & sees[:, padded[chosen] + int(strides @ offset)]
            row.reshape(-1)[chosen] = _share(raycaster, centers[chosen], grid.cell_size * offset, starts, both)
    return passed


def _with_margin(grid: Grid) -> Grid:
    """The grid and the cells around it."""
    (x, y, z), (columns, rows, layers), h = grid.minimum, grid.resolution, grid.cell_size
    return Grid((x - h, y - h, z - h), h, (columns + 2, rows + 2, layers + 2))


def _seen_from_centers(raycaster: Raycaster, grid: Grid, near: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Which starts [s,3] m from its centre each cell's centre sees, bool [s, n_z, n_y, n_x]: all, where none is ``near``.

    One ray per cell and start, for all the pairs that the cell is in.
    """
    sees = np.ones((len(starts), *grid.shape), bool)
    if len(starts) > 1:  # the centre sees itself
        cells = np.flatnonzero(near)
        center = grid.sight_centers().reshape(-1, 3)[cells]
        for row, start in zip(sees, starts, strict=True):
            beyond = start * (1 + _CLEARANCE * raycaster.offset / max(float(np.linalg.norm(start)), 1e-30))
            row.reshape(-1)[cells] = ~raycaster.blocked(center, center + beyond, shortened=False)
    return sees


def _share(raycaster: Raycaster, center: np.ndarray, step: np.ndarray, starts: np.ndarray, both: np.ndarray) -> np.ndarray:
    """Share of free segments between cells at ``center`` [m,3] and ``center + step``, shape [m].

    ``both`` [s,m] tells which starts the centres at both ends see: others lie behind a wall that cuts a cell.
    """

    def unblocked(origins: np.ndarray, targets: np.ndarray) -> np.ndarray:
        return ~raycaster.blocked(origins, targets, shortened=False)

    free, counted = np.zeros(len(center)), both.sum(0)
    for start, seen in zip(starts, both, strict=True):
        valid = np.flatnonzero(seen)
        free[valid] += unblocked(center[valid] + start, center[valid] + start + step)
    alone = np.flatnonzero(counted == 0)
    free[alone] = unblocked(center[alone], center[alone] + step)
    return free / np.maximum(counted, 1)


def _near_geometry(triangles: np.ndarray, grid: Grid) -> np.ndarray:
    """Cells whose box meets the bounding box of a triangle, bool [n_z, n_y, n_x]."""
    corners = np.asarray(triangles, np.float64).reshape(-1, 3, 3)
    size = np.asarray(grid.resolution)
    margin = 1e-2 * grid.cell_size
    low = np.floor((corners.min(1) - margin - grid.minimum) / grid.cell_size)
    high = np.floor((corners.max(1) + margin - grid.minimum) / grid.cell_size)
    meets = ((high >= 0) & (low < size)).all(1)
    boxes = np.concatenate([np.clip(low, 0, size - 1), np.clip(high, 0, size - 1)], 1)[meets].astype(int)
    near = np.zeros(grid.shape, bool)
    for x0, y0, z0, x1, y1, z1 in np.unique(boxes, axis=0).tolist():
        near[z0 : z1 + 1, y0 : y1 + 1, x0 : x1 + 1] = True
    return near


def _any_in_block(near: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """True where a cell of the block from c to c + offset is near geometry; cells outside the grid are not."""
    found = near
    for axis, step in zip((2, 1, 0), offset, strict=True):
        if step:
            moved = np.roll(found, -int(step), axis)
            edge: list[slice | int] = [slice(None)] * 3
            edge[axis] = -1 if step > 0 else 0
            moved[tuple(edge)] = False
            found = found | moved
    return found


def face_transmittance(pairs: torch.Tensor, pair_offsets: np.ndarray, offsets: np.ndarray) -> torch.Tensor:
    """Transmittance of pairs, laid out for the faces of a face stencil.

    Args:
        pairs: share that passes between c and c + pair offset, shape [P, n_z, n_y, n_x].
        pair_offsets: shape [P,3].
        offsets: destination minus source cell of each face, shape [F,3]: each a pair offset or its opposite.

    Returns:
        At the source cell, shape [F, n_z, n_y, n_x]; 1 towards cells outside the grid. Gradients reach ``pairs``.
    """
    index = {tuple(int(v) for v in offset): i for i, offset in enumerate(pair_offsets)}
    rows = []
    for offset in np.asarray(offsets).tolist():
        if tuple(offset) in index:
            rows.append(pairs[index[tuple(offset)]])
            continue
        row = pairs[index[tuple(-v for v in offset)]]
        for axis, step in zip((2, 1, 0), offset, strict=True):  # the pair is stored at the other cell, c + offset
            if step:
                row = torch.roll(row, -step, axis)
        rows.append(row)
    stacked = torch.stack(rows)
    inside = torch.as_tensor(_inside(np.asarray(offsets), tuple(pairs.shape[1:])), device=pairs.device)
    return torch.where(inside, stacked, torch.ones_like(stacked))


def _inside(offsets: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Which destinations lie in the grid, bool [F, n_z, n_y, n_x]."""
    z, y, x = np.meshgrid(*(np.arange(n) for n in shape), indexing="ij")
    cell = np.stack([x, y, z], -1)[None] + offsets[:, None, None, None]
    return ((cell >= 0) & (cell < np.array(shape[::-1]))).all(-1)
