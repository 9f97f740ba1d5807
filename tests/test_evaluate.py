import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from difflpv.evaluate import Score, format_scores, mean_score, predict_constant, score

NAMES = {"method": "m", "component": "bounce1", "light": 2}
TARGET = np.array([[1.0, 2, 3], [2, 1, 0], [4, 4, 4]])
WEIGHT = np.array([1.0, 3, 0])


def test_closed_forms():
    """Prediction 2 E*: error 1, zero at the best scale 1/2; the third receiver has no weight."""
    prediction = 2 * TARGET
    prediction[2] = 1e6
    got = score(prediction, TARGET, WEIGHT, **NAMES)
    assert (got.relative_l2, got.scale) == (pytest.approx(1), pytest.approx(0.5))
    assert got.scaled_l2 == pytest.approx(0, abs=1e-12)
    assert got.mean_error == pytest.approx(1)
    assert (got.method, got.component, got.light) == ("m", "bounce1", 2)


def test_relative_l2_by_hand():
    prediction = TARGET + np.array([[1.0, 0, 0], [0, 2, 0], [0, 0, 0]])
    expected = np.sqrt((1 * 1 + 3 * 4) / (1 * 14 + 3 * 5))
    assert score(prediction, TARGET, WEIGHT, **NAMES).relative_l2 == pytest.approx(expected)
    mean = (1 * 6 + 3 * 3) / 4 / 3
    assert score(prediction, TARGET, WEIGHT, **NAMES).mean_error == pytest.approx((1 + 3 * 2) / 4 / 3 / mean)


def test_a_dark_prediction_scores_one():
    got = score(np.zeros((3, 3)), TARGET, WEIGHT, **NAMES)
    assert (got.relative_l2, got.scaled_l2, got.scale) == (1, 1, 1)


def test_not_finite():
    with pytest.raises(ValueError, match="prediction of 'm': expected finite irradiance"):
        score(np.full((3, 3), np.nan), TARGET, WEIGHT, **NAMES)


@given(st.lists(st.floats(-2, 2), min_size=3, max_size=3), st.integers(0, 9))
def test_no_constant_beats_the_weighted_mean(offset, seed):
    rng = np.random.default_rng(seed)
    target, weight = rng.random((20, 3)), rng.random(20)
    best = predict_constant(target, weight)
    assert best.shape == target.shape and np.ptp(best, axis=0).max() == 0
    other = best + np.array(offset)
    assert score(best, target, weight, **NAMES).relative_l2 <= score(other, target, weight, **NAMES).relative_l2 + 1e-12


def test_mean_over_lights_of_one_method_only():
    first = Score("m", "direct", 0, 1.0, 0.5, 2.0, 0.1, 0.2)
    second = Score("m", "direct", 1, 3.0, 0.7, 4.0, 0.3, 0.4)
    mean = mean_score([first, second])
    assert (mean.light, mean.relative_l2, mean.scale, mean.percentile_95) == (-1, 2.0, 3.0, pytest.approx(0.3))
    with pytest.raises(ValueError, match="expected one method and component"):
        mean_score([first, Score("n", "direct", 0, *(1.0,) * 5)])


def test_table():
    scores = [Score("holpv fitted", "direct", 3, *(0.25,) * 5), Score("m", "bounce1", -1, *(1.0,) * 5)]
    lines = format_scores(scores).splitlines()
    assert len(lines) == 3 and lines[0].startswith("method") and "0.250" in lines[1]
    assert lines[1].split()[:4] == ["holpv", "fitted", "direct", "3"] and lines[2].split()[:3] == ["m", "bounce1", "mean"]
    assert len({len(line) for line in lines}) == 1
