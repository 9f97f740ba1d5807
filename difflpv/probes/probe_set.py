"""Light probes as values: positions, radiance SH, validity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from difflpv.sh import cosine_lobe

__all__ = ["COEFFS", "DIRECTIONS_26", "ProbeSet", "irradiance_of"]

COEFFS = 9  # degree 2
_CUBE = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], np.float64)
DIRECTIONS_26 = _CUBE / np.linalg.norm(_CUBE, axis=1, keepdims=True)
"""Unit vectors from a cube's centre to its faces, edges and corners [26,3]: the normals that probes are judged by."""


def irradiance_of(radiance: Any, normals: np.ndarray) -> Any:
    """Irradiance [..., k, channels] W/m2 for unit normals [k,3] of radiance SH [..., 9, channels]; torch or NumPy.

    E(n) = sum over i of A_l(i) L_i Y_i(n) (physics.md, "Closed forms").
    """
    lobes: Any = np.asarray(cosine_lobe(np.asarray(normals, np.float64), 2))
    if isinstance(radiance, torch.Tensor):
        lobes = torch.as_tensor(lobes, dtype=radiance.dtype, device=radiance.device)
    return lobes @ radiance


@dataclass(frozen=True, eq=False)
class ProbeSet:
    """Light probes.

    Attributes:
        position: [n,3] m, float64.
        radiance: coefficients L_i = integral of L(w) Y_i(w) dw of the incident radiance [n,9,3] W/m2, w pointing from the probe
            toward the incoming light; real orthonormal SH without Condon-Shortley phase, index l(l+1)+m (physics.md).
        valid: [n] bool; a probe that is not (inside a solid, say) is left out of every interpolation. All, if None.
    """

    position: np.ndarray
    radiance: np.ndarray
    valid: np.ndarray | None = None

    def __post_init__(self) -> None:
        position, radiance = np.array(self.position, np.float64), np.array(self.radiance, np.float64)
        if position.ndim != 2 or position.shape[1] != 3:
            raise ValueError(f"probe position: expected shape [n,3], got {list(position.shape)}")
        if radiance.shape != (len(position), COEFFS, 3):
            raise ValueError(f"probe radiance: expected shape [{len(position)},9,3], got {list(radiance.shape)}")
        valid = np.ones(len(position), bool) if self.valid is None else np.array(self.valid)
        if valid.shape != (len(position),) or valid.dtype != bool:
            raise ValueError(f"probe valid: expected {len(position)} booleans, got {valid.dtype} {list(valid.shape)}")
        for name, value in (("position", position), ("radiance", radiance)):
            if not np.isfinite(value[valid]).all():
                raise ValueError(f"probe {name}: expected finite numbers, got NaN or infinity")
        for name, value in (("position", position), ("radiance", radiance), ("valid", valid)):
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.position)

    @property
    def usable(self) -> ProbeSet:
        """The valid probes alone."""
        assert self.valid is not None
        return self if self.valid.all() else ProbeSet(self.position[self.valid], self.radiance[self.valid])

    def irradiance(self, normals: np.ndarray) -> np.ndarray:
        """Irradiance [n, k, 3] W/m2 at every probe for unit normals [k,3]."""
        return np.asarray(irradiance_of(self.radiance, normals))
