"""Light probes in the formats of engines: one module per engine, each the only one that knows its format.

Every export carries a convention record: what the numbers are, in words and in a formula that a reader can evaluate.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any, Literal, get_args

from difflpv.io.exports.convention import ENGINE_READS
from difflpv.probes.probe_files import ProbeRecord

__all__ = ["EXPORT_FORMATS", "ExportFormat", "export_probes", "export_warnings"]

ExportFormat = Literal["threejs", "filament", "gltf", "unity", "godot", "exr"]
EXPORT_FORMATS: tuple[ExportFormat, ...] = get_args(ExportFormat)
_CARRY_READER = ("threejs", "gltf")


def export_probes(record: ProbeRecord, out: str | Path, *, format: ExportFormat, **options: Any) -> list[Path]:
    """Write the valid probes for an engine.

    Args:
        record: the probes.
        out: a file (``threejs``, ``gltf``, ``exr``) or a folder (``filament``, ``unity``, ``godot``), made where missing.
        format: the engine.
        options: of that engine's own function ``export_<format>``.

    Returns:
        The files written.

    Raises:
        difflpv.io.exports.convention.ExportError: what the format cannot hold, in one line.
    """
    if format not in EXPORT_FORMATS:
        raise ValueError(f"format: expected one of {', '.join(EXPORT_FORMATS)}, got {format!r}")
    export = getattr(import_module(f"difflpv.io.exports.{format}"), f"export_{format}")
    return list(export(record, Path(out), **options))


def export_warnings(record: ProbeRecord, *, format: ExportFormat) -> list[str]:
    """One line where points will read the exported probes otherwise than they are made for, none elsewhere."""
    reader = record.reader
    if format in _CARRY_READER or (reader.metric is None and not reader.sight):
        return []
    made_for, reads = reader.described, ENGINE_READS[format]
    return [f"probes made to be read by {made_for}: {reads}, so errors will differ from those recorded"]
