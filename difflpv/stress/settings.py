"""Sizes of the experiments, and the methods that they push."""

from __future__ import annotations

from dataclasses import dataclass, replace

from difflpv.config import LpvConfig

__all__ = ["STRESS_METHODS", "StressSettings"]

# Name -> solve. A method to be pushed as well is one more line; ``steps`` is set by each experiment.
STRESS_METHODS: dict[str, LpvConfig] = {
    "lpv": LpvConfig(method="lpv"),
    "lpv exp": LpvConfig(method="lpv", occlusion="exp"),
    "holpv": LpvConfig(method="holpv"),
    "holpv exp": LpvConfig(method="holpv", occlusion="exp"),
    "learned_9x26 open": LpvConfig(method="learned_9x26", occlusion="none", lookup="trilinear", deposit="nearest"),
    "learned_9x26": LpvConfig(method="learned_9x26"),
    "learned_9x26 two sizes": LpvConfig(method="learned_9x26", coarsen_after=6),
}


@dataclass(frozen=True)
class StressSettings:
    """Sizes; the defaults are the full run.

    Attributes:
        seed: of receivers, paths, light samples and solvers.
        receivers: points with a known irradiance.
        spp: paths per receiver.
        cells: cells along a scene's grid where the cells are not what is turned.
        refinement: cells along the grid, one solve each.
        gradient_cells: largest grid whose gradient is measured.
        steps: numbers of propagation steps that are tried.
        factors: propagation factors over the critical one.
        moves: positions of a light on its way through one cell.
        angles: rotations of the scene in its grid [degrees].
        fit_steps: few and many propagation steps of the fits of a propagation factor.
        fit_budget: forward-equivalents of each of them.
        starts: random starts of each inverse problem.
        budget: forward-equivalents of each fit of an inverse problem.
    """

    seed: int = 0
    receivers: int = 400
    spp: int = 2048
    cells: int = 16
    refinement: tuple[int, ...] = (8, 16, 32, 64, 96)
    gradient_cells: int = 32
    steps: tuple[int, ...] = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512)
    factors: tuple[float, ...] = (0.25, 0.5, 0.75, 0.9, 0.97, 1.0, 1.01, 1.03, 1.1, 1.25, 1.5, 2.0)
    moves: int = 32
    angles: tuple[float, ...] = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 45.0)
    fit_steps: tuple[int, int] = (16, 300)
    fit_budget: float = 60.0
    starts: int = 20
    budget: float = 60.0

    @classmethod
    def quick(cls, seed: int = 0) -> StressSettings:
        """Under three minutes on one core: the limits show, their third digit does not."""
        return replace(
            cls(seed=seed),
            receivers=150,
            spp=512,
            refinement=(8, 16, 32),
            gradient_cells=16,
            steps=(1, 4, 16, 64, 256),
            factors=(0.25, 0.75, 0.9, 1.0, 1.03, 1.25, 2.0),
            moves=16,
            angles=(0.0, 15.0, 30.0, 45.0),
            fit_budget=30.0,
            starts=4,
            budget=45.0,
        )
