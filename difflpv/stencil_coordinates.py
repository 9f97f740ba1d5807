"""Free numbers of a cube-symmetric, conserving stencil: what training and fits move.

    A = sum_i (p + N z)_i B_i

B is the basis of stencils that respect the cube's symmetries (``difflpv.symmetry``); p + N z runs over the coordinates whose
l=0 gain in a uniform field is exactly 1: p is the shortest of them, the columns of N are orthonormal and orthogonal to the
gain's gradient.
"""

from __future__ import annotations

import numpy as np
import torch

from difflpv.stencil import LinearStencil
from difflpv.symmetry import equivariant_basis, neighborhood_offsets, project_equivariant

__all__ = ["StencilCoordinates"]


class StencilCoordinates:
    """The map between free numbers z [m] and the matrices of a stencil, float64.

    Args:
        l_max: SH degree.
        neighbors: 6 or 26.

    Attributes:
        offsets: the cell itself and its neighbours, shape [n,3].
        size: m, one less than the dimension of the symmetric stencils.
    """

    def __init__(self, l_max: int, neighbors: int) -> None:
        basis = equivariant_basis(l_max, neighbors)
        gain = basis[:, :, 0, 0].sum(1)
        self.offsets, self.size, self._neighbors = neighborhood_offsets(neighbors), len(basis) - 1, neighbors
        self._basis = torch.tensor(np.array(basis))  # a copy: the cached one is read-only
        self._point = torch.tensor(gain / (gain @ gain))
        # Householder: the other columns of the reflection that takes gain to an axis are orthogonal to it.
        mirror = gain / np.linalg.norm(gain)
        mirror[0] += np.sign(mirror[0]) or 1.0
        reflection = np.eye(len(gain)) - 2 * np.outer(mirror, mirror) / (mirror @ mirror)
        self._free = torch.tensor(reflection[:, 1:])

    @classmethod
    def for_stencil(cls, stencil: LinearStencil) -> StencilCoordinates:
        """Coordinates of stencils with the degree and neighbourhood of this one."""
        return cls(stencil.l_max, 6 if len(stencil.offsets) <= 7 else 26)

    def matrices(self, z: torch.Tensor) -> torch.Tensor:
        """Matrices [n,K,K] of free numbers z [m], float64; differentiable."""
        return torch.tensordot(self._point + self._free @ z, self._basis, 1)

    def of(self, stencil: LinearStencil) -> torch.Tensor:
        """Free numbers [m] of the nearest conserving symmetric stencil."""
        coordinates = torch.tensor(project_equivariant(stencil, neighbors=self._neighbors))
        return self._free.T @ (coordinates - self._point)
