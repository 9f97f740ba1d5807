"""The page itself: viser's server, the panel of sliders, and a worker that solves and draws what they say."""

from __future__ import annotations

import contextlib
import io
import time
from typing import Any

import numpy as np

from difflpv.scene import AreaLight, DirectionalLight
from difflpv.shapes.overview import outside_camera
from difflpv.shapes.shape import Shape
from difflpv.viewer.glb import shape_glb
from difflpv.viewer.look import PROBE_LIGHTS, SURFACES, Look, layers
from difflpv.viewer.probe_view import ProbeView
from difflpv.viewer.state import AXES, Knobs, Solved, ViewState
from difflpv.viewer.worker import LatestWorker

_PARSING = 0.25  # seconds that a browser gets for a GLB

__all__ = ["MissingViserError", "Page", "require_viser"]

_QUANTITIES = {"moves in this step": "moving", "sum of the steps so far": "sum"}
_SURFACES = dict(zip(("lit by the volume", "white, lit", "albedo", "hidden"), SURFACES, strict=True))
_PROBE_LIGHTS = dict(zip(("the volume", "the file"), PROBE_LIGHTS, strict=True))


class MissingViserError(ImportError):
    """The page needs viser, an optional package: one line that says how to get it."""


def require_viser() -> Any:
    """The module viser, or a ``MissingViserError``."""
    try:
        import viser
    except ImportError:
        raise MissingViserError("the page needs viser: pip install 'difflpv[view]' (--png draws without it)") from None
    return viser


class Page:
    """A page that shows ``state``; it is up when the constructor returns, and ``close`` ends it."""

    def __init__(
        self, state: ViewState, probes: ProbeView, *, host: str = "127.0.0.1", port: int = 8080, look: Look | None = None
    ) -> None:
        """Start serving.

        Args:
            state: what is solved.
            probes: what is shown of probes; their places are those of ``state``.
            host: address to listen on.
            port: first port to try; the next free one is taken.
            look: how the page starts.

        Raises:
            MissingViserError: viser is not installed.
        """
        viser = require_viser()
        self.state, self.probes = state, probes
        with contextlib.redirect_stdout(io.StringIO()):  # viser's own banner, which names no ssh
            self._server = viser.ViserServer(host=host, port=port, label=f"difflpv: {state.scene.name}", verbose=False)
        self._solved: Solved | None = None
        self._drawn: dict[str, tuple[tuple[Any, ...] | None, Any]] = {}
        self._count = 0
        self._seconds = 0.0
        self._worker: LatestWorker[tuple[Knobs, Look]] = LatestWorker(self._work, self._failed)
        self._set_up(look or Look(step=state.steps, index=state.lpv.grid.resolution[2] // 2))
        self._ask()

    @property
    def port(self) -> int:
        """The port it listens on."""
        return int(self._server.get_port())

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until everything asked for is drawn; False after ``timeout`` seconds."""
        return self._worker.wait(timeout)

    def close(self) -> None:
        """Stop serving."""
        self._worker.close()
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _set_up(self, look: Look) -> None:
        server, scene = self._server, self.state.scene
        server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True, control_width="medium")
        server.scene.set_up_direction("+y")
        server.scene.world_axes.visible = False
        server.scene.set_background_image(np.full((4, 4, 3), 24, np.uint8))
        low, high = scene.bounds
        camera = outside_camera(scene)
        view = server.initial_camera
        eye, ahead = camera.to_world[:3, 3], -camera.to_world[:3, 2]
        distance = max(float(((low + high) / 2 - eye) @ ahead), 0.3 * float((high - low).max()))
        view.position, view.look_at, view.fov = tuple(eye), tuple(eye + distance * ahead), camera.yfov
        self._add_light(float((high - low).max()))
        self._add_transport()
        self._add_volume(look)
        self._add_surfaces(look)
        self._add_probes(look)
        self._status = server.gui.add_markdown("solving ...")

    def _control(self, handle: Any) -> Any:
        """A control that asks for work when it changes."""
        handle.on_update(lambda _: self._ask())
        return handle

    def _slider(self, label: str, low: float, high: float, step: float, value: float, **options: Any) -> Any:
        return self._control(self._server.gui.add_slider(label, low, high, step, value, **options))

    def _check(self, label: str, value: bool, **options: Any) -> Any:
        return self._control(self._server.gui.add_checkbox(label, value, **options))

    def _choice(self, label: str, options: dict[str, Any], value: Any, **more: Any) -> Any:
        initial = next(name for name, meaning in options.items() if meaning == value)
        return self._control(self._server.gui.add_dropdown(label, tuple(options), initial_value=initial, **more))

    def _add_light(self, extent: float) -> None:
        self._lights: list[tuple[Any, list[Any]]] = []
        reach = round(extent / 2, 2)
        for light in self.state.scene.lights:
            name = light.mesh if isinstance(light, AreaLight) else light.name
            with self._server.gui.add_folder(f"Light '{name}'", expand_by_default=not self._lights):
                stops = self._slider("intensity", -4.0, 4.0, 0.1, 0.0, hint="stops: +1 doubles the light")
                fixed = isinstance(light, DirectionalLight)
                moves = [
                    self._slider(f"move {a} [m]", -reach, reach, round(reach / 100, 4) or 1e-4, 0.0, disabled=fixed)
                    for a in AXES
                ]
            self._lights.append((stops, moves))

    def _add_transport(self) -> None:
        config = self.state.lpv.config
        with self._server.gui.add_folder("Transport"):
            self._propagation = self._slider(
                "propagation", 0.0, 1.2, 0.01, 1.0, hint=f"times the model's factor; critical: {config.critical_factor:g}"
            )
            blocked = config.occlusion != "none"
            self._occlusion = self._slider(
                "occlusion", 0.0, 4.0, 0.05, 1.0, disabled=not blocked, hint="times the model's strength of occlusion"
            )

    def _add_volume(self, look: Look) -> None:
        self._reversed_axes = {f"across {a}": a for a in AXES}
        with self._server.gui.add_folder("Volume"):
            self._lobes = self._check("SH lobes of a slice", look.lobes)
            self._step = self._slider("step", 0, self.state.steps, 1, look.step, hint="0: what was injected")
            self._quantity = self._choice("show what", _QUANTITIES, look.quantity)
            self._axis = self._choice("slice", self._reversed_axes, look.axis)
            self._index = self._slider("layer", 0, max(self.state.lpv.grid.resolution) - 1, 1, look.index)
            self._length = self._slider("length [cells]", 0.2, 3.0, 0.05, look.length)
            self._contrast = self._slider(
                "contrast", 0.0, 1.0, 0.05, look.contrast, hint="1: length goes with intensity; 0: all of one length"
            )

    def _add_surfaces(self, look: Look) -> None:
        with self._server.gui.add_folder("Surfaces"):
            self._surfaces = self._choice("colour", _SURFACES, look.surfaces)
            self._stops = self._slider("exposure", -4.0, 4.0, 0.1, look.stops, hint="stops")
            known = self.state.truth is not None
            self._errors = self._check("errors against targets", look.errors and known, visible=known)

    def _add_probes(self, look: Look) -> None:
        there = len(self.probes.position) > 0
        with self._server.gui.add_folder("Probes", visible=there):
            self._probes = self._check("spheres", look.probes)
            self._probe_light = self._choice(
                "shaded by", _PROBE_LIGHTS, look.probe_light, visible=self.probes.content is not None
            )
            self._probe_scale = self._slider("size", 0.2, 3.0, 0.05, look.probe_scale)
            self._tetrahedra = self._check("tetrahedra", look.tetrahedra, visible=len(self.probes.edges) > 0)

    def _ask(self) -> None:
        """Hand the panel's values to the worker."""
        knobs = Knobs(
            float(self._propagation.value),
            float(self._occlusion.value),
            tuple(2.0 ** float(stops.value) for stops, _ in self._lights),
            tuple((float(x.value), float(y.value), float(z.value)) for _, (x, y, z) in self._lights),
        )
        axis = self._reversed_axes[self._axis.value]
        layer = self.state.lpv.grid.resolution[AXES.index(axis)] - 1
        look = Look(
            surfaces=_SURFACES[self._surfaces.value],
            stops=float(self._stops.value),
            lobes=bool(self._lobes.value),
            quantity=_QUANTITIES[self._quantity.value],  # type: ignore[arg-type]
            step=int(self._step.value),
            axis=axis,
            index=min(int(self._index.value), layer),
            length=float(self._length.value),
            contrast=float(self._contrast.value),
            probes=bool(self._probes.value),
            probe_light=_PROBE_LIGHTS[self._probe_light.value],
            probe_scale=float(self._probe_scale.value),
            tetrahedra=bool(self._tetrahedra.value),
            errors=bool(self._errors.value),
        )
        self._worker.submit((knobs, look))

    def _work(self, request: tuple[Knobs, Look]) -> None:
        """Solve if the sliders of the solve moved, and send the layers that changed."""
        knobs, look = request
        if self._solved is None or self._solved.knobs != knobs:
            started = time.perf_counter()
            self._solved = self.state.solve(knobs)
            self._seconds = time.perf_counter() - started
        stale = []
        with self._server.atomic():
            for name, key, make in layers(self.state, self._solved, look, self.probes):
                before, handle = self._drawn.get(name, (None, None))
                if before == key:
                    continue
                stale += [] if handle is None else [handle]
                self._drawn[name] = (key, self._draw(name, make()))
        self._status.content = self._summary(self._solved, look)
        if stale:
            # A browser shows nothing of a GLB while it parses it; the one before stays until then, or the page would blink.
            self._server.flush()
            time.sleep(_PARSING)
            for handle in stale:
                handle.remove()

    def _draw(self, name: str, shape: Shape) -> Any:
        """A node of a name of its own, None for nothing."""
        if not shape:
            return None
        self._count += 1
        return self._server.scene.add_glb(f"/{name}/{self._count}", shape_glb(shape), cast_shadow=False, receive_shadow=False)

    def _summary(self, solved: Solved, look: Look) -> str:
        grid = solved.grid_of(look.step)
        place = grid.minimum[AXES.index(look.axis)] + solved.grids[0].cell_size * (look.index + 0.5)
        lines = [f"slice at {look.axis} = {place:.3g} m, cells of {grid.cell_size:.3g} m"]
        lines.append(f"mean irradiance {solved.surface.mean():.4g} W/m², solved in {self._seconds:.2f} s")
        if self.state.truth is not None:
            known = "unknown: targets are of the light as it was" if solved.relative_l2 is None else f"{solved.relative_l2:.3f}"
            lines.append(f"relative L2 error {known}")
        return "  \n".join(lines)

    def _failed(self, error: Exception) -> None:
        """What went wrong, in the panel; what was drawn before stays."""
        self._status.content = f"**{type(error).__name__}**: {error}"
