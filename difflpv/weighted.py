"""Lobes read from, or given to, listed cells with listed weights: the lookup and deposit where geometry picks the cells.

``gather_lobes`` and ``spread_lobes`` are transposes of each other and linear in each argument; the equations stand in
``warp_kernels.weighted``. Which cells, and with what weights, ``difflpv.lookup`` decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from difflpv.bridge import check_float, launch, refuse_forward_mode, refuse_second_derivative, warp_scalar
from warp_kernels.weighted import WeightedKernels, weighted_kernels

__all__ = ["gather_lobes", "spread_lobes"]


def _kernels(tensor: torch.Tensor) -> WeightedKernels:
    return weighted_kernels(warp_scalar(tensor.dtype))


def _rows(volume: torch.Tensor) -> torch.Tensor:
    """[C, K, n_z, n_y, n_x] as contiguous [C K, cells]."""
    return volume.contiguous().flatten(0, 1).flatten(1)


@torch.library.custom_op("difflpv::gather_lobes", mutates_args=())
def _gather(volume: torch.Tensor, cells: torch.Tensor, weights: torch.Tensor, lobes: torch.Tensor) -> torch.Tensor:
    channels, coeffs = volume.shape[:2]
    if not volume.is_cuda and 2 * cells.numel() > volume[0, 0].numel():
        # Cell by cell, all its numbers side by side: 25 times the speed of reading them a volume apart, for one copy.
        table = _rows(volume).t().contiguous()
        held = torch.nn.functional.embedding_bag(cells, table, per_sample_weights=weights, mode="sum")
        return (held.view(-1, channels, coeffs) * lobes[:, None]).sum(-1)
    result = volume.new_empty((len(cells), channels))
    inputs = [_rows(volume), cells.contiguous(), weights.contiguous(), lobes.contiguous(), result]
    launch(_kernels(volume).gather, len(cells), inputs, volume.device)
    return result


@_gather.register_fake
def _(volume, cells, weights, lobes):
    return volume.new_empty((cells.shape[0], volume.shape[0]))


@torch.library.custom_op("difflpv::spread_lobes", mutates_args=())
def _spread(
    flux: torch.Tensor, cells: torch.Tensor, weights: torch.Tensor, lobes: torch.Tensor, shape: Sequence[int]
) -> torch.Tensor:
    volume = flux.new_zeros((flux.shape[1], lobes.shape[1], *shape))
    inputs = [flux.contiguous(), cells.contiguous(), weights.contiguous(), lobes.contiguous(), _rows(volume)]
    launch(_kernels(flux).spread, len(cells), inputs, flux.device)
    return volume


@_spread.register_fake
def _(flux, cells, weights, lobes, shape):
    return flux.new_empty((flux.shape[1], lobes.shape[1], *shape))


@torch.library.custom_op("difflpv::weighted_pullback", mutates_args=())
def _pullback(
    volume: torch.Tensor, cells: torch.Tensor, weights: torch.Tensor, lobes: torch.Tensor, result_bar: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    weights_bar, lobes_bar = torch.empty_like(weights.contiguous()), torch.empty_like(lobes.contiguous())
    bar, rows, listed = result_bar.contiguous(), _rows(volume), cells.contiguous()
    kernels, count = _kernels(volume), len(cells)
    launch(kernels.weights_adjoint, count, [rows, listed, lobes.contiguous(), bar, weights_bar], volume.device)
    launch(kernels.lobes_adjoint, count, [rows, listed, weights.contiguous(), bar, lobes_bar], volume.device)
    return weights_bar, lobes_bar


@_pullback.register_fake
def _(volume, cells, weights, lobes, result_bar):
    return tuple(torch.empty_like(t, memory_format=torch.contiguous_format) for t in (weights, lobes))


def _gather_setup(ctx: Any, inputs: tuple[Any, ...], output: torch.Tensor) -> None:
    ctx.save_for_backward(*inputs)


def _gather_backward(ctx: Any, result_bar: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    volume, cells, weights, lobes = ctx.saved_tensors
    need_volume, _, need_weights, need_lobes = ctx.needs_input_grad
    volume_bar = weights_bar = lobes_bar = None
    if need_volume:
        volume_bar = _spread(result_bar, cells, weights, lobes, volume.shape[2:])
    if need_weights or need_lobes:
        weights_bar, lobes_bar = _pullback(volume, cells, weights, lobes, result_bar)
    return volume_bar, None, weights_bar, lobes_bar


def _spread_setup(ctx: Any, inputs: tuple[Any, ...], output: torch.Tensor) -> None:
    ctx.save_for_backward(*inputs[:4])


def _spread_backward(ctx: Any, volume_bar: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    flux, cells, weights, lobes = ctx.saved_tensors
    need_flux, _, need_weights, need_lobes, _ = ctx.needs_input_grad
    flux_bar = weights_bar = lobes_bar = None
    if need_flux:
        flux_bar = _gather(volume_bar, cells, weights, lobes)
    if need_weights or need_lobes:
        weights_bar, lobes_bar = _pullback(volume_bar, cells, weights, lobes, flux)
    return flux_bar, None, weights_bar, lobes_bar, None


_gather.register_autograd(_gather_backward, setup_context=_gather_setup)
_spread.register_autograd(_spread_backward, setup_context=_spread_setup)
refuse_second_derivative("lookup", _pullback)


def _check(cells: torch.Tensor, weights: torch.Tensor, lobes: torch.Tensor, like: torch.Tensor, cell_count: int) -> None:
    check_float("weights", weights, like=like)
    check_float("lobes", lobes, like=like)
    if cells.dtype != torch.int32 or cells.ndim != 2:
        raise ValueError(f"cells: expected int32 of shape [n, J], got {cells.dtype} {list(cells.shape)}")
    if weights.shape != cells.shape:
        raise ValueError(f"weights: expected shape {list(cells.shape)}, got {list(weights.shape)}")
    if lobes.ndim != 2 or len(lobes) != len(cells):
        raise ValueError(f"lobes: expected shape [{len(cells)}, K], got {list(lobes.shape)}")
    if torch.compiler.is_compiling() or not cells.numel():
        return
    low, high = int(cells.min()), int(cells.max())
    if low < 0 or high >= cell_count:
        raise ValueError(f"cells: expected indices 0..{cell_count - 1}, got {low}..{high}")


def gather_lobes(
    volume: torch.Tensor, cells: torch.Tensor, weights: torch.Tensor, lobes: torch.Tensor
) -> torch.Tensor:
    """Read lobes from listed cells: ``sum_j weights[i,j] sum_k lobes[i,k] volume[c,k,cells[i,j]]``.

    Args:
        volume: any unit, shape [C, K, n_z, n_y, n_x], float32 or float64.
        cells: indices into the flattened grid (x fastest), shape [n,J] int32.
        weights: shape [n,J].
        lobes: coefficients that each point reads with, shape [n,K].

    Returns:
        Unit of ``volume`` times that of ``lobes``, shape [n,C]. Gradients reach volume, weights and lobes.

    Raises:
        TypeError, ValueError: naming the argument, what was expected and what came.
    """
    check_float("volume", volume)
    if volume.ndim != 5 or volume.shape[1] != lobes.shape[-1]:
        raise ValueError(f"volume: expected shape [C, {lobes.shape[-1]}, n_z, n_y, n_x], got {list(volume.shape)}")
    _check(cells, weights, lobes, volume, volume[0, 0].numel())
    refuse_forward_mode("lookup", volume, weights, lobes)
    return _gather(volume, cells, weights, lobes)


def spread_lobes(
    flux: torch.Tensor, cells: torch.Tensor, weights: torch.Tensor, lobes: torch.Tensor, shape: tuple[int, int, int]
) -> torch.Tensor:
    """Give lobes to listed cells, the transpose of ``gather_lobes``.

    Args:
        flux: amplitude of each point, any unit, shape [n,C].
        cells: indices into the flattened grid (x fastest), shape [n,J] int32.
        weights: shape [n,J].
        lobes: shape [n,K].
        shape: grid (n_z, n_y, n_x).

    Returns:
        Unit of ``flux`` times that of ``lobes``, shape [C, K, n_z, n_y, n_x]. Gradients reach flux, weights and lobes.

    Raises:
        TypeError, ValueError: naming the argument, what was expected and what came.
    """
    check_float("flux", flux)
    if flux.ndim != 2 or len(flux) != len(cells):
        raise ValueError(f"flux: expected shape [{len(cells)}, C], got {list(flux.shape)}")
    _check(cells, weights, lobes, flux, shape[0] * shape[1] * shape[2])
    refuse_forward_mode("lookup", flux, weights, lobes)
    return _spread(flux, cells, weights, lobes, list(shape))
