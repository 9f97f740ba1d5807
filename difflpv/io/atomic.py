"""Atomic file writes: a reader sees the old file or the whole new one, never a half-written one.

The new content goes to a temporary file in the same folder, is flushed to the disk, and is renamed over the target.
"""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

__all__ = ["atomic_path", "write_bytes", "write_json", "write_text"]


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Temporary path to write to; renamed to ``path`` on success, removed on any error.

    Args:
        path: the file to be written. Its folder must exist.

    Yields:
        An empty file in the same folder, with the same suffix, for a library that opens files by name.

    Raises:
        FileNotFoundError: the folder does not exist.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: folder '{path.parent}' does not exist")
    temporary = path.parent / f".{path.stem}.{secrets.token_hex(6)}.tmp{path.suffix}"
    temporary.touch(exist_ok=False)  # through the umask, so that the result has ordinary permissions
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    if os.name == "posix":  # the rename itself survives a power cut only once the folder is on the disk
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        except OSError:
            pass  # some network file systems cannot sync a folder; the content is safe
        finally:
            os.close(folder)


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write ``content`` to ``path`` atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: str | Path, content: str) -> None:
    """Write ``content`` to ``path`` as UTF-8, atomically."""
    write_bytes(path, content.encode("utf-8"))


def write_json(path: str | Path, content: Any) -> None:
    """Write ``content`` as indented JSON, atomically.

    Raises:
        ValueError: ``content`` holds a NaN or an infinity, which JSON cannot carry.
        TypeError: ``content`` holds a value that is no JSON.
    """
    try:
        text = json.dumps(content, indent=1, allow_nan=False)
    except ValueError as error:
        raise ValueError(f"{path}: not valid JSON: {error}") from None
    write_text(path, text + "\n")
