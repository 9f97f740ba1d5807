"""The true field in the cells of a volume: what a perfect propagation of degree 2 would hold.

Read like any other volume it gives the error that no kernel of this degree on this grid can be expected to beat by much: the
floor of every table.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from data_gen.blocks import round_samples
from data_gen.components import Components
from data_gen.estimators import REPLICATES, probe_block
from data_gen.pathtracer import PathTracer
from difflpv.grid import Grid
from difflpv.scene import AreaLight, Scene

__all__ = ["true_volume"]

_STREAM = 104
_PATHS = 2**17


def true_volume(scene: Scene, grid: Grid, component: str, *, spp: int = 256, seed: int = 0) -> np.ndarray:
    """Path-traced radiance at the centres of all cells, in the form of an accumulated volume.

    A cell of edge h stores h^2 times the radiance that passes its centre, by direction of travel (physics.md, "The chain" 7).

    Args:
        scene: with its lights.
        grid: cells of the volume.
        component: "direct" (area lights only: the light of others is exact where it is sampled), "bounce1", ...
        spp: paths per cell.
        seed: equal seeds give equal bits.

    Returns:
        Intensity [W/sr], shape [3, 9, n_z, n_y, n_x] float64.
    """
    if component == "direct":
        area = tuple(light for light in scene.lights if isinstance(light, AreaLight))
        if not area:
            return np.zeros((3, 9, *grid.shape))
        scene = replace(scene, lights=area)
    tracer, wanted = PathTracer(scene), Components.of([component])
    samples, rounds = round_samples(spp)
    centers = grid.cell_centers().reshape(-1, 3)
    chunk = max(1, _PATHS // (REPLICATES * samples))
    found = np.zeros((len(centers), 9, 3))
    for number, begin in enumerate(range(0, len(centers), chunk)):
        for part in range(rounds):
            cells = centers[begin : begin + chunk]
            address = (_STREAM, number)
            block = probe_block(tracer, cells, wanted, samples=samples, seed=seed, address=address, round=part)
            found[begin : begin + chunk] += block[:, :, 0].mean(0) / rounds
    found[:, 1:4] *= -1  # toward the light -> direction of travel
    return grid.cell_size**2 * found.transpose(2, 1, 0).reshape(3, 9, *grid.shape)
