"""The planner on ladders of known errors and costs, its statistics, its lights, and one small scene from end to end."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hand_scenes import panel_scene
from hypothesis import given, settings
from hypothesis import strategies as st
from planning_judges import KnownJudge, rungs_of

from difflpv.cli import main
from difflpv.config import LpvConfig, grid_for
from difflpv.config_file import ConfigFileError, read_config_file
from difflpv.error_bounds import ErrorSamples
from difflpv.io import load_scene
from difflpv.lights import apply_light_set
from difflpv.planning.explain import explain
from difflpv.planning.ladder import PLAN_LADDER, family_of, work_of
from difflpv.planning.lights import held_out_lights
from difflpv.planning.plan import make_plan, plan_with
from difflpv.planning.truth import Level

METHODS = ("learned_4x6", "learned_9x6", "learned_4x26", "learned_9x26")


numbers = st.floats(0.01, 2.0)


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(numbers, st.floats(1e-3, 10.0)), min_size=1, max_size=12), numbers)
def test_what_is_chosen_meets_the_tolerance_and_nothing_cheaper_does(known, tolerance):
    rungs = rungs_of(len(known))
    errors = {r.name: e for r, (e, _) in zip(rungs, known, strict=True)}
    seconds = {r.name: s for r, (_, s) in zip(rungs, known, strict=True)}
    plan = plan_with(KnownJudge(errors, seconds), rungs, tolerance=tolerance)
    meeting = [name for name in errors if errors[name] <= tolerance]
    if not meeting:
        assert plan.chosen is None
        return
    chosen = plan.chosen.rung.name
    assert errors[chosen] <= tolerance
    assert seconds[chosen] <= 1.05 * min(seconds[name] for name in meeting) * (1 + 1e-9)  # costs within a tie are one


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(numbers, st.floats(1e-3, 10.0)), min_size=1, max_size=12), st.floats(1e-3, 10.0))
def test_a_budget_is_kept_and_nothing_within_it_is_more_accurate(known, budget):
    rungs = rungs_of(len(known))
    errors = {r.name: e for r, (e, _) in zip(rungs, known, strict=True)}
    seconds = {r.name: s for r, (_, s) in zip(rungs, known, strict=True)}
    plan = plan_with(KnownJudge(errors, seconds), rungs, budget=budget)
    within = [name for name in errors if seconds[name] <= budget]
    if not within:
        assert plan.chosen is None
        return
    assert seconds[plan.chosen.rung.name] <= budget
    assert errors[plan.chosen.rung.name] == min(errors[name] for name in within)


def test_only_what_is_near_the_answer_is_judged_closely():
    rungs = rungs_of(20)
    errors = {r.name: 1.0 - 0.04 * i for i, r in enumerate(rungs)}
    seconds = {r.name: 1.5**i for i, r in enumerate(rungs)}
    judge = KnownJudge(errors, seconds)
    plan = plan_with(judge, rungs, tolerance=0.5)
    assert plan.chosen.rung.name == "rung 13"  # 0.48
    # what may turn out to be no dearer is looked at roughly
    assert {int(name.split()[1]) for name, level in judge.judged if level == 0} == set(range(15))
    assert [name for name, level in judge.judged if level == 2] == ["rung 13"]
    assert all(r.state == "open" for r in plan.runners[14:])
    text = explain(plan)
    assert "tolerance 0.5 is met by rung 13" in text
    assert "Left out of 20 rungs:" in text
    assert "- 6: dearer than what was chosen; best judged: rung 14 (0.440)\n" in text
    assert "Half the tolerance, 0.25: dearer rungs were not judged" in text


def test_times_that_are_alike_foretell_nothing():
    """A hundredth more time and half the error: to the power -70 nothing is said."""
    rungs = rungs_of(2)
    errors, seconds = {"rung 0": 0.5, "rung 1": 0.25}, {"rung 0": 1.0, "rung 1": 1.01}
    text = explain(plan_with(KnownJudge(errors, seconds), rungs, tolerance=0.3))
    assert text.endswith("Half the tolerance, 0.15: nothing on the ladder reached it")
    seconds["rung 1"] = 2.0
    text = " ".join(explain(plan_with(KnownJudge(errors, seconds), rungs, tolerance=0.3)).split())
    assert "(error as time to the power -1.00)" in text


def test_an_interruption_keeps_what_is_known():
    class Impatient(KnownJudge):
        def judge(self, rung, level):
            if len(self.judged) == 3:
                raise KeyboardInterrupt
            return super().judge(rung, level)

    rungs = rungs_of(6)
    judge = Impatient({r.name: 0.9 - 0.1 * i for i, r in enumerate(rungs)}, {r.name: 2.0**i for i, r in enumerate(rungs)})
    plan = plan_with(judge, rungs, tolerance=0.1)
    assert plan.interrupted and plan.chosen is None
    assert plan.best.rung.name == "rung 2"
    assert "interrupted; best so far rung 2" in explain(plan)


@pytest.mark.parametrize("options", [{}, {"tolerance": 0.1, "budget": 1.0}, {"tolerance": -1.0}, {"budget": math.nan}])
def test_a_goal_that_is_none_is_refused(options):
    with pytest.raises(ValueError, match="expected"):
        plan_with(KnownJudge({}, {}), [], **options)


def test_the_truths_noise_is_not_taken_for_error():
    """A perfect prediction has error 0 within its bounds whatever the noise, one that is 20 % too bright 0.2."""
    random = np.random.default_rng(0)
    clean = random.uniform(0.5, 1.5, (2, 3000, 3))
    noise = np.full(clean.shape, 0.4)
    truth, weight = clean + noise * random.normal(size=clean.shape), random.uniform(1, 2, (2, 3000))
    perfect = ErrorSamples.of(clean, truth, noise, weight).estimate()
    assert perfect.low == 0 and perfect.error < 0.05
    bright = ErrorSamples.of(1.2 * clean, truth, noise, weight).estimate()
    assert bright.low < 0.2 < bright.high
    assert bright.high - bright.low < 0.05


def test_a_truth_that_is_all_noise_is_refused():
    """What noise leaves of its square is below 0, and over next to nothing it made the error of all cases 0."""
    truth = np.ones((2, 50, 3))
    truth[1] = np.random.default_rng(0).normal(size=(50, 3))
    noise = np.stack([np.zeros((50, 3)), np.full((50, 3), 1.5)])
    with pytest.raises(ValueError, match="error samples: the truth of case 1 cannot be told from its noise"):
        ErrorSamples.of(np.stack([np.full((50, 3), 9.0), np.zeros((50, 3))]), truth, noise, np.ones((2, 50)))


def test_bounds_hold_as_often_as_they_say():
    random, inside = np.random.default_rng(1), 0
    for trial in range(200):
        truth = np.ones((1, 150, 3))
        found = truth + 0.3 * random.normal(size=truth.shape)
        e = ErrorSamples.of(found, truth, 0 * truth, np.ones((1, 150))).estimate(confidence=0.9, seed=trial)
        inside += e.high >= 0.3
    assert 180 - 3.5 * math.sqrt(200 * 0.9 * 0.1) <= inside <= 180 + 3.5 * math.sqrt(200 * 0.9 * 0.1)


def test_drawn_cases_bound_what_two_cases_of_one_kind_would_have():
    """Without scatter among receivers, two draws of two cases are alike half of the time: the bounds are the cases' errors."""
    truth = np.ones((2, 50, 3))
    samples = ErrorSamples.of(truth * [[[1.1]], [[1.4]]], truth, 0 * truth, np.ones((2, 50)))
    e = samples.estimate(draw_cases=True)
    assert (e.low, e.error, e.high) == pytest.approx((0.1, math.sqrt((0.01 + 0.16) / 2), 0.4))
    e = samples.estimate()
    assert e.low == pytest.approx(e.high)


def test_the_ladder_names_each_rung_once_and_orders_work():
    assert len({rung.name for rung in PLAN_LADDER}) == len(PLAN_LADDER)
    grid = grid_for(load_scene("cornell"), 16)
    by_name = {rung.name: rung for rung in PLAN_LADDER}
    coarse = by_name["learned_4x6, 16 cells, 16 steps"]
    assert work_of(coarse, grid) == 16**3 * 16 * 7 * 4**2
    assert family_of(coarse) == family_of(by_name["learned_4x6, 32 cells, 32 steps"])
    assert family_of(coarse) != family_of(by_name["learned_4x6, 16 cells, 16 steps, nothing blocks"])


@pytest.mark.parametrize("name", ["atrium", "bunny", "cornell"])
def test_held_out_lights_are_other_lights_in_free_space(name):
    scene = load_scene(name)
    sets = held_out_lights(scene, 3, seed=1)
    assert sets == held_out_lights(scene, 3, seed=1)
    assert len(sets) == 3
    lit = [apply_light_set(scene, entries) for entries in sets]
    assert len({one.hash for one in lit}) == 3
    low, high = scene.bounds
    for one in lit:
        assert (one.bounds[0] >= low - 1e-5).all() and (one.bounds[1] <= high + 1e-5).all()


@pytest.mark.slow
def test_a_small_scene_from_end_to_end(tmp_path):
    rungs = [r for r in PLAN_LADDER if r.kind == "constant" or (r.cells == 8 and r.config.occlusion == "traced")]
    levels = (Level(60, 32, 1, 1.2), Level(150, 32, 2))
    plan = make_plan(panel_scene(floor=2.0), tmp_path, tolerance=0.5, component="direct", rungs=rungs, levels=levels)
    assert plan.best is not None
    plan.save(tmp_path / "plan.json")
    file = read_config_file(tmp_path / "plan.json")
    assert file.config == plan.config and file.cells == plan.best.rung.cells
    assert explain(plan)
    again = make_plan(panel_scene(floor=2.0), tmp_path / "b", tolerance=0.5, component="direct", rungs=rungs[:1], levels=levels)
    assert again.runners[0].estimate == next(r for r in plan.runners if r.rung == rungs[0]).estimate


def test_a_plan_of_probes_is_a_file_with_their_places(tmp_path):
    volume = next(r for r in PLAN_LADDER if r.name == "learned_9x26, 8 cells, 8 steps")
    rung = replace(volume, name="8 probes", kind="lit probes", family="LPV-lit probes", probes=8)
    levels = (Level(60, 32, 1, 1.2), Level(60, 32, 1))
    scene = panel_scene(floor=2.0)
    plan = make_plan(scene, tmp_path, tolerance=9.0, component="direct", rungs=[rung], levels=levels, moving=1000)
    assert plan.chosen is not None and len(plan.probes) == len(plan.config.probes) > 0
    assert "a solve with the lookups of 1000 receivers that move" in " ".join(explain(plan).split())
    plan.save(tmp_path / "plan.json")
    file = read_config_file(tmp_path / "plan.json")
    assert file.config == plan.config and file.cells == 8 and file.scene == (scene.name, scene.hash)
    with pytest.raises(ValueError, match="moving: expected a number of receivers >= 0, got -1"):
        make_plan(scene, tmp_path, tolerance=1.0, moving=-1)


@pytest.mark.parametrize("arguments, message", [
    (["plan", "cornell"], "one of the arguments --tolerance --budget-ms is required"),
    (["plan", "cornell", "--tolerance", "0.2", "--budget-ms", "5"], "not allowed with"),
    (["plan", "cornell", "--tolerance", "-1"], "expected a number above 0"),
    (["plan", "cornell", "--tolerance", "0.2", "--confidence", "1"], "--confidence: expected a number in [0.5, 1), got 1"),
    (["plan", "cornell", "--tolerance", "0.2", "--out", "plan.txt"], "--out: expected a file name ending in .json"),
    (["plan", "cornell", "--tolerance", "0.2", "--moving", "many"], "--moving"),
    (["plan", "nowhere.glb", "--tolerance", "0.2"], "nowhere.glb"),
])  # fmt: skip
def test_bad_input_is_one_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    text = capsys.readouterr().err
    assert message in text and text.count("\n") == 1


@pytest.mark.parametrize("content, message", [
    ("{", "JSON is damaged"), ("[]", "expected an object"), ('{"cells": 16}', "config: expected an object with a 'method'"),
    ('{"cells": 1, "config": {"method": "lpv"}}', "cells: expected an integer >= 3"),
    ('{"config": {"method": "lpv", "depth": 3}}', "unknown names"), ('{"config": {"method": "cube"}}', "method"),
])  # fmt: skip
def test_a_configuration_file_that_is_none_is_refused(content, message, tmp_path):
    path = tmp_path / "plan.json"
    path.write_text(content)
    with pytest.raises(ConfigFileError, match=f"plan.json.*{message}"):
        read_config_file(path)


def test_config_decides_a_solve(tmp_path, capsys):
    from difflpv.io.tables import load_table, save_table

    config = LpvConfig(method="learned_4x6", steps=3)
    (tmp_path / "plan.json").write_text(json.dumps({"cells": 9, "config": config.to_json(), "method": "learned_4x6"}))
    (tmp_path / "bare.json").write_text(json.dumps(config.to_json()))
    table = tmp_path / "receivers.npz"
    save_table(table, position=np.array([[0.3, 0.0, 0.2]]), normal=np.array([[0.0, 1.0, 0.0]]))
    base = ["simulate", "cornell", "--receivers", str(table), "--out", str(tmp_path / "out.npz")]
    by_options = ["--method", "learned_4x6", "--steps", "3", "--grid", "9"]
    found = []
    by_plan, by_bare = (["--config", str(tmp_path / f"{name}.json")] for name in ("plan", "bare"))
    for options in (by_plan, [*by_bare, "--grid", "9"], by_options):
        assert main([*base, *options]) == 0
        found.append(load_table(tmp_path / "out.npz")["irradiance"])
    assert np.array_equal(found[0], found[1]) and np.array_equal(found[0], found[2])
    capsys.readouterr()
    assert main([*base, "--config", str(tmp_path / "plan.json"), "--steps", "4"]) == 2
    assert "--steps 4:" in capsys.readouterr().err
    assert main([*base, "--config", str(tmp_path / "none.json")]) == 2
    assert "none.json: cannot be read" in capsys.readouterr().err
