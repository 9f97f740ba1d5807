"""Judging placed probes at points with a known truth: error, tail, leak, size and speed, measured alike for every method."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass

import numpy as np
import torch

from difflpv.placement.edge_rays import tetrahedra_cut_by_walls
from difflpv.placement.reconstruction import irradiance_coordinates
from difflpv.placement.task import PlacementTask
from difflpv.probes.lookup import probe_irradiance
from difflpv.probes.probe_set import DIRECTIONS_26
from difflpv.probes.reader import ProbeReader
from difflpv.probes.rows import Interpolation
from difflpv.probes.tetrahedra import TetrahedralInterpolation

__all__ = ["Judgement", "judge", "lookup_rate", "point_errors", "probe_bytes"]

_NORMALS = len(DIRECTIONS_26)
_POSITION, _CONTENT, _METRIC = 3, 27, 9  # numbers of a probe under one light
_POINTS = 2**16  # in one go, when lookups are timed


@dataclass(frozen=True)
class Judgement:
    """How good probes are at points that did not place them.

    Irradiance is that over the 26 normals of ``DIRECTIONS_26``, in all channels of all lights.

    Attributes:
        count: probes.
        error: relative L2 error of irradiance over all points.
        p95: 95th percentile over points of the error's root mean square, over the root mean square of the truth at all points.
        leak: error where the Delaunay tetrahedron of the probes' positions around the point is cut by a wall, relative to the
            truth there; 0 where no point is. Every interpolation is judged at these same points.
        cut_share: share of the points that these are.
        free_error: ``error`` of the points in free space alone; None if not told which these are.
        surface_error: of those over surfaces.
        bytes: of the probes in float32: position, 27 coefficients, the metric of footprints.
        seconds: spent placing; None if not told.
        lookups_per_second: points that one core reads, one normal each; None if not measured.
    """

    count: int
    error: float
    p95: float
    leak: float
    cut_share: float
    free_error: float | None
    surface_error: float | None
    bytes: int
    seconds: float | None = None
    lookups_per_second: float | None = None

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ValueError(f"judgement count: expected at least one probe, got {self.count}")
        for name in ("error", "p95", "leak", "cut_share", "free_error", "surface_error", "seconds", "lookups_per_second"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= 0):
                raise ValueError(f"judgement {name}: expected a finite number >= 0, got {value}")

    def to_json(self) -> dict[str, float | int | None]:
        """All attributes by name."""
        return asdict(self)


def judge(
    task: PlacementTask,
    position: np.ndarray,
    reader: ProbeReader,
    radiance: np.ndarray | torch.Tensor,
    *,
    surface: np.ndarray | None = None,
    seconds: float | None = None,
    timed: bool = True,
) -> Judgement:
    """Judge probes at the points of a task. Its weights are not used: every point counts alike.

    Args:
        task: points and truth that the probes were not placed by. Its field is not read.
        position: probes [n,3] m.
        reader: how points read them.
        radiance: what they hold under the task's lights [n,9,C] W/m2.
        surface: True for points over surfaces [m]; None if not known.
        seconds: spent placing.
        timed: measure ``lookups_per_second`` (about a second).

    Raises:
        ValueError: wrong shapes, content that is not finite, or a truth that is black everywhere.
    """
    position = np.array(position, np.float64)
    content = torch.as_tensor(radiance, dtype=torch.float64).detach()
    _check(task, position, content, surface)
    interpolation = reader.over(position, task.scene, raycaster=task.raycaster)
    square, truth = _squares(task, position, interpolation, content)
    cut = _cut(task, position)

    def relative(chosen: np.ndarray) -> float:
        whole = truth[chosen].sum()
        return float(np.sqrt(square[chosen].sum() / whole)) if whole > 0 else 0.0

    everywhere = np.ones(len(square), bool)
    return Judgement(
        count=len(position),
        error=relative(everywhere),
        p95=float(np.percentile(np.sqrt(square / truth.mean()), 95)),
        leak=relative(cut),
        cut_share=float(cut.mean()),
        free_error=None if surface is None else relative(~np.asarray(surface, bool)),
        surface_error=None if surface is None else relative(np.asarray(surface, bool)),
        bytes=probe_bytes(len(position), reader),
        seconds=seconds,
        lookups_per_second=lookup_rate(task, position, reader) if timed else None,
    )


def point_errors(
    task: PlacementTask, position: np.ndarray, reader: ProbeReader, radiance: np.ndarray | torch.Tensor
) -> np.ndarray:
    """Error of each point [m], as ``Judgement.p95`` takes it: root mean square, over that of the truth at all points.

    Raises:
        ValueError: as ``judge``.
    """
    position = np.array(position, np.float64)
    content = torch.as_tensor(radiance, dtype=torch.float64).detach()
    _check(task, position, content, None)
    square, truth = _squares(task, position, reader.over(position, task.scene, raycaster=task.raycaster), content)
    return np.asarray(np.sqrt(square / truth.mean()))


def probe_bytes(count: int, reader: ProbeReader) -> int:
    """Size of ``count`` probes under one light in float32, without the connectivity, which follows from the positions."""
    return 4 * count * (_POSITION + _CONTENT + (_METRIC if reader.metric is not None else 0))


def lookup_rate(task: PlacementTask, position: np.ndarray, reader: ProbeReader, *, repeats: int = 3) -> float:
    """Points per second of processor time: rows and irradiance of one normal in RGB, float32, the best of several readings.

    The task's points are read over and over, in one go of at least 2^16, each finding its probes without a hint.
    """
    points = task.points.float().repeat(-(-_POINTS // len(task.points)), 1)
    normals = torch.as_tensor(DIRECTIONS_26, dtype=torch.float32)[torch.arange(len(points)) % _NORMALS]
    x = torch.as_tensor(position, dtype=torch.float32)
    content = torch.ones(len(x), _CONTENT // 3, 3)
    interpolation = reader.over(x.double().numpy(), task.scene, raycaster=task.raycaster)
    best = math.inf
    with torch.no_grad():
        for _ in range(repeats + 1):  # the first one warms up
            if isinstance(interpolation, TetrahedralInterpolation):
                interpolation.forget()
            start = time.process_time()
            probe_irradiance(interpolation.rows(x, points), content, normals)
            best = min(best, time.process_time() - start)
    return len(points) / max(best, 1e-9)


def _check(task: PlacementTask, position: np.ndarray, content: torch.Tensor, surface: np.ndarray | None) -> None:
    if position.ndim != 2 or position.shape[1] != 3 or not len(position):
        raise ValueError(f"probe position: expected shape [n,3] with n > 0, got {list(position.shape)}")
    if not np.isfinite(position).all():
        raise ValueError("probe position: expected finite numbers, got NaN or infinity")
    shape = [len(position), *task.radiance.shape[1:]]
    if list(content.shape) != shape:
        raise ValueError(f"probe radiance: expected shape {shape}, got {list(content.shape)}")
    if not bool(content.isfinite().all()):
        raise ValueError("probe radiance: expected finite numbers, got NaN or infinity")
    if surface is not None and (np.shape(surface) != (len(task.points),) or np.asarray(surface).dtype != bool):
        raise ValueError(f"surface: expected {len(task.points)} booleans, got shape {list(np.shape(surface))}")
    if not bool(task.radiance.any()):
        raise ValueError("judging: the truth is black at all points, there is nothing to be relative to")


def _squares(
    task: PlacementTask, position: np.ndarray, interpolation: Interpolation, content: torch.Tensor
) -> tuple[np.ndarray, np.ndarray]:
    """Sums over normals and channels of the squares of error and truth [m]."""
    with torch.no_grad():
        found = interpolation.rows(torch.as_tensor(position), task.points).apply(irradiance_coordinates(content))
        truth = irradiance_coordinates(task.radiance)
        return (found - truth).square().sum((1, 2)).numpy(), truth.square().sum((1, 2)).numpy()


def _cut(task: PlacementTask, position: np.ndarray) -> np.ndarray:
    """True for points whose Delaunay tetrahedron (outside of the hull: the nearest face of it) is cut by a wall [m]."""
    with torch.no_grad():
        probes = TetrahedralInterpolation(position).rows(torch.as_tensor(position), task.points).probe.numpy()
    cells, of_point = np.unique(np.sort(probes, 1), axis=0, return_inverse=True)
    return tetrahedra_cut_by_walls(task.raycaster, position, cells)[of_point.reshape(-1)]
