"""Light probes that a solved volume lights, and points that read them instead of its cells.

A probe holds the incident radiance of the volume where it stands, an affine fit to the cells that it sees (``difflpv.lookup``):

    L_j,lm = (-1)^l g_l sum over grids h^-2 sum_c W_jc A_c,lm

Intensity A [W/sr] along the flight over h^2 is radiance there; looking toward the light flips the odd degrees. g_l are the
stencil's gains for reading with a wall behind ("backed"): receivers lie on surfaces. A point reads the probes of its
tetrahedron (``difflpv.probes.tetrahedra``). Both steps are linear, so gradients reach everything behind the volume. To find
what a point reads takes no rays, unlike the lookup in cells, and the probes are some kilobytes; light leaks where walls cut
tetrahedra.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from difflpv.grid import Grid
from difflpv.lookup import CellReads, open_cells
from difflpv.probes.probe_set import COEFFS
from difflpv.probes.rows import Rows
from difflpv.probes.tetrahedra import TetrahedralInterpolation
from difflpv.raycast import Raycaster

__all__ = ["VolumeProbes", "probe_radiance"]

_ODD = slice(1, 4)  # coefficients of degree 1: the only odd one of 9


@dataclass(frozen=True, eq=False)
class VolumeProbes:
    """Probes in a volume.

    Attributes:
        position: [p,3] m, float64.
        reads: cells that each probe reads, for each of the solve's grids.
        interpolation: how points read the probes.
    """

    position: torch.Tensor
    reads: tuple[CellReads, ...]
    interpolation: TetrahedralInterpolation

    @classmethod
    def of(
        cls, position: np.ndarray, grids: Sequence[Grid], raycaster: Raycaster, *, dtype: torch.dtype, device: torch.device
    ) -> VolumeProbes:
        """Find out what probes at ``position`` [p,3] m see of the cells of ``grids``, finest first."""
        # in free space any normal will do: without a bias it only lifts the rays by the tracer's own offset
        normal, reads = np.tile((0.0, 1.0, 0.0), (len(position), 1)), []
        x, n = (torch.as_tensor(a, dtype=dtype, device=device) for a in (position, normal))
        for grid in grids:
            usable = open_cells(
                position, normal, grid, mode="affine", raycaster=raycaster, bias=0.0, dtype=dtype, device=device
            )
            reads.append(CellReads(usable.cells, usable.weights(x, n, grid, bias=0.0), usable.backed))
        return cls(torch.as_tensor(position, dtype=torch.float64), tuple(reads), TetrahedralInterpolation(position))

    def rows(self, points: torch.Tensor) -> Rows:
        """Weights of points [n,3] m over the probes, of their dtype and on their device."""
        found = self.interpolation.rows(self.position, points.detach().cpu().double())
        return Rows(found.probe.to(points.device), found.weight.to(dtype=points.dtype, device=points.device))


def probe_radiance(
    volumes: Sequence[torch.Tensor], grids: Sequence[Grid], reads: Sequence[CellReads], gains: torch.Tensor
) -> torch.Tensor:
    """Radiance SH [p,9,3] W/m2 of probes, toward the incoming light; gradients reach volumes and gains.

    Args:
        volumes: accumulated intensity [W/sr] of each grid, [3, K, n_z, n_y, n_x] with K >= 9.
        grids: theirs.
        reads: of the probes, ``VolumeProbes.reads``.
        gains: of each coefficient [K].
    """
    parts = []
    for volume, grid, r in zip(volumes, grids, reads, strict=True):
        held = volume[:, :COEFFS].flatten(2)[:, :, r.cells.long()]  # [3,9,p,27]
        parts.append(torch.einsum("cknj,nj->nkc", held, r.weights) / grid.cell_size**2)
    sign = torch.ones_like(gains[:COEFFS])
    sign[_ODD] = -1
    return torch.stack(parts).sum(0) * (sign * gains[:COEFFS])[:, None]
