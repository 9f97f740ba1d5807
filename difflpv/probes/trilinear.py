"""Trilinear interpolation over a lattice of probes, as irradiance fields are read.

Source: Majercik et al., "Dynamic diffuse global illumination with ray-traced irradiance fields", JCGT 2019, 3.2. A probe that
was displaced from its node keeps the node's weights (their 4.1): positions have no influence on the rows.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import torch

from difflpv.coordinates import check_points
from difflpv.probes.lattice import fill_from_neighbours
from difflpv.probes.rows import Rows

__all__ = ["GridInterpolation"]

_CORNERS = torch.tensor(list(itertools.product((0, 1), repeat=3)))


class GridInterpolation:
    """Trilinear weights of the eight nodes around a point; beyond the lattice, those of the nearest point of its box.

    A node without a usable probe holds that of the nearest node (in steps of the lattice) that has one, so that weights stay
    continuous and sum to 1.
    """

    def __init__(
        self,
        low: Sequence[float],
        high: Sequence[float],
        shape: tuple[int, int, int],
        *,
        probe: np.ndarray | None = None,
        valid: np.ndarray | None = None,
    ) -> None:
        """Set up the lattice.

        Args:
            low: position of the first node [3] m.
            high: position of the last node [3] m; not read along an axis of one node.
            shape: nodes along x, y and z.
            probe: the probe of each node [n_x, n_y, n_z], below 0 for none; counted up with z fastest, if None.
            valid: [n] bool, probes that may be used; all, if None.

        Raises:
            ValueError: naming the argument, what was expected and what came.
        """
        first, last = np.asarray(low, np.float64), np.asarray(high, np.float64)
        count = np.asarray(shape)
        if count.shape != (3,) or (count < 1).any():
            raise ValueError(f"grid shape: expected three numbers > 0, got {shape}")
        if first.shape != (3,) or last.shape != (3,) or not (last - first > 0)[count > 1].all():
            raise ValueError(f"grid corners: expected a lower and a higher one [3], got {first.tolist()} and {last.tolist()}")
        index = np.arange(count.prod()).reshape(shape) if probe is None else np.array(probe, np.int64)
        if index.shape != tuple(shape):
            raise ValueError(f"grid probe: expected shape {list(shape)}, got {list(index.shape)}")
        if valid is not None and len(valid) <= index.max():
            raise ValueError(f"grid valid: expected a boolean for each of {index.max() + 1} probes, got {len(valid)}")
        known = index >= 0 if valid is None else (index >= 0) & np.asarray(valid, bool)[np.maximum(index, 0)]
        if not known.any():
            raise ValueError("grid: expected at least one node with a usable probe, got none")
        self._probe = torch.from_numpy(fill_from_neighbours(index, known).ravel())
        self._low = torch.from_numpy(first)
        self._step = torch.from_numpy(np.where(count > 1, (last - first) / np.maximum(count - 1, 1), 1.0))
        self._last = torch.from_numpy(count - 1)

    def rows(self, position: torch.Tensor, points: torch.Tensor) -> Rows:
        """Weights [m,8] of ``points`` [m,3] m, differentiable in them; ``position`` [n,3] m is not read.

        Raises:
            ValueError: fewer probes than the lattice names, or points of another shape.
        """
        check_points("points", points)
        if len(position) <= int(self._probe.max()):
            raise ValueError(f"position: expected at least {int(self._probe.max()) + 1} probes, got {len(position)}")
        u = ((points - self._low.to(points.dtype)) / self._step.to(points.dtype)).clamp_min(0)
        u = torch.minimum(u, self._last.to(points.dtype))
        base = torch.minimum(u.detach().long(), (self._last - 1).clamp_min(0))
        t = u - base
        weight = torch.where(_CORNERS.bool(), t[:, None], 1 - t[:, None]).prod(-1)
        node = torch.minimum(base[:, None] + _CORNERS, self._last)
        flat = (node[..., 0] * (self._last[1] + 1) + node[..., 1]) * (self._last[2] + 1) + node[..., 2]
        return Rows(self._probe[flat], weight)
