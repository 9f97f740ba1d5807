"""Parts of the bench's document that are tables of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["gradient_section", "pay_off_section"]


def pay_off_section(rows: Sequence[Mapping[str, Any]]) -> str:
    """After how many solves fits pay off, as Markdown.

    Args:
        rows: of ``difflpv.bench.payoff.measure_pay_off``.
    """
    if not rows:
        return "No fitted configuration was measured in this run."
    counts = rows[0]["counts"]
    lines = [
        "What a fit costs once, and the number of solves after which it is cheaper than tracing paths at the fitted model's",
        "error each time: (targets + fit) / (paths - solve), lights moved before every solve. In brackets with the set-up of",
        "geometry and receivers paid off too. *never*: paths are cheaper than the solve by itself.",
        "",
        "| scene | model | error before | fitted | targets [s] | fit [s] | equal paths | "
        + " | ".join(f"{n:,} receivers" for n in counts) + " |",
        "|---|---|---|---|---|---|---|" + "---|" * len(counts),
    ]  # fmt: skip
    for row in rows:
        cells = [
            row["scene"], row["configuration"], f"{row['error_before']:.3f}", f"{row['error']:.3f}",
            f"{row['targets_seconds']:.2g}", f"{row['fit_seconds']:.2g}", f"{row['paths']:.0f}",
            *(_solves(*pair) for pair in zip(row["solves"], row["solves_with_setup"], strict=True)),
        ]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([
        *lines, "",
        "The learned stencils themselves belong to no scene: learned_9x26 was trained once, in free space and on random rooms,",
        "in two minutes on one core (`docs/stencils.md`); without a fit there is nothing to be paid off.",
    ])  # fmt: skip


def _solves(solves: float | None, with_setup: float | None) -> str:
    return "never" if solves is None or with_setup is None else f"{_count(solves)} ({_count(with_setup)})"


def _count(value: float) -> str:
    return f"{max(1, round(value)):,}"


def gradient_section(rows: Sequence[Mapping[str, Any]]) -> str:
    """Gradients of ours beside path replay at equal noise, as Markdown.

    Args:
        rows: of ``difflpv.bench.gradients.measure_gradients``.
    """
    if not rows:
        return "No scene of this run has area lights, one bounce and a learned solve that meets 0.2."
    counts = rows[0]["counts"]
    lines = [
        "One forward and backward pass for power and place of the lights, ours (without noise, wrong by its model) against",
        "Mitsuba 3's path replay with as many paths and edges per receiver as make its standard error equal to our error; both",
        "are relative to the length of the true gradient, which is path traced by central differences.",
        "",
        "| scene | configuration | by | our error | error of the truth | replay's samples | replay's bias |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        for part in ("power", "place"):
            own = row[part]
            samples = "not available" if own["samples"] is None else f"{own['samples']:.3g}"
            bias = "" if own["bias"] is None else f"{own['bias']:.3f} ± {own['bias_error']:.3f}"
            cells = [row["scene"], row["configuration"], part, f"{own['error']:.3f}", f"{own['reference_error']:.3f}"]
            lines.append("| " + " | ".join([*cells, samples, bias]) + " |")
    heads = " | ".join(f"{n:,} receivers" for n in counts)
    lines += [
        "",
        "Milliseconds: ours; path replay, and as a ratio to ours; likewise differences of our own path tracer with the same",
        "error by place (a render, and six more for each light).",
        "",
        f"| scene | configuration | paths of differences | {heads} |",
        "|---|---|---|" + "---|" * len(counts),
    ]
    for row in rows:
        cells = [row["scene"], row["configuration"], f"{row['difference_samples']:.3g}"]
        for k, own in enumerate(row["ours"]):
            others = [row[name][k] if row[name] else None for name in ("replay", "differences")]
            cells.append("; ".join([f"{1e3 * own:.3g}", *(_beside(other, own) for other in others)]))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _beside(other: float | None, own: float) -> str:
    return "not available" if other is None else f"{1e3 * other:.3g} ({other / own:.2g} x)"
