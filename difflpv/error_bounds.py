"""An error with its uncertainty, from receivers whose truth is noisy itself.

Error of cases (light sets) j with receivers i of weight w:

    E^2 = mean_j  sum_i w_i (|p_ij - t_ij|^2 - s_ij^2) / sum_i w_i (|t_ij|^2 - s_ij^2)

with s^2 the truth's variance: what it adds to the squares on average is taken off above and below, so that a perfect
prediction has error 0 for any number of paths. Its bounds are quantiles of a bootstrap over receivers (each drawn with all
its cases), so they hold the scatter of the truth's noise too. They say nothing about lights that are not among the cases,
unless cases are drawn as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

__all__ = ["Estimate", "ErrorSamples"]

_RESAMPLES = 400


@dataclass(frozen=True)
class Estimate:
    """Error with one-sided bounds: it is above ``low``, and below ``high``, each with the confidence asked for."""

    error: float
    low: float
    high: float

    def __post_init__(self) -> None:
        if not 0 <= self.low <= self.error <= self.high:
            raise ValueError(f"estimate: expected 0 <= low <= error <= high, got {self.low}, {self.error}, {self.high}")

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {"error": self.error, "low": self.low, "high": self.high}


@dataclass(frozen=True, eq=False)
class ErrorSamples:
    """What each receiver adds to the squared error and to the squared truth, both [cases, n]; may be negative."""

    squared: np.ndarray
    power: np.ndarray

    @classmethod
    def of(cls, found: np.ndarray, truth: np.ndarray, standard_error: np.ndarray, weight: np.ndarray) -> ErrorSamples:
        """From irradiance [cases, n, 3] found and traced, the standard errors of the latter, and weights [cases, n].

        Raises:
            ValueError: shapes that do not fit, numbers that are not finite, or a case whose truth is all noise: what is left of
                its square could make any error 0.
        """
        if not (found.shape == truth.shape == standard_error.shape) or found.ndim != 3 or weight.shape != found.shape[:2]:
            shapes = [list(a.shape) for a in (found, truth, standard_error, weight)]
            raise ValueError(f"error samples: expected three of shape [cases, n, 3] and weights [cases, n], got {shapes}")
        if not all(np.isfinite(a).all() for a in (found, truth, standard_error, weight)):
            raise ValueError("error samples: expected finite numbers, got NaN or infinity")
        variance = (standard_error.astype(float) ** 2).sum(-1)
        squared, whole = ((part.astype(float) ** 2).sum(-1) for part in (found - truth, truth))
        energy, noise = ((weight * part).sum(1) for part in (whole, variance))
        lost = (energy > 0) & (energy <= (1 + 1e-9) * noise)
        if lost.any():
            raise ValueError(f"error samples: the truth of case {int(lost.argmax())} cannot be told from its noise")
        return cls(weight * (squared - variance), weight * (whole - variance))

    def estimate(self, *, confidence: float = 0.95, seed: int = 0, draw_cases: bool = False) -> Estimate:
        """The error and its bounds, each one-sided with ``confidence``; of so many other cases with ``draw_cases``."""
        if not 0.5 <= confidence < 1:
            raise ValueError(f"confidence: expected a number in [0.5, 1), got {confidence}")
        draws = _draws(self.squared.shape[1], seed)
        power = np.maximum(draws @ self.power.T, 1e-300)
        each = draws @ self.squared.T / power
        if draw_cases:
            count = len(self.squared)
            each *= np.random.default_rng([seed, 1]).multinomial(count, np.full(count, 1 / count), size=len(draws))
        spread = np.sqrt(np.maximum(each.mean(1), 0))
        error = float(np.sqrt(max(0.0, float((self.squared.sum(1) / np.maximum(self.power.sum(1), 1e-300)).mean()))))
        low, high = np.quantile(spread, [1 - confidence, confidence])
        return Estimate(error, min(error, float(low)), max(error, float(high)))


@lru_cache(maxsize=4)
def _draws(count: int, seed: int) -> np.ndarray:
    """How often each of ``count`` receivers is drawn in each resample, [resamples, count]."""
    return np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=_RESAMPLES).astype(float)
