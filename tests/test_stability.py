import math

import numpy as np
import pytest
import torch

from difflpv.propagation import propagate
from difflpv.stability import TOLERANCE, negative_share, spectral_radius, stability, symbol
from difflpv.stencil import LinearStencil, holpv_stencil, lpv_stencil


def diffusion(rate: float) -> LinearStencil:
    """The 7-point heat equation: symbol 1 - 2 rate sum(1 - cos k_i), stable up to rate 1/6."""
    offsets = np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    return LinearStencil("heat", offsets, np.array([1 - 6 * rate] + [rate] * 6)[:, None, None])


@pytest.mark.parametrize(("rate", "radius"), [(0.05, 1.0), (1 / 6, 1.0), (0.2, 1.4), (0.25, 2.0)])
def test_radius_of_the_heat_equation(rate, radius):
    report = stability(diffusion(rate))
    assert report.radius == pytest.approx(radius, abs=1e-9)
    assert report.stable == (radius == 1.0)
    if radius > 1:
        np.testing.assert_allclose(np.abs(report.wave_vector), math.pi, atol=1e-6)


def test_symbol_of_the_heat_equation():
    k = np.random.default_rng(0).uniform(-math.pi, math.pi, (20, 3))
    np.testing.assert_allclose(symbol(diffusion(0.1), k)[:, 0, 0], 1 - 0.2 * (1 - np.cos(k)).sum(1), atol=1e-13)


def test_radius_between_the_samples_is_found():
    # A(k) = 0.5 + a (cos 2x-like bump off the lattice): compare with a dense one-dimensional scan.
    c, s = math.cos(0.37), math.sin(0.37)
    offsets = np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0]])
    rotation = np.array([[0, 0, 0, 0], [0, c, s, 0], [0, -s, c, 0], [0, 0, 0, 0]])
    stencil = LinearStencil("rotating", offsets, np.stack([0.3 * np.eye(4), 0.5 * rotation, 0.3 * rotation @ rotation]))
    k = np.zeros((200_001, 3))
    k[:, 0] = np.linspace(-math.pi, math.pi, len(k))
    dense = spectral_radius(stencil, k).max()
    assert stability(stencil).radius == pytest.approx(dense, abs=1e-7)


@pytest.mark.parametrize("stencil", [lpv_stencil(), holpv_stencil(), holpv_stencil(l_max=3)])
def test_published_kernels_are_stable_up_to_factor_one(stencil):
    report = stability(stencil)
    assert report.stable and report.uniform_gain == pytest.approx(1, abs=1e-12) and "is stable" in report.advice
    above = stability(stencil, factor=1.01)
    assert not above.stable and above.radius == pytest.approx(1.01, abs=1e-9)
    assert "unstable" in above.advice and "at most 1.000000" in above.advice


def test_thesis_normalization_has_critical_factor_four():
    stencil = holpv_stencil(normalization="thesis")
    assert stability(stencil, factor=4 - 1e-9).stable
    assert not stability(stencil, factor=4 + 1e-4).stable


def test_growth_of_a_propagated_wave_is_the_radius():
    # 24 cells hold the wave k = pi exactly; zero edges only take away.
    stencil, field = diffusion(0.2), torch.ones((1, 1, 24, 24, 24), dtype=torch.float64)
    sign = torch.tensor([(-1.0) ** i for i in range(24)], dtype=torch.float64)
    field = field * sign[:, None, None] * sign[:, None] * sign
    total = [propagate(field, stencil, steps=s)[0, 0, 12, 12, 12].item() for s in (3, 4, 5)]
    assert abs((total[2] - total[1]) / (total[1] - total[0])) == pytest.approx(stability(stencil).radius, rel=1e-9)


def test_radius_at_zero_counts_as_stable_within_rounding():
    assert stability(diffusion(0.1), factor=1 + TOLERANCE / 2).stable
    assert not stability(diffusion(0.1), factor=1 + 2 * TOLERANCE).stable


def test_negative_share_is_none_for_diffusion_and_some_for_waves():
    assert negative_share(diffusion(0.1)) == 0.0
    matrices = np.array(diffusion(0.1).matrices) * np.array([1.0] + [-1.0] * 6)[:, None, None]
    assert negative_share(LinearStencil("alternating", diffusion(0.1).offsets, matrices), steps=4) > 0.1
