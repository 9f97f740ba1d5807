"""What engines compute from a probe's numbers, each written from the engine's own sources (addresses beside them).

Nothing here knows the project's spherical harmonics: if an export and this file agree on a light of known answer, the export
is right.
"""

from __future__ import annotations

import numpy as np


def threejs_irradiance(n: np.ndarray, sh: np.ndarray) -> np.ndarray:
    """``shGetIrradianceAt``, mrdoob/three.js, src/renderers/shaders/ShaderChunk/lights_pars_begin.glsl.js."""
    x, y, z = n
    weights = [0.886227, 1.023328 * y, 1.023328 * z, 1.023328 * x, 0.858086 * x * y, 0.858086 * y * z]
    weights += [0.743125 * z * z - 0.247708, 0.858086 * x * z, 0.429043 * (x * x - y * y)]
    return np.array(weights) @ sh


def polynomial_value(n: np.ndarray, sh: np.ndarray) -> np.ndarray:
    """Plain polynomials.

    ``Irradiance_SphericalHarmonics``, google/filament, shaders/src/surface_light_indirect.fs, without its clamp at 0; Unity's
    ``SphericalHarmonicsL2.Evaluate`` and HDRP's ``PremultiplyCoefficients`` (Unity-Technologies/Graphics,
    SphericalHarmonics.cs) have the same nine terms.
    """
    x, y, z = n
    return np.array([1, y, z, x, y * x, y * z, 3 * z * z - 1, z * x, x * x - y * y]) @ sh


def godot_ambient(n: np.ndarray, sh: np.ndarray) -> np.ndarray:
    """Lightmap capture, godotengine/godot, servers/.../forward_clustered/scene_forward_clustered.glsl (USE_LIGHTMAP)."""
    x, y, z = n
    c = (0.886227, 1.023327, 0.858086, 0.247708, 0.429043)
    weights = [c[0], c[1] * y, c[1] * z, c[1] * x, c[2] * x * y, c[2] * y * z]
    weights += [c[3] * (3 * z * z - 1), c[2] * x * z, c[4] * (x * x - y * y)]
    return np.array(weights) @ sh


def godot_tap(point: np.ndarray, data: dict) -> np.ndarray:
    """``lightmap_tap_sh_light``, godotengine/godot, servers/rendering/renderer_rd/storage_rd/light_storage.cpp."""
    planes = np.reshape(np.float32(data["planes"]), (-1, 4))
    children, node = np.reshape(data["children"], (-1, 2)), 0
    while node >= 0:
        over = np.dot(planes[node, :3], np.float32(point)) > planes[node, 3]
        following = int(children[node, 0 if over else 1])
        assert following < 0 or following > node, "Godot refuses a child before its parent"
        node = following
    assert node != -(2**31), "no tetrahedron: Godot leaves the object black"
    corners = np.reshape(data["tetrahedra"], (-1, 4))[abs(node) - 1]
    points = np.reshape(data["points"], (-1, 3))[corners]
    weights = np.linalg.solve(np.vstack([points.T, np.ones(4)]), [*point, 1.0])
    sh = np.reshape(data["sh"], (-1, 9, 3))[corners]
    return np.einsum("v,vic->ic", np.clip(weights, 0, 1), sh)


def openexr_direction(x: float, y: float, width: int, height: int) -> np.ndarray:
    """Direction of a pixel centre of a latitude-longitude map, axes of openexr's ImfEnvmap.h: top +y, middle +z, left +x."""
    longitude, latitude = np.pi * (1 - 2 * (x + 0.5) / width), np.pi * (0.5 - (y + 0.5) / height)
    return np.array([np.sin(longitude) * np.cos(latitude), np.sin(latitude), np.cos(longitude) * np.cos(latitude)])
