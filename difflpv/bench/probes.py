"""Light probes on a uniform grid, read in their tetrahedra: content path-traced where they stand, or sampled from a volume.

Where probes stand and which of them a receiver reads is set-up: it belongs to geometry and receivers. Their content changes
with the light, so making it is the solve.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from data_gen.few_paths import PathPool
from data_gen.freespace import default_clearance, is_free
from difflpv.bench.configuration import Configuration
from difflpv.bench.scenes import BenchScene
from difflpv.bench.timing import timed
from difflpv.bench.tracers import PEER_SEED
from difflpv.bench.volume import VolumeRun
from difflpv.grid import Grid
from difflpv.learnables import fixed_values
from difflpv.lit_probes import VolumeProbes, probe_radiance
from difflpv.placement.uniform import uniform_grids
from difflpv.probes.lookup import probe_irradiance
from difflpv.probes.rows import Rows
from difflpv.probes.tetrahedra import TetrahedralInterpolation
from difflpv.scene import Scene
from difflpv.triangle_distance import triangle_distance

__all__ = ["LitProbes", "ProbeRun", "TracedProbes", "probe_grid"]


@dataclass(frozen=True, eq=False)
class _Space:
    """The free space of a scene within a box (lowest, highest corner [3] m)."""

    scene: Scene
    bounds: tuple[np.ndarray, np.ndarray]
    seed: int

    def in_free_space(self, position: np.ndarray, margin: float = 0.0) -> np.ndarray:
        off = triangle_distance(self.scene.triangle_vertices, position)
        free = off > max(margin, default_clearance(self.bounds))
        free[free] = is_free(self.scene, position[free], self.seed)
        return free


def probe_grid(scene: Scene, grid: Grid, count: int, *, seed: int = 0, refinements: int | None = None) -> np.ndarray:
    """Positions [n,3] m of the finest uniform grid of at most ``count`` probes in free space, where scene and grid overlap.

    Args:
        scene: the scene.
        grid: of the volume.
        count: probes at most.
        seed: of the rays that tell free space.
        refinements: finer grids to try where probes fall into solids, see ``difflpv.placement.uniform.uniform_grids``.

    Raises:
        ValueError: no probe lies in free space.
    """
    inside, outside = scene.bounds, (np.asarray(grid.minimum), np.asarray(grid.maximum))
    low, high = np.maximum(inside[0], outside[0]), np.minimum(inside[1], outside[1])
    flat = high - low < grid.cell_size  # a lone floor has its grid's depth
    box = np.where(flat, outside[0], low), np.where(flat, outside[1], high)
    grids = uniform_grids(_Space(scene, box, seed), count, refinements=refinements)
    if not grids:
        raise ValueError(f"probes: none of at most {count} on a uniform grid of '{scene.name}' lies in free space")
    return grids[0].position


class ProbeRun:
    """Probes of one scene and the receivers that read them; what they hold is made by a subclass.

    Attributes:
        setup: seconds of what is done once per geometry, by name: "probes" (where they stand, their tetrahedra), "receivers"
            (which probes each reads).
        lights: seconds of what is done anew when a light moves, apart from the solve.
        position: of the probes [n,3] m.
    """

    def __init__(self, configuration: Configuration, bench: BenchScene) -> None:
        """Place probes on the finest uniform grid of at most ``configuration.probes`` in free space.

        Args:
            configuration: of kind "traced probes" or "lit probes".
            bench: where.

        Raises:
            ValueError: no probe lies in free space.
        """
        assert configuration.probes is not None
        self.configuration, self.bench = configuration, bench
        self.lights, count = 0.0, configuration.probes
        self.position, placing = timed(lambda: probe_grid(bench.scene, bench.grid(), count, seed=bench.seed))
        self._interpolation, connecting = timed(lambda: TetrahedralInterpolation(self.position))
        (self._rows, self._normals), finding = timed(lambda: self._reads(bench.position, bench.normal))
        self.setup = {"probes": placing + connecting, "receivers": finding}

    def _reads(self, position: np.ndarray, normal: np.ndarray) -> tuple[Rows, torch.Tensor]:
        points = torch.as_tensor(position, dtype=torch.float64)
        rows = self._interpolation.rows(torch.as_tensor(self.position), points)
        return Rows(rows.probe, rows.weight.float()), torch.as_tensor(normal, dtype=torch.float32)

    def solve(self) -> torch.Tensor:
        """Radiance SH of the probes, toward the incoming light [n,9,3] W/m2, float32."""
        raise NotImplementedError

    @torch.no_grad()
    def lookup(self, solved: torch.Tensor) -> np.ndarray:
        """Irradiance [n,3] of the scene's receivers."""
        return probe_irradiance(self._rows, solved, self._normals).numpy()

    @torch.no_grad()
    def predict(self, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Irradiance [n,3] of other receivers."""
        rows, normals = self._reads(position, normal)
        return probe_irradiance(rows, self.solve(), normals).numpy()


class TracedProbes(ProbeRun):
    """Content by a few paths per probe, traced by the processes that trace the path tracer's receivers."""

    def __init__(self, configuration: Configuration, bench: BenchScene, pool: PathPool) -> None:
        """As ``ProbeRun``, with path tracers that wait for work."""
        super().__init__(configuration, bench)
        self.pool = pool

    def solve(self) -> torch.Tensor:
        """Trace every probe."""
        assert self.configuration.samples is not None
        seed = self.bench.seed + PEER_SEED
        found = self.pool.trace_probes(self.position, self.bench.component, samples=self.configuration.samples, seed=seed)
        return torch.as_tensor(found, dtype=torch.float32)


class LitProbes(ProbeRun):
    """Content by a volume solve: an affine fit to the cells that a probe sees, at the probe (``difflpv.lookup``).

    Attributes:
        volume: the solve; its geometry counts as set-up, its rays as what moved lights cost.
    """

    def __init__(self, configuration: Configuration, bench: BenchScene, *, tuning: BenchScene | None = None) -> None:
        """As ``ProbeRun``, and all that ``VolumeRun`` traces and tunes."""
        super().__init__(configuration, bench)
        self.volume = VolumeRun(configuration, bench, tuning=tuning)
        grids, raycaster = self.volume.config.grids(self.volume.grid), self.volume.light.raycaster
        self._probes, seeing = timed(
            lambda: VolumeProbes.of(self.position, grids, raycaster, dtype=torch.float32, device=torch.device("cpu"))
        )
        placing, finding = self.setup["probes"], self.setup["receivers"]
        self.setup = {**self.volume.setup, "probes": placing + seeing, "receivers": finding}
        values = {**fixed_values(self.volume.config), **self.volume.lpv.values()}
        degrees = torch.arange(self.volume.config.stencil.l_max + 1)
        self._gains = values["lookup_gains"].detach().float().repeat_interleave(2 * degrees + 1)
        self.lights = self.volume.lights

    def solve(self) -> torch.Tensor:
        """Solve the volume and sample it at the probes."""
        return self.content(self.volume.solve())

    @torch.no_grad()
    def content(self, volumes: tuple[torch.Tensor, ...]) -> torch.Tensor:
        """Radiance SH of the probes [n,9,3] W/m2 from volumes [3,K,n_z,n_y,n_x] W/sr of each grid."""
        return probe_radiance(volumes, self.volume.config.grids(self.volume.grid), self._probes.reads, self._gains)
