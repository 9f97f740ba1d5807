"""The light propagation volume as a module: what can be learned, and the stages in order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import torch

from difflpv.attenuation import attenuate_pairs
from difflpv.blocking import Blocking
from difflpv.config import LpvConfig
from difflpv.damping import damped_irradiance
from difflpv.fitted import FittedError, FittedRecord, read_fitted, write_fitted
from difflpv.grid import Grid
from difflpv.illumination import Illumination, LightValues, Receivers
from difflpv.injection import InjectionReport, inject
from difflpv.learnables import LEARNABLES, describe_learnables, fixed_values
from difflpv.lit_probes import probe_radiance
from difflpv.parameters import Parameter
from difflpv.probes.lookup import probe_irradiance
from difflpv.propagation import propagate, propagate_moving
from difflpv.sampling import sample_irradiance
from difflpv.scene import Scene
from difflpv.stencil import LinearStencil, pair_offsets
from difflpv.stencil_coordinates import StencilCoordinates
from difflpv.weighted import gather_lobes

__all__ = ["Lpv", "coarsen"]


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
        stencil = self.config.stencil
        self._coordinates = None
        if "stencil" in learn and isinstance(stencil, LinearStencil):
            self._coordinates = StencilCoordinates.for_stencil(stencil)
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
            inside = parameter.nudge_inside(values[parameter.name].cpu())
            getattr(self, f"raw_{parameter.name}").copy_(parameter.to_raw(inside))

    def step_factors(self, values: Mapping[str, torch.Tensor] | None = None) -> torch.Tensor:
        """Propagation factor of each step [steps], float64, detached; ``values`` as in ``forward``."""
        merged = {name: value.detach().cpu().double() for name, value in self._merged(values).items()}
        return merged["propagation"] * merged["propagation_steps"]

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
            ValueError: an illumination made for another grid, or without the occlusion that the configuration names; a value of
                no learnable.
            FloatingPointError: the result is not finite.
        """
        return self.gather(self.accumulate(illumination, values, receivers), illumination, receivers, values)

    def gather(
        self,
        volumes: Sequence[torch.Tensor],
        illumination: Illumination,
        receivers: Receivers,
        values: Mapping[str, torch.Tensor] | None = None,
    ) -> torch.Tensor:
        """Irradiance [n,3] W/m2 of receivers: from the volumes of ``accumulate``, and from punctual lights by shadow rays.

        Raises:
            FloatingPointError: the result is not finite.
        """
        v = self._complete(values, receivers.position)
        irradiance = self.read(volumes, receivers, values)
        direct = illumination.punctual_irradiance(receivers, _light_values(v))
        if direct is not None:
            irradiance = irradiance + direct
        if not torch.compiler.is_compiling() and not bool(irradiance.isfinite().all()):
            raise FloatingPointError(self._not_finite({name: value.detach() for name, value in v.items()}))
        return irradiance

    def accumulate(
        self,
        illumination: Illumination,
        values: Mapping[str, torch.Tensor] | None = None,
        receivers: Receivers | None = None,
    ) -> tuple[torch.Tensor, ...]:
        """The solved volume [3, K, n_z, n_y, n_x] W/sr of each grid, finest first: shade, inject, occlude, propagate.

        With ``receivers`` only what they read is complete: what nobody reads is left out.
        """
        boxes = () if receivers is None else receivers.boxes
        volume, options = self._start(illumination, values, boxes)
        stencil, first, steps = self.config.stencil, self.config.fine_steps, self.config.steps
        if first == steps:
            return (propagate(volume, stencil, **options(0, 0, steps)),)
        # what still moves is read where it goes on, in the coarse cells
        solved, rest = propagate_moving(volume, stencil, **options(0, 0, first))
        return solved - rest, propagate(coarsen(rest), stencil, **options(1, first, steps))

    def moving(
        self, illumination: Illumination, values: Mapping[str, torch.Tensor] | None = None
    ) -> Iterator[torch.Tensor]:
        """The light S_i [3, K, n_z, n_y, n_x] W/sr that moves after each step: S_0, the injected volume, to S_steps.

        The volumes on each grid add up to what ``accumulate`` returns for it, where the configuration's ``tolerance`` is 0;
        S_i with i >= ``config.fine_steps`` (where that is below ``config.steps``) is on the coarser grid.
        """
        light, options = self._start(illumination, values)
        stencil, first, steps = self.config.stencil, self.config.fine_steps, self.config.steps
        yield light
        for step in range(steps):
            light = propagate_moving(light, stencil, **options(int(step >= first), step, step + 1))[1]
            if step + 1 == first < steps:
                light = coarsen(light)
            yield light

    def _start(
        self,
        illumination: Illumination,
        values: Mapping[str, torch.Tensor] | None,
        boxes: Sequence[Sequence[int]] = (),
    ) -> tuple[torch.Tensor, Callable[[int, int, int], dict[str, Any]]]:
        """The injected volume, and ``options(level, begin, end)`` of ``propagate`` for those steps on one of the grids."""
        if illumination.grid != self.grid:
            raise ValueError(f"illumination: expected one made for {self.grid}, got {illumination.grid}")
        config = self.config
        v = self._complete(values, illumination.emitters.position)
        stencil = config.stencil
        vpls, bias = illumination.vpls(_light_values(v)), v["injection_bias"]
        cells = illumination.vpl_cells(vpls, float(bias.detach())) if config.deposit == "visible" else None
        volume, self.report = inject(
            vpls, self.grid, l_max=stencil.l_max, deposit=config.deposit or "nearest", bias=bias, open_cells=cells
        )
        matrices = None
        if self._coordinates is not None:
            z = self._merged(values)["stencil"]  # not in the precision of the light
            matrices = self._coordinates.matrices(z.cpu().double()).to(volume)
        factors = v["propagation"] * v["propagation_steps"]
        passing = cache(lambda level: self._transmittance(illumination, level, v))

        def options(level: int, begin: int, end: int) -> dict[str, Any]:
            return {
                "steps": end - begin,
                "factor": factors[begin:end],
                "transmittance": passing(level),
                # without blockers only a field of the cells acts there, which is no self-shadowing
                "occlude_first_step": bool(config.occlude_first_step) or begin > 0 or config.occlusion == "none",
                "clamp": config.clamp,
                "matrices": matrices,
                "tolerance": config.tolerance,
                "checkpoint_every": self.checkpoint_every,
                # light that goes on in coarser cells is read everywhere
                "read_box": boxes[level] if level < len(boxes) and end == config.steps else None,
            }

        return volume, options

    def _transmittance(
        self, illumination: Illumination, level: int, v: Mapping[str, torch.Tensor]
    ) -> torch.Tensor | None:
        """What passes between cells, per pair of a linear stencil or face of a face stencil; None where nothing blocks."""
        config, stencil = self.config, self.config.stencil
        offsets = pair_offsets(stencil.offsets) if isinstance(stencil, LinearStencil) else stencil.offsets
        traced = config.occlusion == "traced"
        blocking = illumination.blocking[level] if level < len(illumination.blocking) else Blocking()
        blockers = blocking.passed if traced else blocking.potential
        if config.occlusion == "none":
            blockers = None
        elif blockers is None or len(blockers) != len(offsets):
            made = illumination.config
            raise ValueError(
                f"illumination: made for '{made.method}' with occlusion '{made.occlusion}' on {len(illumination.blocking)} "
                f"grid(s), this solve needs '{config.method}' with '{config.occlusion}' on {level + 1} or more"
            )
        return attenuate_pairs(
            offsets,
            potential=None if traced else blockers,
            passed=blockers if traced else None,
            model="exp" if config.occlusion == "exp" else "clamp",
            strength=v["occlusion"],
            correction=v.get("occlusion_correction"),
            cell_occlusion=v.get("cell_occlusion"),
            cell_propagation=v.get("cell_propagation"),
        )

    def read(
        self, volumes: Sequence[torch.Tensor], receivers: Receivers, values: Mapping[str, torch.Tensor] | None = None
    ) -> torch.Tensor:
        """Irradiance [n,3] W/m2 of receivers from the volumes that ``accumulate`` returns."""
        v = self._complete(values, receivers.position)
        degrees = torch.arange(self.config.stencil.l_max + 1, device=receivers.position.device)
        gains = v["lookup_gains"].repeat_interleave(2 * degrees + 1)
        x, n, grids = receivers.position, receivers.normal, self.config.grids(self.grid)
        if self.config.lookup in ("trilinear", "damped"):
            sample = sample_irradiance if self.config.lookup == "trilinear" else damped_irradiance
            parts = [
                sample(volume * gains[:, None, None, None], x, n, grid, bias=v["sampling_bias"])
                for volume, grid in zip(volumes, grids, strict=True)
            ]
            return torch.stack(parts).sum(0)
        if (receivers.rows is None) == bool(self.config.probes):
            raise ValueError("receivers: made for a configuration with light probes, this one has none, or the other way round")
        if receivers.lookup != self.config.lookup or len(receivers.reads) < len(grids):
            raise ValueError(
                f"receivers: made for lookup '{receivers.lookup}' on {len(receivers.reads)} grid(s), this solve needs "
                f"'{self.config.lookup}' on {len(grids)}"
            )
        if receivers.rows is not None:
            held = probe_radiance(volumes, grids, receivers.reads[: len(grids)], gains)
            return probe_irradiance(receivers.rows, held, n)
        lobe, parts = receivers.lobes(self.config.stencil.l_max), []
        for volume, grid, r in zip(volumes, grids, receivers.reads[: len(grids)], strict=True):
            lobes = torch.addcmul(lobe, lobe * r.backed[:, None], gains - 1)
            parts.append(gather_lobes(volume, r.cells, r.weights, lobes) / grid.cell_size**2)
        return torch.stack(parts).sum(0)

    def _complete(self, values: Mapping[str, torch.Tensor] | None, like: torch.Tensor) -> dict[str, torch.Tensor]:
        return {name: value.to(dtype=like.dtype, device=like.device) for name, value in self._merged(values).items()}

    def _merged(self, values: Mapping[str, torch.Tensor] | None) -> dict[str, torch.Tensor]:
        """Everything that a solve needs, as it is held: fixed, then learned, then given."""
        for name in values or ():
            if name not in LEARNABLES or (name == "stencil" and self._coordinates is None):
                raise ValueError(f"values: expected names of learnables (a stencil's only where it is learned), got {name!r}")
        return {**self._fixed, **self.values(), **(values or {})}

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


def coarsen(volume: torch.Tensor) -> torch.Tensor:
    """Intensity in cells of twice the edge: sums of 2 x 2 x 2 cells, shape [C, K, ceil(n_z/2), ceil(n_y/2), ceil(n_x/2)]."""
    z, y, x = volume.shape[2:]
    even = torch.nn.functional.pad(volume, (0, x % 2, 0, y % 2, 0, z % 2))
    return even.unflatten(4, (-1, 2)).unflatten(3, (-1, 2)).unflatten(2, (-1, 2)).sum((3, 5, 7))


def _light_values(values: Mapping[str, torch.Tensor]) -> LightValues:
    return LightValues(
        values.get("light_intensity"), values.get("light_color"), values.get("light_position"), values.get("albedo")
    )
