"""Ratios that hold on any machine, and what moved since they were written down."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from difflpv.bench.run import BenchResult

__all__ = ["compare", "ratios", "read_baseline"]

_MOVED = 0.2  # of a ratio: below that it is noise of a shared machine
_REFERENCE = "learned_9x26"


def ratios(result: BenchResult) -> dict[str, float]:
    """Errors, times over those of learned_9x26, memory in volumes, exponents, peers over ours; no time by itself."""
    found: dict[str, float] = {}
    for key in result.scenes:
        own = [p for p in result.points if p.scene == key]
        reference = next((p.seconds for p in own if p.name == _REFERENCE), None)
        for p in own:
            found[f"{key}: error of {p.name}"] = p.error
            if p.seconds and reference:
                found[f"{key}: time of {p.name} / {_REFERENCE}"] = p.seconds / reference
            if p.both and p.seconds:
                found[f"{key}: forward + backward / forward of {p.name}"] = p.both.median / p.seconds
            if p.memory_volumes:
                found[f"{key}: volumes of {p.name}"] = p.memory_volumes
    found |= {f"exponent of {row['what']}": row["exponent"] for row in result.growth}
    found |= {f"step: {name} / ours": value for name, value in result.step.get("ratios", {}).items() if name != "ours"}
    return {name: float(f"{value:.3g}") for name, value in found.items()}


def compare(before: Mapping[str, float], now: Mapping[str, float]) -> list[str]:
    """A line per ratio that moved by more than a fifth, the largest move first; also what came and went."""
    moved = []
    for name in before.keys() & now.keys():
        old, new = before[name], now[name]
        if abs(new - old) > _MOVED * max(abs(old), 1e-9):
            moved.append((abs(new / old - 1) if old else 1.0, f"{name}: {old:g} -> {new:g}"))
    lines = [line for _, line in sorted(moved, reverse=True)]
    return lines + [f"{name}: gone" for name in before.keys() - now.keys()] + [
        f"{name}: new, {now[name]:g}" for name in now.keys() - before.keys()
    ]  # fmt: skip


def read_baseline(path: Path) -> dict[str, float]:
    """The ratios of a file, none if there is no such file.

    Raises:
        ValueError: not a file of ratios.
    """
    if not path.is_file():
        return {}
    try:
        return {str(name): float(value) for name, value in json.loads(path.read_text(encoding="utf-8")).items()}
    except (ValueError, AttributeError, TypeError) as error:
        raise ValueError(f"{path}: not a file of ratios: {' '.join(str(error).split())}") from None
