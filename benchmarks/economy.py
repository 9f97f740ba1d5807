"""What a solve without gradients saves by doing no more than needed, as ratios measured in one run, and how its cost grows.

    python benchmarks/economy.py [--scenes NAME ...] [--cells 32] [--repeats 7] [--largest 128] [--out docs/economy.md]

Each saving is measured against the same solve without it, in turns; "change" is the largest difference of irradiance at the
receivers over its largest value. One thread, processor time: other work on the machine hardly counts.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from data_gen.receivers import draw_receivers
from difflpv.bench.timing import peak_bytes
from difflpv.config import LpvConfig, grid_for
from difflpv.illumination import Illumination, Receivers, illuminate
from difflpv.io import load_scene
from difflpv.io.atomic import write_text
from difflpv.padded import Spans
from difflpv.pipeline import Lpv
from difflpv.propagation import propagate
from difflpv.stencil_files import learned_stencil

SCENES = ("cornell", "two_rooms_90", "atrium", "planter", "bunny", "diagonal")
METHODS = ("lpv", "holpv", "learned_4x6", "learned_9x26")
_ARGUMENTS = Spans.arguments


def _forgetful(self: Spans, moving: torch.Tensor, into: torch.Tensor) -> list[Any]:
    self._of.clear()  # of an unknown buffer anything may be anywhere
    return _ARGUMENTS(self, moving, into)


@contextmanager
def dark_cells_too() -> Iterator[None]:
    """Steps that take no notice of where light is."""
    Spans.arguments = _forgetful  # type: ignore[method-assign]
    try:
        yield
    finally:
        Spans.arguments = _ARGUMENTS  # type: ignore[method-assign]


@torch.no_grad()
def solve(lpv: Lpv, light: Illumination, receivers: Receivers, *, dark: bool = False, everywhere: bool = False) -> torch.Tensor:
    """Irradiance [n,3]; ``dark`` steps dark cells too, ``everywhere`` those that nobody reads."""
    if not dark:
        return lpv.gather(lpv.accumulate(light, receivers=None if everywhere else receivers), light, receivers)
    with dark_cells_too():
        return lpv.gather(lpv.accumulate(light, receivers=None if everywhere else receivers), light, receivers)


def processor_seconds(calls: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median processor time of calls that take turns, after a round that does not count; other processes leave it alone."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for number in range(-1, repeats):
        for name, call in calls.items():
            begin = time.process_time()
            call()
            if number >= 0:
                times[name].append(time.process_time() - begin)
    return {name: statistics.median(taken) for name, taken in times.items()}


def row(name: str, what: str, with_it: Callable[[], torch.Tensor], without: Callable[[], torch.Tensor], repeats: int) -> str:
    """One saving: time with it over time without, and what it changes."""
    times = processor_seconds({"with": with_it, "without": without}, repeats)
    a, b = with_it(), without()
    change = float((a - b).abs().max() / b.abs().max().clamp_min(1e-30))
    ratio = times["with"] / times["without"]
    line = f"| {what} | {name} | {times['without'] * 1e3:.1f} | {ratio:.2f} | {change:.1g} |"
    print(line, flush=True)
    return line


def savings(names: list[str], cells: int, repeats: int) -> list[str]:
    """A row for every saving on every scene."""
    rows = []
    for name in names:
        scene = load_scene(name)
        grid, component = grid_for(scene, cells), "direct" if name == "diagonal" else "bounce1"
        position, normal, _ = _receivers(scene, grid)
        config = LpvConfig(method="learned_9x26", steps=32)
        light, lpv = illuminate(scene, grid, config, component), Lpv(grid, config)
        every = light.receivers(position, normal)
        near = np.argsort(((position - position[0]) ** 2).sum(1))[:50]
        few = light.receivers(position[near], normal[near])
        at = partial(solve, lpv, light)
        rows.append(row(name, "cells that no light has reached", partial(at, every), partial(at, every, dark=True), repeats))
        for what, asked in (("all receivers", every), ("50 near one", few)):
            what = f"cells that nobody reads, {what}"
            rows.append(row(name, what, partial(at, asked), partial(at, asked, everywhere=True), repeats))
        for tolerance in (1e-30, 1e-3, 1e-2, 0.1):
            stopping = Lpv(grid, LpvConfig(method="learned_9x26", steps=32, tolerance=tolerance))
            what = "tolerance that is never met" if tolerance < 1e-20 else f"tolerance {tolerance:g}"
            rows.append(row(name, what, partial(solve, stopping, light, every), partial(at, every), repeats))
    return rows


def _receivers(scene: Any, grid: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    drawn = draw_receivers(scene, 2000, 0, within=grid)
    return drawn.position.astype(float), drawn.normal.astype(float), drawn.area_weight


def growth(largest: int, repeats: int) -> list[str]:
    """Time of learned_9x26 and learned_4x6 over cells x steps, all of it lit, and the peak memory in volumes."""
    rows = []
    for name in ("learned_4x6", "learned_9x26"):
        stencil, points = learned_stencil(name), []
        coeffs = (stencil.l_max + 1) ** 2
        for n in [n for n in (16, 32, 64, 128) if n <= largest]:
            volume = torch.rand(3, coeffs, n, n, n)
            passed = torch.rand(stencil.pair_count, n, n, n)
            counts = (8, 16, 32) if n <= 64 else (8, 16)
            with torch.no_grad():
                calls = {
                    str(steps): partial(
                        propagate, volume, stencil, steps=steps, transmittance=passed, occlude_first_step=True
                    )
                    for steps in counts
                }
                times = processor_seconds(calls, repeats if n <= 32 else 2)
                whole = peak_bytes(calls[str(counts[0])]) / (4 * volume.numel())
                opened = partial(propagate, volume, stencil, steps=counts[0])
                opened()  # loads its kernel
                lean = peak_bytes(opened) / (4 * volume.numel())
            for steps in counts:
                seconds = times[str(steps)]
                points.append((n**3 * steps, seconds))
                cost = seconds / (n**3 * steps) * 1e9
                memory = f"{lean:.2f} | {whole:.2f}" if steps == counts[0] else " | "
                rows.append(f"| {name} | {n}³ | {steps} | {seconds * 1e3:.1f} | {cost:.1f} | {memory} |")
                print(rows[-1], flush=True)
        x, y = np.log(np.array(points)).T
        rows.append(f"| {name} | all | | exponent {np.polyfit(x, y, 1)[0]:.3f} | | | |")
        print(rows[-1], flush=True)
    return rows


def gradients(cells: int) -> list[str]:
    """What is kept for a backward pass: memory in volumes with and without a gradient of the factors."""
    rows = []
    for name in ("learned_4x6", "learned_9x26"):
        stencil = learned_stencil(name)
        volume = torch.rand(3, (stencil.l_max + 1) ** 2, cells, cells, cells)
        light, factors = volume.clone().requires_grad_(), torch.ones(32, requires_grad=True)
        solves = {
            "no gradient": torch.no_grad()(partial(propagate, volume, stencil, steps=32)),
            "of the light": partial(propagate, light, stencil, steps=32),
            "of the light and the factors": partial(propagate, light, stencil, steps=32, factor=factors),
        }
        for wanted, call in solves.items():
            rows.append(f"| {name} | {wanted} | {peak_bytes(call) / (4 * volume.numel()):.2f} |")
            print(rows[-1], flush=True)
    return rows


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES))
    parser.add_argument("--cells", type=int, default=32)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--largest", type=int, default=128)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    lines = [
        "# The solve does no more than needed", "",
        f"Written by `python benchmarks/economy.py --cells {args.cells} --repeats {args.repeats} --largest {args.largest} "
        "--out docs/economy.md`; one thread, processor time. Ratios are times with the saving over times without, taken in "
        "turns; \"change\" is the largest difference at 2000 receivers over the largest irradiance "
        "(below 1e-6 it is rounding: with a tolerance the steps are added up in another order).", "",
        "## Savings, learned_9x26 with traced occlusion, 32 steps, the whole solve with injection and lookup", "",
        "| saving | scene | without [ms] | with / without | change |", "|---|---|---|---|---|",
        *savings(args.scenes, args.cells, args.repeats), "",
        "## Growth: every cell lit, occlusion in every pair", "",
        "Memory is what a solve holds beyond the injected volume that it is given, its result included: two volumes with a "
        "halo of one cell, for steps that are all alike are summed from the inside out; with occlusion a padded copy of the "
        "transmittance comes on top (3 or 13 numbers a cell, beside 12 or 27 of a volume).", "",
        "| stencil | cells | steps | time [ms] | per cell and step [ns] | memory [volumes] | with occlusion |",
        "|---|---|---|---|---|---|---|", *growth(args.largest, args.repeats), "",
        "## What gradients keep", "",
        "| stencil | gradient, 32 steps | memory of the forward pass [volumes] |", "|---|---|---|", *gradients(args.cells), "",
    ]  # fmt: skip
    if args.out:
        write_text(args.out, "\n".join(lines))


if __name__ == "__main__":
    main()
