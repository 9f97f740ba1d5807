import pytest
import torch

from difflpv.damping import damped_irradiance
from difflpv.grid import Grid
from difflpv.sampling import sample_irradiance

GRID = Grid((0.0, 0, 0), 0.5, (6, 6, 6))
X = torch.tensor([[1.3, 1.41, 1.6], [1.13, 1.72, 1.27]], dtype=torch.float64)
N = torch.tensor([[0.0, 1, 0], [0.6, 0, 0.8]], dtype=torch.float64)


def field(seed=0):
    return torch.randn(3, 9, *GRID.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_a_uniform_field_is_not_damped():
    uniform = field()[:, :, :1, :1, :1].expand(3, 9, *GRID.shape).contiguous()
    torch.testing.assert_close(damped_irradiance(uniform, X, N, GRID), sample_irradiance(uniform, X, N, GRID))


def test_a_field_that_grows_towards_the_surface_is_damped_and_one_that_grows_away_is_not():
    """c at the point, g = -c / 4 or + c / 4 per half cell on either side: d = 1 - |g| / |c| or 1."""
    height = (torch.arange(6, dtype=torch.float64) + 0.5)[None, :, None]
    for slope, expected in ((-0.1, None), (0.1, 1.0)):
        profile = 1 + slope * (height - 3)
        volume = (field()[:, :, :1, :1, :1] * profile).expand(3, 9, *GRID.shape).contiguous()
        ratio = damped_irradiance(volume, X[:1], N[:1], GRID) / sample_irradiance(volume, X[:1], N[:1], GRID)
        value = 1 + slope * (float(X[0, 1]) / 0.5 + 0.5 - 3)
        torch.testing.assert_close(ratio, torch.full_like(ratio, expected or 1 + slope / value))


def test_darkness_stays_dark_and_finite():
    assert not damped_irradiance(torch.zeros(3, 9, *GRID.shape, dtype=torch.float64), X, N, GRID).any()


def test_gradients():
    volume, x, n = field().requires_grad_(), X.clone().requires_grad_(), N.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda v, p, q: damped_irradiance(v, p, q, GRID), (volume, x, n))


def test_messages():
    with pytest.raises(ValueError, match=r"normals: expected shape \[2, 3\], got \[1, 3\]"):
        damped_irradiance(field(), X, N[:1], GRID)
