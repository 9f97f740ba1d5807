"""What the demo does: its sizes, and which fits it compares."""

from __future__ import annotations

from dataclasses import dataclass

from difflpv.config import LpvConfig, Method

__all__ = ["FITS", "SCENE", "UNFITTED", "DemoSettings", "FitPlan"]

SCENE = "cornell"


@dataclass(frozen=True)
class DemoSettings:
    """Sizes of the job.

    Attributes:
        receivers: number of surface points with a known irradiance.
        spp: paths per receiver.
        image_width: pixels of the path-traced image.
        image_height: pixels.
        image_spp: paths per pixel.
        image_light: number of the light set of the images, one of ``test``.
        train: light sets to learn from.
        test: light sets to be judged on.
        cells: cells along an edge of the volume.
        steps: propagation steps.
        lpv_budget: forward-equivalents of each fit of an LPV, one being a solve of all train lights.
        holpv_budget: the same for a HOLPV, whose solve takes about twice as long.
        learned_budget: the same for the learned stencil.
        floor_spp: paths per cell for the true light in the cells.
    """

    receivers: int = 2000
    spp: int = 1024
    image_width: int = 128
    image_height: int = 128
    image_spp: int = 512
    image_light: int = 7
    train: tuple[int, ...] = (0, 1, 2, 3, 4)
    test: tuple[int, ...] = (5, 6, 7)
    cells: int = 32
    steps: int = 32
    lpv_budget: float = 72.0
    holpv_budget: float = 48.0
    learned_budget: float = 30.0
    floor_spp: int = 1024

    def __post_init__(self) -> None:
        if not self.train or self.image_light not in self.test or set(self.train) & set(self.test):
            raise ValueError(
                "light sets: expected some to train on, others to test on and the image's among these, "
                f"got train {self.train}, test {self.test}, image {self.image_light}"
            )

    @classmethod
    def quick(cls) -> DemoSettings:
        """A look at the whole job within a minute: numbers of this size are no result."""
        return cls(
            receivers=500,
            spp=128,
            image_width=64,
            image_height=64,
            image_spp=64,
            cells=16,
            steps=16,
            lpv_budget=36.0,
            holpv_budget=24.0,
            learned_budget=18.0,
            floor_spp=256,
        )

    @property
    def lights(self) -> tuple[int, ...]:
        """Train lights, then test lights."""
        return (*self.train, *self.test)

    def budget(self, method: Method) -> float:
        """Forward-equivalents of a fit."""
        return {"lpv": self.lpv_budget, "holpv": self.holpv_budget}.get(method, self.learned_budget)

    def published(self, method: Method) -> LpvConfig:
        """The solve as published, or as trained."""
        return LpvConfig(method=method, steps=self.steps)

    def fitted(self, method: Method) -> LpvConfig:
        """The solve that is fitted: the published kernels with smooth deposit and occlusion, a learned one as it is."""
        if method in ("lpv", "holpv"):
            return LpvConfig(method=method, steps=self.steps, occlusion="exp", deposit="trilinear")
        return LpvConfig(method=method, steps=self.steps)


@dataclass(frozen=True)
class FitPlan:
    """One fit: a name for tables, the method, the solver and what it learns."""

    name: str
    method: Method
    solver: str
    learn: tuple[str, ...]

    @property
    def folder(self) -> str:
        """Folder name."""
        return self.name.lower().replace(" ", "_")


UNFITTED: dict[str, Method] = {"LPV": "lpv", "HOLPV": "holpv", "learned_9x26": "learned_9x26"}
_SCALARS = ("propagation", "occlusion", "sampling_bias", "injection_bias")
# Without gradients, one number per step is out of reach: BOBYQA needs 2 n + 1 solves before its first step.
FITS: tuple[FitPlan, ...] = (
    FitPlan("LPV fitted", "lpv", "lbfgs", (*_SCALARS, "propagation_steps")),
    FitPlan("LPV nlopt", "lpv", "nlopt-bobyqa", _SCALARS),
    FitPlan("HOLPV fitted", "holpv", "lbfgs", (*_SCALARS, "propagation_steps")),
    FitPlan("HOLPV nlopt", "holpv", "nlopt-bobyqa", _SCALARS),
    FitPlan(
        "learned_9x26 fitted",
        "learned_9x26",
        "lbfgs",
        ("propagation", "propagation_steps", "occlusion", "occlusion_correction", "lookup_gains", "stencil"),
    ),
)
