"""What a tolerance is held to: points and light sets that no position has seen, bounded by a bootstrap over the points.

Error at other points under the lights that placed is too good: positions follow these lights. So every third light set and
every fifth point are held out. What the probes hold under the lights held out is fitted to the points that placed, as a game
bakes its own light into probes that stay where they are; the points held out judge. The bound of their error is a quantile of
a bootstrap over both, points and lights (``difflpv.error_bounds``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from difflpv.error_bounds import ErrorSamples, Estimate
from difflpv.placement.descent import Descent, Probes
from difflpv.placement.reconstruction import fitted_content, irradiance_coordinates
from difflpv.placement.task import PlacementTask

__all__ = ["Unseen"]

_POINTS, _LIGHTS = 5, 3  # every so manieth judges


@dataclass(frozen=True, eq=False)
class Unseen:
    """A task in parts.

    Attributes:
        train: points and lights that place.
        fit: the same points under the lights that judge: what probes hold there is fitted to these.
        judge: the other points under the lights that judge.
        lights: numbers of the light sets held out; empty where the task has fewer than three, all of which place and judge.
    """

    train: PlacementTask
    fit: PlacementTask
    judge: PlacementTask
    lights: tuple[int, ...]

    @classmethod
    def of(cls, task: PlacementTask) -> Unseen:
        """Hold out.

        Raises:
            ValueError: fewer than five points, or none of those held out gets light.
        """
        count = len(task.points)
        if count < _POINTS:
            raise ValueError(f"tolerance: expected at least {_POINTS} points, some to be held out, got {count}")
        others = torch.arange(count) % _POINTS == _POINTS - 1
        lights = range(task.light_count)
        unseen = lights[_LIGHTS - 1 :: _LIGHTS]
        placing = [number for number in lights if number not in unseen]
        judging = unseen or lights
        judge = task.part(points=others, lights=judging)
        if not (judge.weights[:, None, None] * judge.radiance).any():  # nothing would be an error there
            sets = ", ".join(map(str, judging))
            raise ValueError(f"tolerance: expected light at the points held out under light sets {sets}, got none")
        fit = task.part(points=~others, lights=judging)
        return cls(task.part(points=~others, lights=placing), fit, judge, tuple(unseen))

    @torch.no_grad()
    def error(self, descent: Descent, probes: Probes, *, confidence: float) -> Estimate:
        """Relative L2 error of irradiance over 26 normals, root mean square over lights, and its one-sided bounds.

        Args:
            descent: how probes are read and what they hold; its task is not used.
            probes: which.
            confidence: of each bound, in [0.5, 1).
        """
        position = torch.tensor(probes.position)
        reader = descent.settled(probes).over(probes.position, self.judge.scene, raycaster=descent.task.raycaster)
        if descent.reconstruction.content == "fitted":
            rows = reader.rows(position, self.fit.points)
            held = fitted_content(self.fit, position, rows, ridge=descent.reconstruction.ridge)
        else:
            held = self.judge.field(position)
        found = reader.rows(position, self.judge.points).apply(irradiance_coordinates(held))
        truth = irradiance_coordinates(self.judge.radiance)
        squared, power = (_by_light(self.judge, part) for part in (found - truth, truth))
        lit = power.any(1)
        return ErrorSamples(squared[lit], power[lit]).estimate(confidence=confidence, draw_cases=bool(self.lights))


def _by_light(task: PlacementTask, values: torch.Tensor) -> np.ndarray:
    """Weighted squares of ``values`` [m,9,3L] in [L,m]."""
    square = values.square().unflatten(2, (-1, 3)).sum((1, 3))
    return (task.weights[:, None] * square).T.numpy()
