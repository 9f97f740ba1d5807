"""Godot 4 (experimental: written from Godot's sources, not run in Godot): JSON, and the GDScript that feeds it to a LightmapGI.

Godot's own baker leaves radiance coefficients over pi (it scales its sums by 4/rays instead of 4 pi/rays); the shader
multiplies by the cosine lobe and the material by the albedo alone: c_i = L_i / pi makes the value E/pi. Godot is right-handed,
y up. It finds a point's tetrahedron by a tree of planes, which is made here; eight probes around the scene, with the content of
the nearest probe, let every point in the box find one.
Source: github.com/godotengine/godot, scene/3d/lightmap_gi.cpp (LightmapGIData::_set_probe_data), light_storage.cpp
(lightmap_tap_sh_light), scene_forward_clustered.glsl, modules/lightmapper_rd/lm_compute.glsl.
"""

from __future__ import annotations

import math
from importlib.resources import files
from pathlib import Path

import numpy as np

from difflpv.io.atomic import write_json, write_text
from difflpv.io.exports.convention import ENGINE_READS, ExportError, convention_record, make_folder, rounded, usable_probes
from difflpv.io.exports.plane_tree import EMPTY, plane_tree
from difflpv.probes.probe_files import ProbeRecord
from difflpv.probes.tetrahedra import box_corners

__all__ = ["export_godot"]

_SOURCES = (
    "https://github.com/godotengine/godot/blob/master/scene/3d/lightmap_gi.cpp",
    "https://github.com/godotengine/godot/blob/master/servers/rendering/renderer_rd/storage_rd/light_storage.cpp",
    "https://github.com/godotengine/godot/blob/master/servers/rendering/renderer_rd/shaders/forward_clustered/"
    "scene_forward_clustered.glsl",
    "https://github.com/godotengine/godot/blob/master/modules/lightmapper_rd/lm_compute.glsl",
)
_SCRIPT = "difflpv_light_probes.gd"
_MAX_PROBES = 2**12  # the tree is made in Python


def export_godot(record: ProbeRecord, out: Path) -> list[Path]:
    """Write ``light_probes.json`` and ``difflpv_light_probes.gd`` into a folder."""
    probes = usable_probes(record)
    if len(probes) > _MAX_PROBES:
        raise ExportError(f"probes: {len(probes)} are too many for Godot's tree of planes, at most {_MAX_PROBES}")
    rounded(probes.position)  # refuses what float32 cannot hold
    make_folder(out)
    low, high = probes.position.min(0), probes.position.max(0)
    margin = max(1.0, float(np.linalg.norm(high - low)) / 4)
    low, high = low - margin, high + margin
    corners = box_corners((low, high))
    nearest = np.linalg.norm(corners[:, None] - probes.position, axis=-1).argmin(1)
    # The tree is made for the numbers that Godot reads.
    points = np.concatenate([probes.position, corners]).astype(np.float32).astype(np.float64)
    radiance = np.concatenate([probes.radiance, probes.radiance[nearest]])
    tetrahedra, planes, children = plane_tree(points)
    convention = convention_record(
        record,
        "Godot 4 LightmapGIData (experimental: not run in Godot)",
        quantity="radiance SH coefficients / pi, real orthonormal, no Condon-Shortley phase, index l(l+1)+m, 9 x RGB",
        evaluate="sum over i of A_l c_i Y_i(n), A = pi, 2 pi/3, pi/4, as the scene shader does, is E/pi",
        axes="right-handed, y up",
        sources=_SOURCES,
        reads=ENGINE_READS["godot"],
        scale="c_i = L_i / pi",
        box_probes="the last 8 points are the corners of the box, each with the content of the nearest probe",
        tree=f"plane n.p = d a node, children over and under; -1-k is tetrahedron k, {EMPTY} none",
    )
    data = {
        "convention": convention,
        "bounds": rounded(np.concatenate([low, high - low])),
        "points": rounded(points.ravel()),
        "sh": rounded(radiance.ravel() / math.pi),
        "tetrahedra": tetrahedra.ravel().tolist(),
        "planes": rounded(planes.ravel()),
        "children": children.ravel().tolist(),
    }
    written = [out / "light_probes.json", out / _SCRIPT]
    write_text(written[1], files("difflpv").joinpath("data", "exports", _SCRIPT).read_text(encoding="utf-8"))
    write_json(written[0], data)
    return written
