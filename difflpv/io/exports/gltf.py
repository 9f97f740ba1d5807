"""glTF 2.0: one node per probe, its coefficients in the node's ``extras``, to be loaded beside the scene.

glTF is right-handed, y up, in metres, as this project is: positions and coefficients go out as they are.
Source: Khronos Group, glTF 2.0 specification, 3.4 (coordinate system) and 3.13 (extras).
"""

from __future__ import annotations

from pathlib import Path

from difflpv.io.atomic import write_json
from difflpv.io.exports.convention import (
    ENGINE_READS,
    check_file,
    convention_record,
    metric_records,
    reader_record,
    rounded,
    usable_probes,
)
from difflpv.probes.probe_files import CONVENTION, ProbeRecord

__all__ = ["export_gltf"]

_SOURCES = ("https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html",)


def export_gltf(record: ProbeRecord, out: Path) -> list[Path]:
    """Write one ``.gltf`` file without buffers."""
    check_file(out, ".gltf")
    probes = usable_probes(record)
    convention = convention_record(
        record,
        "glTF 2.0 node extras",
        quantity="radiance SH coefficients [W/m2], 9 x RGB",
        evaluate=CONVENTION["irradiance"],
        axes="right-handed, y up",
        sources=_SOURCES,
        reads=ENGINE_READS["gltf"],
        scale=1.0,
        basis=f"{CONVENTION['basis']}, index {CONVENTION['index']}, polynomials {', '.join(CONVENTION['polynomials'])}",
    )
    count = len(probes)
    extras = {"convention": convention, "reader": reader_record(record)}
    nodes: list[dict[str, object]] = [{"name": "light_probes", "children": list(range(1, count + 1)), "extras": extras}]
    own = metric_records(record)
    for k, (position, radiance) in enumerate(zip(rounded(probes.position), rounded(probes.radiance), strict=True)):
        nodes.append({"name": f"probe_{k:04d}", "translation": position, "extras": {"radiance_sh": radiance, **own[k]}})
    document = {
        "asset": {"version": "2.0", "generator": "difflpv"},
        "scene": 0,
        "scenes": [{"name": "light probes", "nodes": [0]}],
        "nodes": nodes,
    }
    write_json(out, document)
    return [out]
