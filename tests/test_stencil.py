import itertools
import math

import numpy as np
import pytest

from difflpv.sh import cosine_lobe, sh_basis
from difflpv.stencil import FaceStencil, LinearStencil, holpv_stencil, lpv_stencil, square_solid_angle


def monte_carlo_solid_angle(center: np.ndarray, axis: int, count: int = 400_000) -> tuple[float, float]:
    rng = np.random.default_rng(1)
    points = np.tile(center.astype(float), (count, 1))
    for i in range(3):
        if i != axis:
            points[:, i] += rng.random(count) - 0.5
    values = np.abs(points[:, axis]) / np.linalg.norm(points, axis=1) ** 3
    return float(values.mean()), float(values.std() / math.sqrt(count))


@pytest.mark.parametrize("center, axis", [((1.5, 0, 0), 0), ((1, 0.5, 0), 1), ((1.5, 1, 0), 0), ((1.5, 1, 1), 0)])
def test_solid_angle_is_the_integral_over_the_face(center, axis):
    mean, error = monte_carlo_solid_angle(np.array(center, float), axis)
    assert abs(square_solid_angle(np.array(center, float), axis) - mean) < 4 * error


def test_faces_and_solid_angles_of_the_publications():
    lpv, holpv = lpv_stencil(), holpv_stencil()
    assert len(lpv.offsets) == 30 and len(holpv.offsets) == 54
    assert sorted(set(lpv.solid_angles.round(10))) == [0.4006696846, 0.4234313544]
    assert sorted(set(holpv.solid_angles.round(7))) == [0.1727394, 0.2506920, 0.4006697]
    assert lpv.solid_angles.sum() == pytest.approx(4 * math.pi, rel=1e-14)
    assert holpv.solid_angles.sum() == pytest.approx(4 * math.pi, rel=1e-14)
    one_neighbour = (lpv.offsets == [1, 0, 0]).all(1)
    assert lpv.solid_angles[one_neighbour].sum() == pytest.approx(2 * math.pi / 3, rel=1e-14)


@pytest.mark.parametrize("make, l_max", list(itertools.product((lpv_stencil, holpv_stencil), (1, 2, 3))))
def test_energy_normalisation_keeps_an_isotropic_field(make, l_max):
    gain = make(l_max=l_max).linear_part.uniform_gain()
    assert gain[0, 0] == pytest.approx(1, abs=1e-14)
    thesis = make(l_max=l_max, normalization="thesis").linear_part.uniform_gain()
    np.testing.assert_allclose(thesis, gain / 4, atol=1e-15)


def test_lpv_gains_of_the_uniform_field():
    gain = lpv_stencil(l_max=2).linear_part.uniform_gain()
    np.testing.assert_allclose(np.diag(gain)[:4], [1, 0.368643, 0.368643, 0.368643], atol=5e-7)
    np.testing.assert_allclose(np.sort(np.diag(gain)[4:]), [0, 0, 0, 0.018479, 0.018479], atol=5e-7)


def clamped_gain(stencil: FaceStencil, directions: np.ndarray) -> np.ndarray:
    lobe = cosine_lobe(directions, stencil.l_max)
    np.testing.assert_allclose((lobe @ stencil.flux_weights.T).sum(1), math.pi, rtol=0.02)
    return np.maximum(lobe @ stencil.flux_weights.T, 0).sum(1) / math.pi


@pytest.mark.parametrize("l_max, expected", [(1, 1.138), (2, 1.0195)])
def test_the_clamp_adds_flux_to_a_fresh_lobe_along_an_axis(l_max, expected):
    """physics.md: +13.8 % with 2 bands, +1.95 % with 3, for the 30-face stencil and a lobe along a grid axis."""
    assert clamped_gain(lpv_stencil(l_max=l_max), np.eye(3)) == pytest.approx(expected, abs=5e-4)


@pytest.mark.parametrize("make", [lpv_stencil, holpv_stencil])
def test_the_clamp_adds_flux_over_all_directions(make):
    """The truncated lobe's positive part integrates to 9/8 pi with 2 bands; 30 and 54 faces sample it to 2e-3 on average."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert clamped_gain(make(l_max=1), directions).mean() == pytest.approx(9 / 8, abs=2e-3)
    cosine = np.linspace(-1, 1, 200_001)
    lobe = 1 / 4 + cosine / 2 + 5 / 32 * (3 * cosine**2 - 1)
    assert clamped_gain(make(l_max=2), directions).mean() == pytest.approx(4 * np.maximum(lobe, 0).mean(), abs=2e-3)


def test_ray_reprojection_turns_the_lobe():
    rays = holpv_stencil(reprojection="ray")
    np.testing.assert_allclose(rays.lobe_axes, rays.directions)
    assert rays.linear_part.uniform_gain()[0, 0] == pytest.approx(1)


def test_linear_part_commutes_with_the_cube_rotation_about_z():
    """Turning offsets and coefficients by 90 degrees leaves the stencil as it is."""
    linear = holpv_stencil().linear_part
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(60, 3))
    samples /= np.linalg.norm(samples, axis=1, keepdims=True)
    rotation = np.linalg.lstsq(sh_basis(samples, 2), sh_basis(samples @ turn, 2), rcond=None)[0].T
    where = {tuple(o): i for i, o in enumerate(linear.offsets.tolist())}
    for offset, matrix in zip(linear.offsets, linear.matrices, strict=True):
        turned = linear.matrices[where[tuple((turn @ offset).tolist())]]
        np.testing.assert_allclose(turned, rotation.T @ matrix @ rotation, atol=1e-12)


def test_messages():
    with pytest.raises(ValueError, match="normalization: expected 'energy' or 'thesis', got 'x'"):
        lpv_stencil(normalization="x")
    with pytest.raises(ValueError, match="reprojection: expected 'face' or 'ray', got 'x'"):
        lpv_stencil(reprojection="x")
    with pytest.raises(ValueError, match="l_max: expected an integer in 0..3, got 4"):
        holpv_stencil(l_max=4)
    with pytest.raises(ValueError, match=r"matrices: expected shape \[1, K, K\], got \[2, 4, 4\]"):
        LinearStencil("x", np.zeros((1, 3), int), np.zeros((2, 4, 4)))
    with pytest.raises(ValueError, match="matrices: expected finite numbers"):
        LinearStencil("x", np.zeros((1, 3), int), np.full((1, 4, 4), np.nan))
    with pytest.raises(ValueError, match="offsets: expected distinct offsets"):
        LinearStencil("x", np.zeros((2, 3), int), np.zeros((2, 4, 4)))
    with pytest.raises(ValueError, match="offsets: expected shape .* in antipodal pairs"):
        s = lpv_stencil()
        FaceStencil("x", 1, s.offsets[1:], s.directions[1:], s.solid_angles[1:], s.lobe_axes[1:])
