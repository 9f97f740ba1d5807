"""Points in a grid: checks shared by the stages that read points, and cell coordinates.

Cell coordinates are u = (x - minimum) / h: cell i of an axis covers [i, i+1) and has its centre at i + 1/2.
"""

from __future__ import annotations

import math

import torch

from difflpv.bridge import check_float
from difflpv.grid import Grid

__all__ = ["cell_coordinates", "check_factor", "check_finite", "check_points", "check_volume", "shifted_points"]


def check_points(
    name: str, points: torch.Tensor, *, like: torch.Tensor | None = None, count: int | None = None
) -> None:
    """Raise unless ``points`` is a finite float tensor [n,3] (``count`` rows, dtype and device of ``like``)."""
    check_float(name, points, like=like)
    if points.ndim != 2 or points.shape[1] != 3 or (count is not None and points.shape[0] != count):
        rows = "n" if count is None else count
        raise ValueError(f"{name}: expected shape [{rows}, 3], got {list(points.shape)}")
    check_finite(name, points)


def check_finite(name: str, tensor: torch.Tensor) -> None:
    """Raise at the first row that is not finite; not checked inside ``torch.compile``, where NaN gives NaN."""
    if torch.compiler.is_compiling() or bool(torch.isfinite(tensor).all()):
        return
    row = int((~torch.isfinite(tensor)).reshape(len(tensor), -1).any(1).nonzero()[0])
    raise ValueError(f"{name}: expected finite numbers, got {tensor[row].tolist()} in row {row}")


def check_factor(name: str, value: float | torch.Tensor, *, like: torch.Tensor, minimum: float = -math.inf) -> None:
    """Raise unless ``value`` is a finite number >= ``minimum``, or a float tensor that holds one."""
    if isinstance(value, torch.Tensor):
        check_float(name, value, like=like)
        if value.numel() != 1:
            raise ValueError(f"{name}: expected a number or a tensor of one element, got shape {list(value.shape)}")
        if torch.compiler.is_compiling():
            return
        value = float(value.detach())
    elif isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{name}: expected a number or a torch.Tensor, got {type(value).__name__}")
    if not (math.isfinite(value) and value >= minimum):
        bound = "" if minimum == -math.inf else f" >= {minimum:g}"
        raise ValueError(f"{name}: expected a finite number{bound}, got {value}")


def check_volume(name: str, volume: torch.Tensor, grid: Grid) -> None:
    """Raise unless ``volume`` is a float tensor [C, K, n_z, n_y, n_x] over ``grid`` with K in 1, 4, 9, 16."""
    check_float(name, volume)
    if volume.ndim != 5 or tuple(volume.shape[2:]) != grid.shape or volume.shape[1] not in (1, 4, 9, 16):
        nz, ny, nx = grid.shape
        raise ValueError(f"{name}: expected shape [C, 1|4|9|16, {nz}, {ny}, {nx}], got {list(volume.shape)}")


def shifted_points(
    position: torch.Tensor, normal: torch.Tensor, grid: Grid, bias: float | torch.Tensor
) -> torch.Tensor:
    """``position + bias h normal`` [m], shape [n,3]; ``bias`` in cells, a number or a tensor of one element."""
    offset = bias.reshape(()) if isinstance(bias, torch.Tensor) else bias
    return position + offset * grid.cell_size * normal


def cell_coordinates(points: torch.Tensor, grid: Grid) -> torch.Tensor:
    """Cell coordinates of points [m], shape [n,3]."""
    return (points - points.new_tensor(grid.minimum)) / grid.cell_size
