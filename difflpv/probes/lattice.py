"""A field known at the centres of a grid's cells, smooth in between: content of probes, distance to walls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from difflpv.grid import Grid

__all__ = ["LatticeField", "fill_from_neighbours"]


@dataclass(frozen=True, eq=False)
class LatticeField:
    """Tricubic (Catmull-Rom) interpolation: the values at the cell centres are met, first derivatives are continuous.

    Source: Catmull and Rom, "A class of local interpolating splines", 1974. Beyond the outermost centres the field is that of
    the nearest point between them.

    Attributes:
        grid: the cells.
        values: [n_z, n_y, n_x, ...] at the cell centres.
    """

    grid: Grid
    values: torch.Tensor

    def __post_init__(self) -> None:
        if tuple(self.values.shape[:3]) != self.grid.shape:
            raise ValueError(f"lattice values: expected shape {list(self.grid.shape)} first, got {list(self.values.shape)}")
        if not bool(self.values.isfinite().all()):
            raise ValueError("lattice values: expected finite numbers, got NaN or infinity")

    def __call__(self, points: torch.Tensor) -> torch.Tensor:
        """Values [m, ...] at ``points`` [m,3] m, differentiable in them; the precision is that of the values."""
        count = torch.tensor(self.grid.resolution, dtype=self.values.dtype)
        low = torch.tensor(self.grid.minimum, dtype=self.values.dtype)
        u = (points.to(self.values.dtype) - low) / self.grid.cell_size - 0.5
        u = torch.minimum(u.clamp_min(0), count - 1)
        first = u.detach().floor().minimum((count - 2).clamp_min(0))
        tap = first.long()[:, :, None] + torch.arange(-1, 3)  # [m, 3, 4]
        tap = torch.minimum(tap.clamp_min(0), count.long()[:, None] - 1)
        w = _catmull_rom(u - first)  # [m, 3, 4]
        nx, ny, _ = self.grid.resolution
        cell = (tap[:, 2, :, None, None] * ny + tap[:, 1, None, :, None]) * nx + tap[:, 0, None, None, :]
        weight = w[:, 2, :, None, None] * w[:, 1, None, :, None] * w[:, 0, None, None, :]
        rest = self.values.shape[3:]
        flat = self.values.reshape(self.grid.cell_count, -1)
        found = torch.einsum("mt,mtc->mc", weight.flatten(1), flat[cell.flatten(1)])
        return found.reshape(len(points), *rest)


def _catmull_rom(t: torch.Tensor) -> torch.Tensor:
    return torch.stack(
        [
            ((-0.5 * t + 1.0) * t - 0.5) * t,
            (1.5 * t - 2.5) * t * t + 1.0,
            ((-1.5 * t + 2.0) * t + 0.5) * t,
            (0.5 * t - 0.5) * t * t,
        ],
        -1,
    )


def fill_from_neighbours(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Replace what is not known by the value at the nearest cell that is (Euclidean distance between centres).

    Args:
        values: [n_z, n_y, n_x, ...].
        known: [n_z, n_y, n_x] bool.

    Raises:
        ValueError: nothing is known.
    """
    from scipy.ndimage import distance_transform_edt

    if not known.any():
        raise ValueError("lattice: no cell lies in free space")
    z, y, x = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return values[z, y, x]
