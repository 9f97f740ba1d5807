import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scene_files import FUZZ, MTL, OBJ, TILES, check_usable, write_obj

from difflpv.io import load_scene
from difflpv.io.srgb import srgb_to_linear
from difflpv.scene import SceneError


def message(path):
    with pytest.raises(SceneError) as info:
        load_scene(path)
    text = str(info.value)
    assert "\n" not in text and "small.obj" in text
    return text


def test_materials_textures_and_lights(tmp_path):
    scene = load_scene(write_obj(tmp_path))
    assert (scene.name, [m.name for m in scene.meshes]) == ("small", ["floor", "lamp"])
    assert [len(m.triangles) for m in scene.meshes] == [2, 1]
    floor = scene.meshes[0]
    np.testing.assert_allclose(floor.material.albedo, [0.5, 0.5, 1.0])
    np.testing.assert_allclose(floor.material.texture.image, srgb_to_linear(np.array(TILES) / 255), rtol=1e-6)
    (light,) = scene.lights
    assert (light.mesh, light.two_sided) == ("lamp", False)
    np.testing.assert_allclose(light.radiance, [3, 2, 1])
    assert scene.grid is None and "default one" in scene.warnings[0]
    check_usable(scene)


def test_v_is_flipped(tmp_path):
    mesh = load_scene(write_obj(tmp_path)).meshes[0]
    corner = {tuple(p): tuple(uv) for p, uv in zip(mesh.vertices, mesh.uv, strict=True)}
    # OBJ's (0, 0) is the image's lower left corner, which glTF calls (0, 1).
    assert corner == {(0, 0, 0): (0, 1), (1, 0, 0): (1, 1), (1, 1, 0): (1, 0), (0, 1, 0): (0, 0)}
    near_origin = load_scene(tmp_path / "small.obj").albedo_at(np.array([0]), np.array([[0.0, 0.25]]))
    np.testing.assert_allclose(near_origin, [[0, 0, 1]], atol=1e-6)  # the blue tile, lower left


def test_without_mtl_the_albedo_is_the_default(tmp_path):
    obj = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nmtllib small.mtl\nusemtl bare\nf 1 3 2\n"
    scene = load_scene(write_obj(tmp_path, obj, "newmtl bare\nKe 1\n"))
    np.testing.assert_allclose([m.material.albedo for m in scene.meshes], np.full((2, 3), 0.8))
    assert [m.name for m in scene.meshes] == ["small", "small_1"]
    np.testing.assert_allclose(scene.lights[0].radiance, [1, 1, 1])  # one number stands for all three


def test_groups_that_return_are_one_mesh_and_polygons_are_fans(tmp_path):
    obj = OBJ + "g floor\nusemtl tiles\nv 2 0 0\nv 3 0 0\nv 3.5 1 0\nv 2.5 2 0\nv 1.5 1 0\nf -5 -4 -3 -2 -1\n"
    scene = load_scene(write_obj(tmp_path, obj))
    assert [(m.name, len(m.triangles)) for m in scene.meshes] == [("floor", 5), ("lamp", 1)]
    pentagon = scene.triangle_areas[2:5].sum()
    assert pentagon == pytest.approx(1.5 + 1.0)  # a trapezium of edges 1 and 2, a triangle of base 2, both 1 high
    assert any("5 corners without texture coordinates" in line for line in scene.warnings)


def test_forms_of_lines(tmp_path):
    lines = ["\ufeff# comment", "v 0 0 0 1 1 1", " v\t1 0 0", "v 0 1 \\", "0", "mtllib small.mtl", "usemtl lamp"]
    obj = "\r\n".join([*lines, "f 1//1 2//1 3//1"])
    assert len(load_scene(write_obj(tmp_path, obj)).triangle_areas) == 1


def test_map_options_and_backslashes(tmp_path):
    (tmp_path / "sub").mkdir()
    options = "-s 1 1 1 -bm 0.5 -clamp on"
    path = write_obj(tmp_path, mtl=MTL.replace("tiles.png", options + " sub\\my tiles.png"))
    (tmp_path / "tiles.png").rename(tmp_path / "sub" / "my tiles.png")
    scene = load_scene(path)
    assert scene.meshes[0].material.texture is not None
    assert sum("is not used" in line for line in scene.warnings) == 3


ERRORS = {
    "nan": (OBJ.replace("v 1 1 0", "v 1 nan 0"), MTL, "line 6: vertex is not finite: [1.0, nan, 0.0]"),
    "number": (OBJ.replace("v 1 1 0", "v 1 one 0"), MTL, "line 6: vertex: expected 3 numbers, got '1 one 0'"),
    "index": (OBJ.replace("3/3", "33/3"), MTL, "line 14: index 33 is out of range, there are 4 vertices"),
    "uv index": (OBJ.replace("3/3", "3/9"), MTL, "line 14: index 9 is out of range, there are 4 texture vertices"),
    "zero": (OBJ.replace("3/3", "0/3"), MTL, "line 14: index 0 is out of range"),
    "face": (OBJ.replace("f 1/1 2/2 3/3 4/4", "f 1 2"), MTL, "line 14: a face needs at least 3 corners, got 2"),
    "albedo": (OBJ, MTL.replace("1.0", "1.2"), "small.mtl: material 'tiles': albedo must lie in [0, 1], got [0.5, 0.5"),
    "kd": (OBJ, MTL.replace("Kd 0.5 0.5 1.0", "Kd spectral x"), "small.mtl line 2: material 'tiles': Kd: expected 3"),
    "usemtl": (OBJ.replace("usemtl lamp", "usemtl lmp"), MTL, "line 16: material 'lmp' is not in the MTL files"),
    "no mtl": (OBJ, None, "line 2: MTL file '"),
    "no texture": (OBJ, MTL.replace("tiles.png", "none.png"), "small.mtl line 3: material 'tiles': texture '"),
    "no light": (OBJ, MTL.replace("Ke 3 2 1", ""), "no light: expected an emissive material or a punctual light"),
    "no mesh": ("v 0 0 0\n", MTL, "no mesh: expected at least one triangle"),
    "empty": ("", MTL, "no mesh"),
    "order": (OBJ, "Kd 1 1 1\n", "small.mtl line 1: Kd before the first newmtl"),
    "huge": (OBJ.replace("v 1 1 0", "v 1 1e200 0"), MTL, "mesh 'floor': vertex 2 is out of range"),
}


@pytest.mark.parametrize("case", sorted(ERRORS))
def test_errors_name_file_line_and_reason(tmp_path, case):
    obj, mtl, expected = ERRORS[case]
    assert expected in message(write_obj(tmp_path, obj, mtl))


def test_zero_area(tmp_path):
    scene = load_scene(write_obj(tmp_path, OBJ + "f 1 1 2\nf 1 2 2\n"))
    assert any("mesh 'lamp': 2 of 3 triangles have no area" in line for line in scene.warnings)


def test_default_camera_of_a_room_stands_inside_and_of_an_object_outside(tmp_path):
    import trimesh

    def scene_of(mesh, inverted):
        faces = mesh.faces[:, ::-1] if inverted else mesh.faces
        lines = [f"v {x} {y} {z}" for x, y, z in mesh.vertices] + ["f {} {} {}".format(*(f + 1)) for f in faces]
        return load_scene(write_obj(tmp_path, "mtllib small.mtl\nusemtl lamp\n" + "\n".join(lines)))

    room = scene_of(trimesh.creation.box((6, 3, 4)), True)
    position = room.cameras[0].to_world[:3, 3]
    assert (np.abs(position) < [3, 1.5, 2]).all()
    ball = scene_of(trimesh.creation.icosphere(2), False)
    position = ball.cameras[0].to_world[:3, 3]
    assert np.linalg.norm(position) > 1.5
    _, direction = ball.cameras[0].rays(np.array([[128.0, 96.0]]))
    np.testing.assert_allclose(direction[0], -position / np.linalg.norm(position), atol=1e-9)
    sheet = scene_of(trimesh.Trimesh([[0, 0, 0], [0, 0, 2], [2, 0, 0]], [[0, 1, 2]]), False)
    assert sheet.cameras[0].to_world[1, 3] > 0.5


HOSTILE = ["nan", "inf", "-1", "0", "99999999999", "1e999", "", "/", "1//", "f", "v", "\0", "\\", "mtllib", "map_Kd"]


def _words_replaced(text, changes):
    lines = [line.split(" ") for line in text.split("\n")]
    for row, column, word in changes:
        line = lines[row % len(lines)]
        line[column % len(line)] = word
    return "\n".join(" ".join(line) for line in lines)


CHANGES = st.lists(st.tuples(st.integers(0, 30), st.integers(0, 5), st.sampled_from(HOSTILE)), max_size=3)


@settings(max_examples=250, **FUZZ)
@given(CHANGES, CHANGES, st.binary(max_size=3), st.integers(0, 200))
def test_anything_gives_a_scene_or_a_scene_error(tmp_path, obj_changes, mtl_changes, noise, where):
    path = write_obj(tmp_path, "", _words_replaced(MTL, mtl_changes))
    content = _words_replaced(OBJ, obj_changes).encode()
    path.write_bytes(content[:where] + noise + content[where + len(noise) :])
    try:
        check_usable(load_scene(path))
    except SceneError as error:
        assert "\n" not in str(error) and "small.obj" in str(error)
