"""Rounds of work blocks, merged into tables and images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from data_gen.blocks import Block, BlockRunner, Quantity
from data_gen.components import Components, Estimate
from data_gen.estimators import REPLICATES
from data_gen.load import TargetsError
from difflpv.io.exr import write_image
from difflpv.io.png import write_png
from difflpv.io.tables import ReceiverTable, save_receivers, save_table
from difflpv.lights import behind_light_weight

__all__ = ["JobRun", "TargetRun"]


class JobRun:
    """One run of a job: rounds of blocks, and what they add up to.

    Attributes:
        rays: traced for what was counted so far.
        seconds: processor time of the same blocks.
    """

    def __init__(self, runner: BlockRunner) -> None:
        self.runner, self.job, self.store = runner, runner.job, runner.store
        self.rays, self.seconds = 0, 0.0

    def compute(self, quantity: Quantity, rounds: Sequence[int]) -> None:
        """Have blocks of ``rounds`` [lights] rounds computed."""
        chunks = range(self.job.parts[quantity].chunk_count)
        blocks = [
            Block(light, quantity, number, chunk)
            for light, count in enumerate(rounds)
            for number in range(count)
            for chunk in chunks
        ]
        self.runner.run(blocks, quantity)

    def estimate(self, light: int, quantity: Quantity, rounds: int, *, count_rays: bool = False) -> Estimate:
        """All entities' estimates from all rounds."""
        parts = []
        for chunk in range(self.job.parts[quantity].chunk_count):
            total = np.zeros(())
            for number in range(rounds):
                block = Block(light, quantity, number, chunk)
                loaded = self.store.load(block)
                if loaded is None:
                    raise TargetsError(f"{self.store.path(block)}: block vanished while targets were being made")
                means, rays, seconds = loaded
                total = total + means.astype(np.float64)
                if count_rays:
                    self.rays += rays
                    self.seconds += seconds
            parts.append(Estimate.of(total / rounds))
        return Estimate(
            np.concatenate([p.mean for p in parts]), np.concatenate([p.standard_error for p in parts])
        )


class TargetRun(JobRun):
    """A run with receivers: goes on to a standard error, writes tables and images."""

    def __init__(self, runner: BlockRunner, receivers: ReceiverTable) -> None:
        super().__init__(runner)
        self.receivers = receivers
        self.weights: list[np.ndarray] = []
        for scene in self.job.scenes:
            weight = np.array(receivers.area_weight)
            weight[behind_light_weight(scene, receivers.position)] = 0
            self.weights.append(weight)

    def errors(self, estimate: Estimate, light: int) -> dict[str, float]:
        """Mean standard error over mean, per component, over receivers that have a weight."""
        counted = self.weights[light] > 0
        if not counted.any():  # all behind a panel: better their own error than none
            counted[:] = True
        mean = estimate.mean[counted].mean((0, 2))
        error = estimate.standard_error[counted].mean((0, 2))
        names = self.job.parts["surface"].components.names
        return {name: float(e / m) if m > 0 else 0.0 for name, m, e in zip(names, mean, error, strict=True)}

    def until(self, target_error: float, max_rounds: int) -> list[int]:
        """Add rounds until every light's error is below ``target_error``; returns the rounds of each light."""
        rounds = [1] * len(self.job.scenes)
        while True:
            self.compute("surface", rounds)
            before = list(rounds)
            for light, done in enumerate(before):
                errors = self.errors(self.estimate(light, "surface", done), light)
                worst = errors["full"] if "full" in errors else max(errors.values())
                if worst > target_error:
                    needed = int(np.ceil(done * (worst / target_error) ** 2 * 1.02))
                    # the first estimates are rough: approach the goal instead of overshooting it
                    rounds[light] = min(max(done + 1, min(needed, 4 * done)), max_rounds)
            if rounds == before:
                return rounds

    def write(
        self, out: Path, surface_rounds: Sequence[int], extra_rounds: Mapping[Quantity, int]
    ) -> tuple[list[Path], list[dict[str, Any]]]:
        """Write tables and images; returns their paths and a summary per light."""
        own = {k: v for k, v in self.receivers.arrays().items() if k in ("position", "normal", "albedo", "mesh_id")}
        files = [out / "receivers.npz"]
        extras = {k: v for k, v in own.items() if k == "mesh_id"}
        save_receivers(
            files[0],
            ReceiverTable(
                self.receivers.position,
                self.receivers.normal,
                self.receivers.area_weight,
                self.receivers.albedo,
                extras,
            ),
        )
        summary: list[dict[str, Any]] = []
        for light, weight in enumerate(self.weights):
            rounds = surface_rounds[light]
            estimate = self.estimate(light, "surface", rounds, count_rays=True)
            part = self.job.parts["surface"]
            files.append(out / f"light_{light}.npz")
            save_table(files[-1], area_weight=weight, **own, **_columns("irr", part.components, estimate))
            summary.append(
                {
                    "hash": self.job.scenes[light].hash,
                    "spp": rounds * REPLICATES * part.samples,
                    "error": self.errors(estimate, light),
                    "receivers_without_weight": int((weight == 0).sum()),
                }
            )
            for quantity, count in extra_rounds.items():
                files += self._write_extra(out, light, quantity, count)
        return files, summary

    def _write_extra(self, out: Path, light: int, quantity: Quantity, rounds: int) -> list[Path]:
        part = self.job.parts[quantity]
        estimate = self.estimate(light, quantity, rounds, count_rays=True)
        if quantity == "probes":
            path = out / f"probes_{light}.npz"
            save_table(path, position=self.job.probes, **_columns("sh", part.components, estimate))
            return [path]
        camera = self.job.camera
        assert camera is not None
        shape = (camera.height, camera.width, 3)
        paths = []
        for index, name in enumerate(part.components.names):
            image = estimate.mean[:, index].reshape(shape)
            paths += [out / f"image_{light}_{name}.exr", out / f"image_{light}_{name}.png"]
            spp = rounds * REPLICATES * part.samples
            error = estimate.standard_error[:, index].reshape(shape)
            write_image(paths[-2], image, error, metadata={"component": name, "spp": spp})
            write_png(paths[-1], image)
        return paths


def _columns(prefix: str, components: Components, estimate: Estimate) -> dict[str, np.ndarray]:
    error = estimate.standard_error
    columns = {}
    for index, name in enumerate(components.names):
        columns[f"{prefix}_{name}"] = estimate.mean[:, index]
        columns[f"se_{name}"] = error[:, index]
    return columns
