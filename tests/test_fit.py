"""Fits on a box whose truth is known because the solve itself made it."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from hand_scenes import box_scene, rectangle

from difflpv.config import LpvConfig
from difflpv.fit import fit, light_target, score_lights
from difflpv.grid import Grid
from difflpv.illumination import illuminate
from difflpv.loss import relative_l2
from difflpv.optim.checkpoint import CheckpointError
from difflpv.optim.result import Status
from difflpv.pipeline import Lpv
from difflpv.scene import AreaLight, Camera, Scene
from difflpv.simulate import render

GRID = Grid((-1.33, -1.27, -1.41), 0.39, (7, 7, 7))
RNG = np.random.default_rng(0)
FREE = RNG.uniform(-0.9, 0.9, (40, 2))
POSITION = np.stack([FREE[:, 0], np.where(np.arange(40) % 2, -1.0, 1.0), FREE[:, 1]], 1)
NORMAL = np.stack([np.zeros(40), -POSITION[:, 1], np.zeros(40)], 1)
WEIGHT = RNG.uniform(0.5, 1.5, 40)
FEW = {"surface_samples": 200, "area_samples": 9}
CAMERA = Camera(np.array([[1.0, 0, 0, 0.1], [0, 0, 1, 0.8], [0, -1, 0, 0.1], [0, 0, 0, 1]]), 1.2, 13, 12)


def room(upward=False):
    """A box with two small panels side by side, or face to face over the same cells."""
    box = box_scene(albedo=np.linspace(0.2, 0.8, 18).reshape(6, 3))
    edges = [((0.4, 0, 0), (0, 0, 0.4)), ((0, 0, 0.4), (0.4, 0, 0))]
    panels = [
        rectangle("left", (-0.7, 0.9, -0.2), *edges[0], (0, 0, 0)),
        rectangle("right", (-0.7, 0.5, -0.2) if upward else (0.3, 0.9, -0.2), *edges[upward], (0, 0, 0)),
    ]
    lights = tuple(AreaLight(p.name, np.array([3.0, 2.0, 1.0])) for p in panels)
    return Scene("room", (*box.meshes, *panels), lights, cameras=(CAMERA,))


def light_sets(count):
    sides = enumerate(("left", "right"))
    panels = [({"type": "area", "mesh": name}, float(3 - i)) for i, name in sides]
    return [[entry | {"radiance": [k + 1.0, 2.0, blue]} for entry, blue in panels] for k in range(count)]


def targets_of(config, truth, *, count=1, component="bounce1", dtype=torch.float64, image=False, upward=False):
    """Targets made by the solve itself with the values ``truth``."""
    scene, found = room(upward), []
    for k, entries in enumerate(light_sets(count)):
        own = None if count == 1 else entries
        blank = light_target(
            scene, own, GRID, config, component, index=k, position=POSITION, normal=NORMAL,
            irradiance=np.ones((40, 3)), weight=WEIGHT, dtype=dtype, **FEW,
        )  # fmt: skip
        lpv = Lpv(GRID, config, learn=tuple(truth), scene=blank.illumination.scene)
        lpv.set_values({name: torch.as_tensor(value, dtype=torch.float64) for name, value in truth.items()})
        with torch.no_grad():
            irradiance = lpv(blank.illumination, blank.receivers).cpu().numpy()
        picture = render(lpv, blank.illumination)[0] if image else None
        found.append(
            light_target(
                scene, own, GRID, config, component, index=k, position=POSITION, normal=NORMAL,
                irradiance=irradiance, weight=WEIGHT, image=picture, dtype=dtype, **FEW,
            )  # fmt: skip
        )
    return scene, found


CONFIG = LpvConfig(steps=3, occlusion="exp", deposit="trilinear")


def test_factors_are_recovered_and_judged_on_other_lights():
    truth = {"propagation": 0.8, "occlusion": 1.7, "sampling_bias": 0.31}
    scene, targets = targets_of(CONFIG, truth, count=3)
    outcome = fit(scene, targets, config=CONFIG, learn=tuple(truth), train=[0, 2], test=[1], solver="lbfgs", budget=200)
    for name, value in truth.items():
        assert outcome.result.parameters[name].item() == pytest.approx(value, abs=1e-3)
        assert outcome.lpv.values()[name].item() == pytest.approx(value, abs=1e-3)
    assert (outcome.train, outcome.test) == ((0, 2), (1,))
    constant, untuned, fitted = outcome.mean_scores([1])
    assert [s.method for s in (constant, untuned, fitted)] == ["constant", "holpv", "holpv fitted"]
    assert fitted.relative_l2 < 1e-3 < 0.05 < untuned.relative_l2
    assert {(s.light, s.method) for s in outcome.scores} >= {(k, "holpv fitted") for k in (0, 1, 2)}


@pytest.mark.parametrize("learn", ["injection_bias", "propagation_steps"])
def test_adam_and_log_loss(learn):
    truth = {learn: 0.3 if learn == "injection_bias" else [0.8, 1.1, 0.6]}
    scene, targets = targets_of(CONFIG, truth)
    options = {"solver": "adam", "lr": 0.1, "loss": "log", "budget": 240}
    outcome = fit(scene, targets, config=CONFIG, learn=[learn], train=[0], test=[], **options)
    assert outcome.result.loss < 0.1 * outcome.result.history[0].loss


def test_albedo_is_recovered_where_light_falls():
    scene = room()
    wanted = scene.mesh_albedo.clip(1e-3, 0.9)
    wanted[0] = [0.3, 0.6, 0.4]
    config = LpvConfig(steps=4)
    scene, targets = targets_of(config, {"albedo": wanted})
    outcome = fit(scene, targets, config=config, learn=["albedo"], train=[0], test=[], solver="lbfgs", budget=300)
    assert outcome.result.loss < 1e-3
    np.testing.assert_allclose(outcome.result.parameters["albedo"][0], wanted[0], atol=0.02)


@pytest.mark.parametrize("component", ["direct", "bounce1"])
def test_light_intensities_by_least_squares(component):
    """Transport without the clamp is linear in the light: one linear solve finds both intensities."""
    config, truth = LpvConfig(steps=3, clamp=False), {"light_intensity": [1.7, 0.4]}
    scene, targets = targets_of(config, truth, component=component)
    outcome = fit(scene, targets, config=config, learn=["light_intensity"], train=[0], test=[], solver="nnls", budget=5)
    assert outcome.result.status is Status.CONVERGED
    np.testing.assert_allclose(outcome.result.parameters["light_intensity"], truth["light_intensity"], rtol=1e-6)


def test_least_squares_of_several_lights_is_relative():
    """A light set a hundred times as bright pulls no more than the other: the sum of squared losses is least."""
    config = LpvConfig(method="learned_4x6", steps=3)
    scene, targets = targets_of(config, {"lookup_gains": [0.9, 0.6]}, count=2)
    dim = replace(targets[1], irradiance=1.3 * targets[1].irradiance)
    bright = light_target(
        scene, [entry | {"radiance": [100 * v for v in entry["radiance"]]} for entry in light_sets(1)[0]], GRID, config,
        "bounce1", index=0, position=POSITION, normal=NORMAL, irradiance=100 * targets[0].irradiance.numpy(), weight=WEIGHT,
        dtype=torch.float64, **FEW,
    )  # fmt: skip
    lights = [bright, dim]
    outcome = fit(scene, lights, config=config, learn=["lookup_gains"], train=[0, 1], test=[], solver="nnls", budget=6)
    assert outcome.result.status is Status.CONVERGED
    gains = outcome.result.parameters["lookup_gains"].clone().requires_grad_(True)
    losses = [
        relative_l2(outcome.lpv(t.illumination, t.receivers, {"lookup_gains": gains}), t.irradiance, t.weight) for t in lights
    ]
    (slope,) = torch.autograd.grad(sum(loss.square() for loss in losses), gains)
    assert all(float(loss.detach()) > 0.01 for loss in losses) and float(slope.norm()) < 1e-9


def test_least_squares_knows_no_other_loss():
    scene, targets = targets_of(CONFIG, {"propagation": 0.8})
    with pytest.raises(ValueError, match="loss: solver 'nnls' knows 'l2' alone, got 'log'"):
        fit(scene, targets, config=CONFIG, learn=["light_intensity"], train=[0], test=[], solver="nnls", loss="log", budget=9)


def test_least_squares_refuses_what_is_not_linear():
    """Opposite lobes meet in the clamp of one cell: max(0, a + b) is not max(0, a) + max(0, b)."""
    config = LpvConfig(method="lpv", steps=6)
    scene, targets = targets_of(config, {"light_intensity": [1.7, 0.4]}, component="direct", upward=True)
    outcome = fit(scene, targets, config=config, learn=["light_intensity"], train=[0], test=[], solver="nnls", budget=5)
    assert outcome.result.status is Status.FAILED and "not affine" in outcome.result.message


def test_an_image_shows_the_albedo_that_is_learned():
    """The surface that a pixel sees reflects by the albedo being fitted, as those do that light it."""
    wanted = np.linspace(0.3, 0.7, 24).reshape(8, 3)
    scene, targets = targets_of(LpvConfig(steps=3), {"albedo": wanted}, image=True)
    outcome = fit(
        scene, targets, config=LpvConfig(steps=3), learn=["albedo"], train=[0], test=[], loss="image-l1", budget=3,
        initial={"albedo": wanted},
    )  # fmt: skip
    assert outcome.result.history[0].loss < 1e-5
    painted = [replace(m, material=replace(m.material, albedo=a)) for m, a in zip(scene.meshes, wanted, strict=True)]
    lit = illuminate(replace(scene, meshes=tuple(painted)), GRID, LpvConfig(steps=3), dtype=torch.float64, **FEW)
    np.testing.assert_allclose(targets[0].image, render(Lpv(GRID, LpvConfig(steps=3)), lit)[0], rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize("loss", ["image-l1", "image-ssim"])
def test_image_losses_on_the_camera_view(loss):
    config = LpvConfig(steps=3)
    scene, targets = targets_of(config, {"propagation": 0.7}, image=True)
    outcome = fit(scene, targets, config=config, learn=["propagation"], train=[0], test=[], loss=loss, budget=60)
    assert outcome.result.parameters["propagation"].item() == pytest.approx(0.7, abs=0.01)


class Interrupt:
    """Ctrl-C at the n-th evaluation."""

    def __init__(self, after):
        self.left = after

    def __call__(self, point):
        self.left -= 1
        if self.left == 0:
            raise KeyboardInterrupt


@pytest.mark.parametrize("solver", ["adam", "lbfgs"])
def test_an_interrupted_fit_keeps_its_best_and_resumes_bit_for_bit(tmp_path, solver):
    scene, targets = targets_of(CONFIG, {"propagation": 0.8, "occlusion": 1.7})
    options = {"config": CONFIG, "learn": ["propagation", "occlusion"], "train": [0], "test": []}
    options |= {"solver": solver, "budget": 36}
    whole = fit(scene, targets, checkpoint=tmp_path / "whole.pt", label="a", **options)
    stopped = fit(scene, targets, checkpoint=tmp_path / "c.pt", callback=Interrupt(5), label="a", **options)
    assert stopped.result.status is Status.INTERRUPTED and stopped.result.loss <= whole.result.history[0].loss
    assert stopped.scores and "run again with the same checkpoint" in stopped.result.message
    resumed = fit(scene, targets, checkpoint=tmp_path / "c.pt", label="a", **options)
    assert resumed.result.loss == whole.result.loss
    for name, value in whole.result.parameters.items():
        assert torch.equal(resumed.result.parameters[name], value)
    assert [p.loss for p in resumed.result.history] == [p.loss for p in whole.result.history]


@pytest.mark.parametrize(("changed", "told"), [({"loss": "log"}, "loss log"), ({"sparsity": 0.5}, "sparsity 0.5")])
def test_a_checkpoint_of_another_loss_is_refused(tmp_path, changed, told):
    """Its best point would be the best of another loss."""
    scene, targets = targets_of(CONFIG, {"propagation": 0.8})
    options = {"config": CONFIG, "learn": ["cell_occlusion"], "train": [0], "test": [], "budget": 6, "label": "a"}
    options["checkpoint"] = tmp_path / "c.pt"
    fit(scene, targets, **options)
    with pytest.raises(CheckpointError, match=f"belongs to another fit: label is .* there and .*{told}"):
        fit(scene, targets, **options | changed)


def test_a_fit_that_overflows_says_where():
    """Adam takes one giant step to p = 2, where 600 steps overflow float32."""
    config = LpvConfig(method="lpv", steps=600)
    scene, targets = targets_of(config, {"propagation": 0.9}, dtype=torch.float32)
    wrong = [type(t)(t.index, t.illumination, t.receivers, 1e6 * t.irradiance, t.weight) for t in targets]
    outcome = fit(scene, wrong, config=config, learn=["propagation"], train=[0], test=[], solver="adam", lr=50.0, budget=30)
    assert outcome.result.status is Status.NON_FINITE
    assert "at step 1, because of parameter 'propagation'" in outcome.result.message
    assert outcome.lpv.values()["propagation"].item() == pytest.approx(1.0)


@pytest.mark.parametrize(("start", "moved"), [(1.02, False), (1.9, True)])
def test_a_fit_that_starts_beyond_the_limit(start, moved):
    """600 steps at 1.02 grow and can be fitted; at 1.9 they overflow float32, and the fit starts from 1 instead.

    Either may still be stopped by a trial of the line search beyond the limit: what counts is the best finite point.
    """
    config = LpvConfig(method="lpv", steps=600)
    scene, targets = targets_of(config, {"propagation": 0.9}, dtype=torch.float32)
    options = {"learn": ["propagation"], "train": [0], "test": [], "initial": {"propagation": start}, "budget": 45}
    outcome = fit(scene, targets, config=config, **options)
    assert ("started from the critical propagation factor 1, because" in outcome.result.message) is moved
    assert outcome.result.loss < 0.5 * outcome.result.history[0].loss
    assert outcome.lpv.values()["propagation"].item() < 1
    assert all(np.isfinite(s.relative_l2) for s in outcome.scores)


def test_step_factors_that_overflow_are_moved_too():
    config = LpvConfig(method="lpv", steps=600)
    scene, targets = targets_of(config, {"propagation_steps": np.full(600, 0.9)}, dtype=torch.float32)
    options = {"learn": ["propagation_steps"], "train": [0], "test": [], "budget": 6}
    outcome = fit(scene, targets, config=config, initial={"propagation_steps": np.full(600, 1.9)}, **options)
    assert "started from the critical propagation factor" in outcome.result.message and np.isfinite(outcome.result.loss)


@pytest.mark.parametrize(("rate", "diverged"), [(0.1, False), (50.0, True)])
def test_adam_says_when_a_large_step_threw_it_out(rate, diverged):
    config = LpvConfig(method="lpv", steps=60)
    scene, targets = targets_of(config, {"propagation": 1.01})
    options = {"learn": ["propagation"], "train": [0], "test": [], "solver": "adam", "lr": rate, "budget": 60}
    outcome = fit(scene, targets, config=config, **options)
    first, last = outcome.result.history[0].loss, outcome.result.history[-1].loss
    assert outcome.result.loss <= first and (last > 1e3 * first) is diverged
    assert ("adam: diverged from a loss of" in outcome.result.message) is diverged


def test_splits_and_losses_that_cannot_be():
    scene, targets = targets_of(CONFIG, {"propagation": 0.8}, count=2)
    base = {"config": CONFIG, "learn": ["propagation"], "budget": 10}
    for changes, message in (
        ({"train": [0, 7], "test": [9]}, r"light sets: no target for \[7, 9\], targets hold \[0, 1\]"),
        ({"train": [], "test": [1]}, "must not be empty"),
        ({"train": [0, 1], "test": [1]}, "not overlap"),
        ({"train": [0], "test": [1], "loss": "huber"}, "loss: expected one of l2, log, image-l1, image-ssim, got 'huber'"),
        ({"train": [0], "test": [1], "loss": "image-l1"}, "loss: 'image-l1' needs target images, light set 0 has none"),
        ({"train": [0], "test": [1], "learn": ["light_color"]}, "light_color belong to one light set: train on one"),
        ({"train": [0], "test": [1], "budget": 1}, "budget: expected at least 3 forward-equivalents"),
        ({"train": [0], "test": [1], "solver": "newton"}, "solver: expected one of"),
    ):
        with pytest.raises(ValueError, match=message):
            fit(scene, targets, **(base | changes))


def test_albedo_has_no_part_in_direct_light():
    scene, targets = targets_of(CONFIG, {"propagation": 0.8}, component="direct")
    with pytest.raises(ValueError, match="learn: 'albedo' has no part in component 'direct'"):
        fit(scene, targets, config=CONFIG, learn=["albedo"], train=[0], test=[], budget=10)


def test_a_target_image_of_another_size():
    scene, targets = targets_of(CONFIG, {"propagation": 0.8})
    t = targets[0]
    small = type(t)(t.index, t.illumination, t.receivers, t.irradiance, t.weight, torch.ones(4, 5, 3, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"image: expected \[12, 13, 3\], got \[4, 5, 3\]"):
        fit(scene, [small], config=CONFIG, learn=["propagation"], train=[0], test=[], loss="image-l1", budget=10)


def test_scores_are_plain_values():
    _, targets = targets_of(CONFIG, {"propagation": 0.8})
    scores = score_lights(targets[0], {"holpv": Lpv(GRID, CONFIG)})
    assert [s.method for s in scores] == ["constant", "holpv"]
    assert json.loads(json.dumps([s.to_json() for s in scores]))[1]["component"] == "bounce1"


def test_light_sets_replace_the_lights():
    config = LpvConfig(steps=2)
    _, targets = targets_of(config, {"propagation": 1.0}, count=2)
    direct = illuminate(targets[1].illumination.scene, GRID, config, "direct").vpls().flux.sum(0)
    expected = np.pi * 0.16 * np.array([4.0, 4.0, 5.0])
    np.testing.assert_allclose(direct, expected, rtol=1e-5)
