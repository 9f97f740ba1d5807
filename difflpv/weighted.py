"""Lobes read from, or given to, listed cells with listed weights: the lookup and deposit where geometry picks the cells.

``gather_lobes`` and ``spread_lobes`` are transposes of each other and linear in each argument; the equations stand in
``warp_kernels.weighted``. Which cells, and with what weights, ``difflpv.lookup`` decides. On the CPU, many points work on a
volume that was turned into rows of cells first (``warp_kernels.cell_rows``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from difflpv.bridge import as_warp, check_float, launch, refuse_forward_mode, refuse_second_derivative, warp_scalar
from difflpv.slabs import SlabLauncher
from warp_kernels.cell_rows import POINTS, CellRowKernels, cell_row_kernels, row_lanes
from warp_kernels.weighted import WeightedKernels, weighted_kernels

__all__ = ["gather_lobes", "spread_lobes"]


def _kernels(tensor: torch.Tensor) -> WeightedKernels:
    return weighted_kernels(warp_scalar(tensor.dtype))


def _rows(volume: torch.Tensor) -> torch.Tensor:
    """[C, K, n_z, n_y, n_x] as contiguous [C K, cells]."""
    return volume.contiguous().flatten(0, 1).flatten(1)


def _turning_pays(cells: torch.Tensor, cell_count: int) -> bool:
    return not cells.is_cuda and 2 * cells.numel() > cell_count


class _CellRows:
    """A volume as rows of cells on the CPU, and launches on it."""

    def __init__(self, channels: int, coeffs: int, pitch: int, flat: torch.Tensor) -> None:
        self.channels, self.coeffs, self.pitch, self.flat = channels, coeffs, pitch, flat
        self.kernels: CellRowKernels = cell_row_kernels(warp_scalar(flat.dtype), channels=channels, coeffs=coeffs)

    @classmethod
    def of(cls, volume: torch.Tensor) -> _CellRows:
        """To read a volume [C, K, n_z, n_y, n_x]."""
        rows, lanes = _rows(volume), row_lanes(volume.element_size())
        flat = volume.new_empty(rows.numel() + lanes)
        flat[-lanes:] = 0
        flat[:-lanes].view(rows.shape[1], -1).copy_(rows.t())
        return cls(volume.shape[0], volume.shape[1], len(rows), flat)

    @classmethod
    def dark(cls, channels: int, coeffs: int, cell_count: int, like: torch.Tensor) -> _CellRows:
        """To add to: all zero, in the dtype of ``like``."""
        lanes = row_lanes(like.element_size())
        pitch = -(-channels * coeffs // lanes) * lanes
        return cls(channels, coeffs, pitch, like.new_zeros(cell_count * pitch))

    def volume(self, shape: Sequence[int]) -> torch.Tensor:
        """What was added: contiguous [C, K, *shape]."""
        turned = self.flat.view(-1, self.pitch).t().contiguous()  # torch is fast at whole matrices
        return turned[: self.channels * self.coeffs].view(self.channels, self.coeffs, *shape)

    def launch(
        self, kernel: Any, cells: torch.Tensor, weights: torch.Tensor | None, lobes: torch.Tensor | None,
        flux: torch.Tensor | None, out: torch.Tensor | None, *, ranges: int = 0,
    ) -> None:  # fmt: skip
        """Run a kernel on all points, or on ``ranges`` ranges of cells; arrays that it does not use are None."""
        none, (count, reads) = self.flat.new_empty(0), cells.shape
        arrays = [none if array is None else array.contiguous() for array in (weights, lobes, flux, out)]
        arrays = [self.flat, cells.contiguous(), *arrays]  # held until the launch is done
        arguments = [*(as_warp(array.view(-1)) for array in arrays), reads, count, len(self.flat) // self.pitch, ranges]
        SlabLauncher(cells.device).launch(kernel, ranges or -(-count // POINTS), 1, arguments)


@torch.library.custom_op("difflpv::gather_lobes", mutates_args=())
def _gather(volume: torch.Tensor, cells: torch.Tensor, weights: torch.Tensor, lobes: torch.Tensor) -> torch.Tensor:
    channels = len(volume)
    result = volume.new_empty((len(cells), channels))
    if _turning_pays(cells, volume[0, 0].numel()):
        turned = _CellRows.of(volume)
        turned.launch(turned.kernels.gather, cells, weights, lobes, None, result)
        return result
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
    if _turning_pays(cells, math.prod(shape)):
        turned = _CellRows.dark(flux.shape[1], lobes.shape[1], math.prod(shape), flux)
        turned.launch(turned.kernels.spread, cells, weights, lobes, flux, None, ranges=torch.get_num_threads())
        return turned.volume(shape)
    volume = flux.new_zeros((flux.shape[1], lobes.shape[1], *shape))
    inputs = [flux.contiguous(), cells.contiguous(), weights.contiguous(), lobes.contiguous(), _rows(volume)]
    launch(_kernels(flux).spread, len(cells), inputs, flux.device)
    return volume


@_spread.register_fake
def _(flux, cells, weights, lobes, shape):
    return flux.new_empty((flux.shape[1], lobes.shape[1], *shape))


@torch.library.custom_op("difflpv::weighted_pullback", mutates_args=())
def _pullback(
    volume: torch.Tensor, cells: torch.Tensor, weights: torch.Tensor, lobes: torch.Tensor, result_bar: torch.Tensor,
    need_weights: bool, need_lobes: bool,
) -> tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
    weights_bar, lobes_bar = _empty_bars(weights, lobes, need_weights, need_lobes)
    if _turning_pays(cells, volume[0, 0].numel()):
        turned = _CellRows.of(volume)
        if need_weights:
            turned.launch(turned.kernels.weights_adjoint, cells, None, lobes, result_bar, weights_bar)
        if need_lobes:
            turned.launch(turned.kernels.lobes_adjoint, cells, weights, None, result_bar, lobes_bar)
        return weights_bar, lobes_bar
    bar, rows, listed = result_bar.contiguous(), _rows(volume), cells.contiguous()
    kernels, count = _kernels(volume), len(cells)
    if need_weights:
        launch(kernels.weights_adjoint, count, [rows, listed, lobes.contiguous(), bar, weights_bar], volume.device)
    if need_lobes:
        launch(kernels.lobes_adjoint, count, [rows, listed, weights.contiguous(), bar, lobes_bar], volume.device)
    return weights_bar, lobes_bar


def _empty_bars(
    weights: torch.Tensor, lobes: torch.Tensor, need_weights: bool, need_lobes: bool
) -> tuple[torch.Tensor, torch.Tensor]:
    """Memory of both gradients, empty where they are not needed."""
    return (
        weights.new_empty(weights.shape if need_weights else (0,)),
        lobes.new_empty(lobes.shape if need_lobes else (0,)),
    )


@_pullback.register_fake
def _(volume, cells, weights, lobes, result_bar, need_weights, need_lobes):
    return _empty_bars(weights, lobes, need_weights, need_lobes)


def _needed_bars(
    volume: torch.Tensor, cells: torch.Tensor, weights: torch.Tensor, lobes: torch.Tensor, result_bar: torch.Tensor, *need: bool
) -> tuple[torch.Tensor | None, torch.Tensor | None]:
    """``_pullback`` as autograd wants it: None for what is not needed."""
    if not any(need):
        return None, None
    weights_bar, lobes_bar = _pullback(volume, cells, weights, lobes, result_bar, *need)
    return weights_bar if need[0] else None, lobes_bar if need[1] else None


def _gather_setup(ctx: Any, inputs: tuple[Any, ...], output: torch.Tensor) -> None:
    ctx.save_for_backward(*inputs)


def _gather_backward(ctx: Any, result_bar: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    volume, cells, weights, lobes = ctx.saved_tensors
    need_volume, _, need_weights, need_lobes = ctx.needs_input_grad
    volume_bar = _spread(result_bar, cells, weights, lobes, volume.shape[2:]) if need_volume else None
    return volume_bar, None, *_needed_bars(volume, cells, weights, lobes, result_bar, need_weights, need_lobes)


def _spread_setup(ctx: Any, inputs: tuple[Any, ...], output: torch.Tensor) -> None:
    ctx.save_for_backward(*inputs[:4])


def _spread_backward(ctx: Any, volume_bar: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    flux, cells, weights, lobes = ctx.saved_tensors
    need_flux, _, need_weights, need_lobes, _ = ctx.needs_input_grad
    flux_bar = _gather(volume_bar, cells, weights, lobes) if need_flux else None
    return flux_bar, None, *_needed_bars(volume_bar, cells, weights, lobes, flux, need_weights, need_lobes), None


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
    low, high = (int(bound) for bound in torch.aminmax(cells))
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
