"""Responses of a cube-symmetric stencil to one lit cell, on one octant of space.

A stencil that respects the cube's symmetries (``difflpv.symmetry``) answers an impulse in any SH coefficient by a rotated copy
of four responses: to Y_00, Y_10, Y_2-2 (xy) and Y_20 stand for degrees 0, 1 and the two irreducible parts of degree 2. Each is
even or odd in every axis, so one octant holds all of it. A sum over all emitter directions, receiver normals and cells of the
whole cube is then a weighted sum over four fields on an eighth of the cells: deterministic, and cheap enough for quasi-Newton.

The adjoint is the same sweep with the transposed stencil; the matrices' gradient is one correlation per step, as three wide
matrix products (``_correlate``). Step t lights at most t cells from the source, so early steps work on small octants.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from difflpv.convolution import stencil_weight
from difflpv.sh import coeff_count
from difflpv.symmetry import cube_symmetries, neighborhood_offsets, sh_representation

__all__ = ["IMPULSES", "Impulses", "octant_cells", "octant_multiplicity", "octant_parities", "octant_responses"]


@dataclass(frozen=True)
class Impulses:
    """Representative coefficients and how many coefficients each stands for."""

    index: tuple[int, ...]
    stands_for: tuple[int, ...]


IMPULSES = {1: Impulses((0, 2), (1, 3)), 2: Impulses((0, 2, 4, 6), (1, 3, 3, 2)), 3: Impulses((0, 2, 4, 6), (1, 3, 3, 2))}


def octant_cells(size: int) -> np.ndarray:
    """Cells (x, y, z) with all coordinates 0..size-1, shape [size, size, size, 3], indexed [z, y, x]."""
    z, y, x = np.meshgrid(*[np.arange(size)] * 3, indexing="ij")
    return np.stack([x, y, z], -1)


def octant_multiplicity(size: int) -> np.ndarray:
    """How many cells of the full cube each octant cell stands for: 2 per coordinate that is not 0, shape [z, y, x]."""
    return 2.0 ** (octant_cells(size) > 0).sum(-1)


@lru_cache
def octant_parities(l_max: int) -> torch.Tensor:
    """Sign of coefficient i of the response to impulse j under the mirrors of z, y and x, shape [3, J, 1, 1, K]."""
    group, rep = cube_symmetries(), sh_representation(l_max)
    signs = []
    for axis in (2, 1, 0):
        mirror = np.eye(3, dtype=int)
        mirror[axis, axis] = -1
        own = np.diag(rep[int(np.flatnonzero((group == mirror).all((1, 2)))[0])]).round()
        signs.append(own[list(IMPULSES[l_max].index), None] * own)
    return torch.tensor(np.stack(signs), dtype=torch.float64)[:, :, None, None]


def _pad(field: torch.Tensor, size: int, parities: torch.Tensor) -> torch.Tensor:
    """[J, w, w, w, K] -> [J, size+2, ...]: mirror images at index 0, zeros beyond the field."""
    w = field.shape[1]
    padded = field.new_zeros((field.shape[0], size + 2, size + 2, size + 2, field.shape[-1]))
    padded[:, 1 : w + 1, 1 : w + 1, 1 : w + 1] = field
    padded[:, 0] = padded[:, 2] * parities[0]
    padded[:, :, 0] = padded[:, :, 2] * parities[1]
    padded[:, :, :, 0] = padded[:, :, :, 2] * parities[2]
    return padded


def _convolve(padded: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.conv3d(padded.movedim(-1, 1), weight).movedim(1, -1)


def _correlate(after: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
    """Sum over cells of after(d) before(d - n)^T for all 27 offsets, indexed [1+n_z, 1+n_y, 1+n_x], shape [3,3,3,K,K].

    ``before`` is padded [J, s+2, ...], ``after`` [J, s, ...]. On the flattened padded grid a shift is one number; shifting
    ``after`` along y and ``before`` along x side by side gives nine offsets in one product [3K, N] [N, 3K].
    """
    count, size = before.shape[-1], before.shape[1]
    wide = torch.zeros_like(before)
    wide[:, 1:-1, 1:-1, 1:-1] = after
    left, right = wide.reshape(-1, count), before.reshape(-1, count)
    rows, dy, dz = len(left), size, size * size
    margin = dz + 2 * dy + 1
    pad_left = torch.nn.functional.pad(left, (0, 0, margin, margin))
    pad_right = torch.nn.functional.pad(right, (0, 0, margin, margin))

    def shifted(values: torch.Tensor, by: int) -> torch.Tensor:
        return values[margin + by : margin + by + rows]

    lefts = torch.cat([shifted(pad_left, n_y * dy) for n_y in (-1, 0, 1)], 1).T
    rights = torch.cat([shifted(pad_right, -n_x) for n_x in (-1, 0, 1)], 1)
    rights = torch.nn.functional.pad(rights, (0, 0, dz, dz))
    out = []
    for n_z in (-1, 0, 1):
        begin = dz - n_z * dz
        out.append((lefts @ rights[begin : begin + rows]).reshape(3, count, 3, count).transpose(1, 2))
    return torch.stack(out)


class _Responses(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, matrices: torch.Tensor, neighbors: int, l_max: int, size: int, stops: tuple[int, ...]
    ) -> torch.Tensor:
        offsets = neighborhood_offsets(neighbors)
        weights = [stencil_weight(offsets, own) for own in matrices]
        parities = octant_parities(l_max).to(matrices.dtype)
        index = IMPULSES[l_max].index
        field = matrices.new_zeros((len(index), 1, 1, 1, matrices.shape[-1]))
        field[range(len(index)), 0, 0, 0, index] = 1.0
        total = matrices.new_zeros((len(index), size, size, size, matrices.shape[-1]))
        total[:, 0, 0, 0] = field[:, 0, 0, 0]
        kept, results = [], []
        for step in range(1, max(stops) + 1):
            w = min(step + 1, size)
            padded = _pad(field, w, parities)
            kept.append(padded)
            field = _convolve(padded, weights[min(step, len(weights)) - 1])
            total[:, :w, :w, :w] += field
            if step in stops:
                results.append(total.clone())
        ctx.kept, ctx.setup = kept, (offsets, l_max, size, stops)
        ctx.save_for_backward(matrices)
        return torch.stack(results)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, bar: torch.Tensor) -> tuple[Any, ...]:
        (matrices,) = ctx.saved_tensors
        offsets, l_max, size, stops = ctx.setup
        transposed = [stencil_weight(-offsets, own.transpose(1, 2)) for own in matrices]
        parities = octant_parities(l_max).to(matrices.dtype)
        share = torch.as_tensor(octant_multiplicity(size), dtype=matrices.dtype)[..., None]
        bar = bar / share  # per cell of the full cube, where the adjoint field has the symmetries of the field
        sums = matrices.new_zeros((len(matrices), 3, 3, 3, *matrices.shape[2:]))
        source = torch.zeros_like(bar[0])
        after = torch.zeros_like(bar[0])
        for step in reversed(range(1, max(stops) + 1)):
            w = min(step + 1, size)
            if step in stops:
                source = source + bar[sorted(stops).index(step)]
            after = source[:, :w, :w, :w] + after[:, :w, :w, :w]
            own = min(step, len(matrices)) - 1
            sums[own] += _correlate(after * share[:w, :w, :w], ctx.kept[step - 1])
            if step > 1:
                below = min(step, size)
                after = _convolve(_pad(after, w, parities), transposed[own])[:, :below, :below, :below]
        z, y, x = (offsets[:, axis] + 1 for axis in (2, 1, 0))
        return sums[:, z, y, x], None, None, None, None


def octant_responses(matrices: torch.Tensor, *, neighbors: int, l_max: int, size: int, stops: tuple[int, ...]) -> torch.Tensor:
    """Light accumulated over the steps after an impulse in the cell at the origin.

    Args:
        matrices: a stencil that respects the cube's symmetries, offsets as in ``neighborhood_offsets``, shape [n,K,K]; or one
            for each of the first steps [s,n,K,K], of which the last goes on.
            Its gradient is right up to what the symmetries average out: contract it with ``equivariant_basis``.
        neighbors: 6 or 26.
        l_max: 1, 2 or 3.
        size: cells per axis of the octant; light beyond is lost.
        stops: increasing numbers of steps after which to report.

    Returns:
        Accumulated coefficients for each impulse of ``IMPULSES``, shape [len(stops), J, z, y, x, K].
    """
    if list(stops) != sorted(set(stops)) or stops[0] < 1:
        raise ValueError(f"stops: expected increasing numbers of steps from 1, got {stops}")
    expected = (len(neighborhood_offsets(neighbors)), coeff_count(l_max), coeff_count(l_max))
    if matrices.shape[-3:] != expected or matrices.ndim not in (3, 4) or not len(matrices):
        raise ValueError(f"matrices: expected {neighbors} neighbours and the cell at l_max {l_max}, got {list(matrices.shape)}")
    return _Responses.apply(matrices.reshape(-1, *expected), neighbors, l_max, size, tuple(stops))
