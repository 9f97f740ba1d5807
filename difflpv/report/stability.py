"""Charts of the stress experiments: error, gradient norm and energy along a knob, a panel each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from difflpv.io.png import shrink_png
from difflpv.report.style import axes_in_row, new_figure, png_bytes, title_axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_experiment"]

_COLORS = ("#e69f00", "#d55e00", "#56b4e9", "#0057a3", "#00795a", "#cc79a7", "#777777", "#7fc8a9", "#8c6d1f", "#5b3a8c")
_DASHES = ("-", "--", ":", "-.")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">")
_DPI = 62
_DECADES = 25.0  # between the smallest and the largest value that an axis shows
_LOG_FROM = 20.0  # largest over smallest value from which an axis is logarithmic


def draw_experiment(experiment: Mapping[str, Any]) -> bytes:
    """One experiment as a PNG file of few colours.

    Args:
        experiment: as ``difflpv.stress.results.Experiment.to_json`` gives it.
    """
    readings = experiment["readings"]
    panels = [
        (name, experiment[f"{name}_label"])
        for name in ("error", "gradient", "energy")
        if any(r[name] is not None for r in readings)
    ]
    methods = list(dict.fromkeys(r["method"] for r in readings))
    figure = new_figure(3.5 * len(panels) + 2.0, 3.0, dpi=_DPI)
    axes = axes_in_row(figure, len(panels))
    for axis, (name, label) in zip(axes, panels, strict=True):
        _draw_panel(axis, experiment, methods, name)
        title_axis(axis, label)
        unit = f" [{experiment['unit']}]" if experiment["unit"] else ""
        axis.set_xlabel("" if experiment["categories"] else f"{experiment['knob']}{unit}")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", frameon=False, fontsize=9)
    return shrink_png(png_bytes(figure))


def _draw_panel(axis: Axes, experiment: Mapping[str, Any], methods: Sequence[str], name: str) -> None:
    every = np.array([np.nan if r[name] is None else r[name] for r in experiment["readings"]], float)
    low, high, log = _range(every)
    for k, method in enumerate(methods):
        own = [r for r in experiment["readings"] if r["method"] == method]
        x = np.array([r["knob"] for r in own], float)
        y = np.array([np.nan if r[name] is None else max(r[name], low) for r in own], float)  # zeros lie on the edge
        style: dict[str, Any] = {"color": _COLORS[k % len(_COLORS)], "label": method, "markersize": 4}
        if experiment["categories"]:
            axis.plot(x + 0.08 * (k - (len(methods) - 1) / 2), y, _MARKERS[k % len(_MARKERS)], **style)
        else:
            dash = _DASHES[k // len(_COLORS) if len(methods) > len(_COLORS) else k % 2]
            axis.plot(x, y, dash, marker=_MARKERS[k % len(_MARKERS)], linewidth=1.5, **style)
        # A cross where the library said something: the reader sees where a curve was vouched for.
        told = np.array([bool(r["message"]) for r in own]) & np.isfinite(y)
        if told.any() and not experiment["categories"]:
            axis.plot(x[told], y[told], "x", color="#333333", markersize=7, markeredgewidth=1.0)
    if experiment["log_knob"]:
        _log_knob(axis, sorted({float(r["knob"]) for r in experiment["readings"]}))
    if experiment["categories"]:
        names = [name.replace(" ", "\n") for name in experiment["categories"]]
        axis.set_xticks(range(len(names)), names, fontsize=8)
    if log:
        axis.set_yscale("log")
    axis.set_ylim(low, high)


def _log_knob(axis: Axes, knobs: Sequence[float]) -> None:
    """A logarithmic axis with plain numbers where the knob spans few decades."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    axis.set_xscale("log")
    axis.xaxis.set_minor_locator(NullLocator())
    if knobs[-1] < 1e4 * knobs[0]:
        ticks = [k for i, k in enumerate(knobs) if i == 0 or k > 1.4 * knobs[i - 1]]
        axis.xaxis.set_major_locator(FixedLocator(ticks if len(ticks) < 8 else ticks[::2]))
        axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.2g}" if value < 1 else f"{value:.3g}"))


def _range(values: np.ndarray) -> tuple[float, float, bool]:
    """Lowest and highest shown value, and whether the axis is logarithmic: where values span more than ``_LOG_FROM``."""
    finite = values[np.isfinite(values)]
    positive = finite[finite > 0]
    if not len(positive) or positive.max() < _LOG_FROM * positive.min() or (finite < 0).any():
        high = float(finite.max(initial=0.0))
        return min(0.0, float(finite.min(initial=0.0))), 1.08 * high if high > 0 else 1.0, False
    low = max(float(positive.min()), float(positive.max()) * 10**-_DECADES)
    return 0.6 * low, 1.6 * float(positive.max()), True
