"""What is measured on: a scene under its lights, receivers that no method has seen, and the path-traced truth there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_gen.load import Targets
from data_gen.receivers import draw_receivers
from data_gen.targets import make_targets
from difflpv.config import grid_for
from difflpv.evaluate import relative_noise
from difflpv.grid import Grid
from difflpv.illumination import Component
from difflpv.io import load_scene
from difflpv.io.tables import ReceiverTable
from difflpv.leakage import dark_receivers
from difflpv.lights import apply_light_set
from difflpv.scene import AreaLight, Scene

__all__ = ["BUNDLED", "BenchScene", "bench_scenes", "components_of", "targets_in_grid"]

# Bundled scene -> components that a volume carries there: diagonal is one floor, from which nothing bounces to a receiver;
# the halls are lit by the sun, whose direct light is exact in every method.
BUNDLED: dict[str, tuple[Component, ...]] = {
    "cornell": ("bounce1", "direct"),
    "two_rooms_90": ("bounce1", "direct"),
    "diagonal": ("direct",),
    "bunny": ("bounce1",),
    "atrium": ("bounce1",),
    "floor": ("bounce1",),
    "planter": ("bounce1",),
}
_MOST_NOISE = 0.5  # of the truth: what is left then is no signal


@dataclass(frozen=True, eq=False)
class BenchScene:
    """One scene under one set of lights, one component of its light, and the truth at receivers inside the grid.

    Attributes:
        name: of the scene.
        component: "direct" or "bounce1".
        light: number of the light set, -1 for the scene's own lights.
        scene: with its lights.
        position: receivers [n,3] m.
        normal: unit normals [n,3].
        weight: area weights [n] m2.
        truth: irradiance [n,3] W/m2.
        standard_error: of the truth, [n,3].
        dark: receivers of a region that is all but dark, bool [n], or None.
        target_seconds: processor time of the truth of this light set, all its components together.
        folder: where the truth lies.
        seed: of receivers and paths.
    """

    name: str
    component: Component
    light: int
    scene: Scene
    position: np.ndarray
    normal: np.ndarray
    weight: np.ndarray
    truth: np.ndarray
    standard_error: np.ndarray
    dark: np.ndarray | None
    target_seconds: float
    folder: Path
    seed: int

    @property
    def noise(self) -> float:
        """Relative L2 error that a perfect prediction would show."""
        return relative_noise(self.standard_error, self.truth, self.weight)

    @property
    def key(self) -> str:
        """Names scene, light set and component."""
        return f"{self.name}/{self.component}" + (f"/light {self.light}" if self.light >= 0 else "")

    def grid(self, cells: int | None = None) -> Grid:
        """The scene's grid, at so many cells along x if given."""
        return grid_for(self.scene, cells)


def components_of(scene: Scene) -> tuple[Component, ...]:
    """Components of a scene's light that a volume carries: the bounce, and the direct light of area lights."""
    has_area = any(isinstance(light, AreaLight) for light in scene.lights)
    return ("bounce1", "direct") if has_area else ("bounce1",)


def targets_in_grid(
    scene: Scene,
    folder: str | Path,
    *,
    components: Sequence[Component],
    receivers: int | ReceiverTable,
    spp: int,
    light_sets: Sequence[Sequence[Mapping[str, Any]]] | None = None,
    seed: int = 0,
    workers: int = 1,
) -> Targets:
    """Path-traced irradiance of receivers drawn by area inside the scene's grid, from ``folder`` if it lies there.

    Args:
        scene: with a grid of its own or the default one.
        folder: made if missing; targets of another request in it are replaced.
        components: as for ``data_gen.targets.make_targets``.
        receivers: how many, or those drawn before.
        spp: paths per receiver.
        light_sets: for ``difflpv.lights.apply_light_set``; None for the scene's own lights.
        seed: of receivers and paths.
        workers: processes of the path tracer.
    """
    if isinstance(receivers, int):
        receivers = draw_receivers(scene, receivers, seed, within=grid_for(scene))
    return make_targets(
        scene, folder, receivers=receivers, components=components, spp=spp, light_sets=light_sets, seed=seed, workers=workers,
        overwrite=True, progress=False,
    )  # fmt: skip


def bench_scenes(
    source: str | Path | Scene,
    folder: str | Path,
    *,
    components: Sequence[Component] | None = None,
    light_sets: Sequence[Sequence[Mapping[str, Any]]] | None = None,
    receivers: int = 2000,
    spp: int = 2048,
    seed: int = 0,
    workers: int = 1,
) -> tuple[BenchScene, ...]:
    """Trace the truth of a scene, or find it in ``folder``; one result per light set and component.

    Components without light, or whose truth is mostly noise, are left out: there is nothing there to be measured.

    Args:
        source: a bundled scene's name, a file, or a scene.
        folder: for the truth; made if missing.
        components: "direct", "bounce1"; by default those of ``BUNDLED``, or all that a volume carries.
        light_sets: for ``difflpv.lights.apply_light_set``; None for the scene's own lights.
        receivers: how many, drawn by area inside the grid.
        spp: paths per receiver.
        seed: of receivers and paths; another seed draws other receivers.
        workers: processes of the path tracer.
    """
    scene = source if isinstance(source, Scene) else load_scene(source)
    wanted = tuple(components or BUNDLED.get(scene.name, ()) or components_of(scene))
    out = Path(folder)
    targets = targets_in_grid(
        scene, out, components=wanted, receivers=receivers, spp=spp, light_sets=light_sets, seed=seed, workers=workers
    )
    position, normal = targets.receivers.position.astype(float), targets.receivers.normal.astype(float)
    dark = dark_receivers(scene.name, position)
    found = []
    for light in targets.lights:
        lit = scene if light_sets is None else apply_light_set(scene, light_sets[light.index])
        for component in wanted:
            one = BenchScene(
                name=scene.name,
                component=component,
                light=-1 if light_sets is None else light.index,
                scene=lit,
                position=position,
                normal=normal,
                weight=light.area_weight.astype(float),
                truth=light.irradiance[component].astype(float),
                standard_error=light.standard_error[component].astype(float),
                dark=dark,
                target_seconds=float(targets.manifest["seconds"]) / len(targets.lights),
                folder=out,
                seed=seed,
            )
            if one.truth.any() and one.noise < _MOST_NOISE:
                found.append(one)
    return tuple(found)
