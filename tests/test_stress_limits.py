"""The limits that docs/stability.md states, each from both sides, on grids of a few cells."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_stress import TINY

from difflpv.config import LpvConfig, grid_for
from difflpv.evaluate import score
from difflpv.io import load_scene
from difflpv.io.tables import load_receivers
from difflpv.learnables import describe_learnables
from difflpv.optim import solve
from difflpv.optim.problem import Problem
from difflpv.parameters import Parameter
from difflpv.pipeline import Lpv
from difflpv.simulate import simulate
from difflpv.stress import STRESS_METHODS
from difflpv.stress.inverse import inverse
from difflpv.stress.measure import Bench, Lit, read
from difflpv.stress.placement import translation
from difflpv.stress.scenes import Case, room_scene
from difflpv.stress.settings import StressSettings

PLAIN = {name: STRESS_METHODS[name] for name in ("lpv", "holpv", "learned_9x26")}
# An independent renderer's irradiance on the Cornell box.
CORNELL = "tests/data/truth/cornell_surface.npz"


def floor_case(*, light=1.0):
    scene = room_scene(cells=8)
    scene = scene.with_lights([replace(item, radiance=light * item.radiance) for item in scene.lights])
    u = np.linspace(-1.6, 1.6, 5)
    x, z = (a.ravel() for a in np.meshgrid(u, u))
    normal, ones = np.tile([0.0, 1, 0], (25, 1)), np.ones((25, 3))
    return Case(scene, np.stack([x, np.zeros(25), z], 1), normal, np.ones(25), {"bounce1": ones, "direct": ones}, {})


@pytest.mark.parametrize("name", PLAIN)
def test_factor_is_silent_at_one_told_above_and_raises_where_it_overflows(name):
    config = replace(PLAIN[name], steps=64)
    lit = Lit.of(floor_case(), config, "bounce1")
    at, above, beyond = (read(name, p, lit, config, values={"propagation": p}) for p in (1.0, 1.01, 2.0))
    assert at.message == "" and "beyond its critical value 1: light grows up to 1.89 times" in above.message
    assert beyond.error > 1e4 and beyond.gradient > 1e5 and "light grows" in beyond.message
    longer = replace(config, steps=512)
    over = read(name, 2.0, lit, longer, values={"propagation": 2.0})
    assert over.error is None and "irradiance is not finite: the propagation factor 2 lies beyond" in over.message
    assert "lower it or take fewer steps" in over.message


def test_thesis_normalization_is_dark_at_its_published_factor():
    """A quarter of the light is kept per step; 3 (the octree thesis) keeps three quarters, 4 all, 4.04 more than all."""
    config = LpvConfig(steps=16, normalization="thesis")
    lit = Lit.of(floor_case(), config, "bounce1")
    one, three, four, more = (read("holpv", p, lit, config, values={"propagation": p}) for p in (1.0, 3.0, 4.0, 4.04))
    assert one.energy < 0.25 * four.energy < 0.7 * three.energy < 0.7 * four.energy
    assert four.message == "" and "beyond its critical value 4" in more.message


@pytest.mark.slow
def test_published_kernels_get_worse_as_cells_shrink_and_the_learned_one_does_not():
    table, scene = load_receivers(CORNELL), load_scene("cornell")
    truth, weight = table.extras["irr_direct"].astype(float), table.area_weight

    def error(method, cells):
        config = LpvConfig(method=method, steps=cells)
        grid = grid_for(scene, cells)
        found = simulate(scene, table.position, table.normal, grid=grid, config=config, component="direct").irradiance
        return score(found, truth, weight, method=method, component="direct", light=0).relative_l2

    for method in ("lpv", "holpv"):
        coarse, fine, finest = (error(method, n) for n in (8, 16, 32))
        assert 1.4 * coarse < fine < finest / 1.3
    assert error("learned_9x26", 32) < 1.05 * error("learned_9x26", 16) < 1.1 * error("learned_9x26", 8)


def test_a_nearest_deposit_jumps_and_a_trilinear_one_moves_evenly(tmp_path):
    methods = {name: STRESS_METHODS[name] for name in ("lpv", "holpv", "learned_9x26 open")}
    found = translation(Bench(replace(TINY, moves=16), methods, tmp_path))
    for name in methods:
        nearest, trilinear = found.of(f"{name}, nearest"), found.of(f"{name}, trilinear")
        jump, even = max(r.error for r in nearest[1:]), max(r.error for r in trilinear[1:])
        assert sum(r.error > 0 for r in nearest[1:]) == 1 and jump > 5 * even  # one border lies on the way
        assert all(r.gradient == 0 for r in nearest) and any(r.gradient > 0 for r in trilinear)
        assert sum(r.error for r in trilinear[1:]) < 1.5 * jump


def test_a_position_is_not_learned_through_a_nearest_deposit():
    scene = room_scene(cells=8)
    for deposit in ("trilinear", "nearest"):
        config = LpvConfig(deposit=deposit)
        if deposit == "trilinear":
            assert describe_learnables(["light_position"], config, grid_for(scene), scene)
        else:
            with pytest.raises(ValueError, match="'light_position' needs deposit='trilinear' or 'visible', got 'nearest'"):
                describe_learnables(["light_position"], config, grid_for(scene), scene)


@pytest.mark.parametrize("factor", [1e-30, 1e-6, 1e6, 1e30])
def test_irradiance_is_proportional_to_radiance_over_sixty_decades(factor):
    config = replace(STRESS_METHODS["holpv exp"], steps=6)
    one, other = (Lit.of(floor_case(light=f), config, "bounce1") for f in (1.0, factor))

    def irradiance(lit):
        return Lpv(lit.light.grid, config)(lit.light, lit.light.receivers(lit.case.position, lit.case.normal)).double()

    a, b = irradiance(one), irradiance(other)
    torch.testing.assert_close(b / factor, a, rtol=1e-5, atol=0)


@pytest.mark.slow
def test_who_finds_what_gradients_lose(tmp_path, monkeypatch):
    """From within a cell L-BFGS finds a lamp; from the far corner it does not, and a search of the whole box may."""
    import difflpv.stress.inverse as module

    monkeypatch.setattr(module, "SOLVERS", dict.fromkeys(("adam", "lbfgs", "nlopt-bobyqa", "nlopt-crs2")))
    found = inverse(Bench(StressSettings(starts=3), PLAIN, tmp_path))
    rate = {(r.method, found.categories[int(r.knob)]): 1 - r.error for r in found.readings}
    assert rate["lbfgs", "near start"] == rate["nlopt-bobyqa", "near start"] == 1
    assert rate["lbfgs", "far start"] == 0 < rate["nlopt-crs2", "far start"]
    # On the mirror plane the gradient vanishes: who follows it stays there, who looks around leaves.
    assert rate["lbfgs", "symmetric"] < rate["nlopt-bobyqa", "symmetric"] == 1


def test_a_flat_start_is_called_converged_with_the_advice_to_start_elsewhere():
    """Two optima at -1 and 1, and between them a point where the gradient is exactly 0."""

    def loss(p):
        return ((p["x"] ** 2 - 1) ** 2).sum()

    stuck = solve(Problem(loss, [Parameter("x", 0.0, -2, 2)]), "lbfgs", budget=30)
    free = solve(Problem(loss, [Parameter("x", 0.1, -2, 2)]), "lbfgs", budget=60)
    assert stuck.loss == 1 and "another start may lead to another optimum" in stuck.message
    assert free.loss < 1e-8


def test_cma_that_is_not_installed_has_a_row_that_says_so(tmp_path, monkeypatch):
    import difflpv.stress.inverse as module

    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(module, "SOLVERS", {"adam": None, "lbfgs": None, "cma": None})
    monkeypatch.setattr(module, "_rate", lambda solver, k, task, settings: module.Reading(solver, k, 0.0, 1.0, 1.0))
    found = inverse(Bench(TINY, PLAIN, tmp_path))
    assert all("not installed: pip install 'difflpv[cma]'" in r.message and r.error is None for r in found.of("cma"))
    assert next(limit for limit in found.limits if limit.method == "cma").limit == "not measured"
