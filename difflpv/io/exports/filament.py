"""Filament: for each probe the ``sh.txt`` that ``cmgen --deploy`` writes.

Nine lines of pre-scaled irradiance coefficients, which the shader evaluates as plain polynomials of the world normal and
multiplies by the diffuse albedo alone: the value is E/pi.
Source: github.com/google/filament, IndirectLight.h (Builder::irradiance), libs/ibl/src/CubemapSH.cpp
(computeIrradianceSH3Bands), tools/cmgen/src/cmgen.cpp (outputSh), shaders/src/surface_light_indirect.fs. The table in
IndirectLight.h prints minus signs at odd m; the code that makes and reads the numbers has none, and so has this file.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

from difflpv.io.atomic import write_json, write_text
from difflpv.io.exports.convention import (
    ENGINE_READS,
    check_own,
    convention_record,
    make_folder,
    polynomial_coefficients,
    rounded,
    usable_probes,
)
from difflpv.probes.probe_files import ProbeRecord

__all__ = ["export_filament"]

_SOURCES = (
    "https://github.com/google/filament/blob/main/libs/ibl/src/CubemapSH.cpp",
    "https://github.com/google/filament/blob/main/filament/include/filament/IndirectLight.h",
    "https://github.com/google/filament/blob/main/shaders/src/surface_light_indirect.fs",
)
_NAMES = [f"L{degree}{order}" for degree in range(3) for order in range(-degree, degree + 1)]


def export_filament(record: ProbeRecord, out: Path) -> list[Path]:
    """Write ``probe_0000/sh.txt``, ``probe_0001/sh.txt``, ... and ``probes.json`` (positions, convention) into a folder."""
    make_folder(out)
    probes = usable_probes(record)
    coefficients = polynomial_coefficients(probes.radiance)
    rounded(coefficients)  # refuses what float32 cannot hold
    index, files = check_own(out / "probes.json"), []
    with contextlib.suppress(FileNotFoundError):
        index.unlink()  # an export that was cut off has no index
    for k, probe in enumerate(coefficients):
        rows = [
            f"({r:18.15f}, {g:18.15f}, {b:18.15f}); // {name}, irradiance, pre-scaled base"
            for (r, g, b), name in zip(probe, _NAMES, strict=True)
        ]
        files.append(make_folder(out / f"probe_{k:04d}") / "sh.txt")
        write_text(files[-1], "\n".join(rows) + "\n")
    convention = convention_record(
        record,
        "Filament IndirectLight",
        quantity="irradiance / pi [W/(m2 sr)] as coefficients of plain polynomials, 9 x RGB",
        evaluate="c0 + c1 y + c2 z + c3 x + c4 yx + c5 yz + c6 (3z^2-1) + c7 zx + c8 (x^2-y^2) of the world normal is E/pi",
        axes="right-handed, y up",
        sources=_SOURCES,
        reads=ENGINE_READS["filament"],
        scale="c_i = L_i K_i A_l / pi; with IndirectLight::Builder::intensity(1) no further factor",
        order="l(l+1)+m, no Condon-Shortley phase",
    )
    nodes = [
        {"position": position, "file": file.relative_to(out).as_posix()}
        for position, file in zip(rounded(probes.position), files, strict=True)
    ]
    write_json(index, {"convention": convention, "probes": nodes})
    return [*files, index]
