"""How much the reconstruction jumps where moving probes change their tetrahedra.

With connectivity held, weights are smooth in the positions; a Delaunay triangulation flips tetrahedra where five probes come to
lie on one sphere, and what it interpolates jumps there (the old and the new tetrahedra disagree in their inside). An optimiser
that steps across sees an error that its gradient did not foretell; this measures how large it is beside a step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from difflpv.probes.probe_set import DIRECTIONS_26, irradiance_of
from difflpv.probes.tetrahedra import TetrahedralInterpolation

__all__ = ["FlipJumps", "flip_jumps"]


@dataclass(frozen=True, eq=False)
class FlipJumps:
    """One row a step of a random motion; changes are relative L2 of irradiance over 26 normals at all points.

    Attributes:
        tetrahedra: how many tetrahedra the step replaced [s]; 0 where nothing flipped.
        step: change by the motion itself, connectivity held [s].
        jump: change by the new connectivity alone, probes held at the end of the step [s].
    """

    tetrahedra: np.ndarray
    step: np.ndarray
    jump: np.ndarray

    @property
    def summary(self) -> dict[str, float]:
        """Share of steps that flip; medians of step and, where one flipped, of jump and jump over step; the worst of these."""
        flipped = self.tetrahedra > 0
        jump = self.jump[flipped] if flipped.any() else np.zeros(1)
        ratio = self.jump[flipped] / self.step[flipped] if flipped.any() else np.zeros(1)
        return {
            "flipping_steps": float(flipped.mean()),
            "step": float(np.median(self.step)),
            "jump": float(np.median(jump)),
            "jump_over_step": float(np.median(ratio)),
            "worst": float(ratio.max()),
        }


def flip_jumps(
    position: np.ndarray, radiance: np.ndarray, points: np.ndarray, *, length: float, steps: int = 100, seed: int = 0
) -> FlipJumps:
    """Move all probes along straight random lines and part the change of each step into motion and flips.

    Args:
        position: probes [n,3] m.
        radiance: what they hold and take along [n,9,C] W/m2.
        points: where irradiance is read [m,3] m.
        length: of a step of each probe, root mean square [m].
        steps: of the motion; every eighth, the directions change.
        seed: of the directions.

    Raises:
        ValueError: a length or number of steps that is not positive, steps so long that each turns tetrahedra inside out (such
            steps cannot be parted and are left out), or no light at the points.
    """
    if not length > 0 or steps < 1:
        raise ValueError(f"flips: expected a length > 0 m and steps > 0, got {length} and {steps}")
    rng = np.random.default_rng(seed)
    content, read = torch.as_tensor(np.asarray(radiance)), torch.as_tensor(np.asarray(points))
    x = np.array(position, np.float64)
    grid = TetrahedralInterpolation(x, connectivity="held")

    def seen(at: np.ndarray) -> torch.Tensor:
        return irradiance_of(grid.rows(torch.from_numpy(at), read).apply(content), DIRECTIONS_26)

    now = seen(x)
    size = float(now.norm())
    if not size > 0:
        raise ValueError("flips: expected light at the points, got none")
    rows = []
    motion = np.zeros_like(x)
    for k in range(steps):
        if k % 8 == 0:
            motion = rng.normal(size=x.shape) * (length / np.sqrt(3))
        before, made = _cells(grid), grid.triangulations
        x = x + motion
        moved = seen(x)
        inside_out = grid.triangulations > made  # the step itself was too long for the old connectivity
        grid.retriangulate(x)
        after = seen(x)
        if not inside_out:
            step, jump = float((moved - now).norm()) / size, float((after - moved).norm()) / size
            rows.append((len(_cells(grid) - before), step, jump))
        now = after
    if not rows:
        raise ValueError(f"flips: every step of {length:g} m turns tetrahedra inside out: take shorter ones")
    tetrahedra, step_change, jump_change = np.array(rows, np.float64).reshape(-1, 3).T
    return FlipJumps(tetrahedra.astype(np.int64), step_change, jump_change)


def _cells(grid: TetrahedralInterpolation) -> set[tuple[int, ...]]:
    return {tuple(sorted(cell)) for cell in grid.tetrahedra.vertices.tolist()}
