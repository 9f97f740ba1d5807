import numpy as np
import pytest

from difflpv.config import LpvConfig
from difflpv.leakage import blocked_share, leak, self_lighting


def test_leak_is_the_error_in_the_dark_over_the_light():
    target = np.array([[2.0, 2, 2], [4, 4, 4], [0, 0, 0], [0.2, 0.2, 0.2]])
    prediction = target + np.array([[9.0], [9], [0.3], [-0.1]])
    dark = np.array([False, False, True, True])
    assert leak(prediction, target, dark) == pytest.approx(0.2 / 3)
    assert leak(prediction, target, dark, np.array([1.0, 0, 1, 0])) == pytest.approx(0.15)
    with pytest.raises(ValueError, match="dark: expected receivers in the dark and in the light"):
        leak(prediction, target, np.zeros(4, bool))


@pytest.mark.parametrize("thickness", [1.0, 0.5, 0.1])
def test_a_closed_wall_stops_traced_light_and_nothing_else_does(thickness):
    config = LpvConfig(method="lpv", occlusion="traced", steps=12)
    assert blocked_share(config, thickness=thickness) == 0
    assert blocked_share(LpvConfig(method="lpv", steps=12), thickness=thickness) == pytest.approx(1, abs=0.02)
    assert 0 < blocked_share(LpvConfig(method="lpv", occlusion="exp", steps=12), thickness=thickness) < 0.5


def test_a_lone_plane_lights_itself_in_the_published_kernel():
    """The first step alone sends a share of the plane's light back onto it."""
    lit = self_lighting(LpvConfig(method="holpv", steps=12))
    assert 0.2 < lit < 1
    assert self_lighting(LpvConfig(method="holpv", steps=12, lookup="damped")) < lit
