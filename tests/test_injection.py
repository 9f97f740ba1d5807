import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from difflpv import injection
from difflpv.grid import Grid
from difflpv.injection import InjectionReport, deposit_lobes, inject
from difflpv.reference import injection as twin
from difflpv.sh import cosine_lobe
from difflpv.vpl import Vpls

GRID = Grid((-1.0, 0.5, 2.0), 0.3, (5, 4, 6))
DEPOSITS = ("nearest", "trilinear")


def random_vpls(generator, dtype, count=40, *, margin=0.0):
    """VPLs in the grid's box grown by ``margin`` cells on every side."""
    size = torch.tensor(GRID.resolution, dtype=dtype) + 2 * margin
    low = torch.tensor(GRID.minimum, dtype=dtype) - margin * GRID.cell_size
    position = low + torch.rand(count, 3, generator=generator, dtype=dtype) * size * GRID.cell_size
    normal = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=dtype), dim=1)
    return Vpls(position, normal, torch.rand(count, 3, generator=generator, dtype=dtype) + 0.1)


def total_flux(volume):
    """Integral over the sphere and sum over the cells [W]: int Y_00 = 2 sqrt(pi), the other degrees vanish."""
    return volume[:, 0].sum((1, 2, 3)) * 2 * math.sqrt(math.pi)


@pytest.mark.parametrize("deposit", DEPOSITS)
@pytest.mark.parametrize("l_max", [1, 2, 3])
def test_equals_twin(generator, dtype, relative_tolerance, deposit, l_max):
    vpls = random_vpls(generator, dtype, margin=0.7)
    volume, report = inject(vpls, GRID, l_max=l_max, deposit=deposit)
    fields = (vpls.position, vpls.normal, vpls.flux)
    expected = twin.inject(*fields, GRID.minimum, GRID.cell_size, GRID.resolution, l_max=l_max, deposit=deposit, bias=0.5)
    assert volume.shape == (3, (l_max + 1) ** 2, *GRID.shape)
    assert 0 < int(report.lost_count) < len(vpls)
    tolerance = relative_tolerance(dtype) * float(expected.abs().max())
    torch.testing.assert_close(volume, expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("deposit", DEPOSITS)
def test_gradients_equal_twin(generator, deposit):
    vpls = random_vpls(generator, torch.float64, margin=0.7)
    inputs = [t.requires_grad_() for t in (vpls.position, vpls.normal, vpls.flux)]
    bias = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
    volume, _ = inject(vpls, GRID, l_max=2, deposit=deposit, bias=bias)
    expected = twin.inject(*inputs, GRID.minimum, GRID.cell_size, GRID.resolution, l_max=2, deposit=deposit, bias=bias)
    cotangent = torch.randn(volume.shape, generator=generator, dtype=torch.float64)
    learnable = [*inputs, bias] if deposit == "trilinear" else inputs[1:]
    ours = torch.autograd.grad(volume, learnable, cotangent)
    theirs = torch.autograd.grad(expected, learnable, cotangent)
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


def test_nearest_has_no_gradient_of_position():
    position = torch.tensor([[-0.4, 1.0, 3.0]], requires_grad=True)
    flux = torch.ones(1, 3, requires_grad=True)
    inject(Vpls(position, torch.tensor([[0.0, 0.0, 1.0]]), flux), GRID, l_max=1)[0].sum().backward()
    assert position.grad is None
    assert flux.grad is not None


def test_single_vpl_closed_form(dtype):
    # Cell (2, 1, 3) holds the point half a cell above the VPL; its coefficients are (Phi / pi) A_l Y_lm(n).
    normal = torch.tensor([[0.0, 0.6, 0.8]], dtype=dtype)
    centre = torch.from_numpy(GRID.cell_centers()[3, 1, 2][None]).to(dtype)
    flux = torch.tensor([[1.0, 2.0, 3.0]], dtype=dtype)
    expected = torch.zeros(3, 9, *GRID.shape, dtype=dtype)
    expected[:, :, 3, 1, 2] = flux[0, :, None] / math.pi * cosine_lobe(normal, 2)
    for deposit in DEPOSITS:  # at a centre the trilinear deposit has one corner of weight 1
        vpls = Vpls(centre - 0.5 * GRID.cell_size * normal, normal, flux)
        volume, _ = inject(vpls, GRID, l_max=2, deposit=deposit)
        torch.testing.assert_close(volume, expected, rtol=1e-5, atol=1e-5)


def test_trilinear_splits_between_two_cells():
    centre = torch.from_numpy(GRID.cell_centers()[3, 1, 2][None]).float()
    position = centre + torch.tensor([[0.25 * GRID.cell_size, 0.0, 0.0]])
    vpls = Vpls(position, torch.tensor([[0.0, 0.0, 1.0]]), torch.ones(1, 3))
    volume, _ = inject(vpls, GRID, l_max=1, deposit="trilinear", bias=0.0)
    share = volume[0, 0] * 2 * math.sqrt(math.pi)
    assert float(share[3, 1, 2]) == pytest.approx(0.75, abs=1e-5)
    assert float(share[3, 1, 3]) == pytest.approx(0.25, abs=1e-5)


@pytest.mark.parametrize("deposit", DEPOSITS)
@settings(max_examples=30, deadline=None)
@given(share=hnp.arrays("float64", (7, 3), elements=st.floats(0, 1, exclude_max=True)), l_max=st.sampled_from([1, 2, 3]))
def test_flux_is_conserved_for_every_position_inside(deposit, share, l_max):
    size = torch.tensor(GRID.resolution, dtype=torch.float64)
    cells = (torch.from_numpy(share) * size).clamp(max=size - 1e-9)
    position = torch.tensor(GRID.minimum, dtype=torch.float64) + (cells + 1e-10) * GRID.cell_size
    normal = torch.nn.functional.normalize(torch.from_numpy(share) - 0.55, dim=1)
    flux = torch.from_numpy(share) + 0.5
    volume, report = inject(Vpls(position, normal, flux), GRID, l_max=l_max, deposit=deposit, bias=0.0)
    assert int(report.lost_count) == 0
    torch.testing.assert_close(total_flux(volume), flux.sum(0), rtol=1e-12, atol=0)


@pytest.mark.parametrize("deposit", DEPOSITS)
def test_report_counts_what_is_lost(dtype, deposit):
    low = torch.tensor(GRID.minimum, dtype=dtype)
    high = torch.tensor(GRID.maximum, dtype=dtype)
    inside = (low + high) / 2
    position = torch.stack([inside, low - 0.01, high + 0.01, inside])
    flux = torch.tensor([[1.0, 1, 1], [2, 0, 0], [0, 0, 4], [1, 1, 1]], dtype=dtype)
    normal = torch.tensor([[0.0, 0.0, 1.0]], dtype=dtype).expand(4, 3)
    volume, report = inject(Vpls(position, normal, flux), GRID, l_max=1, deposit=deposit, bias=0.0)
    assert isinstance(report, InjectionReport)
    assert int(report.lost_count) == 2
    assert float(report.lost_share) == pytest.approx(6 / 12)
    torch.testing.assert_close(total_flux(volume), torch.full((3,), 2.0, dtype=dtype))


def test_cell_boundary_belongs_to_the_upper_cell():
    grid = Grid((0.0, 0.0, 0.0), 1.0, (4, 4, 4))
    position = torch.tensor([[2.0, 0.0, 3.0], [4.0, 1.0, 1.0]])  # the second lies on the grid's upper face: outside
    vpls = Vpls(position, torch.tensor([[1.0, 0.0, 0.0]]).expand(2, 3), torch.ones(2, 3))
    volume, report = inject(vpls, grid, l_max=1, bias=0.0)
    assert volume[0, 0].nonzero().tolist() == [[3, 0, 2]]
    assert int(report.lost_count) == 1


@pytest.mark.parametrize("deposit", DEPOSITS)
def test_empty_input(dtype, deposit):
    nothing = torch.zeros(0, 3, dtype=dtype, requires_grad=True)
    volume, report = inject(Vpls(nothing, nothing, nothing), GRID, l_max=2, deposit=deposit)
    assert volume.shape == (3, 9, *GRID.shape)
    assert not volume.any()
    assert (int(report.lost_count), float(report.lost_share)) == (0, 0.0)
    volume.sum().backward()
    assert nothing.grad.shape == (0, 3)


@pytest.mark.parametrize("deposit", DEPOSITS)
def test_non_contiguous_input(generator, dtype, deposit):
    vpls = random_vpls(generator, dtype)
    strided = Vpls(*(t.t().contiguous().t() for t in (vpls.position, vpls.normal, vpls.flux)))
    assert not strided.position.is_contiguous()
    assert torch.equal(inject(vpls, GRID, l_max=2, deposit=deposit)[0], inject(strided, GRID, l_max=2, deposit=deposit)[0])


def test_promises_of_a_differentiable_op(generator, check_op):
    vpls = random_vpls(generator, torch.float64, count=4)

    def trilinear(position, normal, flux, bias):
        return inject(Vpls(position, normal, flux), GRID, l_max=2, deposit="trilinear", bias=bias)[0]

    check_op(trilinear, [vpls.position, vpls.normal, vpls.flux, torch.tensor(0.5)])


def test_promises_of_the_nearest_deposit(generator, check_op):
    vpls = random_vpls(generator, torch.float64, count=4)
    check_op(
        lambda normal, flux: inject(Vpls(vpls.position, normal, flux), GRID, l_max=2, bias=0.0)[0],
        [vpls.normal, vpls.flux],
    )


@pytest.mark.parametrize("trilinear", [False, True])
def test_opcheck(generator, dtype, trilinear):
    cells = torch.rand(5, 3, generator=generator, dtype=dtype) * 3
    normal = torch.nn.functional.normalize(torch.randn(5, 3, generator=generator, dtype=dtype), dim=1)
    amplitude = torch.rand(5, 2, generator=generator, dtype=dtype)
    inputs = [t.requires_grad_() for t in (cells, normal, amplitude)]
    torch.library.opcheck(injection._deposit, (*inputs, [3, 4, 5], 9, trilinear))
    bar = torch.rand(2, 9, 3, 4, 5, generator=generator, dtype=dtype)
    torch.library.opcheck(injection._deposit_adjoint, (bar, *(t.detach() for t in inputs), trilinear))


@pytest.mark.parametrize("channels", [1, 6])
def test_any_number_of_channels(generator, channels):
    amplitude = torch.rand(1, channels, generator=generator)
    volume = deposit_lobes(
        torch.tensor([[0.5, 0.5, 0.5]]),
        torch.tensor([[0.0, 1.0, 0.0]]),
        amplitude,
        (2, 2, 2),
        l_max=1,
        deposit="nearest",
    )
    torch.testing.assert_close(volume[:, 0, 0, 0, 0], amplitude[0] * math.sqrt(math.pi) / 2)


def test_coefficients_of_degree_three_are_zero(generator):
    volume, _ = inject(random_vpls(generator, torch.float32), GRID, l_max=3)
    assert not volume[:, 9:].any()


def with_value(tensor, row, value):
    tensor = tensor.clone()
    tensor[row, 1] = value
    return tensor


V = random_vpls(torch.Generator().manual_seed(0), torch.float32, count=3)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: inject(None, GRID, l_max=1), TypeError, "vpls: expected difflpv.vpl.Vpls, got NoneType"),
        (lambda: inject(V, 32, l_max=1), TypeError, "grid: expected difflpv.grid.Grid, got int"),
        (lambda: inject(V, GRID, l_max=4), ValueError, r"l_max: expected an integer in 0\.\.3, got 4"),
        (lambda: inject(V, GRID, l_max=1, deposit="cubic"), ValueError, "deposit: expected one of .*visible, got 'cubic'"),
        (lambda: inject(V, GRID, l_max=1, bias="half"), TypeError, "bias: expected a number or .*Tensor, got str"),
        (lambda: inject(V, GRID, l_max=1, bias=math.nan), ValueError, "bias: expected a finite number, got nan"),
        (
            lambda: inject(V, GRID, l_max=1, bias=torch.zeros(2)),
            ValueError,
            r"bias: expected a number or a tensor of one element, got shape \[2\]",
        ),
        (
            lambda: inject(V, GRID, l_max=1, bias=torch.tensor(0.5, dtype=torch.float64)),
            TypeError,
            "bias: expected torch.float32 on cpu, got torch.float64 on cpu",
        ),
        (
            lambda: inject(Vpls(with_value(V.position, 2, math.nan), V.normal, V.flux), GRID, l_max=1),
            ValueError,
            r"vpls.position: expected finite numbers, got \[.*nan.*\] in row 2",
        ),
        (
            lambda: inject(Vpls(V.position, with_value(V.normal, 0, math.inf), V.flux), GRID, l_max=1),
            ValueError,
            r"vpls.normal: expected finite numbers, got \[.*inf.*\] in row 0",
        ),
        (
            lambda: inject(Vpls(V.position, V.normal, with_value(V.flux, 1, math.nan)), GRID, l_max=1),
            ValueError,
            r"vpls.flux: expected finite numbers, got \[.*nan.*\] in row 1",
        ),
    ],
)  # fmt: skip
def test_errors(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_nan_position_inside_a_compiled_graph_is_lost():
    # torch.compile skips the check above; the kernel has to stay inside its arrays and the report has to tell.
    torch._dynamo.reset()
    compiled = torch.compile(lambda p: inject(Vpls(p, V.normal, V.flux), GRID, l_max=1), fullgraph=True, backend="aot_eager")
    volume, report = compiled(with_value(V.position, 2, math.nan))
    assert int(report.lost_count) >= 1
    assert torch.isfinite(volume).all()


@pytest.mark.gpu
@pytest.mark.parametrize("deposit", DEPOSITS)
def test_cuda_equals_cpu(cuda, generator, dtype, relative_tolerance, deposit):
    vpls = random_vpls(generator, dtype, count=1000, margin=0.7)
    results = []
    for device in (torch.device("cpu"), cuda):
        inputs = [t.to(device).requires_grad_() for t in (vpls.position, vpls.normal, vpls.flux)]
        volume, report = inject(Vpls(*inputs), GRID, l_max=2, deposit=deposit)
        gradients = torch.autograd.grad(volume.square().sum(), inputs if deposit == "trilinear" else inputs[1:])
        results.append([t.detach().cpu() for t in (volume, *gradients, report.lost_count, report.lost_share)])
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=10 * relative_tolerance(dtype) * max(1.0, float(a.abs().max())))
