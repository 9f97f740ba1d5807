"""The light propagation volume as a module: what can be learned, and the stages in order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from difflpv.config import LpvConfig
from difflpv.fitted import FittedError, FittedRecord, read_fitted, write_fitted
from difflpv.grid import Grid
from difflpv.illumination import Illumination, LightValues, Receivers
from difflpv.injection import InjectionReport, inject
from difflpv.learnables import describe_learnables, fixed_values
from difflpv.occlusion import attenuate
from difflpv.parameters import Parameter
from difflpv.propagation import propagate
from difflpv.sampling import sample_irradiance
from difflpv.scene import Scene

__all__ = ["Lpv"]


class Lpv(torch.nn.Module):
    """Differentiable LPV or HOLPV solve.

    Learnables (``difflpv.learnables``) are switched on by name. Each is held as an unconstrained ``raw_<name>`` parameter
    (float64) behind a smooth map to its bounds, so that any torch optimiser may move it; ``values()`` are the physical
    values. A solver that works on physical values passes them to ``forward`` instead.

    Example::

        scene = load_scene("cornell")
        grid = grid_for(scene)
        config = LpvConfig(method="holpv", occlusion="exp")
        lpv = Lpv(grid, config, learn=("propagation", "occlusion"))
        light = illuminate(scene, grid, config, "bounce1")
        irradiance = lpv(light, light.receivers(position, normal))  # [n,3] W/m2
    """

    def __init__(
        self,
        grid: Grid,
        config: LpvConfig | None = None,
        *,
        learn: Sequence[str] = (),
        scene: Scene | None = None,
        initial: Mapping[str, Any] | None = None,
        checkpoint_every: int | None = None,
    ) -> None:
        """Set up a solve.

        Args:
            grid: cells of the volume.
            config: method, steps, occlusion and conventions; default HOLPV as published.
            learn: names from ``difflpv.learnables.LEARNABLES``.
            scene: needed where lights or albedo are learned.
            initial: starting values of what is learned.
            checkpoint_every: see ``difflpv.propagation.propagate``.

        Raises:
            ValueError: a learnable that is unknown or that this configuration cannot learn.
        """
        super().__init__()
        self.grid = grid
        self.config = config or LpvConfig()
        self.checkpoint_every = checkpoint_every
        self.described: tuple[Parameter, ...] = tuple(describe_learnables(learn, self.config, grid, scene, initial))
        self._fixed = fixed_values(self.config)
        for parameter in self.described:
            raw = torch.nn.Parameter(parameter.to_raw(parameter.initial))
            self.register_parameter(f"raw_{parameter.name}", raw)
        self.report: InjectionReport | None = None

    @property
    def learned(self) -> tuple[str, ...]:
        """Names of what is learned."""
        return tuple(p.name for p in self.described)

    def values(self) -> dict[str, torch.Tensor]:
        """Physical values of everything that is learned, float64, differentiable in the raw parameters."""
        return {p.name: p.to_physical(getattr(self, f"raw_{p.name}")) for p in self.described}

    @torch.no_grad()
    def set_values(self, values: Mapping[str, torch.Tensor]) -> None:
        """Put physical values in place, strictly inside their bounds."""
        for parameter in self.described:
            getattr(self, f"raw_{parameter.name}").copy_(parameter.to_raw(parameter.nudge_inside(values[parameter.name])))

    def step_factors(self, values: Mapping[str, torch.Tensor] | None = None) -> torch.Tensor:
        """Propagation factor of each step [steps], float64, detached; ``values`` as in ``forward``."""
        merged = {**self._fixed, **self.values(), **(values or {})}
        return (merged["propagation"] * merged["propagation_steps"]).detach().double().cpu()

    def save(self, folder: str | Path, *, provenance: Mapping[str, Any] | None = None) -> None:
        """Write ``fitted.json`` and ``fitted.safetensors``; ``provenance`` says where the values come from."""
        values = {name: value.detach() for name, value in self.values().items()}
        write_fitted(folder, FittedRecord(self.config, self.grid, values, dict(provenance or {})))

    @classmethod
    def load(cls, folder: str | Path, *, scene: Scene | None = None, grid: Grid | None = None) -> Lpv:
        """Read a model written by ``save``.

        Args:
            folder: as given to ``save``.
            scene: needed where lights or albedo were learned.
            grid: another grid than the one it was fitted on; biases are in cells, so they carry over.

        Raises:
            FittedError: missing or damaged files, another format, values that do not fit their names.
        """
        record = read_fitted(folder)
        try:
            lpv = cls(grid or record.grid, record.config, learn=tuple(record.values), scene=scene)
            lpv.set_values(record.values)
        except (TypeError, ValueError, RuntimeError) as error:
            raise FittedError(f"{folder}: {' '.join(str(error).split())}") from None
        return lpv

    def forward(
        self, illumination: Illumination, receivers: Receivers, values: Mapping[str, torch.Tensor] | None = None
    ) -> torch.Tensor:
        """Irradiance of receivers.

        Args:
            illumination: the scene under one set of lights (``illuminate``), on this module's grid and configuration.
            receivers: from ``illumination.receivers``.
            values: physical values by name in place of this module's own; names left out keep theirs.

        Returns:
            Irradiance [n,3] W/m2, in the precision of ``illumination``. ``self.report`` tells what injection lost.

        Raises:
            ValueError: an illumination made for another grid, or without the occlusion that the configuration names.
            FloatingPointError: the result is not finite.
        """
        v = self._complete(values, receivers.position)
        irradiance = sample_irradiance(
            self.accumulate(illumination, values), receivers.position, receivers.normal, self.grid, bias=v["sampling_bias"]
        )
        direct = illumination.punctual_irradiance(receivers, _light_values(v))
        if direct is not None:
            irradiance = irradiance + direct
        if not torch.compiler.is_compiling() and not bool(irradiance.isfinite().all()):
            raise FloatingPointError(self._not_finite({name: value.detach() for name, value in v.items()}))
        return irradiance

    def accumulate(self, illumination: Illumination, values: Mapping[str, torch.Tensor] | None = None) -> torch.Tensor:
        """The solved volume [3, K, n_z, n_y, n_x] W/sr: shade, inject, occlude, propagate."""
        if illumination.grid != self.grid:
            raise ValueError(f"illumination: expected one made for {self.grid}, got {illumination.grid}")
        config = self.config
        if config.occlusion != "none" and illumination.potential is None:
            raise ValueError(f"illumination: made without occlusion, this solve needs '{config.occlusion}'")
        v = self._complete(values, illumination.emitters.position)
        stencil = config.stencil
        vpls = illumination.vpls(_light_values(v))
        volume, self.report = inject(
            vpls, self.grid, l_max=stencil.l_max, deposit=config.deposit, bias=v["injection_bias"]
        )
        passed = None
        if config.occlusion != "none" and illumination.potential is not None:
            passed = attenuate(illumination.potential, model=config.occlusion, strength=v["occlusion"])
        return propagate(
            volume,
            stencil,
            steps=config.steps,
            factor=v["propagation"] * v["propagation_steps"],
            transmittance=passed,
            occlude_first_step=config.occlude_first_step,
            clamp=config.clamp,
            tolerance=config.tolerance,
            checkpoint_every=self.checkpoint_every,
        )

    def _complete(self, values: Mapping[str, torch.Tensor] | None, like: torch.Tensor) -> dict[str, torch.Tensor]:
        merged = {**self._fixed, **self.values(), **(values or {})}
        return {name: value.to(dtype=like.dtype, device=like.device) for name, value in merged.items()}

    def _not_finite(self, values: Mapping[str, torch.Tensor]) -> str:
        gain = float((values["propagation"] * values["propagation_steps"]).max()) if self.config.steps else 0.0
        if gain > self.config.critical_factor:
            return (
                f"irradiance is not finite: the propagation factor {gain:.4g} lies beyond its critical value "
                f"{self.config.critical_factor:g}, so {self.config.steps} steps overflow; lower it or take fewer steps"
            )
        return "irradiance is not finite: check the values " + ", ".join(
            f"{name} = {float(value.max()):.4g}" for name, value in values.items() if value.numel()
        )


def _light_values(values: Mapping[str, torch.Tensor]) -> LightValues:
    return LightValues(
        values.get("light_intensity"), values.get("light_color"), values.get("light_position"), values.get("albedo")
    )
