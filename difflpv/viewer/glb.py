"""Coloured triangles as a GLB that a browser shows as they are: unlit, one side, and through viser's tone mapping unchanged."""

from __future__ import annotations

import json
import struct

import numpy as np

from difflpv.shapes.shape import Shape

__all__ = ["filmic", "shape_glb", "undo_filmic"]

# three.js' ACESFilmicToneMapping at exposure 1, which viser's page puts over everything: Stephen Hill's fit
# ("BakingLab", 2017), exposed by 1 / 0.6.
_INTO = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
_EXPOSURE = 1 / 0.6


def filmic(color: np.ndarray) -> np.ndarray:
    """What three.js' filmic tone mapping makes of linear colours [n,3]."""
    v = _EXPOSURE * np.asarray(color, np.float64) @ _INTO.T
    fitted = (v * (v + 0.0245786) - 0.000090537) / (v * (0.983729 * v + 0.4329510) + 0.238081)
    return np.clip(fitted @ _OUT.T, 0, 1)


def undo_filmic(color: np.ndarray) -> np.ndarray:
    """Linear colours [n,3] that ``filmic`` turns into ``color`` (clipped to 0..1); saturated ones have negative channels."""
    r = np.clip(color, 0, 1) @ np.linalg.inv(_OUT).T
    a, b, c = 1 - 0.983729 * r, 0.0245786 - 0.4329510 * r, -(0.000090537 + 0.238081 * r)
    v = (-b + np.sqrt(b * b - 4 * a * c)) / (2 * a)
    return np.asarray(v @ np.linalg.inv(_INTO).T / _EXPOSURE)


def shape_glb(shape: Shape) -> bytes:
    """A GLB of one mesh with a colour per vertex (KHR_materials_unlit), fronts alone. At least one triangle.

    Raises:
        ValueError: there is nothing in it.
    """
    if not shape:
        raise ValueError("glb: expected at least one triangle, got none")
    positions = np.ascontiguousarray(shape.vertices, "<f4")
    blocks = [positions, undo_filmic(shape.color).astype("<f4"), np.ascontiguousarray(shape.triangles.ravel(), "<u4")]
    data = [b.tobytes() for b in blocks]
    begins = np.cumsum([0, *(len(d) for d in data)])
    targets = (34962, 34962, 34963)  # ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER
    views = [
        {"buffer": 0, "byteOffset": int(begin), "byteLength": len(d), "target": target}
        for begin, d, target in zip(begins, data, targets, strict=False)
    ]
    vertex = {"componentType": 5126, "count": len(positions), "type": "VEC3"}
    bounds = {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    document = {
        "asset": {"version": "2.0", "generator": "difflpv"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "materials": [{"extensions": {"KHR_materials_unlit": {}}, "pbrMetallicRoughness": {"metallicFactor": 0}}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}],
        "accessors": [
            {"bufferView": 0, **vertex, **bounds},
            {"bufferView": 1, **vertex},
            {"bufferView": 2, "componentType": 5125, "count": shape.triangles.size, "type": "SCALAR"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": int(begins[-1])}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    body = b"".join(data)  # every block is a multiple of four bytes long
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(body))
    return head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
