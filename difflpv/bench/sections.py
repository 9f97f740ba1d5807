"""Parts of the bench's document that are tables of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["pay_off_section"]


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
