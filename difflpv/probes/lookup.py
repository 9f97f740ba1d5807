"""Irradiance of receivers from the probes that their rows name."""

from __future__ import annotations

import torch

from difflpv.coordinates import check_points
from difflpv.probes.probe_set import COEFFS
from difflpv.probes.rows import Rows
from difflpv.sh import cosine_lobe
from difflpv.weighted import gather_lobes

__all__ = ["probe_irradiance"]


def probe_irradiance(rows: Rows, radiance: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    """Irradiance [m,C] W/m2 at one normal a receiver: E(n) = sum_j w_j sum_i A_l(i) Y_i(n) L_ji (physics.md, "Closed forms").

    Args:
        rows: weights [m,k] of the receivers over the probes, of the dtype of ``radiance``.
        radiance: radiance SH of the probes [n,9,C] W/m2, toward the incoming light.
        normals: unit normals of the receivers [m,3].

    Returns:
        Gradients reach weights, radiance and normals.

    Raises:
        TypeError, ValueError: naming the argument, what was expected and what came.
    """
    if radiance.ndim != 3 or radiance.shape[1] != COEFFS:
        raise ValueError(f"radiance: expected shape [n,9,C], got {list(radiance.shape)}")
    check_points("normals", normals, like=radiance, count=len(rows.probe))
    volume = radiance.permute(2, 1, 0)[:, :, None, None]
    return gather_lobes(volume, rows.probe.int(), rows.weight, cosine_lobe(normals, 2))
