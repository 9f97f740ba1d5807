import pytest
import torch

from difflpv.vpl import Vpls


def some(count, dtype=torch.float32, start=0.0):
    values = torch.arange(start, start + 9 * count, dtype=dtype).reshape(3, count, 3)
    return Vpls(*values)


def test_length_and_order_of_cat(dtype):
    both = Vpls.cat([some(2, dtype), some(0, dtype), some(3, dtype, start=100.0)])
    assert len(both) == 5
    assert torch.equal(both.position[:2], some(2, dtype).position)
    assert torch.equal(both.normal[2:], some(3, dtype, start=100.0).normal)
    assert torch.equal(both.flux[2:], some(3, dtype, start=100.0).flux)


def test_cat_keeps_gradients():
    flux = torch.ones(2, 3, requires_grad=True)
    first = Vpls(torch.zeros(2, 3), torch.zeros(2, 3), flux)
    Vpls.cat([first, some(1)]).flux.sum().backward()
    assert torch.equal(flux.grad, torch.ones(2, 3))


def test_errors():
    x = torch.zeros(4, 3)
    with pytest.raises(TypeError, match="position: expected a torch.Tensor, got list"):
        Vpls([[0, 0, 0]], x, x)
    with pytest.raises(TypeError, match="position: expected dtype torch.float32 or torch.float64, got torch.int64"):
        Vpls(x.long(), x, x)
    with pytest.raises(ValueError, match=r"position: expected shape \[4, 3\], got \[4, 2\]"):
        Vpls(x[:, :2], x, x)
    with pytest.raises(ValueError, match=r"normal: expected shape \[4, 3\], got \[3, 3\]"):
        Vpls(x, x[1:], x)
    with pytest.raises(TypeError, match="flux: expected torch.float32 on cpu, got torch.float64 on cpu"):
        Vpls(x, x, x.double())
