"""Wavefront OBJ scenes with their MTL materials: Kd, map_Kd and Ke.

Read here because mesh libraries lose Ke or the groups. One mesh for each pair of group (or object) and material, in the
order of their first faces. Kd and Ke are linear; a map is decoded from sRGB and multiplied by Kd. A material without Kd
has albedo 0.8. Emission leaves the side of the geometric normal. OBJ's v runs up, ours down: v becomes 1 - v.

Source: Alias Wavefront, "Object Files (.obj)" and "MTL material format", version 3.0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from difflpv.io.assemble import DEFAULT_ALBEDO, SceneBuilder
from difflpv.io.texture import TextureLibrary
from difflpv.scene import Material, Scene, SceneError, Texture

__all__ = ["load_obj"]

# Options of a map statement and how many values follow each.
_MAP_OPTIONS = {"-blendu": 1, "-blendv": 1, "-bm": 1, "-boost": 1, "-cc": 1, "-clamp": 1, "-imfchan": 1, "-mm": 2}
_MAP_OPTIONS |= {"-o": 3, "-s": 3, "-t": 3, "-texres": 1, "-type": 1, "-colorspace": 1}


@dataclass
class _Group:
    """Triangles of one mesh: ``corners`` are pairs (vertex, texture vertex or -1), three a triangle."""

    name: str
    material: str | None
    line: int
    corners: list[tuple[int, int]] = field(default_factory=list)


def load_obj(path: Path) -> Scene:
    """Load an ``.obj`` file; errors name line or element, the caller adds the file."""
    builder = SceneBuilder(path.stem)
    vertices: list[tuple[float, ...]] = []
    uvs: list[tuple[float, ...]] = []
    groups: dict[tuple[str, str | None], _Group] = {}
    materials: dict[str, Material] = {}
    textures = TextureLibrary()
    object_name, group_name, material = "", "", None
    current: _Group | None = None
    for number, line in _statements(path.read_bytes()):
        keyword, _, rest = line.partition(" ")
        if keyword == "v":
            vertices.append(_floats(rest, 3, number, "vertex"))
        elif keyword == "vt":
            uvs.append(_floats(rest, 2, number, "texture vertex"))
        elif keyword == "f":
            if current is None:
                name = group_name or object_name or path.stem
                current = groups.setdefault((name, material), _Group(name, material, number))
            _add_face(current, rest.split(), len(vertices), len(uvs), number, builder)
        elif keyword == "o":
            object_name, group_name, current = rest.strip(), "", None
        elif keyword == "g":
            group_name, current = rest.strip(), None
        elif keyword == "usemtl":
            material, current = rest.strip(), None
            if material not in materials:
                raise SceneError(f"line {number}: material '{material[:80]}' is not in the MTL files read so far")
        elif keyword == "mtllib":
            _load_mtl(path.parent / rest.strip().replace("\\", "/"), number, materials, textures, builder)
    position, uv = np.array(vertices).reshape(-1, 3), np.array(uvs).reshape(-1, 2)
    for group in groups.values():
        key = group.material
        surface = builder.default_material(f"mesh '{group.name}'") if key is None else materials[key]
        _add_group(builder, group, surface, position, uv)
    return builder.build()


def _statements(content: bytes) -> list[tuple[int, str]]:
    """Numbered statements without comments, white space made single, continued lines joined."""
    statements: list[tuple[int, str]] = []
    pending, start = "", 0
    for number, raw in enumerate(content.decode("utf-8-sig", "replace").split("\n"), 1):
        line = raw.strip()
        if line.startswith("#"):
            continue
        start = start if pending else number
        if line.endswith("\\"):
            pending += line[:-1] + " "
            continue
        line, pending = (pending + line).strip(), ""
        if line:
            keyword, *rest = line.split(None, 1)
            statements.append((start, f"{keyword} {rest[0] if rest else ''}"))
    return statements


def _floats(text: str, count: int, line: int, what: str) -> tuple[float, ...]:
    """The first ``count`` numbers of a statement, finite; missing ones of a texture vertex are 0."""
    parts = text.split()[:count]
    if what == "texture vertex" and len(parts) == 1:
        parts.append("0")
    try:
        values = tuple(map(float, parts))
    except ValueError:
        values = ()
    if len(values) != count:
        raise SceneError(f"line {line}: {what}: expected {count} numbers, got '{text.strip()[:60]}'")
    if not all(map(math.isfinite, values)):
        raise SceneError(f"line {line}: {what} is not finite: {list(values)}")
    return values


def _add_face(group: _Group, parts: list[str], vertices: int, uvs: int, line: int, builder: SceneBuilder) -> None:
    """Split a polygon into a fan of triangles."""
    if len(parts) < 3:
        raise SceneError(f"line {line}: a face needs at least 3 corners, got {len(parts)}")
    builder.reserve(6 * (len(parts) - 2))
    corners = []
    for part in parts:
        fields = part.split("/")
        vertex = _index(fields[0], vertices, line, "vertices")
        uv = _index(fields[1], uvs, line, "texture vertices") if len(fields) > 1 and fields[1] else -1
        corners.append((vertex, uv))
    for k in range(1, len(corners) - 1):
        group.corners += (corners[0], corners[k], corners[k + 1])


def _index(text: str, count: int, line: int, what: str) -> int:
    try:
        value = int(text)
    except ValueError:
        raise SceneError(f"line {line}: expected an index, got '{text[:40]}'") from None
    index = value - 1 if value > 0 else count + value
    if value == 0 or not 0 <= index < count:
        raise SceneError(f"line {line}: index {text[:20]} is out of range, there are {count} {what}")
    return index


def _add_group(builder: SceneBuilder, group: _Group, material: Material, position: np.ndarray, uv: np.ndarray) -> None:
    corners = np.array(group.corners, np.int64)
    if material.texture is None:
        corners[:, 1] = -1  # texture coordinates would only split vertices
    key = corners[:, 0] * (len(uv) + 1) + corners[:, 1] + 1
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    used = corners[first]
    coordinates = None
    missing = int((used[:, 1] < 0).sum())
    if material.texture is not None and missing < len(used):
        coordinates = np.where(used[:, 1:] >= 0, uv[used[:, 1]], 0.0)
        coordinates[:, 1] = 1 - coordinates[:, 1]
        if missing:
            builder.warnings.append(f"mesh '{group.name}': {missing} corners without texture coordinates get (0, 0)")
    builder.add_mesh(group.name, position[used[:, 0]], inverse.reshape(-1, 3), material, uv=coordinates)


@dataclass
class _MtlEntry:
    name: str
    kd: tuple[float, ...] = (DEFAULT_ALBEDO,) * 3
    ke: tuple[float, ...] = (0.0,) * 3
    texture: Texture | None = None


def _load_mtl(
    path: Path, line: int, materials: dict[str, Material], textures: TextureLibrary, builder: SceneBuilder
) -> None:
    if not path.is_file():
        raise SceneError(f"line {line}: MTL file '{path}' is missing")
    entries: list[_MtlEntry] = []
    for number, text in _statements(path.read_bytes()):
        where = f"{path.name} line {number}"
        keyword, _, rest = text.partition(" ")
        if keyword == "newmtl":
            entries.append(_MtlEntry(rest.strip()))
        elif keyword in ("Kd", "Ke", "map_Kd"):
            if not entries:
                raise SceneError(f"{where}: {keyword} before the first newmtl")
            entry = entries[-1]
            if keyword == "map_Kd":
                entry.texture = _map(path.parent, rest, f"{where}: material '{entry.name}'", textures, builder)
            elif keyword == "Kd":
                entry.kd = _color(rest, where, f"material '{entry.name}': Kd")
            else:
                entry.ke = _color(rest, where, f"material '{entry.name}': Ke")
    for entry in entries:
        try:
            materials[entry.name] = Material(entry.name, np.array(entry.kd), entry.texture, np.array(entry.ke))
        except SceneError as error:
            raise SceneError(f"{path.name}: {error}") from None


def _color(text: str, where: str, what: str) -> tuple[float, ...]:
    parts = text.split()
    try:
        values = tuple(map(float, parts[:3]))
    except ValueError:
        values = ()
    if len(values) not in (1, 3):
        raise SceneError(f"{where}: {what}: expected 3 numbers, got '{text.strip()[:60]}'")
    return values * (3 // len(values))


def _map(folder: Path, text: str, where: str, textures: TextureLibrary, builder: SceneBuilder) -> Texture:
    """The image of a map statement; its options are skipped and told."""
    text = text.strip()
    while text.startswith("-"):
        option, _, text = text.partition(" ")
        for _ in range(_MAP_OPTIONS.get(option, 0)):
            value, _, rest = text.strip().partition(" ")
            if option in ("-o", "-s", "-t") and not _is_number(value):
                break  # these take one to three values
            text = rest
        text = text.strip()
        builder.warnings.append(f"{where}: map option {option[:20]} is not used")
    path = folder / text.replace("\\", "/")
    if not text or not path.is_file():
        raise SceneError(f"{where}: texture '{path}' is missing")
    return textures.get(path.resolve(), where, path.read_bytes)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
