"""Fixtures that every stage's tests share: precisions, seeds, and the checks that every differentiable op has to
pass."""

import pytest


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    import torch

    return getattr(torch, request.param)


@pytest.fixture
def generator():
    import torch

    return torch.Generator().manual_seed(20240607)


@pytest.fixture
def relative_tolerance():
    """By how much a kernel may differ from its twin, relative to the largest value."""
    import torch

    return {torch.float32: 1e-5, torch.float64: 1e-12}.__getitem__


@pytest.fixture
def cuda():
    """The CUDA device, for tests marked ``gpu``."""
    import torch

    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    return torch.device("cuda")


@pytest.fixture
def check_op():
    """Everything that a stage's function promises beyond its values, for a ``function`` of tensors with one result."""
    return check_differentiable_op


def check_differentiable_op(function, inputs, *, compiled=True):
    """float64 gradcheck, repeatable backward, torch.compile, forward mode and second derivative refused."""
    import torch

    inputs = [t.detach().double().clone().requires_grad_() for t in inputs]
    assert torch.autograd.gradcheck(function, inputs, fast_mode=False)

    result = function(*inputs)
    cotangent = torch.randn(result.shape, generator=torch.Generator().manual_seed(3), dtype=result.dtype)
    first = torch.autograd.grad(result, inputs, cotangent, retain_graph=True)
    again = torch.autograd.grad(result, inputs, cotangent)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert all(float(a.abs().max()) > 0 for a in first), "a gradient that is zero everywhere checks nothing"

    result = function(*inputs)
    gradients = torch.autograd.grad(result.square().sum(), inputs, create_graph=True)
    with pytest.raises(NotImplementedError, match="second derivatives are not supported"):
        torch.autograd.grad(sum(g.sum() for g in gradients), inputs)

    for i in range(len(inputs)):
        with torch.autograd.forward_ad.dual_level():
            mixed = [t.detach() for t in inputs]
            mixed[i] = torch.autograd.forward_ad.make_dual(mixed[i], torch.ones_like(mixed[i]))
            with pytest.raises(NotImplementedError, match="forward-mode derivatives are not supported"):
                function(*mixed)

    if compiled:
        torch._dynamo.reset()
        graph = torch.compile(function, fullgraph=True, backend="aot_eager")
        result = graph(*inputs)
        torch.testing.assert_close(result, function(*inputs), rtol=1e-12, atol=1e-12)
        for a, b in zip(torch.autograd.grad(result, inputs, cotangent), first, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)
