"""three.js: a Group of LightProbes for ``ObjectLoader``.

``LightProbe.sh`` holds radiance coefficients in the order and signs that this project uses: the shader multiplies by the cosine
lobe (``shGetIrradianceAt``) and the materials by albedo/pi. three.js adds up every visible LightProbe of a scene wherever it
stands, so the probes are written invisible; a scene shows one of them or a blend.
Source: github.com/mrdoob/three.js, src/math/SphericalHarmonics3.js, src/lights/LightProbe.js and
src/renderers/shaders/ShaderChunk/lights_pars_begin.glsl.js.
"""

from __future__ import annotations

import uuid
from pathlib import Path

from difflpv.io.atomic import write_json
from difflpv.io.exports.convention import (
    ENGINE_READS,
    check_file,
    check_own,
    convention_record,
    metric_records,
    reader_record,
    rounded,
    usable_probes,
)
from difflpv.probes.probe_files import ProbeRecord

__all__ = ["export_threejs"]

_SOURCES = (
    "https://github.com/mrdoob/three.js/blob/dev/src/math/SphericalHarmonics3.js",
    "https://github.com/mrdoob/three.js/blob/dev/src/renderers/shaders/ShaderChunk/lights_pars_begin.glsl.js",
)


def export_threejs(record: ProbeRecord, out: Path) -> list[Path]:
    """Write one ``.json`` file."""
    check_own(check_file(out, ".json"))
    probes = usable_probes(record)
    convention = convention_record(
        record,
        "three.js LightProbe",
        quantity="radiance SH coefficients [W/m2], real orthonormal, no Condon-Shortley phase, index l(l+1)+m, 9 x RGB",
        evaluate="sh.getIrradianceAt(n) and the shader's shGetIrradianceAt(n) give irradiance E(n) [W/m2]",
        axes="right-handed, y up",
        sources=_SOURCES,
        reads=ENGINE_READS["threejs"],
        scale=1.0,
        visible="false: three.js adds up all visible probes of a scene; show one, or blend with sh.addScaledSH",
    )
    children: list[dict[str, object]] = []
    own = metric_records(record)
    for k, (position, sh) in enumerate(zip(rounded(probes.position), rounded(probes.radiance.reshape(-1, 27)), strict=True)):
        children.append(
            {
                "uuid": _uuid(record, f"probe {k}"),
                "type": "LightProbe",
                "name": f"probe_{k:04d}",
                "visible": False,
                "layers": 1,
                "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, *position, 1],  # column after column
                "color": 0xFFFFFF,
                "intensity": 1,
                "sh": sh,
                "userData": own[k],
            }
        )
    group = {
        "uuid": _uuid(record, "group"),
        "type": "Group",
        "name": "light_probes",
        "layers": 1,
        "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
        "userData": {"convention": convention, "reader": reader_record(record)},
        "children": children,
    }
    write_json(out, {"metadata": {"version": 4.6, "type": "Object", "generator": "difflpv"}, "object": group})
    return [out]


def _uuid(record: ProbeRecord, name: str) -> str:
    """Derived from the scene, so that the same probes give the same file."""
    return str(uuid.uuid5(uuid.NAMESPACE_URL, f"difflpv {record.scene.get('hash', '')} {name}"))
