"""Targets on disk, as the fitting code reads them.

A folder of targets holds ``manifest.json``, ``receivers.npz``, and per light set k ``light_k.npz`` (receiver table with
``irr_<component>`` and ``se_<component>`` [n,3] W/m2), ``probes_k.npz`` (``sh_<component>`` and ``se_<component>``
[m,9,3] W/m2) and ``image_k_<component>.exr`` where asked for.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from difflpv.io.tables import ReceiverTable, TableError, load_receivers, load_table
from difflpv.scene import Scene

__all__ = [
    "FORMAT",
    "KIND",
    "MANIFEST",
    "LightTargets",
    "Targets",
    "TargetsError",
    "check_files",
    "check_made_for",
    "file_digest",
    "light_of_table",
    "load_targets",
    "read_manifest",
]

MANIFEST = "manifest.json"
KIND = "difflpv-targets"
_MADE_BY = {KIND: "difflpv targets", "difflpv-probe-targets": "difflpv probes targets"}
FORMAT = 1


class TargetsError(ValueError):
    """Targets that cannot be made or used: one line naming folder, file and reason."""


@dataclass(frozen=True, eq=False)
class LightTargets:
    """Targets under one light set.

    Attributes:
        index: number of the light set.
        entries: its lights, in the form that ``difflpv.lights.apply_light_set`` takes.
        irradiance: by component [W/m2], each [n,3].
        standard_error: of ``irradiance`` by component, each [n,3].
        area_weight: area that each receiver stands for under these lights [m2], 0 behind a panel, [n].
        probe_sh: incident radiance coefficients by component [W/m2], each [m,9,3]; empty without probes.
        probe_standard_error: of ``probe_sh`` by component.
        images: EXR files by component; empty without images.
    """

    index: int
    entries: list[dict[str, Any]]
    irradiance: dict[str, np.ndarray]
    standard_error: dict[str, np.ndarray]
    area_weight: np.ndarray
    probe_sh: dict[str, np.ndarray]
    probe_standard_error: dict[str, np.ndarray]
    images: dict[str, Path]


@dataclass(frozen=True, eq=False)
class Targets:
    """A folder of targets.

    Attributes:
        folder: where they lie.
        receivers: positions and normals that all light sets share, before any weight is zeroed.
        lights: one entry per light set.
        probe_positions: [m,3] m, m = 0 without probes.
        manifest: scene, request, samples, versions, seconds, files.
    """

    folder: Path
    receivers: ReceiverTable
    lights: tuple[LightTargets, ...]
    probe_positions: np.ndarray
    manifest: dict[str, Any]

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the irradiance components."""
        return tuple(self.manifest["request"]["components"])

    def check_scene(self, scene: Scene) -> None:
        """Raise a ``TargetsError`` unless these targets were made for ``scene``."""
        check_made_for(scene, self.folder, self.manifest)


def check_made_for(scene: Scene, folder: Path, manifest: dict[str, Any]) -> None:
    """Raise a ``TargetsError`` unless the targets of this manifest were made for ``scene``."""
    made_for = manifest["request"]["scene"]
    if made_for["hash"] != scene.hash:
        raise TargetsError(
            f"{folder}: targets belong to another scene: made for '{made_for['name']}' "
            f"({made_for['hash'][:12]}), got '{scene.name}' ({scene.hash[:12]})"
        )


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read_manifest(folder: str | Path, kind: str = KIND) -> dict[str, Any] | None:
    """Manifest of a folder, None if it has none.

    Raises:
        TargetsError: it is no manifest of this kind and format.
    """
    path = Path(folder) / MANIFEST
    if not path.is_file():
        return None
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise TargetsError(f"{path}: damaged manifest: {' '.join(str(error).split())}") from None
    found = manifest.get("kind") if isinstance(manifest, dict) else None
    if found != kind:
        other = f": '{_MADE_BY[found]}' made it, expected '{_MADE_BY[kind]}'" if found in tuple(_MADE_BY) else ""
        raise TargetsError(f"{path}: not a manifest of {kind.removeprefix('difflpv-').replace('-', ' ')}{other}")
    if manifest.get("format") != FORMAT:
        raise TargetsError(f"{path}: format {manifest.get('format')!r}, this version reads format {FORMAT}")
    for key, expected in (("request", dict), ("files", dict), ("lights", list)):
        if not isinstance(manifest.get(key), expected):
            raise TargetsError(f"{path}: damaged manifest: '{key}' is missing")
    return manifest


def light_of_table(path: str | Path) -> str | None:
    """Hash of the scene under the lights that a table ``light_<k>.npz`` of finished targets holds the truth of, else None."""
    path = Path(path)
    try:
        manifest = read_manifest(path.parent)
    except TargetsError:
        return None
    number = path.stem.removeprefix("light_")
    if manifest is None or path.name not in manifest["files"] or not number.isdecimal():
        return None
    lights = manifest["request"].get("lights", [])
    return str(lights[int(number)]) if int(number) < len(lights) else None


def check_files(folder: Path, kind: str = KIND) -> dict[str, Any]:
    """Manifest of finished targets whose files are all there and unchanged.

    Raises:
        TargetsError: no targets there, or a file is missing or changed.
    """
    manifest = read_manifest(folder, kind)
    if manifest is None:
        missing = "expected a folder, got a file" if folder.exists() else "no such folder"
        reason = missing if not folder.is_dir() else f"no {MANIFEST}: not targets, or not finished"
        raise TargetsError(f"{folder}: {reason}")
    for name, digest in manifest["files"].items():
        path = folder / name
        if not path.is_file():
            raise TargetsError(f"{path}: missing, the manifest names it")
        if file_digest(path) != digest:
            raise TargetsError(f"{path}: was changed since the targets were made, make them again")
    return manifest


def load_targets(folder: str | Path) -> Targets:
    """Load finished targets.

    Args:
        folder: folder written by ``data_gen.targets.make_targets``.

    Raises:
        TargetsError: no targets there, or a file is missing, damaged or changed.
    """
    folder = Path(folder)
    manifest = check_files(folder)
    try:
        receivers = load_receivers(folder / "receivers.npz")
        lights = tuple(_load_light(folder, manifest, index) for index in range(len(manifest["lights"])))
        has_probes = manifest["request"]["probes"] is not None
        probes = load_table(folder / "probes_0.npz")["position"] if has_probes else np.empty((0, 3))
    except (TableError, KeyError, TypeError) as error:
        raise TargetsError(f"{folder}: damaged targets: {' '.join(str(error).split())}") from None
    return Targets(folder, receivers, lights, probes, manifest)


def _load_light(folder: Path, manifest: dict[str, Any], index: int) -> LightTargets:
    request = manifest["request"]
    names = request["components"]
    table = load_table(folder / f"light_{index}.npz")
    probes = load_table(folder / f"probes_{index}.npz") if request["probes"] is not None else {}
    probe_names = [name[3:] for name in probes if name.startswith("sh_")]
    images = {name: folder / f"image_{index}_{name}.exr" for name in names} if request["images"] is not None else {}
    return LightTargets(
        index=index,
        entries=manifest["lights"][index]["entries"],
        irradiance={name: table[f"irr_{name}"] for name in names},
        standard_error={name: table[f"se_{name}"] for name in names},
        area_weight=table["area_weight"],
        probe_sh={name: probes[f"sh_{name}"] for name in probe_names},
        probe_standard_error={name: probes[f"se_{name}"] for name in probe_names},
        images=images,
    )
