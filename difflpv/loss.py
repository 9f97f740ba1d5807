"""How far a prediction is from its target: losses that a fit minimises and figures that a report shows.

Irradiance losses take a prediction E and a target E* of equal shape, ``[receivers, 3]`` W/m2 as a rule, and a weight w
that covers the leading dimensions: the area of each receiver [m2], zero for one that must not count. Image losses take
linear, channels-last images ``[H, W, 3]`` or ``[B, H, W, 3]``. Each returns a scalar tensor.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = [
    "best_scale",
    "image_l1",
    "image_ssim",
    "log_l2",
    "mean_error",
    "percentile_error",
    "relative_l2",
]


def relative_l2(prediction: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """Weighted relative L2 error ||sqrt(w)(E - E*)|| / ||sqrt(w) E*||; its gradient is 0 where the residual is 0.

    Args:
        prediction: E, any shape.
        target: E*, shape of ``prediction``.
        weight: w >= 0 over the leading dimensions of ``prediction``; None counts all alike.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree, a weight is negative or not finite, or the weighted target is all zero.
    """
    weight = _checked(prediction, target, weight)
    root = weight.sqrt()
    norm = torch.linalg.vector_norm(root * target)
    if not norm > 0:
        raise ValueError("target: expected a value other than zero under a positive weight, got none")
    # vector_norm's own derivative is the subgradient 0 at the origin, where sqrt(sum of squares) has NaN.
    return torch.linalg.vector_norm(root * (prediction - target)) / norm


def log_l2(prediction: Tensor, target: Tensor, weight: Tensor | None = None, *, floor: float = 1e-3) -> Tensor:
    """Weighted root mean square of log(1 + E/e) - log(1 + E*/e), e = ``floor`` times the weighted mean of E*.

    Compares dark and bright receivers by ratio. A negative prediction is continued by the tangent at zero, so that it
    keeps a finite gradient that leads back.

    Args:
        prediction: E, any shape.
        target: E* >= 0, shape of ``prediction``.
        weight: w >= 0 over the leading dimensions of ``prediction``; None counts all alike.
        floor: irradiance below which differences stop to count, relative to the mean target.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: as ``relative_l2``, a negative target, or a floor that is not positive.
    """
    weight = _checked(prediction, target, weight)
    if not 0 < floor < torch.inf:
        raise ValueError(f"floor: expected a positive number, got {floor}")
    if (target < 0).any():
        raise ValueError(f"target: expected values >= 0, got {target.min().item():g}")
    total = weight.sum()
    epsilon = floor * _mean_target(target, weight)
    ratio = prediction / epsilon
    logarithm = torch.where(ratio > 0, torch.log1p(ratio.clamp(min=0)), ratio)
    return torch.linalg.vector_norm(weight.sqrt() * (logarithm - torch.log1p(target / epsilon))) / total.sqrt()


def best_scale(prediction: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """The factor s that makes ||sqrt(w)(s E - E*)|| smallest: sum(w E E*) / sum(w E^2).

    Args:
        prediction: E, any shape.
        target: E*, shape of ``prediction``.
        weight: w >= 0 over the leading dimensions of ``prediction``; None counts all alike.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree, a weight is negative or not finite, or the weighted prediction is all zero.
    """
    weight = _checked(prediction, target, weight)
    power = (weight * prediction * prediction).sum()
    if not power > 0:
        raise ValueError("prediction: expected a value other than zero under a positive weight, got none")
    return (weight * prediction * target).sum() / power


def mean_error(prediction: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """Weighted mean of |E - E*| over the weighted mean of E*.

    Args:
        prediction: E, any shape.
        target: E*, shape of ``prediction``, of positive mean.
        weight: w >= 0 over the leading dimensions of ``prediction``; None counts all alike.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree, a weight is negative or not finite, or the mean target is not positive.
    """
    weight = _checked(prediction, target, weight)
    return (weight * (prediction - target).abs()).sum() / weight.sum() / _mean_target(target, weight)


def percentile_error(
    prediction: Tensor, target: Tensor, weight: Tensor | None = None, *, percentile: float = 95.0
) -> Tensor:
    """Error |E - E*| that ``percentile`` percent of the weight does not exceed, over the weighted mean of E*.

    The percentile is the inverse of the weighted distribution (``numpy.quantile`` calls it ``inverted_cdf``).

    Args:
        prediction: E, any shape.
        target: E*, shape of ``prediction``, of positive mean.
        weight: w >= 0 over the leading dimensions of ``prediction``; None counts all alike.
        percentile: in (0, 100].

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: as ``mean_error``, or a percentile outside (0, 100].
    """
    weight = _checked(prediction, target, weight)
    if not 0 < percentile <= 100:
        raise ValueError(f"percentile: expected a number in (0, 100], got {percentile}")
    mean = _mean_target(target, weight)
    counted = weight.flatten() > 0
    error, order = (prediction - target).abs().flatten()[counted].sort()
    cumulative = weight.flatten()[counted][order].cumsum(0)
    index = torch.searchsorted(cumulative, cumulative[-1:] * (percentile / 100))
    return error[index.clamp(max=len(error) - 1)].squeeze(0) / mean


def image_l1(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean absolute difference of two linear images over the mean of the target.

    Args:
        prediction: linear RGB, channels last, shape [H, W, 3] or [B, H, W, 3].
        target: shape of ``prediction``, of positive mean.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree or are not those of images, or the mean target is not positive.
    """
    _check_images(prediction, target)
    return mean_error(prediction, target)


def image_ssim(prediction: Tensor, target: Tensor, *, peak: float | None = None, window: int = 11) -> Tensor:
    """Structural dissimilarity (1 - SSIM)/2 of two linear images, by ``kornia.losses.ssim_loss``.

    SSIM's constants are relative to the brightest value that an image can take, which for a linear image is not 1: the
    target's own peak is used unless one is given. Negative values, which no picture has, count as 0.

    Args:
        prediction: linear RGB, channels last, shape [H, W, 3] or [B, H, W, 3].
        target: shape of ``prediction``.
        peak: brightest value; give the same one for images that are to be compared with each other.
        window: edge of the Gaussian window [pixels], odd, at most the image's edge.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree or are not those of images, a window that does not fit, or a peak that is not
            positive.
    """
    import kornia

    _check_images(prediction, target)
    if window < 1 or window % 2 == 0 or window > min(target.shape[-3:-1]):
        edge = min(target.shape[-3:-1])
        raise ValueError(f"window: expected an odd number of pixels up to the image's edge {edge}, got {window}")
    brightest = float(target.max()) if peak is None else float(peak)
    if not 0 < brightest < torch.inf:
        name = "target" if peak is None else "peak"
        raise ValueError(f"{name}: expected a positive, finite peak, got {brightest:g}")
    first, second = (image.reshape(-1, *image.shape[-3:]).movedim(-1, 1).clamp(min=0) for image in (prediction, target))
    # eps = 0: kornia's default of 1e-12 biases images whose peak is small.
    return kornia.losses.ssim_loss(first, second, window, max_val=brightest, eps=0.0)


def _checked(prediction: Tensor, target: Tensor, weight: Tensor | None) -> Tensor:
    """The weight, checked and broadcast to the prediction's shape."""
    _check_pair(prediction, target)
    if weight is None:
        return torch.ones_like(target)
    if not isinstance(weight, Tensor):
        raise TypeError(f"weight: expected a tensor, got {type(weight).__name__}")
    if weight.shape != prediction.shape[: weight.ndim]:
        expected = f"the leading dimensions of prediction {list(prediction.shape)}"
        raise ValueError(f"weight: expected {expected}, got {list(weight.shape)}")
    if not weight.isfinite().all() or (weight < 0).any():
        raise ValueError(f"weight: expected finite values >= 0, got {weight.min().item():g} to {weight.max().item():g}")
    if not (weight > 0).any():
        raise ValueError("weight: expected a positive value, got none")
    weight = weight.reshape(weight.shape + (1,) * (prediction.ndim - weight.ndim))
    return weight.to(prediction).expand(prediction.shape)


def _check_pair(prediction: Tensor, target: Tensor) -> None:
    for name, tensor in (("prediction", prediction), ("target", target)):
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            got = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
            raise TypeError(f"{name}: expected a floating-point tensor, got {got}")
    if prediction.shape != target.shape:
        raise ValueError(f"target: expected the prediction's shape {list(prediction.shape)}, got {list(target.shape)}")
    if prediction.numel() == 0:
        raise ValueError(f"prediction: expected at least one value, got shape {list(prediction.shape)}")


def _check_images(prediction: Tensor, target: Tensor) -> None:
    _check_pair(prediction, target)
    if prediction.ndim not in (3, 4) or prediction.shape[-1] != 3:
        got = list(prediction.shape)
        raise ValueError(f"prediction: expected an image of shape [H, W, 3] or [B, H, W, 3], got {got}")


def _mean_target(target: Tensor, weight: Tensor) -> Tensor:
    mean = (weight * target).sum() / weight.sum()
    if not mean > 0:
        raise ValueError(f"target: expected a positive weighted mean, got {mean.item():g}")
    return mean
