import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from difflpv.io import load_scene
from difflpv.io.tables import load_table
from difflpv.lights import apply_light_set, behind_light_weight, load_light_sets, select_light_set
from difflpv.scene import AreaLight, DirectionalLight, PointLight, SceneError, SpotLight

AREA = {"type": "area", "mesh": "light", "radiance": [1, 2, 3]}
SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]


@pytest.fixture(scope="module")
def cornell():
    return load_scene("cornell")


def write(folder, content):
    path = folder / "sets.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.mark.parametrize("name", ["cornell", "two_rooms_90"])
def test_bundled_sets(name):
    scene = load_scene(name)
    sets = load_light_sets(None, name)
    assert len(sets) == 8
    for entries in sets:
        lit = apply_light_set(scene, entries)
        (light,) = lit.lights
        panel = lit.meshes[-1]
        assert light.mesh == panel.name == "light" and not light.two_sided
        np.testing.assert_allclose(panel.vertices, entries[0]["vertices"])
        np.testing.assert_array_equal(panel.triangles, [[0, 1, 2], [0, 2, 3]])
        np.testing.assert_allclose(light.radiance, entries[0]["radiance"])
        assert lit.hash != scene.hash
        low, high = scene.bounds  # each panel faces the middle of the room, its emitting side inwards
        assert ((low + high) / 2 - panel.vertices.mean(0)) @ lit.triangle_normals[-1] > 0
    assert scene.lights[0].radiance[0] == pytest.approx({"cornell": 17, "two_rooms_90": 15}[name])  # left as it was


def test_first_set_of_cornell(cornell):
    lit = apply_light_set(cornell, select_light_set(None, "cornell", 0))
    np.testing.assert_allclose(lit.lights[0].radiance, [20, 18, 15])
    np.testing.assert_allclose(lit.meshes[7].vertices[0], [1.0, 5.49, 0.7])


def test_a_set_replaces_all_lights_and_dark_panels_still_block(cornell):
    entries = [
        {"type": "point", "position": [0, 1, 0], "intensity": [1, 1, 1]},
        {"type": "directional", "direction": [0, -2, 0], "irradiance": [4, 4, 4]},
        {"type": "spot", "position": [0, 1, 0], "direction": [1, 0, 0], "intensity": [1, 0, 0], "outer_angle": 0.5},
    ]
    lit = apply_light_set(cornell, entries)
    point, sun, spot = lit.lights
    assert isinstance(point, PointLight) and isinstance(sun, DirectionalLight) and isinstance(spot, SpotLight)
    np.testing.assert_allclose(sun.direction, [0, -1, 0])
    assert (spot.inner_angle, spot.outer_angle) == (0.0, 0.5)
    assert not lit.mesh_emission.any() and len(lit.triangle_areas) == len(cornell.triangle_areas)


def test_dimmed_without_moving_and_two_sided(cornell):
    lit = apply_light_set(cornell, [AREA | {"one_sided": False}])
    assert isinstance(lit.lights[0], AreaLight) and lit.lights[0].two_sided
    np.testing.assert_array_equal(lit.meshes[7].vertices, cornell.meshes[7].vertices)


POINT = {"type": "point", "position": [0, 1, 0], "intensity": [1, 1, 1]}
ERRORS = {
    "unknown mesh": ([AREA | {"mesh": "lamp"}], "[0]: mesh 'lamp' is not in the scene, meshes are floor, ceiling"),
    "twice": ([AREA, AREA], "[1]: mesh 'light' is named twice"),
    "length": ([AREA | {"radiance": [1, 2]}], "[0].radiance: expected 3 numbers, got [1, 2]"),
    "nan": ([AREA | {"radiance": [1, 2, float("nan")]}], "[0].radiance: expected finite numbers"),
    "negative": ([AREA | {"radiance": [1, 2, -3]}], "[0]: light 'light': radiance must be >= 0"),
    "type": ([{"type": "laser"}], "[0]: unknown type 'laser', expected area, point, spot, directional"),
    "no type": ([{"mesh": "light"}], "[0]: unknown type 'None'"),
    "missing": ([{"type": "point", "position": [0, 0, 0]}], "[0]: 'intensity' is missing"),
    "unknown": ([POINT | {"colour": 1}], "[0]: unknown field 'colour'"),
    "object": (["light"], "[0]: expected an object"),
    "flag": ([AREA | {"one_sided": 1}], "[0].one_sided: expected true or false"),
    "name": ([AREA | {"mesh": 7}], "[0].mesh: expected text"),
    "corners": ([AREA | {"vertices": SQUARE[:3]}], "[0].vertices: expected 4 points"),
    "corner": ([AREA | {"vertices": [*SQUARE[:3], [0, 1]]}], "[0].vertices: expected 3 numbers, got [0, 1]"),
    "skewed": ([AREA | {"vertices": [*SQUARE[:3], [0, 2, 0]]}], "[0]: vertices: expected a parallelogram"),
    "flat": ([AREA | {"vertices": [[0, 0, 0], [1, 0, 0]] * 2}], "[0]: vertices: "),
    "angle": (
        [{"type": "spot", "position": [0] * 3, "direction": [1, 0, 0], "intensity": [1] * 3, "outer_angle": 2}],
        "[0]: light 'spot_0': angles must satisfy",
    ),
    "direction": ([{"type": "directional", "direction": [0, 0, 0], "irradiance": [1] * 3}], "direction has no length"),
}


@pytest.mark.parametrize("case", sorted(ERRORS))
def test_errors_name_file_and_element(tmp_path, cornell, case):
    entries, expected = ERRORS[case]
    path = write(tmp_path, {"cornell": [[POINT], entries]})
    with pytest.raises(SceneError) as info:
        apply_light_set(cornell, load_light_sets(path, "cornell")[1])
    text = str(info.value)
    assert text.startswith(f"{path}: cornell[1]") and expected in text and "\n" not in text
    with pytest.raises(SceneError, match="light set for 'cornell', light"):
        apply_light_set(cornell, entries)


def test_file_errors(tmp_path):
    path = write(tmp_path, {"cornell": [[POINT]], "empty": [], "hollow": [[]]})
    for scene, index, expected in [
        ("bunny", 0, "no light sets for scene 'bunny', the file has cornell, empty, hollow"),
        ("cornell", 1, "cornell[1]: index out of range, there are 1 light sets"),
        ("cornell", -1, "cornell[-1]: index out of range"),
        ("empty", 0, "empty: expected a non-empty list of light sets"),
        ("hollow", 0, "hollow[0]: expected a non-empty list of lights"),
    ]:
        with pytest.raises(SceneError) as info:
            select_light_set(path, scene, index)
        assert expected in str(info.value) and "sets.json" in str(info.value)
    with pytest.raises(SceneError, match=r"sets\.json: JSON is damaged"):
        load_light_sets(write(tmp_path, "{"), "cornell")
    with pytest.raises(SceneError, match=r"sets\.json: expected an object"):
        load_light_sets(write(tmp_path, "[]"), "cornell")
    with pytest.raises(SceneError, match=r"none\.json: cannot be read: No such file"):
        load_light_sets(tmp_path / "none.json", "cornell")


def test_receivers_behind_the_panel_by_hand(cornell):
    square = AREA | {"vertices": [[0, 1, 0], [2, 1, 0], [2, 1, 2], [0, 1, 2]]}  # emits down, towards -y
    lit = apply_light_set(cornell, [square])
    points = {
        (1, 1.01, 1): True,
        (0.01, 1.049, 1.99): True,
        (1, 1.051, 1): False,  # too far behind
        (1, 0.99, 1): False,  # in front
        (1, 1.0, 1): False,  # on the panel
        (-0.01, 1.01, 1): False,  # beside it
    }
    np.testing.assert_array_equal(behind_light_weight(lit, np.array(list(points))), list(points.values()))
    # The gap shrinks with a small scene: its ceiling is not all behind the lamp.
    small = replace(lit, meshes=tuple(replace(m, vertices=m.vertices / 100) for m in lit.meshes))
    near = behind_light_weight(small, np.array([[0.01, 0.0101, 0.01], [0.01, 0.0109, 0.01]]))
    assert list(near) == [True, False]
    both = apply_light_set(cornell, [square | {"one_sided": False}])
    assert not behind_light_weight(both, np.array(list(points))).any()
    with pytest.raises(ValueError, match=r"positions: expected shape \[n, 3\], got \[3\]"):
        behind_light_weight(lit, np.zeros(3))


@pytest.mark.parametrize("name", ["cornell", "two_rooms_90"])
def test_receivers_behind_the_panel_agree_with_the_independent_tables(name):
    scene = load_scene(name)
    table = load_table(Path(__file__).parent / "data" / "behind_light.npz")
    lit = [scene] + [apply_light_set(scene, entries) for entries in load_light_sets(None, name)[:5]]
    for k, lights in enumerate(lit):
        expected = table[f"{name}_behind"][k]
        assert expected.any()
        np.testing.assert_array_equal(behind_light_weight(lights, table[f"{name}_position"]), expected)
