"""Sizes of a bench run."""

from __future__ import annotations

from dataclasses import dataclass, replace

__all__ = ["BenchSettings"]


@dataclass(frozen=True)
class BenchSettings:
    """Sizes; the defaults are the full run.

    Attributes:
        seed: of receivers, paths and light samples.
        receivers: points with a known irradiance, inside the grid.
        spp: paths of the truth at each.
        tuning_receivers: further points that factors are tuned on.
        image_width: of the picture [pixels].
        image_spp: paths per pixel of the truth.
        cell_spp: paths per cell of the floor.
        repeats: of every timed call.
        patience: a call that has taken so many seconds in all is not repeated any more [s].
        growth_cells: cells along an edge, to see how cost grows.
        most_receivers: largest number of receivers that is measured; larger ones are scaled up.
        costly_receivers: the same where a receiver costs more: gradients, the pay-off of fits.
        gradient_samples: paths per receiver of the reference gradient, a power of two.
        gradient_replicates: gradients by path replay that tell its noise.
        quick: a quick run.
    """

    seed: int = 0
    receivers: int = 2000
    spp: int = 4096
    tuning_receivers: int = 500
    image_width: int = 128
    image_spp: int = 256
    cell_spp: int = 1024
    repeats: int = 5
    patience: float = 6.0
    growth_cells: tuple[int, ...] = (16, 32, 64, 128)
    most_receivers: int = 1_000_000
    costly_receivers: int = 100_000
    gradient_samples: int = 4096
    gradient_replicates: int = 32
    quick: bool = False

    @classmethod
    def of_quick(cls, seed: int = 0) -> BenchSettings:
        """Under five minutes on two cores: the order of the methods shows, the third digit does not."""
        return replace(
            cls(seed=seed), receivers=600, spp=1024, tuning_receivers=300, image_width=64, image_spp=64,
            cell_spp=512, repeats=3, patience=0.5, growth_cells=(16, 32, 64), most_receivers=100_000,
            costly_receivers=10_000, gradient_samples=512, gradient_replicates=8, quick=True,
        )  # fmt: skip
