"""Exports read by the engines themselves, where those run without a screen: three.js, glTF validator, Filament.

    npm install --prefix out/engines three gltf-validator filament
    python benchmarks/exports.py --engines out/engines

Seven probes, each lit by one directional light of irradiance 1 W/m2; errors are those of what the engines read.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from difflpv.io.exports import export_probes
from difflpv.probes.probe_files import ProbeRecord
from difflpv.probes.probe_set import ProbeSet
from difflpv.sh import sh_basis

TOWARD = np.array([*np.eye(3), *-np.eye(3), [2 / 7, -3 / 7, 6 / 7]])


def main() -> None:
    """Export, ask the engines, print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engines", type=Path, required=True, help="folder that npm installed the engines into")
    engines = parser.parse_args().engines
    record = ProbeRecord(ProbeSet(np.arange(21.0).reshape(7, 3), np.repeat(sh_basis(TOWARD, 2)[:, :, None], 3, 2)))
    with tempfile.TemporaryDirectory() as folder:
        export_probes(record, f"{folder}/probes.gltf", format="gltf")
        export_probes(record, folder, format="filament")
        export_probes(record, f"{folder}/probes.json", format="threejs")  # in the place of Filament's index
        Path(folder, "lights.json").write_text(json.dumps({"toward": TOWARD.tolist()}))
        command = ["node", str(Path(__file__).with_suffix(".mjs").resolve()), folder]
        found = json.loads(subprocess.run(command, cwd=engines, check=True, capture_output=True, text=True).stdout)
    cosine = TOWARD @ TOWARD.T
    known = 0.25 + cosine / 2 + 5 / 32 * (3 * cosine**2 - 1)
    three = np.abs(np.array(found["three"]["irradiance"])[:, :, 0] - known).max()
    travel = np.array([light["direction"] for light in found["filament"]])
    color = np.array([light["color"] for light in found["filament"]])
    print("| engine | checked | largest error |\n|---|---|---|")
    revision = found["three"]["revision"]
    print(f"| three.js r{revision} | ObjectLoader, getIrradianceAt, 7 lights x 7 normals | {three:.1e} W/m2 |")
    print(f"| glTF validator | errors, warnings | {found['gltf']['errors']}, {found['gltf']['warnings']} |")
    print(f"| Filament | getDirectionEstimate, where the light travels to | {np.abs(travel + TOWARD).max():.1e} |")
    print(f"| Filament | getColorEstimate, irradiance facing the light | {np.abs(color[:, 3] - 17 / 16).max():.1e} W/m2 |")


if __name__ == "__main__":
    main()
