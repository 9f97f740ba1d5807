"""Propagation of a volume through its grid: all steps in one differentiable op.

``propagate`` picks what is fastest for the stencil: one matrix per neighbour (a learned stencil) runs on the Warp kernels of
``difflpv.linear_propagation``, faces on those of ``difflpv.face_propagation``, with or without clamp and occlusion: their 30
or 54 fluxes are fewer products than dense matrices. A linear stencil without occlusion also runs on torch's ``conv3d`` with
our adjoint (``difflpv.convolution``), which takes 2 to 8 times as long and stays as a peer (benchmarks/propagation.py). All
agree with ``difflpv.reference.propagation``, and a face stencil's linear part runs on any of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch

from difflpv.bridge import check_float, refuse_forward_mode
from difflpv.convolution import propagate_convolution
from difflpv.face_propagation import propagate_faces
from difflpv.linear_propagation import propagate_pairs
from difflpv.stencil import FaceStencil, LinearStencil

__all__ = ["Backend", "propagate", "propagate_moving"]

Backend = Literal["auto", "warp", "conv3d"]


def propagate(
    volume: torch.Tensor,
    stencil: FaceStencil | LinearStencil,
    *,
    steps: int,
    factor: float | torch.Tensor = 1.0,
    transmittance: torch.Tensor | None = None,
    occlude_first_step: bool = False,
    clamp: bool | None = None,
    matrices: torch.Tensor | None = None,
    tolerance: float = 0.0,
    checkpoint_every: int | None = None,
    read_box: Sequence[int] | None = None,
    backend: Backend = "auto",
) -> torch.Tensor:
    """Move light through the grid for ``steps`` steps and add up what passes every cell.

    Args:
        volume: injected intensity [W/sr], shape [C, K, n_z, n_y, n_x], float32 or float64.
        stencil: LPV, HOLPV or a linear stencil; K must be its coefficient count.
        steps: number of steps, >= 0.
        factor: propagation factor p, a number, a 0-d tensor or one per step [steps]. Learnable.
        transmittance: share of the light that passes. Learnable. Face stencils: of each face's flux, at the source cell,
            shape [F, n_z, n_y, n_x] (see ``difflpv.occlusion.transmittance``). Linear stencils: between cells c and c + n,
            both ways, at c, for each of the P pairs n of ``difflpv.stencil.pair_offsets``, shape [P, n_z, n_y, n_x]; what
            stands there for cells c + n outside the grid is ignored.
        occlude_first_step: the publications leave the first step unoccluded (self-shadowing); True occludes it too.
        clamp: negative intensity carries no flux. Default True for face stencils; linear ones have none.
        matrices: learnable replacement [n,K,K] for a linear stencil's matrices.
        tolerance: stop once the moving flux, in cells that can still reach ``read_box``, is below this share of the
            injected flux (0: never). Costs a thousandth of a step; on CUDA a reduction that waits for the device.
        checkpoint_every: keep every n-th volume for the backward pass and recompute between them. Default: every volume
            up to 1 GiB, then about the square root of ``steps``. Nothing is kept where nothing needs it.
        read_box: cells that anything reads afterwards, (z, y, x) as (begin, end) pairs, six integers; what comes out
            elsewhere is not complete and must get no gradient. On the CPU a step leaves out cells that are too far from the
            box for what is left of the steps, as it leaves out cells that no light has reached. Default: all.
        backend: "auto", or force the Warp kernels or, without clamp and occlusion, ``conv3d``.

    Returns:
        Accumulated intensity [W/sr], shape of ``volume``: the sum of S_0 (the injected volume) to S_steps.

    Raises:
        TypeError, ValueError: naming the argument, what was expected and what came.

    Source: Kaplanyan and Dachsbacher 2010, section 4.2; HOLPV thesis sections 3.2.3 and 4.2.
    """
    return _propagate(
        volume, stencil, moving=False, steps=steps, factor=factor, transmittance=transmittance,
        occlude_first_step=occlude_first_step, clamp=clamp, matrices=matrices, tolerance=tolerance,
        checkpoint_every=checkpoint_every, read_box=read_box, backend=backend,
    )[0]  # fmt: skip


def propagate_moving(
    volume: torch.Tensor, stencil: FaceStencil | LinearStencil, *, steps: int, **options: Any
) -> tuple[torch.Tensor, torch.Tensor]:
    """``propagate``, and what still moves afterwards, in one pass; differentiable in both.

    Args:
        volume: as for ``propagate``.
        stencil: as for ``propagate``.
        steps: as for ``propagate``.
        **options: of ``propagate``.

    Returns:
        Accumulated intensity S_0 + .. + S_n and the moving S_n [W/sr], n being the steps taken (``steps``, unless
        ``tolerance`` ended them), each of the shape of ``volume``.
    """
    return _propagate(volume, stencil, moving=True, steps=steps, **options)


def _propagate(
    volume: torch.Tensor, stencil: FaceStencil | LinearStencil, *, moving: bool, steps: int,
    factor: float | torch.Tensor = 1.0, transmittance: torch.Tensor | None = None, occlude_first_step: bool = False,
    clamp: bool | None = None, matrices: torch.Tensor | None = None, tolerance: float = 0.0,
    checkpoint_every: int | None = None, read_box: Sequence[int] | None = None, backend: Backend = "auto",
) -> tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
    check_float("volume", volume)
    if volume.ndim != 5:
        raise ValueError(f"volume: expected shape [C, K, n_z, n_y, n_x], got {list(volume.shape)}")
    if volume.shape[1] != (stencil.l_max + 1) ** 2:
        raise ValueError(
            f"volume: stencil '{stencil.name}' has {(stencil.l_max + 1) ** 2} coefficients, got {volume.shape[1]}"
        )
    if isinstance(steps, bool) or not isinstance(steps, int) or steps < 0:
        raise ValueError(f"steps: expected an integer >= 0, got {steps!r}")
    if checkpoint_every is not None and checkpoint_every < 1:
        raise ValueError(f"checkpoint_every: expected at least 1, got {checkpoint_every}")
    if not tolerance >= 0:
        raise ValueError(f"tolerance: expected a number >= 0, got {tolerance}")
    box = _box(read_box, volume)
    refuse_forward_mode("propagate", volume, transmittance, matrices, factor if isinstance(factor, torch.Tensor) else None)
    factors = _factors(factor, steps, volume)
    if isinstance(stencil, LinearStencil):
        if clamp:
            raise ValueError(f"clamp: stencil '{stencil.name}' is linear, it has none")
        return _linear(
            volume, stencil, matrices, factors, transmittance, occlude_first_step=occlude_first_step, tolerance=tolerance,
            checkpoint_every=checkpoint_every, box=box, backend=backend, moving=moving,
        )  # fmt: skip
    if matrices is not None:
        raise ValueError(f"matrices: only a linear stencil takes them, got a face stencil '{stencil.name}'")
    clamp = True if clamp is None else clamp
    _check_transmittance(transmittance, len(stencil.offsets), volume)
    if backend == "conv3d":
        if transmittance is not None or clamp:
            raise ValueError("backend: conv3d has neither clamp nor occlusion; use 'auto' or 'warp'")
        return _linear(volume, stencil.linear_part, None, factors, None, tolerance=tolerance, backend=backend, moving=moving)
    return propagate_faces(
        volume,
        stencil,
        factors,
        transmittance,
        occlude_first_step=occlude_first_step,
        clamp=clamp,
        tolerance=tolerance,
        checkpoint_every=checkpoint_every,
        read_box=box,
        moving=moving,
    )


def _box(read_box: Sequence[int] | None, volume: torch.Tensor) -> list[int]:
    if read_box is None:
        return []
    box, size = [int(v) for v in read_box], volume.shape[2:]
    if len(box) != 6 or not all(0 <= box[2 * i] <= box[2 * i + 1] <= size[i] for i in range(3)):
        raise ValueError(f"read_box: expected (begin, end) of z, y, x within {list(size)}, got {list(read_box)}")
    return box


def _factors(factor: float | torch.Tensor, steps: int, volume: torch.Tensor) -> torch.Tensor:
    if not isinstance(factor, torch.Tensor):
        factor = torch.tensor(float(factor), dtype=volume.dtype, device=volume.device)
    check_float("factor", factor, like=volume)
    if factor.shape not in ((), (steps,)):
        raise ValueError(f"factor: expected one number or one per step [{steps}], got shape {list(factor.shape)}")
    return factor.expand(steps)


def _check_transmittance(transmittance: torch.Tensor | None, fields: int, volume: torch.Tensor) -> None:
    if transmittance is None:
        return
    check_float("transmittance", transmittance, like=volume)
    expected = (fields, *volume.shape[2:])
    if transmittance.shape != expected:
        raise ValueError(f"transmittance: expected shape {list(expected)}, got {list(transmittance.shape)}")


def _linear(
    volume: torch.Tensor, stencil: LinearStencil, matrices: torch.Tensor | None, factors: torch.Tensor,
    transmittance: torch.Tensor | None, *, occlude_first_step: bool = False, tolerance: float,
    checkpoint_every: int | None = None, box: Sequence[int] = (), backend: Backend, moving: bool,
) -> tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
    if matrices is None:
        matrices = torch.as_tensor(stencil.matrices, dtype=volume.dtype, device=volume.device)
    check_float("matrices", matrices, like=volume)
    if matrices.shape != stencil.matrices.shape:
        raise ValueError(f"matrices: expected shape {list(stencil.matrices.shape)}, got {list(matrices.shape)}")
    if transmittance is not None:
        if stencil.one_way:
            raise ValueError(f"transmittance: stencil '{stencil.name}' lacks the opposite of offset {list(stencil.one_way[0])}")
        _check_transmittance(transmittance, stencil.pair_count, volume)
        if backend == "conv3d":
            raise ValueError("backend: conv3d has no occlusion; use 'auto' or 'warp'")
    if backend == "conv3d":
        return propagate_convolution(volume, stencil.offsets, matrices, factors, tolerance=tolerance, moving=moving)
    return propagate_pairs(
        volume,
        stencil.offsets,
        matrices,
        factors,
        transmittance,
        occlude_first_step=occlude_first_step,
        tolerance=tolerance,
        checkpoint_every=checkpoint_every,
        read_box=box,
        moving=moving,
    )
