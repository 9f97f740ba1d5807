import struct

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scene_files import FUZZ, PLY, check_usable

from difflpv.io import load_scene
from difflpv.scene import DirectionalLight, SceneError


def load(folder, content):
    path = folder / "small.ply"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return load_scene(path)


def message(folder, content):
    with pytest.raises(SceneError) as info:
        load(folder, content)
    text = str(info.value)
    assert "\n" not in text and "small.ply" in text
    return text


def binary(order=">", normals=False):
    """The scene of ``PLY`` in binary."""
    name = "binary_big_endian" if order == ">" else "binary_little_endian"
    header = PLY[: PLY.index("end_header")].replace("ascii", name)
    body = b""
    if normals:
        header = header.replace("property float z\n", "property float z\nproperty uchar red\nproperty double nx\n")
    for line in PLY[PLY.index("end_header") + 11 :].splitlines()[:5]:
        body += struct.pack(order + "3f", *map(float, line.split()))
        body += struct.pack(order + "Bd", 7, 0.5) if normals else b""
    body += struct.pack(order + "B4i", 4, 0, 1, 2, 3) + struct.pack(order + "B3i", 3, 1, 4, 2)
    return header.encode() + b"end_header\n" + body


FORMS = {"ascii": PLY, "big": binary(">"), "little": binary("<"), "more": binary("<", True)}


@pytest.mark.parametrize("content", FORMS.values(), ids=FORMS)
def test_mixed_polygons(tmp_path, content):
    scene = load(tmp_path, content)
    (mesh,) = scene.meshes
    assert mesh.name == "small"
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0]])
    np.testing.assert_array_equal(mesh.triangles, [[0, 1, 2], [0, 2, 3], [1, 4, 2]])
    np.testing.assert_allclose(mesh.material.albedo, [0.8, 0.8, 0.8])
    check_usable(scene)


def test_light_and_camera_are_added_and_told(tmp_path):
    scene = load(tmp_path, PLY)
    (light,) = scene.lights
    assert isinstance(light, DirectionalLight) and light.direction[1] < 0
    np.testing.assert_allclose(light.irradiance, [1, 1, 1])
    assert any("PLY holds no light" in line for line in scene.warnings)
    assert any("no camera" in line for line in scene.warnings)


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_agrees_with_trimesh(tmp_path, encoding):
    ball = trimesh.creation.icosphere(3)
    mesh = load(tmp_path, ball.export(file_type="ply", encoding=encoding)).meshes[0]
    np.testing.assert_allclose(mesh.vertices, ball.vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.triangles, ball.faces)


ERRORS = {
    "not ply": ("plain text", "not a PLY file"),
    "no end": (PLY.replace("end_header", "end"), "not a PLY file: the header is missing, unfinished"),
    "format": (PLY.replace("ascii", "utf8"), "format 'utf8' is unknown"),
    "type": (PLY.replace("float y", "half y"), "header line 6 is not understood: 'property half y'"),
    "count": (PLY.replace("vertex 5", "vertex 4000000000"), "truncated: 4000000000 rows of 'vertex' do not fit"),
    "short": (PLY.replace("3 1 4 2\n", ""), "truncated: the data ends in element 'face'"),
    "number": (PLY.replace("2 0 0", "2 0 x"), "element 'vertex', from row 0: could not convert"),
    "index": (PLY.replace("3 1 4 2", "3 1 4 9"), "mesh 'small': index 9 is out of range for 5 vertices"),
    "nan": (PLY.replace("2 0 0", "2 0 nan"), "mesh 'small': vertex 4 is not finite"),
    "fraction": (PLY.replace("3 1 4 2", "3 1 4 2.5"), "face 1: expected integers"),
    "corners": (PLY.replace("3 1 4 2", "2 1 4 "), "face 1: expected at least 3 corners, got 2"),
    "no z": (PLY.replace("float z", "float w"), "element 'vertex' with the numbers x, y and z is missing"),
    "no face": (PLY.replace("vertex_indices", "edges"), "no mesh: element 'face' with a list"),
    "twice": (PLY.replace("float y", "float x"), "element 'vertex': a property is named twice"),
}


@pytest.mark.parametrize("case", sorted(ERRORS))
def test_errors(tmp_path, case):
    content, expected = ERRORS[case]
    assert expected in message(tmp_path, content)


def test_zero_area(tmp_path):
    scene = load(tmp_path, PLY.replace("3 1 4 2", "3 1 1 2"))
    assert any("1 of 3 triangles have no area" in line for line in scene.warnings)
    assert "no mesh" in message(tmp_path, PLY.replace("face 2", "face 0"))


def test_every_truncation_of_binary(tmp_path):
    content = binary("<")
    for length in range(len(content)):
        message(tmp_path, content[:length])


@settings(max_examples=400, **FUZZ)
@given(
    st.sampled_from([PLY.encode(), binary("<"), binary(">", True)]),
    st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255) | st.sampled_from(b"0123456789 -.e\n")), max_size=5),
)
def test_damaged_bytes(tmp_path, content, changes):
    damaged = bytearray(content)
    for position, value in changes:
        damaged[position % len(damaged)] = value
    try:
        check_usable(load(tmp_path, bytes(damaged)))
    except SceneError as error:
        assert "\n" not in str(error) and "small.ply" in str(error)
