"""Light sets: the same scene under other lights, given as JSON.

A file maps a scene's name to a list of light sets; a light set is a list of lights that replaces *all* lights of the
scene. Emissive meshes that a set does not name go dark; they still block light. Entries::

    {"type": "area", "mesh": "light", "radiance": [r, g, b], "one_sided": true, "vertices": [a, b, c, d]}
    {"type": "point", "position": [x, y, z], "intensity": [r, g, b]}
    {"type": "spot", "position", "direction", "intensity", "inner_angle": 0.0, "outer_angle": 0.785}
    {"type": "directional", "direction": [x, y, z], "irradiance": [r, g, b]}

``vertices`` (optional) is a parallelogram that takes the place of the mesh's triangles as (a, b, c) and (a, c, d); it
emits to the side of (b-a) x (c-a). Units as everywhere: m, rad, W/sr, W/m2, W/(m2 sr).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from difflpv.scene import AreaLight, DirectionalLight, Light, Mesh, PointLight, Scene, SceneError, SpotLight

__all__ = ["LightEntry", "apply_light_set", "behind_light_weight", "load_light_sets", "select_light_set"]

_PANEL_GAP, _PANEL_SHARE = 0.05, 0.01  # m, and share of the scene, behind a panel in which no volume can resolve the light
_FIELDS: dict[str, tuple[dict[str, int], dict[str, int]]] = {  # type: (required, optional) fields and their lengths
    "area": ({"mesh": 0, "radiance": 3}, {"one_sided": 0, "vertices": 0}),
    "point": ({"position": 3, "intensity": 3}, {"name": 0}),
    "spot": ({"position": 3, "direction": 3, "intensity": 3}, {"inner_angle": 1, "outer_angle": 1, "name": 0}),
    "directional": ({"direction": 3, "irradiance": 3}, {"name": 0}),
}


class LightEntry(dict[str, Any]):
    """One light of a set, as in the file; ``source`` names where it stands, for errors."""

    def __init__(self, entry: Mapping[str, Any], source: str) -> None:
        super().__init__(entry)
        self.source = source


def load_light_sets(path: str | Path | None, scene_name: str) -> list[list[LightEntry]]:
    """Light sets of a scene.

    Args:
        path: JSON file; None for the sets that come with the package (``cornell``, ``two_rooms_90``).
        scene_name: key in the file, the ``Scene.name``.

    Returns:
        The sets, each a non-empty list of checked entries for ``apply_light_set``.

    Raises:
        SceneError: one line naming file, element and reason.
    """
    file = Path(str(resources.files("difflpv"))) / "data" / "light_sets.json" if path is None else Path(path)
    try:
        sets = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise SceneError(f"{file}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{file}: JSON is damaged: {' '.join(str(error).split())}") from None
    if not isinstance(sets, dict):
        raise SceneError(f"{file}: expected an object that maps scene names to light sets")
    if scene_name not in sets:
        raise SceneError(f"{file}: no light sets for scene '{scene_name}', the file has {', '.join(sets) or 'none'}")
    if not isinstance(sets[scene_name], list) or not sets[scene_name]:
        raise SceneError(f"{file}: {scene_name}: expected a non-empty list of light sets")
    checked = []
    for k, entries in enumerate(sets[scene_name]):
        if not isinstance(entries, list) or not entries:
            raise SceneError(f"{file}: {scene_name}[{k}]: expected a non-empty list of lights")
        checked.append([_checked(entry, f"{file}: {scene_name}[{k}][{j}]") for j, entry in enumerate(entries)])
    return checked


def select_light_set(path: str | Path | None, scene_name: str, index: int) -> list[LightEntry]:
    """Light set ``index`` (from 0) of a scene; a ``SceneError`` if there is none."""
    sets = load_light_sets(path, scene_name)
    if not 0 <= index < len(sets):
        source = "bundled light sets" if path is None else str(path)
        raise SceneError(f"{source}: {scene_name}[{index}]: index out of range, there are {len(sets)} light sets")
    return sets[index]


def apply_light_set(scene: Scene, entries: Sequence[Mapping[str, Any]]) -> Scene:
    """The scene lit by a light set instead of its own lights.

    Args:
        scene: the scene; unchanged.
        entries: lights as in the file; plain dictionaries are checked here.

    Raises:
        SceneError: one line naming the light and the reason.
    """
    lights: list[Light] = []
    moved: dict[str, Mesh] = {}
    meshes = {mesh.name: mesh for mesh in scene.meshes}
    named: set[str] = set()
    for k, raw in enumerate(entries):
        entry = raw if isinstance(raw, LightEntry) else _checked(raw, f"light set for '{scene.name}', light {k}")
        try:
            if entry["type"] == "area":
                name = entry["mesh"]
                if name not in meshes:
                    raise SceneError(f"mesh '{name}' is not in the scene, meshes are {', '.join(meshes)}")
                if name in named:
                    raise SceneError(f"mesh '{name}' is named twice in one light set")
                named.add(name)
                lights.append(AreaLight(name, np.array(entry["radiance"], float), not entry.get("one_sided", True)))
                if "vertices" in entry:
                    moved[name] = _panel(meshes[name], np.array(entry["vertices"], float))
            else:
                lights.append(_punctual(entry, k))
        except SceneError as error:
            raise SceneError(f"{entry.source}: {error}") from None
    return scene.with_lights(lights, moved)


def _punctual(entry: LightEntry, k: int) -> Light:
    values = {key: np.array(v, float) for key, v in entry.items() if isinstance(v, list)}
    name = entry.get("name", f"{entry['type']}_{k}")
    if entry["type"] == "point":
        return PointLight(values["position"], values["intensity"], name)
    if entry["type"] == "directional":
        return DirectionalLight(values["direction"], values["irradiance"], name)
    angles = {key: float(entry[key]) for key in ("inner_angle", "outer_angle") if key in entry}
    return SpotLight(values["position"], values["direction"], values["intensity"], name=name, **angles)


def _panel(mesh: Mesh, corners: np.ndarray) -> Mesh:
    size = np.linalg.norm(corners[2] - corners[0]) + np.linalg.norm(corners[3] - corners[1])
    if np.linalg.norm(corners[0] - corners[1] + corners[2] - corners[3]) > 1e-3 * size:
        raise SceneError(f"vertices: expected a parallelogram a, b, c, d, got {corners.tolist()}")
    if np.linalg.norm(np.cross(corners[1] - corners[0], corners[3] - corners[0])) <= 1e-9 * size**2:
        raise SceneError(f"vertices: the parallelogram has no area: {corners.tolist()}")
    return Mesh(mesh.name, corners, np.array([[0, 1, 2], [0, 2, 3]]), mesh.material)


def _checked(entry: Any, where: str) -> LightEntry:
    """A light's fields with their types and lengths checked; units and signs are checked by the light itself."""
    if not isinstance(entry, Mapping):
        raise SceneError(f"{where}: expected an object")
    kind = entry.get("type")
    if not isinstance(kind, str) or kind not in _FIELDS:
        raise SceneError(f"{where}: unknown type {str(kind)[:30]!r}, expected {', '.join(_FIELDS)}")
    required, optional = _FIELDS[kind]
    missing = [key for key in required if key not in entry]
    unknown = [str(key)[:30] for key in entry if key not in required and key not in optional and key != "type"]
    if missing or unknown:
        raise SceneError(f"{where}: {f'{missing[0]!r} is missing' if missing else f'unknown field {unknown[0]!r}'}")
    for key, length in (required | optional).items():
        if key in ("mesh", "name"):
            if key in entry and not isinstance(entry[key], str):
                raise SceneError(f"{where}.{key}: expected text")
        elif key == "one_sided":
            if not isinstance(entry.get(key, True), bool):
                raise SceneError(f"{where}.{key}: expected true or false")
        elif key == "vertices":
            if key in entry:
                corners = entry[key]
                if not isinstance(corners, list) or len(corners) != 4:
                    raise SceneError(f"{where}.{key}: expected 4 points")
                for corner in corners:
                    _check_numbers(corner, 3, f"{where}.{key}")
        elif key in entry:
            _check_numbers([entry[key]] if length == 1 else entry[key], length, f"{where}.{key}")
    return LightEntry(entry, where)


def _check_numbers(value: Any, length: int, where: str) -> None:
    if not isinstance(value, list) or len(value) != length:
        raise SceneError(f"{where}: expected {length} numbers, got {str(value)[:60]}")
    for number in value:
        if isinstance(number, bool) or not isinstance(number, (int, float)) or not abs(number) <= 1e15:
            raise SceneError(f"{where}: expected finite numbers, got {str(value)[:60]}")


def behind_light_weight(scene: Scene, positions: np.ndarray, *, gap: float | None = None) -> np.ndarray:
    """Receivers in the gap behind a light's panel, which get area weight 0.

    No volume can resolve light in the centimetres between a panel and the wall that it hangs on, and those receivers
    would make up nearly all of the error there.

    Args:
        scene: the scene under the lights in question.
        positions: receiver positions [m], shape [n,3].
        gap: how far behind a panel [m]; None for 0.05 m, in scenes of less than 5 m 0.01 of their longest edge.

    Returns:
        True for receivers that lie over a triangle of a one-sided area light, on the side that it does not emit to and
        closer than ``gap`` to its plane, shape [n] bool. Set their weight to 0.
    """
    if gap is None:
        low, high = scene.bounds
        gap = min(_PANEL_GAP, _PANEL_SHARE * float((high - low).max()))
    positions = np.asarray(positions, np.float64)
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError(f"positions: expected shape [n, 3], got {list(positions.shape)}")
    one_sided = scene.mesh_emission.any(1) & ~scene.mesh_two_sided_emission
    lit = np.flatnonzero(one_sided[scene.triangle_mesh])
    behind = np.zeros(len(positions), bool)
    for a, b, c in scene.triangle_vertices[lit]:
        normal = np.cross(b - a, c - a)
        squared = float(normal @ normal)
        offset = positions - a
        depth = -(offset @ normal) / np.sqrt(squared)
        # Barycentric coordinates of the projection onto the panel's plane.
        v = np.cross(offset, c - a) @ normal / squared
        w = np.cross(b - a, offset) @ normal / squared
        tolerance = 1e-6 * gap  # a receiver on the panel itself is not behind it
        behind |= (depth > tolerance) & (depth < gap) & (v >= 0) & (w >= 0) & (v + w <= 1)
    return behind
