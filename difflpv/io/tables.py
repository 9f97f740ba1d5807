"""Receiver tables and other named arrays as ``.npz``.

A receiver table holds ``position`` [n,3] m and unit ``normal`` [n,3], optionally ``albedo`` [n,3] and ``area_weight``
[n] m2 (the area that a receiver stands for; 0 leaves it out of every mean), and any further named arrays.
"""

from __future__ import annotations

import math
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from difflpv.io.atomic import atomic_path

__all__ = ["ReceiverTable", "TableError", "load_receivers", "load_table", "save_receivers", "save_table"]

_MAX_BYTES = 2**31  # of one table, unpacked
_NORMAL_TOLERANCE = 1e-3


class TableError(ValueError):
    """A table that cannot be used: one line naming file, array and reason."""


@dataclass(frozen=True, eq=False)
class ReceiverTable:
    """Points at which irradiance is asked for.

    Attributes:
        position: receiver positions [m], shape [n,3].
        normal: unit normals on the lit side, shape [n,3].
        area_weight: area that each receiver stands for [m2], shape [n]; ones if not given.
        albedo: albedo of the surface at each receiver, shape [n,3], or None.
        extras: any further arrays of the file by name (``irr_direct``, ``mesh_id``, ...).
    """

    position: np.ndarray
    normal: np.ndarray
    area_weight: np.ndarray | None = None
    albedo: np.ndarray | None = None
    extras: dict[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        position = _real("position", self.position, (None, 3))
        count = len(position)
        if not count:
            raise TableError("position: expected at least one receiver, got none")
        normal = _real("normal", self.normal, (count, 3))
        length = np.linalg.norm(normal, axis=1)
        bad = np.flatnonzero(np.abs(length - 1) > _NORMAL_TOLERANCE)
        if bad.size:
            raise TableError(f"normal: expected unit length, row {bad[0]} has length {length[bad[0]]:.6g}")
        weight = np.ones(count) if self.area_weight is None else _real("area_weight", self.area_weight, (count,))
        if (weight < 0).any() or not (weight > 0).any():
            raise TableError("area_weight: expected weights >= 0 with at least one above 0")
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "normal", normal)
        object.__setattr__(self, "area_weight", weight)
        if self.albedo is not None:
            albedo = _real("albedo", self.albedo, (count, 3))
            if (albedo < 0).any() or (albedo > 1).any():
                row = int(np.flatnonzero(((albedo < 0) | (albedo > 1)).any(1))[0])
                raise TableError(f"albedo: must lie in [0, 1], row {row} is {albedo[row].tolist()}")
            object.__setattr__(self, "albedo", albedo)

    def __len__(self) -> int:
        return len(self.position)

    def arrays(self) -> dict[str, np.ndarray]:
        """All arrays by name, as they go into the file."""
        own = {"position": self.position, "normal": self.normal, "area_weight": self.area_weight, "albedo": self.albedo}
        return {name: array for name, array in own.items() if array is not None} | dict(self.extras)


def _real(name: str, value: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    array = np.asarray(value)
    wanted = "[" + ", ".join("n" if n is None else str(n) for n in shape) + "]"
    if array.dtype.kind not in "fiu" or array.dtype.itemsize > 8:
        raise TableError(f"{name}: expected real numbers of shape {wanted}, got dtype {array.dtype}")
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        raise TableError(f"{name}: expected shape {wanted}, got {list(array.shape)}")
    array = np.ascontiguousarray(array, np.float64)
    bad = np.flatnonzero(~np.isfinite(array).all(axis=tuple(range(1, array.ndim))))
    if bad.size:
        raise TableError(f"{name}: row {bad[0]} is not finite: {array[bad[0]].tolist()}")
    return array


def load_table(path: str | Path) -> dict[str, np.ndarray]:
    """All arrays of an ``.npz`` file by name; pickled objects are refused.

    Raises:
        TableError: the file is missing, is no ``.npz``, or claims more than 2 GiB.
    """
    path = Path(path)
    if not path.is_file():
        raise TableError(f"{path}: no such file")
    try:
        with zipfile.ZipFile(path) as archive:
            _check_members(path, archive)
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except TableError:
        raise
    except Exception as error:  # zipfile, zlib and numpy raise some ten different types on damaged files
        reason = " ".join(str(error).split()) or type(error).__name__
        raise TableError(f"{path}: not a readable .npz table: {reason}") from None


def _check_members(path: Path, archive: zipfile.ZipFile) -> None:
    """Refuse headers that claim more than the member holds, before numpy allocates what they claim."""
    if sum(info.file_size for info in archive.infolist()) > _MAX_BYTES:
        raise TableError(f"{path}: unpacks to more than {_MAX_BYTES} bytes")
    for info in archive.infolist():
        if not info.filename.endswith(".npy"):
            raise TableError(f"{path}: '{info.filename}' is no array")
        with archive.open(info) as member:
            version = np.lib.format.read_magic(member)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(member)
            if dtype.hasobject:
                raise TableError(f"{path}: '{info.filename[:-4]}' holds Python objects, which are not read")
            if math.prod(shape) * dtype.itemsize != info.file_size - member.tell():
                raise TableError(f"{path}: '{info.filename[:-4]}' is damaged: {list(shape)} does not fit its size")


def load_receivers(path: str | Path) -> ReceiverTable:
    """Receiver table from an ``.npz`` file with at least ``position`` and ``normal``; the rest goes to ``extras``.

    Raises:
        TableError: one line naming file, array and reason.
    """
    arrays = load_table(path)
    for name in ("position", "normal"):
        if name not in arrays:
            raise TableError(f"{path}: array '{name}' is missing, the file has {', '.join(sorted(arrays)) or 'none'}")
    own = {name: arrays.pop(name) for name in ("position", "normal", "area_weight", "albedo") if name in arrays}
    try:
        return ReceiverTable(**own, extras=arrays)
    except TableError as error:
        raise TableError(f"{path}: {error}") from None


def save_table(path: str | Path, **arrays: Any) -> None:
    """Write named arrays to an ``.npz`` file, atomically; the same arrays give the same bytes.

    Raises:
        TableError: an array holds objects or a number that is not finite.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise TableError(f"{path}: expected a file name ending in .npz")
    checked = {}
    for name, value in arrays.items():
        array = np.ascontiguousarray(value)
        if array.dtype.hasobject:
            raise TableError(f"{path}: array '{name}' holds Python objects, expected numbers or text")
        bad = int((~np.isfinite(array)).sum()) if array.dtype.kind in "fc" else 0
        if bad:
            raise TableError(f"{path}: array '{name}' holds {bad} values that are not finite")
        checked[name] = array.reshape(np.shape(value))
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, **checked)


def save_receivers(path: str | Path, table: ReceiverTable) -> None:
    """Write a receiver table to an ``.npz`` file, atomically."""
    save_table(path, **table.arrays())
