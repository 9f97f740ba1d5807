"""The container of glTF 2.0: JSON, buffers and accessors, checked before they are used.

Source: Khronos Group, glTF 2.0 specification, sections 3.6 (binary data) and 4 (GLB).
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from difflpv.scene import SceneError

__all__ = ["GltfDocument", "number", "numbers"]

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_LARGEST = 1e30  # numbers beyond this are damage, and their products would overflow


def number(value: Any, where: str) -> float:
    """``value`` as a finite float; ``where`` names it in the error."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= _LARGEST:
        raise SceneError(f"{where}: expected a finite number, got {str(value)[:40]}")
    return float(value)


def numbers(value: Any, count: int, where: str) -> np.ndarray:
    """``value`` as ``count`` finite floats."""
    if not isinstance(value, list) or len(value) != count:
        raise SceneError(f"{where}: expected {count} numbers, got {str(value)[:60]}")
    return np.array([number(v, where) for v in value])


class GltfDocument:
    """A ``.glb`` or ``.gltf`` file: ``json`` and the bytes behind it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._buffers: dict[int, bytes] = {}
        content = path.read_bytes()
        if content[:4] == b"glTF" or path.suffix.lower() == ".glb":
            text, self._binary = _glb_chunks(content)
        else:
            text, self._binary = content, None
        try:
            self.json = json.loads(text.decode("utf-8-sig"), parse_constant=_no_constant)
        except ValueError as error:  # also UnicodeDecodeError and JSONDecodeError
            raise SceneError(f"JSON is damaged: {error}") from None
        if not isinstance(self.json, dict):
            raise SceneError("JSON is damaged: expected an object at the top")
        version = self.child(self.json, "asset", "asset").get("version")
        if not isinstance(version, str) or not version.startswith("2."):
            raise SceneError(f"asset version: expected glTF 2.x, got {str(version)[:20]}")

    @staticmethod
    def child(parent: dict[str, Any], key: str, where: str) -> dict[str, Any]:
        """The object ``parent[key]``; empty if it is absent."""
        value = parent.get(key, {})
        if not isinstance(value, dict):
            raise SceneError(f"{where}: expected an object, got {type(value).__name__}")
        return value

    def extension(self, parent: dict[str, Any], name: str, where: str) -> dict[str, Any] | None:
        """Extension ``name`` of an element, None if it has none."""
        extensions = self.child(parent, "extensions", f"{where} extensions")
        return self.child(extensions, name, f"{where} {name}") if name in extensions else None

    @staticmethod
    def array(parent: dict[str, Any], key: str, where: str) -> list[Any]:
        """The list ``parent[key]``; empty if it is absent."""
        value = parent.get(key, [])
        if not isinstance(value, list):
            raise SceneError(f"{where}: expected a list, got {type(value).__name__}")
        return value

    def element(self, kind: str, index: Any, where: str, parent: dict[str, Any] | None = None) -> dict[str, Any]:
        """Object ``index`` of the top-level list ``kind`` (or of ``parent``'s); ``where`` names who asks."""
        items = self.array(self.json if parent is None else parent, kind, kind)
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(items):
            raise SceneError(f"{where}: index {str(index)[:20]} into {kind} is out of range, there are {len(items)}")
        if not isinstance(items[index], dict):
            raise SceneError(f"{kind} {index}: expected an object")
        return items[index]

    def view(self, index: Any, where: str) -> tuple[memoryview, int | None]:
        """Bytes of a buffer view, and its stride."""
        view = self.element("bufferViews", index, where)
        where = f"bufferView {index}"
        if self.extension(view, "EXT_meshopt_compression", where) is not None:
            raise SceneError(f"{where}: EXT_meshopt_compression is not supported, export without compression")
        content = self._buffer(view.get("buffer"), where)
        offset, length = _count(view.get("byteOffset", 0), where), _count(view.get("byteLength"), where)
        if offset + length > len(content):
            raise SceneError(f"{where}: bytes {offset}..{offset + length} run past its buffer of {len(content)} bytes")
        stride = view.get("byteStride")
        if stride is not None and not 4 <= _count(stride, where) <= 252:
            raise SceneError(f"{where}: byteStride must lie in 4..252, got {stride}")
        return memoryview(content)[offset : offset + length], stride

    def accessor(self, index: Any, where: str, types: Sequence[str]) -> np.ndarray:
        """Values of an accessor, shape [count] for SCALAR, else [count, width]; normalised integers as floats."""
        accessor = self.element("accessors", index, where)
        name = f"{where}, accessor {index}"
        if "sparse" in accessor:
            raise SceneError(f"{name}: sparse accessors are not supported")
        if "bufferView" not in accessor:
            raise SceneError(f"{name}: no bufferView (compressed or empty data is not supported)")
        kind, component = accessor.get("type"), accessor.get("componentType")
        if not isinstance(kind, str) or kind not in types:
            raise SceneError(f"{name}: expected type {' or '.join(types)}, got {str(kind)[:20]}")
        if not isinstance(component, int) or component not in _COMPONENTS:
            raise SceneError(f"{name}: unknown componentType {str(component)[:20]}")
        dtype, width = np.dtype(_COMPONENTS[component]), _WIDTHS[kind]
        data, stride = self.view(accessor["bufferView"], name)
        count, offset = _count(accessor.get("count"), name), _count(accessor.get("byteOffset", 0), name)
        size = dtype.itemsize * width
        step = stride or size
        if step < size:
            raise SceneError(f"{name}: byteStride {step} is smaller than an element of {size} bytes")
        if count and offset + step * (count - 1) + size > len(data):
            raise SceneError(f"{name}: {count} elements run past the end of a bufferView of {len(data)} bytes")
        values: np.ndarray = np.ndarray((count, width), dtype, data, offset, (step, dtype.itemsize)).copy()
        if accessor.get("normalized") is True and dtype.kind in "iu":
            values = np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values[:, 0] if kind == "SCALAR" else values

    def _buffer(self, index: Any, where: str) -> bytes:
        buffer = self.element("buffers", index, where)
        if index not in self._buffers:
            name = f"buffer {index}"
            if "uri" in buffer:
                content = self.uri_bytes(buffer["uri"], name)
            elif index == 0 and self._binary is not None:
                content = self._binary
            else:
                raise SceneError(f"{name}: neither a uri nor a binary chunk")
            length = _count(buffer.get("byteLength"), name)
            if len(content) < length:
                raise SceneError(f"{name}: truncated: {length} bytes expected, {len(content)} found")
            self._buffers[index] = content[:length]
        return self._buffers[index]

    def uri_bytes(self, uri: Any, where: str) -> bytes:
        """Bytes behind a data URI, or of a file beside this one."""
        if not isinstance(uri, str):
            raise SceneError(f"{where}: uri must be text")
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            if not head.endswith(";base64"):
                raise SceneError(f"{where}: expected a base64 data URI")
            try:
                return base64.b64decode(body, validate=True)
            except (binascii.Error, ValueError) as error:
                raise SceneError(f"{where}: data URI is damaged: {error}") from None
        relative = unquote(uri)
        if "://" in relative or "\0" in relative or Path(relative).is_absolute():
            raise SceneError(f"{where}: expected a file beside the scene, got '{uri[:80]}'")
        path = self.path.parent / relative
        if not path.is_file():
            raise SceneError(f"{where}: file '{path}' is missing")
        return path.read_bytes()


def _count(value: Any, where: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**40:
        raise SceneError(f"{where}: expected a count of bytes or elements, got {str(value)[:20]}")
    return value


def _no_constant(text: str) -> float:
    raise ValueError(f"{text} is not JSON")


def _glb_chunks(content: bytes) -> tuple[bytes, bytes | None]:
    """JSON and binary chunk of a GLB container."""
    if len(content) < 12 or content[:4] != b"glTF":
        raise SceneError("not a GLB file: the header is missing")
    version, length = struct.unpack_from("<II", content, 4)
    if version != 2:
        raise SceneError(f"GLB version: expected 2, got {version}")
    if length > len(content):
        raise SceneError(f"truncated: the GLB header says {length} bytes, the file has {len(content)}")
    chunks: list[tuple[int, bytes]] = []
    position = 12
    while position + 8 <= length:
        size, kind = struct.unpack_from("<II", content, position)
        if position + 8 + size > length:
            raise SceneError(f"truncated: GLB chunk {len(chunks)} of {size} bytes runs past the end")
        chunks.append((kind, content[position + 8 : position + 8 + size]))
        position += 8 + size
    if not chunks or chunks[0][0] != 0x4E4F534A:
        raise SceneError("GLB has no JSON chunk")
    binary = next((data for kind, data in chunks[1:] if kind == 0x004E4942), None)
    return chunks[0][1], binary
