"""The ladder of models that a plan climbs, and how much work each is.

A rung is a ``difflpv.bench.configuration.Configuration``: a constant, a volume, or light probes that a volume lights and that
receivers read instead of its cells. Further kinds join as configurations of their own kind beside a judge that can measure them
(``difflpv.planning.race.Judge``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from difflpv.bench.configuration import Configuration, Family
from difflpv.config import LpvConfig, Method
from difflpv.grid import Grid
from difflpv.stencil import LinearStencil

__all__ = ["PLAN_LADDER", "family_of", "work_of"]

_METHODS: tuple[Method, ...] = ("learned_4x6", "learned_9x6", "learned_4x26", "learned_9x26")
_OCCLUSION = {"none": "nothing blocks", "exp": "geometry volume"}


def _rung(method: Method, cells: int, **options: Any) -> Configuration:
    config = LpvConfig(method=method, steps=options.pop("steps", min(cells, 32)), **options)
    parts = [method, f"{cells} cells", f"{config.steps} steps"]
    if config.coarsen_after is not None:
        parts.append(f"two sizes after {config.coarsen_after}")
    if config.occlusion in _OCCLUSION:
        parts.append(_OCCLUSION[config.occlusion])
    if config.lookup != "affine":
        parts.append(f"{config.lookup} lookup")
    family: Family = "learned"
    return Configuration(", ".join(parts), "volume", family, config, cells)


def _probes(count: int, method: Method, cells: int) -> Configuration:
    volume = _rung(method, cells)
    family: Family = "LPV-lit probes"
    return Configuration(f"{count} probes in {volume.name}", "lit probes", family, volume.config, cells, probes=count)


def _ladder() -> tuple[Configuration, ...]:
    rungs = [Configuration("constant", "constant", "constant")]
    for method in _METHODS:
        rungs += [_rung(method, cells) for cells in (8, 16, 24, 32)]
        rungs.append(_rung(method, 48, coarsen_after=10))
    for method in ("learned_9x6", "learned_9x26"):
        rungs += [_rung(method, 32, coarsen_after=10), _rung(method, 64, coarsen_after=10)]
    best: Method = "learned_9x26"
    rungs += [_rung(best, 16, steps=8), _rung(best, 32, steps=16)]
    rungs += [_rung(m, cells, occlusion="none") for m in ("learned_4x6", best) for cells in (16, 32)]
    rungs += [_rung(best, cells, occlusion="exp") for cells in (16, 32)]
    rungs += [_rung(best, 16, lookup="visible"), _rung(best, 32, lookup="visible"), _rung(best, 32, lookup="trilinear")]
    rungs += [_probes(64, best, 16), _probes(512, best, 16), _probes(512, best, 32)]
    return tuple(rungs)


PLAN_LADDER: tuple[Configuration, ...] = _ladder()


def family_of(rung: Configuration) -> tuple[Any, ...]:
    """What rungs share that differ in their cells only: their error falls with the size of a cell.

    Two cell sizes are a family of their own: light that goes on in coarse cells is another approximation, which may do better.
    """
    c = rung.config
    if c is None:
        return (rung.kind,)
    short = c.steps < min(rung.cells or 32, 32)
    return ((rung.kind, rung.probes), c.method, c.occlusion, c.lookup, short, c.coarsen_after is not None)


def work_of(rung: Configuration, grid: Grid) -> float:
    """Products of a solve on ``grid``: cells x steps x products per cell, over all grids; 0 for what solves nothing."""
    config = rung.config
    if config is None:
        return 0.0
    stencil, coeffs = config.stencil, (config.stencil.l_max + 1) ** 2
    products = coeffs**2 * len(stencil.offsets) if isinstance(stencil, LinearStencil) else 2 * coeffs * len(stencil.offsets)
    sizes = [float(g.resolution[0] * g.resolution[1] * g.resolution[2]) for g in config.grids(grid)]
    steps: Sequence[int] = (config.steps,)
    if len(sizes) > 1:
        steps = (config.fine_steps, config.steps - config.fine_steps)
    return products * sum(n * s for n, s in zip(sizes, steps, strict=True))
