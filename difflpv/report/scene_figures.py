"""Figures of scenes without a browser: probes as shaded spheres in their room, slices of a volume as SH lobes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from difflpv.grid import Grid
from difflpv.io.atomic import write_bytes
from difflpv.io.png import auto_exposure
from difflpv.io.srgb import linear_to_srgb
from difflpv.probes.probe_set import ProbeSet
from difflpv.raycast import Raycaster
from difflpv.report.picture import axis_camera, picture
from difflpv.report.style import DPI, new_figure, png_bytes, title_axis
from difflpv.scene import Camera, Scene
from difflpv.shapes.colors import exposed
from difflpv.shapes.lobes import lobe_shape
from difflpv.shapes.overview import outside_camera
from difflpv.shapes.section import section
from difflpv.shapes.shape import Shape, joined
from difflpv.shapes.spheres import probe_radius, sphere_normals, sphere_shape, tube_shape
from difflpv.shapes.surfaces import surfaces_of

__all__ = ["LobeSlice", "draw_pictures", "lobe_picture", "probe_figure", "probe_picture"]

_WIDTH = 3.7  # of a picture [inches]
_WALL, _EDGE = (0.03, 0.03, 0.03), (0.05, 0.22, 0.45)
_INVALID = 0.02
_LARGEST_PROBE = 0.03  # of the scene's extent
_LEAST_SHARE = 0.4  # of the longest edge that any edge of a slice shows
_TITLE = 0.088  # of a letter [inches]
_GREY = (0.50, 0.51, 0.53)


@dataclass(frozen=True, eq=False)
class LobeSlice:
    """One layer of a volume: cell centres [m,3] m, coefficients [m,K,3] W/sr, its grid, normal axis (0, 1, 2), height [m]."""

    centers: np.ndarray
    coeffs: np.ndarray
    grid: Grid
    axis: int
    height: float


def probe_figure(
    scene: Scene,
    probes: ProbeSet,
    path: str | Path,
    *,
    edges: np.ndarray | None = None,
    title: str | None = None,
    surfaces: Shape | None = None,
    camera: Camera | None = None,
    stops: float | None = None,
) -> None:
    """Write a PNG of probes in their scene, each a white sphere lit by its own irradiance for every normal.

    Args:
        scene: the room; drawn in its albedo, without the sides that face nothing (one looks in through the walls).
        probes: what is drawn; those that are not valid are black.
        path: the file.
        edges: segments [m,2,3] m between them, of their tetrahedra say.
        title: a line over the picture.
        surfaces: coloured triangles in place of the scene's albedo.
        camera: by default one that stands outside (``difflpv.shapes.overview``).
        stops: exposure of the spheres; by default white is their 98th percentile.
    """
    image = probe_picture(scene, probes, edges=edges, surfaces=surfaces, camera=camera, stops=stops)
    count = int(probes.valid.sum()) if probes.valid is not None else len(probes)
    write_bytes(path, draw_pictures([image], [title or f"{scene.name}: {count} light probes"]))


def probe_picture(
    scene: Scene,
    probes: ProbeSet,
    *,
    edges: np.ndarray | None = None,
    surfaces: Shape | None = None,
    camera: Camera | None = None,
    stops: float | None = None,
    irradiance: np.ndarray | None = None,
    width: int = 560,
) -> np.ndarray:
    """The picture of ``probe_figure``, linear [H,W,3].

    ``irradiance`` [n,k,3] W/m2 for the normals ``sphere_normals`` takes the place of what the probes hold.
    """
    low, high = scene.bounds
    extent = float((high - low).max())
    if surfaces is None:
        surfaces = surfaces_of(scene, Raycaster(scene)).plain()
        surfaces = Shape(surfaces.vertices, surfaces.triangles, 0.75 * surfaces.color)
    parts = [surfaces]
    if len(probes):
        e = np.clip(probes.irradiance(sphere_normals()) if irradiance is None else irradiance, 0, None)
        valid = np.ones(len(probes), bool) if probes.valid is None else probes.valid
        stops = auto_exposure(e[valid].reshape(1, -1, 3) / np.pi) if stops is None and valid.any() else stops
        color = np.where(valid[:, None, None], exposed(e / np.pi, stops or 0.0), _INVALID)
        parts.append(sphere_shape(probes.position, probe_radius(probes.position, _LARGEST_PROBE * extent), color))
    if edges is not None:
        parts.append(tube_shape(edges, 0.0012 * extent, _EDGE))
    return picture(joined(parts), camera or outside_camera(scene), width=width, background=(0.012, 0.012, 0.012))


def lobe_picture(scene: Scene, layer: LobeSlice, *, reference: float | None = None, width: int = 560) -> np.ndarray:
    """A slice of SH lobes as on a plan, with the outline of the walls in its plane, linear [H,W,3].

    ``reference`` is the largest value that stands for the longest lobe (``difflpv.shapes.lobes.lobe_shape``).
    """
    low, high = scene.bounds
    cell, extent = layer.grid.cell_size, float((high - low).max())
    margin = np.maximum(0.04 * extent, (_LEAST_SHARE * extent - (high - low)) / 2)  # a flat scene is more than a line
    lobes = lobe_shape(layer.centers, layer.coeffs, 1.1 * cell, reference=reference)
    walls = tube_shape(section(scene.triangle_vertices, layer.axis, layer.height), 0.004 * extent, _WALL)
    camera = axis_camera(low - margin, high + margin, layer.axis, layer.height)
    return picture(joined([lobes, walls]), camera, width=width, background=_GREY)


def draw_pictures(images: Sequence[np.ndarray], titles: Sequence[str]) -> bytes:
    """Linear pictures [H,W,3] side by side at one height under their titles, as a PNG; a narrow one has room for its title."""
    aspects = [image.shape[1] / image.shape[0] for image in images]
    height = _WIDTH / (sum(aspects) / len(aspects))
    widths = [max(height * aspect, _TITLE * len(title)) for aspect, title in zip(aspects, titles, strict=True)]
    figure = new_figure(sum(widths) + 0.1 * len(images), height + 0.35, dpi=DPI)
    axes = figure.subplots(1, len(images), squeeze=False, width_ratios=widths)[0]
    for axis, image, title in zip(axes, images, titles, strict=True):
        axis.imshow(linear_to_srgb(image), interpolation="lanczos")
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
        axis.set_anchor("W")
        title_axis(axis, title)
    return png_bytes(figure)
