import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from difflpv import sampling
from difflpv.grid import Grid
from difflpv.reference import sampling as twin
from difflpv.sampling import sample_coeffs, sample_irradiance
from difflpv.sh import sh_basis

GRID = Grid((-1.0, 0.5, 2.0), 0.3, (5, 4, 6))


def random_volume(generator, dtype, l_max=2, channels=3):
    return torch.rand(channels, (l_max + 1) ** 2, *GRID.shape, generator=generator, dtype=dtype)


def random_receivers(generator, dtype, count=40, *, margin=1.2):
    """Receivers in the grid's box grown by ``margin`` cells on every side."""
    size = torch.tensor(GRID.resolution, dtype=dtype) + 2 * margin
    low = torch.tensor(GRID.minimum, dtype=dtype) - margin * GRID.cell_size
    positions = low + torch.rand(count, 3, generator=generator, dtype=dtype) * size * GRID.cell_size
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=dtype), dim=1)
    return positions, normals


@pytest.mark.parametrize("l_max", [0, 1, 2, 3])
@pytest.mark.parametrize("channels", [1, 3, 6])
def test_irradiance_equals_twin(generator, dtype, relative_tolerance, l_max, channels):
    volume = random_volume(generator, dtype, l_max, channels)
    positions, normals = random_receivers(generator, dtype)
    result = sample_irradiance(volume, positions, normals, GRID, bias=0.7)
    expected = twin.sample_irradiance(volume, positions, normals, GRID.minimum, GRID.cell_size, bias=0.7)
    assert result.shape == (40, channels)
    torch.testing.assert_close(result, expected, rtol=0, atol=relative_tolerance(dtype) * float(expected.abs().max()))


@pytest.mark.parametrize("l_max", [1, 2, 3])
def test_coeffs_equal_twin(generator, dtype, relative_tolerance, l_max):
    volume = random_volume(generator, dtype, l_max)
    points, _ = random_receivers(generator, dtype)
    result = sample_coeffs(volume, points, GRID)
    expected = twin.sample_coeffs(volume, points, GRID.minimum, GRID.cell_size)
    assert result.shape == (40, 3, (l_max + 1) ** 2)
    torch.testing.assert_close(result, expected, rtol=0, atol=relative_tolerance(dtype))


def test_gradients_equal_twin(generator):
    volume = random_volume(generator, torch.float64, 3).requires_grad_()
    positions, normals = (t.requires_grad_() for t in random_receivers(generator, torch.float64))
    bias = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    box = (GRID.minimum, GRID.cell_size)
    pairs = [
        (
            sample_irradiance(volume, positions, normals, GRID, bias=bias),
            twin.sample_irradiance(volume, positions, normals, *box, bias=bias),
            (volume, positions, normals, bias),
        ),
        (sample_coeffs(volume, positions, GRID), twin.sample_coeffs(volume, positions, *box), (volume, positions)),
    ]
    for ours, theirs, inputs in pairs:
        cotangent = torch.randn(ours.shape, generator=generator, dtype=torch.float64)
        for a, b in zip(
            torch.autograd.grad(ours, inputs, cotangent), torch.autograd.grad(theirs, inputs, cotangent), strict=True
        ):
            torch.testing.assert_close(a, b, rtol=1e-11, atol=1e-11)


def test_uniform_isotropic_volume(generator, dtype):
    # I(w) = I everywhere: radiance I / h^2 from all sides, so E = pi I / h^2 wherever the receiver is.
    intensity = torch.tensor([0.5, 1.0, 2.0], dtype=dtype)
    volume = torch.zeros(3, 9, *GRID.shape, dtype=dtype)
    volume[:, 0] = (intensity * 2 * math.sqrt(math.pi))[:, None, None, None]
    positions, normals = random_receivers(generator, dtype)
    result = sample_irradiance(volume, positions, normals, GRID)
    expected = (math.pi * intensity / GRID.cell_size**2).expand(40, 3)
    torch.testing.assert_close(result, expected, rtol=1e-5, atol=0)


def test_directional_volume_is_received_by_the_facing_side():
    # Light travelling along +z, I(w) = delta about w: coefficients Y(w). E = 1/h^2 lobe(-n)(w), which is 17/16 (l_max 2)
    # of cos for a receiver that faces it and 1/16 for one that looks away: the sign of n is pinned here.
    direction = np.array([[0.0, 0.0, 1.0]])
    volume = torch.from_numpy(sh_basis(direction, 2))[0][None, :, None, None, None].expand(1, 9, *GRID.shape)
    positions = torch.zeros(2, 3, dtype=torch.float64)
    normals = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    result = sample_irradiance(volume, positions, normals, GRID) * GRID.cell_size**2
    torch.testing.assert_close(result[:, 0], torch.tensor([17 / 16, 1 / 16], dtype=torch.float64), rtol=1e-12, atol=0)


def test_linear_field_is_reproduced(generator, dtype):
    # Trilinear interpolation is exact for a + b.x between the outermost cell centres.
    slope = torch.tensor([0.3, -0.7, 1.1], dtype=dtype)
    centres = torch.from_numpy(GRID.cell_centers()).to(dtype)
    volume = (2 + centres @ slope)[None, None].expand(2, 4, *GRID.shape)
    points, _ = random_receivers(generator, dtype, margin=-0.5)
    expected = (2 + points @ slope)[:, None, None].expand(-1, 2, 4)
    torch.testing.assert_close(sample_coeffs(volume, points, GRID), expected, rtol=1e-5, atol=1e-5)


def test_outside_and_boundary_points_read_the_nearest_edge_cell(generator, dtype):
    volume = random_volume(generator, dtype)
    low, high = (torch.tensor(v, dtype=dtype) for v in (GRID.minimum, GRID.maximum))
    points = torch.stack([low, low - 0.2, low - 1e12, high, high + 0.2, high + 1e12])
    first, last = volume[:, :, 0, 0, 0], volume[:, :, -1, -1, -1]
    expected = torch.stack([first] * 3 + [last] * 3)
    torch.testing.assert_close(sample_coeffs(volume, points, GRID), expected, rtol=1e-5, atol=1e-5)


def test_point_on_a_cell_boundary_is_the_mean_of_both_cells(generator):
    grid = Grid((0.0, 0.0, 0.0), 1.0, (4, 4, 4))
    volume = torch.rand(1, 4, 4, 4, 4, generator=generator)
    result = sample_coeffs(volume, torch.tensor([[2.0, 1.5, 0.5]]), grid)
    torch.testing.assert_close(result[0], (volume[:, :, 0, 1, 1] + volume[:, :, 0, 1, 2]) / 2)


@settings(max_examples=30, deadline=None)
@given(a=st.floats(-3, 3), b=st.floats(-3, 3), seed=st.integers(0, 1000))
def test_irradiance_is_linear_in_the_volume(a, b, seed):
    generator = torch.Generator().manual_seed(seed)
    first, second = (random_volume(generator, torch.float64) for _ in range(2))
    receivers = random_receivers(generator, torch.float64, count=7)
    separate = a * sample_irradiance(first, *receivers, GRID) + b * sample_irradiance(second, *receivers, GRID)
    together = sample_irradiance(a * first + b * second, *receivers, GRID)
    torch.testing.assert_close(together, separate, rtol=1e-12, atol=1e-9)


def test_volume_gradient_is_the_adjoint(generator, dtype):
    # <E(V), Ebar> = <V, Vbar>: the scatter is the transpose of the lookup.
    volume = random_volume(generator, dtype).requires_grad_()
    result = sample_irradiance(volume, *random_receivers(generator, dtype), GRID)
    cotangent = torch.randn(result.shape, generator=generator, dtype=dtype)
    (bar,) = torch.autograd.grad(result, volume, cotangent)
    left, right = float((result * cotangent).sum().detach()), float((volume * bar).sum().detach())
    assert left == pytest.approx(right, rel=1e-4 if dtype == torch.float32 else 1e-12)


def test_empty_input(dtype):
    volume = torch.ones(3, 4, *GRID.shape, dtype=dtype, requires_grad=True)
    nothing = torch.zeros(0, 3, dtype=dtype, requires_grad=True)
    irradiance, coeffs = sample_irradiance(volume, nothing, nothing, GRID), sample_coeffs(volume, nothing, GRID)
    assert irradiance.shape == (0, 3)
    assert coeffs.shape == (0, 3, 4)
    (irradiance.sum() + coeffs.sum()).backward()
    assert not volume.grad.any()
    assert nothing.grad.shape == (0, 3)


def test_non_contiguous_input(generator, dtype):
    volume = random_volume(generator, dtype)
    positions, normals = random_receivers(generator, dtype)
    strided = volume.permute(2, 3, 4, 0, 1).contiguous().permute(3, 4, 0, 1, 2)
    columns = [t.t().contiguous().t() for t in (positions, normals)]
    assert not strided.is_contiguous()
    assert torch.equal(sample_irradiance(volume, positions, normals, GRID), sample_irradiance(strided, *columns, GRID))
    assert torch.equal(sample_coeffs(volume, positions, GRID), sample_coeffs(strided, columns[0], GRID))


SMALL = Grid((0.0, 0.0, 0.0), 0.5, (2, 3, 2))


def small_case(generator):
    volume = torch.rand(2, 9, *SMALL.shape, generator=generator, dtype=torch.float64)
    positions = torch.rand(4, 3, generator=generator, dtype=torch.float64)
    normals = torch.nn.functional.normalize(torch.randn(4, 3, generator=generator, dtype=torch.float64), dim=1)
    return volume, positions, normals


def test_promises_of_irradiance(generator, check_op):
    def irradiance(volume, positions, normals, bias):
        return sample_irradiance(volume, positions, normals, SMALL, bias=bias)

    check_op(irradiance, [*small_case(generator), torch.tensor(0.1)])


def test_promises_of_coeffs(generator, check_op):
    check_op(lambda volume, points: sample_coeffs(volume, points, SMALL), small_case(generator)[:2])


def test_opcheck(generator, dtype):
    volume, positions, normals = (t.to(dtype).requires_grad_() for t in small_case(generator))
    torch.library.opcheck(sampling._irradiance, (volume, positions, normals, 4.0))
    torch.library.opcheck(sampling._coeffs, (volume, positions))
    detached = [t.detach() for t in (volume, positions, normals)]
    bar = torch.rand(4, 2, generator=generator, dtype=dtype)
    torch.library.opcheck(sampling._irradiance_volume_adjoint, (bar, *detached, 4.0))
    torch.library.opcheck(sampling._irradiance_point_adjoint, (bar, *detached, 4.0))
    bar = torch.rand(4, 2, 9, generator=generator, dtype=dtype)
    torch.library.opcheck(sampling._coeffs_volume_adjoint, (bar, *detached[:2]))
    torch.library.opcheck(sampling._coeffs_point_adjoint, (bar, *detached[:2]))


V = torch.zeros(3, 4, *GRID.shape)
X = torch.zeros(3, 3)
NAN = torch.tensor([[0.0, 0, 0], [0, math.nan, 0], [0, 0, 0]])


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: sample_irradiance(V, X, X, None), TypeError, "grid: expected difflpv.grid.Grid, got NoneType"),
        (lambda: sample_irradiance([1], X, X, GRID), TypeError, "volume: expected a torch.Tensor, got list"),
        (
            lambda: sample_irradiance(V[:, :3], X, X, GRID),
            ValueError,
            r"volume: expected shape \[C, 1\|4\|9\|16, 6, 4, 5\], got \[3, 3, 6, 4, 5\]",
        ),
        (
            lambda: sample_irradiance(V.transpose(2, 4), X, X, GRID),
            ValueError,
            r"volume: expected shape \[C, 1\|4\|9\|16, 6, 4, 5\], got \[3, 4, 5, 4, 6\]",
        ),
        (lambda: sample_irradiance(V, X.double(), X, GRID), TypeError, "positions: expected torch.float32 on cpu, got"),
        (
            lambda: sample_irradiance(V, X[:, :2], X, GRID),
            ValueError,
            r"positions: expected shape \[n, 3\], got \[3, 2\]",
        ),
        (lambda: sample_irradiance(V, X, X[:2], GRID), ValueError, r"normals: expected shape \[3, 3\], got \[2, 3\]"),
        (lambda: sample_irradiance(V, NAN, X, GRID), ValueError, r"positions: expected finite .* nan, 0.0\] in row 1"),
        (lambda: sample_irradiance(V, X, NAN, GRID), ValueError, "normals: expected finite numbers, got"),
        (
            lambda: sample_irradiance(V, X, X, GRID, bias=math.inf),
            ValueError,
            "bias: expected a finite number, got inf",
        ),
        (lambda: sample_irradiance(V, X, X, GRID, bias=True), TypeError, "bias: expected a number or .* got bool"),
        (lambda: sample_coeffs(V, NAN, GRID), ValueError, "points: expected finite numbers"),
        (lambda: sample_coeffs(V, X[0], GRID), ValueError, r"points: expected shape \[n, 3\], got \[3\]"),
        (lambda: sample_coeffs(V, X, 32), TypeError, "grid: expected difflpv.grid.Grid, got int"),
        (lambda: sample_coeffs(V.half(), X, GRID), TypeError, "volume: expected dtype torch.float32 or torch.float64"),
    ],
)
def test_errors(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_nan_position_inside_a_compiled_graph_gives_nan(dtype):
    # torch.compile skips the check above; NaN must come out, not a plausible number.
    torch._dynamo.reset()
    compiled = torch.compile(lambda x: sample_coeffs(V.to(dtype), x, GRID), fullgraph=True, backend="aot_eager")
    result = compiled(NAN.to(dtype))
    assert torch.isnan(result[1]).all()
    assert torch.isfinite(result[[0, 2]]).all()


@pytest.mark.gpu
def test_cuda_equals_cpu(cuda, generator, dtype, relative_tolerance):
    inputs = (random_volume(generator, dtype), *random_receivers(generator, dtype, count=1000))
    results = []
    for device in (torch.device("cpu"), cuda):
        volume, positions, normals = (t.to(device).requires_grad_() for t in inputs)
        irradiance = sample_irradiance(volume, positions, normals, GRID)
        coeffs = sample_coeffs(volume, positions, GRID)
        total = irradiance.square().sum() + coeffs.square().sum()
        gradients = torch.autograd.grad(total, (volume, positions, normals))
        results.append([t.detach().cpu() for t in (irradiance, coeffs, *gradients)])
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=10 * relative_tolerance(dtype) * float(a.abs().max()))
