"""What a solve consists of, apart from its numbers: method, steps, occlusion and conventions."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from numbers import Real
from typing import Any, Literal, get_args

from difflpv.grid import Grid
from difflpv.injection import Deposit
from difflpv.lookup import Lookup
from difflpv.scene import Scene
from difflpv.stencil import FaceStencil, LinearStencil, Normalization, Reprojection, holpv_stencil, lpv_stencil
from difflpv.stencil_files import LEARNED_STENCILS, learned_stencil

__all__ = ["METHODS", "OCCLUSION_CHOICES", "LpvConfig", "Method", "Occlusion", "grid_for"]

Method = Literal[
    "lpv", "holpv", "learned_4x6", "learned_9x6", "learned_4x26", "learned_9x26", "learned_16x26"
]
Occlusion = Literal["none", "clamp", "exp", "traced"]
METHODS: tuple[str, ...] = get_args(Method)
OCCLUSION_CHOICES: tuple[str, ...] = get_args(Occlusion)
_DEFAULT_CELLS = 32


@dataclass(frozen=True)
class LpvConfig:
    """Closed choices of a solve; the defaults are the publications' (physics.md lists what they measure).

    Attributes:
        method: "lpv" (30 faces, l_max 1), "holpv" (54 faces, l_max 2), or a learned stencil, "learned_<K>x<neighbours>".
            A learned one is linear: ``clamp`` is off.
        steps: propagation steps.
        occlusion: "none"; the geometry volume with "clamp" (publications) or "exp" (smooth); or "traced", the share of free
            rays between neighbouring cells (``difflpv.traced``). Default None: "traced" for learned stencils, else "none".
        lookup: cells that a receiver may read: "trilinear", all eight (publications), or "damped" beside it
            (``difflpv.damping``); "front", those in front of its plane; "visible", those in its sight;
            "affine", an affine fit to those of 27 in its sight (``difflpv.lookup``). Default None: "affine" for learned
            stencils, else "trilinear".
        normalization: "energy" keeps an isotropic field's flux, "thesis" a quarter of it per step.
        reprojection: lobe along the "face" normal or the "ray".
        clamp: negative intensity carries no flux; False makes transport linear.
        deposit: VPLs go to the "nearest" cell, to eight by "trilinear" weights (differentiable in position), or to those of
            the eight that they see ("visible", differentiable too). Default None: "visible" for learned stencils, else
            "nearest".
        occlude_first_step: the publications leave the first step unoccluded. Default None: True with "traced" occlusion,
            which has no self-shadowing to avoid, else False.
        l_max: SH degree, None for the method's own.
        tolerance: stop when the moving flux falls below this share (0: never).
        coarsen_after: after so many steps light goes on in cells of twice the edge, where a step is an eighth of the work and
            goes twice as far; receivers read both grids, and ``tolerance`` counts on each by itself. None, or no step left:
            one grid.
        probes: positions (x, y, z) [m] in free space of light probes that the volume lights; receivers read them instead of
            its cells (``difflpv.lit_probes``). Needs the "affine" lookup, by which probes read cells, and 9 coefficients or
            more. None by default.
    """

    method: Method = "holpv"
    steps: int = 32
    occlusion: Occlusion | None = None
    normalization: Normalization = "energy"
    reprojection: Reprojection = "face"
    clamp: bool = True
    deposit: Deposit | None = None
    occlude_first_step: bool | None = None
    l_max: int | None = None
    tolerance: float = 0.0
    lookup: Lookup | None = None
    coarsen_after: int | None = None
    probes: tuple[tuple[float, float, float], ...] = ()

    def __post_init__(self) -> None:
        learned = self.method in LEARNED_STENCILS
        if self.occlusion is None:
            object.__setattr__(self, "occlusion", "traced" if learned else "none")
        if self.lookup is None:
            object.__setattr__(self, "lookup", "affine" if learned else "trilinear")
        if self.deposit is None:
            object.__setattr__(self, "deposit", "visible" if learned else "nearest")
        if self.occlude_first_step is None:
            object.__setattr__(self, "occlude_first_step", self.occlusion == "traced")
        choices = {
            "method": METHODS,
            "occlusion": OCCLUSION_CHOICES,
            "normalization": get_args(Normalization),
            "reprojection": get_args(Reprojection),
            "deposit": get_args(Deposit),
            "lookup": get_args(Lookup),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name}: expected one of {', '.join(allowed)}, got {getattr(self, name)!r}")
        for name, least in (("steps", 0), ("coarsen_after", 1), ("l_max", 0)):
            value = getattr(self, name)
            optional = value is None and name != "steps"
            if not optional and (isinstance(value, bool) or not isinstance(value, int) or value < least):
                raise ValueError(f"{name}: expected an integer >= {least}, got {value!r}")
        for name in ("clamp", "occlude_first_step"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name}: expected true or false, got {getattr(self, name)!r}")
        if not (isinstance(self.tolerance, Real) and self.tolerance >= 0):
            raise ValueError(f"tolerance: expected a number >= 0, got {self.tolerance!r}")
        self._check_probes()
        if learned:
            object.__setattr__(self, "clamp", False)
            self._check_learned()
        _ = self.stencil

    def _check_probes(self) -> None:
        try:
            given = [[float(v) for v in position] for position in self.probes]
        except (TypeError, ValueError):
            raise ValueError("probes: expected positions (x, y, z) of numbers [m]") from None
        if not all(len(p) == 3 and all(map(math.isfinite, p)) for p in given):
            raise ValueError("probes: expected positions (x, y, z) of finite numbers [m]")
        object.__setattr__(self, "probes", tuple((x, y, z) for x, y, z in given))
        if given and self.lookup != "affine":
            raise ValueError(f"probes: they read cells by the 'affine' lookup, got lookup '{self.lookup}'")
        if given and self.stencil.l_max < 2:
            raise ValueError(f"probes: expected 9 coefficients or more, '{self.method}' has {(self.stencil.l_max + 1) ** 2}")

    def _check_learned(self) -> None:
        own = learned_stencil(self.method).l_max
        needed = {"normalization": "energy", "reprojection": "face"}
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

    def grids(self, grid: Grid) -> tuple[Grid, ...]:
        """The grids of a solve on ``grid``, finest first: itself and, with ``coarsen_after``, one of twice the cell."""
        return (grid, grid.coarser()) if self.fine_steps < self.steps else (grid,)

    @property
    def fine_steps(self) -> int:
        """Steps on the finest grid."""
        return self.steps if self.coarsen_after is None else min(self.coarsen_after, self.steps)

    def to_json(self) -> dict[str, Any]:
        """Values as JSON has them, for ``from_json``."""
        return asdict(self) | {"probes": [list(position) for position in self.probes]}

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
