"""What the exports share: the scale of polynomial coefficients, mirrored axes, and the convention record.

Engines that evaluate plain polynomials, c_0 + c_1 y + c_2 z + c_3 x + c_4 xy + c_5 yz + c_6 (3z^2-1) + c_7 xz + c_8 (x^2-y^2),
take c_i = L_i K_i A_l(i) / pi with Y_i = K_i p_i: the radiance that leaves a white Lambert surface of that normal, E/pi.
Source: Ramamoorthi and Hanrahan, "An efficient representation for irradiance environment maps", 2001, eq. 11 to 13.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

import difflpv
from difflpv.probes.probe_files import ProbeRecord, describes_probes
from difflpv.probes.probe_set import ProbeSet
from difflpv.sh import lobe_factors

__all__ = [
    "BASIS_SCALE",
    "ENGINE_READS",
    "ExportError",
    "check_file",
    "check_own",
    "convention_record",
    "make_folder",
    "metric_records",
    "mirrored",
    "polynomial_coefficients",
    "reader_record",
    "rounded",
    "usable_probes",
]

BASIS_SCALE = np.sqrt(np.array([1, 3, 3, 3, 15, 15, 5 / 4, 15, 15 / 4]) / (4 * math.pi))
"""K_i with Y_i = K_i p_i and p = 1, y, z, x, xy, yz, 3z^2-1, xz, x^2-y^2 [9]."""
ENGINE_READS: Mapping[str, str] = MappingProxyType(
    {
        "threejs": "three.js adds up all visible probes; your own code blends, with userData.metric and userData.reader",
        "gltf": "glTF carries numbers alone; your own code blends, with extras.metric and extras.reader",
        "filament": "Filament has one indirect light for the whole scene and blends nothing",
        "unity": "Unity blends in tetrahedra of its own, without looking for walls",
        "godot": "Godot blends in the tetrahedra of this export, without looking for walls",
        "exr": "an atlas of images holds no weights; your own code blends",
    }
)
"""How points read the probes of each format, in words."""
_WEIGHTS = (
    "d_j = |metric_j (x - p_j)|^2; of the neighbours of least d, w_j ~ exp(-(d_j - d_first) / 2) - exp(-(d_next - d_first) / 2)"
    " + 1e-9, normalised, d_next being the least of those left out (without one: no such term); metric: three rows, 1/m"
)
# Sign of each polynomial under a reflection of one axis.
_ODD = {"x": (3, 4, 7), "z": (2, 5, 7)}


class ExportError(ValueError):
    """Probes that a format cannot hold, or a place that cannot be written: one line."""


def usable_probes(record: ProbeRecord) -> ProbeSet:
    """The valid probes; an ``ExportError`` if there are none."""
    probes = record.probes.usable
    if not len(probes):
        raise ExportError(f"probes: none of the {len(record.probes)} is valid, nothing to export")
    return probes


def polynomial_coefficients(radiance: np.ndarray) -> np.ndarray:
    """Coefficients of E/pi in the plain polynomials, of the shape of ``radiance`` [..., 9, 3]."""
    scale = BASIS_SCALE * lobe_factors(2) / math.pi
    return np.asarray(radiance) * scale[:, None]


def mirrored(probes: ProbeSet, axis: Literal["x", "z"]) -> ProbeSet:
    """The probes in a left-handed system: ``axis`` turned round, in positions and in coefficients."""
    if axis not in _ODD:
        raise ValueError(f"mirrored axis: expected x or z, got {axis!r}")
    position, radiance = probes.position.copy(), probes.radiance.copy()
    position[:, "xyz".index(axis)] *= -1
    radiance[:, _ODD[axis]] *= -1
    return ProbeSet(position + 0.0, radiance + 0.0)  # + 0.0: no negative zeros in the files


def convention_record(
    record: ProbeRecord,
    engine: str,
    *,
    quantity: str,
    evaluate: str,
    axes: str,
    sources: tuple[str, ...],
    reads: str,
    **more: Any,
) -> dict[str, Any]:
    """The record beside or inside an exported file.

    Args:
        record: the probes; their scene, method and errors go along.
        engine: who reads the file.
        quantity: what the coefficients or pixels are, with unit.
        evaluate: the engine's formula and what it yields.
        axes: handedness and up axis.
        sources: where the engine's convention is defined (addresses).
        reads: how the engine lets points read the probes.
        more: what else matters for this format.
    """
    return {
        "written_by": f"difflpv {difflpv.__version__}",
        "engine": engine,
        "quantity": quantity,
        "evaluate": evaluate,
        "axes": axes,
        "direction": "lobes point from the probe toward the incoming light; evaluated at the surface's outward normal",
        "color": "linear RGB",
        "length": "m",
        "interpolation": {"made_for": record.reader.described, "engine": reads},
        "sources": list(sources),
        **more,
        "scene": record.scene,
        "method": record.method,
        "errors": record.errors,
    }


def reader_record(record: ProbeRecord) -> dict[str, Any]:
    """How points are to read the probes, for formats that have a place for it."""
    reader = record.reader
    described: dict[str, Any] = {"interpolation": reader.interpolation, "sight": reader.sight}
    if reader.metric is not None:
        described |= {"neighbours": reader.neighbours, "weights": _WEIGHTS}
    return described


def metric_records(record: ProbeRecord) -> list[dict[str, Any]]:
    """For each valid probe ``{"metric": 3x3}`` 1/m, or nothing where points read tetrahedra."""
    reader = record.usable_reader
    if reader.metric is None:
        return [{} for _ in range(len(record.probes.usable))]
    return [{"metric": metric} for metric in rounded(reader.metric)]


def rounded(values: np.ndarray) -> list[Any]:
    """Nested lists of numbers at single precision, in as few digits as bring it back."""
    with np.errstate(over="ignore"):
        single = np.asarray(values, np.float32)
    if not np.isfinite(single).all():
        raise ExportError("probes: a number is beyond the range of float32, which engines read")
    shortest = [float(text) for text in single.ravel().astype(str)]
    return list(np.array(shortest).reshape(single.shape).tolist())


def check_file(out: Path, suffix: str) -> Path:
    """``out`` with its folder made; an ``ExportError`` unless its name ends in ``suffix``."""
    if out.suffix.lower() != suffix:
        raise ExportError(f"{out}: expected a file name ending in {suffix}")
    make_folder(out.parent)
    return out


def check_own(file: Path) -> Path:
    """``file``; an ``ExportError`` where probes in the own format are described there, which an export must not replace."""
    if describes_probes(file):
        raise ExportError(f"{file}: describes light probes of difflpv, which would be lost; choose another place")
    return file


def make_folder(folder: Path) -> Path:
    """Make ``folder``; an ``ExportError`` where that cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ExportError(f"{folder}: folder cannot be made: {error.strerror}") from None
    return folder
