"""Small scene files made on the spot: a GLB builder, an OBJ with its MTL, a PLY."""

import io
import json
import struct

import numpy as np
from hypothesis import HealthCheck
from PIL import Image

# Settings of the fuzz tests: the same examples every time, files in a tmp_path that the examples share.
FUZZ = {"deadline": None, "suppress_health_check": [HealthCheck.function_scoped_fixture], "derandomize": True}

QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
QUAD_INDICES = np.array([0, 1, 2, 0, 2, 3], np.uint16)
QUAD_UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
_COMPONENTS = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}


def png(pixels):
    """PNG bytes of 8-bit pixels [H,W,3]."""
    out = io.BytesIO()
    Image.fromarray(np.asarray(pixels, np.uint8)).save(out, format="PNG")
    return out.getvalue()


class Gltf:
    """Collects glTF elements; ``glb()`` and ``gltf()`` give the file."""

    def __init__(self):
        self.json = {
            "asset": {"version": "2.0"},
            "scenes": [{"nodes": []}],
            "nodes": [],
            "meshes": [],
            "materials": [],
            "accessors": [],
            "bufferViews": [],
        }
        self.binary = b""

    def view(self, content, stride=None):
        self.binary += b"\0" * (-len(self.binary) % 4)
        self.json["bufferViews"].append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content)})
        if stride:
            self.json["bufferViews"][-1]["byteStride"] = stride
        self.binary += content
        return len(self.json["bufferViews"]) - 1

    def accessor(self, array, **more):
        array = np.ascontiguousarray(array)
        kind = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        entry = {"componentType": _COMPONENTS[str(array.dtype)], "count": len(array), "type": kind}
        self.json["accessors"].append({"bufferView": self.view(array.tobytes())} | entry | more)
        return len(self.json["accessors"]) - 1

    def material(self, name="grey", color=(0.5, 0.5, 0.5), emission=None, strength=None, **more):
        entry = {"name": name, "doubleSided": True, "pbrMetallicRoughness": {"baseColorFactor": [*color, 1.0]}}
        if emission is not None:
            entry["emissiveFactor"] = list(emission)
        if strength is not None:
            entry["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": strength}}
        self.json["materials"].append(entry | more)
        return len(self.json["materials"]) - 1

    def primitive(self, material, positions=QUAD, indices=QUAD_INDICES, uv=None, **more):
        attributes = {"POSITION": self.accessor(positions)}
        if uv is not None:
            attributes["TEXCOORD_0"] = self.accessor(uv)
        entry = {"attributes": attributes, "material": material}
        if indices is not None:
            entry["indices"] = self.accessor(indices)
        return entry | more

    def mesh(self, *primitives, name=None):
        self.json["meshes"].append({"primitives": list(primitives)} | ({"name": name} if name else {}))
        return len(self.json["meshes"]) - 1

    def node(self, root=True, **entry):
        self.json["nodes"].append(entry)
        index = len(self.json["nodes"]) - 1
        if root:
            self.json["scenes"][0]["nodes"].append(index)
        return index

    def light(self, root=True, **light):
        extension = self.json.setdefault("extensions", {}).setdefault("KHR_lights_punctual", {"lights": []})
        extension["lights"].append(light)
        return {"extensions": {"KHR_lights_punctual": {"light": len(extension["lights"]) - 1}}}

    def glb(self):
        text = json.dumps(self.json | {"buffers": [{"byteLength": len(self.binary)}]}).encode()
        text += b" " * (-len(text) % 4)
        binary = self.binary + b"\0" * (-len(self.binary) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def small_gltf():
    """A grey floor and a panel that emits (8, 6, 4)."""
    gltf = Gltf()
    floor, lamp = gltf.material("floor"), gltf.material("lamp", (0, 0, 0), (1, 0.75, 0.5), 8.0, doubleSided=False)
    gltf.node(name="floor", mesh=gltf.mesh(gltf.primitive(floor), name="floor mesh"))
    gltf.node(name="light", mesh=gltf.mesh(gltf.primitive(lamp)), translation=[0, 0, 2])
    return gltf


OBJ = """# a floor and a lamp
mtllib small.mtl
o room
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
g floor
usemtl tiles
f 1/1 2/2 3/3 4/4
g lamp
usemtl lamp
v 0 0 1
v 1 0 1
v 1 1 1
f -3 -2 -1
"""

MTL = """newmtl tiles
Kd 0.5 0.5 1.0
map_Kd tiles.png
newmtl lamp
Kd 0 0 0
Ke 3 2 1
"""

TILES = [[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [188, 188, 188]]]


def write_obj(folder, obj=OBJ, mtl=MTL, tiles=True):
    """Write the OBJ and what it names into ``folder``; the OBJ's path."""
    (folder / "small.obj").write_text(obj)
    if mtl is not None:
        (folder / "small.mtl").write_text(mtl)
    if tiles:
        (folder / "tiles.png").write_bytes(png(TILES))
    return folder / "small.obj"


PLY = """ply
format ascii 1.0
comment a square and a triangle
element vertex 5
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
1 1 0
0 1 0
2 0 0
4 0 1 2 3
3 1 4 2
"""


def check_usable(scene):
    """What every loaded scene promises, whatever the file was."""
    triangles = np.arange(len(scene.triangle_mesh))
    albedo = scene.albedo_at(triangles, np.full((len(triangles), 2), 1 / 3))
    assert np.isfinite(scene.triangle_normals).all()
    assert (albedo >= 0).all() and (albedo <= 1 + 1e-6).all()
    assert (scene.triangle_areas > 0).all()
    assert scene.lights and scene.cameras and len({m.name for m in scene.meshes}) == len(scene.meshes)
    origins, directions = scene.cameras[0].rays(np.array([[0.5, 0.5]]))
    assert np.isfinite(origins).all() and np.isfinite(directions).all()
    assert len(scene.hash) == 64
    assert all("\n" not in line for line in scene.warnings)
