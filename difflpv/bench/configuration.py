"""What is measured: methods with their settings, from the cheapest to the dearest. A later method is a few lines here.

A ``kind`` says how it is solved (``difflpv.bench.measure.prepare``), a ``family`` what is drawn alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

from difflpv.config import LpvConfig

__all__ = ["FAMILIES", "LADDER", "Configuration", "Family", "Kind", "chosen"]

Kind = Literal["constant", "volume", "floor", "paths", "mitsuba", "traced probes", "lit probes"]
Family = Literal["constant", "LPV", "HOLPV", "learned", "floor", "path tracer", "Mitsuba 3", "traced probes", "LPV-lit probes"]
FAMILIES: tuple[str, ...] = get_args(Family)


_WANTED: dict[str, tuple[Kind, ...]] = {
    "config": ("volume", "floor", "lit probes"),
    "samples": ("paths", "mitsuba", "traced probes"),
    "probes": ("traced probes", "lit probes"),
}


@dataclass(frozen=True)
class Configuration:
    """One method with its settings.

    Attributes:
        name: unique.
        kind: how it is solved.
        family: what it is drawn and counted with.
        config: the solve, for "volume", "lit probes" and "floor" (which only reads by its lookup).
        cells: along x of the scene's grid; None for the scene's own.
        surface_samples: lit surface samples that start a bounce of area lights.
        area_samples: samples per area light.
        learn: what is tuned to the scene before it is measured, on other receivers than those that judge
            (``difflpv.learnables``); empty for what is taken as it comes.
        samples: paths per receiver for "paths" and "mitsuba", per probe for "traced probes".
        probes: how many at most, on a uniform grid in free space, for "traced probes" and "lit probes".
        published: as in a publication, nothing of this project in it.
        quick: part of a quick run.
    """

    name: str
    kind: Kind
    family: Family
    config: LpvConfig | None = None
    cells: int | None = None
    surface_samples: int = 8192
    area_samples: int = 64
    learn: tuple[str, ...] = ()
    samples: int | None = None
    probes: int | None = None
    published: bool = False
    quick: bool = False

    def __post_init__(self) -> None:
        for name, choices in (("kind", get_args(Kind)), ("family", FAMILIES)):
            if getattr(self, name) not in choices:
                raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {getattr(self, name)!r}")
        for name, kinds in _WANTED.items():
            if (getattr(self, name) is not None) != (self.kind in kinds):
                only = " and ".join(f"'{kind}'" for kind in kinds)
                raise ValueError(f"{name}: expected for {only} only, '{self.name}' is of kind '{self.kind}'")
        if self.kind == "lit probes" and self.config is not None and self.config.stencil.l_max < 2:
            raise ValueError(f"config: expected 9 coefficients or more for probes, '{self.name}' has {self.config.method}")
        if self.probes is not None and self.probes < 1:
            raise ValueError(f"probes: expected at least 1, got {self.probes}")
        if self.cells is not None and self.cells < 3:
            raise ValueError(f"cells: expected at least 3, got {self.cells}")
        if self.samples is not None and (self.samples < 1 or self.samples & (self.samples - 1)):
            raise ValueError(f"samples: expected a power of two, got {self.samples}")

    def to_json(self) -> dict[str, Any]:
        """Plain values: what decides the numbers."""
        named = ("name", "kind", "family", "cells", "surface_samples", "area_samples", "samples", "probes", "published")
        values = {name: getattr(self, name) for name in named}
        return {**values, "learn": list(self.learn), "config": self.config.to_json() if self.config else None}


def _volume(name: str, config: LpvConfig, **options: Any) -> Configuration:
    family: Family = "LPV" if config.method == "lpv" else "HOLPV" if config.method == "holpv" else "learned"
    return Configuration(name, "volume", family, config, **options)


def _learned(neighbors: str = "9x26", **options: Any) -> LpvConfig:
    return LpvConfig(method=f"learned_{neighbors}", **options)  # type: ignore[arg-type]


_TUNED = ("propagation", "occlusion", "sampling_bias")
_FITTED = ("stencil", "occlusion", "lookup_gains")
_OPEN: dict[str, Any] = {"occlusion": "none", "lookup": "trilinear", "deposit": "nearest"}
_FEW: dict[str, Any] = {"surface_samples": 1024, "area_samples": 16}

LADDER: tuple[Configuration, ...] = (
    Configuration("constant", "constant", "constant", quick=True),
    _volume("LPV as published", LpvConfig(method="lpv"), published=True, quick=True),
    _volume("LPV, thesis normalisation", LpvConfig(method="lpv", normalization="thesis"), published=True),
    _volume("LPV, tuned", LpvConfig(method="lpv", occlusion="exp"), learn=_TUNED),
    _volume("HOLPV as published", LpvConfig(method="holpv"), published=True, quick=True),
    _volume("HOLPV, thesis normalisation", LpvConfig(method="holpv", normalization="thesis"), published=True),
    _volume("HOLPV, geometry volume", LpvConfig(method="holpv", occlusion="clamp"), published=True),
    _volume("HOLPV, tuned", LpvConfig(method="holpv", occlusion="exp"), learn=_TUNED),
    _volume("learned_4x6", _learned("4x6")),
    _volume("learned_9x6", _learned("9x6"), quick=True),
    _volume("learned_4x26", _learned("4x26")),
    _volume("learned_9x26", _learned(), quick=True),
    _volume("learned_16x26", _learned("16x26")),
    _volume("learned_9x26, fitted", _learned(), learn=_FITTED),
    _volume("learned_9x26, nothing blocks", _learned(**_OPEN)),
    _volume("learned_9x26, geometry volume", _learned(occlusion="exp")),
    _volume("learned_9x26, two cell sizes", _learned(coarsen_after=10)),
    _volume("learned_9x26, 16 steps", _learned(steps=16)),
    _volume("learned_9x6, 8 cells, 8 steps", _learned("9x6", steps=8), cells=8, **_FEW),
    _volume("learned_9x6, 16 cells, 16 steps", _learned("9x6", steps=16), cells=16, **_FEW, quick=True),
    _volume("learned_9x26, 8 cells, 8 steps", _learned(steps=8), cells=8, **_FEW),
    _volume("learned_9x26, 16 cells, 16 steps", _learned(steps=16), cells=16, **_FEW, quick=True),
    _volume("learned_9x26, 16 cells, 16 steps, fitted", _learned(steps=16), cells=16, learn=_FITTED, **_FEW, quick=True),
    _volume("learned_9x6, few samples", _learned("9x6"), **_FEW),
    _volume("learned_9x26, few samples", _learned(), **_FEW),
    _volume("learned_9x26, 64 cells, two sizes", _learned(coarsen_after=6), cells=64),
    _volume("learned_9x26, 96 cells, two sizes", _learned(steps=40, coarsen_after=8), cells=96),
    Configuration("floor", "floor", "floor", LpvConfig(method="holpv", lookup="affine"), quick=True),
    *(
        Configuration(f"path tracer, {n}", "paths", "path tracer", samples=n, quick=n in (1, 4, 16, 64))
        for n in (1, 4, 16, 64, 256)
    ),
    *(
        Configuration(f"Mitsuba 3, {n}", "mitsuba", "Mitsuba 3", samples=n, quick=n in (1, 4, 16, 64))
        for n in (1, 4, 16, 64, 256)
    ),
    *(
        Configuration(f"probes {n}, path-traced", "traced probes", "traced probes", samples=256, probes=n, quick=n == 64)
        for n in (64, 256)
    ),
    Configuration("probes 64, LPV-lit, 16 cells", "lit probes", "LPV-lit probes", _learned(steps=16), 16, **_FEW, probes=64),
    Configuration("probes 256, LPV-lit", "lit probes", "LPV-lit probes", _learned(), probes=256),
)


def chosen(names: Sequence[str] | None = None, *, quick: bool = False) -> tuple[Configuration, ...]:
    """Rows of the ladder: all, those of a quick run, or those named.

    Raises:
        ValueError: an unknown name.
    """
    if names is None:
        return tuple(c for c in LADDER if c.quick or not quick)
    by_name = {c.name: c for c in LADDER}
    for name in names:
        if name not in by_name:
            raise ValueError(f"configuration: no '{name}', expected names of {', '.join(by_name)}")
    return tuple(by_name[name] for name in names)
