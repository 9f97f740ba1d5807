"""Tone-mapped PNG previews of linear images."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image

from difflpv.io.atomic import atomic_path
from difflpv.io.srgb import linear_to_srgb

__all__ = ["auto_exposure", "shrink_png", "tone_map", "write_png"]


def auto_exposure(rgb: np.ndarray, *, percentile: float = 98.0) -> float:
    """Exposure in stops that puts ``percentile`` of the pixels' largest channel at white; 0 for a black image.

    Compare images under one exposure: take it from the target and hand it to each prediction.
    """
    level = float(np.percentile(np.asarray(rgb, np.float64).max(axis=-1), percentile))
    return float(-np.log2(level)) if np.isfinite(level) and level > 0 else 0.0


def tone_map(rgb: np.ndarray, *, exposure: float = 0.0) -> np.ndarray:
    """8-bit sRGB of a linear image [H,W,3]: times 2^``exposure``, clipped, encoded.

    Raises:
        ValueError: wrong shape, or a pixel that is not finite.
    """
    rgb = np.asarray(rgb, np.float64)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or not rgb.size:
        raise ValueError(f"rgb: expected shape [H, W, 3], got {list(rgb.shape)}")
    if not np.isfinite(rgb).all():
        raise ValueError(f"rgb: expected finite values, got {int((~np.isfinite(rgb)).sum())} that are not")
    if not np.isfinite(exposure) or abs(exposure) > 500:
        raise ValueError(f"exposure: expected stops in -500..500, got {exposure}")
    return np.round(255 * linear_to_srgb(rgb * 2.0**exposure)).astype(np.uint8)


def write_png(path: str | Path, rgb: np.ndarray, *, exposure: float | None = None) -> None:
    """Write a preview of a linear image [H,W,3] atomically; ``exposure`` in stops, None for ``auto_exposure``."""
    mapped = tone_map(rgb, exposure=auto_exposure(rgb) if exposure is None else exposure)
    with atomic_path(path) as temporary:
        Image.fromarray(mapped).save(temporary, format="PNG")


def shrink_png(png: bytes, *, colors: int = 32) -> bytes:
    """The same picture with a palette of its own: a third of the size of a chart, which has few colours anyway."""
    target = io.BytesIO()
    with Image.open(io.BytesIO(png)) as image:
        few = image.convert("RGB").quantize(colors, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        few.save(target, format="PNG", optimize=True)
    return target.getvalue()
