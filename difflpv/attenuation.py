"""From what geometry says to what passes: tunable transmittance between neighbouring cells.

    traced            T' = T / (T + s (1 - T)),    s > 0 the strength: smooth, and leaves T = 0 and T = 1 what they are
    geometry volume   T' = 1 - clamp(s B, 0, 1)  or  exp(-s max(B, 0))    (``difflpv.occlusion.attenuate``)

The strength is one number, times one per kind of neighbour (face, edge, corner: a smooth correction of the traced value),
times the geometric mean of a field at the two cells. A field of propagation multiplies T' likewise, so that what passes
between two cells stays the same both ways.
"""

from __future__ import annotations

import numpy as np
import torch

from difflpv.bridge import check_float
from difflpv.occlusion import OcclusionModel, attenuate

__all__ = ["attenuate_pairs", "pair_mean", "strengthen"]


def strengthen(transmittance: torch.Tensor, strength: torch.Tensor) -> torch.Tensor:
    """Tune traced transmittance: ``T / (T + s (1 - T))``; s = 1 leaves it, more blocks more.

    Args:
        transmittance: T in [0, 1], any shape.
        strength: s > 0, broadcast to that shape.

    Returns:
        Shape of ``transmittance``. Gradients reach both.

    Raises:
        TypeError, ValueError: naming the argument, what was expected and what came.
    """
    check_float("transmittance", transmittance)
    check_float("strength", strength, like=transmittance)
    if not torch.compiler.is_compiling() and not bool(((strength > 0) & strength.isfinite()).all()):
        raise ValueError(f"strength: expected finite numbers > 0, got {float(strength.detach().min())}")
    return transmittance / (transmittance + strength * (1 - transmittance))


def pair_mean(field: torch.Tensor, offsets: np.ndarray) -> torch.Tensor:
    """Geometric mean of a positive field [n_z, n_y, n_x] at c and c + offset, shape [P, n_z, n_y, n_x].

    Args:
        field: positive numbers.
        offsets: (x, y, z) with entries -1, 0, 1, shape [P,3]; beyond the grid the field goes on as at its edge.
    """
    padded = torch.nn.functional.pad(field[None, None], (1,) * 6, mode="replicate")[0, 0].log()
    z, y, x = field.shape
    here = padded[1:-1, 1:-1, 1:-1]
    there = [padded[1 + k : 1 + k + z, 1 + j : 1 + j + y, 1 + i : 1 + i + x] for i, j, k in np.asarray(offsets).tolist()]
    return torch.stack([(0.5 * (here + other)).exp() for other in there])


def attenuate_pairs(
    offsets: np.ndarray,
    *,
    potential: torch.Tensor | None = None,
    passed: torch.Tensor | None = None,
    model: OcclusionModel = "clamp",
    strength: torch.Tensor,
    correction: torch.Tensor | None = None,
    cell_occlusion: torch.Tensor | None = None,
    cell_propagation: torch.Tensor | None = None,
) -> torch.Tensor | None:
    """Share of the light that passes between cells; None where nothing blocks.

    Args:
        offsets: of the pairs or faces that the first axis stands for, shape [P,3].
        potential: blocking potential of the geometry volume, shape [P, n_z, n_y, n_x], or None.
        passed: traced transmittance, same shape, or None; at most one of the two is given.
        model: of the geometry volume.
        strength: one number.
        correction: strength of traced transmittance towards face, edge and corner neighbours, [3], or None.
        cell_occlusion: strength by cell, shape [n_z, n_y, n_x], or None.
        cell_propagation: what passes by cell, same shape, or None.

    Returns:
        Shape [P, n_z, n_y, n_x]. Gradients reach every tensor.
    """
    blocked = cell_occlusion if cell_occlusion is None else pair_mean(cell_occlusion, offsets)
    share = None
    if potential is not None:
        share = attenuate(potential if blocked is None else potential * blocked, model=model, strength=strength)
    elif passed is not None:
        by_pair = strength.expand(len(offsets))
        if correction is not None:
            kind = torch.as_tensor(np.abs(offsets).sum(1) - 1, device=correction.device)
            by_pair = by_pair * correction[kind]
        by_pair = by_pair[:, None, None, None]
        share = strengthen(passed, by_pair if blocked is None else by_pair * blocked)
    if cell_propagation is None:
        return share
    moved = pair_mean(cell_propagation, offsets)
    return moved if share is None else share * moved
