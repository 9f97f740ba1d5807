"""How well probes reconstruct what a task knows: the error that every placement is trained by, and the content that is best."""

from __future__ import annotations

from typing import Literal

import torch

from difflpv.placement.task import PlacementTask
from difflpv.probes.probe_set import DIRECTIONS_26, irradiance_of
from difflpv.probes.rows import Interpolation, Rows
from difflpv.probes.tetrahedra import TetrahedralInterpolation

__all__ = ["Content", "fitted_content", "reconstruction_error"]

Content = Literal["field", "fitted"]
_RIDGE = 0.02


def fitted_content(task: PlacementTask, position: torch.Tensor, rows: Rows, *, ridge: float = _RIDGE) -> torch.Tensor:
    """Radiance SH [n,9,C] W/m2 that reconstructs the task's points best, differentiable in positions and weights.

    Least squares over the points with a pull of ``ridge`` (share of the points per probe) toward the field's value, so that a
    probe that few points read keeps it; the content of variable projection (Golub and Pereyra 1973).
    """
    start = task.field(position)
    assert task.weight is not None
    weight = task.weight / task.weight.mean()
    matrix = rows.dense(len(position))
    weighted = (matrix * weight[:, None]).T
    normal = weighted @ matrix
    damping = ridge * len(task.points) / len(position) * torch.eye(len(position), dtype=normal.dtype)
    residual = (task.radiance - rows.apply(start)).flatten(1)
    return start + torch.linalg.solve(normal + damping, weighted @ residual).reshape(start.shape)


def reconstruction_error(
    task: PlacementTask,
    position: torch.Tensor,
    *,
    content: Content = "field",
    interpolation: Interpolation | None = None,
    ridge: float = _RIDGE,
) -> torch.Tensor:
    """Relative L2 error of irradiance over 26 normals at the task's points, a scalar, differentiable in ``position``.

    Args:
        task: points and their truth.
        position: probes [n,3] m.
        content: what probes hold: the "field" where they are, or "fitted" (``fitted_content``).
        interpolation: tetrahedra over these positions if None.
        ridge: of ``fitted_content``.

    Raises:
        ValueError: an unknown content.
    """
    if content not in ("field", "fitted"):
        raise ValueError(f"content: expected field or fitted, got {content!r}")
    reader = interpolation or TetrahedralInterpolation(position.detach())
    rows = reader.rows(position, task.points)
    held = task.field(position) if content == "field" else fitted_content(task, position, rows, ridge=ridge)
    found, truth = (irradiance_of(radiance, DIRECTIONS_26) for radiance in (rows.apply(held), task.radiance))
    assert task.weight is not None
    weight = task.weight[:, None, None]
    return ((weight * (found - truth) ** 2).sum() / (weight * truth**2).sum()).sqrt()
