"""Linear stencils with occlusion on the Warp kernels of ``warp_kernels.linear_propagation``.

Buffers, slabs and checkpoints as in ``difflpv.padded``. Volumes are kept only where the matrices, the factors or the
transmittance learn: the step is linear in the light.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch

from difflpv.bridge import as_warp, refuse_second_derivative, warp_scalar
from difflpv.padded import Layout, Spans, kept_volumes, last_bar, march, nest, steps_back, volumes_between
from difflpv.slabs import SlabLauncher
from difflpv.stencil import pair_offsets
from warp_kernels.linear_propagation import cpu_lanes, matrices_kernel, step_kernel

__all__ = ["propagate_pairs"]


def _layout(volume: torch.Tensor) -> Layout:
    return Layout.of(volume, cpu_lanes(volume.element_size()))


class _Steps:
    """Launches of one solve: constant arguments bound once, the moving buffers given per step."""

    def __init__(
        self, layout: Layout, matrices: torch.Tensor, factors: torch.Tensor, transmittance: torch.Tensor,
        offsets: torch.Tensor, occlude_first_step: bool,
    ) -> None:  # fmt: skip
        self.layout, self.device = layout, factors.device
        self.occlude_first_step, self.occluded = occlude_first_step, len(transmittance) > 0
        self._scalar, self._width = warp_scalar(factors.dtype), layout.x if factors.is_cuda else 1
        cells = offsets.cpu().numpy()
        self.pairs = pair_offsets(cells)
        order = [(0, 0, 0)] + [tuple(int(v) for v in side * n) for n in self.pairs for side in (1, -1)]
        self._place = torch.tensor([order.index(tuple(n)) for n in cells.tolist()], device=self.device)
        coeffs = layout.coeffs
        weights = matrices.new_zeros((len(order), coeffs, coeffs))
        weights[self._place] = matrices.detach()
        self.paired = _mirrored(weights)
        swapped = [0] + [i + (1 if i % 2 else -1) for i in range(1, len(order))]
        line_shift = self.pairs[:, 2] * layout.pitch_y + self.pairs[:, 1]
        self._tensors = {  # keeps them alive
            "weights": weights, "adjoint weights": weights[swapped].transpose(1, 2).contiguous(),
            "factor": factors.detach().contiguous(), "transmittance": self._padded(transmittance.detach()),
            "line_shift": torch.tensor(line_shift, dtype=torch.int32, device=self.device),
            "x_shift": torch.tensor(np.ascontiguousarray(self.pairs[:, 0]), dtype=torch.int32, device=self.device),
        }  # fmt: skip
        self._views = {k: as_warp(v.reshape(-1)) for k, v in self._tensors.items()}
        self._none, no_ints = as_warp(factors.new_empty(0)), as_warp(torch.empty(0, dtype=torch.int32, device=self.device))
        self._nowhere = [no_ints, no_ints, no_ints, self._none]
        self.launcher = SlabLauncher(self.device)

    def _padded(self, transmittance: torch.Tensor) -> torch.Tensor:
        """Padded transmittance; 0 towards cells outside the grid, whatever stands there (a NaN would survive 0 S)."""
        if not self.occluded:
            return transmittance
        buffer = self.layout.pad(transmittance)
        inside = self.layout.inside(buffer, len(self.pairs))
        for field, offset in zip(inside, self.pairs.tolist(), strict=True):
            for axis, step in enumerate(reversed(offset)):
                if step:
                    field.select(axis, -1 if step > 0 else 0).zero_()
        return buffer

    @cached_property
    def slabs(self) -> tuple[int, int]:
        """Slabs of the matrices' gradient and rows in each: few enough to add up, many enough for every thread."""
        z, y = self.layout.z, self.layout.y
        return (z * y, 1) if self.device.type == "cuda" else (z, y)

    def occlude(self, step: int) -> bool:
        """True where the transmittance acts on this step."""
        return self.occluded and (step > 0 or self.occlude_first_step)

    def _spec(self, step: int) -> dict[str, Any]:
        layout = self.layout
        return {
            "coeffs": layout.coeffs, "lanes": layout.lanes, "occluded": self.occlude(step),
        }  # fmt: skip

    def forward(self, moving: torch.Tensor, into: torch.Tensor, total: torch.Tensor, step: int, spans: Spans) -> None:
        """S_{step+1} from S_step, added onto ``total``; all flat padded buffers."""
        where = spans.arguments(moving, into)
        self._step(moving, into, total, self._none, self._none, self._none, step, where, weights="weights")

    def nested(self, inner: torch.Tensor, into: torch.Tensor, injected: torch.Tensor, step: int, spans: Spans) -> None:
        """``injected`` (flat, without halo) and what this step makes of ``inner``, ``into``; flat padded buffers."""
        where = spans.arguments(inner, into)
        self._step(inner, into, injected, self._none, self._none, self._none, step, where, weights="weights", nested=True)

    def adjoint(
        self, after: torch.Tensor, into: torch.Tensor, total_bar: torch.Tensor, before: torch.Tensor | None,
        transmittance_bar: torch.Tensor, factor_bar: torch.Tensor, step: int,
    ) -> None:  # fmt: skip
        """G_step ``into`` from G_{step+1}; adds onto ``transmittance_bar`` and ``factor_bar`` unless they are empty."""
        flags = {
            "adjoint": True, "need_factor": len(factor_bar) > 0,
            "need_transmittance": len(transmittance_bar) > 0 and self.occlude(step),
        }  # fmt: skip
        volume = self._none if before is None else as_warp(before)
        bars = as_warp(transmittance_bar), as_warp(factor_bar)
        self._step(after, into, total_bar, volume, *bars, step, self._nowhere, weights="adjoint weights", **flags)

    def _step(
        self, moving: torch.Tensor, into: torch.Tensor, total: torch.Tensor, before: Any, transmittance_bar: Any,
        factor_bar: Any, step: int, where: list[Any], *, weights: str, **flags: bool,
    ) -> None:  # fmt: skip
        v, layout = self._views, self.layout
        kernel = step_kernel(self._scalar, **self._spec(step), paired=self.paired, **flags)
        arguments = [
            as_warp(moving), as_warp(into), as_warp(total), v["transmittance"], before, transmittance_bar, factor_bar,
            v[weights], v["factor"], v["line_shift"], v["x_shift"], *where, len(self.pairs), step, layout.pitch_y,
            layout.pitch, layout.channels, layout.z, layout.y, layout.x,
        ]  # fmt: skip
        self.launcher.launch(kernel, layout.z * layout.y, self._width, arguments)

    def correlate(self, after: torch.Tensor, before: torch.Tensor, partial: torch.Tensor, step: int) -> None:
        """Add the matrices' gradient of one step onto ``partial`` [slabs, 1 + 2P, K, K]; ``after`` is G_{step+1}."""
        v, layout = self._views, self.layout
        slabs, rows = self.slabs
        arguments = [
            as_warp(after), as_warp(before), v["transmittance"], as_warp(partial.view(-1)), v["factor"], v["line_shift"],
            v["x_shift"], len(self.pairs), step, layout.pitch_y, layout.pitch, layout.channels, rows, layout.y, layout.x,
        ]  # fmt: skip
        self.launcher.launch(matrices_kernel(self._scalar, **self._spec(step)), slabs, partial.shape[1], arguments)

    def matrices_bar(self, partial: torch.Tensor) -> torch.Tensor:
        """Gradient of the matrices in the order of the offsets [n,K,K]."""
        return partial.sum(0)[self._place]

    def transmittance_bar(self, buffer: torch.Tensor) -> torch.Tensor:
        """Gradient of the transmittance [P, n_z, n_y, n_x] from the halves that both cells of each pair have seen."""
        pairs = len(self.pairs)
        bar = self.layout.inside(buffer, 2 * pairs)[:pairs].contiguous()
        for n, offset in enumerate(self.pairs.tolist()):
            bar[n] += self.layout.inside(buffer, 2 * pairs, tuple(offset))[pairs + n]
        return bar


def _mirrored(weights: torch.Tensor) -> bool:
    """True where A_{-n} = P A_n P, P = diag((-1)^l), up to rounding: what the paired products need."""
    coeffs = weights.shape[1]
    parity = torch.tensor([(-1.0) ** int(k**0.5) for k in range(coeffs)], dtype=weights.dtype, device=weights.device)
    difference = weights[2::2] - parity[:, None] * weights[1::2] * parity
    bound = 4 * torch.finfo(weights.dtype).eps * weights.abs().amax()
    return bool((difference.abs() <= bound).all())


@torch.library.custom_op("difflpv::propagate_pairs", mutates_args=())
def _propagate(
    volume: torch.Tensor, matrices: torch.Tensor, factors: torch.Tensor, transmittance: torch.Tensor, offsets: torch.Tensor,
    occlude_first_step: bool, tolerance: float, keep: int, read_box: Sequence[int], want_moving: bool,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:  # fmt: skip
    layout = _layout(volume)
    steps = _Steps(layout, matrices, factors, transmittance, offsets, occlude_first_step)
    # all steps alike but for their factor, and nothing asked for but the sum
    nested = not (keep or tolerance or want_moving) and (occlude_first_step or not steps.occluded)
    spans = Spans(layout, volume, len(factors), read_box, last_first=nested)
    if nested:
        total = nest(layout, volume, len(factors), steps.nested, spans)
        steps.launcher.release()
        states = kept_volumes(layout, volume, len(factors), keep)
        return layout.unpad(total), volume.new_empty(0), states, torch.tensor(len(factors))
    total, moving, states, done = march(layout, volume, len(factors), keep, tolerance, steps.forward, spans)
    steps.launcher.release()
    rest = layout.unpad(moving) if want_moving else volume.new_empty(0)
    return layout.unpad(total), rest, states, torch.tensor(done)


@_propagate.register_fake
def _(volume, matrices, factors, transmittance, offsets, occlude_first_step, tolerance, keep, read_box, want_moving):
    states = kept_volumes(_layout(volume), volume, len(factors), keep)
    total = torch.empty_like(volume, memory_format=torch.contiguous_format)
    rest = torch.empty_like(total) if want_moving else volume.new_empty(0)
    return total, rest, states, torch.empty((), dtype=torch.int64)


@torch.library.custom_op("difflpv::propagate_pairs_backward", mutates_args=())
def _propagate_backward(
    total_bar: torch.Tensor, moving_bar: torch.Tensor, states: torch.Tensor, done: torch.Tensor, matrices: torch.Tensor,
    factors: torch.Tensor, transmittance: torch.Tensor, offsets: torch.Tensor, occlude_first_step: bool, keep: int,
    need_matrices: bool, need_factors: bool, need_transmittance: bool,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:  # fmt: skip
    layout = _layout(total_bar)
    steps = _Steps(layout, matrices, factors, transmittance, offsets, occlude_first_step)
    source = layout.pad(total_bar)
    after = last_bar(layout, total_bar, moving_bar, source)
    scratch = [layout.empty(layout.fields, total_bar) for _ in range(2)]
    factor_bar = total_bar.new_zeros(len(factors) * layout.z * layout.y if need_factors else 0)
    pairs = len(transmittance) if need_transmittance else 0
    passed_bar = layout.empty(2 * pairs, total_bar) if pairs else total_bar.new_empty(0)
    partial = total_bar.new_zeros((steps.slabs[0] if need_matrices else 0, 1 + 2 * len(steps.pairs), *matrices.shape[1:]))
    for step, before in steps_back(layout, states, len(factors), int(done), keep, steps.forward):
        if need_matrices and before is not None:
            steps.correlate(after, before, partial, step)
        into = scratch[step % 2]
        steps.adjoint(after, into, source, before, passed_bar, factor_bar, step)
        after = into
    return (
        layout.unpad(after),
        steps.matrices_bar(partial) if need_matrices else total_bar.new_empty(0),
        factor_bar.view(len(factors), layout.z * layout.y).sum(1) if need_factors else total_bar.new_empty(0),
        steps.transmittance_bar(passed_bar) if pairs else total_bar.new_empty(0),
    )


@_propagate_backward.register_fake
def _(
    total_bar, moving_bar, states, done, matrices, factors, transmittance, offsets, occlude_first_step, keep, need_matrices,
    need_factors, need_transmittance,
):  # fmt: skip
    def like(tensor: torch.Tensor, needed: bool) -> torch.Tensor:
        return torch.empty_like(tensor) if needed else total_bar.new_empty(0)

    passed = like(transmittance, need_transmittance and len(transmittance) > 0)
    bar = torch.empty_like(total_bar, memory_format=torch.contiguous_format)
    return bar, like(matrices, need_matrices), like(factors, need_factors), passed


refuse_second_derivative("propagate", _propagate_backward)


def _setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[torch.Tensor, ...]) -> None:
    _, matrices, factors, transmittance, offsets, occlude_first_step, _, keep, *_ = inputs
    _, _, states, done = output
    ctx.mark_non_differentiable(states, done)
    ctx.save_for_backward(states, done, matrices, factors, transmittance, offsets)
    ctx.occlude_first_step, ctx.keep = occlude_first_step, keep


def _backward(
    ctx: Any, total_bar: torch.Tensor, moving_bar: torch.Tensor, *unused: torch.Tensor
) -> tuple[torch.Tensor | None, ...]:
    needs, given = ctx.needs_input_grad[:4], (total_bar.contiguous(), moving_bar.contiguous())
    bars = _propagate_backward(*given, *ctx.saved_tensors, ctx.occlude_first_step, ctx.keep, *needs[1:])
    return (*(bar if need else None for bar, need in zip(bars, needs, strict=True)), *[None] * 6)


_propagate.register_autograd(_backward, setup_context=_setup)


def propagate_pairs(
    volume: torch.Tensor,
    offsets: np.ndarray,
    matrices: torch.Tensor,
    factors: torch.Tensor,
    transmittance: torch.Tensor | None,
    *,
    occlude_first_step: bool,
    tolerance: float,
    checkpoint_every: int | None,
    read_box: Sequence[int] = (),
    moving: bool = False,
) -> tuple[torch.Tensor, torch.Tensor]:
    """``difflpv.propagation`` for a linear stencil on the Warp kernels; validated there, ``factors`` is [steps].

    Returns the accumulated volume and the moving one (empty unless ``moving``).
    """
    passed = volume.new_ones((0, *volume.shape[2:])) if transmittance is None else transmittance
    learned = matrices.requires_grad or factors.requires_grad or passed.requires_grad
    keep = 0
    if torch.is_grad_enabled() and learned and len(factors):
        keep = volumes_between(_layout(volume), volume, len(factors), checkpoint_every)
    return _propagate(
        volume.contiguous(),
        matrices.contiguous(),
        factors.contiguous(),
        passed.contiguous(),
        torch.as_tensor(np.array(offsets), device=volume.device),
        occlude_first_step,
        float(tolerance),
        keep,
        list(read_box),
        moving,
    )[:2]
