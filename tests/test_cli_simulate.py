"""``targets``, ``simulate`` and ``render`` on a small room."""

import json

import numpy as np
import pytest
from cli_room import difflpv, make_targets, write_room
from PIL import Image

from data_gen.cells import trace_volume
from data_gen.load import load_targets
from difflpv.config import LpvConfig, grid_for
from difflpv.illumination import illuminate
from difflpv.io import load_scene
from difflpv.io.exr import read_exr
from difflpv.io.tables import load_receivers, load_table, save_table
from difflpv.lights import apply_light_set, load_light_sets
from difflpv.pipeline import Lpv
from difflpv.simulate import read_volume, render, simulate


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room")
    scene = write_room(folder)
    make_targets(folder, scene, "--images", "--image-spp", 8)
    return folder


@pytest.fixture
def table(room):
    return room / "targets" / "light_1.npz"


def run_json(capsys, *arguments):
    capsys.readouterr()
    assert difflpv(*arguments, "--json") == 0
    out, err = capsys.readouterr()
    assert out.count("\n") == 1
    return json.loads(out), err


def test_targets_are_recognised_and_guarded(room, capsys):
    scene = room / "room.glb"
    capsys.readouterr()
    make_targets(room, scene, "--images", "--image-spp", 8)
    assert "already there, nothing repeated: 40 receivers, 4 light(s)" in capsys.readouterr().out
    command = ["targets", scene, "--receivers", 40, "--spp", 512, "--out", room / "targets"]
    assert difflpv(*command) == 2
    err = capsys.readouterr().err
    assert "holds targets of another request (different lights, components, sampling" in err and err.count("\n") == 1


def test_targets_of_some_lights_as_json(room, tmp_path, capsys):
    content, err = run_json(
        capsys, "targets", room / "room.glb", "--lights", room / "sets.json", "--light", "1-2", "--receivers", 8, "--spp", 32,
        "--component", "direct", "--probes", 2, "--probe-spp", 32, "--out", tmp_path / "t",
    )  # fmt: skip
    assert err == "" and [row["set"] for row in content["lights"]] == [1, 2] and not content["recognised"]
    assert content["receivers"] == 8 and set(content["lights"][0]["error"]) == {"direct"}
    targets = load_targets(tmp_path / "t")
    assert targets.lights[1].entries[0]["radiance"] == [6.0, 6.0, 6.0] and len(targets.probe_positions) == 2


def test_targets_at_given_receivers_and_an_unreached_goal(room, table, tmp_path, capsys):
    command = ["targets", room / "room.glb", "--receivers", table, "--component", "bounce1", "--out", tmp_path / "t"]
    assert difflpv(*command, "--target-error", "0.0001", "--max-spp", "32") == 0
    out, err = capsys.readouterr()
    assert "standard error over mean: bounce1" in out and "after" in err and "asked for 0.0001" in err
    assert np.array_equal(load_targets(tmp_path / "t").receivers.position, load_receivers(table).position)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--receivers", "0"], "--receivers: expected a whole number >= 1, got '0'"),
        (["--receivers", "none.npz"], "none.npz: no such file"),
        (["--component", "glow"], "component 'glow': expected direct, bounce1"),
        (["--light", "0"], "--light: needs --lights SETS.json (or --lights bundled)"),
        (["--lights", "SETS", "--light", "2-4"], "--light: 4 is out of range, SETS has 4 light sets (0-3)"),
        (["--lights", "bundled"], "light_sets.json: no light sets for scene 'room', the file has"),
        (["--spp", "5", "--target-error", "0.1"], "argument --target-error: not allowed with argument --spp"),
        (["--target-error", "2"], "argument --target-error: expected a share between 0 and 1, got '2'"),
        (["--workers", "0"], "argument --workers: expected a whole number >= 1, got '0'"),
    ],
)
def test_bad_options_of_targets(room, tmp_path, capsys, arguments, message):
    sets = str(room / "sets.json")
    arguments = [sets if a == "SETS" else a for a in arguments]
    assert difflpv("targets", room / "room.glb", "--out", tmp_path / "t", *arguments) == 2
    err = capsys.readouterr().err
    assert message.replace("SETS has", f"{sets} has") in err and err.count("\n") == 1


def test_prediction_is_that_of_the_function(room, table, tmp_path, capsys):
    out = tmp_path / "new" / "prediction.npz"
    command = ["simulate", room / "room.glb", "--method", "lpv", "--component", "bounce1", "--steps", 4, "--grid", 8,
               "--lights", room / "sets.json", "--light", 1, "--receivers", table, "--out", out, "--seed", 3]  # fmt: skip
    content, err = run_json(capsys, *command)
    got, scene, asked = load_table(out), load_scene(room / "room.glb"), load_receivers(table)
    assert set(got) == {"position", "normal", "irradiance", "area_weight", "albedo"}
    entries = load_light_sets(room / "sets.json", "room")[1]
    expected = simulate(
        apply_light_set(scene, entries), asked.position, asked.normal, grid=grid_for(scene, 8),
        config=LpvConfig(method="lpv", steps=4), component="bounce1", seed=3,
    )  # fmt: skip
    assert np.array_equal(got["irradiance"], expected.irradiance) and err == ""
    assert content["config"]["steps"] == 4 and content["receivers"] == 40
    constant, lpv = content["scores"]
    assert (constant["method"], lpv["method"], lpv["light"]) == ("constant", "lpv", 1)
    weight, truth = asked.area_weight[:, None], asked.extras["irr_bounce1"]
    error = np.sqrt((weight * (got["irradiance"] - truth) ** 2).sum() / (weight * truth**2).sum())
    assert lpv["relative_l2"] == pytest.approx(error)
    assert difflpv(*command) == 0
    assert "lpv     " in capsys.readouterr().out


def test_a_table_without_weight_and_truth(room, table, tmp_path, capsys):
    asked = load_receivers(table)
    save_table(tmp_path / "bare.npz", position=asked.position, normal=asked.normal)
    content, _ = run_json(
        capsys, "simulate", room / "room.glb", "--steps", 2, "--no-clamp", "--deposit", "trilinear", "--occlusion", "none",
        "--receivers", tmp_path / "bare.npz", "--out", tmp_path / "p.npz",
    )  # fmt: skip
    assert content["scores"] == [] and set(load_table(tmp_path / "p.npz")) == {"position", "normal", "irradiance"}
    assert content["config"] == LpvConfig(steps=2, clamp=False, deposit="trilinear").to_json()


def test_the_truth_of_another_light_judges_nothing(room, table, tmp_path, capsys):
    """A table of targets is the truth under its own light set; one that stands apart from them is taken at its word."""
    command = ["simulate", room / "room.glb", "--steps", 4, "--out", tmp_path / "p.npz"]
    content, err = run_json(capsys, *command, "--receivers", table)
    assert content["scores"] == [] and "the truth under another scene or light set" in content["warnings"][-1]
    assert f"warning: {table}: the truth under" in err
    lights = ("--lights", room / "sets.json", "--light", 1)
    content, _ = run_json(capsys, *command, *lights, "--receivers", table)
    assert len(content["scores"]) == 2 and content["warnings"] == []
    save_table(tmp_path / "light_1.npz", **load_table(table))
    content, _ = run_json(capsys, *command, "--receivers", tmp_path / "light_1.npz")
    assert len(content["scores"]) == 2


def test_a_truth_that_is_no_number_is_told(room, table, tmp_path, capsys):
    columns = load_table(table)
    columns["irr_bounce1"][3, 1] = np.nan
    np.savez(tmp_path / "t.npz", **columns)
    command = ["simulate", room / "room.glb", "--steps", 4, "--receivers", tmp_path / "t.npz", "--out", tmp_path / "p.npz"]
    content, _ = run_json(capsys, *command)
    assert content["scores"] == [] and content["warnings"] == [
        f"{tmp_path / 't.npz'}: irr_bounce1: row 3 is not finite, no error is told"
    ]
    save_table(tmp_path / "t.npz", **columns | {"irr_bounce1": np.zeros((40, 3))})
    content, _ = run_json(capsys, *command)
    assert content["warnings"] == [f"{tmp_path / 't.npz'}: irr_bounce1 is 0 everywhere, no relative error is told"]


@pytest.mark.parametrize("command", ["simulate", "render"])
def test_a_place_where_nothing_can_be_written_is_told_before_the_work(command, room, table, tmp_path, capsys, monkeypatch):
    for name in ("difflpv.simulate.simulate", "difflpv.simulate.render"):
        monkeypatch.setattr(name, None)
    (tmp_path / "file").touch()
    (tmp_path / "folder.npz").mkdir()
    (tmp_path / "folder.exr").mkdir()
    suffix = {"simulate": ".npz", "render": ".exr"}[command]
    own = [command, room / "room.glb", *(["--receivers", table] if command == "simulate" else [])]
    for out, message in (
        (tmp_path / "file" / f"a{suffix}", f"--out: folder {tmp_path / 'file'} cannot be made: "),
        (tmp_path / f"folder{suffix}", f"--out: expected a file, {tmp_path / f'folder{suffix}'} is a folder"),
    ):
        assert difflpv(*own, "--out", out) == 2
        err = capsys.readouterr().err
        assert err.startswith(f"difflpv: error: {message}") and err.count("\n") == 1
    monkeypatch.setattr("os.access", lambda path, mode: False)
    assert difflpv(*own, "--out", tmp_path / f"a{suffix}") == 2
    assert capsys.readouterr().err == f"difflpv: error: --out: folder {tmp_path} cannot be written to\n"


def test_the_table_that_is_read_is_not_replaced(room, table, capsys):
    before = table.read_bytes()
    assert difflpv("simulate", room / "room.glb", "--steps", 2, "--receivers", table, "--out", table) == 2
    assert "is the table of --receivers and would be lost" in capsys.readouterr().err and table.read_bytes() == before


def test_constant_is_the_weighted_mean_of_the_targets(room, table, tmp_path, capsys):
    command = ["simulate", room / "room.glb", "--method", "constant", "--receivers", table, "--out", tmp_path / "c.npz"]
    content, _ = run_json(capsys, *command, "--targets", room / "targets", "--light", 1)
    light = load_targets(room / "targets").lights[1]
    mean = np.average(light.irradiance["bounce1"], axis=0, weights=light.area_weight)
    np.testing.assert_allclose(load_table(tmp_path / "c.npz")["irradiance"], np.tile(mean, (40, 1)))
    assert [s["scale"] for s in content["scores"]] == [pytest.approx(1)]


def test_the_floor_reads_the_true_light_and_keeps_it(room, table, tmp_path, capsys, monkeypatch):
    """One command path-traces it beside the output; another lookup, an image and tables of other methods find it again."""
    command = ["simulate", room / "room.glb", "--method", "floor", "--component", "direct", "--lights", room / "sets.json",
               "--light", 1, "--receivers", table, "--out", tmp_path / "f.npz"]  # fmt: skip
    content, err = run_json(capsys, *command, "--spp", 2048)
    scene, asked = load_scene(room / "room.glb"), load_receivers(table)
    lit = apply_light_set(scene, load_light_sets(room / "sets.json", "room")[1])
    volume = trace_volume(lit, grid_for(scene), "direct", spp=2048).mean
    light = illuminate(lit, grid_for(scene), LpvConfig(lookup="affine"), "direct")
    expected = read_volume(volume, light, asked.position, asked.normal)
    np.testing.assert_allclose(load_table(tmp_path / "f.npz")["irradiance"], expected, rtol=1e-4, atol=1e-4)
    constant, floor = content["scores"]
    assert floor["method"] == "floor" and floor["relative_l2"] < 0.6 * constant["relative_l2"]
    assert len(list((tmp_path / "floor").iterdir())) == 1
    monkeypatch.setattr("data_gen.cells.trace_volume", None)
    other, _ = run_json(capsys, *command, "--lookup", "trilinear")
    assert other["scores"][1]["relative_l2"] != floor["relative_l2"]
    render = ["render", *command[1:8], "--out", tmp_path / "image.exr"]
    assert difflpv(*render, "--light", 1) == 0 and read_exr(tmp_path / "image.exr")[0]["R"].max() > 0


def test_noise_of_the_floor_is_told(room, table, tmp_path, capsys):
    command = ["simulate", room / "room.glb", "--method", "floor", "--receivers", table, "--out", tmp_path / "f.npz"]
    content, err = run_json(capsys, *command, "--spp", 32)
    assert "floor: 32 paths per cell leave a noise of" in content["warnings"][0] and "--spp" in err


def test_lost_light_is_told(tmp_path, table, capsys):
    """A grid that ends inside the room: the share of lost VPLs, and the receivers outside."""
    scene = write_room(tmp_path, "cut", grid_low=(0.0, -1.5, -0.6))
    command = ["simulate", scene, "--component", "direct", "--steps", 2, "--receivers", table, "--out", tmp_path / "p.npz"]
    content, err = run_json(capsys, *command)
    assert "m does not contain the scene: 32 VPLs with 50 % of the flux are lost" in content["warnings"][0]
    assert err == "".join(f"warning: {line}\n" for line in content["warnings"]) and "receivers lie outside" in err


def test_an_image_has_named_channels_and_a_preview(room, tmp_path, capsys):
    out = tmp_path / "image.exr"
    content, _ = run_json(capsys, "render", room / "room.glb", "--steps", 2, "--method", "lpv", "--out", out)
    channels, metadata = read_exr(out)
    assert set(channels) == {"R", "G", "B", *(f"{c}.{x}" for c in ("direct", "bounce1") for x in "RGB")}
    assert channels["R"].shape == (12, 16) and metadata["method"] == "lpv" and content["width"] == 16
    np.testing.assert_allclose(channels["G"], channels["direct.G"] + channels["bounce1.G"], rtol=1e-6)
    assert channels["R"].max() > 0
    with Image.open(content["preview"]) as preview:
        assert preview.size == (16, 12)
    assert difflpv("render", room / "room.glb", "--steps", 2, "--component", "bounce1", "--exposure", "-1", "--out", out) == 0
    assert "bounce1.R" in read_exr(out)[0] and "direct.R" not in read_exr(out)[0]
    scene = load_scene(room / "room.glb")
    config = LpvConfig(steps=2)
    expected, _ = render(Lpv(grid_for(scene), config), illuminate(scene, grid_for(scene), config, "bounce1"))
    np.testing.assert_allclose(read_exr(out)[0]["R"], expected[:, :, 0], rtol=1e-6)


def test_an_image_of_the_constant(room, tmp_path, capsys):
    out = tmp_path / "constant.exr"
    command = ["render", room / "room.glb", "--method", "constant", "--component", "bounce1", "--out", out]
    assert difflpv(*command, "--targets", room / "targets", "--light", 2) == 0
    light = load_targets(room / "targets").lights[2]
    mean = np.average(light.irradiance["bounce1"], axis=0, weights=light.area_weight)
    shown = np.unique(read_exr(out)[0]["R"].round(6))
    np.testing.assert_allclose(shown[shown > 0], mean[0] * 0.7 / np.pi, rtol=1e-4)


BAD = {
    "method": (["--method", "radiosity"], "argument --method: invalid choice: 'radiosity'"),
    "steps": (["--steps", "-1"], "argument --steps: expected a whole number >= 0, got '-1'"),
    "spp": (["--spp", "64"], "--spp: only --method floor traces paths, got --method holpv"),
    "floor": (["--method", "floor", "--steps", "4"], "--steps: --method floor solves nothing, only --grid, --lookup and"),
    "grid": (["--grid", "2"], "grid: expected at least 3 cells, got 2"),
    "lights": (["--lights", "SETS"], "--lights: choose one of the 4 light sets with --light 0..3"),
    "light": (["--lights", "SETS", "--light", "4"], "--light: 4 is out of range, SETS has 4 light sets (0-3)"),
    "alone": (["--light", "0"], "--light: needs --lights"),
    "constant": (["--method", "constant"], "--method constant: needs --targets DIR"),
    "targets": (["--targets", "x"], "--targets: only --method constant takes its mean from targets"),
    "which": (["--method", "constant", "--targets", "DIR"], "--targets: choose one of the 4 light sets with --light"),
    "device": (["--device", "tpu"], "--device: expected auto, cpu, cuda or cuda:N, got 'tpu'"),
    "fitted": (["--fitted", "nowhere"], "nowhere/fitted.json: not found: expected a folder written by 'difflpv fit'"),
}


@pytest.mark.parametrize("name", BAD)
@pytest.mark.parametrize("command", ["simulate", "render"])
def test_bad_options(command, name, room, table, tmp_path, capsys):
    arguments, message = BAD[name]
    sets = str(room / "sets.json")
    arguments = [{"SETS": sets, "DIR": str(room / "targets")}.get(a, a) for a in arguments]
    own = {"simulate": ["--receivers", table, "--out", tmp_path / "p.npz"], "render": ["--out", tmp_path / "p.exr"]}[command]
    assert difflpv(command, room / "room.glb", *own, *arguments) == 2
    out, err = capsys.readouterr()
    assert out == "" and message.replace("SETS", sets) in err and err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_bad_files(room, table, tmp_path, capsys):
    scene = room / "room.glb"
    (tmp_path / "file").write_text("")
    asked = load_receivers(table)
    save_table(tmp_path / "long.npz", position=asked.position, normal=2 * asked.normal)
    for arguments, message in (
        (["simulate", scene, "--receivers", "none.npz", "--out", "p.npz"], "none.npz: no such file"),
        (["simulate", scene, "--receivers", scene, "--out", "p.npz"], "not a readable .npz table"),
        (["simulate", scene, "--receivers", table, "--out", "p.csv"], "--out: expected a file name ending in .npz, got p.csv"),
        (["simulate", scene, "--receivers", table, "--out", tmp_path / "file" / "p.npz", "--steps", 4], "--out: folder"),
        (["simulate", scene, "--receivers", tmp_path / "long.npz", "--out", "p.npz"], "normal: expected unit length, row 0"),
        (["render", scene, "--out", "p.png"], "--out: expected a file name ending in .exr, got p.png"),
        (["render", scene, "--camera", 3, "--out", "p.exr"], "--camera: 3 is out of range, scene 'room' has 1 camera(s)"),
        (["render", scene, "--exposure", "1e9", "--out", "p.exr"], "--exposure: expected stops in -100..100"),
        (["evaluate", "cornell", "--targets", room / "targets"], "targets belong to another scene: made for 'room'"),
        (["evaluate", scene, "--targets", tmp_path], "no manifest.json: not targets, or not finished"),
    ):
        assert difflpv(*arguments) == 2
        err = capsys.readouterr().err
        assert message in err and err.count("\n") == 1, err
