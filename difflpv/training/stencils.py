"""Training of a stencil: L-BFGS on the exact free-space loss, conserving by construction, stable by penalty.

The free numbers are coordinates in the basis of cube-symmetric stencils, less the one direction that the unit l=0 gain fixes.
A run starts from the published kernel (LPV for 6 neighbours, HOLPV for 26) at short range, then reads receivers out to 16
cells after 20, 30 and 34 steps: light must arrive in time and must not come back later. Lit planes (``PlaneLoss``) keep the
errors of single cells from adding up over a wall: without them a wall lights itself with a sixth of its exitance. One round
is up to 10 L-BFGS iterations; after each the state is on the disk, and a run that is cut off goes on to the same bits.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from difflpv.io.atomic import atomic_path, write_json
from difflpv.stability import TOLERANCE, stability
from difflpv.stencil import LinearStencil, holpv_stencil, lpv_stencil
from difflpv.stencil_files import load_stencil, save_stencil
from difflpv.symmetry import equivariant_basis, neighborhood_offsets, project_equivariant
from difflpv.training.objective import FreeSpaceLoss, PlaneLoss, Shell, growth_penalty, truncation_floor

__all__ = ["RUNGS", "Rung", "TrainingError", "TrainingResult", "train_stencil"]

_FORMAT = 1
_PENALTY_WEIGHT, _MARGIN, _PLANE_WEIGHT = 100.0, 1e-3, 0.5
_ROUND, _HISTORY, _STALL = 10, 40, 1e-4
_QUICK_MINUTES = 3.0


class TrainingError(ValueError):
    """A run that can not start or go on: one line naming what, expected and got."""


@dataclass(frozen=True)
class Stage:
    """Rounds of L-BFGS on one set of shells, on an octant of ``size`` cells."""

    rounds: int
    size: int
    shells: tuple[Shell, ...]


@dataclass(frozen=True)
class Rung:
    """A size of stencil: degree, neighbours, and how many rounds it takes."""

    l_max: int
    neighbors: int
    rounds: int


RUNGS = {
    "learned_4x6": Rung(1, 6, 30),
    "learned_9x6": Rung(2, 6, 16),
    "learned_4x26": Rung(1, 26, 30),
    "learned_9x26": Rung(2, 26, 22),
    "learned_16x26": Rung(3, 26, 14),
}


def _stages(rounds: int) -> tuple[Stage, ...]:
    near = Stage(min(8, max(rounds // 4, 1)), 11, (Shell(14, 2, 9.5), Shell(20, 2, 9.5)))
    far = (Shell(20, 2, 9.5), Shell(30, 9.5, 16), Shell(34, 2, 9.5), Shell(34, 0.9, 4))
    return near, Stage(max(rounds - near.rounds, 0), 18, far)


@dataclass(frozen=True, eq=False)
class TrainingResult:
    """Result of ``train_stencil``.

    Attributes:
        stencil: the trained stencil, stable.
        rounds: rounds done, of those asked for.
        finished: False where ``minutes`` ended the run: call again to go on.
        losses: loss after each round.
        errors: relative L2 error in free space by shell, e.g. {"2..9.5 cells, 20 steps": 0.15}.
        blended: share of the published kernel that was mixed in to make the stencil stable; 0 where training sufficed.
    """

    stencil: LinearStencil
    rounds: int
    finished: bool
    losses: tuple[float, ...]
    errors: dict[str, float]
    blended: float


class _Coordinates:
    """Free numbers z of a stencil with l=0 gain 1: A = B (p + N z), N orthonormal and orthogonal to the gain's gradient."""

    def __init__(self, l_max: int, neighbors: int) -> None:
        basis = equivariant_basis(l_max, neighbors)
        gain = basis[:, :, 0, 0].sum(1)
        self.basis = torch.tensor(np.array(basis))  # a copy: the cached one is read-only
        self._point = torch.tensor(gain / (gain @ gain))
        # Householder: the other columns of the reflection that takes gain to an axis are orthogonal to it.
        mirror = gain / np.linalg.norm(gain)
        mirror[0] += np.sign(mirror[0]) or 1.0
        reflection = np.eye(len(gain)) - 2 * np.outer(mirror, mirror) / (mirror @ mirror)
        self._free = torch.tensor(reflection[:, 1:])

    def matrices(self, z: torch.Tensor) -> torch.Tensor:
        return torch.tensordot(self._point + self._free @ z, self.basis, 1)

    def of(self, coordinates: np.ndarray) -> torch.Tensor:
        return self._free.T @ (torch.tensor(coordinates) - self._point)


def _wave_vectors(seed: int) -> torch.Tensor:
    """Where stability is asked for: a lattice, random ones, and long waves, all in the irreducible wedge."""
    rng = np.random.default_rng(seed)
    lattice = np.stack(np.meshgrid(*[np.linspace(0, np.pi, 5)] * 3), -1).reshape(-1, 3)
    k = np.concatenate([lattice, rng.uniform(0, np.pi, (120, 3)), rng.uniform(0, 1, (40, 3))])
    k = np.unique(-np.sort(-k, axis=1), axis=0)
    return torch.tensor(k[np.linalg.norm(k, axis=1) > 0])


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Sums split over threads round differently: one thread gives the same bits on every machine of a kind."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _optimizer(z: torch.Tensor) -> torch.optim.LBFGS:
    return torch.optim.LBFGS(
        [z], max_iter=_ROUND, history_size=_HISTORY, line_search_fn="strong_wolfe", tolerance_grad=0, tolerance_change=0
    )


def _minimize_round(
    z: torch.Tensor, optimizer: torch.optim.LBFGS, loss: FreeSpaceLoss, planes: PlaneLoss | None,
    coordinates: _Coordinates, wave_vectors: torch.Tensor,
) -> float:  # fmt: skip
    def light(matrices: torch.Tensor) -> torch.Tensor:
        found = loss.responses(matrices.float())
        return loss.of(found) + (0.0 if planes is None else planes.of(found[-1]))

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        matrices = coordinates.matrices(z)
        growth = growth_penalty(matrices, loss.neighbors, wave_vectors, margin=_MARGIN)
        value = light(matrices).double() + _PENALTY_WEIGHT * growth
        if not bool(torch.isfinite(value)):  # a trial step so far out that light overflows: the line search turns back
            value = 1e6 + 0.0 * z.sum()
        value.backward()
        return value

    first = optimizer.step(closure)
    assert first is not None
    with torch.no_grad():
        return float(light(coordinates.matrices(z)))


def train_stencil(
    rung: str,
    *,
    seed: int = 0,
    rounds: int | None = None,
    minutes: float | None = None,
    out: str | Path,
    start: str | Path | None = None,
    resume: bool = True,
    quick: bool = False,
    report: Callable[[str], None] | None = None,
) -> TrainingResult:
    """Train one rung of the learned stencils and write it.

    Args:
        rung: a name of ``RUNGS``: learned_<coefficients>x<neighbours>.
        seed: of the wave vectors at which stability is asked for.
        rounds: rounds of 10 L-BFGS iterations; default the rung's own.
        minutes: stop after the round that exceeds this time; a later call goes on from there.
        out: folder; gets ``<rung>.safetensors``, ``<rung>.json`` (configuration and result) and ``<rung>.checkpoint``.
        start: a stencil file to start from, instead of the published kernel at short range.
        resume: go on from a checkpoint in ``out`` if there is one; False starts anew.
        quick: the shape of the result within 3 minutes.
        report: called with a line of progress after each round.

    Raises:
        TrainingError: unknown rung, or a checkpoint of other settings.
        StencilError: ``start`` can not be read.
    """
    if rung not in RUNGS:
        raise TrainingError(f"rung: expected one of {', '.join(RUNGS)}, got {rung!r}")
    kind = RUNGS[rung]
    rounds = (min(kind.rounds, 10) if quick else kind.rounds) if rounds is None else rounds
    if rounds < 1:
        raise TrainingError(f"rounds: expected at least 1, got {rounds}")
    minutes = _QUICK_MINUTES if quick and minutes is None else minutes
    stages = _stages(rounds)
    if start is not None:
        stages = (Stage(rounds, stages[-1].size, stages[-1].shells),)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    config = {
        "format": _FORMAT,
        "rung": rung,
        "seed": seed,
        "rounds": rounds,
        "start": None if start is None else Path(start).stem,
        "penalty_weight": _PENALTY_WEIGHT,
        "margin": _MARGIN,
        "plane_weight": _PLANE_WEIGHT,
        "stages": [asdict(stage) for stage in stages],
    }
    with _one_thread():
        return _train(rung, kind, stages, config, folder, start, resume, minutes, report or (lambda line: None))


def _train(
    rung: str, kind: Rung, stages: tuple[Stage, ...], config: dict[str, Any], folder: Path, start: str | Path | None,
    resume: bool, minutes: float | None, report: Callable[[str], None],
) -> TrainingResult:  # fmt: skip
    coordinates = _Coordinates(kind.l_max, kind.neighbors)
    published = (lpv_stencil if kind.neighbors == 6 else holpv_stencil)(l_max=kind.l_max).linear_part
    first = published if start is None else load_stencil(start)
    z = coordinates.of(project_equivariant(first, neighbors=kind.neighbors)).requires_grad_(True)
    wave_vectors = _wave_vectors(config["seed"])
    saved = _read_checkpoint(folder / f"{rung}.checkpoint", config) if resume else None
    losses: list[float] = list(saved["losses"]) if saved else []
    if saved:
        with torch.no_grad():
            z.copy_(saved["z"])
    begin, stage_begin, stopped = time.monotonic(), 0, False
    for stage in stages:
        if stopped or len(losses) >= stage_begin + stage.rounds:
            stage_begin += stage.rounds
            continue
        loss = FreeSpaceLoss(kind.l_max, kind.neighbors, stage.shells, size=stage.size, dtype=torch.float32)
        patches = stage.size > 12
        planes = PlaneLoss(kind.l_max, size=stage.size, dtype=torch.float32, weight=_PLANE_WEIGHT) if patches else None
        optimizer = _optimizer(z)
        if saved and len(losses) > stage_begin:
            optimizer.load_state_dict(saved["optimizer"])
        while len(losses) < stage_begin + stage.rounds and not stopped:
            losses.append(_minimize_round(z, optimizer, loss, planes, coordinates, wave_vectors))
            if len(losses) > stage_begin + 1 and losses[-1] > (1 - _STALL) * losses[-2]:
                optimizer = _optimizer(z)  # curvature gathered across the kink of the penalty: forget it
            state = {"config": config, "z": z.detach(), "optimizer": optimizer.state_dict(), "losses": losses}
            with atomic_path(folder / f"{rung}.checkpoint") as path:
                torch.save(state, path)
            report(f"{rung}: round {len(losses)} of {config['rounds']}, loss {losses[-1]:.6f}")
            stopped = minutes is not None and time.monotonic() - begin > 60 * minutes
        stage_begin += stage.rounds
    finished = len(losses) >= sum(stage.rounds for stage in stages)
    with torch.no_grad():
        matrices = coordinates.matrices(z).numpy()
    anchor = np.tensordot(project_equivariant(published, neighbors=kind.neighbors), coordinates.basis.numpy(), 1)
    stencil, blended = _stabilized(rung, kind, matrices, anchor)
    judge = FreeSpaceLoss(kind.l_max, kind.neighbors, stages[-1].shells, size=stages[-1].size, dtype=torch.float32)
    found = judge.errors(torch.tensor(stencil.matrices, dtype=torch.float32))
    errors = {f"{s.near:g}..{s.far:g} cells, {s.steps} steps": e for s, e in zip(judge.shells, found, strict=True)}
    save_stencil(folder / f"{rung}.safetensors", stencil)
    result = {
        "rounds_done": len(losses),
        "finished": finished,
        "loss": losses[-1],
        "errors": errors,
        "truncation_floor": truncation_floor(kind.l_max),
        "blended": blended,
    }
    write_json(folder / f"{rung}.json", {"config": config, "training": result})
    return TrainingResult(stencil, len(losses), finished, tuple(losses), errors, blended)


def _stabilized(name: str, kind: Rung, matrices: np.ndarray, anchor: np.ndarray) -> tuple[LinearStencil, float]:
    """The stencil itself where stable, else the least blend with the published kernel (stable, gain 1) that is."""
    offsets = np.array(neighborhood_offsets(kind.neighbors))

    def blend(share: float) -> LinearStencil:
        mixed = (1 - share) * matrices + share * anchor
        center = int(np.flatnonzero((offsets == 0).all(1))[0])
        mixed[center, 0, 0] += 1 - mixed[:, 0, 0].sum()  # the last bits of the gain: exactly 1
        return LinearStencil(name, offsets, mixed)

    share = 0.0
    while share < 1 and stability(blend(share)).radius > 1 + TOLERANCE:
        share = max(0.002, 1.5 * share)
    return blend(min(share, 1.0)), min(share, 1.0)


def _read_checkpoint(path: Path, config: dict[str, Any]) -> dict[str, Any] | None:
    if not path.exists():
        return None
    try:
        saved = torch.load(path, weights_only=True)
        known = saved["config"]
    except Exception as error:  # torch.load raises anything from EOFError to RuntimeError on a damaged file
        raise TrainingError(f"{path}: damaged: {' '.join(str(error).split())}; start anew without resuming") from None
    plain = {**config, "stages": None}
    if {**known, "stages": None} != plain or str(known["stages"]) != str(config["stages"]):
        different = sorted(key for key in config if str(known.get(key)) != str(config[key]))
        raise TrainingError(f"{path}: made with other settings ({', '.join(different)}); choose another folder or start anew")
    return saved
