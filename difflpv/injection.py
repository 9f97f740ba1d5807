"""Injection: virtual point lights into the cells of a volume (physics.md, "The chain" 3).

Source: Kaplanyan and Dachsbacher 2010, Cascaded Light Propagation Volumes, section 4.1 (nearest cell, half a cell
of offset along the normal). The trilinear deposit is this project's, so that a light's position has a gradient.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch

from difflpv.bridge import check_float, launch, refuse_forward_mode, refuse_second_derivative, warp_scalar
from difflpv.coordinates import cell_coordinates, check_factor, check_finite, shifted_points
from difflpv.grid import Grid
from difflpv.lookup import OpenCells
from difflpv.sh import coeff_count, cosine_lobe
from difflpv.vpl import Vpls
from difflpv.weighted import spread_lobes
from warp_kernels.injection import injection_kernels

__all__ = ["Deposit", "InjectionReport", "deposit_lobes", "inject"]

Deposit = Literal["nearest", "trilinear", "visible"]


@dataclass(frozen=True)
class InjectionReport:
    """What an injection lost, as tensors of no dimension (reading them is what synchronises a CUDA device).

    Attributes:
        lost_count: number of VPLs outside the grid, int64.
        lost_share: their part of the flux of all VPLs (sum over RGB), 0 to 1.
    """

    lost_count: torch.Tensor
    lost_share: torch.Tensor


@torch.library.custom_op("difflpv::deposit_lobes", mutates_args=())
def _deposit(
    cells: torch.Tensor,
    normal: torch.Tensor,
    amplitude: torch.Tensor,
    shape: Sequence[int],
    coeffs: int,
    trilinear: bool,
) -> torch.Tensor:
    volume = cells.new_zeros((amplitude.shape[1], coeffs, *shape))
    inputs = [t.contiguous() for t in (cells, normal, amplitude)]
    kernel = injection_kernels(warp_scalar(cells.dtype)).forward
    launch(kernel, len(cells), [*inputs, coeffs, int(trilinear), volume.flatten(0, 1)], cells.device)
    return volume


@_deposit.register_fake
def _(cells, normal, amplitude, shape, coeffs, trilinear):
    return cells.new_empty((amplitude.shape[1], coeffs, *shape))


@torch.library.custom_op("difflpv::deposit_lobes_adjoint", mutates_args=())
def _deposit_adjoint(
    volume_bar: torch.Tensor, cells: torch.Tensor, normal: torch.Tensor, amplitude: torch.Tensor, trilinear: bool
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    inputs = [t.contiguous() for t in (cells, normal, amplitude)]
    outputs = [torch.zeros_like(t) for t in inputs]
    kernel = injection_kernels(warp_scalar(cells.dtype)).adjoint
    bar = volume_bar.contiguous().flatten(0, 1)
    launch(kernel, len(cells), [*inputs, volume_bar.shape[1], int(trilinear), bar, *outputs], cells.device)
    return outputs[0], outputs[1], outputs[2]


@_deposit_adjoint.register_fake
def _(volume_bar, cells, normal, amplitude, trilinear):
    return tuple(torch.empty_like(t, memory_format=torch.contiguous_format) for t in (cells, normal, amplitude))


def _setup(ctx: Any, inputs: tuple[Any, ...], output: torch.Tensor) -> None:
    ctx.save_for_backward(*inputs[:3])
    ctx.trilinear = inputs[5]


def _backward(ctx: Any, volume_bar: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    cells_bar, normal_bar, amplitude_bar = _deposit_adjoint(volume_bar, *ctx.saved_tensors, ctx.trilinear)
    return cells_bar if ctx.trilinear else None, normal_bar, amplitude_bar, None, None, None


_deposit.register_autograd(_backward, setup_context=_setup)
refuse_second_derivative("injection", _deposit_adjoint)


def deposit_lobes(
    cells: torch.Tensor,
    normal: torch.Tensor,
    amplitude: torch.Tensor,
    shape: tuple[int, int, int],
    *,
    l_max: int,
    deposit: Literal["nearest", "trilinear"],
) -> torch.Tensor:
    """Add ``amplitude * cosine_lobe(normal)`` to the cells of a lattice.

    Args:
        cells: cell coordinates (x, y, z), shape [n,3]; points outside [0, n) add nothing.
        normal: unit normals, shape [n,3].
        amplitude: any unit, shape [n,C].
        shape: lattice (n_z, n_y, n_x).
        l_max: highest SH degree, 0..3.
        deposit: see ``inject``.

    Returns:
        Unit of ``amplitude``, shape [C, (l_max+1)^2, n_z, n_y, n_x].
    """
    refuse_forward_mode("injection", cells, normal, amplitude)
    return _deposit(cells, normal, amplitude, list(shape), coeff_count(l_max), deposit == "trilinear")


def inject(
    vpls: Vpls,
    grid: Grid,
    *,
    l_max: int,
    deposit: Deposit = "nearest",
    bias: float | torch.Tensor = 0.5,
    open_cells: OpenCells | None = None,
) -> tuple[torch.Tensor, InjectionReport]:
    """Inject VPLs: add ``(flux/pi) cosine_lobe(normal)`` to the cell that holds ``position + bias h normal``.

    Args:
        vpls: positions [m], unit normals, flux [W]; no VPL at all gives a volume of zeros.
        grid: the volume's cells, h = ``grid.cell_size``.
        l_max: highest SH degree, 0..3.
        deposit: ``"nearest"`` cell (the publications), ``"trilinear"`` over the eight cells around the point, or
            ``"visible"`` over those that ``open_cells`` allows. Only ``"nearest"`` has no gradient for ``position`` and
            ``bias``: theirs is None. Within half a cell of the grid's faces the weights fold onto the edge cells, so a
            VPL inside the grid never loses flux.
        bias: offset along the normal, in cells; a number or a tensor of one element.
        open_cells: cells that each VPL may give to, for ``"visible"``.

    Returns:
        Intensity [W/sr], shape [3, (l_max+1)^2, n_z, n_y, n_x], and the report of VPLs outside the grid. Gradients
        reach flux and normal always; the normal counts as the argument of the lobe's polynomials, not as a point on
        the sphere.

    Raises:
        TypeError: wrong type, dtype or device of an argument.
        ValueError: wrong shape, ``l_max`` or ``deposit``, or a number that is not finite.
    """
    if not isinstance(vpls, Vpls):
        raise TypeError(f"vpls: expected difflpv.vpl.Vpls, got {type(vpls).__name__}")
    if not isinstance(grid, Grid):
        raise TypeError(f"grid: expected difflpv.grid.Grid, got {type(grid).__name__}")
    if deposit not in get_args(Deposit):
        raise ValueError(f"deposit: expected one of {', '.join(get_args(Deposit))}, got {deposit!r}")
    if (deposit == "visible") != (open_cells is not None):
        raise ValueError("open_cells: expected with deposit='visible' and with no other")
    coeff_count(l_max)
    check_float("vpls.position", vpls.position)
    for name in ("position", "normal", "flux"):
        check_finite(f"vpls.{name}", getattr(vpls, name))
    check_factor("bias", bias, like=vpls.position)
    cells = cell_coordinates(shifted_points(vpls.position, vpls.normal, grid, bias), grid)
    if deposit != "visible":
        volume = deposit_lobes(cells, vpls.normal, vpls.flux / math.pi, grid.shape, l_max=l_max, deposit=deposit)
    else:
        assert open_cells is not None  # checked above
        weights = open_cells.weights(vpls.position, vpls.normal, grid, bias=bias) * _inside(cells, grid)[:, None]
        lobes = cosine_lobe(vpls.normal, l_max)
        volume = spread_lobes(vpls.flux / math.pi, open_cells.cells, weights, lobes, grid.shape)
    return volume, _report(cells.detach(), vpls.flux.detach(), grid)


def _inside(cells: torch.Tensor, grid: Grid) -> torch.Tensor:
    return ((cells >= 0) & (cells < cells.new_tensor(grid.resolution))).all(1)


def _report(cells: torch.Tensor, flux: torch.Tensor, grid: Grid) -> InjectionReport:
    inside = _inside(cells, grid)
    total = flux.sum()
    lost = (flux.sum(1) * ~inside).sum()
    share = torch.where(
        total > 0, lost / torch.where(total > 0, total, torch.ones_like(total)), torch.zeros_like(total)
    )
    return InjectionReport((~inside).sum(), share)
