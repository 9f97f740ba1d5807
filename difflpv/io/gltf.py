"""glTF 2.0 and GLB scenes.

Read here rather than through a mesh library, because every element has to be named in its error and because mesh
libraries drop ``KHR_lights_punctual``. Light units are read radiometrically: W/sr for point and spot lights, W/m2 for
directional ones, W/(m2 sr) for ``emissiveFactor`` x ``emissiveStrength``. Meshes keep the order of the file's nodes.

Source: Khronos Group, glTF 2.0 specification; KHR_lights_punctual, KHR_materials_emissive_strength,
KHR_texture_transform, KHR_mesh_quantization.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from difflpv.grid import Grid
from difflpv.io.assemble import SceneBuilder
from difflpv.io.gltf_document import GltfDocument, number, numbers
from difflpv.io.texture import TextureLibrary
from difflpv.scene import Camera, DirectionalLight, Material, PointLight, Scene, SceneError, SpotLight, Texture

__all__ = ["load_gltf"]

_READ_EXTENSIONS = {"KHR_lights_punctual", "KHR_texture_transform", "KHR_mesh_quantization"}
_MAX_CELLS = 2**28
_MAX_IMAGE_EDGE = 2**14


def load_gltf(path: Path) -> Scene:
    """Load a ``.glb`` or ``.gltf`` file; errors name the element, the caller adds the file."""
    return _Reader(path).read()


class _Reader:
    def __init__(self, path: Path) -> None:
        self.document = GltfDocument(path)
        self.builder = SceneBuilder(path.stem)
        self._textures = TextureLibrary()
        self._materials: dict[int | None, tuple[Material, dict[str, Any]]] = {}

    def read(self) -> Scene:
        doc = self.document
        for name in doc.array(doc.json, "extensionsRequired", "extensionsRequired"):
            # Material extensions change the look, not the geometry: base colour and emission stay readable.
            if name not in _READ_EXTENSIONS and not str(name).startswith("KHR_materials_"):
                raise SceneError(f"required extension {str(name)[:60]} is not supported")
        scene, worlds = self._world_matrices()
        extras = scene.get("extras") if isinstance(scene.get("extras"), dict) else {}
        assert isinstance(extras, dict)
        self.builder.grid = _grid(extras["lpv_grid"]) if "lpv_grid" in extras else None
        for index in sorted(worlds):
            node = doc.element("nodes", index, "scene")
            where = f"node {index} '{node.get('name', '')}'"
            if "mesh" in node:
                self._add_mesh(node, worlds[index], where)
            if "camera" in node:
                self._add_camera(node, worlds[index], where, extras)
            light = doc.extension(node, "KHR_lights_punctual", where)
            if light is not None:
                self._add_light(light.get("light"), worlds[index], where)
        return self.builder.build()

    def _world_matrices(self) -> tuple[dict[str, Any], dict[int, np.ndarray]]:
        """The default scene, and the world matrix [4,4] of each of its nodes."""
        doc = self.document
        nodes = doc.array(doc.json, "nodes", "nodes")
        if "scenes" in doc.json:
            scene = doc.element("scenes", doc.json.get("scene", 0), "scene")
            roots = doc.array(scene, "nodes", "scene nodes")
        else:
            parents = [n for n in nodes if isinstance(n, dict)]
            children = {c for n in parents for c in doc.array(n, "children", "node") if type(c) is int}
            scene, roots = {}, [i for i in range(len(nodes)) if i not in children]
        worlds: dict[int, np.ndarray] = {}
        pending = [(root, np.eye(4), "scene") for root in roots]
        while pending:
            index, parent, where = pending.pop()
            node = doc.element("nodes", index, where)
            if index in worlds:
                raise SceneError(f"node {index}: reached twice, the node hierarchy is no tree")
            where = f"node {index}"
            with np.errstate(all="ignore"):  # an overflow becomes a vertex that is not finite, which is reported
                worlds[index] = parent @ _local_matrix(node, where)
            pending += [(child, worlds[index], where) for child in doc.array(node, "children", f"{where} children")]
        return scene, worlds

    def _add_mesh(self, node: dict[str, Any], world: np.ndarray, where: str) -> None:
        doc = self.document
        mesh = doc.element("meshes", node["mesh"], where)
        names = [n for n in (node.get("name"), mesh.get("name")) if isinstance(n, str) and n.strip()]
        name = names[0] if names else f"mesh_{node['mesh']}"
        if "skin" in node:
            self.builder.warnings.append(f"{where}: skin is not applied, the mesh keeps its rest pose")
        primitives = doc.array(mesh, "primitives", f"mesh {node['mesh']} primitives")
        for k, primitive in enumerate(primitives):
            at = f"mesh '{name}' primitive {k}"
            if not isinstance(primitive, dict):
                raise SceneError(f"{at}: expected an object")
            if doc.extension(primitive, "KHR_draco_mesh_compression", at) is not None:
                raise SceneError(f"{at}: Draco compression is not supported, export without compression")
            self._add_primitive(primitive, world, name if len(primitives) == 1 else f"{name}_{k}", at)

    def _add_primitive(self, primitive: dict[str, Any], world: np.ndarray, name: str, at: str) -> None:
        doc = self.document
        mode = primitive.get("mode", 4)
        if mode not in (4, 5, 6):
            self.builder.warnings.append(f"{at}: points and lines are not surfaces and were dropped")
            return
        attributes = doc.child(primitive, "attributes", f"{at} attributes")
        if "POSITION" not in attributes:
            raise SceneError(f"{at}: no POSITION")
        local = doc.accessor(attributes["POSITION"], f"{at} POSITION", ["VEC3"]).astype(np.float64)
        if "indices" in primitive:
            indices = doc.accessor(primitive["indices"], f"{at} indices", ["SCALAR"])
            if indices.dtype.kind != "u":
                raise SceneError(f"{at} indices: expected unsigned integers")
        else:
            indices = np.arange(len(local))
        triangles = _triangles(indices.astype(np.int64), int(mode), at)
        self.builder.reserve(triangles.size + len(local))
        with np.errstate(all="ignore"):
            vertices = local @ world[:3, :3].T + world[:3, 3]
            mirrored = np.linalg.det(world[:3, :3]) < 0
        if mirrored:  # glTF 2.0, 3.7.4: a mirroring transform reverses the winding, so the front stays the front
            triangles = triangles[:, ::-1]
        material, base_texture = self._material(primitive.get("material"), at)
        uv = self._uv(attributes, base_texture, at)
        if "COLOR_0" in attributes:
            self.builder.warnings.append(f"{at}: vertex colours are not used")
        if "targets" in primitive:
            self.builder.warnings.append(f"{at}: morph targets are not applied")
        self.builder.add_mesh(name, vertices, triangles, material, uv=uv, two_sided=material.double_sided)

    def _uv(self, attributes: dict[str, Any], base_texture: dict[str, Any], at: str) -> np.ndarray | None:
        doc = self.document
        transform = doc.extension(base_texture, "KHR_texture_transform", "baseColorTexture") or {}
        key = f"TEXCOORD_{transform.get('texCoord', base_texture.get('texCoord', 0))}"
        if not base_texture or key not in attributes:
            return None
        uv = doc.accessor(attributes[key], f"{at} {key}", ["VEC2"]).astype(np.float64)
        if not transform:
            return uv
        where = f"{at} KHR_texture_transform"
        angle = number(transform.get("rotation", 0.0), where)
        rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        scale = numbers(transform.get("scale", [1, 1]), 2, where)
        offset = numbers(transform.get("offset", [0, 0]), 2, where)
        with np.errstate(all="ignore"):
            return (uv * scale) @ rotation.T + offset

    def _material(self, index: Any, at: str) -> tuple[Material, dict[str, Any]]:
        """The material, and its ``baseColorTexture`` object (empty if it has none)."""
        if index is None:
            return self.builder.default_material(at), {}
        doc = self.document
        entry = doc.element("materials", index, at)
        if index not in self._materials:
            name = str(entry.get("name", index))
            where = f"material '{name}'"
            pbr = doc.child(entry, "pbrMetallicRoughness", f"{where} pbrMetallicRoughness")
            factor = numbers(pbr.get("baseColorFactor", [1, 1, 1, 1]), 4, f"{where} baseColorFactor")[:3]
            info = doc.child(pbr, "baseColorTexture", f"{where} baseColorTexture")
            texture = self._texture(info.get("index"), where) if "baseColorTexture" in pbr else None
            emission = numbers(entry.get("emissiveFactor", [0, 0, 0]), 3, f"{where} emissiveFactor")
            strength = doc.extension(entry, "KHR_materials_emissive_strength", where) or {}
            emission = emission * number(strength.get("emissiveStrength", 1.0), f"{where} emissiveStrength")
            if emission.any() and "emissiveTexture" in entry:
                emissive = doc.child(entry, "emissiveTexture", f"{where} emissiveTexture")
                emission = emission * self._texture(emissive.get("index"), where).image.mean((0, 1), dtype=np.float64)
                self.builder.warnings.append(f"{where}: emissive texture replaced by its mean colour")
            if entry.get("alphaMode", "OPAQUE") != "OPAQUE":
                self.builder.warnings.append(f"{where}: transparency is not modelled, the surface is opaque")
            double_sided = entry.get("doubleSided", False) is True
            self._materials[index] = Material(name, factor, texture, emission, double_sided), info
        return self._materials[index]

    def _texture(self, index: Any, where: str) -> Texture:
        doc = self.document
        source = doc.element("textures", index, where).get("source")
        if source is None:
            raise SceneError(f"{where}, texture {index}: no PNG or JPEG source")
        image = doc.element("images", source, f"{where}, texture {index}")
        at = f"{where}, image {source}"

        def read() -> bytes:
            if "bufferView" in image:
                return bytes(doc.view(image["bufferView"], at)[0])
            return doc.uri_bytes(image.get("uri"), at)

        return self._textures.get(source, at, read)

    def _add_light(self, index: Any, world: np.ndarray, where: str) -> None:
        doc = self.document
        lights = doc.extension(doc.json, "KHR_lights_punctual", "file") or {}
        light = doc.element("lights", index, f"{where} KHR_lights_punctual", lights)
        name, kind = str(light.get("name", f"light_{index}")), light.get("type")
        where = f"{where}, light '{name}'"
        color = numbers(light.get("color", [1, 1, 1]), 3, f"{where} color")
        power = color * number(light.get("intensity", 1.0), f"{where} intensity")
        position = world[:3, 3]
        if kind == "point":
            self.builder.lights.append(PointLight(position, power, name))
            return
        direction = _unit_columns(world, where)[:, 2] * -1.0  # lights shine along the node's -z
        if kind == "directional":
            self.builder.lights.append(DirectionalLight(direction, power, name))
        elif kind == "spot":
            spot = doc.child(light, "spot", f"{where} spot")
            inner = number(spot.get("innerConeAngle", 0.0), f"{where} innerConeAngle")
            outer = number(spot.get("outerConeAngle", np.pi / 4), f"{where} outerConeAngle")
            self.builder.lights.append(SpotLight(position, direction, power, inner, outer, name))
        else:
            raise SceneError(f"{where}: unknown type '{str(kind)[:20]}', expected point, spot or directional")

    def _add_camera(self, node: dict[str, Any], world: np.ndarray, where: str, extras: dict[str, Any]) -> None:
        doc = self.document
        camera = doc.element("cameras", node["camera"], where)
        at = f"camera {node['camera']}"
        if camera.get("type") != "perspective":
            self.builder.warnings.append(f"{at}: only perspective cameras are read, it was dropped")
            return
        lens = doc.child(camera, "perspective", f"{at} perspective")
        yfov = number(lens.get("yfov"), f"{at} yfov")
        if not 0 < yfov < np.pi:
            raise SceneError(f"{at}: yfov must lie in (0, pi), got {yfov}")
        aspect = number(lens.get("aspectRatio", 4 / 3), f"{at} aspectRatio")
        if not 1 / 64 <= aspect <= 64:
            raise SceneError(f"{at}: aspectRatio must lie in 1/64..64, got {aspect}")
        size: list[Any] = [256, max(1, round(256 / aspect))]
        if "image" in extras:
            image = doc.child(extras, "image", "scene extras 'image'")
            size = [image.get("width"), image.get("height")]
        if any(type(n) is not int or not 1 <= n <= _MAX_IMAGE_EDGE for n in size):
            raise SceneError(f"scene extras 'image': expected edges in 1..{_MAX_IMAGE_EDGE}, got {str(size)[:60]}")
        to_world = np.eye(4)
        to_world[:3, :3], to_world[:3, 3] = _unit_columns(world, f"{where} {at}"), world[:3, 3]
        self.builder.cameras.append(Camera(to_world, yfov, *size))


def _local_matrix(node: dict[str, Any], where: str) -> np.ndarray:
    if "matrix" in node:
        return numbers(node["matrix"], 16, f"{where} matrix").reshape(4, 4).T  # column-major
    translation = numbers(node.get("translation", [0, 0, 0]), 3, f"{where} translation")
    x, y, z, w = numbers(node.get("rotation", [0, 0, 0, 1]), 4, f"{where} rotation")
    scale = numbers(node.get("scale", [1, 1, 1]), 3, f"{where} scale")
    length = float(np.sqrt(x * x + y * y + z * z + w * w))
    if not length > 0:
        raise SceneError(f"{where} rotation: the quaternion has no length")
    x, y, z, w = x / length, y / length, z / length, w / length
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= scale
    matrix[:3, 3] = translation
    return matrix


def _unit_columns(world: np.ndarray, where: str) -> np.ndarray:
    """The node's axes in world space without its scale, shape [3,3]."""
    with np.errstate(all="ignore"):
        length = np.linalg.norm(world[:3, :3], axis=0)
        axes = world[:3, :3] / length
    if not np.isfinite(axes).all() or not np.isfinite(world[:3, 3]).all():
        raise SceneError(f"{where}: the node's transform cannot be used (zero scale or overflow)")
    return axes


def _triangles(indices: np.ndarray, mode: int, at: str) -> np.ndarray:
    """Triangle list [T,3] of a triangle list (4), strip (5) or fan (6)."""
    if mode == 4:
        if len(indices) % 3:
            raise SceneError(f"{at}: {len(indices)} indices are no multiple of 3")
        return indices.reshape(-1, 3)
    if len(indices) < 3:
        raise SceneError(f"{at}: a strip or fan needs at least 3 indices, got {len(indices)}")
    if mode == 6:
        return np.stack([np.full(len(indices) - 2, indices[0]), indices[1:-1], indices[2:]], 1)
    strip = np.stack([indices[:-2], indices[1:-1], indices[2:]], 1)
    strip[1::2] = strip[1::2, [1, 0, 2]]  # every second triangle of a strip runs the other way round
    return strip


def _grid(entry: Any) -> Grid:
    where = "scene extras 'lpv_grid'"
    if not isinstance(entry, dict):
        raise SceneError(f"{where}: expected an object with min, max and resolution")
    low, high = numbers(entry.get("min"), 3, f"{where} min"), numbers(entry.get("max"), 3, f"{where} max")
    cells = numbers(entry.get("resolution"), 3, f"{where} resolution")
    if (cells != np.round(cells)).any() or (cells < 1).any() or cells.prod() > _MAX_CELLS:
        raise SceneError(f"{where} resolution: expected integers > 0, at most {_MAX_CELLS} cells, got {cells.tolist()}")
    try:
        return Grid.from_bounds(low, high, cells.astype(int))
    except ValueError as error:
        raise SceneError(f"{where}: {error}") from None
