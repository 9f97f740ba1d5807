"""Barycentric weights of points in a tetrahedral grid of probes: the op above ``warp_kernels.tetrahedra``.

Which simplex holds a point is found by walking and has no gradient; the weights have one, written by hand, in the positions of
probes and points alike.
"""

from __future__ import annotations

from typing import Any

import torch

from difflpv.bridge import as_warp, launch, refuse_forward_mode, refuse_second_derivative, warp_scalar
from difflpv.coordinates import check_points
from warp_kernels.tetrahedra import TetrahedraKernels, tetrahedra_kernels

__all__ = ["barycentric_weights"]


def _kernels(tensor: torch.Tensor) -> TetrahedraKernels:
    return tetrahedra_kernels(warp_scalar(tensor.dtype))


@torch.library.custom_op("difflpv::barycentric", mutates_args=())
def _barycentric(
    position: torch.Tensor,
    points: torch.Tensor,
    vertices: torch.Tensor,
    neighbours: torch.Tensor,
    hull: torch.Tensor,
    start: torch.Tensor,
    convex: bool,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    kernels, device, count, cells = _kernels(position), position.device, len(points), len(vertices)
    probe, active = start.new_empty((count, 4)), start.new_empty(count)
    weight = points.new_empty((count, 4))
    if not count:
        return probe, weight, active
    if not cells:  # Warp takes no empty rows of vectors; nothing reads these
        vertices = neighbours = start.new_zeros((1, 4))
    matrix, origin = position.new_empty((len(vertices), 3, 3)), position.new_empty((len(vertices), 3))
    sphere, found = position.new_empty((len(hull), 4)), torch.full_like(active, -1)
    probes, read = (as_warp(t.contiguous(), kernels.vec3) for t in (position, points))
    corners, over = (as_warp(t.contiguous(), kernels.vec4i) for t in (vertices, neighbours))
    faces, balls = as_warp(hull.contiguous(), kernels.vec3i), as_warp(sphere, kernels.vec4)
    rows, last = as_warp(matrix, kernels.mat33), as_warp(origin, kernels.vec3)
    if cells:
        launch(kernels.prepare_tetrahedra, cells, [probes, corners, rows, last], device)
        walk = [read, rows, last, over, start.contiguous(), 2 * cells, int(convex), found]
        launch(kernels.locate, count, walk, device)
    launch(kernels.prepare_hull, len(hull), [probes, faces, balls], device)
    result = [as_warp(probe, kernels.vec4i), as_warp(weight, kernels.vec4), active]
    launch(kernels.weigh, count, [probes, read, corners, faces, rows, last, balls, found, *result], device)
    return probe, weight, active


@_barycentric.register_fake
def _(position, points, vertices, neighbours, hull, start, convex):
    count = points.shape[0]
    return start.new_empty((count, 4)), points.new_empty((count, 4)), start.new_empty(count)


@torch.library.custom_op("difflpv::barycentric_pullback", mutates_args=())
def _pullback(
    position: torch.Tensor,
    points: torch.Tensor,
    probe: torch.Tensor,
    weight: torch.Tensor,
    active: torch.Tensor,
    weight_bar: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    position_bar = torch.zeros_like(position, memory_format=torch.contiguous_format)
    points_bar = torch.zeros_like(points, memory_format=torch.contiguous_format)
    if len(points):
        kernels = _kernels(position)
        vec3, vec4 = kernels.vec3, kernels.vec4
        inputs = [as_warp(position.contiguous(), vec3), as_warp(points.contiguous(), vec3)]
        inputs += [as_warp(probe, kernels.vec4i), as_warp(weight, vec4), active, as_warp(weight_bar.contiguous(), vec4)]
        inputs += [as_warp(position_bar, vec3), as_warp(points_bar, vec3)]
        launch(kernels.adjoint, len(points), inputs, position.device)
    return position_bar, points_bar


@_pullback.register_fake
def _(position, points, probe, weight, active, weight_bar):
    return tuple(torch.empty_like(t, memory_format=torch.contiguous_format) for t in (position, points))


def _setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[torch.Tensor, ...]) -> None:
    probe, weight, active = output
    ctx.mark_non_differentiable(probe, active)
    ctx.save_for_backward(inputs[0], inputs[1], probe, weight, active)


def _backward(ctx: Any, probe_bar: Any, weight_bar: torch.Tensor, active_bar: Any) -> tuple[torch.Tensor | None, ...]:
    del probe_bar, active_bar
    position_bar, points_bar = _pullback(*ctx.saved_tensors, weight_bar)
    return position_bar, points_bar, None, None, None, None, None


_barycentric.register_autograd(_backward, setup_context=_setup)
refuse_second_derivative("barycentric weights", _pullback)


def _check_indices(name: str, value: torch.Tensor, columns: int, low: int, high: int) -> None:
    if value.dtype != torch.int32 or value.ndim != 2 or value.shape[1] != columns:
        raise ValueError(f"{name}: expected int32 of shape [t, {columns}], got {value.dtype} {list(value.shape)}")
    if not torch.compiler.is_compiling() and value.numel() and (int(value.min()) < low or int(value.max()) >= high):
        raise ValueError(f"{name}: expected indices {low}..{high - 1}, got {int(value.min())}..{int(value.max())}")


def barycentric_weights(
    position: torch.Tensor,
    points: torch.Tensor,
    vertices: torch.Tensor,
    neighbours: torch.Tensor,
    hull: torch.Tensor,
    *,
    start: torch.Tensor | None = None,
    convex: bool = True,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Walk to the tetrahedron of each point, or to the closest point of the hull, and weigh its probes.

    Args:
        position: probes [n,3] m, float32 or float64.
        points: where they are read [m,3] m.
        vertices: probes of each tetrahedron [t,4] int32; none may be without volume.
        neighbours: tetrahedron over the face opposite each vertex [t,4] int32; -1 - f for triangle f of the hull.
        hull: triangles that answer for points outside [f,3] int32, f > 0; repeated vertices make a segment or a point of one.
        start: tetrahedron in which each walk starts [m] int32; the first, if None. No result depends on it.
        convex: the tetrahedra fill a convex body; where they do not, a walk that leaves them looks at all.

    Returns:
        ``(probe, weight, active)``: probes [m,4] int32, their weights [m,4] (each row sums to 1; the first ``active`` [m] int32
        are the vertices of the simplex, the rest repeats with weight 0). Gradients of ``weight`` reach position and points.

    Raises:
        TypeError, ValueError: naming the argument, what was expected and what came.
    """
    check_points("position", position)
    check_points("points", points, like=position)
    _check_indices("vertices", vertices, 4, 0, len(position))
    _check_indices("hull", hull, 3, 0, len(position))
    _check_indices("neighbours", neighbours, 4, -len(hull), max(len(vertices), 1))
    if not len(hull):
        raise ValueError("hull: expected at least one triangle, got none")
    if len(neighbours) != len(vertices):
        raise ValueError(f"neighbours: expected one row for each of {len(vertices)} tetrahedra, got {len(neighbours)}")
    if start is None:
        start = torch.zeros(len(points), dtype=torch.int32, device=points.device)
    elif start.dtype != torch.int32 or start.shape != (len(points),):
        raise ValueError(f"start: expected int32 of shape [{len(points)}], got {start.dtype} {list(start.shape)}")
    elif len(start) and len(vertices) and not 0 <= int(start.min()) <= int(start.max()) < len(vertices):
        raise ValueError(f"start: expected tetrahedra 0..{len(vertices) - 1}, got {int(start.min())}..{int(start.max())}")
    refuse_forward_mode("barycentric weights", position, points)
    return _barycentric(position, points, vertices, neighbours, hull, start, convex)
