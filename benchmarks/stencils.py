"""Data sheets of the shipped stencils: ``python benchmarks/stencils.py`` writes docs/stencils.md and the JSON sheets."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import torch

from difflpv.io.atomic import write_json, write_text
from difflpv.propagation import propagate
from difflpv.stability import negative_share, stability
from difflpv.stencil import LinearStencil, holpv_stencil, lpv_stencil
from difflpv.stencil_files import LEARNED_STENCILS, learned_stencil
from difflpv.symmetry import equivariant_basis, project_equivariant
from difflpv.training.objective import FreeSpaceLoss, Shell, truncation_floor
from difflpv.training.stencils import RUNGS

ROOT = Path(__file__).resolve().parents[1]
PROTOCOL = (Shell(20, 2, 9.5), Shell(30, 9.5, 16), Shell(40, 9.5, 19))
LATE = (Shell(32, 2, 9.5),)
BY_DISTANCE = tuple(Shell(30, near, far) for near, far in ((2, 3.5), (3.5, 5), (5, 7), (7, 9.5), (9.5, 12), (12, 14), (14, 16)))


def free_space(stencil: LinearStencil, neighbors: int, shells: tuple[Shell, ...]) -> list[float]:
    basis = equivariant_basis(stencil.l_max, neighbors)
    matrices = np.tensordot(project_equivariant(stencil, neighbors=neighbors), basis, 1)
    loss = FreeSpaceLoss(stencil.l_max, neighbors, shells, size=21, dtype=torch.float32)
    return loss.errors(torch.tensor(matrices, dtype=torch.float32))


def cost(stencil: LinearStencil, steps: int = 8, repeats: int = 5) -> tuple[float, float]:
    """Milliseconds per step on 32^3 cells, RGB, and of a bare conv3d of the same K, alternating; medians."""
    count = stencil.matrices.shape[1]
    volume, weight = torch.randn(3, count, 32, 32, 32), torch.randn(count, count, 3, 3, 3) / 100
    bare = volume.contiguous(memory_format=torch.channels_last_3d)
    weight = weight.contiguous(memory_format=torch.channels_last_3d)
    ours, theirs = [], []
    with torch.no_grad():
        for _ in range(repeats):
            begin = time.perf_counter()
            propagate(volume, stencil, steps=steps)
            middle = time.perf_counter()
            field = bare
            for _ in range(steps):
                field = torch.nn.functional.conv3d(field, weight, padding=1)
            ours.append((middle - begin) / steps)
            theirs.append((time.perf_counter() - middle) / steps)
    return 1e3 * float(np.median(ours)), 1e3 * float(np.median(theirs))


def sheet(stencil: LinearStencil, neighbors: int) -> dict:
    report, gain = stability(stencil), np.diag(stencil.uniform_gain())
    ms, bare = cost(stencil)
    return {
        "free_numbers": len(equivariant_basis(stencil.l_max, neighbors)) - 1,
        "truncation_floor": truncation_floor(stencil.l_max),
        "errors": {
            f"{s.near:g}..{s.far:g} cells, {s.steps} steps": round(e, 5)
            for s, e in zip(PROTOCOL + LATE, free_space(stencil, neighbors, PROTOCOL + LATE), strict=True)
        },
        "errors_by_distance": {
            f"{s.near:g}..{s.far:g}": round(e, 4)
            for s, e in zip(BY_DISTANCE, free_space(stencil, neighbors, BY_DISTANCE), strict=True)
        },
        "uniform_gain_by_degree": [
            sorted({round(float(g), 4) for g in gain[d * d : (d + 1) ** 2]}) for d in range(stencil.l_max + 1)
        ],
        "spectral_radius": report.radius,
        "worst_wave_vector": report.wave_vector,
        "negative_share": round(negative_share(stencil), 4),
        "ms_per_step": round(ms, 2),
        "conv3d_ms_per_step": round(bare, 2),
    }


def page(sheets: dict[str, dict]) -> str:
    shells = list(next(iter(sheets.values()))["errors"])
    distances = list(next(iter(sheets.values()))["errors_by_distance"])
    lines = [
        "# Data sheets of the stencils",
        "",
        "Written by `python benchmarks/stencils.py`; do not edit. Train one anew with `difflpv train-stencil learned_9x26",
        "--out out/stencils` (2 minutes on a free core; the same bits as the shipped file). What else was tried:",
        "[stencil_trials.md](stencil_trials.md); on scenes: [scenes.md](scenes.md).",
        "",
        "`learned_KxN` has K coefficients and N neighbours. All are linear (the published kernels without their clamp), keep",
        "the flux of a uniform field exactly (l=0 gain 1) and respect the 48 symmetries of the cube.",
        "",
        "## Free space",
        "",
        "Relative L2 error of irradiance, weighted by r², of a cosine emitter in one cell: exact mean over emitter directions,",
        "receiver normals and cells. *Floor* is what degree l_max leaves even with perfect transport: emitter and receiver",
        "are clamped cosines: no linear stencil of that degree can be below it (l_max 3 has that of l_max 2, as A_3 = 0).",
        "",
        "| stencil | free numbers | " + " | ".join(shells) + " | floor |",
        "|---|---|" + "---|" * (len(shells) + 1),
    ]
    for name, s in sheets.items():
        errors = " | ".join(f"{s['errors'][shell]:.3f}" for shell in shells)
        lines.append(f"| {name} | {s['free_numbers']} | {errors} | {s['truncation_floor']:.3f} |")
    lines += ["", "By distance [cells], after 30 steps:", "", "| stencil | " + " | ".join(distances) + " |"]
    lines.append("|---|" + "---|" * len(distances))
    for name, s in sheets.items():
        lines.append(f"| {name} | " + " | ".join(f"{s['errors_by_distance'][d]:.3f}" for d in distances) + " |")
    lines += [
        "",
        "## Rooms",
        "",
        "Gains by degree of receivers with a wall behind them, fitted to 28 path-traced rooms drawn at random, and the",
        "geometric mean error (direct light and one bounce, traced occlusion) of six further rooms without and with them.",
        "",
        "| stencil | gains | rooms not fitted, without | with |",
        "|---|---|---|---|",
    ]
    for name, s in sheets.items():
        if rooms := s.get("rooms"):
            gains = ", ".join(f"{g:.3f}" for g in rooms["gains"])
            lines.append(f"| {name} | {gains} | {rooms['held_out_error_without']:.3f} | {rooms['held_out_error']:.3f} |")
    lines += [
        "",
        "## Stability, positivity, cost",
        "",
        "Spectral radius of the Fourier symbol over all wave vectors and where it is reached; gains of a uniform field by",
        "degree; negative irradiance from a cosine emitter as a share of the positive (2 to 9.5 cells); one step at 32³ cells,",
        "RGB, on one CPU thread, against a bare `conv3d` of the same K in the same run.",
        "",
        "| stencil | radius | at k | gains by degree | negative share | ms per step | times conv3d |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, s in sheets.items():
        k = ", ".join(f"{v:.2f}" for v in s["worst_wave_vector"])
        gains = "; ".join(", ".join(f"{g:g}" for g in degree) for degree in s["uniform_gain_by_degree"])
        ratio = s["ms_per_step"] / s["conv3d_ms_per_step"]
        speed = f"{s['negative_share']:.3f} | {s['ms_per_step']:.1f} | {ratio:.2f}"
        lines.append(f"| {name} | {s['spectral_radius']:.7f} | ({k}) | {gains} | {speed} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    torch.set_num_threads(1)
    sheets = {"lpv": sheet(lpv_stencil().linear_part, 6), "holpv": sheet(holpv_stencil().linear_part, 26)}
    for name in LEARNED_STENCILS:
        sheets[name] = sheet(learned_stencil(name), RUNGS[name].neighbors)
        path = ROOT / "difflpv" / "data" / "stencils" / f"{name}.json"
        known = json.loads(path.read_text())
        write_json(path, {**known, "sheet": sheets[name]})
        sheets[name] = {**sheets[name], "rooms": known["training"]["rooms"]}
    write_text(ROOT / "docs" / "stencils.md", page(sheets))


if __name__ == "__main__":
    main()
