"""How points read a set of probes: which interpolation, with what of its own, as a value that is kept beside the probes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from difflpv.probes.gaussian import GaussianInterpolation
from difflpv.probes.rows import Interpolation
from difflpv.probes.tetrahedra import TetrahedralInterpolation
from difflpv.probes.visible import Sight, VisibleInterpolation
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
        if self.metric is not None:
            metric = np.array(self.metric, np.float64)
            if metric.ndim != 3 or metric.shape[1:] != (3, 3) or not len(metric):
                raise ValueError(f"metric: expected shape [n,3,3] with n > 0, got {list(metric.shape)}")
            if not np.isfinite(metric).all():
                raise ValueError("metric: expected finite numbers, got NaN or infinity")
            metric.flags.writeable = False
            object.__setattr__(self, "metric", metric)
        if isinstance(self.neighbours, bool) or not isinstance(self.neighbours, int) or self.neighbours < 1:
            raise ValueError(f"neighbours: expected a whole number > 0, got {self.neighbours!r}")
        if not isinstance(self.sight, bool):
            raise ValueError(f"sight: expected True or False, got {self.sight!r}")

    def kept(self, index: np.ndarray) -> ProbeReader:
        """The reader of some of the probes: those of ``index``, numbers or booleans [n]."""
        return self if self.metric is None else replace(self, metric=self.metric[index])

    @property
    def described(self) -> str:
        """In words, for people and files."""
        how = "tetrahedra" if self.metric is None else f"Gaussian footprints of {self.neighbours} neighbours"
        return f"{how}, weighted by sight" if self.sight else how

    def over(self, position: np.ndarray, scene: Scene, *, raycaster: Raycaster | None = None) -> Interpolation:
        """The interpolation over probes at ``position`` [n,3] m of ``scene``, whose walls ``sight`` looks at."""
        inner: Interpolation
        if self.metric is None:
            inner = TetrahedralInterpolation(position)
        else:
            inner = GaussianInterpolation(torch.tensor(self.metric), neighbours=self.neighbours)
        return VisibleInterpolation(inner, Sight(scene, raycaster=raycaster)) if self.sight else inner
