"""A volume solve in the parts that cost: geometry, rays of the lights, the solve, the lookup, the gradients."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from data_gen.cells import kept_volume
from difflpv.bench.configuration import Configuration
from difflpv.bench.scenes import BenchScene
from difflpv.bench.timing import timed
from difflpv.fit import fit, light_target
from difflpv.illumination import Illumination, Receivers, illuminate
from difflpv.loss import relative_l2
from difflpv.pipeline import Lpv

__all__ = ["FloorRun", "VolumeRun"]

_TUNING_BUDGET = 30.0  # forward-equivalents


class VolumeRun:
    """One volume solve on one scene, ready to be repeated.

    Attributes:
        setup: seconds of what is done once per geometry, by name: "geometry" (what stands between cells), "receivers" (what
            each receiver sees), "fit" where something is tuned.
        lights: seconds of what is done anew when a light moves, apart from the solve: its rays onto the surfaces.
    """

    def __init__(self, configuration: Configuration, bench: BenchScene, *, tuning: BenchScene | None = None) -> None:
        """Trace everything that a solve needs.

        Args:
            configuration: of kind "volume".
            bench: where to solve.
            tuning: the same scene with other receivers, where the configuration tunes something.
        """
        assert configuration.config is not None
        self.configuration, self.bench, self.config = configuration, bench, configuration.config
        self.grid = bench.grid(configuration.cells)
        self._rays: dict[str, Any] = {
            "surface_samples": configuration.surface_samples,
            "area_samples": configuration.area_samples,
            "seed": bench.seed,
        }
        first, everything = timed(lambda: self._traced(None))
        self.light, self.lights = timed(lambda: self._traced(first))
        self.receivers, sight = timed(lambda: self.light.receivers(bench.position, bench.normal))
        self.setup = {"geometry": max(0.0, everything - self.lights), "receivers": sight}
        self.lpv, self.values = Lpv(self.grid, self.config), {"light_intensity": torch.ones(len(bench.scene.lights))}
        if configuration.learn:
            if tuning is None:
                raise ValueError(f"tuning: expected receivers to tune '{configuration.name}' on, got none")
            self.lpv, self.setup["fit"] = timed(lambda: self._tuned(tuning))
        self._truth = torch.as_tensor(bench.truth, dtype=torch.float32)
        self._weight = torch.as_tensor(bench.weight, dtype=torch.float32)

    def _traced(self, known: Illumination | None) -> Illumination:
        blocking = known.blocking if known else None
        light = illuminate(self.bench.scene, self.grid, self.config, self.bench.component, blocking=blocking, **self._rays)
        if self.config.deposit == "visible":
            light.vpl_cells(light.vpls())  # kept by the illumination
        return light

    def relight(self) -> Illumination:
        """Trace the rays of the lights anew, as for lights that moved; what stands between cells is kept."""
        return self._traced(self.light)

    def _tuned(self, tuning: BenchScene) -> Lpv:
        target = light_target(
            tuning.scene, None, self.grid, self.config, tuning.component, index=0, position=tuning.position,
            normal=tuning.normal, irradiance=tuning.truth, weight=tuning.weight, **self._rays,
        )  # fmt: skip
        learn = [name for name in self.configuration.learn if name != "occlusion" or self.config.occlusion != "none"]
        return fit(
            tuning.scene, [target], config=self.config, learn=learn, train=[0], test=[], solver="lbfgs", budget=_TUNING_BUDGET
        ).lpv

    @torch.no_grad()
    def solve(self) -> tuple[torch.Tensor, ...]:
        """Shade the lights anew, inject, propagate."""
        return self.lpv.accumulate(self.light, self.values)

    @torch.no_grad()
    def lookup(self, solved: tuple[torch.Tensor, ...], receivers: Receivers | None = None) -> np.ndarray:
        """Irradiance [n,3] of the receivers, those of the scene if none are given."""
        return self.lpv.read(solved, self.receivers if receivers is None else receivers).numpy()

    def both(self, receivers: Receivers | None = None, weight: np.ndarray | None = None) -> Mapping[str, torch.Tensor]:
        """Gradient with respect to intensity and position of every light, float32.

        Args:
            receivers: those of the scene by default.
            weight: gradient of ``sum(weight * irradiance)``, [n,3]; by default of the error, or of other receivers' mean.
        """
        count = len(self.bench.scene.lights)
        leaves = {"light_intensity": torch.ones(count, requires_grad=True)}
        if self.config.deposit != "nearest":
            leaves["light_position"] = torch.zeros(count, 3, requires_grad=True)
        irradiance = self.lpv(self.light, self.receivers if receivers is None else receivers, leaves)
        if weight is not None:
            aim = (torch.as_tensor(weight, dtype=irradiance.dtype) * irradiance).sum()
        elif receivers is not None:
            aim = irradiance.mean()
        else:
            aim = relative_l2(irradiance, self._truth, self._weight)
        found = torch.autograd.grad(aim, list(leaves.values()), allow_unused=True)
        return {n: torch.zeros_like(v) if g is None else g for (n, v), g in zip(leaves.items(), found, strict=True)}

    def predict(self, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Irradiance [n,3] of other receivers."""
        return self.lookup(self.solve(), self.light.receivers(position, normal))

    @property
    def volume_bytes(self) -> int:
        """Size of one volume of the finest grid in float32."""
        x, y, z = self.grid.resolution
        return 4 * 3 * (self.config.stencil.l_max + 1) ** 2 * x * y * z


class FloorRun(VolumeRun):
    """The true radiance in every cell as spherical harmonics of degree 2, read by the lookup: what a perfect propagation does.

    The volume is path traced once and kept beside the truth.
    """

    def __init__(self, configuration: Configuration, bench: BenchScene, *, spp: int = 1024) -> None:
        super().__init__(configuration, bench)
        known = kept_volume(bench.folder / "cells", bench.scene, self.grid, bench.component, spp=spp, seed=bench.seed)
        self._known = (torch.as_tensor(known.mean, dtype=torch.float32),)

    def solve(self) -> tuple[torch.Tensor, ...]:
        """The known volume."""
        return self._known
