"""Fitted models on disk: ``fitted.json`` (what it is) beside ``fitted.safetensors`` (its numbers)."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

import difflpv
from difflpv.config import LpvConfig
from difflpv.grid import Grid
from difflpv.io.atomic import atomic_path, write_json

__all__ = ["FORMAT", "FittedError", "FittedRecord", "read_fitted", "write_fitted"]

FORMAT = 1
_JSON, _TENSORS = "fitted.json", "fitted.safetensors"


class FittedError(ValueError):
    """A fitted model that cannot be read: one line naming file and reason."""


@dataclass(frozen=True, eq=False)
class FittedRecord:
    """A fitted model without its module.

    Attributes:
        config: method, steps, occlusion and conventions.
        grid: the cells it was fitted on.
        values: physical values by name of what was learned, float64.
        provenance: JSON values that say where it comes from (scene, targets, solver, losses ...).
    """

    config: LpvConfig
    grid: Grid
    values: dict[str, torch.Tensor]
    provenance: dict[str, Any] = field(default_factory=dict)


def write_fitted(folder: str | Path, record: FittedRecord) -> None:
    """Write a model; the tensors first, so that a ``fitted.json`` always has its numbers beside it.

    Raises:
        TypeError, ValueError: provenance that is no JSON, or a value that is not finite; what lies there is left as it is.
    """
    folder = Path(folder)
    values = {name: value.detach().cpu().contiguous() for name, value in record.values.items()}
    grid = record.grid
    described = {
        "format": FORMAT,
        "difflpv": difflpv.__version__,
        "config": record.config.to_json(),
        "grid": {"minimum": grid.minimum, "cell_size": grid.cell_size, "resolution": grid.resolution},
        "values": {name: value.tolist() for name, value in values.items()},
        "provenance": record.provenance,
    }
    json.dumps(described, allow_nan=False)  # before anything is on the disk
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_path(folder / _TENSORS) as path:
        save_file(values, path)
    write_json(folder / _JSON, described)


def read_fitted(folder: str | Path) -> FittedRecord:
    """Read a model.

    Raises:
        FittedError: missing or damaged files, another format, numbers that do not belong to the description.
    """
    folder = Path(folder)
    path = folder / _JSON
    try:
        described = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FittedError(f"{path}: not found: expected a folder written by 'difflpv fit'") from None
    except (OSError, ValueError) as error:
        raise FittedError(f"{path}: damaged: {' '.join(str(error).split())}") from None
    if not isinstance(described, dict) or described.get("format") != FORMAT:
        got = described.get("format") if isinstance(described, dict) else type(described).__name__
        raise FittedError(f"{path}: expected format {FORMAT}, got {got!r}")
    try:
        values = load_file(folder / _TENSORS)
    except FileNotFoundError:
        raise FittedError(f"{folder / _TENSORS}: not found") from None
    except (OSError, SafetensorError) as error:
        raise FittedError(f"{folder / _TENSORS}: damaged: {' '.join(str(error).split())}") from None
    try:
        own = described["grid"]
        grid = Grid(tuple(own["minimum"]), float(own["cell_size"]), tuple(own["resolution"]))
        if {name: value.tolist() for name, value in values.items()} != described["values"]:
            raise ValueError(f"values differ from those of {_TENSORS}: the two files do not belong together")
        return FittedRecord(LpvConfig.from_json(described["config"]), grid, values, dict(described["provenance"]))
    except (KeyError, TypeError, ValueError) as error:
        raise FittedError(f"{path}: {' '.join(str(error).split())}") from None
