"""Figures as PNG bytes, on a white ground of their own, so that they read the same on a light and on a dark page.

matplotlib is imported when the first figure is drawn, and its global state is left alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from difflpv.io.png import auto_exposure, tone_map
from difflpv.report.style import DPI, axes_in_row, new_figure, png_bytes, title_axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_convergence", "draw_factors", "draw_lights", "draw_renders"]

_CELL = 2.35  # width of a picture [inches]
_SIGNED = "RdBu_r"
_ERROR_RANGE = 2.0  # of the error maps, in means of the path-traced image
# Okabe and Ito's palette, which colour-blind readers can tell apart: one hue per method, nlopt lighter and dashed.
_COLORS = {
    "constant": "#777777",
    "floor": "#222222",
    "LPV": "#e69f00",
    "LPV fitted": "#d55e00",
    "LPV nlopt": "#eda57c",
    "HOLPV": "#56b4e9",
    "HOLPV fitted": "#0057a3",
    "HOLPV nlopt": "#8ab6d8",
    "learned_9x26": "#7fc8a9",
    "learned_9x26 fitted": "#00795a",
}
_MARKERS = {"constant": "_", "LPV": "s", "LPV fitted": "s", "HOLPV": "o", "HOLPV fitted": "o"}
_MARKERS |= {"learned_9x26": "D", "learned_9x26 fitted": "D", "floor": "_"}
_TICKS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
_MORE_TICKS = (0.03, 0.04, 0.06, 0.08, 0.15, 0.3, 0.4, 0.6, 0.7, 0.8, 1.2, 1.5, 3.0, 4.0)


def draw_renders(
    truth: np.ndarray,
    predicted: Mapping[str, np.ndarray],
    hit: np.ndarray,
    captions: Mapping[str, str],
    *,
    dpi: int = DPI,
) -> bytes:
    """The path-traced image beside predictions, all under its exposure, and the signed error beneath each prediction.

    Args:
        truth: path traced, linear [H,W,3].
        predicted: linear [H,W,3] by name.
        hit: pixels that see a surface, [H,W] bool; the others are masked in the error maps.
        captions: a line beneath each error map.
        dpi: pixels per inch; a picture is 2.35 inches wide.
    """
    from matplotlib.colors import Normalize

    exposure = auto_exposure(truth[hit][None]) if hit.any() else 0.0
    mean = float(truth[hit].mean()) if hit.any() else 0.0
    height, width = hit.shape
    columns = 1 + len(predicted)
    figure = new_figure(_CELL * columns, 2 * 0.97 * _CELL * height / width + 0.7, dpi=dpi)
    axes = figure.subplots(2, columns, squeeze=False)
    for axis in axes.ravel():
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
    for axis, name, image in zip(axes[0], ["path traced", *predicted], [truth, *predicted.values()], strict=True):
        axis.imshow(tone_map(image, exposure=exposure), interpolation="lanczos")
        axis.set_title(name, fontsize=11)
    scale = Normalize(-_ERROR_RANGE, _ERROR_RANGE)
    for axis, (name, image) in zip(axes[1, 1:], predicted.items(), strict=True):
        error = np.ma.masked_array((image - truth).mean(2) / (mean or 1.0), mask=~hit)
        axis.set_facecolor("#b8b8b8")
        axis.imshow(error, cmap=_SIGNED, norm=scale, interpolation="nearest")
        axis.set_xlabel(captions.get(name, ""), fontsize=10)
    _color_bar(axes[1, 0], scale, height / width)
    return png_bytes(figure)


def _color_bar(axis: Axes, scale: Any, aspect: float) -> None:
    """The error maps' key, in the free cell beneath the path-traced image."""
    from matplotlib.cm import ScalarMappable

    axis.set_box_aspect(aspect)
    axis.text(0.5, 0.74, "error of each pixel", ha="center", fontsize=10.5, fontweight="bold", color="#333333")
    axis.text(0.06, 0.62, "too dark", ha="left", fontsize=9.5, color="#333333")
    axis.text(0.94, 0.62, "too bright", ha="right", fontsize=9.5, color="#333333")
    bar = axis.figure.colorbar(
        ScalarMappable(scale, _SIGNED), cax=axis.inset_axes((0.06, 0.5, 0.88, 0.08)), orientation="horizontal", extend="both"
    )
    ticks = [share * _ERROR_RANGE for share in (-1, -0.5, 0, 0.5, 1)]
    bar.set_ticks(ticks, labels=[f"{tick:g}".replace("-", "−") for tick in ticks])
    bar.ax.tick_params(labelsize=9.5)
    axis.text(0.5, 0.2, "times the mean of\nthe path-traced image", ha="center", fontsize=9.5, color="#333333")


def draw_convergence(fits: Mapping[str, Mapping[str, Any]], constant: float) -> bytes:
    """Best loss so far against forward-equivalents and against seconds; a dot for every evaluation.

    Args:
        fits: by name; ``history`` has rows of (forward-equivalents, seconds, loss), ``solver`` names who searched.
        constant: loss of the constant prediction.
    """
    figure = new_figure(11.0, 4.6)
    axes = axes_in_row(figure, 2, sharey=True)
    losses = [row[2] for fit in fits.values() for row in fit["history"] if row[2] is not None]
    best, start = min(losses, default=constant), max((f["history"][0][2] or constant for f in fits.values()), default=constant)
    low, high = 0.93 * min(best, constant), 1.35 * max(start, constant)
    for axis, column, label in ((axes[0], 0, "forward-equivalents (a solve of all train lights = 1)"), (axes[1], 1, "seconds")):
        ends = []
        for name, fit in fits.items():
            rows = np.array([[r[0], r[1], np.nan if r[2] is None else r[2]] for r in fit["history"]], float)
            x, y = rows[:, column], rows[:, 2]
            running = np.minimum.accumulate(np.where(np.isnan(y), np.inf, y))
            color = _COLORS.get(name, "#333333")
            nlopt = fit["solver"].startswith("nlopt")
            axis.plot(x, np.clip(y, low, high), ".", color=color, alpha=0.45, markersize=5, clip_on=False)
            axis.step(x, running, where="post", color=color, linewidth=1.4 if nlopt else 2.2, linestyle="--" if nlopt else "-")
            ends.append((x[-1], running[-1], f"{name.replace(' fitted', '').replace(' nlopt', '')}, {fit['solver']}", color))
        axis.axhline(constant, color=_COLORS["constant"], linewidth=1, linestyle=":")
        axis.set_yscale("log")
        axis.set_ylim(low, high)
        axis.set_xlim(left=0)
        widest = max((e[0] for e in ends), default=1.0)
        axis.set_xlim(0, 1.42 * widest)
        axis.text(1.41 * widest, constant, "constant", color=_COLORS["constant"], fontsize=8.5, ha="right", va="bottom")
        _label_ends(axis, ends, low, high, gap=0.02 * widest)
        axis.set_xlabel(label)
    _loss_ticks(axes[0], low, high)
    axes[0].set_ylabel("mean relative L2 of the train lights")
    title_axis(axes[0], "by work")
    title_axis(axes[1], "by time on this machine")
    return png_bytes(figure)


def draw_lights(scores: Sequence[Mapping[str, Any]], train: Sequence[int], test: Sequence[int], noise: float) -> bytes:
    """Error under each light, a column per light, train and test apart.

    Args:
        scores: with ``method``, ``light`` and ``relative_l2``.
        train: light sets learned from.
        test: light sets judged on.
        noise: relative L2 error of a perfect prediction, from the targets' own noise.
    """
    figure = new_figure(9.5, 4.4)
    (axis,) = axes_in_row(figure, 1)
    order = [*train, *test]
    ends = []
    methods = [m for m in _MARKERS if any(s["method"] == m for s in scores)]
    for k, method in enumerate(methods):
        by_light = {s["light"]: s["relative_l2"] for s in scores if s["method"] == method}
        y = [by_light[light] for light in order]
        x = np.arange(len(order)) + 0.09 * (k - (len(methods) - 1) / 2)
        bar = method in ("constant", "floor")
        filled = bar or method.endswith("fitted")
        axis.plot(
            x,
            y,
            _MARKERS[method],
            color=_COLORS[method],
            markersize=13 if bar else 7,
            markeredgewidth=2.4 if bar else 1.6,
            markerfacecolor=_COLORS[method] if filled else "white",
        )
        ends.append((len(order) - 0.55, y[-1], method, _COLORS[method]))
    values = [s["relative_l2"] for s in scores if s["method"] in methods]
    low, high = 0.8 * min([noise or min(values), *values]), 1.25 * max(values)
    axis.set_yscale("log")
    axis.set_ylim(low, high)
    axis.set_xlim(-0.6, len(order) + 0.75)
    axis.axvspan(len(train) - 0.5, len(order) - 0.5, color="#f1f1f1", zorder=0)
    for x0, text in ((-0.45, "train lights"), (len(train) - 0.42, "test lights")):
        axis.text(x0, high * 0.97, text, va="top", fontsize=10, fontweight="bold", color="#333333")
    if noise > 0:
        axis.axhline(noise, color="#777777", linewidth=1, linestyle=":")
        axis.text(-0.55, noise * 1.03, "noise of the targets", color="#777777", fontsize=8.5, va="bottom")
    _label_ends(axis, ends, low, high, gap=0.08)
    axis.set_xticks(range(len(order)), [str(k) for k in order])
    axis.set_xlabel("light set")
    axis.set_ylabel("relative L2 of irradiance")
    _loss_ticks(axis, low, high)
    return png_bytes(figure)


def draw_factors(factors: Mapping[str, Sequence[float]]) -> bytes:
    """Per-step propagation factors, and their running product: how much the light counts that has gone n steps.

    Args:
        factors: a factor per step, by name.
    """
    from matplotlib.ticker import LogLocator, NullLocator

    figure = new_figure(11.0, 3.6)
    left, right = axes_in_row(figure, 2)
    products = {name: np.cumprod(np.maximum(values, 1e-12)) for name, values in factors.items()}
    count = max(len(values) for values in factors.values())
    for axis, curves, title in ((left, factors, "factor of each step"), (right, products, "product of the factors so far")):
        for name, values in curves.items():
            axis.plot(np.arange(1, len(values) + 1), values, color=_COLORS.get(name, "#333333"), linewidth=2)
        axis.plot([0, count], [1, 1], color="#777777", linewidth=1, linestyle=":")
        axis.set_xlim(0, 1.3 * count)
        axis.set_xlabel("propagation step")
        title_axis(axis, title)
    left.set_ylim(0, 1.12 * max(1.0, *(max(v) for v in factors.values())))
    right.set_yscale("log")
    every = np.concatenate([*products.values(), np.ones(1)])
    right.set_ylim(0.3 * every.min(), 3.0 * every.max())
    right.yaxis.set_major_locator(LogLocator())
    right.yaxis.set_minor_locator(NullLocator())
    for axis, curves in ((left, factors), (right, products)):
        ends = [(len(v), float(v[-1]), name, _COLORS.get(name, "#333333")) for name, v in curves.items()]
        ends.append((count, 1.0, "as published", "#777777"))
        _label_ends(axis, ends, *axis.get_ylim(), gap=0.02 * count, log=axis is right)
    return png_bytes(figure)


def _label_ends(
    axis: Axes, ends: Iterable[tuple[float, float, str, str]], low: float, high: float, *, gap: float, log: bool = True
) -> None:
    """Name curves at their right ends, moved apart where they would overlap."""
    scale = np.log if log else np.asarray
    bottom, top = float(scale(low)), float(scale(high))
    placed = sorted(ends, key=lambda e: e[1])
    heights = [min(max((float(scale(max(e[1], low))) - bottom) / (top - bottom), 0.02), 0.98) for e in placed]
    least = 0.055
    for i in range(1, len(heights)):
        heights[i] = max(heights[i], heights[i - 1] + least)
    overflow = max(heights[-1] - 0.98, 0.0) if heights else 0.0
    for (x, _, text, color), height in zip(placed, heights, strict=True):
        axis.text(
            x + gap,
            height - overflow,
            text,
            color=color,
            va="center",
            fontsize=9,
            fontweight="bold",
            transform=axis.get_xaxis_transform(),  # x in data, y as a share of the axes
        )


def _loss_ticks(axis: Axes, low: float, high: float) -> None:
    """Plain numbers on a logarithmic axis."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    ticks = _TICKS if high > 10 * low else sorted(_TICKS + _MORE_TICKS)
    axis.yaxis.set_major_locator(FixedLocator([t for t in ticks if low <= t <= high]))
    axis.yaxis.set_minor_locator(NullLocator())
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
