"""Sampling: irradiance of receivers, and coefficients at free points, from a volume (physics.md, "The chain" 7).

A volume stores radiant intensity per cell [W/sr]; 1/h^2 turns intensity through a cell into radiance. Source:
Kaplanyan and Dachsbacher 2010, section 4.4 (trilinear lookup, cosine lobe about the negated normal).
"""

from __future__ import annotations

from typing import Any

import torch

from difflpv.bridge import launch, refuse_forward_mode, refuse_second_derivative, warp_scalar
from difflpv.coordinates import cell_coordinates, check_factor, check_points, check_volume, shifted_points
from difflpv.grid import Grid
from warp_kernels.sampling import SamplingKernels, sampling_kernels

__all__ = ["sample_coeffs", "sample_irradiance"]


def _kernels(tensor: torch.Tensor) -> SamplingKernels:
    return sampling_kernels(warp_scalar(tensor.dtype))


def _rows(volume: torch.Tensor) -> torch.Tensor:
    """[C, K, n_z, n_y, n_x] as contiguous [C K, n_z, n_y, n_x]: Warp arrays have four axes at most."""
    return volume.contiguous().flatten(0, 1)


@torch.library.custom_op("difflpv::sample_irradiance", mutates_args=())
def _irradiance(volume: torch.Tensor, cells: torch.Tensor, normal: torch.Tensor, scale: float) -> torch.Tensor:
    result = volume.new_empty((len(cells), len(volume)))
    inputs = [_rows(volume), cells.contiguous(), normal.contiguous(), volume.shape[1], scale, result]
    launch(_kernels(volume).irradiance, len(cells), inputs, volume.device)
    return result


@_irradiance.register_fake
def _(volume, cells, normal, scale):
    return volume.new_empty((cells.shape[0], volume.shape[0]))


@torch.library.custom_op("difflpv::sample_irradiance_volume_adjoint", mutates_args=())
def _irradiance_volume_adjoint(
    result_bar: torch.Tensor, volume: torch.Tensor, cells: torch.Tensor, normal: torch.Tensor, scale: float
) -> torch.Tensor:
    bar = torch.zeros_like(volume, memory_format=torch.contiguous_format)
    inputs = [t.contiguous() for t in (result_bar, cells, normal)]
    kernel = _kernels(volume).irradiance_volume_adjoint
    launch(kernel, len(cells), [*inputs, volume.shape[1], scale, bar.flatten(0, 1)], volume.device)
    return bar


@_irradiance_volume_adjoint.register_fake
def _(result_bar, volume, cells, normal, scale):
    return torch.empty_like(volume, memory_format=torch.contiguous_format)


@torch.library.custom_op("difflpv::sample_irradiance_point_adjoint", mutates_args=())
def _irradiance_point_adjoint(
    result_bar: torch.Tensor, volume: torch.Tensor, cells: torch.Tensor, normal: torch.Tensor, scale: float
) -> tuple[torch.Tensor, torch.Tensor]:
    inputs = [result_bar.contiguous(), _rows(volume), cells.contiguous(), normal.contiguous()]
    cells_bar, normal_bar = torch.empty_like(inputs[2]), torch.empty_like(inputs[3])
    kernel = _kernels(volume).irradiance_point_adjoint
    launch(kernel, len(cells), [*inputs, volume.shape[1], scale, cells_bar, normal_bar], volume.device)
    return cells_bar, normal_bar


@_irradiance_point_adjoint.register_fake
def _(result_bar, volume, cells, normal, scale):
    return tuple(torch.empty_like(t, memory_format=torch.contiguous_format) for t in (cells, normal))


def _irradiance_setup(ctx: Any, inputs: tuple[Any, ...], output: torch.Tensor) -> None:
    ctx.save_for_backward(*inputs[:3])
    ctx.scale = inputs[3]


def _irradiance_backward(ctx: Any, result_bar: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    need_volume, need_cells, need_normal = ctx.needs_input_grad[:3]
    volume_bar = cells_bar = normal_bar = None
    if need_volume:
        volume_bar = _irradiance_volume_adjoint(result_bar, *ctx.saved_tensors, ctx.scale)
    if need_cells or need_normal:
        cells_bar, normal_bar = _irradiance_point_adjoint(result_bar, *ctx.saved_tensors, ctx.scale)
    return volume_bar, cells_bar, normal_bar, None


_irradiance.register_autograd(_irradiance_backward, setup_context=_irradiance_setup)
refuse_second_derivative("sampling", _irradiance_volume_adjoint)
refuse_second_derivative("sampling", _irradiance_point_adjoint)


@torch.library.custom_op("difflpv::sample_coeffs", mutates_args=())
def _coeffs(volume: torch.Tensor, cells: torch.Tensor) -> torch.Tensor:
    result = volume.new_empty((len(cells), volume.shape[0], volume.shape[1]))
    flat = result.flatten(1)
    launch(_kernels(volume).coeffs, flat.shape, [_rows(volume), cells.contiguous(), flat], volume.device)
    return result


@_coeffs.register_fake
def _(volume, cells):
    return volume.new_empty((cells.shape[0], volume.shape[0], volume.shape[1]))


@torch.library.custom_op("difflpv::sample_coeffs_volume_adjoint", mutates_args=())
def _coeffs_volume_adjoint(result_bar: torch.Tensor, volume: torch.Tensor, cells: torch.Tensor) -> torch.Tensor:
    bar = torch.zeros_like(volume, memory_format=torch.contiguous_format)
    flat = result_bar.contiguous().flatten(1)
    inputs = [flat, cells.contiguous(), bar.flatten(0, 1)]
    launch(_kernels(volume).coeffs_volume_adjoint, flat.shape, inputs, volume.device)
    return bar


@_coeffs_volume_adjoint.register_fake
def _(result_bar, volume, cells):
    return torch.empty_like(volume, memory_format=torch.contiguous_format)


@torch.library.custom_op("difflpv::sample_coeffs_point_adjoint", mutates_args=())
def _coeffs_point_adjoint(result_bar: torch.Tensor, volume: torch.Tensor, cells: torch.Tensor) -> torch.Tensor:
    bar = torch.empty_like(cells, memory_format=torch.contiguous_format)
    inputs = [result_bar.contiguous().flatten(1), _rows(volume), cells.contiguous(), bar]
    launch(_kernels(volume).coeffs_point_adjoint, len(cells), inputs, volume.device)
    return bar


@_coeffs_point_adjoint.register_fake
def _(result_bar, volume, cells):
    return torch.empty_like(cells, memory_format=torch.contiguous_format)


def _coeffs_setup(ctx: Any, inputs: tuple[Any, ...], output: torch.Tensor) -> None:
    ctx.save_for_backward(*inputs)


def _coeffs_backward(ctx: Any, result_bar: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    volume_bar = _coeffs_volume_adjoint(result_bar, *ctx.saved_tensors) if ctx.needs_input_grad[0] else None
    cells_bar = _coeffs_point_adjoint(result_bar, *ctx.saved_tensors) if ctx.needs_input_grad[1] else None
    return volume_bar, cells_bar


_coeffs.register_autograd(_coeffs_backward, setup_context=_coeffs_setup)
refuse_second_derivative("sampling", _coeffs_volume_adjoint)
refuse_second_derivative("sampling", _coeffs_point_adjoint)


def _check_grid(grid: Grid) -> None:
    if not isinstance(grid, Grid):
        raise TypeError(f"grid: expected difflpv.grid.Grid, got {type(grid).__name__}")


def sample_irradiance(
    volume: torch.Tensor,
    positions: torch.Tensor,
    normals: torch.Tensor,
    grid: Grid,
    *,
    bias: float | torch.Tensor = 0.5,
) -> torch.Tensor:
    """Irradiance of receivers, ``E = 1/h^2 sum_k A_k(x') cosine_lobe(-n)_k`` at ``x' = position + bias h normal``.

    ``A`` is interpolated trilinearly between cell centres; beyond the outermost centres, and outside the grid, the
    nearest cells of the edge answer.

    Args:
        volume: accumulated intensity [W/sr], shape [C, K, n_z, n_y, n_x], K in 1, 4, 9, 16.
        positions: receivers [m], shape [n,3].
        normals: unit normals on the free side, shape [n,3].
        grid: the volume's cells.
        bias: offset along the normal, in cells; a number or a tensor of one element.

    Returns:
        Irradiance [W/m2], shape [n,C]. Gradients reach every tensor (the normal as the argument of the lobe's
        polynomials and of the offset); the position's jumps where x' crosses a plane of cell centres, as the slope
        of a linear interpolation does. The volume's gradient is deterministic on the CPU; CUDA adds in no fixed order.

    Raises:
        TypeError: wrong type, dtype or device of an argument.
        ValueError: wrong shape, or a point, normal or bias that is not finite.
    """
    _check_grid(grid)
    check_volume("volume", volume, grid)
    check_points("positions", positions, like=volume)
    check_points("normals", normals, like=volume, count=len(positions))
    check_factor("bias", bias, like=volume)
    cells = cell_coordinates(shifted_points(positions, normals, grid, bias), grid)
    refuse_forward_mode("sampling", volume, cells, normals)
    return _irradiance(volume, cells, normals, 1 / grid.cell_size**2)


def sample_coeffs(volume: torch.Tensor, points: torch.Tensor, grid: Grid) -> torch.Tensor:
    """Coefficients of a volume at points, trilinear between cell centres (clipped as in ``sample_irradiance``).

    Args:
        volume: any unit, shape [C, K, n_z, n_y, n_x], K in 1, 4, 9, 16.
        points: [m], shape [m,3].
        grid: the volume's cells.

    Returns:
        Unit of ``volume``, shape [m, C, K]. Gradients reach volume and points.

    Raises:
        TypeError: wrong type, dtype or device of an argument.
        ValueError: wrong shape, or a point that is not finite.
    """
    _check_grid(grid)
    check_volume("volume", volume, grid)
    check_points("points", points, like=volume)
    cells = cell_coordinates(points, grid)
    refuse_forward_mode("sampling", volume, cells)
    return _coeffs(volume, cells)
