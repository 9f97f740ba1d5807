"""How cost grows, what peers need for the same, and what share of this machine's bandwidth and arithmetic a step uses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from difflpv.bench.scenes import BenchScene
from difflpv.bench.settings import BenchSettings
from difflpv.bench.timing import interleaved, peak_bytes
from difflpv.config import LpvConfig
from difflpv.illumination import illuminate
from difflpv.padded import Layout
from difflpv.pipeline import Lpv
from difflpv.propagation import propagate
from difflpv.scene import AreaLight
from difflpv.stencil import LinearStencil
from difflpv.stencil_files import learned_stencil
from warp_kernels.linear_propagation import cpu_lanes

__all__ = ["exponent", "machine_rates", "measure_growth", "measure_step"]

_STENCIL = "learned_9x26"
_STEPS = 8


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Least-squares slope of log cost over log size: 1 is linear growth.

    Raises:
        ValueError: fewer than two sizes, or one that is not positive.
    """
    if len(sizes) < 2 or len(sizes) != len(costs) or min(*sizes, *costs) <= 0:
        got = f"{list(sizes)}, {list(costs)}"
        raise ValueError(f"sizes: expected at least two positive ones with a positive cost each, got {got}")
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def _volume(cells: int, channels: int = 3, coeffs: int = 9) -> torch.Tensor:
    return torch.randn(channels, coeffs, cells, cells, cells, generator=torch.Generator().manual_seed(0))


def _passed(cells: int) -> torch.Tensor:
    return torch.rand(13, cells, cells, cells, generator=torch.Generator().manual_seed(1))


def _solve(cells: int, *, channels: int = 3, steps: int = _STEPS, occluded: bool = True) -> Callable[[], torch.Tensor]:
    volume, passed = _volume(cells, channels), _passed(cells) if occluded else None
    stencil = learned_stencil(_STENCIL)

    def call() -> torch.Tensor:
        with torch.no_grad():
            return propagate(volume, stencil, steps=steps, factor=0.97, transmittance=passed, occlude_first_step=True)

    return call


def measure_growth(bench: BenchScene, settings: BenchSettings) -> list[dict[str, Any]]:
    """Cost against one size at a time: rows of ``what``, ``sizes``, ``seconds`` and the fitted ``exponent``.

    Cells also hold ``volumes``, the peak memory of propagation without gradients in volumes, ``volumes_open``, the same where
    nothing blocks, and ``volumes_buffers``, what two volumes with their halo of one cell come to. Propagation runs on random
    light in every cell, so that nothing is left out as empty.

    Args:
        bench: whose receivers and lights are multiplied.
        settings: sizes.
    """
    largest = settings.growth_cells[-1]
    series: dict[str, dict[int, Callable[[], object]]] = {
        "cells": {n**3: _solve(n) for n in settings.growth_cells},
        "steps": {n: _solve(min(32, largest), steps=n) for n in (4, 8, 16, 32)},
        "channels": {n: _solve(min(32, largest), channels=n) for n in (1, 3, 6, 12)},
        "receivers": _receivers(bench, [n for n in (1_000, 10_000, 100_000, 1_000_000) if n <= settings.most_receivers]),
        "lights": _lights(bench, (1, 4, 16)),
    }
    rows = []
    for what, calls in series.items():
        times = interleaved({str(n): call for n, call in calls.items()}, settings.repeats, patience=settings.patience)
        seconds = [times[str(n)].median for n in calls]
        row: dict[str, Any] = {"what": what, "sizes": list(calls), "seconds": seconds}
        row["exponent"] = exponent(row["sizes"], seconds)
        if what == "cells":
            row["volumes"] = [peak_bytes(call) / (4 * 3 * 9 * n) for n, call in calls.items()]
            opened = [(n, _solve(n, occluded=False)) for n in settings.growth_cells]
            row["volumes_open"] = [peak_bytes(call) / (4 * 3 * 9 * n**3) for n, call in opened]
            row["volumes_buffers"] = [_two_buffers(n) / (3 * 9 * n**3) for n in settings.growth_cells]
        rows.append(row)
    return rows


def _two_buffers(cells: int) -> int:
    layout = Layout.of(torch.empty(3, 9, cells, cells, cells, device="meta"), cpu_lanes(4))
    return 2 * layout.length(layout.fields)


def _receivers(bench: BenchScene, counts: Sequence[int]) -> dict[int, Callable[[], object]]:
    config, grid = LpvConfig(method="learned_9x26", steps=2), bench.grid()
    light, lpv = illuminate(bench.scene, grid, config, bench.component, surface_samples=256, area_samples=8), Lpv(grid, config)
    with torch.no_grad():
        solved = lpv.accumulate(light)
    rng = np.random.default_rng(bench.seed)
    calls: dict[int, Callable[[], object]] = {}
    for count in counts:
        chosen = rng.integers(0, len(bench.position), count)
        seen = light.receivers(bench.position[chosen], bench.normal[chosen])

        def call(seen: Any = seen) -> object:
            with torch.no_grad():
                return lpv.read(solved, seen)

        calls[count] = call
    return calls


def _lights(bench: BenchScene, counts: Sequence[int]) -> dict[int, Callable[[], object]]:
    """Rays, shading and injection for so many samples of the area lights, or copies of the others; no propagation."""
    config, grid = LpvConfig(method="learned_9x26", steps=0), bench.grid(16)
    known = illuminate(bench.scene, grid, config, bench.component, surface_samples=1024, area_samples=16).blocking
    has_area = any(isinstance(light, AreaLight) for light in bench.scene.lights)
    calls: dict[int, Callable[[], object]] = {}
    for count in counts:
        options: dict[str, Any] = {"surface_samples": 1024, "area_samples": 16 * count if has_area else 16}
        scene = bench.scene
        if not has_area:
            scene = type(scene)(scene.name, scene.meshes, scene.lights * count, scene.cameras, scene.grid)

        def call(scene: Any = scene, options: dict[str, Any] = options) -> object:
            light = illuminate(scene, grid, config, bench.component, blocking=known, **options)
            with torch.no_grad():
                return Lpv(grid, config).accumulate(light)

        calls[count] = call
    return calls


def measure_step(settings: BenchSettings, *, compiled: bool = True, cells: int = 32) -> dict[str, Any]:
    """One step of learned_9x26 with occlusion: ours, ``conv3d`` without occlusion, the eager twin, and the twin compiled.

    Args:
        settings: repeats.
        compiled: measure ``torch.compile`` too (it takes a minute to compile).
        cells: along an edge.

    Returns:
        ``seconds`` per step by name, ``ratios`` to ours, ``skipped`` reasons by name, ``flops`` and ``bytes`` of one step.
    """
    from difflpv.bench.peers import compiled_twin, convolution, convolution_weight, eager_twin

    stencil, volume, passed = learned_stencil(_STENCIL), _volume(cells), _passed(cells)
    factors, skipped = torch.full((_STEPS,), 0.97), {}
    weight = convolution_weight(stencil).contiguous(memory_format=torch.channels_last_3d)
    twin = eager_twin(stencil, passed)
    calls: dict[str, Callable[[], object]] = {
        "ours": _solve(cells),
        "ours, without occlusion": lambda: _open(volume, stencil),
        "conv3d (channels_last_3d), without occlusion": lambda: convolution(volume, weight, factors),
        "torch twin, eager": lambda: twin(volume, factors),
    }
    if compiled:
        run, why = compiled_twin(stencil, passed)
        if run is None:
            skipped["torch twin, torch.compile"] = why
        else:
            calls["torch twin, torch.compile"] = lambda: run(volume, factors)
    with torch.no_grad():
        times = interleaved(calls, settings.repeats, patience=settings.patience, few=lambda name: name.startswith("torch"))
    seconds = {name: timing.median / _STEPS for name, timing in times.items()}
    used = sum(int((np.abs(m) > 0).sum()) for m in stencil.matrices)
    field = 4 * cells**3
    return {
        "cells": cells,
        "seconds": seconds,
        "ratios": {name: s / seconds["ours"] for name, s in seconds.items()},
        "skipped": skipped,
        "flops": 2.0 * 3 * used * cells**3,
        # moving light in and out, the total in and out, the transmittance once for all channels
        "bytes": float(field * (4 * 27 + 13)),
    }


def _open(volume: torch.Tensor, stencil: LinearStencil) -> torch.Tensor:
    with torch.no_grad():
        return propagate(volume, stencil, steps=_STEPS, factor=0.97)


def machine_rates(settings: BenchSettings) -> dict[str, float]:
    """What this machine reaches with the threads in use: copy bandwidth [B/s] and float32 multiply-adds [flop/s]."""
    source, target = torch.zeros(2**25), torch.empty(2**25)
    a, b = torch.randn(1536, 1536), torch.randn(1536, 1536)
    times = interleaved({"copy": lambda: target.copy_(source), "fma": lambda: a @ b}, max(3, settings.repeats))
    return {
        "copy_bytes_per_second": 2 * 4 * 2**25 / times["copy"].low,
        "flops_per_second": 2 * 1536**3 / times["fma"].low,
        "threads": float(torch.get_num_threads()),
    }
