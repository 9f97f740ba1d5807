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
_DPI = 80
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
    figure = new_figure(4.1 * len(panels) + 1.9, 3.5, dpi=_DPI)
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
    shown = []
    for k, method in enumerate(methods):
        own = [r for r in experiment["readings"] if r["method"] == method]
        x = np.array([r["knob"] for r in own], float)
        y = np.array([np.nan if r[name] is None else r[name] for r in own], float)
        shown.append(y)
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
        axis.set_xscale("log")
    if experiment["categories"]:
        axis.set_xticks(range(len(experiment["categories"])), experiment["categories"], fontsize=8)
    _scale(axis, np.concatenate(shown))


def _scale(axis: Axes, values: np.ndarray) -> None:
    """Logarithmic where values span more than ``_LOG_FROM``; zeros lie on its lower edge."""
    positive = values[np.isfinite(values) & (values > 0)]
    if not len(positive) or positive.max() < _LOG_FROM * positive.min() or (values[np.isfinite(values)] < 0).any():
        axis.set_ylim(bottom=min(0.0, float(np.nanmin(values))) if np.isfinite(values).any() else 0.0)
        return
    axis.set_yscale("log")
    low = max(float(positive.min()), float(positive.max()) * 10**-_DECADES)
    axis.set_ylim(0.7 * low, 1.5 * float(positive.max()))
