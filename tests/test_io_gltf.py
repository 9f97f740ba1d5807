import base64
import copy
import json
import math
import zlib

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scene_files import FUZZ, QUAD, QUAD_INDICES, QUAD_UV, TILES, Gltf, check_usable, png, small_gltf

from difflpv.io import bundled_scenes, load_scene
from difflpv.io.srgb import srgb_to_linear
from difflpv.scene import AreaLight, DirectionalLight, PointLight, SceneError, SpotLight


def load(folder, gltf, name="small.glb"):
    path = folder / name
    path.write_bytes(gltf if isinstance(gltf, bytes) else gltf.glb())
    return load_scene(path)


def message(folder, gltf, name="small.glb"):
    with pytest.raises(SceneError) as info:
        load(folder, gltf, name)
    text = str(info.value)
    assert "\n" not in text and name in text
    return text


# Bundled scenes -------------------------------------------------------------------------------------------------------

PINNED = {  # name: meshes, triangles, lights, cell size
    "atrium": (15, 25850, DirectionalLight, 1.25),
    "bunny": (2, 12202, AreaLight, 0.625),
    "cornell": (8, 36, AreaLight, 0.375),
    "diagonal": (2, 4, AreaLight, 0.3125),
    "floor": (17, 27550, DirectionalLight, 0.3125),
    "planter": (17, 27550, DirectionalLight, 0.3125),
    "two_rooms_90": (13, 1354, AreaLight, 0.28125),
}


def test_bundled_names():
    assert bundled_scenes() == sorted(PINNED)


@pytest.mark.parametrize("name", sorted(PINNED))
def test_bundled_scene(name):
    scene = load_scene(name)
    meshes, triangles, light, cell = PINNED[name]
    assert (scene.name, len(scene.meshes), len(scene.triangle_areas)) == (name, meshes, triangles)
    assert [type(found) for found in scene.lights] == [light]
    assert scene.grid is not None and scene.grid.resolution == (32, 32, 32)
    assert scene.grid.cell_size == pytest.approx(cell)
    assert (scene.cameras[0].width, scene.cameras[0].height) == (256, 192)
    assert scene.warnings == ()
    check_usable(scene)


def test_cornell_in_detail():
    scene = load_scene("cornell")
    names = ["floor", "ceiling", "back", "left_red", "right_green", "short_block", "tall_block", "light"]
    assert [mesh.name for mesh in scene.meshes] == names
    light = scene.lights[0]
    assert light.mesh == "light" and not light.two_sided
    np.testing.assert_allclose(light.radiance, [17, 12, 4], rtol=1e-6)
    np.testing.assert_allclose(scene.meshes[3].material.albedo, [0.63, 0.065, 0.05])
    np.testing.assert_allclose(scene.grid.minimum, [-6, -3.25, -6])
    np.testing.assert_allclose(scene.cameras[0].to_world[:3, 3], [0, 2.75, 10.6])
    np.testing.assert_allclose(scene.triangle_normals[scene.triangle_mesh == 7], [[0, -1, 0]] * 2, atol=1e-6)
    assert np.sum(scene.triangle_areas[scene.triangle_mesh == 7]) == pytest.approx(1.3 * 1.05, rel=1e-5)


def test_atrium_sun():
    sun = load_scene("atrium").lights[0]
    np.testing.assert_allclose(sun.irradiance, [30, 27, 22])
    np.testing.assert_allclose(sun.direction, [0.24996, -0.89271, -0.37494], atol=1e-5)


@pytest.mark.parametrize("name", ["atrium", "cornell", "two_rooms_90"])
def test_geometry_agrees_with_trimesh(name):
    from difflpv import io

    path = f"{io.__path__[0]}/../data/scenes/{name}.glb"
    dump = trimesh.load(path, force="scene", process=False).to_geometry()
    scene = load_scene(name)

    def ordered(corners):
        return corners.reshape(-1, 9)[np.lexsort(np.round(corners.reshape(-1, 9), 4).T)]

    np.testing.assert_allclose(ordered(scene.triangle_vertices), ordered(np.asarray(dump.triangles)), atol=1e-5)


# Transforms and geometry ----------------------------------------------------------------------------------------------


def test_no_material_is_told(tmp_path):
    gltf = small_gltf()
    del gltf.json["meshes"][0]["primitives"][0]["material"]
    scene = load(tmp_path, gltf)
    np.testing.assert_allclose(scene.meshes[0].material.albedo, [0.8, 0.8, 0.8])
    assert "mesh 'floor' primitive 0: no material, the albedo is 0.8" in scene.warnings


def test_hierarchy_of_trs_and_matrix(tmp_path):
    gltf = small_gltf()
    half = math.sqrt(0.5)
    child = gltf.node(root=False, name="child", mesh=0, translation=[1, 0, 0], scale=[2, 2, 2])
    inner = gltf.node(root=False, rotation=[0, 0, half, half], children=[child])  # 90 degrees about z: x -> y
    matrix = np.eye(4)
    matrix[:3, 3] = [10, 20, 30]
    gltf.node(matrix=matrix.T.ravel().tolist(), children=[inner])
    scene = load(tmp_path, gltf)
    assert [mesh.name for mesh in scene.meshes] == ["floor", "light", "child"]  # the order of the file's nodes
    expected = np.array([[10, 21, 30], [10, 23, 30], [8, 23, 30], [8, 21, 30]])
    np.testing.assert_allclose(scene.meshes[2].vertices, expected, atol=1e-6)
    np.testing.assert_allclose(scene.triangle_normals, [[0, 0, 1]] * 6, atol=1e-6)


def test_rotation_agrees_with_trimesh(tmp_path):
    quaternion = np.array([0.1, -0.5, 0.3, 0.8])  # x, y, z, w; not of unit length
    gltf = small_gltf()
    gltf.node(name="turned", mesh=0, rotation=quaternion.tolist())
    rotation = trimesh.transformations.quaternion_matrix(quaternion[[3, 0, 1, 2]])[:3, :3]
    np.testing.assert_allclose(load(tmp_path, gltf).meshes[2].vertices, QUAD @ rotation.T, atol=1e-6)


def test_mirroring_keeps_the_front(tmp_path):
    gltf = small_gltf()
    gltf.json["nodes"][1]["scale"] = [-1, 1, 1]
    scene = load(tmp_path, gltf)
    np.testing.assert_allclose(scene.triangle_normals[2:], [[0, 0, 1]] * 2, atol=1e-6)


def test_primitives_and_names(tmp_path):
    gltf = small_gltf()
    gltf.node(name="block", mesh=gltf.mesh(gltf.primitive(0), gltf.primitive(1)))
    gltf.node(mesh=0)  # takes the mesh's name
    gltf.node(name="floor", mesh=0)  # taken
    gltf.node(mesh=1)  # nameless
    scene = load(tmp_path, gltf)
    names = [mesh.name for mesh in scene.meshes]
    assert names == ["floor", "light", "block_0", "block_1", "floor mesh", "floor_1", "mesh_1"]
    assert [light.mesh for light in scene.lights] == ["light", "block_1", "mesh_1"]


@pytest.mark.parametrize(("mode", "indices"), [(4, None), (5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])])
def test_modes(tmp_path, mode, indices):
    gltf = small_gltf()
    points = QUAD[QUAD_INDICES] if indices is None else QUAD
    where = None if indices is None else np.array(indices, np.uint8)
    gltf.json["meshes"][0]["primitives"] = [gltf.primitive(0, points, where, mode=mode)]
    scene = load(tmp_path, gltf)
    floor = scene.triangle_mesh == 0
    assert scene.triangle_areas[floor].sum() == pytest.approx(1.0)
    np.testing.assert_allclose(scene.triangle_normals[floor], [[0, 0, 1]] * 2)


def test_points_are_dropped_and_told(tmp_path):
    gltf = small_gltf()
    gltf.json["meshes"][0]["primitives"].append(gltf.primitive(0, mode=0))
    assert any("points" in line for line in load(tmp_path, gltf).warnings)


def test_interleaved_and_normalised_accessors(tmp_path):
    gltf = small_gltf()
    vertex = np.zeros(4, [("position", "<f4", 3), ("uv", "<u2", 2)])
    vertex["position"], vertex["uv"] = QUAD, (QUAD_UV * 65535).astype(np.uint16)
    view = gltf.view(vertex.tobytes(), stride=16)
    accessors = gltf.json["accessors"]
    shared = {"bufferView": view, "count": 4}
    accessors.append(shared | {"componentType": 5126, "type": "VEC3"})
    accessors.append(shared | {"componentType": 5123, "type": "VEC2", "byteOffset": 12, "normalized": True})
    attributes = {"POSITION": len(accessors) - 2, "TEXCOORD_0": len(accessors) - 1}
    gltf.json["meshes"][0]["primitives"][0]["attributes"] = attributes
    textured(gltf, png(TILES))
    mesh = load(tmp_path, gltf).meshes[0]
    np.testing.assert_array_equal(mesh.vertices, QUAD)
    np.testing.assert_array_equal(mesh.uv, QUAD_UV)


def test_quantised_positions(tmp_path):
    gltf = small_gltf()
    quantised = np.array([[0, 0, 0, 0], [127, 0, 0, 0], [127, 127, 0, 0], [-128, 127, 0, 0]], np.int8)
    view = gltf.view(quantised.tobytes(), stride=4)
    entry = {"bufferView": view, "count": 4, "componentType": 5120, "type": "VEC3", "normalized": True}
    gltf.json["accessors"].append(entry)
    gltf.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = len(gltf.json["accessors"]) - 1
    expected = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [-1, 1, 0]]
    np.testing.assert_allclose(load(tmp_path, gltf).meshes[0].vertices, expected)


def test_zero_area_triangles_are_dropped_and_told(tmp_path):
    gltf = small_gltf()
    primitive = gltf.primitive(0, indices=np.array([0, 1, 2, 0, 0, 1, 0, 2, 3, 3, 3, 3], np.uint32))
    gltf.json["meshes"][0]["primitives"] = [primitive]
    scene = load(tmp_path, gltf)
    assert len(scene.meshes[0].triangles) == 2
    assert any(line.startswith("mesh 'floor': 2 of 4 triangles have no area") for line in scene.warnings)


# Materials, lights, cameras -------------------------------------------------------------------------------------------


def textured(gltf, content=None, uri=None, mime="image/png", **more):
    """Put a texture on the floor."""
    image = {"uri": uri} if uri else {"bufferView": gltf.view(content), "mimeType": mime}
    gltf.json |= {"images": [image], "textures": [{"source": 0}]}
    gltf.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0} | more
    primitive = gltf.json["meshes"][0]["primitives"][0]
    if "TEXCOORD_0" not in primitive["attributes"]:
        primitive["attributes"]["TEXCOORD_0"] = gltf.accessor(QUAD_UV)


@pytest.mark.parametrize("storage", ["view", "data", "file"])
def test_texture_storage(tmp_path, storage):
    gltf, content = small_gltf(), png(TILES)
    if storage == "view":
        textured(gltf, content)
    elif storage == "data":
        textured(gltf, uri="data:image/png;base64," + base64.b64encode(content).decode())
    else:
        (tmp_path / "my tiles.png").write_bytes(content)
        textured(gltf, uri="my%20tiles.png")
    scene = load(tmp_path, gltf)
    expected = srgb_to_linear(np.array(TILES) / 255)
    np.testing.assert_allclose(scene.meshes[0].material.texture.image, expected, rtol=1e-6)
    assert scene.meshes[0].material.texture.image.dtype == np.float32
    # The corner (0, 0, 0) has uv (0, 1): the lower left of the image, where it repeats from texel to texel.
    lower_left = scene.meshes[0].material.texture.lookup(np.array([[0.25, 0.75]]))
    np.testing.assert_allclose(lower_left, [[0, 0, 1]], atol=1e-6)


def test_texture_times_factor(tmp_path):
    gltf = small_gltf()
    gltf.json["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [0.5, 0.25, 1.0, 1.0]
    textured(gltf, png(np.full((2, 2, 3), 188)))
    albedo = load(tmp_path, gltf).albedo_at(np.array([0]), np.array([[0.3, 0.3]]))
    level = ((188 / 255 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(albedo, [[0.5 * level, 0.25 * level, level]], rtol=1e-6)


def test_jpeg_and_grey_images(tmp_path):
    import io

    from PIL import Image

    out = io.BytesIO()
    Image.new("L", (8, 8), 128).save(out, format="JPEG")
    gltf = small_gltf()
    textured(gltf, out.getvalue(), mime="image/jpeg")
    image = load(tmp_path, gltf).meshes[0].material.texture.image
    np.testing.assert_allclose(image, srgb_to_linear(np.array(128 / 255)), atol=0.01)


def test_texture_transform(tmp_path):
    gltf = small_gltf()
    transform = {"offset": [0.5, 0.25], "scale": [2, 4], "rotation": math.pi / 2}
    textured(gltf, png(TILES), extensions={"KHR_texture_transform": transform})
    # KHR_texture_transform: translation x rotation x scale, rotation [[cos, sin], [-sin, cos]] as its sample code.
    expected = [[0.5 + 4 * v, 0.25 - 2 * u] for u, v in QUAD_UV]
    np.testing.assert_allclose(load(tmp_path, gltf).meshes[0].uv, expected, atol=1e-12)


def test_texture_without_coordinates_is_told(tmp_path):
    gltf = small_gltf()
    textured(gltf, png(TILES))
    del gltf.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"]
    scene = load(tmp_path, gltf)
    assert any("no texture coordinates" in line for line in scene.warnings)
    np.testing.assert_allclose(scene.albedo_at(np.array([0]), np.zeros((1, 2))), [[0.5, 0.5, 0.5]])


def test_emission(tmp_path):
    gltf = small_gltf()
    scene = load(tmp_path, gltf)
    assert len(scene.lights) == 1 and scene.lights[0].mesh == "light" and scene.lights[0].two_sided is False
    np.testing.assert_allclose(scene.lights[0].radiance, [8, 6, 4])
    gltf.json["materials"][1]["doubleSided"] = True
    del gltf.json["materials"][1]["extensions"]
    light = load(tmp_path, gltf).lights[0]
    assert light.two_sided is True
    np.testing.assert_allclose(light.radiance, [1, 0.75, 0.5])


def test_punctual_lights(tmp_path):
    gltf = small_gltf()
    half = math.sqrt(0.5)
    down = [-half, 0, 0, half]  # -90 degrees about x: -z -> -y
    gltf.node(translation=[1, 2, 3], **gltf.light(type="point", color=[1, 0.5, 0], intensity=4, name="bulb"))
    gltf.node(rotation=down, scale=[3, 3, 3], **gltf.light(type="directional", intensity=5))
    spot = {"innerConeAngle": 0.2, "outerConeAngle": 0.6}
    gltf.node(rotation=down, translation=[0, 9, 0], **gltf.light(type="spot", spot=spot, intensity=6))
    gltf.node(**gltf.light(type="spot"))
    _, point, sun, lamp, plain = load(tmp_path, gltf).lights
    assert isinstance(point, PointLight) and point.name == "bulb"
    np.testing.assert_allclose([point.position, point.intensity], [[1, 2, 3], [4, 2, 0]])
    assert isinstance(sun, DirectionalLight)
    np.testing.assert_allclose([sun.direction, sun.irradiance], [[0, -1, 0], [5, 5, 5]], atol=1e-12)
    assert isinstance(lamp, SpotLight) and (lamp.inner_angle, lamp.outer_angle) == (0.2, 0.6)
    np.testing.assert_allclose([lamp.position, lamp.direction], [[0, 9, 0], [0, -1, 0]], atol=1e-12)
    assert (plain.inner_angle, plain.outer_angle) == (0.0, pytest.approx(math.pi / 4))
    np.testing.assert_allclose([plain.direction, plain.intensity], [[0, 0, -1], [1, 1, 1]])


def test_camera(tmp_path):
    gltf = small_gltf()
    gltf.json["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.8, "aspectRatio": 2.0}}]
    gltf.node(camera=0, translation=[0, 0, 5], scale=[2, 3, 4])
    camera = load(tmp_path, gltf).cameras[0]
    assert (camera.yfov, camera.width, camera.height) == (0.8, 256, 128)
    origin, direction = camera.rays(np.array([[128.0, 64.0], [128.0, 0.0]]))
    np.testing.assert_allclose(origin, [[0, 0, 5]] * 2)
    np.testing.assert_allclose(direction, [[0, 0, -1], [0, math.sin(0.4), -math.cos(0.4)]], atol=1e-12)
    gltf.json["scenes"][0]["extras"] = {"image": {"width": 64, "height": 48}}
    camera = load(tmp_path, gltf).cameras[0]
    assert (camera.width, camera.height) == (64, 48)


def test_grid(tmp_path):
    gltf = small_gltf()
    gltf.json["scenes"][0]["extras"] = {"lpv_grid": {"min": [0, 0, 0], "max": [4, 2, 1], "resolution": [8, 4, 2]}}
    grid = load(tmp_path, gltf).grid
    assert (grid.resolution, grid.cell_size) == ((8, 4, 2), 0.5)


def test_gltf_with_external_buffer(tmp_path):
    gltf = small_gltf()
    gltf.json["buffers"] = [{"byteLength": len(gltf.binary), "uri": "small.bin"}]
    (tmp_path / "small.bin").write_bytes(gltf.binary)
    (tmp_path / "small.gltf").write_text(json.dumps(gltf.json))
    assert load_scene(tmp_path / "small.gltf").hash == load(tmp_path, small_gltf()).hash
    (tmp_path / "small.bin").write_bytes(gltf.binary[:10])
    with pytest.raises(SceneError, match="buffer 0: truncated: .* 10 found"):
        load_scene(tmp_path / "small.gltf")
    (tmp_path / "small.bin").unlink()
    with pytest.raises(SceneError, match="buffer 0: file '.*small.bin' is missing"):
        load_scene(tmp_path / "small.gltf")


# Errors ---------------------------------------------------------------------------------------------------------------


def _set(path, value):
    def change(gltf):
        target = gltf.json
        for key in path[:-1]:
            target = target[key]
        target[path[-1]] = value

    return change


def _nan(gltf):
    positions = QUAD.copy()
    positions[2, 1] = np.nan
    gltf.json["meshes"][0]["primitives"] = [gltf.primitive(0, positions)]


def _missing_image(gltf):
    textured(gltf, uri="nowhere.png")


def _bad_image(gltf):
    textured(gltf, b"no image")


def _huge_image(gltf):
    # A PNG header that claims 9000 x 9000 pixels.
    content = bytearray(png(TILES))
    content[16:24] = (9000).to_bytes(4, "big") * 2
    content[29:33] = zlib.crc32(content[12:29]).to_bytes(4, "big")
    textured(gltf, bytes(content))


PRIMITIVE = ("meshes", 0, "primitives", 0)
FACTOR = ("materials", 0, "pbrMetallicRoughness", "baseColorFactor")
ERRORS = {
    "albedo": (_set(FACTOR, [0.5, 1.5, 0.5, 1]), "material 'floor': albedo must lie in [0, 1], got [0.5, 1.5, 0.5]"),
    "albedo text": (_set(FACTOR, "red"), "material 'floor' baseColorFactor: expected 4 numbers, got red"),
    "nan": (_nan, "mesh 'floor': vertex 2 is not finite"),
    "index": (_set((*PRIMITIVE, "indices"), 77), "mesh 'floor' primitive 0 indices: index 77 into accessors"),
    "no light": (_set(("materials", 1, "emissiveFactor"), [0, 0, 0]), "no light"),
    "no mesh": (_set(("scenes", 0, "nodes"), []), "no mesh"),
    "material": (_set((*PRIMITIVE, "material"), 9), "index 9 into materials is out of range, there are 2"),
    "mesh": (_set(("nodes", 0, "mesh"), 5), "node 0 'floor': index 5 into meshes is out of range"),
    "child": (_set(("nodes", 0, "children"), [9]), "node 0: index 9 into nodes"),
    "cycle": (_set(("nodes", 0, "children"), [0]), "node 0: reached twice"),
    "no position": (_set((*PRIMITIVE, "attributes"), {}), "mesh 'floor' primitive 0: no POSITION"),
    "sparse": (_set(("accessors", 0, "sparse"), {}), "accessor 0: sparse accessors are not supported"),
    "draco": (
        _set((*PRIMITIVE, "extensions"), {"KHR_draco_mesh_compression": {}}),
        "mesh 'floor' primitive 0: Draco compression is not supported",
    ),
    "required": (_set(("extensionsRequired",), ["EXT_texture_webp"]), "EXT_texture_webp is not supported"),
    "count": (_set(("accessors", 0, "count"), 10**9), "1000000000 elements run past the end"),
    "component": (_set(("accessors", 0, "componentType"), 5124), "unknown componentType 5124"),
    "type": (_set(("accessors", 0, "type"), "MAT4"), "expected type VEC3, got MAT4"),
    "view": (_set(("bufferViews", 0, "byteLength"), 10**6), "bufferView 0: bytes 0..1000000 run past its buffer"),
    "quaternion": (_set(("nodes", 0, "rotation"), [0, 0, 0, 0]), "node 0 rotation: the quaternion has no length"),
    "matrix": (_set(("nodes", 0, "matrix"), [1]), "node 0 matrix: expected 16 numbers"),
    "version": (_set(("asset", "version"), "1.0"), "asset version: expected glTF 2.x, got 1.0"),
    "grid": (
        _set(("scenes", 0, "extras"), {"lpv_grid": {"min": [0] * 3, "max": [1, 2, 1], "resolution": [4] * 3}}),
        "scene extras 'lpv_grid': grid bounds: expected cubic cells",
    ),
    "grid size": (
        _set(("scenes", 0, "extras"), {"lpv_grid": {"min": [0] * 3, "max": [1] * 3, "resolution": [9999] * 3}}),
        "scene extras 'lpv_grid' resolution",
    ),
    "emission": (_set(("materials", 1, "emissiveFactor"), [1, -1, 1]), "material 'lamp': emission must be finite"),
    "missing image": (_missing_image, "nowhere.png' is missing"),
    "bad image": (_bad_image, "material 'floor', image 0: image cannot be decoded: neither PNG nor JPEG"),
    "huge image": (_huge_image, "textures of more than"),
}


@pytest.mark.parametrize("case", sorted(ERRORS))
def test_errors_name_file_element_and_reason(tmp_path, case):
    change, expected = ERRORS[case]
    gltf = small_gltf()
    change(gltf)
    assert expected in message(tmp_path, gltf)


def test_vertex_index_out_of_range(tmp_path):
    gltf = small_gltf()
    gltf.json["meshes"][0]["primitives"] = [gltf.primitive(0, indices=np.array([0, 1, 999], np.uint16))]
    assert "mesh 'floor': index 999 is out of range for 4 vertices" in message(tmp_path, gltf)


def test_light_errors(tmp_path):
    gltf = small_gltf()
    gltf.node(name="lamp", **gltf.light(type="laser"))
    assert "light 'light_0': unknown type 'laser'" in message(tmp_path, gltf)
    gltf.json["extensions"]["KHR_lights_punctual"]["lights"][0] = {
        "type": "spot",
        "spot": {"innerConeAngle": 0.5, "outerConeAngle": 0.4},
    }
    assert "angles must satisfy" in message(tmp_path, gltf)
    gltf.json["extensions"]["KHR_lights_punctual"]["lights"] = []
    assert "node 2 'lamp' KHR_lights_punctual: index 0 into lights is out of range" in message(tmp_path, gltf)


def test_every_truncation_is_reported(tmp_path):
    content = small_gltf().glb()
    for length in [0, 3, 11, 12, 19, 40, len(content) // 2, len(content) - 1]:
        assert "truncated" in message(tmp_path, content[:length]) or length < 12


def test_file_errors(tmp_path):
    folder = tmp_path / "room.glb"
    folder.mkdir()
    for source, expected in [
        (tmp_path / "none.glb", "none.glb: no such file"),
        ("cornel", "scene 'cornel': no such bundled scene, there are atrium, bunny, cornell"),
        ("scene.fbx", "unknown scene format '.fbx'"),
        (tmp_path, "expected a scene file (.glb, .gltf, .obj, .ply) or a bundled name, got a folder"),
        (folder, "room.glb: expected a file, got a folder"),
    ]:
        with pytest.raises(SceneError) as info:
            load_scene(source)
        assert expected in str(info.value)
    assert "JSON is damaged" in message(tmp_path, b"{", "small.gltf")
    assert "JSON is damaged: NaN is not JSON" in message(tmp_path, b'{"a": NaN}', "small.gltf")
    assert message(tmp_path, b"[" * 100000, "small.gltf")


# Anything goes in, a scene or a SceneError comes out ------------------------------------------------------------------


def _rich_gltf():
    gltf = small_gltf()
    textured(gltf, png(TILES), extensions={"KHR_texture_transform": {"scale": [2, 2]}})
    gltf.json["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.8, "aspectRatio": 2.0}}]
    gltf.node(camera=0, translation=[0.5, 0.5, 5.0])
    gltf.node(rotation=[0, 0, 0, 1], **gltf.light(type="spot", spot={"outerConeAngle": 0.5}, color=[1, 1, 1]))
    grid = {"min": [0, 0, 0], "max": [1, 1, 1], "resolution": [4, 4, 4]}
    gltf.json["scenes"][0]["extras"] = {"lpv_grid": grid, "image": {"width": 8, "height": 8}}
    gltf.json["scene"] = 0
    return gltf


RICH = _rich_gltf()
RICH_BYTES = RICH.glb()


def _leaves(value, path=()):
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in items:
        yield from _leaves(child, (*path, key))


LEAVES = [path for path in _leaves(RICH.json) if path]
HOSTILE = [None, True, -1, 0, 1, 2, 7, 10**6, 2**31, 10**18, 10**400, 1e300, -0.5, "", "x", "data:,", [], {}, [None]]


def _survives(folder, content, name):
    path = folder / name
    path.write_bytes(content)
    try:
        check_usable(load_scene(path))
    except SceneError as error:
        assert "\n" not in str(error) and name in str(error)


@settings(max_examples=400, **FUZZ)
@given(st.lists(st.tuples(st.sampled_from(LEAVES), st.sampled_from(HOSTILE)), min_size=1, max_size=2))
def test_hostile_json_values(tmp_path, changes):
    gltf = copy.deepcopy(RICH)
    for path, value in changes:
        try:
            _set(path, copy.deepcopy(value))(gltf)
        except (TypeError, KeyError, IndexError):
            pass  # an earlier change removed the parent
    _survives(tmp_path, gltf.glb(), "fuzz.glb")


@settings(max_examples=300, **FUZZ)
@given(
    st.lists(st.tuples(st.integers(0, len(RICH_BYTES) - 1), st.integers(0, 255)), max_size=6),
    st.integers(0, len(RICH_BYTES)) | st.none(),
)
def test_damaged_bytes(tmp_path, changes, length):
    content = bytearray(RICH_BYTES)
    for position, value in changes:
        content[position] = value
    _survives(tmp_path, bytes(content[:length]), "fuzz.glb")


def test_empty_gltf_builder_has_no_mesh(tmp_path):
    assert "no mesh" in message(tmp_path, Gltf())
