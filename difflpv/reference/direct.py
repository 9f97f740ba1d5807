"""Torch twin of direct irradiance: physics.md, "Closed forms", for every pair of receiver and emitter at once."""

from __future__ import annotations

import torch

__all__ = ["direct_irradiance", "geometry_terms"]


def geometry_terms(
    points: torch.Tensor,
    normals: torch.Tensor,
    kind: torch.Tensor,
    position: torch.Tensor,
    direction: torch.Tensor,
    cone: torch.Tensor,
) -> torch.Tensor:
    """G [n,m] of receivers [n,3] under emitters [m]: 1/m2 for a position, 1 for a directional light.

    ``kind``: 0 point, 1 spot, 2 directional, 3 area sample; ``cone``: cosines of the inner and outer half-angle [m,2].
    """
    d = position[None] - points[:, None]
    square = (d * d).sum(-1)
    near = square < 1e-12  # closer than a micrometre: no direction, no contribution
    square = torch.where(near, torch.ones_like(square), square)
    w = d / square.sqrt()[..., None]
    facing = torch.where(near, torch.zeros_like(square), (w * normals[:, None]).sum(-1).clamp_min(0)) / square
    leaving = -(w * direction[None]).sum(-1)
    s = ((leaving - cone[:, 1]) / (cone[:, 0] - cone[:, 1]).clamp_min(1e-4)).clamp(0, 1)
    parallel = -(normals @ direction.T)
    spot, area = facing * s * s, facing * leaving.clamp_min(0)
    return torch.where(
        kind == 0, facing, torch.where(kind == 1, spot, torch.where(kind == 2, parallel.clamp_min(0), area))
    )


def direct_irradiance(
    points: torch.Tensor,
    normals: torch.Tensor,
    kind: torch.Tensor,
    position: torch.Tensor,
    direction: torch.Tensor,
    power: torch.Tensor,
    cone: torch.Tensor,
    visibility: torch.Tensor,
) -> torch.Tensor:
    """E = sum_j V_ij G_ij P_j [W/m2], shape [n,3]; ``power`` [m,3], ``visibility`` [n,m]."""
    terms = geometry_terms(points, normals, kind, position, direction, cone)
    return (terms * visibility.to(terms.dtype)) @ power
