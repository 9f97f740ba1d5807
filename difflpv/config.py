"""What a solve consists of, apart from its numbers: method, steps, occlusion and conventions."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, get_args

from difflpv.grid import Grid
from difflpv.scene import Scene
from difflpv.stencil import FaceStencil, LinearStencil, Normalization, Reprojection, holpv_stencil, lpv_stencil
from difflpv.stencil_files import LEARNED_STENCILS, learned_stencil

__all__ = ["METHODS", "OCCLUSION_CHOICES", "LpvConfig", "Method", "Occlusion", "grid_for"]

Method = Literal[
    "lpv", "holpv", "learned_4x6", "learned_9x6", "learned_4x26", "learned_9x26", "learned_16x26"
]
Occlusion = Literal["none", "clamp", "exp"]
METHODS: tuple[str, ...] = get_args(Method)
OCCLUSION_CHOICES: tuple[str, ...] = get_args(Occlusion)
_DEFAULT_CELLS = 32


@dataclass(frozen=True)
class LpvConfig:
    """Closed choices of a solve; the defaults are the publications' (physics.md lists what they measure).

    Attributes:
        method: "lpv" (30 faces, l_max 1), "holpv" (54 faces, l_max 2), or a learned stencil, "learned_<K>x<neighbours>".
            A learned one is linear: ``clamp`` is off, and it takes no occlusion.
        steps: propagation steps.
        occlusion: "none", or the geometry volume with "clamp" (publications) or "exp" (smooth).
        normalization: "energy" keeps an isotropic field's flux, "thesis" a quarter of it per step.
        reprojection: lobe along the "face" normal or the "ray".
        clamp: negative intensity carries no flux; False makes transport linear.
        deposit: VPLs go to the "nearest" cell or "trilinear" (differentiable in position).
        occlude_first_step: the publications leave the first step unoccluded.
        l_max: SH degree, None for the method's own.
        tolerance: stop when the moving flux falls below this share (0: never).
    """

    method: Method = "holpv"
    steps: int = 32
    occlusion: Occlusion = "none"
    normalization: Normalization = "energy"
    reprojection: Reprojection = "face"
    clamp: bool = True
    deposit: Literal["nearest", "trilinear"] = "nearest"
    occlude_first_step: bool = False
    l_max: int | None = None
    tolerance: float = 0.0

    def __post_init__(self) -> None:
        choices = {
            "method": METHODS,
            "occlusion": OCCLUSION_CHOICES,
            "normalization": get_args(Normalization),
            "reprojection": get_args(Reprojection),
            "deposit": ("nearest", "trilinear"),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name}: expected one of {', '.join(allowed)}, got {getattr(self, name)!r}")
        if self.steps < 0:
            raise ValueError(f"steps: expected a number >= 0, got {self.steps}")
        if not self.tolerance >= 0:
            raise ValueError(f"tolerance: expected a number >= 0, got {self.tolerance}")
        if self.method in LEARNED_STENCILS:
            object.__setattr__(self, "clamp", False)
            self._check_learned()
        _ = self.stencil

    def _check_learned(self) -> None:
        own = learned_stencil(self.method).l_max
        needed = {"occlusion": "none", "normalization": "energy", "reprojection": "face"}
        for name, value in needed.items():
            if getattr(self, name) != value:
                raise ValueError(f"{name}: the linear stencil '{self.method}' needs '{value}', got {getattr(self, name)!r}")
        if self.l_max not in (None, own):
            raise ValueError(f"l_max: '{self.method}' has {own}, got {self.l_max}")

    @property
    def stencil(self) -> FaceStencil | LinearStencil:
        """The propagation stencil."""
        if self.method in LEARNED_STENCILS:
            return learned_stencil(self.method)
        make, own = {"lpv": (lpv_stencil, 1), "holpv": (holpv_stencil, 2)}[self.method]
        l_max = own if self.l_max is None else self.l_max
        return make(l_max=l_max, normalization=self.normalization, reprojection=self.reprojection)

    @property
    def critical_factor(self) -> float:
        """Propagation factor above which a uniform field grows without bound: 1 (energy) or 4 (thesis)."""
        return 1.0 if self.normalization == "energy" else 4.0

    def to_json(self) -> dict[str, Any]:
        """Plain values, for ``from_json``."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> LpvConfig:
        """A configuration from ``to_json``; unknown names are an error."""
        unknown = set(values) - {f.name for f in fields(cls)}
        if unknown:
            raise ValueError(f"configuration: unknown names {sorted(unknown)}")
        return cls(**values)


def grid_for(scene: Scene, cells: int | None = None) -> Grid:
    """The scene's own grid, at ``cells`` cells along x if given; a cube around the scene where the file names none."""
    if cells is not None and cells < 3:
        raise ValueError(f"grid: expected at least 3 cells, got {cells}")
    if scene.grid is None:
        return Grid.around(*scene.bounds, cells or _DEFAULT_CELLS)
    return scene.grid if cells is None else scene.grid.with_cells(cells)
