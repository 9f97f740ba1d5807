"""Charts of the bench: error over time, time over the number of receivers, cost over size; as PNG and SVG."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from difflpv.io.png import shrink_png
from difflpv.report.style import axes_in_row, new_figure, png_bytes, title_axis

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "FAMILY_COLORS", "draw_break_even", "draw_error_over_time", "draw_growth", "draw_scanline", "small_png", "svg_text",
]  # fmt: skip

FAMILY_COLORS = {
    "constant": "#777777", "LPV": "#e69f00", "HOLPV": "#d55e00", "learned": "#00795a", "floor": "#333333",
    "path tracer": "#56b4e9", "Mitsuba 3": "#0057a3", "traced probes": "#cc79a7", "LPV-lit probes": "#7a3e9d",
}  # fmt: skip
_MARKERS = {
    "LPV": "s", "HOLPV": "D", "learned": "o", "path tracer": "^", "Mitsuba 3": "v", "traced probes": ">", "LPV-lit probes": "p",
}  # fmt: skip
_DPI = 75
_STEEP = 20  # peak over median of a line that needs a logarithmic axis


def draw_error_over_time(
    points: Sequence[Mapping[str, Any]], front: Sequence[str], *, title: str, noise: float, volumes: Sequence[str] = ()
) -> Figure:
    """Error over the time of a solve with its lookup, both logarithmic.

    Args:
        points: of one scene and component: ``name``, ``family``, ``error``, ``seconds`` (None: a horizontal line).
        front: names on the Pareto front, the fastest first.
        title: over the chart.
        noise: of the truth: errors within the band below it mean nothing.
        volumes: names on the front of volume solves among themselves, the fastest first.
    """
    figure = new_figure(8.2, 4.4, dpi=_DPI)
    axis = axes_in_row(figure, 1)[0]
    by_name = {p["name"]: p for p in points}
    timed = [p for p in points if p["seconds"]]
    lowest = min([noise, *(p["error"] for p in points)])
    axis.axhspan(0.5 * lowest, max(noise, 0.5 * lowest), color="#eeeeee", label="noise of the truth", zorder=0)
    for family, dash in (("constant", ":"), ("floor", "--")):
        for p in (p for p in points if p["family"] == family):
            label = "constant" if family == "constant" else "true SH in the cells"
            axis.axhline(p["error"], color=FAMILY_COLORS[family], linestyle=dash, linewidth=1.2, label=label)
    for names, label, style in (
        (front, "Pareto front", {"color": "#bbbbbb", "linewidth": 5, "solid_capstyle": "round"}),
        (volumes, "front of volume solves", {"color": FAMILY_COLORS["learned"], "linewidth": 1}),
    ):
        line = [by_name[name] for name in names if name in by_name]
        if line:
            x, y = [1e3 * p["seconds"] for p in line], [p["error"] for p in line]
            axis.plot(x, y, zorder=1, label=label, **style)  # type: ignore[arg-type]
    for family, marker in _MARKERS.items():
        own = [p for p in timed if p["family"] == family]
        if own:
            x, y = [1e3 * p["seconds"] for p in own], [p["error"] for p in own]
            axis.plot(x, y, marker, color=FAMILY_COLORS[family], markersize=6, markeredgecolor="white", label=family, zorder=3)
    axis.set(xscale="log", yscale="log", xlabel="time of one solve with its lookup [ms]", ylabel="relative L2 error")
    top = max(p["error"] for p in points)
    axis.set_ylim(0.7 * lowest, 1.3 * top)
    for ticks in (axis.xaxis, axis.yaxis):
        _plain_ticks(ticks)
    title_axis(axis, title)
    figure.legend(frameon=False, fontsize=8, loc="outside right upper")
    return figure


def draw_break_even(even: Mapping[str, Any]) -> Figure:
    """Time over the number of receivers at equal error: ours by what has changed, and path tracers."""
    figure = new_figure(6.4, 4.0, dpi=_DPI)
    axis = axes_in_row(figure, 1)[0]
    counts = even["counts"]
    for (what, seconds), dash in zip(even["ours"].items(), ("-", "--", ":"), strict=True):
        axis.plot(counts, seconds, dash, color=FAMILY_COLORS["learned"], marker="o", markersize=4, label=f"ours, {what}")
    for family, peer in even["peers"].items():
        label = f"{family}, {peer['paths']:.0f} paths"
        axis.plot(counts, peer["seconds"], color=FAMILY_COLORS[family], marker=_MARKERS[family], markersize=5, label=label)
    axis.axvline(even["measured"], color="#bbbbbb", linewidth=1)
    axis.set(xscale="log", yscale="log", xlabel="receivers", ylabel="seconds")
    title_axis(axis, f"{even['scene']}: {even['configuration']}, all at error {even['error']:.3f}")
    axis.legend(frameon=False, fontsize=8)
    return figure


def draw_growth(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Cost over one size at a time, with the fitted exponent."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    figure = new_figure(2.5 * len(rows), 2.7, dpi=_DPI)
    for axis, row in zip(axes_in_row(figure, len(rows)), rows, strict=True):
        axis.plot(row["sizes"], [1e3 * s for s in row["seconds"]], "o-", color=FAMILY_COLORS["learned"], markersize=4)
        axis.set(xscale="log", yscale="log", xlabel=row["what"], ylabel="ms" if row is rows[0] else "")
        if row["sizes"][-1] < 1000:
            axis.xaxis.set_major_locator(FixedLocator(row["sizes"]))
            axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.xaxis.set_minor_locator(NullLocator())
        _plain_ticks(axis.yaxis)
        title_axis(axis, f"exponent {row['exponent']:.2f}")
    return figure


def draw_scanline(row: Mapping[str, Any]) -> Figure:
    """Irradiance along a line: the truth with two standard errors, and predictions by name; logarithmic past a near light."""
    import numpy as np

    figure = new_figure(7.6, 3.6, dpi=_DPI)
    axis = axes_in_row(figure, 1)[0]
    distance, truth = np.array(row["distance"]), np.array(row["truth"])
    # a gap where an object stands on the line
    gaps = np.flatnonzero(np.diff(distance) > 1.5 * np.diff(distance).min()) + 1
    band = 2 * np.array(row["standard_error"])
    x, low, high, middle = (np.insert(v, gaps, np.nan) for v in (distance, truth - band, truth + band, truth))
    axis.fill_between(x, low, high, color="#bbbbbb", linewidth=0, label="path traced, 2 standard errors")
    axis.plot(x, middle, color="black", linewidth=1.6, label="path traced")
    colors = {"LPV": "#e69f00", "HOLPV": "#d55e00", "learned_9x26": "#00795a", "floor": "#56b4e9"}
    for name, values in row["methods"].items():
        family, style = name.split(" ")[0], "--" if name == "floor" else "-"
        label = f"{'true SH in the cells' if name == 'floor' else name}: error {row['errors'][name]:.2f}"
        y = np.insert(np.array(values), gaps, np.nan)
        axis.plot(x, y, style, color=colors[family], linewidth=1.3, label=label)
    axis.set(xlabel="distance along the line [m]", ylabel="irradiance [W/m²]", xlim=(distance.min(), distance.max()))
    if truth.max() > _STEEP * np.median(truth):
        lit = truth[truth > 0]
        axis.set(yscale="log", ylim=(0.3 * float(lit.min()), 3 * float(truth.max())))
        _plain_ticks(axis.yaxis)
    else:
        # what is published may be several times too bright: cut off rather than flatten all others
        top = max(max(v) for name, v in row["methods"].items() if not name.endswith("published"))
        axis.set_ylim(0, 1.6 * max(top, float(truth.max())))
    title_axis(axis, f"{row['scene']}: {row['line']} line")
    figure.legend(frameon=False, fontsize=8, loc="outside right upper")
    return figure


def _plain_ticks(axis: Any) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator

    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(FuncFormatter(lambda value, _: ""))


def small_png(figure: Figure) -> bytes:
    """A figure as a PNG file of few colours."""
    return shrink_png(png_bytes(figure))


def svg_text(figure: Figure) -> str:
    """A figure as an SVG file, the same text for the same figure."""
    import matplotlib

    target = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "difflpv"}):
        figure.savefig(target, format="svg", metadata={"Date": None, "Creator": None})
    return target.getvalue()
