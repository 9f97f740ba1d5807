"""Torch twin of RSM shading: the ray of each texel meets its fixed plane, the flux is albedo x weight x power."""

from __future__ import annotations

import torch

__all__ = ["rsm_vpls"]


def rsm_vpls(
    offset: torch.Tensor,
    direction: torch.Tensor,
    normal: torch.Tensor,
    plane: torch.Tensor,
    weight: torch.Tensor,
    albedo: torch.Tensor,
    position: torch.Tensor,
    power: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Hit positions [t,3] m and fluxes [t,3] W of texels.

    ``offset``, ``direction``, ``normal``, ``albedo`` [t,3]; ``plane``, ``weight`` [t]; ``position``, ``power`` [3].
    """
    origin = position + offset
    distance = (plane - (normal * origin).sum(1)) / (normal * direction).sum(1)
    return origin + distance[:, None] * direction, albedo * weight[:, None] * power
