"""Options that commands share, and bad scenes as a new user meets them."""

import argparse

import numpy as np
import pytest
from cli_room import difflpv, write_room
from hypothesis import given
from hypothesis import strategies as st
from scene_files import QUAD, QUAD_INDICES, Gltf, small_gltf, write_obj

import difflpv.cli.fit as fit_command
from difflpv.cli import options
from difflpv.config import METHODS
from difflpv.fit import Loss
from difflpv.illumination import Component
from difflpv.learnables import LEARNABLES


def test_choices_are_those_of_the_functions():
    """The commands name them without importing torch; here they are compared."""
    assert set(options.METHODS) == {*METHODS, "constant", "floor"}
    assert options.COMPONENTS == Component.__args__
    assert fit_command.LEARNABLES == LEARNABLES
    assert fit_command.LOSSES == Loss.__args__


@pytest.mark.parametrize(
    ("text", "expected"), [("0", (0,)), ("0-4,7", (0, 1, 2, 3, 4, 7)), ("3,1", (3, 1)), ("2-2", (2,)), ("none", ())]
)
def test_index_lists(text, expected):
    assert options.index_list(text) == expected


@pytest.mark.parametrize("text", ["", "a", "1-", "-1", "4-2", "1,,2", "1 2", "1.5", "1,1", "0-3,2", "9" * 12, "²"])
def test_bad_index_lists(text):
    with pytest.raises(argparse.ArgumentTypeError):
        options.index_list(text)


@given(st.lists(st.integers(0, 99), min_size=1, unique=True))
def test_every_list_of_numbers_can_be_written(numbers):
    assert options.index_list(",".join(map(str, numbers))) == tuple(numbers)


@given(st.integers(1, 60))
def test_default_split_uses_every_light_once(count):
    train, test = fit_command.default_split(count)
    assert train and (*train, *test) == tuple(range(count))


def test_eight_lights_split_as_the_demo_does():
    assert fit_command.default_split(8) == ((0, 1, 2, 3, 4), (5, 6, 7))
    assert fit_command.default_split(1) == ((0,), ())


@pytest.mark.parametrize(
    ("function", "good", "bad"),
    [
        (options.natural, {"0": 0, "12": 12}, ["-1", "1.0", "x", "", "٣"]),
        (options.positive, {"1": 1}, ["0"]),
        (options.positive_float, {"2.5": 2.5, "1e3": 1000.0}, ["0", "-1", "nan", "inf", "x"]),
        (options.fraction, {"0.01": 0.01}, ["0", "1", "2", "nan"]),
        (options.name_list, {"a, b": ("a", "b")}, ["", "a,,b"]),
    ],
)
def test_numbers_and_names(function, good, bad):
    for text, value in good.items():
        assert function(text) == value
    for text in bad:
        with pytest.raises(argparse.ArgumentTypeError):
            function(text)


def test_devices(monkeypatch):
    import torch

    assert options.select_device("cpu") == torch.device("cpu")
    for name in ("gpu", "cpu:0", "cuda:x", "cuda:", ""):
        with pytest.raises(options.UsageError, match="--device: expected auto, cpu, cuda or cuda:N"):
            options.select_device(name)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert options.select_device("auto") == torch.device("cpu")
    with pytest.raises(options.UsageError, match=r"--device: no CUDA device for 'cuda:1' \(torch .*\); use --device cpu"):
        options.select_device("cuda:1")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert options.select_device("auto") == torch.device("cuda")
    with pytest.raises(options.UsageError, match="'cuda:1' is out of range, there are 1 CUDA devices"):
        options.select_device("cuda:1")


def gltf_file(positions=QUAD, indices=QUAD_INDICES, color=(0.5, 0.5, 0.5), lamp=True, floor=True):
    gltf = Gltf()
    grey = gltf.material("grey", color)
    if floor:
        gltf.node(name="floor", mesh=gltf.mesh(gltf.primitive(grey, positions, indices)))
    if lamp:
        emitter = gltf.material("lamp", (0, 0, 0), (1, 1, 1), 8.0)
        gltf.node(name="light", mesh=gltf.mesh(gltf.primitive(emitter)), translation=[0, 0, 2])
    return gltf.glb()


NAN = QUAD.copy()
NAN[2, 1] = np.nan
SCENES = {
    "truncated": (small_gltf().glb()[:-100], "truncated: the GLB header says 1388 bytes, the file has 1288"),
    "index": (gltf_file(indices=np.uint16([0, 1, 2, 0, 2, 9])), "mesh 'floor': index 9 is out of range for 4 vertices"),
    "nan": (gltf_file(NAN), "mesh 'floor': vertex 2 is not finite: [nan, nan, nan]"),
    "albedo": (gltf_file(color=(0.5, 1.5, 0.5)), "material 'grey': albedo must lie in [0, 1], got [0.5, 1.5, 0.5]"),
    "dark": (gltf_file(lamp=False), "scene 'dark': no light: expected an emissive material or a punctual light"),
    "empty": (gltf_file(lamp=False, floor=False), "scene 'empty': no mesh: expected at least one triangle"),
}


@pytest.mark.parametrize("name", SCENES)
def test_bad_scenes(name, tmp_path, capsys):
    content, reason = SCENES[name]
    path = tmp_path / f"{name}.glb"
    path.write_bytes(content)
    assert difflpv("info", path) == 2
    assert capsys.readouterr() == ("", f"difflpv: error: {path}: {reason}\n")


def test_missing_files(tmp_path, capsys):
    path = tmp_path / "room.glb"
    assert difflpv("info", path) == 2
    assert capsys.readouterr().err == f"difflpv: error: {path}: no such file\n"
    obj = write_obj(tmp_path, tiles=False)
    assert difflpv("info", obj) == 2
    texture = tmp_path / "tiles.png"
    reason = f"small.mtl line 3: material 'tiles': texture '{texture}' is missing"
    assert capsys.readouterr().err == f"difflpv: error: {obj}: {reason}\n"


def test_triangles_without_area_are_told(tmp_path, capsys):
    path = tmp_path / "zero.glb"
    path.write_bytes(gltf_file(indices=np.array([0, 1, 2, 0, 2, 3, 0, 1, 1], np.uint16)))
    assert difflpv("info", path) == 0
    assert "warning: mesh 'floor': 1 of 3 triangles have no area and were dropped\n" in capsys.readouterr().err


def test_a_grid_that_does_not_contain_the_scene_is_told(tmp_path, capsys):
    scene = write_room(tmp_path, grid_low=(-0.5, -1.5, -0.6))
    assert difflpv("info", scene) == 0
    assert "warning: the grid (-0.5, -1.5, -0.6) .. (2.7, 1.7, 2.6) m does not contain the scene" in capsys.readouterr().err


def test_info_of_a_bundled_scene_and_of_obj(tmp_path, capsys):
    assert difflpv("info", "cornell") == 0
    out, err = capsys.readouterr()
    assert err == "" and "32 x 32 x 32 cells of 0.375 m" in out and "area 'light': radiance (17, 12, 4) W/(m2 sr)" in out
    assert difflpv("info", write_obj(tmp_path)) == 0
    assert "tiles: albedo (0.5, 0.5, 1) x texture 2 x 2" in capsys.readouterr().out


def test_info_of_point_spot_and_directional_lights(tmp_path, capsys):
    gltf = small_gltf()
    gltf.node(translation=[0, 0, 1], **gltf.light(type="point", name="bulb", intensity=2.0))
    gltf.node(**gltf.light(type="directional", name="sun", intensity=3.0))
    gltf.node(**gltf.light(type="spot", name="beam", intensity=4.0, spot={"outerConeAngle": 0.5}))
    (tmp_path / "lights.glb").write_bytes(gltf.glb())
    assert difflpv("info", tmp_path / "lights.glb") == 0
    out = capsys.readouterr().out
    assert "point 'bulb' at (0, 0, 1) m: intensity (2, 2, 2) W/sr" in out
    assert "directional 'sun' along (-0, -0, -1): irradiance (3, 3, 3) W/m2" in out and "spot 'beam'" in out
