"""Torch tensors into Warp launches, and what a custom op must refuse.

Every op of the project is a ``torch.library.custom_op`` whose body launches hand-written Warp kernels. Warp sees
detached, contiguous tensors that torch allocated; no ``wp.Tape`` is involved. Importing this module initialises Warp.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any

import torch
import warp as wp

__all__ = [
    "as_warp",
    "check_float",
    "launch",
    "record",
    "refuse_forward_mode",
    "refuse_second_derivative",
    "replay",
    "warp_scalar",
]


def _init_quietly() -> None:
    """Initialise Warp; without CUDA keep its native "no driver" line, which no setting turns off, from stderr."""
    wp.config.log_level = wp.LOG_ERROR
    if torch.cuda.is_available():
        wp.init()
        return
    try:
        stderr = os.dup(2)
    except OSError:  # the process runs without one
        wp.init()
        return
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)


_init_quietly()

_SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}


def warp_scalar(dtype: torch.dtype) -> Any:
    """The Warp scalar type of a torch dtype (float32 or float64)."""
    if dtype not in _SCALARS:
        raise TypeError(f"dtype: expected torch.float32 or torch.float64, got {dtype}")
    return _SCALARS[dtype]


def check_float(name: str, tensor: torch.Tensor, *, like: torch.Tensor | None = None) -> None:
    """Raise unless ``tensor`` is a float32/float64 tensor (of the dtype and device of ``like``)."""
    if not isinstance(tensor, torch.Tensor):
        raise TypeError(f"{name}: expected a torch.Tensor, got {type(tensor).__name__}")
    if tensor.dtype not in _SCALARS:
        raise TypeError(f"{name}: expected dtype torch.float32 or torch.float64, got {tensor.dtype}")
    if like is not None and (tensor.dtype != like.dtype or tensor.device != like.device):
        raise TypeError(f"{name}: expected {like.dtype} on {like.device}, got {tensor.dtype} on {tensor.device}")


def as_warp(tensor: torch.Tensor, dtype: Any = None) -> Any:
    """A Warp view of a contiguous tensor's memory; ``dtype`` may be a Warp vector type over the last axis."""
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False, return_ctype=True)


def launch(kernel: Any, dim: int | Sequence[int], inputs: Sequence[Any], device: torch.device) -> None:
    """Launch a kernel on torch's device (and current stream); tensors among ``inputs`` are passed as scalar arrays."""
    arguments = [as_warp(value) if isinstance(value, torch.Tensor) else value for value in inputs]
    stream = wp.stream_from_torch(torch.cuda.current_stream(device)) if device.type == "cuda" else None
    target = None if stream is not None else wp.device_from_torch(device)
    wp.launch(kernel, dim=dim, inputs=arguments, device=target, stream=stream, record_tape=False)


def record(kernel: Any, dim: Sequence[int], inputs: Sequence[Any], device: torch.device) -> Any:
    """A launch to be replayed: ``set_param_at_index_from_ctype`` changes an input, ``replay`` runs it."""
    target = wp.device_from_torch(device)
    return wp.launch(kernel, dim=dim, inputs=list(inputs), device=target, record_tape=False, record_cmd=True)


def replay(command: Any, device: torch.device) -> None:
    """Run a recorded launch on torch's current stream."""
    command.launch(wp.stream_from_torch(torch.cuda.current_stream(device)) if device.type == "cuda" else None)


def refuse_forward_mode(name: str, *tensors: torch.Tensor | None) -> None:
    """Raise if a tensor carries a forward-mode tangent: a custom op would drop it and return zeros."""
    if torch.compiler.is_compiling():
        return
    for tensor in tensors:
        if tensor is not None and torch.autograd.forward_ad.unpack_dual(tensor).tangent is not None:
            raise NotImplementedError(f"{name}: forward-mode derivatives are not supported; use backward()")


def refuse_second_derivative(name: str, backward_op: Any) -> None:
    """Let ``backward_op`` (a custom op) raise a clear error when it is differentiated itself."""

    def backward(ctx: Any, *gradients: torch.Tensor) -> Any:
        raise NotImplementedError(f"{name}: second derivatives are not supported; call backward() without create_graph")

    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        del ctx, inputs, output

    register: Callable[..., None] = backward_op.register_autograd
    register(backward, setup_context=setup_context)
