"""The page's content as one PNG: the lit scene with its probes, what moves after a step, and the sum of all steps."""

from __future__ import annotations

import numpy as np

from difflpv.probes.probe_set import COEFFS, ProbeSet
from difflpv.report.scene_figures import LobeSlice, draw_pictures, lobe_picture, probe_picture
from difflpv.shapes.colors import exposed
from difflpv.shapes.shape import Shape
from difflpv.viewer.look import Look
from difflpv.viewer.probe_view import ProbeView
from difflpv.viewer.state import AXES, Quantity, Solved, ViewState

__all__ = ["draw_still"]


def draw_still(state: ViewState, solved: Solved, look: Look, probes: ProbeView) -> bytes:
    """A PNG of three pictures.

    Args:
        state: the scene.
        solved: a solve of it.
        look: slice, step, exposure and whether tetrahedra are drawn; probes that hold something are shaded by that.
        probes: what is drawn of probes.
    """
    stops = state.exposure + look.stops
    surfaces, radiance = state.surfaces, state.surfaces.radiance(solved.surface)
    content, irradiance = probes.content, None
    if content is None or look.probe_light == "volume":
        valid = None if content is None else content.valid
        content, irradiance = ProbeSet(probes.position, np.zeros((len(probes.position), COEFFS, 3)), valid), solved.probes
    lit = probe_picture(
        state.scene, content, edges=probes.edges if look.tetrahedra else None, stops=stops, irradiance=irradiance,
        surfaces=Shape(surfaces.vertices, surfaces.triangles, exposed(radiance, stops)),
    )  # fmt: skip
    axis = AXES.index(look.axis)

    def lobes(step: int, quantity: Quantity) -> np.ndarray:
        centers, coeffs = solved.slice(step, quantity, look.axis, look.index)
        layer = LobeSlice(centers, coeffs, solved.grid_of(step), axis, float(centers[0, axis]))
        return lobe_picture(state.scene, layer)

    count = int(probes.valid.sum())
    height = solved.grids[0].minimum[axis] + solved.grids[0].cell_size * (look.index + 0.5)
    return draw_pictures(
        [lit, lobes(look.step, "moving"), lobes(state.steps, "sum")],
        [
            state.scene.name + (f", {count} probes" if count else ""),
            f"moves after {look.step} steps, {look.axis} = {height:.3g} m",
            f"sum after {state.steps} steps",
        ],
    )
