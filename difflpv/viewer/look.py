"""From a solve and the switches of the page to the coloured triangles that are drawn, each layer only when it changed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from difflpv.shapes.colors import ERROR_SCALE_END, exposed, scale_color
from difflpv.shapes.lobes import DEFAULT_CONTRAST, lobe_shape
from difflpv.shapes.shape import Shape, icosphere, joined
from difflpv.shapes.spheres import probe_radius, sphere_normals, sphere_shape, tube_shape
from difflpv.viewer.probe_view import ProbeView
from difflpv.viewer.state import Axis, Quantity, Solved, ViewState

__all__ = ["PROBE_LIGHTS", "SURFACES", "Layer", "Look", "ProbeLight", "SurfaceColor", "layers"]

SurfaceColor = Literal["lit", "white", "albedo", "hidden"]
SURFACES: tuple[SurfaceColor, ...] = get_args(SurfaceColor)
ProbeLight = Literal["volume", "file"]
PROBE_LIGHTS: tuple[ProbeLight, ...] = get_args(ProbeLight)
_EDGE = (0.05, 0.22, 0.45)
_INVALID = 0.02  # grey of probes that no interpolation uses
_LARGEST_PROBE = 0.03  # of the scene's extent
_RECEIVER = 0.006  # of the scene's extent


@dataclass(frozen=True)
class Look:
    """Switches that need no solve.

    Attributes:
        surfaces: "lit" by the solve, "white" (the same light on white surfaces), plain "albedo", or "hidden".
        stops: brighter than the exposure of the first solve.
        lobes: show a slice of the volume.
        quantity: what "moving" after ``step``, or the "sum" so far.
        step: of the propagation.
        axis: normal of the slice.
        index: layer of the slice in the finest grid.
        length: of the longest lobe, in cells.
        contrast: see ``difflpv.shapes.lobes.lobe_shape``.
        probes: show probes.
        probe_light: what shades them: the "volume" at their place, or what their "file" holds.
        probe_scale: times their usual radius.
        tetrahedra: show the edges between them.
        errors: show receivers coloured by their error.
    """

    surfaces: SurfaceColor = "lit"
    stops: float = 0.0
    lobes: bool = True
    quantity: Quantity = "sum"
    step: int = 0
    axis: Axis = "z"
    index: int = 0
    length: float = 1.1
    contrast: float = DEFAULT_CONTRAST
    probes: bool = True
    probe_light: ProbeLight = "volume"
    probe_scale: float = 1.0
    tetrahedra: bool = False
    errors: bool = False


Layer = tuple[str, tuple[Any, ...], Callable[[], Shape]]
"""Name, key and maker of what is drawn as one."""


def layers(state: ViewState, solved: Solved, look: Look, probes: ProbeView) -> Iterator[Layer]:
    """Name, key and maker of each layer; a layer whose key is that of the last time looks as it did then."""
    stops = state.exposure + look.stops
    low, high = state.scene.bounds
    extent = float((high - low).max())
    number = id(solved)

    def surfaces() -> Shape:
        if look.surfaces == "hidden":
            return joined([])
        if look.surfaces == "albedo":
            return state.surfaces.plain()
        radiance = state.surfaces.radiance(solved.surface, white=look.surfaces == "white")
        return Shape(state.surfaces.vertices, state.surfaces.triangles, exposed(radiance, stops))

    def lobes() -> Shape:
        if not look.lobes:
            return joined([])
        centers, coeffs = solved.slice(look.step, look.quantity, look.axis, look.index)
        cell = solved.grid_of(look.step).cell_size
        return lobe_shape(centers, coeffs, look.length * cell, contrast=look.contrast)

    def spheres() -> Shape:
        if not (look.probes and len(probes.position)):
            return joined([])
        irradiance = solved.probes
        if look.probe_light == "file" and probes.content is not None:
            irradiance = probes.content.irradiance(sphere_normals())
        color = np.where(probes.valid[:, None, None], exposed(np.clip(irradiance, 0, None) / np.pi, stops), _INVALID)
        radius = look.probe_scale * probe_radius(probes.position, _LARGEST_PROBE * extent)
        return sphere_shape(probes.position, radius, color)

    def tetrahedra() -> Shape:
        return tube_shape(probes.edges, 0.0012 * extent, _EDGE) if look.tetrahedra else joined([])

    def errors() -> Shape:
        if not look.errors or solved.errors is None or state.truth is None:
            return joined([])
        color = scale_color(solved.errors / ERROR_SCALE_END)
        dots = np.repeat(color[:, None], len(icosphere(0)[0]), axis=1)
        return sphere_shape(state.truth.position, _RECEIVER * extent, dots)

    shown = (look.lobes, look.quantity, look.step, look.axis, look.index, look.length, look.contrast)
    balls = (look.probes, look.probe_light, look.probe_scale, look.stops)
    yield "surfaces", (number, look.surfaces, look.stops), surfaces
    yield "lobes", (number, *shown) if look.lobes else (), lobes
    yield "probes", (number, *balls) if look.probes else (), spheres
    yield "tetrahedra", (look.tetrahedra,), tetrahedra
    yield "errors", (number, look.errors) if look.errors else (), errors
