"""How every figure looks: white ground, quiet axes, a title at the left. matplotlib is imported when one is drawn."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["DPI", "axes_in_row", "new_figure", "png_bytes", "title_axis"]

DPI = 150


def new_figure(width: float, height: float, *, dpi: int = DPI) -> Figure:
    """An empty figure of so many inches, white."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=dpi, layout="constrained", facecolor="white")


def axes_in_row(figure: Figure, count: int, *, sharey: bool = False) -> list[Axes]:
    """Axes side by side: no box, quiet ticks."""
    axes = list(figure.subplots(1, count, sharey=sharey, squeeze=False)[0])
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.spines[["left", "bottom"]].set_color("#777777")
        axis.tick_params(which="both", color="#777777", labelcolor="#444444")
    return axes


def title_axis(axis: Axes, text: str) -> None:
    """A title over the left end of axes."""
    axis.set_title(text, loc="left", fontsize=10.5, fontweight="bold", color="#333333")


def png_bytes(figure: Figure) -> bytes:
    """A figure as a PNG file."""
    target = io.BytesIO()
    figure.savefig(target, format="png", metadata={"Software": ""}, pil_kwargs={"optimize": True})
    return target.getvalue()
