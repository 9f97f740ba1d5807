"""Face stencils on the Warp kernels of ``warp_kernels.propagation``; buffers, slabs and checkpoints as in ``difflpv.padded``.

Volumes are kept only where the clamp or a learnable of the propagation needs them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch

from difflpv.bridge import as_warp, refuse_second_derivative, warp_scalar
from difflpv.padded import Layout, Spans, kept_volumes, last_bar, march, steps_back, volumes_between
from difflpv.slabs import SlabLauncher
from difflpv.stencil import FaceStencil
from warp_kernels.propagation import CPU_LANES, adjoint_kernel, forward_kernel

__all__ = ["propagate_faces"]


class _Steps:
    """Launches of one solve: constant arguments bound once, the moving buffers given per step."""

    def __init__(
        self, layout: Layout, factors: torch.Tensor, transmittance: torch.Tensor, offsets: torch.Tensor,
        axis: torch.Tensor, weights: torch.Tensor, lobes: torch.Tensor, clamp: bool, occlude_first_step: bool,
    ) -> None:  # fmt: skip
        self.layout, self.device, self.axes = layout, factors.device, len(lobes)
        self.clamp, self.occlude_first_step, self.occluded = clamp, occlude_first_step, len(transmittance) > 0
        self._scalar = warp_scalar(factors.dtype)
        cells = offsets.cpu().numpy()
        neighbours, owner = np.unique(cells, axis=0, return_inverse=True)
        owner = owner.ravel()
        self.faces, self.neighbours = len(cells), len(neighbours)
        topology = {
            "line_shift": neighbours[:, 2] * layout.pitch_y + neighbours[:, 1],
            "x_shift": neighbours[:, 0],
            "first": np.concatenate([[0], np.cumsum(np.bincount(owner))]),
            "face": np.argsort(owner, kind="stable"),
            "face_neighbour": owner,
        }
        tensors = {k: torch.tensor(v, dtype=torch.int32, device=self.device) for k, v in topology.items()}
        tensors |= {"axis": axis.to(torch.int32), "weights": weights, "lobes": lobes, "factor": factors}
        self._offsets, self._order, self._transmittance = cells, topology["face"], transmittance.detach()
        self._tensors = {k: v.detach().contiguous().reshape(-1) for k, v in tensors.items()}  # keeps them alive
        self._views = {k: as_warp(v) for k, v in self._tensors.items()}
        self.launcher = SlabLauncher(self.device)

    @cached_property
    def _leaving(self) -> torch.Tensor:
        """Padded transmittance at the source cells: what the adjoint reads."""
        return self.layout.pad(self._transmittance) if self.occluded else self._transmittance

    @cached_property
    def _arriving(self) -> torch.Tensor:
        """Padded transmittance at the destination cells, faces in the order of ``face``: what a step reads."""
        if not self.occluded:
            return self._transmittance
        buffer = self.layout.empty(self.faces, self._transmittance)
        for i, f in enumerate(self._order):
            self.layout.inside(buffer, self.faces, tuple(self._offsets[f].tolist()))[i] = self._transmittance[f]
        return buffer

    def occlude(self, step: int) -> bool:
        """True where the transmittance acts on this step."""
        return self.occluded and (step > 0 or self.occlude_first_step)

    def _spec(self, step: int) -> dict[str, Any]:
        return {
            "coeffs": self.layout.coeffs, "axes": self.axes, "channels": _group(self.layout),
            "lanes": self.layout.lanes, "clamp": self.clamp, "occluded": self.occlude(step),
        }  # fmt: skip

    def forward(self, moving: torch.Tensor, into: torch.Tensor, total: torch.Tensor, step: int, spans: Spans) -> None:
        """S_{step+1} from S_step, added onto ``total``; all flat padded buffers."""
        v, layout = self._views, self.layout
        where = spans.arguments(moving, into)
        arguments = [
            as_warp(moving), as_warp(into), as_warp(total), as_warp(self._arriving), v["weights"], v["lobes"], v["factor"],
            v["line_shift"], v["x_shift"], v["first"], v["face"], v["axis"], *where, self.neighbours, self.faces, step,
            layout.pitch_y, layout.pitch, layout.channels // _group(layout), layout.z, layout.y, layout.x,
        ]  # fmt: skip
        self._launch(forward_kernel(self._scalar, **self._spec(step)), arguments)

    def adjoint(
        self, moving: torch.Tensor, lobe_bar: torch.Tensor, into: torch.Tensor, total_bar: torch.Tensor,
        volume_bar: torch.Tensor, transmittance_bar: torch.Tensor, factor_bar: torch.Tensor, step: int, *, start: bool = False,
    ) -> None:  # fmt: skip
        """H_step ``into`` from H_{step+1}; adds onto ``transmittance_bar`` and ``factor_bar`` unless they are empty.

        ``start`` takes no step: it leaves H of ``total_bar``. Without clamp and factors ``moving`` is not read.
        """
        v, layout = self._views, self.layout
        need_transmittance = len(transmittance_bar) > 0 and self.occlude(step)
        flags = {"need_factor": len(factor_bar) > 0, "need_transmittance": need_transmittance}
        arguments = [
            as_warp(moving), as_warp(lobe_bar), as_warp(into), as_warp(total_bar), as_warp(volume_bar), as_warp(self._leaving),
            as_warp(transmittance_bar), as_warp(factor_bar), v["weights"], v["lobes"], v["factor"], v["line_shift"],
            v["x_shift"], v["face_neighbour"], v["axis"], 0 if start else self.faces // 2, self.faces, int(step == 0), step,
            layout.pitch_y, layout.pitch, layout.channels // _group(layout), layout.z, layout.y, layout.x,
        ]  # fmt: skip
        self._launch(adjoint_kernel(self._scalar, **self._spec(step), **flags), arguments)

    def _launch(self, kernel: Any, arguments: list[Any]) -> None:
        """One group of channels after the other: they add onto the same transmittance gradient."""
        layout = self.layout
        rows, width = layout.z * layout.y, layout.x if self.device.type == "cuda" else 1
        for group in range(layout.channels // _group(layout)):
            self.launcher.launch(kernel, rows, width, arguments, first=group * rows)


def _group(layout: Layout) -> int:
    """Channels that one thread works on together."""
    return 3 if layout.channels % 3 == 0 else 1


def _rows(layout: Layout) -> int:
    return layout.channels // _group(layout) * layout.z * layout.y


@torch.library.custom_op("difflpv::propagate_faces", mutates_args=())
def _propagate(
    volume: torch.Tensor, factors: torch.Tensor, transmittance: torch.Tensor, offsets: torch.Tensor, axis: torch.Tensor,
    weights: torch.Tensor, lobes: torch.Tensor, clamp: bool, occlude_first_step: bool, tolerance: float, keep: int,
    read_box: Sequence[int], want_moving: bool,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:  # fmt: skip
    layout = Layout.of(volume, CPU_LANES)
    steps = _Steps(layout, factors, transmittance, offsets, axis, weights, lobes, clamp, occlude_first_step)
    spans = Spans(layout, volume, len(factors), read_box, groups=layout.channels // _group(layout))
    total, moving, states, done = march(layout, volume, len(factors), keep, tolerance, steps.forward, spans)
    steps.launcher.release()
    rest = layout.unpad(moving) if want_moving else volume.new_empty(0)
    return layout.unpad(total), rest, states, torch.tensor(done)


@_propagate.register_fake
def _(
    volume, factors, transmittance, offsets, axis, weights, lobes, clamp, occlude_first_step, tolerance, keep, read_box,
    want_moving,
):  # fmt: skip
    states = kept_volumes(Layout.of(volume, CPU_LANES), volume, len(factors), keep)
    total = torch.empty_like(volume, memory_format=torch.contiguous_format)
    rest = torch.empty_like(total) if want_moving else volume.new_empty(0)
    return total, rest, states, torch.empty((), dtype=torch.int64)


@torch.library.custom_op("difflpv::propagate_faces_backward", mutates_args=())
def _propagate_backward(
    accumulated_bar: torch.Tensor, moving_bar: torch.Tensor, states: torch.Tensor, done: torch.Tensor, factors: torch.Tensor,
    transmittance: torch.Tensor, offsets: torch.Tensor, axis: torch.Tensor, weights: torch.Tensor, lobes: torch.Tensor,
    clamp: bool, occlude_first_step: bool, keep: int, need_factors: bool, need_transmittance: bool,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:  # fmt: skip
    layout = Layout.of(accumulated_bar, CPU_LANES)
    fields = layout.fields
    steps = _Steps(layout, factors, transmittance, offsets, axis, weights, lobes, clamp, occlude_first_step)
    total_bar, volume_bar = layout.pad(accumulated_bar), layout.empty(fields, accumulated_bar)
    end_bar = last_bar(layout, accumulated_bar, moving_bar, total_bar)
    lobe_bar = layout.empty(layout.channels * len(lobes), accumulated_bar)
    lobe_bar_next = torch.zeros_like(lobe_bar)
    # the kernel that makes the transmittance's gradient writes the factors' too
    factor_bar = accumulated_bar.new_zeros(len(factors) * _rows(layout) if need_factors or need_transmittance else 0)
    faces = len(transmittance) if need_transmittance else 0
    transmittance_bar = layout.empty(faces, accumulated_bar) if faces else accumulated_bar.new_empty(0)
    count = int(done)
    if count == 0:
        volume_bar = end_bar
    else:
        none = accumulated_bar.new_empty(0)
        steps.adjoint(total_bar, lobe_bar_next, lobe_bar, end_bar, volume_bar, none, none, count - 1, start=True)
    for step, before in steps_back(layout, states, len(factors), count, keep, steps.forward):
        moving = total_bar if before is None else before
        steps.adjoint(moving, lobe_bar, lobe_bar_next, total_bar, volume_bar, transmittance_bar, factor_bar, step)
        lobe_bar, lobe_bar_next = lobe_bar_next, lobe_bar
    volume_bar = layout.unpad(volume_bar)
    if faces:
        transmittance_bar = layout.inside(transmittance_bar, faces).contiguous()
    if need_factors:
        factor_bar = factor_bar.view(len(factors), _rows(layout)).sum(1)
    else:
        factor_bar = accumulated_bar.new_empty(0)
    return volume_bar, factor_bar, transmittance_bar


@_propagate_backward.register_fake
def _(
    accumulated_bar, moving_bar, states, done, factors, transmittance, offsets, axis, weights, lobes, clamp, occlude_first_step,
    keep, need_factors, need_transmittance,
):  # fmt: skip
    passed = torch.empty_like(transmittance) if need_transmittance else accumulated_bar.new_empty(0)
    return torch.empty_like(accumulated_bar), accumulated_bar.new_empty(len(factors) if need_factors else 0), passed


refuse_second_derivative("propagate", _propagate_backward)


def _setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[torch.Tensor, ...]) -> None:
    _, factors, transmittance, offsets, axis, weights, lobes, *flags = inputs
    _, _, states, done = output
    ctx.mark_non_differentiable(states, done)
    ctx.save_for_backward(states, done, factors, transmittance, offsets, axis, weights, lobes)
    ctx.clamp, ctx.occlude_first_step, _, ctx.keep, *_ = flags


def _backward(
    ctx: Any, accumulated_bar: torch.Tensor, moving_bar: torch.Tensor, *unused: torch.Tensor
) -> tuple[torch.Tensor | None, ...]:
    need_volume, need_factors, need_transmittance = ctx.needs_input_grad[:3]
    volume_bar, factor_bar, transmittance_bar = _propagate_backward(
        accumulated_bar.contiguous(), moving_bar.contiguous(), *ctx.saved_tensors, ctx.clamp, ctx.occlude_first_step, ctx.keep,
        need_factors, need_transmittance,
    )  # fmt: skip
    return (
        volume_bar if need_volume else None,
        factor_bar if need_factors else None,
        transmittance_bar if need_transmittance else None,
        *[None] * 10,
    )


_propagate.register_autograd(_backward, setup_context=_setup)


def propagate_faces(
    volume: torch.Tensor,
    stencil: FaceStencil,
    factors: torch.Tensor,
    transmittance: torch.Tensor | None,
    *,
    occlude_first_step: bool,
    clamp: bool,
    tolerance: float,
    checkpoint_every: int | None,
    read_box: Sequence[int] = (),
    moving: bool = False,
) -> tuple[torch.Tensor, torch.Tensor]:
    """``difflpv.propagation`` on the Warp kernels; arguments validated there, ``factors`` is [steps].

    Returns the accumulated volume and the moving one (empty unless ``moving``).
    """
    passed = volume.new_ones((0, *volume.shape[2:])) if transmittance is None else transmittance
    learned = torch.is_grad_enabled() and (factors.requires_grad or passed.requires_grad)
    needs = learned or (clamp and torch.is_grad_enabled() and volume.requires_grad)
    keep = 0
    if needs and len(factors):
        keep = volumes_between(Layout.of(volume, CPU_LANES), volume, len(factors), checkpoint_every)
    lobes, axis = stencil.distinct_lobes

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(values, dtype=volume.dtype, device=volume.device)

    return _propagate(
        volume.contiguous(),
        factors.contiguous(),
        passed.contiguous(),
        torch.as_tensor(stencil.offsets, device=volume.device),
        torch.as_tensor(axis, device=volume.device),
        tensor(stencil.flux_weights),
        tensor(lobes),
        clamp,
        occlude_first_step,
        float(tolerance),
        keep,
        list(read_box),
        moving,
    )[:2]
