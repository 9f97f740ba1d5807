"""``difflpv probes``: the group, its targets and its export."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_room import difflpv, write_room

from data_gen.probe_targets import load_probe_targets
from difflpv.cli.probes import SUBCOMMANDS
from difflpv.cli.probes.export import FORMATS
from difflpv.io.exports import EXPORT_FORMATS
from difflpv.probes.probe_files import ProbeRecord, load_probes, save_probes
from difflpv.probes.probe_set import ProbeSet
from difflpv.probes.reader import ProbeReader


@pytest.fixture
def folder(tmp_path) -> Path:
    rng = np.random.default_rng(1)
    probes = ProbeSet(rng.normal(size=(6, 3)), rng.normal(size=(6, 9, 3)), np.arange(6) != 2)
    save_probes(tmp_path / "probes", ProbeRecord(probes, {"name": "box", "hash": "ab"}))
    return tmp_path / "probes"


def test_group_names_its_subcommands(capsys) -> None:
    assert difflpv("probes", "--help") == 0
    text = capsys.readouterr().out
    assert all(re.search(rf"^ +{name.replace('_', '-')}\b", text, re.M) for name in SUBCOMMANDS)
    assert difflpv("probes") == 2
    told = "the following arguments are required: COMMAND (see 'difflpv probes --help')"
    assert capsys.readouterr().err == f"difflpv: error: {told}\n"


@pytest.mark.parametrize("name", SUBCOMMANDS)
def test_each_subcommand_explains_itself_with_an_example(name, capsys) -> None:
    assert difflpv("probes", name.replace("_", "-"), "--help") == 0
    options, _, example = capsys.readouterr().out.partition("example:")
    assert f"difflpv probes {name.replace('_', '-')} " in example
    assert all(option in options for option in re.findall(r"--[a-z-]+", example))


def test_formats_are_those_of_the_library() -> None:
    assert FORMATS == EXPORT_FORMATS  # written out in the command, whose help loads no torch
    program = "import sys; from difflpv.cli import main; main(['probes', 'export', '--help']); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=60).returncode == 0


@pytest.mark.parametrize("format", FORMATS)
def test_export_writes_what_it_says(format, folder, tmp_path, capsys) -> None:
    out = tmp_path / {"threejs": "a.json", "gltf": "a.gltf", "exr": "a.exr"}.get(format, "a")
    assert difflpv("probes", "export", folder, "--format", format, "--out", out, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["command"], told["format"], told["probes"], told["invalid"]) == ("probes export", format, 5, 1)
    sizes = [Path(file).stat().st_size for file in told["files"]]
    assert all(sizes) and sum(sizes) == told["bytes"]
    assert difflpv("probes", "export", folder, "--format", format, "--out", out) == 0
    assert capsys.readouterr().out.startswith(f"5 probes (1 invalid ones left out) for {format} -> ")


def test_export_says_what_an_engine_does_with_footprints(folder, tmp_path, capsys) -> None:
    record = load_probes(folder)
    save_probes(folder, replace(record, reader=ProbeReader("gaussian", np.tile(np.eye(3), (6, 1, 1)))))
    line = "probes made to be read by Gaussian footprints of 8 neighbours: Unity blends in tetrahedra of its own"
    assert difflpv("probes", "export", folder, "--format", "unity", "--out", tmp_path / "a", "--json") == 0
    told = capsys.readouterr()
    assert told.err.startswith(f"warning: {line}") and told.err.count("\n") == 1
    assert json.loads(told.out)["warnings"][0].startswith(line)
    assert difflpv("probes", "export", folder, "--format", "gltf", "--out", tmp_path / "a.gltf", "--json") == 0
    told = capsys.readouterr()
    assert told.err == "" and json.loads(told.out)["warnings"] == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--format", "exr", "--mirror", "z"], "--mirror: belongs to --format unity, got --format exr"),
        (["--format", "unity", "--height", "4"], "--height: belongs to --format exr, got --format unity"),
        (["--format", "gltf"], "expected a file name ending in .gltf"),
        (["--format", "unreal"], "argument --format: invalid choice: 'unreal'"),
    ],
)
def test_errors_are_one_line(arguments, message, folder, tmp_path, capsys) -> None:
    assert difflpv("probes", "export", folder, *arguments, "--out", tmp_path / "a.out") == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


@pytest.mark.parametrize(("format", "out"), [("threejs", "probes.json"), ("exr", "probes.exr"), ("filament", "")])
def test_an_export_does_not_replace_what_it_reads(format, out, folder, capsys) -> None:
    before = {file: file.read_bytes() for file in folder.iterdir()}
    assert difflpv("probes", "export", folder, "--format", format, "--out", folder / out) == 2
    line = f"difflpv: error: {folder / 'probes.json'}: describes light probes of difflpv, which would be lost"
    error = capsys.readouterr().err
    assert error.startswith(line) and error.count("\n") == 1
    assert {file: file.read_bytes() for file in folder.iterdir()} == before
    assert difflpv("probes", "export", folder, "--format", "gltf", "--out", folder / "probes.gltf") == 0


def test_no_probes_there_is_one_line(tmp_path, capsys) -> None:
    assert difflpv("probes", "export", tmp_path, "--format", "gltf", "--out", tmp_path / "a.gltf") == 2
    assert capsys.readouterr().err.startswith(f"difflpv: error: {tmp_path / 'probes.json'}: not found: expected a folder")


TINY = ("--count", 6, "--cells", 3, "--spp", 32, "--lattice-spp", 32)


def test_targets_are_made_once_under_the_lights_that_are_named(tmp_path, capsys) -> None:
    scene, out = write_room(tmp_path), tmp_path / "made"
    for recognised in (False, True):
        assert difflpv("probes", "targets", scene, "--lights", tmp_path / "sets.json", *TINY, "--out", out, "--json") == 0
        told = json.loads(capsys.readouterr().out)
        assert (told["points"], told["surface_points"], told["recognised"]) == (6, 2, recognised)
        assert len(told["lights"]) == 4 and told["component"] == "bounce1"
    made = load_probe_targets(out)
    assert [entries[0]["radiance"] for entries in made.light_sets] == [[8.0 - k, 6.0, 4.0 + k] for k in range(4)]
    assert told["cells"] == list(made.grid.resolution) and told["free_cells"] == made.free.sum()
    assert difflpv("probes", "targets", scene, *TINY, "--out", out) == 2  # under its own lights: another request
    assert "another request (different lights)" in capsys.readouterr().err
    for lights, sets in (("3", 3), ("own", 1)):  # none are bundled with this room: its own, moved
        assert difflpv("probes", "targets", scene, "--lights", lights, *TINY, "--out", out, "--overwrite") == 0
        text = capsys.readouterr().out
        assert f"written: bounce1 of {sets} light set(s)" in text and "6 points, 2 of them over surfaces" in text
        assert len({repr(entries) for entries in load_probe_targets(out).light_sets}) == sets


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--lights", "0"], "--lights: expected a whole number >= 1, got '0'"),
        (["--lights", "bundled"], "no light sets for scene 'room'"),
        (["--surface-share", "1.5"], "--surface-share: expected a share from 0 to 1, got '1.5'"),
        (["--component", "bounce"], "component 'bounce': expected direct, bounce1"),
    ],
)
def test_errors_of_targets_are_one_line(arguments, message, tmp_path, capsys) -> None:
    assert difflpv("probes", "targets", write_room(tmp_path), *arguments, *TINY, "--out", tmp_path / "made") == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (tmp_path / "made").exists()
