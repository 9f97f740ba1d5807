"""The measuring core of ``difflpv bench``: timings, memory, and points on a scene small enough to check."""

import json
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from data_gen.receivers import draw_receivers
from difflpv.bench import growth
from difflpv.bench.configuration import LADDER, Configuration, chosen
from difflpv.bench.measure import Point, errors, measure, prepare
from difflpv.bench.scenes import bench_scenes, components_of
from difflpv.bench.timing import Timing, interleaved, peak_bytes
from difflpv.bench.volume import VolumeRun
from difflpv.config import LpvConfig
from difflpv.evaluate import relative_noise
from difflpv.grid import Grid
from difflpv.illumination import illuminate
from difflpv.io import load_scene


@pytest.fixture(scope="module")
def cornell(tmp_path_factory):
    folder = tmp_path_factory.mktemp("truth")
    return bench_scenes("cornell", folder, components=("bounce1",), receivers=60, spp=256)[0]


def test_timing_is_the_median_between_quartiles():
    timing = Timing.of([5.0, 1.0, 3.0, 2.0, 4.0])
    assert (timing.low, timing.median, timing.high, timing.repeats) == (2.0, 3.0, 4.0, 5)
    assert Timing.of([3.0, 1.0]) == Timing(2.0, 1.0, 3.0, 2)
    assert (timing + timing).median == 6.0


def test_calls_take_turns_and_the_first_round_does_not_count():
    order = []
    times = interleaved({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 3)
    assert order == ["a", "b"] * 4 and times["a"].repeats == 3


def test_a_slow_call_is_not_repeated_beyond_the_patience():
    times = interleaved({"slow": lambda: time.sleep(0.02), "quick": lambda: None}, 4, patience=0.01)
    assert times["slow"].repeats == 1 and times["quick"].repeats == 4


def test_peak_memory_of_what_is_held_at_one_time():
    million = 4 * 1000 * 1000

    def call():
        first = torch.zeros(1000, 1000)
        second = first + 1
        del first
        return second * 2

    assert peak_bytes(call) == pytest.approx(2 * million, rel=0.05)
    assert peak_bytes(lambda: np.zeros(million)) == pytest.approx(8 * million, rel=0.05)


def test_a_solve_without_gradients_holds_two_padded_volumes_and_the_transmittance():
    cells, fields = 32, 27
    padded = (cells + 2) * (cells + 1) ** 2 / cells**3  # rows and slices share their halo; whole vectors fit 32 cells
    unit = 4 * fields * cells**3
    opened, occluded = (peak_bytes(growth._solve(cells, occluded=blocks)) / unit for blocks in (False, True))
    assert growth._two_buffers(cells) / (fields * cells**3) == pytest.approx(2 * padded, rel=1e-3)
    assert opened == pytest.approx(2 * padded, rel=0.05)
    assert occluded - opened == pytest.approx(13 / 27 * padded, rel=0.2)


def test_noise_is_the_error_of_a_perfect_prediction():
    rng = np.random.default_rng(0)
    truth, deviation = rng.uniform(1, 2, (20000, 3)), rng.uniform(0.1, 0.3, (20000, 3))
    weight = rng.uniform(0, 1, 20000)
    measured = truth + deviation * rng.standard_normal(truth.shape)
    area = weight[:, None]
    found = np.sqrt((area * (measured - truth) ** 2).sum() / (area * truth**2).sum())
    assert relative_noise(deviation, truth, weight) == pytest.approx(found, rel=0.02)  # 60,000 numbers: 0.3 % a sigma
    with pytest.raises(ValueError, match="target: expected a value other than zero"):
        relative_noise(deviation, 0 * truth, weight)


def test_receivers_lie_within_the_grid_and_keep_their_share_of_the_area():
    scene = load_scene("cornell")
    low, high = scene.bounds
    half = Grid.from_bounds(low - 1, (high[0] + 1, high[1] + 1, (low[2] + high[2]) / 2), (8, 8, 4))
    everywhere, inside = draw_receivers(scene, 400), draw_receivers(scene, 400, within=half)
    assert half.contains(inside.position).all()
    share = half.contains(everywhere.position).mean()
    found = inside.area_weight.sum() / everywhere.area_weight.sum()
    assert found == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / 400))


def test_blocking_of_the_same_geometry_is_kept():
    scene = load_scene("cornell")
    config = LpvConfig(method="learned_9x6", steps=2)
    grid = Grid.around(*scene.bounds, 8)
    first = illuminate(scene, grid, config, surface_samples=64, area_samples=4)
    again = illuminate(scene, grid, config, surface_samples=64, area_samples=4, blocking=first.blocking)
    assert again.blocking is first.blocking
    with pytest.raises(ValueError, match="blocking: expected that of 2 grid"):
        illuminate(scene, grid, replace(config, coarsen_after=1), blocking=first.blocking)


def test_configurations_check_themselves_and_have_unique_names():
    assert len({c.name for c in LADDER}) == len(LADDER)
    json.dumps([c.to_json() for c in LADDER])
    assert [c.name for c in chosen(["learned_9x26", "constant"])] == ["learned_9x26", "constant"]
    with pytest.raises(ValueError, match="no 'magic'"):
        chosen(["magic"])
    for wrong in ({"kind": "volume"}, {"kind": "paths", "samples": 3}, {"kind": "magic"}, {"kind": "constant", "cells": 2}):
        with pytest.raises(ValueError, match="expected"):
            Configuration("x", **{"family": "constant", **wrong})


def test_components_that_a_volume_carries():
    assert components_of(load_scene("diagonal")) == ("bounce1", "direct")
    assert components_of(load_scene("atrium")) == ("bounce1",)


def test_a_component_without_light_is_left_out(tmp_path):
    found = bench_scenes("diagonal", tmp_path, components=("bounce1", "direct"), receivers=40, spp=64)
    assert [s.component for s in found] == ["direct"]  # one floor: nothing bounces to a receiver


def test_points_of_a_ladder(cornell):
    names = ["constant", "LPV as published", "learned_9x6, 8 cells, 8 steps", "path tracer, 4", "path tracer, 64"]
    points = {p.name: p for p in measure(chosen(names), cornell, repeats=1)}
    assert list(points) == names
    constant, lpv, learned, few, many = points.values()
    assert learned.error < constant.error < lpv.error  # docs/scenes.md: 0.26, 0.55, 2.1
    assert constant.seconds is None and constant.both is None
    assert learned.memory_volumes > 2 and learned.both.median > learned.solve.median
    assert 2.5 < few.error / many.error < 8  # 16 times the paths, a quarter of the noise (less by Sobol' points)
    again = Point.from_json(json.loads(json.dumps(learned.to_json())))
    assert again == learned


def test_what_is_measured_is_what_simulate_predicts(cornell):
    from difflpv.simulate import simulate

    (configuration,) = chosen(["learned_9x26, 8 cells, 8 steps"])
    wide = replace(configuration, surface_samples=8192, area_samples=64)
    run = prepare(wide, cornell)
    found = run.lookup(run.solve())
    own = simulate(cornell.scene, cornell.position, cornell.normal, grid=cornell.grid(8), config=configuration.config)
    np.testing.assert_allclose(found, own.irradiance, rtol=1e-4, atol=1e-4)
    assert errors(found, cornell)["leak"] is None


def test_gradients_of_light_power_and_place_are_those_of_finite_differences(cornell):
    (configuration,) = chosen(["learned_9x26, 8 cells, 8 steps"])
    run = prepare(configuration, cornell)
    assert isinstance(run, VolumeRun)
    slope = float(run.both()["light_intensity"])
    truth, weight = cornell.truth, cornell.weight[:, None]

    def error(power):
        run.values = {"light_intensity": torch.full((1,), power)}
        found = run.lookup(run.solve())
        return np.sqrt((weight * (found - truth) ** 2).sum() / (weight * truth**2).sum())

    assert slope == pytest.approx((error(1.02) - error(0.98)) / 0.04, rel=2e-2)  # float32 through a quotient


def test_tuning_needs_receivers_of_its_own(cornell):
    with pytest.raises(ValueError, match="tuning: expected receivers"):
        prepare(chosen(["LPV, tuned"])[0], cornell)
