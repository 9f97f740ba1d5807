import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import sph_harm_y

from difflpv.sh import L_MAX_LIMIT, coeff_count, cosine_lobe, degree_of_count, lobe_factors, sh_basis


def random_directions(count, seed=0):
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def quadrature(polar=24, azimuth=48):
    """Directions and weights [sr] that integrate polynomials up to degree 47 exactly over the sphere."""
    z, w = np.polynomial.legendre.leggauss(polar)
    phi = 2 * np.pi * np.arange(azimuth) / azimuth
    r = np.sqrt(1 - z**2)
    d = np.stack([r[:, None] * np.cos(phi), r[:, None] * np.sin(phi), np.repeat(z[:, None], azimuth, 1)], -1)
    return d.reshape(-1, 3), np.repeat(w * 2 * np.pi / azimuth, azimuth)


def test_agrees_with_scipy_up_to_the_condon_shortley_phase():
    d = random_directions(200)
    theta, phi = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    for degree in range(L_MAX_LIMIT + 1):
        for m in range(-degree, degree + 1):
            complex_value = sph_harm_y(degree, abs(m), theta, phi)
            part = complex_value.imag if m < 0 else complex_value.real
            expected = part * (1 if m == 0 else math.sqrt(2) * (-1) ** m)  # scipy carries (-1)^m
            found = sh_basis(d, L_MAX_LIMIT)[:, degree * (degree + 1) + m]
            np.testing.assert_allclose(found, expected, atol=1e-12, err_msg=f"l {degree}, m {m}")


def test_signs_by_hand():
    n = 0.5 / math.sqrt(math.pi)
    np.testing.assert_allclose(sh_basis(np.array([1.0, 0, 0]), 1), [n, 0, 0, n * math.sqrt(3)])
    np.testing.assert_allclose(sh_basis(np.array([0, 1.0, 0]), 1), [n, n * math.sqrt(3), 0, 0])
    np.testing.assert_allclose(sh_basis(np.array([0, 0, 1.0]), 1), [n, 0, n * math.sqrt(3), 0])


def test_orthonormal_by_quadrature():
    d, w = quadrature()
    basis = sh_basis(d, L_MAX_LIMIT)
    np.testing.assert_allclose(basis.T @ (w[:, None] * basis), np.eye(16), atol=1e-12)


unit = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: math.hypot(*v) > 0.1)


@settings(deadline=None)
@given(unit, unit)
def test_addition_theorem(a, b):
    a, b = np.array(a) / math.hypot(*a), np.array(b) / math.hypot(*b)
    legendre = [1, a @ b, (3 * (a @ b) ** 2 - 1) / 2, (5 * (a @ b) ** 3 - 3 * (a @ b)) / 2]
    products = sh_basis(a, 3) * sh_basis(b, 3)
    for degree in range(4):
        total = products[degree**2 : (degree + 1) ** 2].sum()
        assert total == pytest.approx((2 * degree + 1) / (4 * math.pi) * legendre[degree], abs=1e-12)


@pytest.mark.parametrize("l_max", range(4))
def test_cosine_lobe_is_the_projection_of_the_clamped_cosine(l_max):
    n = random_directions(1, seed=3)[0]
    # Integrate over the hemisphere about n, so that the kink at the horizon does not disturb the quadrature.
    mu, w = np.polynomial.legendre.leggauss(24)
    mu, w = (mu + 1) / 2, w / 2
    phi = 2 * np.pi * np.arange(48) / 48
    s = np.cross(n, [0, 0, 1.0])
    s /= np.linalg.norm(s)
    t = np.cross(n, s)
    r = np.sqrt(1 - mu**2)[:, None]
    d = mu[:, None, None] * n + (r * np.cos(phi))[..., None] * s + (r * np.sin(phi))[..., None] * t
    weight = (w * mu)[:, None] * np.full(48, 2 * np.pi / 48)
    projected = np.einsum("ij,ijk->k", weight, sh_basis(d, l_max))
    np.testing.assert_allclose(cosine_lobe(n, l_max), projected, atol=1e-12)


def test_cosine_lobe_integrates_to_pi():
    d, w = quadrature()
    for n in random_directions(5):
        lobe = sh_basis(d, 2) @ cosine_lobe(n, 2)
        assert (w * lobe).sum() == pytest.approx(math.pi, rel=1e-12)
    np.testing.assert_allclose(lobe_factors(3)[[0, 1, 4, 9]], [math.pi, 2 * math.pi / 3, math.pi / 4, 0])


def test_irradiance_of_uniform_radiance_is_pi_times_it():
    radiance = np.zeros(9)
    radiance[0] = 2.0 * math.sqrt(4 * math.pi)  # L = 2 W/(m2 sr) from everywhere
    for n in random_directions(4):
        assert cosine_lobe(n, 2) @ radiance == pytest.approx(2 * math.pi)


@pytest.mark.parametrize("l_max", range(4))
@pytest.mark.parametrize("shape", [(), (0,), (5,), (2, 3)])
def test_torch_agrees_with_numpy(l_max, shape):
    d = random_directions(max(1, math.prod(shape))).reshape(-1, 3)[: math.prod(shape)].reshape(*shape, 3)
    for dtype in (torch.float32, torch.float64):
        found = cosine_lobe(torch.tensor(d, dtype=dtype), l_max)
        assert found.dtype == dtype and found.shape == (*shape, (l_max + 1) ** 2)
        np.testing.assert_allclose(found.numpy(), cosine_lobe(d, l_max), rtol=1e-5, atol=1e-6)
    assert sh_basis(d.astype(np.float32), l_max).dtype == np.float32


def test_torch_gradient():
    d = torch.tensor(random_directions(3), requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: sh_basis(x, 3), (d,))


def test_counts_and_errors():
    assert [coeff_count(l_max) for l_max in range(4)] == [1, 4, 9, 16]
    assert [degree_of_count(count) for count in (1, 4, 9, 16)] == [0, 1, 2, 3]
    for bad in (-1, 4):
        with pytest.raises(ValueError, match=rf"l_max: expected an integer in 0\.\.3, got {bad}"):
            sh_basis(np.zeros(3), bad)
    for bad in (0, 2, 8, 25):
        with pytest.raises(ValueError, match=f"expected 1, 4, 9 or 16, got {bad}"):
            degree_of_count(bad)
    with pytest.raises(ValueError, match=r"directions: expected shape \[\.\.\., 3\], got \(4,\)"):
        sh_basis(np.zeros(4), 1)
