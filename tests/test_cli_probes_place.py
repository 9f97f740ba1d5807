"""``difflpv probes place``: what it writes, that it goes on after an interruption, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from cli_room import difflpv, write_room

import data_gen.probe_targets as probe_targets
from difflpv.cli.probes.place import CONTENTS, INTERPOLATIONS, METHODS
from difflpv.io import load_scene
from difflpv.placement.content import held_content, probe_record, training_error, with_fitted_content
from difflpv.placement.descent import Descent
from difflpv.placement.from_targets import placement_task
from difflpv.placement.place import PLACEMENT_METHODS, place
from difflpv.placement.reconstruction import Content
from difflpv.probes.probe_files import load_probes
from difflpv.probes.reader import InterpolationName

TINY = ("--count", 40, "--cells", 8, "--spp", 32, "--lattice-spp", 32)
SMALL = ("--count", 6, "--steps", 8, "--relocations", 1)


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> tuple[Path, Path]:
    """A scene and targets under its four light sets."""
    folder = tmp_path_factory.mktemp("room")
    scene = write_room(folder)
    out = folder / "targets"
    assert difflpv("probes", "targets", scene, "--lights", folder / "sets.json", *TINY, "--out", out) == 0
    return scene, out


@pytest.fixture(scope="module")
def task(room):
    scene = load_scene(room[0])
    return placement_task(scene, probe_targets.load_probe_targets(room[1]))


def placed(room, out, *arguments) -> int:
    return difflpv("probes", "place", room[0], "--targets", room[1], "--out", out, *arguments)


def test_choices_are_those_of_the_library() -> None:
    assert METHODS == PLACEMENT_METHODS  # written out in the command, whose help loads no torch
    assert set(INTERPOLATIONS) == set(InterpolationName.__args__) and set(CONTENTS) == set(Content.__args__)


def test_writes_the_probes_that_the_library_places(room, task, tmp_path, capsys) -> None:
    out = tmp_path / "probes"
    assert placed(room, out, *SMALL, "--seed", 2, "--bake", 1, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    record, expected = load_probes(out), place(task, 6, "gradient", seed=2, steps=8, relocations=1)
    assert np.array_equal(record.probes.position, expected.position)
    assert np.array_equal(record.probes.radiance, expected.radiance[:, :, 3:6])
    assert record.method == "gradient" and record.scene["name"] == "room"
    assert record.errors["training"] == pytest.approx(expected.details["training_error"], rel=1e-9)
    known = record.provenance
    assert (known["light"], known["content"], known["interrupted"]) == (1, "fitted", False)
    assert known["targets"]["folder"] == str(room[1]) and known["request"]["options"] == {"relocations": 1, "steps": 8}
    assert known["evaluations"] == expected.evaluations and known["seconds"] > 0
    assert [row[0] for row in known["history"]] == list(range(len(expected.history)))
    assert (told["command"], told["probes"], told["recognised"]) == ("probes place", 6, False)
    assert told["training_error"] == record.errors["training"]
    assert placed(room, out, *SMALL, "--seed", 2, "--bake", 1) == 0  # there already
    assert "already there, nothing repeated: 6 probes by gradient" in capsys.readouterr().out
    assert placed(room, out, *SMALL, "--seed", 2) == 0  # another light of the same probes: from the checkpoint
    assert "they hold the light of set 0" in capsys.readouterr().out
    assert np.array_equal(load_probes(out).probes.radiance, expected.radiance[:, :, :3])
    assert load_probes(out).provenance["evaluations"] == expected.evaluations  # of all runs together


def test_goes_on_after_an_interruption_to_the_same_bits(room, tmp_path, monkeypatch, capsys) -> None:
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    assert placed(room, whole, *SMALL) == 0
    run, calls = Descent.run, []

    def stopped(self, *arguments, **options):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return run(self, *arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Descent, "run", stopped)
        assert placed(room, broken, *SMALL) == 130
    assert "interrupted, the best so far: 6 probes" in capsys.readouterr().out
    assert load_probes(broken).provenance["interrupted"]
    done = []
    monkeypatch.setattr(Descent, "run", lambda *a, **o: (done.append(1), run(*a, **o))[1])
    assert placed(room, broken, *SMALL) == 0
    assert len(done) == 1  # two of the three parts were done
    first, second = load_probes(whole), load_probes(broken)
    assert np.array_equal(first.probes.position, second.probes.position)
    assert np.array_equal(first.probes.radiance, second.probes.radiance)
    assert first.provenance["evaluations"] == second.provenance["evaluations"]
    assert not second.provenance["interrupted"]


def test_another_request_replaces_only_when_asked_to(room, tmp_path, capsys) -> None:
    out = tmp_path / "probes"
    assert placed(room, out, "--method", "grid", "--count", 8) == 0
    grid = load_probes(out)
    assert placed(room, out, "--method", "grid", "--count", 27) == 2
    assert "holds probes of another request (different count)" in capsys.readouterr().err
    assert placed(room, out, "--method", "grid", "--count", 27, "--overwrite") == 0
    assert len(load_probes(out).probes) > len(grid.probes)
    (out / "probes.json").unlink()  # broken off before anything was written: the checkpoint tells
    assert placed(room, out, *SMALL) == 0
    (out / "probes.json").unlink()
    assert placed(room, out, *SMALL, "--seed", 1) == 2
    error = capsys.readouterr().err
    assert "seed is 0 there and 1 here" in error and error.count("\n") == 1
    assert placed(room, out, *SMALL, "--seed", 1, "--overwrite") == 0


def test_ends_with_few_probes_where_few_meet_the_tolerance(room, tmp_path, capsys) -> None:
    options = ("--steps", 4, "--relocations", 0, "--tolerance", 0.99, "--count", 30)
    assert placed(room, tmp_path / "few", *options, "--lights", "0-1") == 0
    text = capsys.readouterr().out
    assert "tolerance 0.99 met: error 0." in text and "95% confidence, under lights that placed, too few" in text
    record = load_probes(tmp_path / "few")
    assert len(record.probes) < 8 and record.provenance["details"]["held_out_error"] <= 0.99
    assert placed(room, tmp_path / "unseen", *options, "--tolerance", 0.01, "--count", 8) == 0
    assert "confidence, under 1 light set(s) held out" in capsys.readouterr().out


def test_options_reach_the_placement(room, tmp_path) -> None:
    out = tmp_path / "probes"
    options = ("--content", "field", "--region=-1,-1,0.1,-0.2,1,0.6", "--reach", 0.4, "--edge-rays", "--sight")
    assert placed(room, out, *SMALL, *options, "--lights", "2-3") == 0
    record = load_probes(out)
    request = record.provenance["request"]
    assert request["options"] == {
        "content": "field", "reach": 0.4, "coverage": 1.0, "sight": True, "regions": [[[-1, -1, 0.1], [-0.2, 1, 0.6]]],
    } | {"steps": 8, "relocations": 1}  # fmt: skip
    assert record.method == "gradient+edge_rays" and record.provenance["light"] == 2
    own = record.probes.position[:6]
    assert (own >= [-1, -1, 0.1]).all() and (own <= [-0.2, 1, 0.6]).all()
    task = placement_task(load_scene(room[0]), probe_targets.load_probe_targets(room[1]), lights=[2])
    with_field = task.field(torch.as_tensor(np.array(record.probes.position))).numpy()
    np.testing.assert_allclose(record.probes.radiance, with_field, rtol=1e-12)


def test_footprints_come_along(room, tmp_path) -> None:
    out = tmp_path / "probes"
    assert placed(room, out, *SMALL, "--interpolation", "gaussian") == 0
    record = load_probes(out)
    assert record.reader.interpolation == "gaussian" and record.reader.metric.shape == (6, 3, 3)


def test_targets_are_made_where_there_are_none(room, tmp_path, monkeypatch, capsys) -> None:
    made = []
    real = probe_targets.make_probe_targets

    def tiny(scene, folder, **options):
        made.append(options)
        return real(scene, folder, count=40, cells=4, spp=32, lattice_spp=32)

    monkeypatch.setattr(probe_targets, "make_probe_targets", tiny)
    options = ("--out", tmp_path / "out", "--method", "grid", "--count", 8, "--workers", 2)
    assert difflpv("probes", "place", room[0], *options) == 0
    assert made == [{"workers": 2, "progress": None}]
    assert probe_targets.load_probe_targets(tmp_path / "out" / "targets").points.shape == (40, 3)
    assert difflpv("probes", "place", room[0], *options) == 0 and len(made) == 2
    assert "already there" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--count", 0], "argument --count: expected a whole number >= 1, got '0'"),
        (["--tolerance", 2], "argument --tolerance: expected a share between 0 and 1, got '2'"),
        (["--region", "0,0,0,1,0,1"], "argument --region: expected x0,y0,z0,x1,y1,z1 with each first number below"),
        (["--region", "0,0,nan,1,1,1"], "argument --region: expected x0,y0,z0,x1,y1,z1"),
        (["--region", "7,7,7,8,8,8"], "no probe lies in free space"),
        (["--method", "grid", "--steps", 5], "grid: no option 'steps'; its options are spread"),
        (["--lights", "3-4"], "--lights: 4 is out of range"),
        (["--lights", "1", "--bake", 0], "--bake: expected one of the light sets 1, got 0"),
        (["--edge-rays", "--interpolation", "gaussian"], "--edge-rays: belongs to --interpolation tetrahedra"),
        (["--method", "best"], "argument --method: invalid choice: 'best'"),
    ],
)
def test_errors_are_one_line(arguments, message, room, tmp_path, capsys) -> None:
    assert placed(room, tmp_path / "out", *arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (tmp_path / "out" / "probes.json").exists()


def test_targets_that_do_not_fit_are_one_line(room, tmp_path, capsys) -> None:
    (tmp_path / "empty").mkdir()
    for scene, targets, message in (
        (room[0], tmp_path / "empty", "empty"),
        (room[0], tmp_path / "mistyped", "mistyped: no such folder"),
        (tmp_path / "none.glb", room[1], "none.glb"),
        ("cornell", room[1], "targets belong to another scene: made for 'room'"),
    ):
        assert difflpv("probes", "place", scene, "--targets", targets, "--out", tmp_path / "out") == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_record_says_how_good_the_content_is(task) -> None:
    grid = place(task, 8, "grid")
    fitted = with_fitted_content(task, grid)
    assert np.array_equal(held_content(task, fitted), fitted.radiance) and grid.radiance is None
    assert training_error(task, fitted) < training_error(task, grid)
    record = probe_record(task, fitted, light=3, provenance={"seconds": -1, "note": "kept"})
    assert np.array_equal(record.probes.radiance, fitted.radiance[:, :, 9:])
    assert record.errors["training"] == training_error(task, fitted)
    assert record.provenance["seconds"] == fitted.seconds and record.provenance["note"] == "kept"
    with pytest.raises(ValueError, match="light: expected a number from 0 to 3, got 4"):
        probe_record(task, fitted, light=4)
