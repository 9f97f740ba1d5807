"""Error against the number of probes: what a chart must show, seen in its pixels."""

import io

import numpy as np
import pytest
from PIL import Image

from difflpv.report.probe_charts import draw_curves

FALLING = {16: [(16, 0.5), (15, 0.45)], 64: [(61, 0.3), (64, 0.32)], 256: [(256, 0.2)]}
FLAT = {16: [(16, 0.5)], 64: [(64, 0.5)]}


def pixels(panels, **options):
    png = draw_curves(panels, quantity="error", **options)
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def reddest_rows(image, left, right):
    """Heights of pixels in the colour of our first line, vermilion."""
    near = np.abs(image[:, left:right] - [0xD5, 0x5E, 0x00]).sum(2) < 40
    return np.flatnonzero(near.any(1))


def test_our_line_falls_where_the_error_does_and_panels_stand_side_by_side():
    one = pixels({"a": {"ours": FALLING, "grid": FLAT}}, ours=["ours"])
    two = pixels({"a": {"ours": FALLING, "grid": FLAT}, "b": {"grid": FLAT}}, ours=["ours"])
    assert two.shape[1] == pytest.approx(2 * one.shape[1], abs=2)
    width = one.shape[1]
    plot = one[: int(0.7 * len(one))]
    left, right = reddest_rows(plot, 0, width // 2), reddest_rows(plot, width // 2, width)
    assert len(left) and len(right) and right.max() > left.max() + 20  # rows count downwards


def test_nothing_to_draw_and_zeros_are_named():
    with pytest.raises(ValueError, match="at least one scene"):
        draw_curves({}, quantity="error")
    for curves in ({}, {"grid": {16: [(16, 0.0)]}}):
        with pytest.raises(ValueError, match="curves of a: expected at least one, and numbers above 0"):
            draw_curves({"a": curves}, quantity="error")
