"""Linear colours for what is shown: exposure of radiance, and the scale of errors."""

from __future__ import annotations

import numpy as np

from difflpv.io.srgb import srgb_to_linear

__all__ = ["ERROR_SCALE_END", "exposed", "relative_errors", "scale_color"]

ERROR_SCALE_END = 1.0
"""Error that the brightest colour of the scale stands for, in means of the truth."""
# "inferno" of matplotlib (CC0) at eighths, sRGB: even in lightness, dark for small errors.
_SCALE = np.array(
    [[0, 0, 4], [31, 12, 72], [85, 15, 109], [136, 34, 106], [186, 54, 85], [227, 89, 51], [249, 140, 10], [249, 201, 50],
     [252, 255, 164]]
) / 255.0  # fmt: skip


def exposed(radiance: np.ndarray, stops: float) -> np.ndarray:
    """Linear display colours of radiance [...,3]: times 2^stops, clipped to 0..1."""
    return np.clip(np.asarray(radiance, np.float64) * 2.0**stops, 0.0, 1.0)


def relative_errors(predicted: np.ndarray, truth: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """Error of each receiver, |E - E*| over the weighted mean of |E*|, [n].

    Args:
        predicted: irradiance E [n,3] W/m2.
        truth: irradiance E* [n,3] W/m2, not black.
        weight: area of each receiver [n]; all alike by default.

    Raises:
        ValueError: shapes that differ, or a truth that is black everywhere.
    """
    predicted, truth = np.asarray(predicted, np.float64), np.asarray(truth, np.float64)
    if predicted.shape != truth.shape or truth.ndim != 2:
        raise ValueError(f"errors: expected equal shapes [n,3], got {list(predicted.shape)} and {list(truth.shape)}")
    mean = float(np.average(np.linalg.norm(truth, axis=1), weights=weight))
    if not mean > 0:
        raise ValueError("errors: the truth is black, there is nothing to be relative to")
    return np.linalg.norm(predicted - truth, axis=1) / mean


def scale_color(share: np.ndarray) -> np.ndarray:
    """Linear colours [n,3] of a scale from black (0) over red to light yellow (1 and more)."""
    x = np.clip(np.asarray(share, np.float64), 0, 1) * (len(_SCALE) - 1)
    return np.asarray(srgb_to_linear(np.stack([np.interp(x, np.arange(len(_SCALE)), _SCALE[:, k]) for k in range(3)], -1)))
