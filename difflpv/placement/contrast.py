"""How different two probes are: the contrast functions of the light probe thesis (3.1.3, "Contrast of spherical harmonics").

    samples   max over directions d of |Y_a(d) - Y_b(d)| / mean Y        Y: luminance of the irradiance
    mse       mean over coefficients of (a_i - b_i)^2 / mean a_i^2

Both are divided by a mean over the probes of the scene, so that thresholds are pure numbers; the thesis does not say by what.
Two probes differ as soon as one direction does, and are alike when all are: hence the maximum.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from difflpv.probes.probe_set import DIRECTIONS_26, irradiance_of

__all__ = ["AXES_6", "Contrast", "ContrastKind", "luminance"]

ContrastKind = Literal["samples6", "samples26", "mse"]

AXES_6 = np.concatenate([np.eye(3), -np.eye(3)])
"""The crude sample set of the thesis: both directions of each axis [6,3]."""

_BT709 = np.array([0.2126, 0.7152, 0.0722])


def luminance(rgb: np.ndarray) -> np.ndarray:
    """Luminance (ITU-R BT.709) [..., lights] of RGB of one light after the other [..., 3 x lights]."""
    return np.asarray(rgb.reshape(*rgb.shape[:-1], rgb.shape[-1] // 3, 3) @ _BT709)


class Contrast:
    """A contrast function with the scene's mean fixed."""

    def __init__(self, kind: ContrastKind, reference: np.ndarray) -> None:
        """Take the scene's mean from the probes ``reference`` [n,9,C] W/m2.

        Raises:
            ValueError: no such contrast function.
        """
        if kind not in ("samples6", "samples26", "mse"):
            raise ValueError(f"contrast: expected samples6, samples26 or mse, got '{kind}'")
        self.kind = kind
        mean = np.square(reference).mean() if kind == "mse" else np.abs(self._features(reference)).mean()
        self._scale = max(float(mean), 1e-30)

    def _features(self, radiance: np.ndarray) -> np.ndarray:
        if self.kind == "mse":
            return radiance.reshape(len(radiance), -1)
        normals = AXES_6 if self.kind == "samples6" else DIRECTIONS_26
        return luminance(irradiance_of(radiance, normals)).reshape(len(radiance), -1)

    def pairs(self, radiance: np.ndarray, pair: np.ndarray) -> np.ndarray:
        """Contrast [p] of the pairs of indices [p,2] into probes that hold ``radiance`` [n,9,C]."""
        features = self._features(radiance)
        difference = features[pair[:, 0]] - features[pair[:, 1]]
        if self.kind == "mse":
            return np.asarray(np.square(difference).mean(1) / self._scale)
        return np.asarray(np.abs(difference).max(1, initial=0.0) / self._scale)

    def groups(self, radiance: np.ndarray, group: np.ndarray) -> np.ndarray:
        """Largest contrast [g] of any two probes in groups of indices [g,k]."""
        first, second = np.triu_indices(group.shape[1], 1)
        pair = np.stack([group[:, first], group[:, second]], -1)
        return self.pairs(radiance, pair.reshape(-1, 2)).reshape(len(group), -1).max(1)
