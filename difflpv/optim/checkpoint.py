"""Checkpoints of a fit: one file, written whole or not at all, read without running code from it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch

from difflpv.io.atomic import atomic_path

__all__ = ["CheckpointError", "load_checkpoint", "save_checkpoint"]

_FORMAT = "difflpv-fit-1"


class CheckpointError(ValueError):
    """A checkpoint that cannot be used: one line naming the file and the reason."""


def save_checkpoint(path: str | os.PathLike[str], identity: dict[str, Any], content: dict[str, Any]) -> None:
    """Write a checkpoint atomically.

    Args:
        path: file to replace.
        identity: plain values that a later run must match.
        content: tensors and plain values, all readable by ``torch.load(weights_only=True)``.
    """
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(Path(path)) as temporary:
        torch.save({"format": _FORMAT, "identity": identity, "content": content}, temporary)


def load_checkpoint(path: str | os.PathLike[str], identity: dict[str, Any]) -> dict[str, Any] | None:
    """Content of the checkpoint at ``path``, None if there is no such file.

    Args:
        path: file to read.
        identity: plain values of the present run.

    Raises:
        CheckpointError: the file is not a checkpoint of this version, or belongs to another problem or to other
            solver options.
    """
    if not Path(path).exists():
        return None
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises half a dozen types for a damaged file
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(f"checkpoint {path}: cannot be read ({reason[:120]}); delete it to start anew") from None
    if not isinstance(saved, dict) or saved.get("format") != _FORMAT:
        raise CheckpointError(f"checkpoint {path}: expected format {_FORMAT}, got another file; choose another path")
    for key in [*identity, *(k for k in saved["identity"] if k not in identity)]:
        there, here = saved["identity"].get(key), identity.get(key)
        if there != here:
            raise CheckpointError(
                f"checkpoint {path}: belongs to another fit: {key} is {there!r} there and {here!r} here; "
                "choose another path or delete it"
            )
    return saved["content"]
