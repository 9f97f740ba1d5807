"""Training of a stencil: free space by L-BFGS, then rooms; conserving by construction, stable by penalty.

The free numbers are coordinates in the basis of cube-symmetric stencils, less the one direction that the unit l=0 gain fixes.
A run starts from the published kernel (LPV for 6 neighbours, HOLPV for 26) at short range, then reads receivers out to 16
cells after 20, 30 and 34 steps: light must arrive in time and must not come back later. Lit planes (``PlaneLoss``) keep the
errors of single cells from adding up over a wall: without them a wall lights itself with a sixth of its exitance. One round
is up to 10 L-BFGS iterations; after each the state is on the disk, and a run that is cut off goes on to the same bits. Last
come path-traced rooms, for the gains of receivers on walls alone (``difflpv.training.room_loss``). Moving the matrices there
too was tried and does not pay: rooms 5 % better, free space 15 % and the bounce on scenes never seen 20 % worse.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from difflpv.config import Method
from difflpv.io.atomic import atomic_path, write_json
from difflpv.stability import TOLERANCE, stability
from difflpv.stencil import LinearStencil, holpv_stencil, lpv_stencil
from difflpv.stencil_coordinates import StencilCoordinates
from difflpv.stencil_files import load_stencil, save_stencil
from difflpv.training.objective import FreeSpaceLoss, PlaneLoss, Shell, growth_penalty, truncation_floor
from difflpv.training.room_loss import RoomResponse, fit_gains, mean_room_error
from difflpv.training.rooms import traced_room

__all__ = ["RUNGS", "Rung", "TrainingError", "TrainingResult", "train_stencil"]

_FORMAT = 2
_PENALTY_WEIGHT, _MARGIN, _PLANE_WEIGHT = 100.0, 1e-3, 0.5
_ROUND, _HISTORY, _STALL = 10, 40, 1e-4
_ROOMS, _HELD_OUT = 28, 6
_QUICK_MINUTES, _QUICK_ROUNDS, _QUICK_ROOMS = 3.0, 8, 8


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


RUNGS: dict[Method, Rung] = {
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
        rounds: rounds in free space done, of those asked for.
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
    coordinates: StencilCoordinates, wave_vectors: torch.Tensor,
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
    rung: Method,
    *,
    seed: int = 0,
    rounds: int | None = None,
    rooms: int | None = None,
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
        rounds: rounds of 10 L-BFGS iterations in free space; default the rung's own. 0, with ``start``, leaves only rooms.
        rooms: number of rooms for the gains; default 28, 0 for none.
        minutes: stop after the round that exceeds this time; a later call goes on from there.
        out: folder; gets ``<rung>.safetensors``, ``<rung>.json`` (configuration and result), checkpoints, and the rooms'
            targets in ``rooms``.
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
    rounds = (min(kind.rounds, _QUICK_ROUNDS) if quick else kind.rounds) if rounds is None else rounds
    if rounds < (1 if start is None else 0):
        raise TrainingError(f"rounds: expected at least 1, or 0 with a stencil to start from, got {rounds}")
    rooms = (_QUICK_ROOMS if quick else _ROOMS) if rooms is None else rooms
    if rooms < 0:
        raise TrainingError(f"rooms: expected at least 0, got {rooms}")
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
        "start": None if start is None else f"{Path(start).stem} {hashlib.sha256(Path(start).read_bytes()).hexdigest()[:12]}",
        "penalty_weight": _PENALTY_WEIGHT,
        "margin": _MARGIN,
        "plane_weight": _PLANE_WEIGHT,
        "stages": [asdict(stage) for stage in stages],
    }
    with _one_thread():
        return _train(rung, kind, stages, rooms, config, folder, start, resume, minutes, report or (lambda line: None))


def _train(
    rung: Method, kind: Rung, stages: tuple[Stage, ...], rooms: int, config: dict[str, Any], folder: Path,
    start: str | Path | None, resume: bool, minutes: float | None, report: Callable[[str], None],
) -> TrainingResult:  # fmt: skip
    coordinates = StencilCoordinates(kind.l_max, kind.neighbors)
    published = (lpv_stencil if kind.neighbors == 6 else holpv_stencil)(l_max=kind.l_max).linear_part
    first = published if start is None else load_stencil(start)
    z = coordinates.of(first).requires_grad_(True)
    wave_vectors = _wave_vectors(config["seed"])
    saved = _read_checkpoint(folder / f"{rung}.checkpoint", config) if resume else None
    losses: list[float] = list(saved["losses"]) if saved else []
    if saved:
        with torch.no_grad():
            z.copy_(saved["z"])
    deadline, stage_begin, stopped = time.monotonic() + 60 * (math.inf if minutes is None else minutes), 0, False
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
            stopped = time.monotonic() > deadline
        stage_begin += stage.rounds
    finished = len(losses) >= sum(stage.rounds for stage in stages)
    with torch.no_grad():
        matrices = coordinates.matrices(z).numpy()
    last = stages[-1]
    judge = FreeSpaceLoss(kind.l_max, kind.neighbors, last.shells, size=last.size, dtype=torch.float32)
    anchor = coordinates.matrices(coordinates.of(published)).numpy()
    stencil, blended = _stabilized(LinearStencil(rung, coordinates.offsets, matrices, first.lookup_gains), anchor)
    of_rooms = None
    if finished and rooms:
        stencil, of_rooms = _with_gains(stencil, rung, rooms, config["seed"], folder, report)
    found = judge.errors(torch.tensor(stencil.matrices, dtype=torch.float32))
    errors = {f"{s.near:g}..{s.far:g} cells, {s.steps} steps": e for s, e in zip(judge.shells, found, strict=True)}
    save_stencil(folder / f"{rung}.safetensors", stencil)
    result = {
        "rounds_done": len(losses),
        "finished": finished,
        "loss": losses[-1] if losses else None,
        "rooms": of_rooms,
        "errors": errors,
        "truncation_floor": truncation_floor(kind.l_max),
        "blended": blended,
    }
    write_json(folder / f"{rung}.json", {"config": config | {"rooms": rooms}, "training": result})
    return TrainingResult(stencil, len(losses), finished, tuple(losses), errors, blended)


def _with_gains(
    stencil: LinearStencil, rung: Method, rooms: int, seed: int, folder: Path, report: Callable[[str], None]
) -> tuple[LinearStencil, dict[str, Any]]:
    """The stencil with gains fitted to some rooms, and how far that brought others."""
    responses = []
    for index in range(rooms + _HELD_OUT):
        responses.append(RoomResponse.of(traced_room(seed, index, folder / "rooms"), stencil, rung))
        report(f"{rung}: room {index + 1} of {rooms + _HELD_OUT}")
    fitted, judges = responses[:rooms], responses[rooms:]
    gains = fit_gains(fitted, stencil.l_max)
    ones = torch.ones(stencil.l_max + 1)
    found = {
        "gains": list(gains),
        "error": float(mean_room_error(fitted, torch.tensor(gains))),
        "held_out_error": float(mean_room_error(judges, torch.tensor(gains))),
        "held_out_error_without": float(mean_room_error(judges, ones)),
    }
    return LinearStencil(stencil.name, stencil.offsets, stencil.matrices, gains), found


def _stabilized(stencil: LinearStencil, anchor: np.ndarray) -> tuple[LinearStencil, float]:
    """The stencil itself where stable, else the least blend with the published kernel (stable, gain 1) that is."""
    offsets = np.asarray(stencil.offsets)

    def blend(share: float) -> LinearStencil:
        mixed = (1 - share) * stencil.matrices + share * anchor
        center = int(np.flatnonzero((offsets == 0).all(1))[0])
        mixed[center, 0, 0] += 1 - mixed[:, 0, 0].sum()  # the last bits of the gain: exactly 1
        return LinearStencil(stencil.name, offsets, mixed, stencil.lookup_gains)

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
