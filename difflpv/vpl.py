"""Virtual point lights: what an RSM, an area light's surface or a lit surface hands to injection."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from difflpv.bridge import check_float

__all__ = ["Vpls"]


@dataclass(frozen=True, eq=False)
class Vpls:
    """Small cosine emitters, I(w) = (flux/pi) max(0, n.w).

    Attributes:
        position: [n,3] m.
        normal: unit normals on the lit side, [n,3].
        flux: reflected or emitted flux [n,3] W, linear RGB.
    """

    position: torch.Tensor
    normal: torch.Tensor
    flux: torch.Tensor

    def __post_init__(self) -> None:
        check_float("position", self.position)
        for name in ("position", "normal", "flux"):
            tensor = getattr(self, name)
            check_float(name, tensor, like=self.position)
            if tensor.ndim != 2 or tensor.shape[1] != 3 or len(tensor) != len(self.position):
                raise ValueError(f"{name}: expected shape [{len(self.position)}, 3], got {list(tensor.shape)}")

    def __len__(self) -> int:
        return len(self.position)

    @classmethod
    def cat(cls, parts: list[Vpls]) -> Vpls:
        """All VPLs of several sources, in order."""
        return cls(*(torch.cat([getattr(p, name) for p in parts]) for name in ("position", "normal", "flux")))
