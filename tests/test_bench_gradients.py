"""Gradients beside path replay: the true one, ours, path replay's, equal noise, and how they are written."""

import numpy as np
import pytest

from data_gen.few_paths import trace_paths
from data_gen.pathtracer import PathTracer
from difflpv.bench import breakeven, gradients
from difflpv.bench.configuration import chosen
from difflpv.bench.gradients import equal_samples, gradient_task, measure_gradients, moved_light
from difflpv.bench.measure import measure, prepare
from difflpv.bench.mitsuba_gradient import PathReplay
from difflpv.bench.mitsuba_peer import unavailable
from difflpv.bench.scenes import bench_scenes
from difflpv.bench.sections import gradient_section
from difflpv.bench.settings import BenchSettings

NAMES = ["learned_9x26, 16 cells, 16 steps", "path tracer, 4"]
SIZES = BenchSettings(repeats=2, patience=0.01, costly_receivers=1000, gradient_samples=256)


@pytest.fixture(scope="module")
def cornell(tmp_path_factory):
    folder = tmp_path_factory.mktemp("truth")
    return bench_scenes("cornell", folder, components=("bounce1",), receivers=100, spp=512)[0]


@pytest.fixture(scope="module")
def task(cornell):
    return gradient_task(cornell, samples=512)


def test_noise_falls_with_the_root_of_the_samples():
    assert equal_samples(64, 0.4, 0.1) == pytest.approx(1024)
    assert equal_samples(64, 0.1, 0.4) == pytest.approx(4)


def test_a_moved_light_takes_its_panel_along(cornell):
    light = next(mesh for mesh in cornell.scene.meshes if mesh.name == cornell.scene.lights[0].mesh)
    moved = moved_light(cornell.scene, 0, np.array([0.5, 0, 0]))
    shifts = [b.vertices - a.vertices for a, b in zip(cornell.scene.meshes, moved.meshes, strict=True)]
    assert {mesh.name for mesh, s in zip(moved.meshes, shifts, strict=True) if s.any()} == {light.name}
    assert moved.lights == cornell.scene.lights


def test_power_is_the_function_itself_and_place_points_at_the_goal(cornell, task):
    # irradiance is proportional to the power, so the gradient by its factor is the function's value
    value = (task.weight * cornell.truth).sum()
    noise = np.sqrt(((task.weight * cornell.standard_error) ** 2).sum())
    assert task.power[0] == pytest.approx(value, abs=5 * noise + 5 * task.power_error * abs(value))
    assert task.power[0] > 0  # the goal is weaker: less power, less loss
    assert task.place_error < 0.2


def test_ours_is_near_the_true_gradient_by_power(cornell, task):
    run = prepare(chosen(NAMES[:1])[0], cornell)
    found = run.both(run.receivers, task.weight)
    # linear in the power: the gradient is the function of what is solved
    assert float(found["light_intensity"]) == pytest.approx((task.weight * run.lookup(run.solve())).sum(), rel=1e-3)
    assert float(found["light_intensity"]) == pytest.approx(task.power[0], rel=0.3)


def test_rows_without_mitsuba_and_as_text(cornell, monkeypatch):
    monkeypatch.setattr(gradients, "unavailable", lambda: "not here")
    points = measure(chosen(NAMES), cornell, repeats=1, gradients=False, memory=False)
    assert measure_gradients([p for p in points if p.family == "path tracer"], cornell, SIZES) == []
    monkeypatch.setattr(breakeven, "EQUAL_ERROR", 1.0)
    (row,) = measure_gradients(points, cornell, SIZES)
    assert row["replay"] is None and row["counts"] == [100] and row["ours"][0] > 0 and row["differences"][0] > 0
    assert row["difference_samples"] > 0 and 0 < row["place"]["error"] and row["power"]["samples"] is None
    assert gradient_section([row]).count("not available") == 3 and "No scene" in gradient_section([])


@pytest.mark.skipif(bool(unavailable()), reason="Mitsuba 3 cannot be used here")
def test_path_replay_refuses_what_it_does_not_measure(tmp_path):
    scene = bench_scenes("cornell", tmp_path, components=("direct",), receivers=20, spp=32)[0]
    with pytest.raises(ValueError, match="cornell/direct: path replay"):
        PathReplay(scene, scene.position, scene.normal, scene.truth)


@pytest.mark.slow
@pytest.mark.skipif(bool(unavailable()), reason="Mitsuba 3 cannot be used here")
def test_path_replay_finds_the_true_gradient_by_power_and_place(cornell, task):
    # receivers in corners give the edges' estimate a heavy tail: those well inside the room
    low, high = cornell.scene.bounds
    inner = ((cornell.position > low + 0.3) & (cornell.position < high - 0.3)).sum(1) >= 2
    weight = task.weight * inner[:, None]
    replay = PathReplay(cornell, cornell.position, cornell.normal, weight)
    found = [replay.gradient(power_samples=256, place_samples=4096, seed=k) for k in range(16)]
    power, place = (np.stack([f[name] for f in found]) for name in ("light_intensity", "light_position"))
    assert power.mean(0)[0] == pytest.approx((weight * cornell.truth).sum(), rel=0.05)
    step, truth = 5e-3, np.zeros(3)
    for axis, way in enumerate(step * np.eye(3)):
        tracers = [PathTracer(moved_light(cornell.scene, 0, sign * way)) for sign in (1, -1)]
        sides = [trace_paths(t, cornell.position, cornell.normal, "bounce1", samples=1024, seed=7) for t in tracers]
        truth[axis] = (weight * (sides[0] - sides[1])).sum() / (2 * step)
    error = place.std(0, ddof=1)[0] / 4
    np.testing.assert_array_less(abs(place.mean(0)[0] - truth), 4 * error + 0.05 * np.linalg.norm(truth))
    assert np.linalg.norm(error) < 0.5 * np.linalg.norm(truth)  # it can tell
