"""Charts of placed probes: error against their number, a line for each method, a panel for each scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from difflpv.io.png import shrink_png
from difflpv.report.style import axes_in_row, new_figure, png_bytes, title_axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Curve", "draw_curves"]

_OURS = ("#d55e00", "#00795a", "#cc79a7")
_OTHERS = ("#333333", "#888888", "#e69f00", "#b38600", "#0057a3", "#56b4e9", "#8c6d1f", "#5b3a8c", "#7fc8a9", "#b5b5b5")
_MARKERS = ("o", "s", "^", "v", "D", "P", "X", "<", ">", "p")
_DPI = 80
_PANEL = 3.1  # inches
_LEGEND = 2.4  # of a column of the legend
_ROOM = (0.85, 1.15)  # below and above all values

Curve = Mapping[int, Sequence[tuple[float, float]]]
"""Of one method: number of probes asked for -> (number placed, value) of each seed."""


def draw_curves(
    panels: Mapping[str, Mapping[str, Curve]],
    *,
    quantity: str,
    ours: Sequence[str] = (),
    floors: Mapping[str, float] | None = None,
) -> bytes:
    """A PNG: value over the number of probes, both logarithmic; the line is the mean of the seeds, the band their range.

    Args:
        panels: of each scene, the curve of each method by name. A method has one colour everywhere.
        quantity: what the values are, the label of the vertical axis.
        ours: names of methods that are drawn thick.
        floors: of each scene, a value below which nothing can be told (the noise of the truth); drawn where it is near.

    Raises:
        ValueError: a panel without a curve, or a value that has no logarithm.
    """
    names = list(dict.fromkeys(name for curves in panels.values() for name in curves))
    for scene, curves in panels.items():
        values = [v for curve in curves.values() for runs in curve.values() for placed, value in runs for v in (placed, value)]
        if not values or not min(values) > 0:
            raise ValueError(f"curves of {scene}: expected at least one, and numbers above 0, got {values[:4]}")
    if not panels:
        raise ValueError("curves: expected at least one scene")
    others = [name for name in names if name not in ours]
    style = {name: (_OTHERS[k % len(_OTHERS)], _MARKERS[k % len(_MARKERS)], 1.3) for k, name in enumerate(others)}
    style |= {name: (_OURS[k % len(_OURS)], "*", 2.8) for k, name in enumerate(name for name in names if name in ours)}
    figure = new_figure(_PANEL * len(panels), 4.3, dpi=_DPI)
    for axis, (scene, curves) in zip(axes_in_row(figure, len(panels)), panels.items(), strict=True):
        for name, curve in curves.items():
            _draw(axis, name, curve, *style[name])
        values = [value for curve in curves.values() for runs in curve.values() for _, value in runs]
        bottom, top = _ROOM[0] * min(values), _ROOM[1] * max(values)
        axis.set(xscale="log", yscale="log", xlabel="probes", ylim=(bottom, top))
        if floors and bottom < floors.get(scene, 0) < top:
            axis.axhline(floors[scene], color="#999999", linestyle=":", linewidth=1.2, label="noise of the truth")
        _ticks(axis, sorted({count for curve in curves.values() for count in curve}))
        title_axis(axis, scene)
    figure.axes[0].set_ylabel(quantity)
    found = {label: handle for axis in figure.axes for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    columns = max(1, int(_PANEL * len(panels) / _LEGEND))
    figure.legend(found.values(), found.keys(), frameon=False, fontsize=8.5, loc="outside lower center", ncols=columns)
    return shrink_png(png_bytes(figure), colors=64)


def _draw(axis: Axes, name: str, curve: Curve, color: str, marker: str, width: float) -> None:
    counts = sorted(curve)
    x = [float(np.mean([placed for placed, _ in curve[count]])) for count in counts]
    values = [np.array([value for _, value in curve[count]]) for count in counts]
    y = [float(v.mean()) for v in values]
    size = 11 if marker == "*" else 5
    axis.plot(x, y, color=color, marker=marker, markersize=size, markeredgecolor="white", linewidth=width, label=name)
    if max(map(len, values)) > 1:
        axis.fill_between(x, [v.min() for v in values], [v.max() for v in values], color=color, alpha=0.2, linewidth=0)


def _ticks(axis: Axes, counts: Sequence[int]) -> None:
    from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullLocator

    axis.xaxis.set_major_locator(FixedLocator(list(counts)))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_locator(NullLocator())
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.yaxis.set_minor_locator(NullLocator())
