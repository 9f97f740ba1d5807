"""How well probes reconstruct what a task knows: the error that every placement is trained by, and the content that is best."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch

from difflpv.placement.task import PlacementTask
from difflpv.probes.probe_set import DIRECTIONS_26
from difflpv.probes.rows import Interpolation, Rows
from difflpv.probes.tetrahedra import TetrahedralInterpolation
from difflpv.sh import cosine_lobe

__all__ = ["Content", "Reconstruction", "fitted_content", "irradiance_coordinates", "reconstruction_error", "relative_error"]

Content = Literal["field", "fitted"]
_RIDGE = 0.02
_DARK = "placement radiance: expected light at a point of some weight, got none"
_LOBES = cosine_lobe(DIRECTIONS_26, 2)
_FACTOR = torch.from_numpy(np.linalg.cholesky(_LOBES.T @ _LOBES))


def irradiance_coordinates(radiance: torch.Tensor) -> torch.Tensor:
    """Radiance SH [m,9,C] in coordinates [m,9,C] whose squares sum to those of irradiance over the 26 normals, exactly."""
    return torch.einsum("mkc,kj->mjc", radiance, _FACTOR.to(radiance))


def fitted_content(
    task: PlacementTask, position: torch.Tensor, rows: Rows, *, ridge: float = _RIDGE, toward: torch.Tensor | None = None
) -> torch.Tensor:
    """Radiance SH [n,9,C] W/m2 that reconstructs the task's points best, differentiable in positions and weights.

    Least squares over the points with a pull of ``ridge`` (share of the points per probe) toward other content, so that a
    probe that few points read keeps that; the content of variable projection (Golub and Pereyra 1973). ``toward`` [n,9,C] is
    that content; the field's value if None.
    """
    start = task.field(position) if toward is None else toward
    found = _least_squares(task, rows.dense(len(position)), start.flatten(1), task.radiance.flatten(1), ridge)
    return found.reshape(start.shape)


class Reconstruction:
    """The training error of probes at one task's points, as often as it is asked for.

    The light of several sets has far fewer than 9C independent channels, and the error does not change where channels are
    turned into one another: with ``kept`` below 1 only the principal ones stay that hold this share of the truth's energy.

    Attributes:
        task: points and their truth.
        content: what probes hold: the "field" where they are, or "fitted" (``fitted_content``).
        truth: radiance at the points in ``irradiance_coordinates`` [m,K], K <= 9C.
        ridge: of the least squares.
    """

    def __init__(
        self, task: PlacementTask, content: Content = "field", *, ridge: float = _RIDGE, kept: float = 1.0
    ) -> None:
        """Take the truth.

        Raises:
            ValueError: an unknown content, a negative ridge, a share that is none, or points without light.
        """
        if not 0 < kept <= 1:
            raise ValueError(f"kept: expected a share in (0, 1], got {kept}")
        if content not in ("field", "fitted"):
            raise ValueError(f"content: expected field or fitted, got {content!r}")
        if not ridge >= 0:
            raise ValueError(f"ridge: expected a number >= 0, got {ridge}")
        self.task, self.content = task, content
        self.ridge = ridge
        self.truth = irradiance_coordinates(task.radiance).flatten(1)
        self._scale = float((task.weights[:, None] * self.truth.square()).sum().sqrt())
        if not self._scale > 0:
            raise ValueError(_DARK)
        self._axes: torch.Tensor | None = None
        if kept < 1:
            energy, axes = torch.linalg.eigh(self.truth.T @ (self.truth * task.weights[:, None]))
            lost = energy.clamp_min(0).cumsum(0) <= (1 - kept) * energy.sum()
            self._axes = axes[:, ~lost]
            self.truth = self.truth @ self._axes

    def read(self, position: torch.Tensor, rows: Rows) -> tuple[torch.Tensor, torch.Tensor]:
        """What probes at ``position`` [n,3] m hold [n,K] and what the points read by ``rows`` [m,K], as ``truth``."""
        held = irradiance_coordinates(self.task.field(position)).flatten(1)
        if self._axes is not None:
            held = held @ self._axes
        matrix = rows.dense(len(position))  # for as many channels as several lights have, cheaper than the rows' gather
        if self.content == "fitted":
            held = _least_squares(self.task, matrix, held, self.truth, self.ridge)
        return held, matrix @ held

    def error(self, position: torch.Tensor, rows: Rows) -> torch.Tensor:
        """Relative L2 error of irradiance over 26 normals at the task's points, a scalar."""
        square = (self.read(position, rows)[1] - self.truth).square().sum(1)
        # the root has no slope at 0, where all is met exactly: the bound's is 0
        return (self.task.weights * square).sum().clamp_min(torch.finfo(square.dtype).tiny).sqrt() / self._scale


def relative_error(task: PlacementTask, radiance: torch.Tensor) -> torch.Tensor:
    """Relative L2 error of irradiance over 26 normals, a scalar, of ``radiance`` [m,9,C] W/m2 at the task's points.

    Raises:
        ValueError: points without light.
    """
    weight = task.weights[:, None, None]
    found, truth = irradiance_coordinates(radiance), irradiance_coordinates(task.radiance)
    power = (weight * truth.square()).sum()
    if not power > 0:
        raise ValueError(_DARK)
    return ((weight * (found - truth).square()).sum() / power).sqrt()


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
        ValueError: an unknown content, or points without light.
    """
    reader = interpolation or TetrahedralInterpolation(position.detach())
    return Reconstruction(task, content, ridge=ridge).error(position, reader.rows(position, task.points))


def _least_squares(
    task: PlacementTask, matrix: torch.Tensor, start: torch.Tensor, truth: torch.Tensor, ridge: float
) -> torch.Tensor:
    weighted = (matrix * (task.weights / task.weights.mean())[:, None]).T
    damping = ridge * len(task.points) / len(start) * torch.eye(len(start), dtype=matrix.dtype)
    return start + torch.linalg.solve(weighted @ matrix + damping, weighted @ (truth - matrix @ start))
