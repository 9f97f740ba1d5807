"""Where a plane across an axis cuts triangles: the outline of the walls beside a slice of the volume."""

from __future__ import annotations

import numpy as np

__all__ = ["section"]


def section(corners: np.ndarray, axis: int, height: float) -> np.ndarray:
    """Segments [m,2,3] m in which triangles [T,3,3] m cut the plane x_axis = ``height``; those that lie in it do not count."""
    over = corners[:, :, axis] > height
    crossing = over.any(1) & ~over.all(1)
    corners, over = corners[crossing], over[crossing]
    alone = np.where(over.sum(1) == 1, over.argmax(1), (~over).argmax(1))  # the corner on its own side
    rows = np.arange(len(corners))
    apex = corners[rows, alone]
    ends = []
    for k in (1, 2):
        other = corners[rows, (alone + k) % 3]
        share = (height - apex[:, axis]) / (other[:, axis] - apex[:, axis])
        ends.append(apex + share[:, None] * (other - apex))
    return np.stack(ends, 1) if len(corners) else np.zeros((0, 2, 3))
