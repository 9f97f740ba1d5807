"""How points read a set of probes: which interpolation, with what of its own, as a value that is kept beside the probes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from difflpv.probes.gaussian import GaussianInterpolation
from difflpv.probes.rows import Interpolation
from difflpv.probes.tetrahedra import TetrahedralInterpolation
from difflpv.probes.visible import VisibleInterpolation
from difflpv.raycast import Raycaster
from difflpv.scene import Scene

__all__ = ["InterpolationName", "ProbeReader"]

InterpolationName = Literal["tetrahedra", "gaussian"]


@dataclass(frozen=True, eq=False)
class ProbeReader:
    """How points read probes.

    Attributes:
        interpolation: barycentric in "tetrahedra", as engines do, or by "gaussian" footprints.
        metric: of the footprints [n,3,3] 1/m; None with tetrahedra.
        neighbours: probes that a point reads at most, of the footprints.
        sight: weights are multiplied by how far a point sees each probe (``VisibleInterpolation``).
    """

    interpolation: InterpolationName = "tetrahedra"
    metric: np.ndarray | None = None
    neighbours: int = 8
    sight: bool = False

    def __post_init__(self) -> None:
        if self.interpolation not in ("tetrahedra", "gaussian"):
            raise ValueError(f"interpolation: expected tetrahedra or gaussian, got {self.interpolation!r}")
        if (self.metric is not None) != (self.interpolation == "gaussian"):
            raise ValueError("metric: expected one a probe with gaussian footprints, none with tetrahedra")
        if self.neighbours < 1:
            raise ValueError(f"neighbours: expected a number > 0, got {self.neighbours}")

    def over(self, position: np.ndarray, scene: Scene, *, raycaster: Raycaster | None = None) -> Interpolation:
        """The interpolation over probes at ``position`` [n,3] m of ``scene``, whose walls ``sight`` looks at."""
        inner: Interpolation
        if self.metric is None:
            inner = TetrahedralInterpolation(position)
        else:
            inner = GaussianInterpolation(torch.as_tensor(self.metric), neighbours=self.neighbours)
        return VisibleInterpolation(inner, scene, raycaster=raycaster) if self.sight else inner
