"""Truth by levels, and the judge on a small scene: nothing twice, and bounds that hold against many more receivers."""

from dataclasses import replace

import numpy as np
import pytest
from hand_scenes import panel_scene

from difflpv.config import LpvConfig, grid_for
from difflpv.error_bounds import ErrorSamples
from difflpv.illumination import illuminate
from difflpv.pipeline import Lpv
from difflpv.planning.judging import SceneJudge
from difflpv.planning.ladder import PLAN_LADDER
from difflpv.planning.lights import held_out_lights
from difflpv.planning.truth import HeldOutTruth, Level

LEVELS = (Level(40, 32, 1, 1.3), Level(40, 32, 2), Level(100, 32, 2))
SMALL = next(r for r in PLAN_LADDER if r.name == "learned_9x26, 8 cells, 8 steps")


def judge_of(tmp_path, **options):
    scene = panel_scene(floor=2.0)
    return SceneJudge(scene, "direct", held_out_lights(scene, 2), tmp_path, **{"levels": LEVELS, **options})


def test_a_level_adds_lights_and_receivers_to_the_one_before(tmp_path):
    scene = panel_scene(floor=2.0)
    truth = HeldOutTruth(scene, "direct", held_out_lights(scene, 2), tmp_path, levels=LEVELS)
    first, second, third = (truth.level(k) for k in range(3))
    assert [t.irradiance.shape for t in (first, second, third)] == [(1, 40, 3), (2, 40, 3), (2, 100, 3)]
    assert np.array_equal(first.irradiance[0], second.irradiance[0])
    assert np.array_equal(second.irradiance, third.irradiance[:, :40])
    assert (third.parts, third.sets) == ((0, 2), (0, 1))
    # the parts together stand for the area of one: each for its share by count
    assert np.allclose(third.weight[:, :40].sum(1) / third.weight.sum(1), 0.4)
    assert np.allclose(third.weight.sum(1), second.weight.sum(1))
    again = HeldOutTruth(scene, "direct", held_out_lights(scene, 2), tmp_path / "again", levels=LEVELS).level(2)
    assert np.array_equal(again.irradiance, third.irradiance)


def test_a_light_set_that_brings_no_light_is_passed_over(tmp_path):
    scene = panel_scene(floor=2.0)
    own = held_out_lights(scene, 2)
    dark = [{**own[0][0], "radiance": [0.0, 0.0, 0.0]}]
    truth = HeldOutTruth(scene, "direct", [dark, *own], tmp_path, levels=LEVELS)
    assert truth.level(0).sets == (1,)
    assert truth.level(1).sets == (1, 2)
    with pytest.raises(ValueError, match="scene 'panel' has no light in 'direct' to plan for"):
        HeldOutTruth(scene, "direct", [dark], tmp_path / "dark", levels=LEVELS).level(0)


def test_a_light_set_that_brings_no_more_light_than_noise_is_passed_over(tmp_path, monkeypatch):
    """One path of 32 that finds the light at one receiver: its standard error is all that it brings."""
    trace = HeldOutTruth._trace

    def unlucky(self, number, sets):
        trace(self, number, sets)
        if number == 0 and 0 in sets:
            for table in (self._part(0).irradiance, self._part(0).standard_error):
                table[0] = np.zeros((40, 3))
                table[0][7] = 0.25

    monkeypatch.setattr(HeldOutTruth, "_trace", unlucky)
    scene = panel_scene(floor=2.0)
    assert HeldOutTruth(scene, "direct", held_out_lights(scene, 3), tmp_path, levels=LEVELS).level(1).sets == (1, 2)


def test_levels_never_become_smaller(tmp_path):
    with pytest.raises(ValueError, match="levels: expected receivers and lights that never become fewer"):
        judge_of(tmp_path, levels=(Level(40, 32, 2), Level(30, 32, 2)))


def test_each_light_is_solved_once_and_times_are_repeated_on_request(tmp_path, monkeypatch):
    solves, real = [], Lpv.accumulate

    def counted(self, *args, **kwargs):
        solves.append(1)
        return real(self, *args, **kwargs)

    monkeypatch.setattr(Lpv, "accumulate", counted)
    judge = judge_of(tmp_path)
    monkeypatch.setattr("difflpv.planning.judging._SHORT", 0.0)
    counts = []
    for level in range(3):
        _, seconds = judge.judge(SMALL, level)
        counts.append(len(solves))
    assert counts == [2, 3, 3]  # the first of its kind is solved twice: it loads kernels
    solve = judge.solve_of(SMALL)
    assert len(solves) == 3
    times = [solve(), solve()]
    assert len(solves) == 3 + 2
    assert judge.seconds(SMALL) == min(seconds, *times)
    assert judge.solve_of(PLAN_LADDER[0])() == 0.0


def test_what_is_kept_between_rungs_and_levels_is_what_would_be_computed_anew(tmp_path):
    """Its panel moves from light to light: what stands between cells does too."""
    rungs = [r for r in PLAN_LADDER if r.cells == 8 or r.name == "learned_9x26, 16 cells, 16 steps, geometry volume"]
    judge = judge_of(tmp_path)
    for rung in rungs:
        judge.judge(rung, 0)
    truth = judge.truth.level(2)
    tables = [judge.truth.receivers(part) for part in truth.parts]
    position, normal = (np.concatenate([getattr(t, name) for t in tables]) for name in ("position", "normal"))
    for rung in rungs:
        grid, found = judge.grid(rung), []
        for number in truth.sets:
            light = illuminate(judge.truth.lit(number), grid, rung.config, "direct")
            found.append(Lpv(grid, rung.config)(light, light.receivers(position, normal)).detach().double().numpy())
        anew = ErrorSamples.of(np.stack(found), truth.irradiance, truth.standard_error, truth.weight).estimate()
        assert judge.judge(rung, 2)[0].error == pytest.approx(anew.error, rel=1e-6), rung.name
        assert judge.judge(rung, 2)[0].high == pytest.approx(anew.high, rel=1e-6), rung.name


@pytest.mark.parametrize("config", [
    LpvConfig(method="learned_9x26", steps=6), LpvConfig(method="holpv", occlusion="exp", steps=6),
])  # fmt: skip
def test_lights_carried_over_to_other_cells_are_the_same_as_traced_anew(config):
    scene = panel_scene(floor=2.0)
    coarse, fine = grid_for(scene, 8), grid_for(scene, 12)
    position, normal = np.array([[0.1, 0.0, 0.2]]), np.array([[0, 1.0, 0]])
    first = illuminate(scene, coarse, LpvConfig(method="learned_4x6", steps=6), "direct", seed=3)
    first.vpl_cells(first.vpls())  # those of the coarse cells must not be carried over
    for grid in (fine, coarse):
        anew, carried = illuminate(scene, grid, config, "direct", seed=3), first.on(grid, config, seed=3)
        found = [Lpv(grid, config)(light, light.receivers(position, normal)) for light in (anew, carried)]
        assert found[0].abs().max() > 0
        assert found[0].tolist() == found[1].tolist()


PROBES = replace(SMALL, name="8 probes", kind="lit probes", family="LPV-lit probes", probes=8)


def test_probes_read_the_volume_that_was_solved_for_another_rung(tmp_path, monkeypatch):
    solves, real = [], Lpv.accumulate
    monkeypatch.setattr(Lpv, "accumulate", lambda self, *args, **kwargs: solves.append(1) or real(self, *args, **kwargs))
    monkeypatch.setattr("difflpv.planning.judging._SHORT", 0.0)
    judge = judge_of(tmp_path)
    _, seconds = judge.judge(SMALL, 1)
    count = len(solves)
    estimate, more = judge.judge(PROBES, 1)
    assert len(solves) == count
    assert more > seconds  # they are lit, too
    config = judge.config(PROBES)
    assert config.probes and replace(config, probes=()) == SMALL.config
    truth, found = judge.truth.level(1), []
    table = judge.truth.receivers(0)
    for number in truth.sets:
        light = illuminate(judge.truth.lit(number), judge.grid(PROBES), config, "direct")
        lpv = Lpv(light.grid, config)
        found.append(lpv(light, light.receivers(table.position, table.normal)).detach().double().numpy())
    anew = ErrorSamples.of(np.stack(found), truth.irradiance, truth.standard_error, truth.weight).estimate()
    assert estimate.error == pytest.approx(anew.error, rel=1e-5)
    assert judge.solve_of(PROBES)() > 0


def test_moving_receivers_add_their_lookups_to_the_time(tmp_path):
    still, moving = judge_of(tmp_path), judge_of(tmp_path, moving=10**6)
    for judge in (still, moving):
        for rung in (SMALL, PROBES):
            judge.judge(rung, 0)
    # a million receivers look up for longer than a volume of 8 cells takes to solve; in probes, without rays, for less
    assert moving.seconds(SMALL) > 10 * still.seconds(SMALL)
    assert moving.seconds(PROBES) < moving.seconds(SMALL)


@pytest.mark.slow
def test_bounds_hold_against_the_error_over_many_more_receivers(tmp_path):
    """Brute force with other receivers, other paths and ten times as many; both bounds with 99.9 %."""
    levels = (Level(200, 64, 1, 1.3), Level(200, 64, 2), Level(500, 64, 2))
    judge = judge_of(tmp_path / "few", levels=levels, confidence=0.999)
    brute = judge_of(tmp_path / "many", levels=(Level(5000, 64, 2),), seed=77)
    for name in ("constant", SMALL.name, "learned_4x26, 16 cells, 16 steps", "learned_9x26, 16 cells, 16 steps"):
        rung = next(r for r in PLAN_LADDER if r.name == name)
        estimate, truth = judge.judge(rung, 2)[0], brute.judge(rung, 0)[0].error
        assert estimate.low <= truth <= estimate.high, name
        assert judge.judge(rung, 0)[0].low <= 1.3 * truth, name
