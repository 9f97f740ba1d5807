"""How far predictions are from the truth: the figures that every table shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import torch

from difflpv.loss import best_scale, mean_error, percentile_error, relative_l2

__all__ = ["Score", "format_scores", "mean_score", "predict_constant", "relative_noise", "score"]


@dataclass(frozen=True)
class Score:
    """Errors of one prediction, over receivers weighted by area.

    Attributes:
        method: name of the method.
        component: "direct" or "bounce1".
        light: number of the light set, -1 for a mean over several.
        relative_l2: ||E - E*|| / ||E*||.
        scaled_l2: the same after the best single scale.
        scale: that scale; 1 for an absolutely calibrated method.
        mean_error: mean |E - E*| over the mean of E*.
        percentile_95: 95th percentile of |E - E*| over the mean of E*.
    """

    method: str
    component: str
    light: int
    relative_l2: float
    scaled_l2: float
    scale: float
    mean_error: float
    percentile_95: float

    def to_json(self) -> dict[str, object]:
        """Plain values."""
        return asdict(self)


def score(
    prediction: np.ndarray, target: np.ndarray, weight: np.ndarray, *, method: str, component: str, light: int
) -> Score:
    """Score irradiance [n,3] against ``target`` [n,3] with area weights [n].

    Raises:
        ValueError: shapes that differ, a target that is zero everywhere, or numbers that are not finite.
    """
    if not np.isfinite(prediction).all():
        raise ValueError(f"prediction of '{method}': expected finite irradiance, got NaN or infinity")
    p, t, w = (torch.as_tensor(np.asarray(a), dtype=torch.float64) for a in (prediction, target, weight))
    scale = best_scale(p, t, w) if bool(p.any()) else torch.ones((), dtype=torch.float64)
    return Score(
        method,
        component,
        light,
        relative_l2(p, t, w).item(),
        relative_l2(scale * p, t, w).item(),
        scale.item(),
        mean_error(p, t, w).item(),
        percentile_error(p, t, w).item(),
    )


def predict_constant(target: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The area-weighted mean of the targets at every receiver, [n,3]: what every method has to beat."""
    mean = (weight[:, None] * target).sum(0) / weight.sum()
    return np.broadcast_to(mean, target.shape).copy()


def relative_noise(standard_error: np.ndarray, target: np.ndarray, weight: np.ndarray) -> float:
    """Relative L2 error that a perfect prediction would show against targets [n,3] of this standard error [n,3].

    Args:
        standard_error: of the targets [W/m2].
        target: irradiance [W/m2].
        weight: area weights [n].

    Raises:
        ValueError: a target that is zero everywhere.
    """
    power = float((weight[:, None] * np.asarray(target, float) ** 2).sum())
    if not power > 0:
        raise ValueError("target: expected a value other than zero under a positive weight, got none")
    return float(np.sqrt((weight[:, None] * np.asarray(standard_error, float) ** 2).sum() / power))


def mean_score(scores: Sequence[Score]) -> Score:
    """Mean over light sets of one method and component."""
    first = scores[0]
    if any((s.method, s.component) != (first.method, first.component) for s in scores):
        raise ValueError("scores: expected one method and component")
    names = ("relative_l2", "scaled_l2", "scale", "mean_error", "percentile_95")
    return Score(first.method, first.component, -1, *(float(np.mean([getattr(s, n) for s in scores])) for n in names))


def format_scores(scores: Sequence[Score]) -> str:
    """A plain-text table, a line per score."""
    width = max([len("method"), *(len(s.method) for s in scores)])
    lines = [
        f"{'method':{width}s}  component  light  rel. L2  at best scale (scale)  mean error  95th percentile",
    ]
    for s in scores:
        light = " mean" if s.light < 0 else f"{s.light:5d}"
        lines.append(
            f"{s.method:{width}s}  {s.component:9s}  {light}  {s.relative_l2:7.3f}  {s.scaled_l2:13.3f} ({s.scale:5.2f})"
            f"  {s.mean_error:10.3f}  {s.percentile_95:15.3f}"
        )
    return "\n".join(lines)
