"""Points and lights that judge probes, and ``difflpv probes evaluate`` and ``show``."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from cli_room import difflpv, write_room

from data_gen.load import TargetsError
from data_gen.probe_targets import make_probe_targets
from difflpv.cli.probes.judged import CONTENTS, PlacedProbes
from difflpv.io import load_scene
from difflpv.placement.held_out import BAKED_CONTENTS, HeldOut
from difflpv.placement.reconstruction import fitted_content
from difflpv.probes.probe_files import ProbeRecord, save_probes
from difflpv.probes.probe_set import DIRECTIONS_26, ProbeSet, irradiance_of
from difflpv.probes.reader import ProbeReader
from difflpv.report import scene_figures
from difflpv.report.probe_errors import error_picture

TINY = {"cells": 3, "spp": 64, "lattice_spp": 32, "component": "direct"}


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A room, targets A and B of it (one light set in common), and probes in a folder."""
    folder = tmp_path_factory.mktemp("held_out")
    path = write_room(folder)
    scene, sets = load_scene(str(path)), json.loads((folder / "sets.json").read_text())["room"]
    placing = make_probe_targets(scene, folder / "A", count=12, light_sets=sets[:2], **TINY)
    judging = make_probe_targets(scene, folder / "B", count=40, light_sets=sets[1:], seed=1, **TINY)
    probes = ProbeSet(placing.points[:6], np.ones((6, 9, 3)))
    described = {"name": scene.name, "hash": scene.hash}
    save_probes(folder / "probes", ProbeRecord(probes, described, "by hand", {}, {"seconds": 2.5}))
    return folder, scene, placing, judging


def test_lights_that_placed_do_not_judge_and_points_are_split(world):
    _, scene, placing, judging = world
    held_out = HeldOut.of(scene, judging, placing)
    assert held_out.left_out == (0,) and held_out.lights == (1, 2)
    assert HeldOut.of(scene, judging).lights == (0, 1, 2)
    fit, judge = held_out.fit.points.numpy(), held_out.judge.points.numpy()
    assert (len(fit), len(judge)) == (30, 10)  # of 30 in free space and 10 over surfaces, of both
    assert held_out.surface.sum() in (2, 3) and len(held_out.surface) == 10
    everything = np.concatenate([fit, judge])
    assert len(np.unique(everything, axis=0)) == 40
    np.testing.assert_array_equal(judge[held_out.surface], [p for p in judging.points[-10:] if p.tolist() in judge.tolist()])
    which = [judging.points.tolist().index(p) for p in judge.tolist()]
    expected = np.concatenate([judging.radiance[k][which] for k in (1, 2)], axis=2)
    np.testing.assert_array_equal(held_out.judge.radiance.numpy(), expected)
    # the noise is that of irradiance, drawn
    spread = np.concatenate([judging.standard_error[k][which] for k in (1, 2)], axis=2)
    drawn = np.random.default_rng(0).normal(size=(2000, *spread.shape)) * spread
    noise = np.sqrt((irradiance_of(drawn, DIRECTIONS_26) ** 2).sum((1, 2, 3)).mean())
    assert held_out.noise == pytest.approx(noise / np.linalg.norm(irradiance_of(expected, DIRECTIONS_26)), rel=0.03)


def test_targets_that_cannot_judge_are_refused(world, tmp_path):
    _, scene, placing, judging = world
    with pytest.raises(TargetsError, match=r"A: has points of .*A: make them with another seed"):
        HeldOut.of(scene, placing, placing)
    same_lights = make_probe_targets(scene, tmp_path / "C", count=4, light_sets=judging.light_sets[:1], seed=2, **TINY)
    with pytest.raises(TargetsError, match="all light sets placed the probes"):
        HeldOut.of(scene, same_lights, judging)
    with pytest.raises(TargetsError, match="expected bounce1, which placed"):
        HeldOut.of(scene, judging, replace(placing, component="bounce1"))


def test_content_is_traced_at_the_probes_and_fitting_takes_only_the_first_part(world):
    _, scene, placing, judging = world
    held_out, reader = HeldOut.of(scene, judging, placing), ProbeReader()
    position = judging.points[:5]
    traced = held_out.traced(position, spp=512)
    assert traced.shape == (5, 9, 6) and torch.equal(traced, held_out.traced(position, spp=512))
    expected = np.concatenate([judging.radiance[k][:5] for k in (1, 2)], axis=2)
    assert np.linalg.norm(traced.numpy() - expected) < 0.3 * np.linalg.norm(expected)
    fitted = held_out.fitted(position, reader, traced)
    black = replace(held_out, judge=replace(held_out.judge, radiance=0 * held_out.judge.radiance))
    assert torch.equal(fitted, black.fitted(position, reader, traced))
    rows = reader.over(position, scene).rows(torch.as_tensor(position), held_out.fit.points)

    def residual(content):
        return float((irradiance_of(rows.apply(content) - held_out.fit.radiance, DIRECTIONS_26)).norm())

    assert residual(fitted) < residual(traced)
    kept = fitted_content(held_out.fit, torch.as_tensor(position), rows, ridge=1e9, toward=traced)
    torch.testing.assert_close(kept, traced, rtol=1e-6, atol=1e-6)


def test_evaluate_prints_the_table_and_says_what_is_unseen(world, capsys):
    folder, _, _, _ = world
    command = ("probes", "evaluate", folder / "room.glb", folder / "probes", folder / "probes", "--targets", folder / "B")
    assert difflpv(*command, "--placed-by", folder / "A", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["points"], told["lights"], told["left_out"], told["content"]) == (10, [1, 2], [0], "fitted")
    first, second = told["probes"]
    assert first["error"] == second["error"] > 0 and first["in_solids"] == 0 and first["seconds"] == 2.5
    assert (first["method"], first["count"], first["bytes"]) == ("by hand", 6, 6 * 120)
    assert difflpv(*command, "--placed-by", folder / "A", "--content", "traced") == 0
    text = capsys.readouterr().out
    assert "Judged at 10 points that placed no probes and fitted nothing" in text and "left out, because they did: 0." in text
    assert text.count("by hand") == 2 and "Content traced." in text
    assert difflpv(*command) == 0
    assert "which lights placed the probes is not known without --placed-by" in capsys.readouterr().out


def test_show_draws_one_or_two_panels_and_sums_up(world, tmp_path, capsys):
    folder, _, _, _ = world
    figure = tmp_path / "new" / "a.png"
    command = ("probes", "show", folder / "room.glb", folder / "probes", "--out", figure)
    assert difflpv(*command) == 0
    text = capsys.readouterr().out
    assert "6 probes, by hand: " in text and text.endswith(f"-> {figure}\n")
    alone = figure.read_bytes()
    assert difflpv(*command, "--targets", folder / "B", "--placed-by", folder / "A", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["probes"] == 6 and told["lights"] == [1, 2] and told["error"] > 0
    assert len(figure.read_bytes()) > 1.2 * len(alone)


def test_footprints_of_a_file_are_what_judges_read_and_tetrahedra_are_not_drawn(world, tmp_path, capsys, monkeypatch):
    folder, scene, placing, _ = world
    position, valid = np.insert(placing.points[:6], 2, 99.0, axis=0), np.arange(7) != 2
    metric = np.random.default_rng(0).normal(size=(7, 3, 3))
    reader, described = ProbeReader("gaussian", metric, neighbours=5), {"name": scene.name, "hash": scene.hash}
    save_probes(tmp_path, ProbeRecord(ProbeSet(position, np.ones((7, 9, 3)), valid), described, reader=reader))
    placed = PlacedProbes.of(tmp_path, scene)
    np.testing.assert_array_equal(placed.position, placing.points[:6])
    np.testing.assert_array_equal(placed.reader.metric, metric[valid])
    assert (placed.reader.interpolation, placed.reader.neighbours) == ("gaussian", 5)
    drawn = []
    monkeypatch.setattr(scene_figures, "probe_picture", lambda scene, probes, *, edges: drawn.append(edges))
    monkeypatch.setattr(scene_figures, "draw_pictures", lambda pictures, titles: b"")
    assert difflpv("probes", "show", folder / "room.glb", tmp_path, "--out", tmp_path / "a.png") == 0
    assert "read by Gaussian footprints of 5 neighbours: " in capsys.readouterr().out
    assert difflpv("probes", "show", folder / "room.glb", folder / "probes", "--out", tmp_path / "a.png") == 0
    assert drawn[0] is None and len(drawn[1])


def test_error_picture_is_brighter_where_the_error_is(world):
    scene = world[1]
    points = np.array([[-0.5, 0.0, 0.5], [0.5, 0.0, 0.5]])
    seen = error_picture(scene, points, np.array([0.0, 1.0]), width=400).max(2)
    dark, bright = seen[:, :200], seen[:, 200:]  # the camera looks along -z, x goes right
    assert bright.max() > 0.5 > 0.3 > dark.max()
    with pytest.raises(ValueError, match="as many finite errors"):
        error_picture(scene, points, np.zeros(3))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluate", "{room}", "{probes}", "--targets", "{none}"], "none"),
        (["evaluate", "{room}", "{none}", "--targets", "{B}"], "probes.json: not found"),
        (["evaluate", "cornell", "{probes}", "--targets", "{B}"], "probes of scene 'room', not of this 'cornell'"),
        (["evaluate", "{room}", "{probes}", "--targets", "{B}", "--placed-by", "{B}"], "with another seed"),
        (["show", "{room}", "{probes}", "--out", "a.jpg"], "expected a file name ending in .png"),
        (["show", "{room}", "{probes}", "--out", "a.png", "--placed-by", "{A}"], "--placed-by: needs --targets"),
    ],
)
def test_errors_are_one_line(arguments, message, world, capsys):
    folder = world[0]
    names = {name: folder / name for name in ("A", "B", "none", "probes")} | {"room": folder / "room.glb"}
    assert difflpv("probes", *(a.format(**names) for a in arguments)) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("difflpv: error: ") and message in error


def test_contents_are_those_of_the_library():
    assert CONTENTS == BAKED_CONTENTS  # written out in the commands, whose help loads no torch
