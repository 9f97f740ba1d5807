"""Occlusion: the geometry volume of blockers, and the transmittance between neighbouring cells (physics.md, 4).

Source: Kaplanyan and Dachsbacher 2010, section 4.2 (blocking potential on a lattice shifted by half a cell, SH
cosine lobes of surfels scaled by area / h^2, ``"clamp"``). The ``"exp"`` model is this project's: smooth, for
optimisation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from difflpv.bridge import check_float, launch, refuse_forward_mode, refuse_second_derivative, warp_scalar
from difflpv.coordinates import cell_coordinates, check_factor, check_finite
from difflpv.grid import Grid
from difflpv.injection import deposit_lobes
from difflpv.sh import degree_of_count, sh_basis
from warp_kernels.occlusion import occlusion_kernels

__all__ = ["Blockers", "OcclusionModel", "attenuate", "blocking_potential", "geometry_volume", "transmittance"]

OcclusionModel = Literal["clamp", "exp"]


@dataclass(frozen=True, eq=False)
class Blockers:
    """Surfels that block light.

    Attributes:
        position: [n,3] m.
        normal: unit normals, [n,3].
        area: [n] m2.
    """

    position: torch.Tensor
    normal: torch.Tensor
    area: torch.Tensor

    def __post_init__(self) -> None:
        check_float("position", self.position)
        for name, shape in (("position", (len(self), 3)), ("normal", (len(self), 3)), ("area", (len(self),))):
            tensor = getattr(self, name)
            check_float(name, tensor, like=self.position)
            if tuple(tensor.shape) != shape:
                raise ValueError(f"{name}: expected shape {list(shape)}, got {list(tensor.shape)}")

    def __len__(self) -> int:
        return len(self.position)


def geometry_volume(blockers: Blockers, grid: Grid, *, l_max: int, two_sided: bool = True) -> torch.Tensor:
    """Blocking potential of surfels on the lattice of cell corners.

    Each surfel adds ``area / h^2 cosine_lobe(normal)`` to its nearest corner (at a tie the higher one); one whose
    nearest corner would lie outside the lattice, more than half a cell outside the grid, is ignored.

    A wall of surfels of area h^2, one per corner, has the potential B at normal incidence: two-sided 2 (1/4 + 5/16)
    = 9/8 for ``l_max`` 2 and 3 but only 1/2 for ``l_max`` 1, whose degrees hold no even lobe but the constant;
    one-sided 17/16 and 3/4 on the normal's side, 1/16 and -1/4 behind it.

    Args:
        blockers: surfels; none at all gives zeros.
        grid: the light volume's cells; the lattice has one corner more per axis.
        l_max: highest SH degree of the potential, 0..3; need not be that of the light.
        two_sided: add the lobe of -normal as well (this project's surfaces); False reproduces the publications.

    Returns:
        Potential [1], shape [(l_max+1)^2, n_z+1, n_y+1, n_x+1]. Gradients reach area and normal.

    Raises:
        TypeError: wrong type of an argument.
        ValueError: ``l_max`` out of range, a negative area, or a number that is not finite.
    """
    if not isinstance(blockers, Blockers):
        raise TypeError(f"blockers: expected difflpv.occlusion.Blockers, got {type(blockers).__name__}")
    if not isinstance(grid, Grid):
        raise TypeError(f"grid: expected difflpv.grid.Grid, got {type(grid).__name__}")
    for name in ("position", "normal", "area"):
        check_finite(f"blockers.{name}", getattr(blockers, name))
    if not torch.compiler.is_compiling() and bool((blockers.area < 0).any()):
        raise ValueError(f"blockers.area: expected areas >= 0, got {float(blockers.area.min())}")
    corners = cell_coordinates(blockers.position, grid) + 0.5  # corner i is the centre of cell i of this lattice
    nz, ny, nx = grid.shape
    share = (blockers.area / grid.cell_size**2)[:, None]
    lattice = (nz + 1, ny + 1, nx + 1)
    volume = deposit_lobes(corners, blockers.normal, share, lattice, l_max=l_max, deposit="nearest")[0]
    if not two_sided:
        return volume
    # Y_lm(-n) = (-1)^l Y_lm(n): both lobes together double the even degrees and cancel the odd ones.
    factors = [2.0 if degree % 2 == 0 else 0.0 for degree in range(l_max + 1) for _ in range(2 * degree + 1)]
    return volume * volume.new_tensor(factors)[:, None, None, None]


@torch.library.custom_op("difflpv::corner_mean", mutates_args=())
def _corner_mean(corners: torch.Tensor, offsets: torch.Tensor) -> torch.Tensor:
    faces, z, y, x = corners.shape
    mean = corners.new_empty((faces, z - 1, y - 1, x - 1))
    kernel = occlusion_kernels(warp_scalar(corners.dtype)).forward
    launch(kernel, mean.shape, [corners.contiguous(), offsets.contiguous(), mean], corners.device)
    return mean


@_corner_mean.register_fake
def _(corners, offsets):
    faces, z, y, x = corners.shape
    return corners.new_empty((faces, z - 1, y - 1, x - 1))


@torch.library.custom_op("difflpv::corner_mean_adjoint", mutates_args=())
def _corner_mean_adjoint(mean_bar: torch.Tensor, offsets: torch.Tensor) -> torch.Tensor:
    faces, z, y, x = mean_bar.shape
    bar = mean_bar.new_empty((faces, z + 1, y + 1, x + 1))
    kernel = occlusion_kernels(warp_scalar(mean_bar.dtype)).adjoint
    launch(kernel, bar.shape, [mean_bar.contiguous(), offsets.contiguous(), bar], mean_bar.device)
    return bar


@_corner_mean_adjoint.register_fake
def _(mean_bar, offsets):
    faces, z, y, x = mean_bar.shape
    return mean_bar.new_empty((faces, z + 1, y + 1, x + 1))


def _setup(ctx: Any, inputs: tuple[Any, ...], output: torch.Tensor) -> None:
    ctx.save_for_backward(inputs[1])


def _backward(ctx: Any, mean_bar: torch.Tensor) -> tuple[torch.Tensor, None]:
    return _corner_mean_adjoint(mean_bar, *ctx.saved_tensors), None


_corner_mean.register_autograd(_backward, setup_context=_setup)
refuse_second_derivative("occlusion", _corner_mean_adjoint)


def blocking_potential(
    blocking: torch.Tensor, offsets: np.ndarray | torch.Tensor, directions: np.ndarray | torch.Tensor
) -> torch.Tensor:
    """Blocking potential B of each face of a stencil, for every source cell.

    The potential midway between the centres of source and destination cell, towards the light, -direction: the mean
    over the corners of the shared face (4), edge (2) or corner (1). Linear in ``blocking`` and free of the
    strength, so a fit evaluates it once and then only ``attenuate``.

    Args:
        blocking: geometry volume [1], shape [K, n_z+1, n_y+1, n_x+1], K in 1, 4, 9, 16.
        offsets: destination minus source cell (x, y, z) of each face, entries -1, 0 or 1, shape [F,3].
        directions: unit vectors in which the light travels, shape [F,3].

    Returns:
        Potential [1], shape [F, n_z, n_y, n_x], also where the destination lies outside the grid. Gradients reach
        ``blocking``.

    Raises:
        TypeError: wrong type or dtype of an argument.
        ValueError: wrong shape, an offset beyond the 26 neighbours, a direction that is no unit vector, NaN.
    """
    check_float("blocking", blocking)
    if blocking.ndim != 4 or min(blocking.shape[1:]) < 2 or blocking.shape[0] not in (1, 4, 9, 16):
        raise ValueError(f"blocking: expected shape [1|4|9|16, n_z+1, n_y+1, n_x+1], got {list(blocking.shape)}")
    check_finite("blocking", blocking)
    steps = torch.as_tensor(offsets, device=blocking.device)
    toward = torch.as_tensor(directions, dtype=blocking.dtype, device=blocking.device)
    _check_faces(steps, toward)
    l_max = degree_of_count(blocking.shape[0])
    at_corners = torch.einsum("fk,kzyx->fzyx", sh_basis(-toward, l_max), blocking)
    refuse_forward_mode("occlusion", at_corners)
    return _corner_mean(at_corners, steps.to(torch.int32))


def _check_faces(offsets: torch.Tensor, directions: torch.Tensor) -> None:
    if offsets.is_floating_point() or offsets.dtype == torch.bool:
        raise TypeError(f"offsets: expected integers, got {offsets.dtype}")
    if offsets.ndim != 2 or offsets.shape[1] != 3:
        raise ValueError(f"offsets: expected shape [F, 3], got {list(offsets.shape)}")
    if directions.shape != offsets.shape:
        raise ValueError(f"directions: expected shape {list(offsets.shape)}, got {list(directions.shape)}")
    if torch.compiler.is_compiling() or not len(offsets):
        return
    if int(offsets.abs().max()) > 1:
        raise ValueError(f"offsets: expected entries -1, 0 or 1, got {int(offsets.abs().max())} in absolute value")
    error = (directions.norm(dim=1) - 1).abs()
    if not bool((error < 1e-4).all()):
        row = int((~(error < 1e-4)).nonzero()[0])
        raise ValueError(f"directions: expected unit vectors, got {directions[row].tolist()} in row {row}")


def attenuate(
    potential: torch.Tensor, *, model: OcclusionModel = "clamp", strength: float | torch.Tensor = 1.0
) -> torch.Tensor:
    """Transmittance of a blocking potential: ``1 - clamp(s B, 0, 1)`` or ``exp(-s max(B, 0))``.

    Args:
        potential: B [1], any shape.
        model: ``"clamp"`` (the publications) or ``"exp"`` (smooth in s, for optimisation).
        strength: s >= 0, the occlusion factor; a number or a tensor of one element.

    Returns:
        Transmittance [1] in [0, 1], shape of ``potential``. Gradients reach potential and strength.

    Raises:
        TypeError: wrong type or dtype of an argument.
        ValueError: unknown model, or a strength that is negative or not finite.
    """
    check_float("potential", potential)
    check_factor("strength", strength, like=potential, minimum=0.0)
    scaled = potential * (strength.reshape(()) if isinstance(strength, torch.Tensor) else strength)
    if model == "clamp":
        return 1 - scaled.clamp(0, 1)
    if model == "exp":
        return torch.exp(-scaled.clamp_min(0))
    raise ValueError(f"model: expected 'clamp' or 'exp', got {model!r}")


def transmittance(
    blocking: torch.Tensor,
    offsets: np.ndarray | torch.Tensor,
    directions: np.ndarray | torch.Tensor,
    *,
    model: OcclusionModel = "clamp",
    strength: float | torch.Tensor = 1.0,
) -> torch.Tensor:
    """Share of the flux that passes from each source cell through each face of a stencil.

    Args:
        blocking: geometry volume, see ``blocking_potential``.
        offsets: see ``blocking_potential``.
        directions: see ``blocking_potential``.
        model: see ``attenuate``.
        strength: see ``attenuate``.

    Returns:
        Transmittance [1] in [0, 1], shape [F, n_z, n_y, n_x]; exactly 1 for an empty geometry volume. Gradients reach
        ``blocking`` and ``strength``.

    Raises:
        TypeError: see ``blocking_potential`` and ``attenuate``.
        ValueError: see ``blocking_potential`` and ``attenuate``.
    """
    return attenuate(blocking_potential(blocking, offsets, directions), model=model, strength=strength)
