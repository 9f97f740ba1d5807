import numpy as np
import pytest
from PIL import Image

from difflpv.io.png import auto_exposure, tone_map, write_png
from difflpv.io.srgb import linear_to_srgb, srgb_to_linear


def test_srgb_is_its_own_inverse_and_has_the_standard_values():
    codes = np.arange(256) / 255
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(codes)), codes, atol=1e-12)
    # IEC 61966-2-1: middle grey of 21.4 % reflectance has code 127.5; slope 12.92 at black.
    np.testing.assert_allclose(srgb_to_linear(np.array([0.0, 0.5, 1.0])), [0, 0.21404114, 1], atol=1e-8)
    np.testing.assert_allclose(linear_to_srgb(np.array([-1.0, 0.001, 2.0])), [0, 0.01292, 1])


def test_preview(tmp_path):
    rgb = np.zeros((2, 3, 3))
    rgb[0, 1] = [0.2158605, 1.0, 8.0]  # code 128 is 0.2158605
    write_png(tmp_path / "a.png", rgb, exposure=0.0)
    pixels = np.asarray(Image.open(tmp_path / "a.png"))
    assert pixels.shape == (2, 3, 3)
    np.testing.assert_array_equal(pixels[0, 1], [128, 255, 255])
    assert not pixels[1].any()
    np.testing.assert_array_equal(tone_map(rgb / 4, exposure=2.0), tone_map(rgb))


def test_auto_exposure():
    assert auto_exposure(np.full((4, 4, 3), 0.25)) == pytest.approx(2.0)
    assert auto_exposure(np.zeros((4, 4, 3))) == 0.0


@pytest.mark.parametrize(
    ("rgb", "exposure", "expected"),
    [
        (np.zeros((2, 2)), 0.0, r"rgb: expected shape \[H, W, 3\], got \[2, 2\]"),
        (np.full((2, 2, 3), np.nan), 0.0, "rgb: expected finite values, got 12"),
        (np.zeros((2, 2, 3)), np.inf, "exposure: expected stops"),
    ],
)
def test_errors(rgb, exposure, expected):
    with pytest.raises(ValueError, match=expected):
        tone_map(rgb, exposure=exposure)
