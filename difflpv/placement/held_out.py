"""Judging probes by what no placement has seen: other points, other lights, and content baked for these lights.

Two folders of targets of one scene: A placed the probes, B judges them. Light sets of B that A has too are left out (the
scene's own lights come first in both). Points of B are split: by the first part content may be fitted, on the second everything
is judged. A method is thus judged by where it puts probes and how they are read, never by how well it knows one light.

"traced" content is path-traced where the probes stand, which is what games bake. "fitted" content solves the first part by
least squares, with a weak pull toward the traced one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch

from data_gen.freespace import is_free
from data_gen.load import TargetsError
from data_gen.probe_content import trace_probes
from data_gen.probe_targets import ProbeTargets
from difflpv.placement.from_targets import light_channels, placement_task, split_points
from difflpv.placement.reconstruction import fitted_content, irradiance_coordinates
from difflpv.placement.task import PlacementTask
from difflpv.probes.reader import ProbeReader
from difflpv.scene import Scene

__all__ = ["BAKED_CONTENTS", "BakedContent", "HeldOut"]

BakedContent = Literal["fitted", "traced"]

BAKED_CONTENTS: tuple[BakedContent, ...] = get_args(BakedContent)
"""Ways of baking content for the judging lights."""


_TRIES = 4  # one set of 64 paths may all miss the light in a dark corner


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Points and lights that judge.

    Attributes:
        scene: the scene.
        targets: B of the module.
        lights: numbers of its light sets that judge.
        left_out: numbers of those that placed the probes too.
        fit: the points by which content is fitted, under ``lights``.
        judge: the points that judge.
        surface: True for those of ``judge`` that lie over surfaces [m].
        noise: standard error of the truth at the points of ``judge``, in relative L2 of irradiance over 26 normals: no error
            below it can be told from none.
    """

    scene: Scene
    targets: ProbeTargets
    lights: tuple[int, ...]
    left_out: tuple[int, ...]
    fit: PlacementTask
    judge: PlacementTask
    surface: np.ndarray
    noise: float

    @classmethod
    def of(
        cls, scene: Scene, targets: ProbeTargets, placed_by: ProbeTargets | None = None, *, share: float = 0.75
    ) -> HeldOut:
        """Split what judges.

        Args:
            scene: which both targets were made for.
            targets: B of the module.
            placed_by: A of the module; None if not known, and then no light set is left out.
            share: of B's points that content is fitted by.

        Raises:
            TargetsError: targets of another scene or component, points that both have, or no light set is left.
            ValueError: a share that is none, or that leaves one part empty.
        """
        targets.check_scene(scene)
        seen: set[str] = set()
        if placed_by is not None:
            placed_by.check_scene(scene)
            if placed_by.component != targets.component:
                raise TargetsError(
                    f"{targets.folder}: expected {placed_by.component}, which placed the probes, got {targets.component}"
                )
            if {p.tobytes() for p in placed_by.points} & {p.tobytes() for p in targets.points}:
                raise TargetsError(f"{targets.folder}: has points of {placed_by.folder}: make them with another seed")
            seen = {light["hash"] for light in placed_by.manifest["lights"]}
        hashes = [light["hash"] for light in targets.manifest["lights"]]
        lights = tuple(k for k, name in enumerate(hashes) if name not in seen)
        if not lights:
            raise TargetsError(f"{targets.folder}: all light sets placed the probes: make some with other lights")
        first, second = split_points(targets, share)
        return cls(
            scene,
            targets,
            lights,
            tuple(k for k in range(len(hashes)) if k not in lights),
            placement_task(scene, targets, lights=lights, points=first),
            placement_task(scene, targets, lights=lights, points=second),
            second >= len(targets.points) - targets.surface_count,
            _noise(targets, list(lights), second),
        )

    def traced(self, position: np.ndarray, *, spp: int = 4096, seed: int = 0, workers: int = 1) -> torch.Tensor:
        """Path-traced content of probes at ``position`` [n,3] m for the judging lights [n,9,C] W/m2."""
        sets = [self.targets.light_sets[k] for k in self.lights]
        options = {"component": self.targets.component, "spp": spp, "seed": seed, "workers": workers, "progress": False}
        found = trace_probes(self.scene, position, light_sets=sets, **options).mean  # type: ignore[arg-type]
        return torch.as_tensor(light_channels(found))

    def fitted(self, position: np.ndarray, reader: ProbeReader, traced: torch.Tensor) -> torch.Tensor:
        """Content by least squares over the points of ``fit`` with a pull toward ``traced`` [n,9,C] W/m2."""
        position = np.array(position, np.float64)  # a copy: those of probe sets cannot be written to, which torch warns about
        x = torch.from_numpy(position)
        interpolation = reader.over(position, self.scene, raycaster=self.fit.raycaster)
        with torch.no_grad():
            return fitted_content(self.fit, x, interpolation.rows(x, self.fit.points), toward=traced)

    def in_solids(self, position: np.ndarray) -> int:
        """How many probes at ``position`` [n,3] m stand in a solid (``data_gen.freespace.is_free``)."""
        inside = np.asarray(position, np.float64)
        for seed in range(_TRIES):
            inside = inside[~is_free(self.scene, inside, seed)]
        return len(inside)


def _noise(targets: ProbeTargets, lights: list[int], points: np.ndarray) -> float:
    # a sum of squares: the noise of different coefficients adds up like their values
    spread, value = (
        irradiance_coordinates(torch.as_tensor(light_channels(part[lights][:, points])))
        for part in (targets.standard_error, targets.radiance)
    )
    return float(spread.norm() / value.norm()) if bool(value.any()) else 0.0
