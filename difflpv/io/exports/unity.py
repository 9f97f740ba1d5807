"""Unity: JSON, and the editor script that makes a light probe group of it and fills the baked probes.

``SphericalHarmonicsL2`` holds coefficients of plain polynomials whose sum is E/pi (a white ambient light is 1 in every
direction); its constants in HDRP's SphericalHarmonicMath are K_i A_l / pi. Unity is left-handed, y up. Importers of glTF, OBJ
and FBX turn the x axis round, so that is the default here: the probes lie where the imported scene is.
Source: docs.unity3d.com, SphericalHarmonicsL2, LightProbes.bakedProbes; github.com/Unity-Technologies/Graphics,
com.unity.render-pipelines.core, SphericalHarmonics.cs; github.com/KhronosGroup/UnityGLTF, issue 257 (handedness).
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Literal

from difflpv.io.atomic import write_json, write_text
from difflpv.io.exports.convention import (
    ENGINE_READS,
    convention_record,
    make_folder,
    mirrored,
    polynomial_coefficients,
    rounded,
    usable_probes,
)
from difflpv.probes.probe_files import ProbeRecord

__all__ = ["export_unity"]

_SOURCES = (
    "https://docs.unity3d.com/ScriptReference/Rendering.SphericalHarmonicsL2.html",
    "https://docs.unity3d.com/ScriptReference/LightProbes-bakedProbes.html",
    "https://github.com/Unity-Technologies/Graphics/tree/master/Packages/com.unity.render-pipelines.core",
    "https://github.com/KhronosGroup/UnityGLTF/issues/257",
)
_SCRIPT = "DifflpvLightProbes.cs"


def export_unity(record: ProbeRecord, out: Path, *, mirror: Literal["x", "z"] = "x") -> list[Path]:
    """Write ``light_probes.json`` and ``Editor/DifflpvLightProbes.cs`` into a folder.

    Args:
        record: the probes.
        out: folder under ``Assets``.
        mirror: the axis that is turned round on the way to Unity's left-handed system, as the scene's importer does it.
    """
    probes = mirrored(usable_probes(record), mirror)
    make_folder(out / "Editor")
    convention = convention_record(
        record,
        "Unity LightProbes.bakedProbes",
        quantity="irradiance / pi [W/(m2 sr)] as coefficients of plain polynomials, SphericalHarmonicsL2[channel, i]",
        evaluate="c0 + c1 y + c2 z + c3 x + c4 xy + c5 yz + c6 (3z^2-1) + c7 xz + c8 (x^2-y^2), as Evaluate(n), is E/pi",
        axes=f"left-handed, y up; {mirror} is minus the {mirror} of the right-handed scene",
        sources=_SOURCES,
        reads=ENGINE_READS["unity"],
        scale="c_i = L_i K_i A_l / pi",
        layout="positions: 3 numbers a probe; coefficients: 27 numbers a probe, i after i, r g b",
    )
    data = {
        "convention": convention,
        "positions": rounded(probes.position.ravel()),
        "coefficients": rounded(polynomial_coefficients(probes.radiance).ravel()),
    }
    written = [out / "light_probes.json", out / "Editor" / _SCRIPT]
    write_text(written[1], _script(_SCRIPT))
    write_json(written[0], data)
    return written


def _script(name: str) -> str:
    return files("difflpv").joinpath("data", "exports", name).read_text(encoding="utf-8")
