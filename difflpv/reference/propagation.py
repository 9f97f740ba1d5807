"""Torch twin of propagation: the equations of physics.md, "The chain" 5, one face at a time. Readable, slow, exact."""

from __future__ import annotations

import torch

__all__ = ["propagate_faces", "propagate_linear", "shift_cells"]


def shift_cells(field: torch.Tensor, offset: tuple[int, int, int]) -> torch.Tensor:
    """Move a field [..., n_z, n_y, n_x] by a cell offset (x, y, z); what leaves the grid is lost."""
    moved = torch.zeros_like(field)
    into: list[slice] = []
    out_of: list[slice] = []
    for axis, step in zip((-3, -2, -1), reversed(offset), strict=True):
        size = field.shape[axis]
        into.append(slice(max(step, 0), size + min(step, 0)))
        out_of.append(slice(max(-step, 0), size + min(-step, 0)))
    moved[..., into[0], into[1], into[2]] = field[..., out_of[0], out_of[1], out_of[2]]
    return moved


def propagate_faces(
    volume: torch.Tensor,
    offsets: list[tuple[int, int, int]],
    weights: torch.Tensor,
    lobes: torch.Tensor,
    factors: torch.Tensor,
    transmittance: torch.Tensor | None = None,
    *,
    clamp: bool = True,
    occlude_first_step: bool = False,
) -> torch.Tensor:
    """Accumulate ``len(factors)`` steps of a face stencil.

    Args:
        volume: injected intensity [W/sr], shape [C, K, n_z, n_y, n_x].
        offsets: destination minus source cell of each face.
        weights: coefficients -> face flux, shape [F,K].
        lobes: face flux -> destination coefficients, shape [F,K].
        factors: propagation factor of each step, shape [steps].
        transmittance: at the source cell, shape [F, n_z, n_y, n_x], or None.
        clamp: negative intensity carries no flux.
        occlude_first_step: apply ``transmittance`` to the first step too.

    Returns:
        Sum of the injected volume and all steps, same shape.
    """
    moving = accumulated = volume
    for step, factor in enumerate(factors):
        flux = torch.einsum("fk,ckzyx->fczyx", weights, moving)
        if clamp:
            flux = torch.relu(flux)
        if transmittance is not None and (step > 0 or occlude_first_step):
            flux = flux * transmittance[:, None]
        moving = torch.zeros_like(volume)
        for f, offset in enumerate(offsets):
            moving = moving + shift_cells(flux[f], offset)[:, None] * lobes[f][:, None, None, None]
        moving = factor * moving
        accumulated = accumulated + moving
    return accumulated


def propagate_linear(
    volume: torch.Tensor,
    offsets: list[tuple[int, int, int]],
    matrices: torch.Tensor,
    factors: torch.Tensor,
    transmittance: torch.Tensor | None = None,
    *,
    occlude_first_step: bool = False,
) -> torch.Tensor:
    """Accumulate ``len(factors)`` steps of a linear stencil: ``matrices`` [n,K,K], destination from source.

    Args:
        volume: injected intensity [W/sr], shape [C, K, n_z, n_y, n_x].
        offsets: destination minus source cell (x, y, z) of each matrix.
        matrices: shape [n,K,K].
        factors: propagation factor of each step, shape [steps].
        transmittance: share that passes between c and c + n, at c, for every offset n > (0, 0, 0) in lexicographic order,
            shape [P, n_z, n_y, n_x], or None.
        occlude_first_step: apply ``transmittance`` to the first step too.

    Returns:
        Sum of the injected volume and all steps, same shape.
    """
    ahead = sorted(n for n in offsets if n > (0, 0, 0))
    moving = accumulated = volume
    for step, factor in enumerate(factors):
        arrived = torch.zeros_like(volume)
        for offset, matrix in zip(offsets, matrices, strict=True):
            sent = torch.einsum("ij,cjzyx->cizyx", matrix, moving)
            back = (-offset[0], -offset[1], -offset[2])
            if transmittance is None or offset == back or (step == 0 and not occlude_first_step):
                arrived = arrived + shift_cells(sent, offset)
            elif offset in ahead:  # the pair's share lies at the source cell
                arrived = arrived + shift_cells(sent * transmittance[ahead.index(offset)], offset)
            else:  # and here at the destination
                arrived = arrived + shift_cells(sent, offset) * transmittance[ahead.index(back)]
        moving = factor * arrived
        accumulated = accumulated + moving
    return accumulated
