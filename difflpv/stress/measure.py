"""One reading: solve, compare with the truth, differentiate, and keep what the library says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from difflpv.config import LpvConfig
from difflpv.grid import Grid
from difflpv.illumination import Component, Illumination, illuminate
from difflpv.loss import relative_l2
from difflpv.pipeline import Lpv
from difflpv.stress.results import Reading
from difflpv.stress.scenes import Case
from difflpv.stress.settings import StressSettings
from difflpv.trouble import describe_trouble

__all__ = ["Bench", "Lit", "read"]


@dataclass(frozen=True)
class Bench:
    """What every experiment gets.

    Attributes:
        settings: sizes.
        methods: solves by name, to be taken with the experiment's own steps.
        folder: for path-traced truth.
    """

    settings: StressSettings
    methods: Mapping[str, LpvConfig]
    folder: Path


@dataclass(frozen=True, eq=False)
class Lit:
    """A case traced for one method, on one grid and for one component."""

    case: Case
    light: Illumination
    component: Component

    @classmethod
    def of(
        cls,
        case: Case,
        config: LpvConfig,
        component: Component,
        *,
        grid: Grid | None = None,
        seed: int = 0,
        dtype: torch.dtype = torch.float32,
        surface_samples: int = 8192,
        area_samples: int = 64,
    ) -> Lit:
        """Trace a case; on its own grid unless another is given."""
        light = illuminate(
            case.scene,
            grid or case.grid,
            config,
            component,
            surface_samples=surface_samples,
            area_samples=area_samples,
            seed=seed,
            dtype=dtype,
        )
        return cls(case, light, component)


def read(
    name: str,
    knob: float,
    lit: Lit,
    config: LpvConfig,
    *,
    values: Mapping[str, float] | None = None,
    by: str | None = "propagation",
    checkpoint_every: int | None = None,
) -> Reading:
    """Solve one case with one method.

    Args:
        name: of the method, for the reading.
        knob: setting, for the reading.
        lit: the case.
        config: the solve.
        values: physical values by name, such as the propagation factor.
        by: derivative of the error with respect to this quantity, None for no gradient.
        checkpoint_every: see ``difflpv.propagation.propagate``.
    """
    lpv = Lpv(lit.light.grid, config, checkpoint_every=checkpoint_every)
    given = {n: torch.tensor(float(v), dtype=torch.float64) for n, v in (values or {}).items()}
    if by is not None:
        given[by] = given.get(by, torch.ones((), dtype=torch.float64)).requires_grad_()
    case, receivers = lit.case, lit.light.receivers(lit.case.position, lit.case.normal)
    try:
        with torch.set_grad_enabled(by is not None):
            irradiance = lpv(lit.light, receivers, given).double()
            truth, weight = torch.as_tensor(case.truth[lit.component]), torch.as_tensor(case.weight)
            error = relative_l2(irradiance, truth, weight)
            gradient = None
            if by is not None:
                gradient = float(torch.autograd.grad(error, given[by])[0].norm())
    except FloatingPointError as problem:
        return Reading(name, knob, message=f"{type(problem).__name__}: {problem}")
    found = irradiance.detach().numpy()
    said = describe_trouble(lpv, lit.light, case.position, case.normal, found, given)
    energy = float(case.weight @ found.sum(1) / (case.weight @ case.truth[lit.component].sum(1)))
    return Reading(name, knob, float(error.detach()), gradient, energy, "\n".join(said))
