"""PLY meshes, ASCII and binary of either byte order, any polygons.

PLY carries neither materials nor lights: the mesh gets albedo 0.8, and a directional light of 1 W/m2 that a light set
replaces; both are told in ``Scene.warnings``. Read here because mesh libraries refuse mixed polygons and do not bound
what a header claims.

Source: Greg Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from difflpv.io.assemble import SceneBuilder
from difflpv.scene import DirectionalLight, Scene, SceneError

__all__ = ["load_ply"]

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_TYPES |= {"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"}
_MAX_HEADER = 2**16
_LIGHT_DIRECTION = (-0.3, -1.0, -0.4)


@dataclass
class _Property:
    name: str
    dtype: np.dtype
    count: np.dtype | None = None  # type of the length in front of a list


@dataclass
class _Element:
    name: str
    rows: int
    properties: list[_Property] = field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        return any(p.count is not None for p in self.properties)


# Values of an element: a column [rows] for a number, a list of rows for a list.
_Columns = dict[str, np.ndarray | list[np.ndarray]]


def load_ply(path: Path) -> Scene:
    """Load a ``.ply`` file; errors name the element, the caller adds the file."""
    content = path.read_bytes()
    elements, style, start = _header(content)
    columns: dict[str, _Columns] = {}
    if style == "ascii":
        reader: _AsciiReader | _BinaryReader = _AsciiReader(content[start:])
    else:
        reader = _BinaryReader(content[start:])
    for element in elements:
        columns[element.name] = reader.read(element)
        if {"vertex", "face"} <= set(columns):
            break  # what follows (edges, comments of scanners) is not needed
    kinds = {(e.name, p.name): p.count is not None for e in elements for p in e.properties}
    if any(kinds.get(("vertex", axis), True) for axis in "xyz"):
        raise SceneError("element 'vertex' with the numbers x, y and z is missing")
    index = next((name for name in ("vertex_indices", "vertex_index") if kinds.get(("face", name), False)), None)
    if index is None:
        raise SceneError("no mesh: element 'face' with a list 'vertex_indices' is missing")
    vertices = np.stack([np.asarray(columns["vertex"][axis], np.float64).reshape(-1) for axis in "xyz"], 1)
    polygons = columns["face"][index]
    builder = SceneBuilder(path.stem)
    builder.reserve(len(vertices) + sum(3 * max(len(p) - 2, 0) for p in polygons))
    if kinds.keys() & {("vertex", "red"), ("face", "red")}:
        builder.warnings.append("vertex and face colours are not used")
    builder.add_mesh(path.stem, vertices, _fan(polygons), builder.default_material(f"mesh '{path.stem}'"))
    builder.lights.append(DirectionalLight(np.array(_LIGHT_DIRECTION), np.ones(3), "default"))
    builder.warnings.append("PLY holds no light: a directional light of 1 W/m2 was added, a light set replaces it")
    return builder.build()


def _fan(polygons: list[np.ndarray] | np.ndarray) -> np.ndarray:
    """Triangles [T,3] of polygons, each split into a fan."""
    by_size: dict[int, list[int]] = {}
    for row, polygon in enumerate(polygons):
        if len(polygon) < 3:
            raise SceneError(f"face {row}: expected at least 3 corners, got {len(polygon)}")
        by_size.setdefault(len(polygon), []).append(row)
    triangles, order = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
    for size, rows in by_size.items():
        corners = np.array([polygons[row] for row in rows], np.int64)
        fan = np.stack([np.repeat(corners[:, :1], size - 2, 1), corners[:, 1:-1], corners[:, 2:]], -1)
        triangles.append(fan.reshape(-1, 3))
        order.append(np.repeat(rows, size - 2))
    return np.concatenate(triangles)[np.argsort(np.concatenate(order), kind="stable")]


def _header(content: bytes) -> tuple[list[_Element], str, int]:
    """Elements, format name and the position of the data."""
    end = content.find(b"end_header", 0, _MAX_HEADER)
    stop = content.find(b"\n", end)
    if not content.startswith(b"ply") or end < 0 or stop < 0:
        raise SceneError("not a PLY file: the header is missing, unfinished or larger than 64 KiB")
    elements: list[_Element] = []
    style = ""
    for number, line in enumerate(content[:end].decode("latin-1").splitlines(), 1):
        words = line.split()
        if not words or words[0] in ("ply", "comment", "obj_info"):
            continue
        try:
            if words[0] == "format":
                style = words[1]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2])))
            elif words[0] == "property" and words[1] == "list":
                count, dtype = np.dtype(_TYPES[words[2]]), np.dtype(_TYPES[words[3]])
                if count.kind == "f" or dtype.kind == "f" and words[4].startswith("vertex_ind"):
                    raise ValueError(line)
                elements[-1].properties.append(_Property(words[4], dtype, count))
            elif words[0] == "property":
                elements[-1].properties.append(_Property(words[2], np.dtype(_TYPES[words[1]])))
            else:
                raise ValueError(line)
        except (ValueError, IndexError, KeyError):
            raise SceneError(f"header line {number} is not understood: '{line.strip()[:60]}'") from None
    if style not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise SceneError(f"format '{style[:30]}' is unknown, expected ascii or binary")
    left = len(content) - stop - 1
    for element in elements:
        names = [p.name for p in element.properties]
        if len(set(names)) < len(names):
            raise SceneError(f"element '{element.name}': a property is named twice")
        # Every value takes at least a byte: a header that claims more than that is refused before anything is made.
        if element.rows < 0 or element.rows * len(names) > left:
            raise SceneError(f"truncated: {element.rows} rows of '{element.name}' do not fit into {left} bytes")
        if style != "ascii":
            order: Literal["<", ">"] = "<" if style == "binary_little_endian" else ">"
            for p in element.properties:
                p.dtype = p.dtype.newbyteorder(order)
                p.count = None if p.count is None else p.count.newbyteorder(order)
    if len({e.name for e in elements}) < len(elements):
        raise SceneError("an element is named twice")
    return elements, style, stop + 1


class _AsciiReader:
    def __init__(self, body: bytes) -> None:
        self._words = body.split()
        self._position = 0

    def read(self, element: _Element) -> _Columns:
        if not element.has_lists:
            width = len(element.properties)
            table = self._take(element.rows * width, element, 0).reshape(element.rows, width)
            return {p.name: table[:, k] for k, p in enumerate(element.properties)}
        columns: _Columns = {p.name: [] for p in element.properties}
        for row in range(element.rows):
            for p in element.properties:
                count = 1 if p.count is None else self._count(element, row)
                values = self._take(count, element, row)
                if p.dtype.kind != "f":
                    values = _integers(values, element, row)
                columns[p.name].append(values)  # type: ignore[union-attr]
        return columns

    def _count(self, element: _Element, row: int) -> int:
        count = self._take(1, element, row)[0]
        if not 0 <= count <= len(self._words) or count != int(count):
            raise SceneError(f"{element.name} {row}: list length {count} is out of range")
        return int(count)

    def _take(self, count: int, element: _Element, row: int) -> np.ndarray:
        words = self._words[self._position : self._position + count]
        if len(words) < count:
            raise SceneError(f"truncated: the data ends in element '{element.name}'")
        self._position += count
        try:
            return np.array(list(map(float, words)), np.float64)
        except ValueError as error:
            raise SceneError(f"element '{element.name}', from row {row}: {error}") from None


def _integers(values: np.ndarray, element: _Element, row: int) -> np.ndarray:
    if not (np.isfinite(values).all() and (np.abs(values) < 2**53).all() and (values == np.round(values)).all()):
        raise SceneError(f"{element.name} {row}: expected integers, got {values.tolist()[:6]}")
    return values.astype(np.int64)


class _BinaryReader:
    def __init__(self, body: bytes) -> None:
        self._body = body
        self._position = 0

    def read(self, element: _Element) -> _Columns:
        if not element.properties or not element.rows:
            return {p.name: [] for p in element.properties}
        fast = self._read_uniform(element)
        return self._read_rows(element) if fast is None else fast

    def _read_uniform(self, element: _Element) -> _Columns | None:
        """All rows at once if every row's lists are as long as the first row's, else None."""
        fields: list[Any] = []
        position, lengths = self._position, {}
        for p in element.properties:
            if p.count is not None:
                lengths[p.name] = length = self._length(element, 0, p.count, position)
                fields.append((f"{p.name} length", p.count, ()))
                fields.append((p.name, p.dtype, (length,)))
                position += p.count.itemsize + length * p.dtype.itemsize
            else:
                fields.append((p.name, p.dtype, ()))
                position += p.dtype.itemsize
        row = np.dtype(fields)
        if self._position + row.itemsize * element.rows > len(self._body):
            if element.has_lists:
                return None  # perhaps later rows are shorter
            raise SceneError(f"truncated: the data ends in element '{element.name}'")
        table = np.frombuffer(self._body, row, element.rows, self._position)
        if any((table[f"{name} length"] != length).any() for name, length in lengths.items()):
            return None
        self._position += row.itemsize * element.rows
        return {p.name: table[p.name] for p in element.properties}

    def _read_rows(self, element: _Element) -> _Columns:
        columns: _Columns = {p.name: [] for p in element.properties}
        for row in range(element.rows):
            for p in element.properties:
                length = 1
                if p.count is not None:
                    length = self._length(element, row, p.count, self._position)
                    self._position += p.count.itemsize
                if self._position + length * p.dtype.itemsize > len(self._body):
                    raise SceneError(f"truncated: the data ends in {element.name} {row}")
                values = np.frombuffer(self._body, p.dtype, length, self._position)
                columns[p.name].append(values)  # type: ignore[union-attr]
                self._position += length * p.dtype.itemsize
        return columns

    def _length(self, element: _Element, row: int, dtype: np.dtype, position: int) -> int:
        if position + dtype.itemsize > len(self._body):
            raise SceneError(f"truncated: the data ends in {element.name} {row}")
        length = int(np.frombuffer(self._body, dtype, 1, position)[0])
        if not 0 <= length <= len(self._body):
            raise SceneError(f"{element.name} {row}: list length {length} is out of range")
        return length
