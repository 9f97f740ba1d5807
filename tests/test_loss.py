import re

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from difflpv import loss as losses
from difflpv.loss import best_scale, image_l1, image_ssim, log_l2, mean_error, percentile_error, relative_l2

LAW = settings(deadline=None, max_examples=30)
DOUBLE = torch.float64


def sample(seed, shape=(7, 3), dtype=DOUBLE):
    generator = torch.Generator().manual_seed(seed)
    prediction = torch.rand(shape, generator=generator, dtype=dtype) + 0.1
    target = torch.rand(shape, generator=generator, dtype=dtype) + 0.1
    weight = torch.rand(shape[0], generator=generator, dtype=dtype)
    return prediction, target, weight


def test_relative_l2_against_its_definition():
    p, t, w = (x.numpy() for x in sample(0))
    expected = np.sqrt((w[:, None] * (p - t) ** 2).sum()) / np.sqrt((w[:, None] * t**2).sum())
    assert float(relative_l2(*map(torch.from_numpy, (p, t, w)))) == pytest.approx(expected, rel=1e-14)


def test_values_known_without_computing():
    t = torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], dtype=DOUBLE)
    assert float(relative_l2(1.25 * t, t)) == pytest.approx(0.25)
    assert float(relative_l2(torch.zeros_like(t), t)) == pytest.approx(1.0)
    assert float(best_scale(0.8 * t, t)) == pytest.approx(1.25)
    assert float(mean_error(1.1 * t, t)) == pytest.approx(0.1)
    assert float(image_l1((0.5 * t).expand(4, 2, 3), t.expand(4, 2, 3))) == pytest.approx(0.5)
    # far above the floor a common factor k costs |log k|
    assert float(log_l2(2 * t, t, floor=1e-9)) == pytest.approx(np.log(2), rel=1e-7)


@LAW
@given(seed=st.integers(0, 1000), factor=st.floats(0.01, 100))
def test_relative_figures_do_not_depend_on_the_unit(seed, factor):
    p, t, w = sample(seed)
    for function in (relative_l2, log_l2, mean_error, percentile_error, best_scale):
        torch.testing.assert_close(function(factor * p, factor * t, 7.0 * w), function(p, t, w), rtol=1e-9, atol=0)


@LAW
@given(seed=st.integers(0, 1000), change=st.floats(-0.5, 0.5))
def test_no_scale_beats_the_best(seed, change):
    p, t, w = sample(seed)
    s = best_scale(p, t, w)
    assert relative_l2(s * p, t, w) <= relative_l2((s + change) * p, t, w) + 1e-15


@LAW
@given(seed=st.integers(0, 1000), percentile=st.floats(1, 100))
def test_percentile_against_numpy(seed, percentile):
    p, t, w = sample(seed, (23, 3))
    w[3] = 0
    error, weights = (p - t).abs().numpy().ravel(), np.repeat(w.numpy(), 3)
    expected = np.quantile(error, percentile / 100, weights=weights, method="inverted_cdf")
    mean = float((w[:, None] * t).sum() / (3 * w.sum()))
    assert float(percentile_error(p, t, w, percentile=percentile)) == pytest.approx(expected / mean, rel=1e-12)


def test_weight_zero_does_not_count():
    p, t, w = sample(1)
    w[2] = 0
    for function in (relative_l2, log_l2, mean_error, percentile_error, best_scale):
        before = function(p, t, w)
        changed = p.clone()
        changed[2] = 1e6
        torch.testing.assert_close(function(changed, t, w), before)


@pytest.mark.parametrize("function", [relative_l2, log_l2, best_scale, mean_error])
def test_gradcheck(function):
    p, t, w = sample(2)
    p[0, 0] = -0.3
    assert torch.autograd.gradcheck(lambda x: function(x, t, w), (p.requires_grad_(True),))


@pytest.mark.parametrize("function", [image_l1, lambda p, t: image_ssim(p, t, window=5, peak=1.0)])
def test_gradcheck_of_images(function):
    p, t, _ = sample(3, (6, 7, 3))
    assert torch.autograd.gradcheck(lambda x: function(x, t), (p.requires_grad_(True),), fast_mode=True)


EVERY = [relative_l2, log_l2, mean_error, image_l1, lambda p, t: image_ssim(p, t, window=3)]


@pytest.mark.parametrize("function", EVERY)
def test_zero_residual_has_a_finite_gradient(function):
    p, _, _ = sample(4, (5, 5, 3))
    p.requires_grad_(True)
    value = function(p, p.detach().clone())
    (gradient,) = torch.autograd.grad(value, p)
    assert float(value.detach()) == pytest.approx(0, abs=1e-12) and gradient.isfinite().all()
    assert gradient.abs().max() < 1e-9


def test_log_l2_leads_a_negative_prediction_back():
    t = torch.ones(4, 3, dtype=DOUBLE)
    p = torch.full((4, 3), -0.5, dtype=DOUBLE, requires_grad=True)
    value = log_l2(p, t)
    (gradient,) = torch.autograd.grad(value, p)
    assert value.isfinite() and (gradient < 0).all()


def test_ssim_uses_the_hdr_peak_and_guards_negatives():
    p, t, _ = sample(5, (16, 16, 3))
    torch.testing.assert_close(image_ssim(40 * p, 40 * t), image_ssim(p, t))  # the peak scales along
    assert float(image_ssim(t, t)) == pytest.approx(0, abs=1e-12)
    assert 0.1 < float(image_ssim(p, t)) <= 1
    negative = p.clone()
    negative[0] = -3.0
    torch.testing.assert_close(image_ssim(negative, t), image_ssim(negative.clamp(min=0), t))
    dark = 1e-7 * t.float()  # kornia's default eps would dominate here
    assert float(image_ssim(dark, dark)) == pytest.approx(0, abs=1e-4)
    batch = torch.stack([p, t]), torch.stack([t, t])
    assert float(image_ssim(*batch, peak=1.0)) == pytest.approx(float(image_ssim(p, t, peak=1.0)) / 2)


def test_float32_and_non_contiguous():
    p, t, w = sample(6, (8, 3), torch.float32)
    assert relative_l2(p, t, w).dtype == torch.float32
    strided = torch.stack([p, p], -1)[..., 0]
    assert not strided.is_contiguous()
    torch.testing.assert_close(relative_l2(strided, t, w.double()), relative_l2(p, t, w))


PAIR = [relative_l2, log_l2, best_scale, mean_error, percentile_error]


@pytest.mark.parametrize("function", PAIR)
def test_bad_arguments(function):
    p, t, w = sample(7)
    with pytest.raises(TypeError, match="prediction: expected a floating-point tensor, got list"):
        function([1.0], t)
    with pytest.raises(TypeError, match="target: expected a floating-point tensor, got torch.int64"):
        function(p, t.long())
    with pytest.raises(ValueError, match=re.escape("target: expected the prediction's shape [7, 3], got [6, 3]")):
        function(p, t[:6])
    with pytest.raises(ValueError, match=re.escape("weight: expected the leading dimensions of prediction [7, 3]")):
        function(p, t, w[:3])
    with pytest.raises(ValueError, match="weight: expected finite values >= 0, got -1"):
        function(p, t, w - w - 1)
    with pytest.raises(ValueError, match="weight: expected finite values"):
        function(p, t, w * torch.nan)
    with pytest.raises(ValueError, match="weight: expected a positive value"):
        function(p, t, 0 * w)
    with pytest.raises(TypeError, match="weight: expected a tensor, got float"):
        function(p, t, 1.0)
    with pytest.raises(ValueError, match="prediction: expected at least one value"):
        function(p[:0], t[:0])


def test_more_bad_arguments():
    p, t, w = sample(8)
    for function in (relative_l2, log_l2, mean_error, percentile_error):
        with pytest.raises(ValueError, match="^target: expected"):
            function(p, 0 * t, w)
    with pytest.raises(ValueError, match="^prediction: expected a value other than zero"):
        best_scale(0 * p, t, w)
    with pytest.raises(ValueError, match="floor: expected a positive number, got 0"):
        log_l2(p, t, floor=0)
    with pytest.raises(ValueError, match="target: expected values >= 0, got -1"):
        log_l2(p, -t / t)
    with pytest.raises(ValueError, match="percentile: expected a number"):
        percentile_error(p, t, percentile=0)
    for function in (image_l1, image_ssim):
        with pytest.raises(ValueError, match="expected an image of shape"):
            function(p, t)
    image = t.expand(7, 7, 3)
    with pytest.raises(ValueError, match="window: expected an odd number of pixels up to the image's edge 7, got 11"):
        image_ssim(image, image)
    with pytest.raises(ValueError, match="target: expected a positive, finite peak, got 0"):
        image_ssim(image, 0 * image, window=3)
    with pytest.raises(ValueError, match="peak: expected a positive, finite peak, got -1"):
        image_ssim(image, image, window=3, peak=-1.0)


def test_everything_public_is_tested_here():
    assert set(losses.__all__) <= set(globals())
