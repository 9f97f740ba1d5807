"""What else was tried on the learned 9x26 stencil: ``python benchmarks/stencil_trials.py`` writes docs/stencil_trials.md.

- a first step of its own: matrices B for the step out of the injected cell, then A as ever. The light is linear in B, so the
  best B is a least-squares problem over the 62 cube-symmetric stencils: no training could find a better one.
- matrices of their own for the first 1 or 4 steps, trained together with all others (``stencil_opening``).
- emitters anywhere in their cell: nearest deposit, and trilinear deposit, which carries the first moment of the position.
- matrices of low rank: each A_n cut to its largest singular values.

Protocol of docs/stencils.md: cosine emitter, random directions, receivers 2 to 9.5 cells away after 20 steps and 9.5 to 16
after 30, random normals, relative L2 weighted by r^2.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from stencil_opening import opening_rows

from difflpv.injection import deposit_lobes
from difflpv.io.atomic import write_text
from difflpv.propagation import propagate
from difflpv.reference.propagation import shift_cells
from difflpv.sh import cosine_lobe
from difflpv.stencil import LinearStencil
from difflpv.stencil_files import learned_stencil
from difflpv.symmetry import equivariant_basis
from difflpv.training.objective import FreeSpaceLoss, Shell

ROOT = Path(__file__).resolve().parents[1]
HALF, EMITTERS, RECEIVERS = 18, 12, 3000
SHELLS = ((2.0, 9.5, 20), (9.5, 16.0, 30))

VERDICT = (
    "- *Planes 8 x*: lit planes weigh 8 times, the nearest cells 3 times, the two shells above twice as much as in training.",
    "- Free space can be had, with one stencil for both shells, and rooms pay for it: longer training lowers both shells and",
    "  raises the error of rooms and scenes. Weighing planes more and stopping early gives rooms and cornell back and makes",
    "  two_rooms_90 a sixth better, but then only the far shell gains.",
    "- Not kept: no trial lowers both shells by a tenth without a loss elsewhere, and by the further rooms, which are what a",
    "  choice may look at, none is better than what is shipped.",
)


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    d = rng.normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


class Receivers:
    """Receivers of one shell around the centre cell; everything that they read is weighted by r^2."""

    def __init__(self, near: float, far: float, seed: int) -> None:
        rng = np.random.default_rng(seed)
        axis = np.arange(-HALF, HALF + 1)
        z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
        cells = np.stack([x, y, z], -1).reshape(-1, 3).astype(float)
        radius = np.linalg.norm(cells, axis=1)
        self.index = rng.choice(np.flatnonzero((radius >= near) & (radius <= far)), RECEIVERS)
        self.cells, self.weight = cells[self.index], radius[self.index] ** 2
        self.normals = directions(rng, RECEIVERS)
        self.lobes = cosine_lobe(-self.normals, 2)

    def truth(self, d: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Irradiance [b,m] of emitters with directions [b,3] at ``offset`` [b,3] from the centre of the centre cell."""
        ray = self.cells[None] - offset[:, None]
        r = np.linalg.norm(ray, axis=-1)
        u = ray / r[..., None]
        cosines = np.maximum((u * d[:, None]).sum(-1), 0) * np.maximum(-(u * self.normals).sum(-1), 0)
        return cosines / (np.pi * r**2) * self.weight

    def read(self, light: torch.Tensor) -> np.ndarray:
        """Irradiance [b,m] in solved volumes [b, 9, z, y, x]."""
        return np.einsum("bkm,mk->bm", light.flatten(2)[:, :, self.index].double().numpy(), self.lobes) * self.weight


def error(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


def injected(d: np.ndarray, offset: np.ndarray, deposit: str) -> torch.Tensor:
    size = 2 * HALF + 1
    cells = torch.tensor(offset + HALF + 0.5)
    amplitude = torch.eye(len(d), dtype=torch.float64) / np.pi  # an emitter per channel
    return deposit_lobes(cells, torch.tensor(d), amplitude, (size,) * 3, l_max=2, deposit=deposit).float()  # type: ignore[arg-type]


def first_step(stencil: LinearStencil, shell: Receivers, steps: int, rng: np.random.Generator) -> float:
    """Error with the best first step, judged on emitters that it was not fitted to."""
    basis = torch.tensor(np.array(equivariant_basis(2, 26)), dtype=torch.float32)
    offsets = [(int(x), int(y), int(z)) for x, y, z in stencil.offsets]

    def moved(light: torch.Tensor, matrices: torch.Tensor) -> torch.Tensor:
        parts = [shift_cells(torch.einsum("ij,bjzyx->bizyx", m, light), n) for m, n in zip(matrices, offsets, strict=True)]
        return propagate(torch.stack(parts).sum(0), stencil, steps=steps - 1)

    def columns(d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What each basis stencil adds, and the truth; the injected cell itself is read by no receiver."""
        light = injected(d, np.zeros_like(d), "nearest")
        found = [shell.read(moved(light, matrices)).ravel() for matrices in basis]
        return np.stack(found, 1), shell.truth(d, np.zeros_like(d)).ravel()

    fit_a, fit_b = columns(directions(rng, EMITTERS))
    best = np.linalg.lstsq(fit_a, fit_b, rcond=None)[0]
    a, b = columns(directions(rng, 4))
    return error(a @ best, b)


def main() -> None:
    torch.set_num_threads(1)
    opening = opening_rows(ROOT / "out" / "benchmarks", SHELLS)
    stencil, rng = learned_stencil("learned_9x26"), np.random.default_rng(0)
    shells = [Receivers(near, far, seed) for seed, (near, far, _) in enumerate(SHELLS)]
    with torch.no_grad():
        d = directions(rng, EMITTERS)
        zero, anywhere = np.zeros((EMITTERS, 3)), rng.uniform(-0.5, 0.5, (EMITTERS, 3))
        rows: list[tuple[str, list[float]]] = []
        for name, offset, deposit in (
            ("as shipped, emitter at the cell's centre", zero, "nearest"),
            ("emitter anywhere in its cell, nearest deposit", anywhere, "nearest"),
            ("emitter anywhere in its cell, trilinear deposit", anywhere, "trilinear"),
        ):
            light = injected(d, offset, deposit)
            rows.append((name, [
                error(shell.read(propagate(light, stencil, steps=steps)), shell.truth(d, offset))
                for shell, (_, _, steps) in zip(shells, SHELLS, strict=True)
            ]))  # fmt: skip
        rows.append(("the best first step of its own", [
            first_step(stencil, shell, steps, rng) for shell, (_, _, steps) in zip(shells, SHELLS, strict=True)
        ]))  # fmt: skip
        loss = FreeSpaceLoss(2, 26, tuple(Shell(steps, near, far) for near, far, steps in SHELLS), size=18, dtype=torch.float32)
        u, s, v = np.linalg.svd(stencil.matrices)
        for rank in (7, 6, 5, 4):
            cut = (u[:, :, :rank] * s[:, None, :rank]) @ v[:, :rank]
            rows.append((f"matrices of rank {rank} of 9", loss.errors(torch.tensor(cut, dtype=torch.float32))))
    lines = [
        "# What else was tried on learned_9x26",
        "",
        "Written by `python benchmarks/stencil_trials.py` (10 minutes); do not edit. Free space, protocol of",
        "[stencils.md](stencils.md), sampled: 12 emitters, 3,000 receivers a shell.",
        "",
        "| trial | 2..9.5 cells, 20 steps | 9.5..16 cells, 30 steps |",
        "|---|---|---|",
        *(f"| {name} | " + " | ".join(f"{e:.3f}" for e in errors) + " |" for name, errors in rows),
        "",
        "- *Sub-cell positions*: a trilinear deposit carries the first moment of the emitter's position and takes back all",
        "  that the nearest cell loses. Kept: it is what `deposit=\"visible\"` does with the cells that a VPL sees.",
        "- *A first step of its own*: the best one, fitted to each shell alone, helps little nearby and a quarter at",
        "  distance. Trained together with all other steps it gains more: see below.",
        "- *Low rank*: the matrices use all of their rank. Not kept.",
        "- *Two cell sizes* (`--coarsen-after`): kept; [scenes.md](scenes.md) has the rows.",
        "",
        "## Matrices of their own for the first steps",
        "",
        "The first steps out of the injected cell and all later ones, trained together from the shipped stencil, without any",
        "cost in a solve. Free space exactly as in [stencils.md](stencils.md); gains of receivers refitted to the 28 rooms of",
        "the training. *Further rooms* and the four scenes are fitted by nothing (32 steps, scenes as in",
        "[scenes.md](scenes.md); their targets are those of `scenes.py`). *Norm*: the largest 2-norm of the symbols of first",
        "and later steps; *radius*: spectral radius of the later ones.",
        "",
        "| first steps of their own | 2..9.5 | 9.5..16 | rooms | further rooms | cornell direct | bounce1 "
        "| two_rooms_90 direct | bounce1 | atrium bounce1 | planter bounce1 | norm | radius |",
        "|---|" + 12 * "---|",
        *opening,
        "",
        *VERDICT,
        "",
    ]
    print("\n".join(lines))
    write_text(ROOT / "docs" / "stencil_trials.md", "\n".join(lines))


if __name__ == "__main__":
    main()
