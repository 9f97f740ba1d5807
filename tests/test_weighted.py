import pytest
import torch

from difflpv.reference import weighted as twin
from difflpv.weighted import gather_lobes, spread_lobes

SHAPE = (3, 2, 4)


def case(dtype=torch.float64, points=7, coeffs=9, channels=3, seed=0):
    g = torch.Generator().manual_seed(seed)
    volume = torch.randn(channels, coeffs, *SHAPE, generator=g, dtype=dtype)
    cells = torch.randint(0, 24, (points, 8), generator=g).int()
    weights = torch.rand(points, 8, generator=g, dtype=dtype)
    lobes = torch.randn(points, coeffs, generator=g, dtype=dtype)
    flux = torch.randn(points, channels, generator=g, dtype=dtype)
    return volume, cells, weights, lobes, flux


@pytest.mark.parametrize("points", [1, 600], ids=["a volume apart", "rows of cells"])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("coeffs", [1, 4, 9, 16])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_agree_with_the_twin(coeffs, dtype, channels, points):
    volume, cells, weights, lobes, flux = case(dtype, points, coeffs, channels)
    tolerance = {"rtol": 1e-5, "atol": 1e-5} if dtype == torch.float32 else {"rtol": 1e-12, "atol": 1e-12}
    gathered = gather_lobes(volume, cells, weights, lobes)
    torch.testing.assert_close(gathered, twin.gather_lobes(volume, cells, weights, lobes), **tolerance)
    spread = spread_lobes(flux, cells, weights, lobes, SHAPE)
    torch.testing.assert_close(spread, twin.spread_lobes(flux, cells, weights, lobes, SHAPE), **tolerance)


def test_gather_and_spread_are_transposes():
    volume, cells, weights, lobes, flux = case()
    read = (gather_lobes(volume, cells, weights, lobes) * flux).sum()
    given = (spread_lobes(flux, cells, weights, lobes, SHAPE) * volume).sum()
    torch.testing.assert_close(read, given, rtol=1e-13, atol=0)


@pytest.mark.parametrize("points", [1, 3], ids=["a volume apart", "rows of cells"])
def test_gradients(points):
    volume, cells, weights, lobes, flux = (t.requires_grad_() if t.is_floating_point() else t for t in case(points=points))
    assert torch.autograd.gradcheck(lambda v, w, o: gather_lobes(v, cells, w, o), (volume, weights, lobes))
    assert torch.autograd.gradcheck(lambda f, w, o: spread_lobes(f, cells, w, o, SHAPE), (flux, weights, lobes))


@pytest.mark.parametrize("points", [1, 9])
def test_gradients_of_some_are_those_of_all(points):
    volume, cells, weights, lobes, _ = case(points=points)
    every = [t.clone().requires_grad_() for t in (volume, weights, lobes)]
    whole = torch.autograd.grad(gather_lobes(every[0], cells, *every[1:]).square().sum(), every)
    for i in range(3):
        some = [t.clone().requires_grad_(i == j) for j, t in enumerate((volume, weights, lobes))]
        (bar,) = torch.autograd.grad(gather_lobes(some[0], cells, *some[1:]).square().sum(), some[i])
        assert torch.equal(bar, whole[i])


def test_any_number_of_threads_gives_the_same_bits():
    volume, cells, weights, lobes, flux = case(torch.float32, points=900)
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 2, 5, 40):  # 40: more than cells
            torch.set_num_threads(count)
            found.append((gather_lobes(volume, cells, weights, lobes), spread_lobes(flux, cells, weights, lobes, SHAPE)))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for other in found[1:] for a, b in zip(found[0], other, strict=True))


def test_two_backwards_agree_and_strided_input_is_read_in_order():
    volume, cells, weights, lobes, _ = case()
    volume.requires_grad_()
    result = gather_lobes(volume, cells, weights, lobes)
    first, second = (torch.autograd.grad(result.sum(), volume, retain_graph=True)[0] for _ in range(2))
    assert torch.equal(first, second)
    turned = volume.detach().transpose(2, 4).contiguous().transpose(2, 4)
    assert torch.equal(gather_lobes(turned, cells, weights.T.contiguous().T, lobes), result)


def test_no_points_and_no_volume():
    volume, cells, weights, lobes, flux = case()
    assert gather_lobes(volume, cells[:0], weights[:0], lobes[:0]).shape == (0, 3)
    assert not spread_lobes(flux[:0], cells[:0], weights[:0], lobes[:0], SHAPE).any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: {**c, "cells": c["cells"].long()}, r"cells: expected int32 of shape \[n, J\], got torch.int64"),
        (lambda c: {**c, "cells": c["cells"] + 24}, r"cells: expected indices 0\.\.23, got 24"),
        (lambda c: {**c, "weights": c["weights"][:, :4]}, r"weights: expected shape \[7, 8\], got \[7, 4\]"),
        (lambda c: {**c, "lobes": c["lobes"][:3]}, r"lobes: expected shape \[7, K\], got \[3, 9\]"),
        (lambda c: {**c, "volume": c["volume"][:, :4]}, r"volume: expected shape \[C, 9, n_z, n_y, n_x\], got \[3, 4,"),
        (lambda c: {**c, "weights": c["weights"].float()}, "weights: expected torch.float64 on cpu, got torch.float32"),
    ],
)
def test_messages(change, message):
    volume, cells, weights, lobes, _ = case()
    arguments = change({"volume": volume, "cells": cells, "weights": weights, "lobes": lobes})
    with pytest.raises((TypeError, ValueError), match=message):
        gather_lobes(**arguments)


def test_forward_mode_and_second_derivatives_are_refused():
    volume, cells, weights, lobes, _ = case()
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(volume, volume)
        with pytest.raises(NotImplementedError, match="lookup: forward-mode"):
            gather_lobes(dual, cells, weights, lobes)
    weights.requires_grad_()
    (bar,) = torch.autograd.grad(gather_lobes(volume, cells, weights, lobes).sum(), weights, create_graph=True)
    with pytest.raises(NotImplementedError, match="lookup: second derivatives"):
        bar.sum().backward()
