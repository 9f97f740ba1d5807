"""What commands print: warnings and progress on stderr, text or one JSON object on stdout."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from difflpv.cli.options import UsageError

__all__ = ["Progress", "jsonable", "last_change", "make_folder", "make_folder_of", "print_json", "warn"]


def warn(lines: Iterable[str]) -> None:
    """One ``warning:`` line each on stderr."""
    for line in dict.fromkeys(lines):
        print(f"warning: {line}", file=sys.stderr)


def print_json(content: dict[str, Any]) -> None:
    """One JSON object on stdout; infinities and NaN, which JSON has not, become null."""
    print(json.dumps(jsonable(content), allow_nan=False))


def jsonable(value: Any) -> Any:
    """Plain JSON values; numbers that are not finite become None."""
    if isinstance(value, dict):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(item) for item in value]
    if hasattr(value, "tolist"):  # arrays and their scalars
        return jsonable(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def last_change(path: Path) -> int | None:
    """When a file was written last [ns], None where there is none: to tell what a command found from what it made."""
    return path.stat().st_mtime_ns if path.is_file() else None


def make_folder(option: str, folder: Path) -> Path:
    """Create an output folder; a ``UsageError`` names the option where that cannot be, or nothing can be written there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{option}: folder {folder} cannot be made: {error.strerror}") from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise UsageError(f"{option}: folder {folder} cannot be written to")
    return folder


def make_folder_of(option: str, file: Path) -> None:
    """Create the folder of an output file, before the work whose result goes there; a ``UsageError`` where it cannot be."""
    if file.is_dir():
        raise UsageError(f"{option}: expected a file, {file} is a folder")
    make_folder(option, file.parent)


class Progress:
    """One line on a terminal's stderr, rewritten in place; silent elsewhere."""

    def __init__(self, *, quiet: bool) -> None:
        self._active = not quiet and sys.stderr.isatty()
        self._width = 0

    def show(self, line: str) -> None:
        """Replace the line."""
        if self._active:
            sys.stderr.write("\r" + line.ljust(self._width))
            sys.stderr.flush()
            self._width = len(line)

    def close(self) -> None:
        """Clear the line."""
        if self._active and self._width:
            sys.stderr.write("\r" + " " * self._width + "\r")
            sys.stderr.flush()
            self._width = 0
