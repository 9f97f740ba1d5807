"""``difflpv probes export``: light probes in the format of an engine."""

from __future__ import annotations

import argparse
import textwrap
from pathlib import Path
from typing import Any

from difflpv.cli.options import UsageError, add_output, positive
from difflpv.cli.output import print_json, warn

__all__ = ["add_parser", "run"]

# As difflpv.io.exports.EXPORT_FORMATS, which would load torch; a test holds the two together.
FORMATS = ("threejs", "filament", "gltf", "unity", "godot", "exr")
# Options of one format alone: option -> (format, argument of its export function).
_OWN = {"mirror": "unity", "quantity": "exr", "height": "exr"}


def add_parser(subparsers: Any) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "export",
        help="write probes for three.js, Filament, glTF, Unity, Godot or as EXR maps",
        description=textwrap.fill(
            "Writes the valid probes of a folder (probes.json, probes.safetensors) in the format of an engine, with a record "
            "of what the numbers are: radiance or irradiance, scale, signs, axes, handedness (docs/exports.md).",
            100,
        ),
        epilog="example:\n"
        "  difflpv probes export out/probes --format threejs --out out/probes.json\n"
        "  difflpv probes export out/probes --format exr --quantity radiance --height 32 --out out/probes.exr\n"
        "  difflpv probes export out/probes --format unity --mirror x --out MyProject/Assets/difflpv",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument("probes", metavar="PROBES", type=Path, help="folder with probes.json and probes.safetensors")
    parser.add_argument("--format", choices=FORMATS, required=True, help=", ".join(FORMATS))
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="PATH",
        help="file (threejs: .json, gltf: .gltf, exr: .exr) or folder (filament, unity, godot)",
    )
    parser.add_argument("--mirror", choices=("x", "z"), help="unity: the axis that the scene importer turns round (default: x)")
    parser.add_argument("--quantity", choices=("irradiance", "radiance"), help="exr: what the maps hold (default: irradiance)")
    parser.add_argument("--height", type=positive, metavar="ROWS", help="exr: rows of each map (default: 16)")
    add_output(parser)


def run(args: argparse.Namespace) -> int:
    """Read, export, say what was written."""
    options = {}
    for name, format in _OWN.items():
        value = getattr(args, name)
        if value is not None:
            if format != args.format:
                raise UsageError(f"--{name}: belongs to --format {format}, got --format {args.format}")
            options[name] = value

    from difflpv.io.exports import export_probes, export_warnings
    from difflpv.probes.probe_files import load_probes

    record = load_probes(args.probes)
    files = export_probes(record, args.out, format=args.format, **options)
    warnings = export_warnings(record, format=args.format)
    warn(warnings)
    assert record.probes.valid is not None
    count, left = int(record.probes.valid.sum()), int((~record.probes.valid).sum())
    if args.json:
        print_json(
            {
                "command": "probes export",
                "format": args.format,
                "probes": count,
                "invalid": left,
                "files": files,
                "bytes": sum(file.stat().st_size for file in files),
                "warnings": warnings,
            }
        )
        return 0
    shown = ", ".join(map(str, files)) if len(files) <= 3 else f"{len(files)} files in {args.out}"
    print(f"{count} probes{f' ({left} invalid ones left out)' if left else ''} for {args.format} -> {shown}")
    return 0
