"""Padded buffers of the propagation kernels, and the march over steps there and back.

A buffer is flat: rows of cells along x, all fields of a row together. A halo of one cell is zero, so that kernels need no
bounds checks and may read ``lanes`` cells at once. What ends one row begins the next, and so with slices of rows: cell
(x, y, z) of a field lies at ``(((z+1) pitch_y + y+1) fields + field) pitch + x+1`` with ``pitch_y`` = n_y + 1 and ``pitch`` =
ceil(n_x / lanes) lanes + 1, and ``lanes`` spare elements lie at the end. (Rows that start on vector boundaries were slower:
their margins cost more memory than aligned access saves.)

Adjoint of A = sum_i S_i with S_{i+1} = F_i(S_i): G_N = Abar (and the cotangent of S_N, where that is asked for too),
G_i = Abar + (dF_i/dS)^T G_{i+1}, and the volume's gradient is G_0. Volumes are kept only where that derivative or a
learnable of the propagation needs them. Without any a solve holds three: the moving one, the next one, their sum; one whose
steps commute and of which nothing but the sum is asked for, two (``nest``).

On the CPU a step leaves out cells that no light has reached and cells that can no longer reach what is read
(``warp_kernels.row_spans``); ``Spans`` holds what it needs for that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from difflpv.bridge import as_warp

__all__ = [
    "Forward", "Layout", "Spans", "kept_volumes", "last_bar", "march", "nest", "steps_back", "volumes_between",
]  # fmt: skip

_KEEP_ALL_BYTES = 2**30


@dataclass(frozen=True)
class Layout:
    """Padded buffers of one volume shape."""

    channels: int
    coeffs: int
    z: int
    y: int
    x: int
    lanes: int

    @classmethod
    def of(cls, volume: torch.Tensor, cpu_lanes: int) -> Layout:
        """Layout of a volume [C, K, n_z, n_y, n_x]; on CUDA a thread has one cell."""
        channels, coeffs, z, y, x = volume.shape
        return cls(channels, coeffs, z, y, x, 1 if volume.is_cuda else cpu_lanes)

    @property
    def fields(self) -> int:
        """Scalar fields of a volume."""
        return self.channels * self.coeffs

    @property
    def pitch(self) -> int:
        """Elements from one field of a row to the next."""
        return -(-self.x // self.lanes) * self.lanes + 1

    @property
    def pitch_y(self) -> int:
        """Rows from one slice of them to the next."""
        return self.y + 1

    @property
    def rows(self) -> int:
        """Rows of a buffer, those of the halo among them."""
        return (self.z + 2) * self.pitch_y + 1

    def length(self, fields: int) -> int:
        """Elements of a flat buffer of so many fields."""
        return self.rows * fields * self.pitch + self.lanes

    def empty(self, fields: int, like: torch.Tensor) -> torch.Tensor:
        """Zeroed flat buffer of so many padded scalar fields."""
        return torch.zeros(self.length(fields), dtype=like.dtype, device=like.device)

    def view(self, buffer: torch.Tensor, fields: int) -> torch.Tensor:
        """View with the halo, shape [n_z + 2, n_y + 2, fields, pitch + 1]; its ends overlap."""
        row = fields * self.pitch
        return buffer.as_strided(
            (self.z + 2, self.y + 2, fields, self.pitch + 1), (self.pitch_y * row, row, self.pitch, 1)
        )

    def clear_border(self, buffer: torch.Tensor, fields: int) -> None:
        """Zero what a step does not write of a flat buffer: the rows of the halo and the spare end."""
        rows = buffer[: -self.lanes].view(self.rows, -1)
        first, last = rows[: self.pitch_y + 1], rows[-self.pitch_y - 1 :]
        for border in (first, last, rows[:: self.pitch_y], buffer[-self.lanes :]):
            border.zero_()

    def inside(self, buffer: torch.Tensor, fields: int, offset: tuple[int, int, int] = (0, 0, 0)) -> torch.Tensor:
        """View of the cells without halo, shape [fields, n_z, n_y, n_x]; with an offset (x, y, z) of their neighbours there."""
        x, y, z = (1 + step for step in offset)
        window = self.view(buffer, fields)[z : z + self.z, y : y + self.y, :, x : x + self.x]
        return window.permute(2, 0, 1, 3)

    def pad(self, field: torch.Tensor, into: torch.Tensor | None = None) -> torch.Tensor:
        """Flat padded copy of a field [..., n_z, n_y, n_x]."""
        field = field.detach().reshape(-1, self.z, self.y, self.x)
        buffer = self.empty(len(field), field) if into is None else into
        self.inside(buffer, len(field)).copy_(field)
        return buffer

    def unpad(self, buffer: torch.Tensor) -> torch.Tensor:
        """Contiguous volume [C, K, n_z, n_y, n_x] of a flat buffer."""
        inside = self.inside(buffer, self.fields).contiguous()
        return inside.view(self.channels, self.coeffs, self.z, self.y, self.x)


class Spans:
    """Where light is in the buffers of one solve: spans of their rows, and the box that each step has to fill."""

    def __init__(
        self, layout: Layout, like: torch.Tensor, steps: int, read_box: Sequence[int] = (), *, groups: int = 1,
        last_first: bool = False,
    ) -> None:  # fmt: skip
        """Set up.

        Args:
            layout: of the buffers.
            like: gives precision and device.
            steps: of the solve.
            read_box: cells that are read at the end, (z, y, x) as (begin, end) pairs; empty: all.
            groups: channel groups that keep spans of their own.
            last_first: the last step is taken first (``nest``).
        """
        size = np.array([layout.z, layout.y, layout.x])
        box = np.array(read_box, np.int64).reshape(-1, 2) if len(read_box) else np.stack([0 * size, size], 1)
        left = np.arange(steps)[:: 1 if last_first else -1, None, None]  # light goes one cell a step
        needed = np.clip(box + left * np.array([-1, 1]), 0, size[:, None])
        dark = np.zeros((groups, layout.rows, 2), np.int32)
        dark[..., 0] = layout.x
        full = dark.copy()
        slices = full[:, layout.pitch_y : -layout.pitch_y - 1].reshape(groups, layout.z, layout.pitch_y, 2)
        slices[:, :, 1:] = (0, layout.x)
        self.needed = torch.as_tensor(needed.astype(np.int32), device=like.device)
        self._dark, self._full = (torch.as_tensor(spans, device=like.device) for spans in (dark, full))
        self.moved = like.new_zeros(groups * layout.z * layout.y)
        self._of: dict[int, torch.Tensor] = {}
        self._views: dict[int, Any] = {}
        self._constant = [as_warp(self.needed.view(-1)), as_warp(self.moved)]

    def mark_dark(self, buffer: torch.Tensor) -> None:
        """Say that a buffer is zero; of one that nothing was said of, anything may be anywhere."""
        self._keep(buffer, self._dark)

    def arguments(self, moving: torch.Tensor, into: torch.Tensor) -> list[Any]:
        """What a step's kernel takes: ``lit``, ``lit_next``, ``needed``, ``moved``."""
        for buffer in (moving, into):
            if buffer.data_ptr() not in self._of:
                self._keep(buffer, self._full)
        return [self._views[moving.data_ptr()], self._views[into.data_ptr()], *self._constant]

    def _keep(self, buffer: torch.Tensor, spans: torch.Tensor) -> None:
        own = spans.clone()
        self._of[buffer.data_ptr()], self._views[buffer.data_ptr()] = own, as_warp(own.view(-1))


# S_{step+1} from S_step, added onto a total: (moving, into, total, step, spans), the first three flat padded buffers.
Forward = Callable[[torch.Tensor, torch.Tensor, torch.Tensor, int, Spans], None]


def volumes_between(layout: Layout, volume: torch.Tensor, steps: int, checkpoint_every: int | None) -> int:
    """Steps from one kept volume to the next: every step up to 1 GiB, then about the square root of their number."""
    bytes_a_step = layout.length(layout.fields) * volume.element_size()
    return checkpoint_every or (1 if steps * bytes_a_step <= _KEEP_ALL_BYTES else math.isqrt(steps))


def kept_volumes(layout: Layout, like: torch.Tensor, steps: int, keep: int) -> torch.Tensor:
    """Uninitialised memory of every ``keep``-th volume (0: of none), shape [slots, length]."""
    return like.new_empty((-(-steps // keep) if keep else 0, layout.length(layout.fields)))


def march(
    layout: Layout, volume: torch.Tensor, steps: int, keep: int, tolerance: float, forward: Forward, spans: Spans
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, int]:
    """All steps: padded accumulated and moving intensity, the kept volumes, and how many steps were taken."""
    fields = layout.fields
    states = kept_volumes(layout, volume, steps, keep)
    for i, state in enumerate(states):  # zeroing all of it would cost as much as a step
        state.zero_() if i == 0 else layout.clear_border(state, fields)
    scratch = [layout.empty(fields, volume) for _ in range(2 if keep != 1 else 1)]
    for buffer in scratch[0 if keep else 1 :]:  # without kept volumes the first one receives the injected light
        spans.mark_dark(buffer)

    def home(step: int) -> torch.Tensor:
        kept = keep and step < steps and step % keep == 0
        return states[step // keep] if kept else scratch[step % len(scratch)]

    def flux(buffer: torch.Tensor) -> float:
        return float(torch.linalg.vector_norm(layout.inside(buffer, fields)[:: layout.coeffs], ord=1))

    total = layout.pad(volume, into=home(0)).clone()
    injected = flux(home(0)) if tolerance else 0.0
    for step in range(steps):
        if tolerance:
            moving = injected if step == 0 else flux(home(step)) if volume.is_cuda else float(spans.moved.sum())
            if moving <= tolerance * injected:
                return total, home(step), states, step
        forward(home(step), home(step + 1), total, step, spans)
    return total, home(steps), states, steps


def nest(layout: Layout, volume: torch.Tensor, steps: int, nested: Forward, spans: Spans) -> torch.Tensor:
    """All steps of a linear stencil, the last one first: padded accumulated intensity S_0 + F_1 (S_0 + F_2 (S_0 + ..)).

    That is their sum only where the steps commute, as those of one stencil behind one transmittance do, whatever their factors.
    Two buffers instead of three, but no moving volume to keep, to ask for, or to stop at.
    """
    inner, into = layout.pad(volume), layout.empty(layout.fields, volume)
    spans.mark_dark(into)
    injected = volume.reshape(-1)
    for step in reversed(range(steps)):
        nested(inner, into, injected, step, spans)
        inner, into = into, inner
    return inner


def last_bar(layout: Layout, total_bar: torch.Tensor, moving_bar: torch.Tensor, padded: torch.Tensor) -> torch.Tensor:
    """Padded G_N: ``padded``, that of the accumulated volume, with that of the moving one unless this is empty."""
    return layout.pad(total_bar + moving_bar) if moving_bar.numel() else padded


def steps_back(
    layout: Layout, states: torch.Tensor, steps: int, done: int, keep: int, forward: Forward
) -> Iterator[tuple[int, torch.Tensor | None]]:
    """The steps taken, last first, each with the volume before it (None where none were kept), recomputed between kept ones."""
    if not keep:
        yield from ((step, None) for step in reversed(range(done)))
        return
    between = [layout.empty(layout.fields, states) for _ in range(min(keep, steps) - 1)]
    unused, spans = layout.empty(layout.fields, states) if between else states, Spans(layout, states, steps)
    for begin in reversed(range(0, done, keep)):
        count = min(keep, done - begin)
        volumes = [states[begin // keep], *between]
        for i in range(count - 1):
            forward(volumes[i], volumes[i + 1], unused, begin + i, spans)
        for i in reversed(range(count)):
            yield begin + i, volumes[i]
