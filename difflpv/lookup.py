"""Which cells a point may use, and how much of each: side-aware weights between points on surfaces and the cells around them.

A cell's value belongs to its centre. Some of the cells around a point x on a surface with normal n have their centre behind
the surface or behind another wall; their trilinear mean then reads light from there (a leak) or the darkness of a solid (a
loss). Cells are therefore picked by sight, c_j being centres in cells and w_j their weights:

- ``"front"``: of the eight around x' = x + b h n, those whose centre lies before the surface's plane. No rays.
- ``"visible"``: of the same eight, those whose centre the point sees. Both have trilinear weights, normalised.
- ``"affine"``: of the 27 around x', those that the point sees; w_j is what a weighted least-squares fit of an affine function
  to their values gives at x itself, though no centre lies there (moving least squares: Lancaster and Salkauskas 1981).
  With d_j = c_j - x, g_j = open_j exp(-|d_j|^2 / 2 s^2) and p_j = (1, d_j):

      w_j = g_j p_j . (sum_i g_i p_i p_i^T + r sum_i g_i diag(0, 1, 1, 1))^-1 (1, 0, 0, 0)

  s = 0.8 cells. Without the ridge an affine field would be read exactly; r = 0.2 trades some of that for small slopes where
  few cells are seen. benchmarks/scenes.py compares the lookups.

``backed`` tells a wall from thin air: 1 where something stands within a cell behind the point ("front" takes that as given).
A linear stencil sends a little light back from the cells that light has reached; behind a wall nothing comes back, so a
receiver there reads too much, by a factor per degree that training finds (``LinearStencil.lookup_gains``).

A point that may use none of its cells takes the nearest of 27 that it may use; where there is none either (inside a crack)
all count. Rays have no gradient: cells are picked once and held; the weights are differentiable in the point's position.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from difflpv.coordinates import cell_coordinates, shifted_points
from difflpv.grid import Grid
from difflpv.raycast import Raycaster

__all__ = ["CellReads", "Lookup", "OpenCells", "open_cells"]

Lookup = Literal["trilinear", "damped", "front", "visible", "affine"]
_CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))
_BLOCK = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
_TINY = 1e-6  # a point this close to losing all its weight counts as having none
_SPREAD, _RIDGE = 0.8, 0.2


@dataclass(frozen=True, eq=False)
class CellReads:
    """What points read of one grid: ``cells`` [n,J] int32 with ``weights`` [n,J], and ``backed`` [n] (see ``OpenCells``)."""

    cells: torch.Tensor
    weights: torch.Tensor
    backed: torch.Tensor

    def box(self, grid: Grid) -> tuple[int, ...]:
        """The box of all these cells: (z, y, x) as (begin, end) pairs, for ``difflpv.propagation.propagate``."""
        cells = self.cells.cpu().numpy().ravel()
        n_x, n_y, n_z = grid.resolution
        if not len(cells):
            return (0, 0, 0, 0, 0, 0)
        parts = (cells // (n_x * n_y), cells // n_x % n_y, cells % n_x)
        return tuple(int(v) for part in parts for v in (part.min(), part.max() + 1))


@dataclass(frozen=True, eq=False)
class OpenCells:
    """Cells that each point may use.

    Attributes:
        cells: index into the flattened grid (x fastest), shape [n,J] int32; J is 8 or, for "affine", 27.
        centers: centres of these cells in cell coordinates, shape [n,J,3].
        open: 1 where a point may use a cell, else 0, shape [n,J]; at least one per point.
        backed: 1 where a wall stands behind the point, else 0, shape [n].
    """

    cells: torch.Tensor
    centers: torch.Tensor
    open: torch.Tensor
    backed: torch.Tensor

    def weights(
        self, position: torch.Tensor, normal: torch.Tensor, grid: Grid, *, bias: float | torch.Tensor = 0.5
    ) -> torch.Tensor:
        """Weights [n,J] of points [n,3] m with normals [n,3], each row summing to 1; differentiable in all three.

        ``bias`` is the offset of trilinear weights along the normal, in cells; affine ones are read at the point itself.
        """
        if self.cells.shape[1] == len(_BLOCK):
            # outside the grid the fit would be read ever farther from all centres, until rounding takes it (NaN from 40 cells)
            u = cell_coordinates(position, grid)
            return self._affine(torch.minimum(u.clamp_min(0), u.new_tensor(grid.resolution)))
        u = cell_coordinates(shifted_points(position, normal, grid, bias), grid)
        # beyond the outermost centres the edge cells answer, as in difflpv.sampling
        u = torch.minimum(u.clamp_min(0.5), u.new_tensor(grid.resolution) - 0.5)
        tent = (1 - (u[:, None] - self.centers).abs()).clamp_min(0).prod(-1) * self.open
        total = tent.sum(1, keepdim=True)
        even = self.open / self.open.sum(1, keepdim=True)
        return torch.where(total > _TINY, tent / total.clamp_min(_TINY), even)

    def _affine(self, u: torch.Tensor) -> torch.Tensor:
        d = self.centers - u[:, None]
        square = d.square().sum(-1)
        nearest = torch.where(self.open > 0, square, torch.inf).amin(1, keepdim=True).detach()  # keeps far points from 0 / 0
        g = self.open * torch.exp(-(square - nearest) / (2 * _SPREAD**2))
        p = torch.cat([torch.ones_like(d[..., :1]), d], -1)
        ridge = torch.diag(p.new_tensor([0.0, _RIDGE, _RIDGE, _RIDGE]))
        moments = torch.einsum("nj,nja,njb->nab", g, p, p) + g.sum(1)[:, None, None] * ridge
        first = torch.linalg.solve(moments, p.new_tensor([1.0, 0, 0, 0]).expand(len(u), 4))
        return g * torch.einsum("nja,na->nj", p, first)


def open_cells(
    position: np.ndarray,
    normal: np.ndarray,
    grid: Grid,
    *,
    mode: Literal["front", "visible", "affine"],
    raycaster: Raycaster | None = None,
    bias: float = 0.5,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> OpenCells:
    """Pick the cells that points on surfaces may use.

    Args:
        position: points on surfaces [n,3] m.
        normal: unit normals on the free side [n,3].
        grid: the volume's cells.
        mode: see the module.
        raycaster: over the scene; needed for all modes but "front".
        bias: offset along the normal at which the cells are picked, in cells.
        dtype: of the result.
        device: of the result.

    Raises:
        ValueError: an unknown mode, or one that needs a ray caster and has none.
    """
    if mode not in ("front", "visible", "affine"):
        raise ValueError(f"lookup: expected 'front', 'visible' or 'affine', got {mode!r}")
    if mode == "front":
        raycaster = None
    elif raycaster is None:
        raise ValueError(f"lookup: '{mode}' needs a raycaster")
    x, n = np.asarray(position, np.float64), np.asarray(normal, np.float64)
    h, low, size = grid.cell_size, np.asarray(grid.minimum), np.asarray(grid.resolution)
    u = np.clip((x + bias * h * n - low) / h, 0.5, size - 0.5)  # beyond the outermost centres the edge cells answer
    home = np.minimum(np.floor(u).astype(np.int64), size - 1)
    if mode == "affine":
        cells = np.clip(home[:, None] + _BLOCK, 0, size - 1)
        inside = (cells == home[:, None] + _BLOCK).all(-1)  # a cell that stands twice would count twice
        near = np.ones(cells.shape[:2])
    else:
        base = np.minimum(np.floor(u - 0.5).astype(np.int64), np.maximum(size - 2, 0))
        cells = np.minimum(base[:, None] + _CORNERS, size - 1)
        inside = np.ones(cells.shape[:2], bool)
        near = np.maximum(0, 1 - np.abs(u[:, None] - (cells + 0.5))).prod(-1)
    usable = _usable(x, n, grid.sight_centers(cells), raycaster) & inside
    backed = np.ones(len(x)) if raycaster is None else raycaster.blocked(x + 2 * raycaster.offset * n, x - h * n)
    lost = np.flatnonzero((near * usable).sum(1) <= _TINY)
    if len(lost):
        cells[lost], usable[lost] = _nearest_usable(x[lost], n[lost], cells[lost], home[lost], grid, raycaster)
        hopeless = lost[usable[lost].all(1)]
        usable[hopeless] = inside[hopeless]
    flat = (cells[..., 2] * size[1] + cells[..., 1]) * size[0] + cells[..., 0]
    return OpenCells(
        torch.as_tensor(flat.astype(np.int32), device=device),
        torch.as_tensor(cells + 0.5, dtype=dtype, device=device),
        torch.as_tensor(usable, dtype=dtype, device=device),
        torch.as_tensor(backed, dtype=dtype, device=device),
    )


def _usable(x: np.ndarray, n: np.ndarray, centers: np.ndarray, raycaster: Raycaster | None) -> np.ndarray:
    """Which centres [n,m,3] points [n,3] may use, bool [n,m]: by plane, or by sight where there is a ray caster."""
    if raycaster is None:
        return ((centers - x[:, None]) * n[:, None]).sum(-1) > 0
    origins = np.broadcast_to((x + 2 * raycaster.offset * n)[:, None], centers.shape).reshape(-1, 3)
    return ~raycaster.blocked(origins, centers.reshape(-1, 3), shortened=False).reshape(centers.shape[:2])


def _nearest_usable(
    x: np.ndarray, n: np.ndarray, cells: np.ndarray, home: np.ndarray, grid: Grid, raycaster: Raycaster | None
) -> tuple[np.ndarray, np.ndarray]:
    """Cells [m,J,3] and flags [m,J] of points that may use none of theirs: the nearest usable one of 27, else all."""
    around = np.clip(home[:, None] + _BLOCK, 0, np.asarray(grid.resolution) - 1)
    centers = grid.sight_centers(around)
    usable = _usable(x, n, centers, raycaster)
    distance = np.where(usable, ((centers - x[:, None]) ** 2).sum(-1), np.inf)
    nearest = distance.argmin(1)
    found = usable.any(1)
    flags = np.ones(cells.shape[:2], bool)
    chosen = cells.copy()
    chosen[found] = around[np.flatnonzero(found), nearest[found]][:, None]
    flags[found, 1:] = False
    return chosen, flags
