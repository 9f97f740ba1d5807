"""Light probes on disk: ``probes.json`` (what they are) beside ``probes.safetensors`` (their numbers).

The tensors are ``position`` [n,3] float64 m, ``radiance`` [n,9,3] float64 W/m2, ``valid`` [n] uint8 and, where points read the
probes by Gaussian footprints, ``metric`` [n,3,3] float64 1/m. ``reader`` in the record says how points read them
(``ProbeReader``); files without it are read by tetrahedra. The record repeats the convention in words, so that a reader without
this package can use the numbers; it also holds the checksum of the tensors, so that a pair from two different runs is refused.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

import difflpv
from difflpv.io.atomic import write_bytes, write_json
from difflpv.probes.probe_set import COEFFS, ProbeSet
from difflpv.probes.reader import ProbeReader

__all__ = ["CONVENTION", "MAX_PROBES", "ProbeFileError", "ProbeRecord", "describes_probes", "load_probes", "save_probes"]

MAX_PROBES = 2**20
"""More probes than that are refused: some 250 MB of coefficients."""
_FORMAT = 1
_JSON, _TENSORS = "probes.json", "probes.safetensors"
_MAX_JSON = 2**24  # bytes
_MAX_TENSORS = MAX_PROBES * (3 + 3 * COEFFS + 9) * 8 + MAX_PROBES + 2**16

CONVENTION: Mapping[str, Any] = MappingProxyType(
    {
        "quantity": "radiance",
        "unit": "W/m2: coefficient i is the integral of L(w) Y_i(w) dw",
        "direction": "w points from the probe toward the incoming light",
        "basis": "real orthonormal spherical harmonics, degrees 0 to 2, without Condon-Shortley phase",
        "index": "l(l+1)+m",
        "polynomials": ["1", "y", "z", "x", "xy", "yz", "3z^2-1", "xz", "x^2-y^2"],
        "irradiance": "E(n) = sum over i of A_l L_i Y_i(n), A = pi, 2 pi/3, pi/4",
        "axes": "right-handed, y up",
        "length": "m",
        "color": "linear RGB",
    }
)
"""What the numbers of a file mean; written into every ``probes.json`` and required there."""


class ProbeFileError(ValueError):
    """Probes that cannot be read: one line naming file and reason."""


@dataclass(frozen=True, eq=False)
class ProbeRecord:
    """Probes and where they come from.

    Attributes:
        probes: the probes themselves.
        scene: name and content hash of the scene, ``{"name": ..., "hash": ...}``, or empty.
        method: how they were placed; empty if unknown.
        errors: judged errors by name.
        provenance: further JSON values (command, seed, options, targets, seconds ...).
        reader: how points read them, the invalid ones (which it leaves to its user to take out) included.
    """

    probes: ProbeSet
    scene: dict[str, str] = field(default_factory=dict)
    method: str = ""
    errors: dict[str, float] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    reader: ProbeReader = ProbeReader()

    def __post_init__(self) -> None:
        if not len(self.probes):
            raise ValueError("probes: expected at least one, got none")
        if len(self.probes) > MAX_PROBES:
            raise ValueError(f"probes: expected at most {MAX_PROBES}, got {len(self.probes)}")
        if not isinstance(self.method, str):
            raise TypeError(f"probe method: expected text, got {type(self.method).__name__}")
        for name in ("scene", "errors", "provenance"):
            if not isinstance(getattr(self, name), dict):
                raise TypeError(f"probe {name}: expected a dictionary, got {type(getattr(self, name)).__name__}")
        if self.scene and not all(isinstance(self.scene.get(key), str) for key in ("name", "hash")):
            raise ValueError(f"probe scene: expected name and hash, got {', '.join(map(str, self.scene)) or 'nothing'}")
        if not isinstance(self.reader, ProbeReader):
            raise TypeError(f"probe reader: expected a ProbeReader, got {type(self.reader).__name__}")
        if self.reader.metric is not None and len(self.reader.metric) != len(self.probes):
            raise ValueError(f"probe reader: expected metrics of {len(self.probes)} probes, got {len(self.reader.metric)}")

    @property
    def usable_reader(self) -> ProbeReader:
        """How points read ``probes.usable``."""
        assert self.probes.valid is not None
        return self.reader.kept(self.probes.valid)


def save_probes(folder: str | Path, record: ProbeRecord) -> None:
    """Write ``probes.safetensors`` and ``probes.json`` into ``folder``, each atomically, the numbers first.

    Raises:
        ValueError: an error or provenance value that JSON cannot hold.
    """
    folder = Path(folder)
    probes = record.probes
    assert probes.valid is not None
    tensors = {
        "position": np.ascontiguousarray(probes.position),
        # Where a probe is not valid its content may be anything; a file holds finite numbers only.
        "radiance": np.where(probes.valid[:, None, None], probes.radiance, np.nan_to_num(probes.radiance, posinf=0, neginf=0)),
        "valid": probes.valid.astype(np.uint8),
    }
    reader = record.reader
    if reader.metric is not None:
        tensors["metric"] = np.ascontiguousarray(reader.metric)
    content = safetensors.numpy.save(tensors, metadata={"format": str(_FORMAT), "convention": json.dumps(dict(CONVENTION))})
    described = {
        "format": _FORMAT,
        "kind": "light probes",
        "difflpv": difflpv.__version__,
        "convention": dict(CONVENTION),
        "count": len(probes),
        "invalid": int((~probes.valid).sum()),
        "scene": record.scene,
        "method": record.method,
        "errors": record.errors,
        "provenance": record.provenance,
        "reader": {"interpolation": reader.interpolation, "neighbours": reader.neighbours, "sight": reader.sight},
        "sha256": hashlib.sha256(content).hexdigest(),
    }
    json.dumps(described, allow_nan=False)  # before anything is on the disk
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(folder / _TENSORS, content)
    write_json(folder / _JSON, described)


def describes_probes(path: Path) -> bool:
    """Whether a file is the ``probes.json`` of saved probes, whose numbers lie beside it."""
    return path.name == _JSON and path.is_file() and (path.parent / _TENSORS).is_file()


def load_probes(folder: str | Path) -> ProbeRecord:
    """Read probes that ``save_probes`` wrote.

    Raises:
        ProbeFileError: missing, damaged, foreign or oversized files, or a pair that does not belong together.
    """
    folder = Path(folder)
    path = folder / _JSON
    described = _read_description(path)
    content = _bounded(folder / _TENSORS, _MAX_TENSORS)
    if hashlib.sha256(content).hexdigest() != described.get("sha256"):
        raise ProbeFileError(f"{folder / _TENSORS}: damaged, or not the file that {_JSON} was written with (checksum differs)")
    try:
        tensors = safetensors.numpy.load(content)
    except (SafetensorError, ValueError) as error:
        raise ProbeFileError(f"{folder / _TENSORS}: damaged: {' '.join(str(error).split())}") from None
    missing = {"position", "radiance", "valid"} - set(tensors)
    if missing:
        raise ProbeFileError(f"{folder / _TENSORS}: tensors missing: {', '.join(sorted(missing))}")
    try:
        probes = ProbeSet(tensors["position"], tensors["radiance"], tensors["valid"].astype(bool))
        scene, method, errors, provenance = (described[name] for name in ("scene", "method", "errors", "provenance"))
        return ProbeRecord(probes, scene, method, errors, provenance, _reader(described, tensors.get("metric")))
    except KeyError as error:
        raise ProbeFileError(f"{path}: {error.args[0]!r} is missing") from None
    except (TypeError, ValueError) as error:
        raise ProbeFileError(f"{path}: {' '.join(str(error).split())}") from None


def _reader(described: dict[str, Any], metric: np.ndarray | None) -> ProbeReader:
    if "reader" not in described and metric is None:
        return ProbeReader()
    reader = described["reader"]
    if not isinstance(reader, dict):
        raise TypeError(f"reader: expected a dictionary, got {type(reader).__name__}")
    missing = {"interpolation", "neighbours", "sight"} - set(reader)
    if missing:
        raise ValueError(f"reader: {', '.join(sorted(missing))} missing")
    return ProbeReader(reader["interpolation"], metric, reader["neighbours"], reader["sight"])


def _read_description(path: Path) -> dict[str, Any]:
    content = _bounded(path, _MAX_JSON)
    try:
        described = json.loads(content.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise ProbeFileError(f"{path}: damaged: {' '.join(str(error).split())}") from None
    if not isinstance(described, dict) or described.get("kind") != "light probes":
        raise ProbeFileError(f"{path}: expected a description of light probes, got another JSON file")
    if described.get("format") != _FORMAT:
        raise ProbeFileError(f"{path}: expected format {_FORMAT}, got {str(described.get('format'))[:20]}")
    convention = described.get("convention")
    if convention != dict(CONVENTION):
        found = convention if isinstance(convention, dict) else {}
        key = next((name for name in CONVENTION if found.get(name) != CONVENTION[name]), "an unknown entry")
        raise ProbeFileError(f"{path}: convention: expected {key} {CONVENTION.get(key)!r}, got {str(found.get(key))[:80]!r}")
    return described


def _bounded(path: Path, limit: int) -> bytes:
    """The bytes of a file of at most ``limit`` bytes."""
    try:
        size = path.stat().st_size
        if size > limit:
            raise ProbeFileError(f"{path}: {size} bytes, at most {limit} are read")
        return path.read_bytes()
    except FileNotFoundError:
        raise ProbeFileError(f"{path}: not found: expected a folder with {_JSON} and {_TENSORS}") from None
    except OSError as error:
        raise ProbeFileError(f"{path}: cannot be read: {error.strerror}") from None
