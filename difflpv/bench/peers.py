"""Other ways to take the same propagation steps: ``conv3d``, the readable torch twin, and the twin compiled."""

from __future__ import annotations

import shutil
from collections.abc import Callable

import torch

from difflpv.convolution import stencil_weight
from difflpv.reference.propagation import propagate_linear
from difflpv.stencil import LinearStencil

__all__ = ["compiled_twin", "convolution", "convolution_weight", "eager_twin"]

Steps = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


def convolution_weight(stencil: LinearStencil) -> torch.Tensor:
    """``conv3d``'s weight [K,K,3,3,3] of a linear stencil, contiguous."""
    return stencil_weight(stencil.offsets, torch.tensor(stencil.matrices, dtype=torch.float32)).contiguous()


def convolution(volume: torch.Tensor, weight: torch.Tensor, factors: torch.Tensor) -> torch.Tensor:
    """Accumulated steps by ``conv3d``, in the layout of ``weight``; nothing blocks."""
    last = weight.is_contiguous(memory_format=torch.channels_last_3d)
    moving = total = volume.contiguous(memory_format=torch.channels_last_3d) if last else volume
    for factor in factors:
        moving = factor * torch.nn.functional.conv3d(moving, weight, padding=1)
        total = total + moving
    return total


def eager_twin(stencil: LinearStencil, transmittance: torch.Tensor) -> Steps:
    """``difflpv.reference.propagation.propagate_linear`` of a stencil, as a function of volume and factors."""
    offsets: list[tuple[int, int, int]] = [(int(x), int(y), int(z)) for x, y, z in stencil.offsets]
    matrices = torch.tensor(stencil.matrices, dtype=torch.float32)

    def run(volume: torch.Tensor, factors: torch.Tensor) -> torch.Tensor:
        return propagate_linear(volume, offsets, matrices, factors, transmittance, occlude_first_step=True)

    return run


def compiled_twin(stencil: LinearStencil, transmittance: torch.Tensor) -> tuple[Steps | None, str]:
    """The twin's single step compiled and repeated, or None and why there is none."""
    if not (shutil.which("g++") or shutil.which("clang++")):
        return None, "torch.compile needs a C++ compiler, found neither g++ nor clang++"
    twin = eager_twin(stencil, transmittance)

    def step(moving: torch.Tensor, factor: torch.Tensor) -> torch.Tensor:
        return twin(moving, factor) - moving

    fast = torch.compile(step, dynamic=False)

    def run(volume: torch.Tensor, factors: torch.Tensor) -> torch.Tensor:
        moving = total = volume
        for k in range(len(factors)):
            moving = fast(moving, factors[k : k + 1])
            total = total + moving
        return total

    try:
        probe = torch.zeros(3, (stencil.l_max + 1) ** 2, *transmittance.shape[1:])
        run(probe, torch.ones(1))
    except Exception as error:  # a compiler that is not there, or not whole, fails in many ways
        return None, f"torch.compile failed: {' '.join(str(error).split())[:120]}"
    return run, ""
