import subprocess
import sys
from functools import lru_cache

import pytest
import torch
import warp as wp

from difflpv.bridge import (
    as_warp,
    check_float,
    launch,
    refuse_forward_mode,
    refuse_second_derivative,
    warp_scalar,
)


@lru_cache
def scale_kernel(scalar):
    @wp.kernel(enable_backward=False, module="unique")
    def scale(source: wp.array2d(dtype=scalar), factor: scalar, result: wp.array2d(dtype=scalar)):
        i, j = wp.tid()
        result[i, j] = factor * source[i, j]

    return scale


@torch.library.custom_op("difflpv_test::cube", mutates_args=())
def cube(x: torch.Tensor) -> torch.Tensor:
    return x**3


@torch.library.custom_op("difflpv_test::cube_adjoint", mutates_args=())
def cube_adjoint(bar: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    return 3 * x**2 * bar


cube.register_autograd(
    lambda ctx, bar: cube_adjoint(bar, *ctx.saved_tensors),
    setup_context=lambda ctx, inputs, output: ctx.save_for_backward(*inputs),
)
refuse_second_derivative("cube", cube_adjoint)


def test_launch_reads_and_writes_torch_memory(dtype):
    source = torch.arange(6, dtype=dtype).reshape(2, 3).requires_grad_()
    result = torch.zeros(2, 3, dtype=dtype)
    launch(scale_kernel(warp_scalar(source.dtype)), source.shape, [source, 2, result], source.device)
    assert torch.equal(result, 2 * source.detach())


@pytest.mark.parametrize("shape", [(0, 3), (2, 0)])
def test_launch_over_nothing(dtype, shape):
    nothing = torch.zeros(shape, dtype=dtype)
    launch(scale_kernel(warp_scalar(dtype)), shape, [nothing, 2, nothing], nothing.device)


@pytest.mark.gpu
def test_launch_uses_the_current_stream(cuda):
    source = torch.ones(2, 3, device=cuda)
    result = torch.zeros_like(source)
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        torch.cuda._sleep(10_000_000)
        source.add_(1)
        launch(scale_kernel(warp_scalar(source.dtype)), source.shape, [source, 2, result], cuda)
    stream.synchronize()
    assert torch.equal(result, torch.full_like(source, 4))


def test_as_warp_describes_the_same_memory(dtype):
    tensor = torch.zeros(4, 3, dtype=dtype)
    assert as_warp(tensor).data == tensor.data_ptr()
    assert list(as_warp(tensor).shape)[:2] == [4, 3]
    vectors = as_warp(tensor, wp.types.vector(3, warp_scalar(dtype)))
    assert vectors.ndim == 1


def test_warp_scalar():
    assert warp_scalar(torch.float32) is wp.float32
    assert warp_scalar(torch.float64) is wp.float64
    with pytest.raises(TypeError, match="dtype: expected torch.float32 or torch.float64, got torch.float16"):
        warp_scalar(torch.float16)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([1.0], "flux: expected a torch.Tensor, got list"),
        (torch.zeros(3, dtype=torch.int64), "flux: expected dtype torch.float32 or torch.float64, got torch.int64"),
        (torch.zeros(3, dtype=torch.float64), "flux: expected torch.float32 on cpu, got torch.float64 on cpu"),
        (torch.zeros(3, device="meta"), "flux: expected torch.float32 on cpu, got torch.float32 on meta"),
    ],
)
def test_check_float(value, message):
    check_float("flux", torch.zeros(3))
    with pytest.raises(TypeError, match=message):
        check_float("flux", value, like=torch.zeros(1))


def test_refuse_forward_mode():
    x = torch.ones(3)
    refuse_forward_mode("injection", x, None)
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(x, x)
        refuse_forward_mode("injection", x)
        with pytest.raises(NotImplementedError, match=r"injection: forward-mode .* use backward\(\)"):
            refuse_forward_mode("injection", x, dual)


def test_refuse_second_derivative():
    x = torch.tensor(2.0, requires_grad=True)
    (first,) = torch.autograd.grad(cube(x), x)
    assert float(first) == 12.0
    (first,) = torch.autograd.grad(cube(x), x, create_graph=True)
    with pytest.raises(NotImplementedError, match="cube: second derivatives are not supported"):
        first.backward()


def test_import_is_silent():
    result = subprocess.run(
        [sys.executable, "-c", "import difflpv.bridge, sys; print('seen', file=sys.stderr)"],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert (result.stdout, result.stderr) == ("", "seen\n")
