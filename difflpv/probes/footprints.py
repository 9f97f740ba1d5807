"""The probes that are nearest to each point by metrics of their own: the op above ``warp_kernels.gaussian``.

Which probes are nearest is piecewise constant and has no gradient; how near they are has one, written by hand, in positions,
metrics and points.
"""

from __future__ import annotations

import math
from typing import Any

import torch

from difflpv.bridge import as_warp, check_float, launch, refuse_forward_mode, refuse_second_derivative, warp_scalar
from difflpv.coordinates import check_finite, check_points
from warp_kernels.gaussian import MOST_LISTED, GaussianKernels, gaussian_kernels

__all__ = ["nearest_footprints"]

_POINTS_PER_CELL = 32  # at least: making a cell's list takes as long as finding so many points
_MOST_CELLS, _MOST_ENTRIES = 2**12, 2**22  # entries: of cell and probe
_FEW_PROBES = 2  # times what is wanted: so few are looked at as fast without cells


def _kernels(tensor: torch.Tensor) -> GaussianKernels:
    return gaussian_kernels(warp_scalar(tensor.dtype))


def _resolution(extent: torch.Tensor, points: int, probes: int, count: int) -> tuple[int, int, int]:
    """Cells along each axis, near cubes, so many that it pays."""
    cells = min(points // _POINTS_PER_CELL, _MOST_CELLS, _MOST_ENTRIES // probes)
    size = extent.double().clamp_min(1e-3 * float(extent.max())).tolist()
    if cells < 8 or probes <= _FEW_PROBES * count or not max(size) > 0:
        return 1, 1, 1
    edge = (math.prod(size) / cells) ** (1 / 3)
    return max(1, int(size[0] / edge)), max(1, int(size[1] / edge)), max(1, int(size[2] / edge))


def _find_by_cells(
    position: torch.Tensor, metric: torch.Tensor, points: torch.Tensor, near: torch.Tensor, distance: torch.Tensor
) -> None:
    """Fill ``near`` and ``distance`` [m,k] on the CPU, k at most ``MOST_LISTED``."""
    kernels, device, count = _kernels(position), position.device, near.shape[1]
    low, high = points.amin(0), points.amax(0)
    resolution = _resolution(high - low, len(points), len(position), count)
    cells = math.prod(resolution)
    number = torch.finfo(points.dtype)
    edge = ((high - low) / low.new_tensor(resolution)).clamp_min(number.tiny)
    box = torch.stack([low, edge])
    if cells > 1:
        listed, lower = near.new_empty(cells * len(position)), points.new_empty(cells * len(position))
        length = near.new_empty(cells)
        rounding = 8 * number.eps * torch.maximum(low.abs(), high.abs()).max()  # of centres and of what lies in which cell
        spread = (metric.abs() @ (0.5001 * edge + rounding)).norm(dim=1)
        inputs = [position, metric, spread, box, *resolution[1:], count, lower, listed, length]
        launch(kernels.list_cells, cells, _flat(inputs), device)
    else:
        listed, length = torch.arange(len(position), dtype=torch.int32), near.new_full((1,), len(position))
    inputs = [position, metric, points, box, *resolution, count, listed, length, near, distance]
    launch(kernels.nearest_listed, len(points), _flat(inputs), device)


def _flat(inputs: list[Any]) -> list[Any]:
    return [value.view(-1) if isinstance(value, torch.Tensor) else value for value in inputs]


@torch.library.custom_op("difflpv::footprints", mutates_args=())
def _footprints(
    position: torch.Tensor, metric: torch.Tensor, points: torch.Tensor, count: int
) -> tuple[torch.Tensor, torch.Tensor]:
    near = torch.empty((len(points), count), dtype=torch.int32, device=points.device)
    distance = points.new_empty((len(points), count))
    position, metric, points = (t.contiguous() for t in (position, metric, points))
    if not len(points):
        return near, distance
    if position.is_cuda or count > MOST_LISTED:
        kernels = _kernels(position)
        inputs = [as_warp(position, kernels.vec3), as_warp(metric, kernels.mat33), as_warp(points, kernels.vec3)]
        launch(kernels.nearest_of_all, len(points), [*inputs, near, distance], position.device)
    else:
        _find_by_cells(position, metric, points, near, distance)
    return near, distance


@_footprints.register_fake
def _(position, metric, points, count):
    shape = (points.shape[0], count)
    return points.new_empty(shape, dtype=torch.int32), points.new_empty(shape)


@torch.library.custom_op("difflpv::footprints_pullback", mutates_args=())
def _pullback(
    position: torch.Tensor, metric: torch.Tensor, points: torch.Tensor, near: torch.Tensor, distance_bar: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    bars = [torch.zeros_like(t, memory_format=torch.contiguous_format) for t in (position, metric, points)]
    if len(points):
        kernels = _kernels(position)
        types = (kernels.vec3, kernels.mat33, kernels.vec3)
        inputs = [as_warp(t.contiguous(), kind) for t, kind in zip((position, metric, points), types, strict=True)]
        inputs += [near, distance_bar.contiguous()]
        inputs += [as_warp(t, kind) for t, kind in zip(bars, types, strict=True)]
        launch(kernels.adjoint, len(points), inputs, position.device)
    return bars[0], bars[1], bars[2]


@_pullback.register_fake
def _(position, metric, points, near, distance_bar):
    return tuple(torch.empty_like(t, memory_format=torch.contiguous_format) for t in (position, metric, points))


def _setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[torch.Tensor, ...]) -> None:
    ctx.mark_non_differentiable(output[0])
    ctx.save_for_backward(*inputs[:3], output[0])


def _backward(ctx: Any, near_bar: Any, distance_bar: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    del near_bar
    return *_pullback(*ctx.saved_tensors, distance_bar), None


_footprints.register_autograd(_backward, setup_context=_setup)
refuse_second_derivative("nearest footprints", _pullback)


def nearest_footprints(
    position: torch.Tensor, metric: torch.Tensor, points: torch.Tensor, count: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """The probes of least |M_j (x - p_j)|^2 for each point x, nearest first; of those equally near, the first ones.

    Args:
        position: probes [n,3] m, float32 or float64.
        metric: M of each [n,3,3] 1/m.
        points: [m,3] m.
        count: how many probes a point gets, from 1 to n.

    Returns:
        ``(near, distance)``: indices [m,count] int32, and |M_j (x - p_j)|^2 [m,count] (1e30 or, in float64, 1e300, where it is
        more). Gradients of ``distance`` reach position, metric and points.

    Raises:
        TypeError, ValueError: naming the argument, what was expected and what came.
    """
    check_points("position", position)
    check_points("points", points, like=position)
    check_float("metric", metric, like=position)
    if metric.shape != (len(position), 3, 3):
        raise ValueError(f"metric: expected shape [{len(position)}, 3, 3], got {list(metric.shape)}")
    check_finite("metric", metric)
    if not 1 <= count <= len(position):
        raise ValueError(f"count: expected 1 to {len(position)} probes, got {count}")
    refuse_forward_mode("nearest footprints", position, metric, points)
    return _footprints(position, metric, points, count)
