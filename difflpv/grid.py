"""A box of cubic cells: the lattice that a light propagation volume lives on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

__all__ = ["Grid"]

_MOST_CELLS = 2**31 - 1  # kernels count them in 32 bits
_OFF_CENTER = 1e-3 * np.array([0.618, 0.382, 0.854])


@dataclass(frozen=True)
class Grid:
    """Axis-aligned box of cubic cells.

    Attributes:
        minimum: lowest corner [m], three floats (x, y, z).
        cell_size: edge h of a cell [m].
        resolution: number of cells (n_x, n_y, n_z).

    Tensors over a grid are laid out z, y, x: a volume is ``[channels, coeffs, n_z, n_y, n_x]``.
    """

    minimum: tuple[float, float, float]
    cell_size: float
    resolution: tuple[int, int, int]

    def __post_init__(self) -> None:
        object.__setattr__(self, "minimum", tuple(float(v) for v in self.minimum))
        object.__setattr__(self, "resolution", tuple(int(v) for v in self.resolution))
        if len(self.minimum) != 3 or not np.isfinite(self.minimum).all():
            raise ValueError(f"grid minimum: expected three finite numbers, got {self.minimum}")
        if not (np.isfinite(self.cell_size) and self.cell_size > 0):
            raise ValueError(f"grid cell_size: expected a positive length, got {self.cell_size}")
        if len(self.resolution) != 3 or min(self.resolution) < 1:
            raise ValueError(f"grid resolution: expected three positive integers, got {self.resolution}")
        if math.prod(self.resolution) > _MOST_CELLS:
            raise ValueError(f"grid resolution: expected at most {_MOST_CELLS} cells in all, got {self.resolution}")

    @classmethod
    def from_bounds(cls, minimum: Any, maximum: Any, resolution: Any) -> Grid:
        """Grid over ``minimum``..``maximum`` [m]; the bounds must give cubic cells."""
        low, high = np.asarray(minimum, float), np.asarray(maximum, float)
        count = np.broadcast_to(np.asarray(resolution, int), (3,))
        if (count < 1).any() or (count != np.asarray(resolution)).any():
            raise ValueError(f"grid resolution: expected positive integers, got {np.asarray(resolution).tolist()}")
        size = (high - low) / count
        if not (size > 0).all() or size.max() - size.min() > 1e-4 * size.max():
            raise ValueError(f"grid bounds: expected cubic cells, got {count.tolist()} cells of {size.tolist()} m")
        return cls(tuple(low.tolist()), float(size[0]), tuple(count.tolist()))

    @classmethod
    def around(cls, minimum: Any, maximum: Any, cells: int) -> Grid:
        """Cube of ``cells``^3 cells centred on a bounding box, one cell of margin on the longest side."""
        low, high = np.asarray(minimum, float), np.asarray(maximum, float)
        if cells < 3:
            raise ValueError(f"grid cells: expected at least 3, got {cells}")
        edge = float((high - low).max()) * cells / (cells - 2)
        if not edge > 0:
            raise ValueError(f"grid bounds: expected a box with an extent, got {low.tolist()}..{high.tolist()}")
        return cls(tuple(((low + high) / 2 - edge / 2).tolist()), edge / cells, (cells, cells, cells))

    @property
    def maximum(self) -> tuple[float, float, float]:
        """Highest corner [m]."""
        high = np.asarray(self.minimum) + self.cell_size * np.asarray(self.resolution)
        return float(high[0]), float(high[1]), float(high[2])

    @property
    def shape(self) -> tuple[int, int, int]:
        """Tensor shape (n_z, n_y, n_x)."""
        nx, ny, nz = self.resolution
        return nz, ny, nx

    @property
    def cell_count(self) -> int:
        """Number of cells."""
        return int(np.prod(self.resolution))

    def with_cells(self, cells: int) -> Grid:
        """The same box with ``cells`` cells along its first axis.

        Where a cell's edge does not divide the other edges, the box grows at their high end by less than a cell.
        """
        if cells < 1:
            raise ValueError(f"grid cells: expected at least 1, got {cells}")
        size = self.cell_size * self.resolution[0] / cells
        nx, ny, nz = (int(np.ceil(n * self.cell_size / size - 1e-6)) for n in self.resolution)
        return Grid(self.minimum, size, (nx, ny, nz))

    def coarser(self) -> Grid:
        """The same lowest corner with cells of twice the edge; where a count is odd the box grows by a cell of this grid."""
        nx, ny, nz = (-(-n // 2) for n in self.resolution)
        return Grid(self.minimum, 2 * self.cell_size, (nx, ny, nz))

    def sight_centers(self, cells: np.ndarray | None = None) -> np.ndarray:
        """Points by which geometry tells on which side of a wall a cell is [m]: centres, a thousandth of a cell off.

        A scene that is aligned with its grid may have a wall exactly on a plane of centres; these would be on no side of it.

        Args:
            cells: indices (x, y, z), shape [..., 3]; all cells as [n_z, n_y, n_x, 3] if None.
        """
        if cells is None:
            return self.cell_centers() + self.cell_size * _OFF_CENTER
        return np.asarray(self.minimum) + self.cell_size * (np.asarray(cells) + 0.5 + _OFF_CENTER)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """True where a point [n,3] [m] lies in a cell, shape [n]."""
        u = (np.asarray(points) - np.asarray(self.minimum)) / self.cell_size
        return ((u >= 0) & (u < np.asarray(self.resolution))).all(-1)

    def cell_centers(self) -> np.ndarray:
        """Centres of all cells [m], shape [n_z, n_y, n_x, 3]."""
        axes = [self.minimum[a] + self.cell_size * (np.arange(self.resolution[a]) + 0.5) for a in range(3)]
        z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
        return np.stack([x, y, z], -1)
