"""What a stencil is trained for: exact free-space transport, unit l=0 gain, no growing mode.

The truth is the closed form E = Phi (d.u)+ (-n.u)+ / (pi r^2) of a small cosine emitter (physics.md). A volume predicts
E = lobe(-n)^T G(x) lobe(d) / pi with the response G of one lit cell, so the mean square error over all directions d and
normals n is a quadratic form,

    mean (E - truth)^2 = truncation + sum_ij A_i^2 A_j^2 / (16 pi^4) (G_ij - Y_i(u) Y_j(u) / r^2)^2,

with the zonal factors A of the cosine lobe. No sampling is left. The first term does not depend on the stencil: it is what
degree l_max can not hold of two clamped cosines. At l_max 2 it is 0.1247 of the truth (relative L2), and since A_3 = 0 it is
the same at l_max 3: ``truncation_floor`` is the least error that any linear stencil can have.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from difflpv.sh import cosine_lobe, lobe_factors, sh_basis
from difflpv.symmetry import neighborhood_offsets
from difflpv.training.octant import IMPULSES, octant_cells, octant_multiplicity, octant_parities, octant_responses

__all__ = ["FreeSpaceLoss", "PlaneLoss", "Shell", "growth_penalty", "truncation_floor"]

_TRUTH_SQUARE = 1 / (6 * math.pi) ** 2  # mean over d and n of (r^2 truth)^2: each clamped cosine has mean square 1/6


@dataclass(frozen=True)
class Shell:
    """Receivers between two distances [cells] that are read after some steps, and what their error counts."""

    steps: int
    near: float
    far: float
    weight: float = 1.0


def truncation_floor(l_max: int) -> float:
    """Relative L2 error that degree ``l_max`` leaves even with perfect transport: emitter and receiver are clamped cosines."""
    degrees = np.arange(l_max + 1)
    factors = lobe_factors(l_max)[degrees**2]
    kept = (factors**2 * (2 * degrees + 1)).sum() / (16 * math.pi**2)
    return math.sqrt(1 - (kept * 6) ** 2)


class FreeSpaceLoss:
    """Weighted sum over shells of the squared relative transport error (the part above ``truncation_floor``)."""

    def __init__(self, l_max: int, neighbors: int, shells: tuple[Shell, ...], *, size: int, dtype: torch.dtype) -> None:
        if not shells or any(not 0 < s.near < s.far or s.far > size for s in shells):
            raise ValueError(f"shells: expected 0 < near < far <= {size} cells, got {shells}")
        self.l_max, self.neighbors, self.size, self.shells = l_max, neighbors, size, shells
        self.stops = tuple(sorted({shell.steps for shell in shells}))
        impulses, factors = IMPULSES[l_max], lobe_factors(l_max) ** 2
        cells = octant_cells(size).astype(float)
        radius = np.linalg.norm(cells, axis=-1)
        basis = sh_basis(cells / np.maximum(radius, 1e-9)[..., None], l_max)
        truth = np.stack([basis * basis[..., [j]] for j in impulses.index])
        scale = np.stack([n * factors[j] * factors for j, n in zip(impulses.index, impulses.stands_for, strict=True)])
        multiplicity = octant_multiplicity(size)
        self._truth = torch.tensor(truth, dtype=dtype)
        self._square = torch.tensor(radius**2, dtype=dtype)[None, ..., None]
        self._scale = torch.tensor(scale / (16 * math.pi**4) / _TRUTH_SQUARE, dtype=dtype)[:, None, None, None]
        self._shares = []
        for shell in shells:
            inside = multiplicity * ((radius >= shell.near) & (radius <= shell.far))
            self._shares.append(torch.tensor(inside / inside.sum(), dtype=dtype)[None, ..., None])

    def responses(self, matrices: torch.Tensor) -> torch.Tensor:
        """``octant_responses`` after ``stops`` steps."""
        return octant_responses(matrices, neighbors=self.neighbors, l_max=self.l_max, size=self.size, stops=self.stops)

    def squares(self, found: torch.Tensor) -> torch.Tensor:
        """Squared relative transport error of each shell, from ``responses``."""
        out = []
        for shell, share in zip(self.shells, self._shares, strict=True):
            gap = found[self.stops.index(shell.steps)] * self._square - self._truth
            out.append((gap.square() * self._scale * share).sum())
        return torch.stack(out)

    def errors(self, matrices: torch.Tensor) -> list[float]:
        """Relative L2 error of each shell, truncation included: what a table of free-space errors shows."""
        floor = truncation_floor(self.l_max) ** 2
        with torch.no_grad():
            return (self.squares(self.responses(matrices)) + floor).sqrt().tolist()

    def __call__(self, matrices: torch.Tensor) -> torch.Tensor:
        """What training lowers: the weighted sum of ``squares``."""
        return self.of(self.responses(matrices))

    def of(self, found: torch.Tensor) -> torch.Tensor:
        """The same from ``responses``."""
        weights = torch.tensor([shell.weight for shell in self.shells], dtype=found.dtype)
        return (weights * self.squares(found)).sum()


class PlaneLoss:
    """Error of a lit plane: small errors of single cells that all have one sign add up over a wall.

    Patches of (2 R + 1)^2 cells with normal z and exitance 1 W/m2; receivers on the axis m cells above facing down (up to
    R = 16), level with the patch and facing up (self-lighting, truth 0), below it facing up (truth 0), and to the side.
    ``weight`` times the sum of the squared errors.
    """

    _HEIGHTS, _RADII = (1, 2, 4, 8), (1, 3, 6, 12)

    def __init__(self, l_max: int, *, size: int, dtype: torch.dtype, weight: float) -> None:
        if size <= max(self._RADII):
            raise ValueError(f"size: expected more than {max(self._RADII)} cells, got {size}")
        count = (l_max + 1) ** 2
        index = list(IMPULSES[l_max].index)
        cells, up = octant_cells(size).astype(float), np.array([0.0, 0.0, 1.0])
        emitted = cosine_lobe(up, l_max)[index] / math.pi  # Y_xy is not in it, so the representatives suffice
        parity = octant_parities(l_max)[0, :, 0, 0].numpy()  # z mirror: what the field below the patch looks like
        radius = np.maximum(np.linalg.norm(cells, axis=-1), 1e-9)
        multiplicity = 2.0 ** (cells[..., :2] > 0).sum(-1)
        rows, truths = [], []

        def add(height: int, normal: np.ndarray, share: np.ndarray, below: bool) -> None:
            u = cells[height] / radius[height][..., None] * (np.array([1, 1, -1]) if below else 1)
            exact = np.maximum(u[..., 2], 0) * np.maximum(-(u @ normal), 0) / (math.pi * radius[height] ** 2)
            reads = cosine_lobe(-normal, l_max) * (parity if below else 1) * emitted[:, None]
            for reach in self._RADII:
                inside = share * ((cells[height][..., :2] <= reach).all(-1))
                row = np.zeros((len(index), size, size, size, count))
                row[:, height] = reads[:, None, None] * inside[None, ..., None]
                rows.append(row)
                truths.append(float((inside * exact).sum()))

        add(0, up, multiplicity[0], False)
        for height in self._HEIGHTS:
            add(height, -up, multiplicity[height], False)
            add(height, up, multiplicity[height], False)
            if height <= 2:
                add(height, up, multiplicity[height], True)
            side = np.where(cells[height][..., 0] > 0, multiplicity[height] / 2, 0.0)
            add(height, np.array([-1.0, 0.0, 0.0]), side, False)
        self._rows = torch.tensor(np.stack(rows).reshape(len(rows), -1), dtype=dtype)
        self._truths = torch.tensor(truths, dtype=dtype)
        self._weight = weight

    def predictions(self, found: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Irradiance [W/m2] of every patch and receiver, and the truth, from one response [J, z, y, x, K]."""
        return self._rows @ found.reshape(-1), self._truths

    def of(self, found: torch.Tensor) -> torch.Tensor:
        """Weighted sum of squares."""
        predicted, truth = self.predictions(found)
        return self._weight * (predicted - truth).square().sum()


def growth_penalty(matrices: torch.Tensor, neighbors: int, wave_vectors: torch.Tensor, *, margin: float) -> torch.Tensor:
    """Sum over wave vectors k [1/cell] of max(0, rho(k) - 1 + margin min(1, |k|^2))^2, rho = spectral radius of the symbol.

    The margin closes at k = 0, where conservation itself puts an eigenvalue at 1.
    """
    offsets = torch.tensor(np.array(neighborhood_offsets(neighbors)), dtype=wave_vectors.dtype)
    phase = wave_vectors @ offsets.T
    symbol = torch.tensordot(torch.complex(phase.cos(), -phase.sin()), matrices.to(torch.complex128), 1)
    radius = torch.linalg.eigvals(symbol).abs().amax(-1)
    allowed = 1 - margin * wave_vectors.square().sum(-1).clamp_max(1)
    return (radius - allowed).clamp_min(0).square().sum()
