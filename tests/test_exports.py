"""Exports, judged by a directional light of known answer through each engine's own formula (tests/engine_shaders.py)."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from engine_shaders import godot_ambient, godot_tap, openexr_direction, polynomial_value, threejs_irradiance

from difflpv.io.exports import EXPORT_FORMATS, export_probes, export_warnings
from difflpv.io.exports.convention import BASIS_SCALE, ExportError, mirrored
from difflpv.io.exports.exr import tile_directions
from difflpv.io.exports.plane_tree import plane_tree
from difflpv.io.exr import read_exr
from difflpv.probes.probe_files import ProbeRecord
from difflpv.probes.probe_set import DIRECTIONS_26, ProbeSet, irradiance_of
from difflpv.probes.reader import ProbeReader
from difflpv.sh import sh_basis

# Toward the light: every axis, both ways, and one oblique direction without two equal components.
TOWARD = np.array([*np.eye(3), *-np.eye(3), [2 / 7, -3 / 7, 6 / 7]])
STRENGTH = np.array([3.0, 2.0, 0.5])  # W/m2 on a surface that faces the light, by channel
POSITION = np.array([[0, 0, 0], [1.5, 0, 0], [0, 2, 0], [0, 0, 2.5], [1, 1, 1], [2, 0.5, 3], [-1, 0.25, 0.5]])


def known_answer(normal: np.ndarray, toward: np.ndarray) -> np.ndarray:
    """Irradiance of a directional light in degree 2: 1/4 + c/2 + 5/16 (3/2 c^2 - 1/2) for the clamped cosine of c.

    Legendre series of max(0, c); no spherical harmonics involved.
    """
    c = float(normal @ toward)
    return (0.25 + c / 2 + 5 / 32 * (3 * c * c - 1)) * STRENGTH


def lit_record() -> ProbeRecord:
    """One probe for each light, all where POSITION says; an invalid one among them."""
    radiance = sh_basis(TOWARD, 2)[:, :, None] * STRENGTH
    position, valid = np.insert(POSITION, 3, 99, axis=0), np.arange(8) != 3
    probes = ProbeSet(position, np.insert(radiance, 3, np.nan, axis=0), valid)
    return ProbeRecord(probes, {"name": "box", "hash": "ab"}, "gradient", {"l2": 0.2})


def check(evaluate, sets: np.ndarray, scale: float = 1.0, turn=(1, 1, 1), tolerance: float = 3e-6) -> None:
    """Every probe through the engine's formula against the light's known answer, at 26 normals of the engine's axes."""
    assert len(sets) == len(TOWARD)
    for sh, toward in zip(sets, TOWARD, strict=True):
        for normal in DIRECTIONS_26:
            np.testing.assert_allclose(
                evaluate(normal * np.array(turn), sh), scale * known_answer(normal, toward), atol=tolerance * STRENGTH.max()
            )


def test_known_answer_is_the_cosine_up_to_degree_2() -> None:
    # Against E max(0, cos) integrated: equal moments with 1, c and c^2 over the sphere.
    nodes, weights = np.polynomial.legendre.leggauss(64)
    half, half_weights = (nodes + 1) / 2, weights / 2
    series = np.array([known_answer(np.array([c, 0, 0]), np.eye(3)[0])[0] / STRENGTH[0] for c in nodes])
    for power in range(3):
        np.testing.assert_allclose((weights * series * nodes**power).sum(), (half_weights * half * half**power).sum())


def test_threejs_light_probes(tmp_path) -> None:
    (file,) = export_probes(lit_record(), tmp_path / "new" / "probes.json", format="threejs")
    group = json.loads(file.read_text())["object"]
    assert [probe["type"] for probe in group["children"]] == ["LightProbe"] * 7
    check(threejs_irradiance, np.array([probe["sh"] for probe in group["children"]]).reshape(-1, 9, 3))
    assert [probe["matrix"][12:15] for probe in group["children"]] == POSITION.tolist()
    # three.js adds up the visible probes of a scene: seven lit at once would be seven times the light.
    assert not any(probe["visible"] for probe in group["children"]) and group["userData"]["convention"]["scale"] == 1
    assert len({probe["uuid"] for probe in group["children"]}) == 7


def test_filament_sh_txt(tmp_path) -> None:
    *texts, index = export_probes(lit_record(), tmp_path, format="filament")
    nodes = json.loads(index.read_text())["probes"]
    assert [tmp_path / node["file"] for node in nodes] == texts and [n["position"] for n in nodes] == POSITION.tolist()
    line = re.compile(r"\( *(\S+), +(\S+), +(\S+)\); // L(\d)(-?\d), irradiance, pre-scaled base")
    found = [[line.fullmatch(row) for row in text.read_text().splitlines()] for text in texts]
    sets = np.array([[[float(row[k]) for k in (1, 2, 3)] for row in rows] for rows in found if all(rows)])
    assert [(row[4], row[5]) for row in found[0]] == [(str(l), str(m)) for l in range(3) for m in range(-l, l + 1)]  # noqa: E741
    check(polynomial_value, sets, scale=1 / np.pi)  # the shader's value times albedo is what leaves the surface


def test_filament_scale_is_the_table_of_its_documentation() -> None:
    # IndirectLight.h, last column, which it calls 1/pi A C; its signs are those of another phase.
    table = [0.282095, 0.325735, 0.325735, 0.325735, 0.273137, 0.273137, 0.078848, 0.273137, 0.136569]
    lobe = np.array([1, 2 / 3, 2 / 3, 2 / 3, 1 / 4, 1 / 4, 1 / 4, 1 / 4, 1 / 4])
    np.testing.assert_allclose(BASIS_SCALE * lobe, table, atol=6e-7)


def test_gltf_nodes(tmp_path) -> None:
    (file,) = export_probes(lit_record(), tmp_path / "probes.gltf", format="gltf")
    document = json.loads(file.read_text())
    root, *nodes = document["nodes"]
    assert document["asset"]["version"] == "2.0" and document["scenes"][document["scene"]]["nodes"] == [0]
    assert root["children"] == list(range(1, 8)) and [node["translation"] for node in nodes] == POSITION.tolist()
    record = root["extras"]["convention"]
    assert record["evaluate"] == "E(n) = sum over i of A_l L_i Y_i(n), A = pi, 2 pi/3, pi/4"
    norm = np.sqrt([1, 3, 3, 3, 15, 15, 5 / 4, 15, 15 / 4]) / (2 * np.sqrt(np.pi))  # orthonormal, as the record says
    lobe = np.repeat([np.pi, 2 * np.pi / 3, np.pi / 4], [1, 3, 5])
    sets = np.array([node["extras"]["radiance_sh"] for node in nodes])
    check(polynomial_value, sets * (norm * lobe)[:, None])


@pytest.mark.parametrize(("mirror", "turn"), [("x", (-1, 1, 1)), ("z", (1, 1, -1))])
def test_unity_baked_probes(mirror, turn, tmp_path) -> None:
    data, script = export_probes(lit_record(), tmp_path, format="unity", mirror=mirror)
    content = json.loads(data.read_text())
    check(polynomial_value, np.reshape(content["coefficients"], (-1, 9, 3)), scale=1 / np.pi, turn=turn)
    assert np.reshape(content["positions"], (-1, 3)).tolist() == (POSITION * turn).tolist()
    assert script.parent.name == "Editor" and content["convention"]["axes"].startswith(f"left-handed, y up; {mirror} is minus")
    names = set(re.findall(r"public float\[\] (\w+);", script.read_text()))
    assert names == {"positions", "coefficients"} <= set(content)  # JsonUtility matches fields by name


def test_unity_constants_are_those_of_its_render_pipeline() -> None:
    # Unity-Technologies/Graphics, SphericalHarmonics.cs: Unity's own factors from SH to the stored coefficients.
    c0, c1, c2, c3, c4 = 0.28209479177387814, 0.32573500793527994, 0.27313710764801977, 0.07884789131313000, 0.13656855382400988
    lobe = np.array([1, 2 / 3, 2 / 3, 2 / 3, 1 / 4, 1 / 4, 1 / 4, 1 / 4, 1 / 4])
    np.testing.assert_allclose(BASIS_SCALE * lobe, [c0, c1, c1, c1, c2, c2, c3, c2, c4], rtol=1e-12)


def test_a_flip_of_an_axis_would_be_noticed() -> None:
    # The oblique light and the axes tell every reflection and every wrong sign apart: the test of the tests.
    sets = sh_basis(TOWARD, 2)[:, :, None] * STRENGTH
    for wrong in (mirrored(ProbeSet(POSITION, sets), "x"), mirrored(ProbeSet(POSITION, sets), "z")):
        with pytest.raises(AssertionError):
            check(threejs_irradiance, wrong.radiance)
    for k in range(9):
        flipped = sets.copy()
        flipped[:, k] *= -1
        with pytest.raises(AssertionError):
            check(threejs_irradiance, flipped)


def test_godot_capture_data(tmp_path) -> None:
    data, script = export_probes(lit_record(), tmp_path, format="godot")
    content = json.loads(data.read_text())
    assert "experimental" in content["convention"]["engine"] and "EXPERIMENTAL" in script.read_text()
    points = np.reshape(content["points"], (-1, 3))
    assert points[:7].tolist() == POSITION.tolist() and len(points) == 15  # and the corners of the box
    check(godot_ambient, np.reshape(content["sh"], (-1, 9, 3))[:7], scale=1 / np.pi)  # ambient light times albedo
    assert set(re.findall(r'parsed\["(\w+)"\]', script.read_text())) | {"convention"} == set(content)
    low, size = np.reshape(content["bounds"], (2, 3))
    for point in low + np.random.default_rng(5).uniform(size=(200, 3)) * size:
        tapped = godot_tap(point, content)
        assert (tapped[0] > 0).all()  # never black, and a blend: weights are positive and sum to 1
        np.testing.assert_allclose(tapped[0], STRENGTH / (2 * np.sqrt(np.pi)) / np.pi, rtol=1e-5)


def test_plane_tree_finds_the_tetrahedron_of_every_point() -> None:
    points = np.random.default_rng(2).uniform(-1, 1, (40, 3))
    hull = np.array([[x, y, z] for x in (-2, 2) for y in (-2, 2) for z in (-2, 2)], float)
    points = np.concatenate([points, hull])
    tetrahedra, planes, children = plane_tree(points)
    linear = points @ [1.0, -2.0, 3.0]  # barycentric interpolation brings a linear function back inside a tetrahedron
    data = {"planes": planes, "children": children, "tetrahedra": tetrahedra, "points": points}
    data["sh"] = np.repeat(linear, 27)
    for point in np.random.default_rng(3).uniform(-1.9, 1.9, (300, 3)):
        np.testing.assert_allclose(godot_tap(point, data)[0], point @ [1.0, -2.0, 3.0], atol=2e-4)
    corners = points[tetrahedra]
    np.testing.assert_allclose(np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])).sum() / 6, 64)  # they fill the box


@pytest.mark.parametrize("count", [1, 2, 27])
def test_godot_takes_too_few_and_coplanar_and_regular_probes(count, tmp_path) -> None:
    grid = np.stack(np.meshgrid(*[np.arange(3.0)] * 3, indexing="ij"), -1).reshape(-1, 3)[:count]
    record = ProbeRecord(ProbeSet(grid, np.ones((count, 9, 3))))
    content = json.loads(export_probes(record, tmp_path, format="godot")[0].read_text())
    low, size = np.reshape(content["bounds"], (2, 3))
    for point in low + np.random.default_rng(1).uniform(size=(50, 3)) * size:
        np.testing.assert_allclose(godot_tap(point, content), 1 / np.pi, rtol=1e-4)


def test_exr_atlas_of_irradiance(tmp_path) -> None:
    image, described = export_probes(lit_record(), tmp_path / "atlas.exr", format="exr", height=8)
    channels, header = read_exr(image)
    record = json.loads(str(header["difflpv:convention"]))
    assert record == json.loads(described.read_text())["convention"]
    (width, height), columns = record["tile"], record["columns"]
    pixels = np.stack([channels[name] for name in "RGB"], -1)
    assert pixels.shape == (4 * height, 2 * width, 3)
    for k, toward in enumerate(TOWARD):
        tile = pixels[k // columns * height :][:height, k % columns * width :][:, :width]
        for y in range(height):
            for x in range(width):
                expected = known_answer(openexr_direction(x, y, width, height), toward)
                np.testing.assert_allclose(tile[y, x], expected, atol=2e-6)
    assert (pixels[3 * height :, width:] == 0).all()  # no eighth probe


def test_exr_maps_of_radiance_integrate_to_irradiance(tmp_path) -> None:
    image, _ = export_probes(lit_record(), tmp_path / "atlas.exr", format="exr", quantity="radiance", height=64)
    channels, _ = read_exr(image)
    tile = np.stack([channels[name][:64, :128] for name in "RGB"], -1).reshape(-1, 3)  # light from +x
    directions = tile_directions(64).reshape(-1, 3)
    solid_angle = np.cos(np.arcsin(directions[:, 1])) * (np.pi / 64) ** 2
    for normal in DIRECTIONS_26:
        seen = (tile * (solid_angle * np.maximum(0, directions @ normal))[:, None]).sum(0)
        np.testing.assert_allclose(seen, known_answer(normal, TOWARD[0]), atol=2e-3)


def test_every_export_says_what_it_is(tmp_path) -> None:
    names = {"threejs": "a.json", "gltf": "a.gltf", "exr": "a.exr"}
    for format in EXPORT_FORMATS:
        files = export_probes(lit_record(), tmp_path / format / names.get(format, ""), format=format)
        (record,) = [r for r in map(find_convention, files) if r is not None]
        assert {"quantity", "evaluate", "axes", "direction", "scale", "sources", "length", "color"} <= set(record)
        assert "handed" in record["axes"] and "radiance" in record["quantity"]
        assert all(source.startswith("https://") for source in record["sources"])
        assert (record["scene"], record["method"], record["errors"]) == ({"name": "box", "hash": "ab"}, "gradient", {"l2": 0.2})
        again = export_probes(lit_record(), tmp_path / format / names.get(format, ""), format=format)
        assert again == files and not list(tmp_path.rglob("*.tmp*"))


def footprint_weights(point: np.ndarray, position: np.ndarray, metric: np.ndarray, neighbours: int) -> np.ndarray:
    """As the words of the exported record say, for more probes than neighbours."""
    d = (np.einsum("nij,nj->ni", metric, point - position) ** 2).sum(1)
    order = np.argsort(d)
    first, after = d[order[0]], d[order[neighbours]]
    weight = np.zeros(len(d))
    near = order[:neighbours]
    weight[near] = np.exp(-(d[near] - first) / 2) - np.exp(-(after - first) / 2) + 1e-9
    return weight / weight.sum()


@pytest.mark.parametrize("format", EXPORT_FORMATS)
def test_footprints_go_along_or_are_warned_of(format, tmp_path) -> None:
    plain = lit_record()
    metric = np.eye(3) + 0.2 * np.random.default_rng(0).normal(size=(8, 3, 3))
    record = replace(plain, reader=ProbeReader("gaussian", metric, neighbours=3))
    out = tmp_path / {"threejs": "a.json", "gltf": "a.gltf", "exr": "a.exr"}.get(format, "a")
    files = export_probes(record, out, format=format)
    (convention,) = [r for r in map(find_convention, files) if r is not None]
    assert convention["interpolation"]["made_for"] == "Gaussian footprints of 3 neighbours"
    assert export_warnings(plain, format=format) == []
    warnings = export_warnings(record, format=format)
    seeing = export_warnings(replace(plain, reader=ProbeReader(sight=True)), format=format)
    if format not in ("threejs", "gltf"):
        (line,), (other,) = warnings, seeing
        assert line.startswith("probes made to be read by Gaussian footprints of 3 neighbours: ") and "\n" not in line
        assert convention["interpolation"]["engine"] in line and "tetrahedra, weighted by sight: " in other
        return
    assert warnings == seeing == []
    document = json.loads(files[0].read_text())
    root, *nodes = document["nodes"] if format == "gltf" else (document["object"], *document["object"]["children"])
    place = "extras" if format == "gltf" else "userData"
    reader, carried = root[place]["reader"], np.array([node[place]["metric"] for node in nodes])
    assert (reader["interpolation"], reader["neighbours"], reader["sight"]) == ("gaussian", 3, False)
    rows = ProbeReader("gaussian", metric[np.arange(8) != 3], neighbours=3).over(POSITION, None)  # type: ignore[arg-type]
    for point in np.random.default_rng(1).uniform(0, 2, (20, 3)):
        expected = rows.rows(torch.from_numpy(POSITION), torch.from_numpy(point[None])).dense(7)[0]
        np.testing.assert_allclose(footprint_weights(point, POSITION, carried, 3), expected, atol=1e-6)


def find_convention(file: Path):
    if file.suffix not in (".json", ".gltf"):
        return None
    content = json.loads(file.read_text())
    for key in ("object", "nodes", "userData", "extras"):
        content = content[key] if isinstance(content, dict) and key in content else content
        content = content[0] if isinstance(content, list) else content
    return content["convention"]


def test_what_a_format_cannot_hold_is_refused_in_one_line(tmp_path) -> None:
    record = lit_record()
    for format, suffix in (("threejs", ".json"), ("gltf", ".gltf"), ("exr", ".exr")):
        with pytest.raises(ExportError, match=rf"probes\.bin: expected a file name ending in \{suffix}"):
            export_probes(record, tmp_path / "probes.bin", format=format)
    nothing = ProbeRecord(ProbeSet(np.zeros((2, 3)), np.zeros((2, 9, 3)), np.zeros(2, bool)))
    huge = ProbeRecord(ProbeSet(np.zeros((1, 3)), np.full((1, 9, 3), 1e41)))
    for format in EXPORT_FORMATS:
        out = tmp_path / {"threejs": "p.json", "gltf": "p.gltf", "exr": "p.exr"}.get(format, "p")
        with pytest.raises(ExportError, match="none of the 2 is valid"):
            export_probes(nothing, out, format=format)
        with pytest.raises(ExportError, match="beyond the range of float32"):
            export_probes(huge, out, format=format)
    (tmp_path / "taken").write_text("")
    with pytest.raises(ExportError, match="taken: folder cannot be made"):
        export_probes(record, tmp_path / "taken", format="filament")
    with pytest.raises(ExportError, match="expected 2 to 1024 rows"):
        export_probes(record, tmp_path / "a.exr", format="exr", height=1)
    with pytest.raises(ExportError, match="lower the height"):
        many = ProbeRecord(ProbeSet(np.zeros((100, 3)), np.zeros((100, 9, 3))))
        export_probes(many, tmp_path / "a.exr", format="exr", height=1024)
    with pytest.raises(ExportError, match="too many for Godot"):
        many = ProbeRecord(ProbeSet(np.zeros((4097, 3)), np.zeros((4097, 9, 3))))
        export_probes(many, tmp_path / "g", format="godot")
    with pytest.raises(ValueError, match="format: expected one of threejs.*got 'unreal'"):
        export_probes(record, tmp_path, format="unreal")  # type: ignore[arg-type]


def test_mirrored_probes_are_the_probes_of_the_mirrored_world() -> None:
    rng = np.random.default_rng(4)
    probes = ProbeSet(rng.normal(size=(3, 3)), rng.normal(size=(3, 9, 3)))
    for axis, turn in (("x", [-1, 1, 1]), ("z", [1, 1, -1])):
        other = mirrored(probes, axis)  # type: ignore[arg-type]
        np.testing.assert_allclose(other.position, probes.position * turn)
        np.testing.assert_allclose(irradiance_of(other.radiance, DIRECTIONS_26 * turn), probes.irradiance(DIRECTIONS_26))
