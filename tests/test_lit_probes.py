"""Light probes that a volume lights: a uniform field, the bench's own probes, gradients end to end, files and messages."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from hand_scenes import box_scene, panel_scene

from difflpv.cli import main
from difflpv.config import LpvConfig, grid_for
from difflpv.illumination import Receivers, illuminate
from difflpv.io import load_scene
from difflpv.io.tables import load_table, save_table
from difflpv.lookup import CellReads, open_cells
from difflpv.pipeline import Lpv
from difflpv.probes.lookup import probe_irradiance
from difflpv.probes.tetrahedra import TetrahedralInterpolation
from difflpv.simulate import simulate

CORNERS = tuple((x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5))
CONFIG = LpvConfig(method="learned_9x26", steps=4, probes=CORNERS)
SCENE = box_scene()


def lit(config=CONFIG, dtype=torch.float32, component="bounce1"):
    return illuminate(SCENE, grid_for(SCENE, 8), config, component, surface_samples=256, dtype=dtype)


def points(count, seed=0):
    random = np.random.default_rng(seed)
    normal = random.normal(size=(count, 3))
    return random.uniform(-0.8, 0.8, (count, 3)), normal / np.linalg.norm(normal, axis=1, keepdims=True)


def test_in_a_uniform_isotropic_field_every_point_reads_pi_times_its_radiance():
    """A_00 = h^2 L sqrt(4 pi) in every cell is radiance L everywhere, and E = pi L whatever the normal."""
    light = lit()
    lpv, h = Lpv(light.grid, CONFIG), light.grid.cell_size
    volume = torch.zeros(3, 9, *light.grid.shape)
    volume[:, 0] = h**2 * float(np.sqrt(4 * np.pi)) * torch.tensor([1.0, 2.0, 0.5])[:, None, None, None]
    found = lpv.read((volume,), light.receivers(*points(30)))
    gain = CONFIG.stencil.lookup_gains[0]  # of degree 0, for reading with a wall behind
    expected = gain * torch.pi * torch.tensor([1.0, 2.0, 0.5]).expand(30, 3)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("coarsen_after", [None, 2])
def test_a_point_reads_the_radiance_of_its_tetrahedrons_probes(coarsen_after):
    """Reading a solve of one or two grids at the probes, then their barycentric mean, is reading through the probes."""
    config = replace(CONFIG, coarsen_after=coarsen_after)
    light = lit(config)
    lpv, (x, n) = Lpv(light.grid, config), points(20, seed=1)
    solved = lpv.accumulate(light)
    found = lpv.gather(solved, light, light.receivers(x, n)).detach()
    at_probes = Lpv(light.grid, replace(config, probes=()))
    rows = TetrahedralInterpolation(np.array(CORNERS)).rows(torch.tensor(CORNERS).double(), torch.as_tensor(x))
    corners, up, reads = torch.tensor(CORNERS), torch.tensor([[0.0, 1.0, 0.0]]).expand(8, 3), []
    for grid in config.grids(light.grid):  # in free space no wall stands behind a probe: the gains come on top
        usable = open_cells(corners.numpy(), up.numpy(), grid, mode="affine", raycaster=light.raycaster, bias=0.0)
        reads.append(CellReads(usable.cells, usable.weights(corners, up, grid), torch.ones(8)))
    expected = torch.zeros(20, 3)
    for i in range(20):
        normal = torch.as_tensor(n[i], dtype=torch.float32).expand(8, 3).contiguous()
        seen = Receivers(corners, normal, None, tuple(reads), "affine")
        each = at_probes.read(solved, seen).detach()
        expected[i] = (rows.weight[i].float()[:, None] * each[rows.probe[i]]).sum(0)
    torch.testing.assert_close(found, expected, rtol=2e-4, atol=1e-6)


def test_what_is_solved_for_probes_alone_is_what_they_read_of_everything():
    light, (x, n) = lit(), points(20)
    lpv, receivers = Lpv(light.grid, CONFIG), light.receivers(x, n)
    everything = lpv.gather(lpv.accumulate(light), light, receivers)
    torch.testing.assert_close(lpv(light, receivers), everything, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("name", ["light_intensity", "lookup_gains"])
def test_gradients_through_probes_are_those_of_finite_differences(name):
    light = lit(dtype=torch.float64)
    lpv = Lpv(light.grid, CONFIG, learn=(name,), scene=SCENE)
    receivers, start = light.receivers(*points(15)), lpv.values()[name].detach()
    weight = torch.as_tensor(np.random.default_rng(2).normal(size=(15, 3)))

    def aim(value):
        return (weight * lpv(light, receivers, {name: value})).sum()

    (found,) = torch.autograd.grad(aim(leaf := start.clone().requires_grad_()), leaf)
    assert float(found.abs().max()) > 0
    for i in range(start.numel()):
        step = torch.zeros_like(start).reshape(-1)
        step[i] = 1e-5
        step = step.reshape(start.shape)
        expected = float(aim(start + step) - aim(start - step)) / 2e-5
        assert float(found.reshape(-1)[i]) == pytest.approx(expected, rel=1e-5, abs=1e-9)


def test_one_probe_answers_everywhere():
    light = lit(replace(CONFIG, probes=((0.0, 0.0, 0.0),)))
    lpv, (x, n) = Lpv(light.grid, light.config), points(5)
    found = lpv(light, light.receivers(x, np.tile(n[0], (5, 1)))).detach()
    assert float(found.abs().max()) > 0
    torch.testing.assert_close(found, found[:1].expand(5, 3))


@pytest.mark.parametrize("options, message", [
    ({"probes": ((0, 0),)}, "probes: expected positions"),
    ({"probes": ((0, 0, float("nan")),)}, "probes: expected positions .* finite"),
    ({"probes": "here"}, "probes: expected positions"),
    ({"probes": CORNERS, "lookup": "visible"}, "probes: they read cells by the 'affine' lookup, got lookup 'visible'"),
    ({"probes": CORNERS, "method": "learned_4x26"}, "probes: expected 9 coefficients or more, 'learned_4x26' has 4"),
    ({"probes": CORNERS, "method": "holpv"}, "affine"),
])  # fmt: skip
def test_configurations_with_probes_check_themselves(options, message):
    with pytest.raises(ValueError, match=message):
        LpvConfig(**{"method": "learned_9x26", **options})


def test_receivers_of_one_kind_are_refused_by_a_solve_of_the_other():
    light, plain = lit(), replace(CONFIG, probes=())
    solved = Lpv(light.grid, CONFIG).accumulate(light)
    with pytest.raises(ValueError, match="receivers: made for a configuration with light probes, this one has none"):
        Lpv(light.grid, plain).read(solved, light.receivers(*points(2)))


def test_a_plan_with_probes_is_a_configuration_for_simulate_and_python(tmp_path, capsys):
    scene = load_scene("cornell")
    config = LpvConfig(method="learned_9x26", steps=6, probes=((-1.0, 2.0, 0.0), (1.0, 2.0, 0.5), (0.0, 3.0, 1.0)))
    assert LpvConfig.from_json(json.loads(json.dumps(config.to_json()))) == config
    plan = {"cells": 8, "config": config.to_json(), "scene": "cornell", "scene_hash": scene.hash}
    (tmp_path / "plan.json").write_text(json.dumps(plan))
    position, normal = np.array([[0.3, 0.0, 0.2], [0.0, 0.0, 1.0]]), np.tile([0.0, 1.0, 0.0], (2, 1))
    save_table(tmp_path / "table.npz", position=position, normal=normal)
    arguments = ["--config", str(tmp_path / "plan.json"), "--receivers", str(tmp_path / "table.npz")]
    assert main(["simulate", "cornell", *arguments, "--out", str(tmp_path / "out.npz")]) == 0
    assert "read through 3 light probes" in capsys.readouterr().out
    expected = simulate(scene, position, normal, grid=grid_for(scene, 8), config=config).irradiance
    np.testing.assert_array_equal(load_table(tmp_path / "out.npz")["irradiance"], expected)
    assert main(["simulate", "floor", *arguments, "--out", str(tmp_path / "out.npz")]) == 2
    text = capsys.readouterr().err
    assert "plan.json has light probes placed in scene 'cornell'" in text and text.count("\n") == 1


def test_probes_read_like_those_of_the_bench(tmp_path):
    """Beside ``difflpv bench``'s run of the same solve and grid of probes."""
    from difflpv.bench.configuration import Configuration
    from difflpv.bench.probes import LitProbes
    from difflpv.bench.scenes import bench_scenes

    plain = LpvConfig(method="learned_9x26", steps=4)
    scenes = bench_scenes(panel_scene(floor=2.0), tmp_path, components=("direct",), receivers=20, spp=32)
    run = LitProbes(Configuration("p", "lit probes", "LPV-lit probes", plain, cells=8, probes=8), scenes[0])
    config = replace(plain, probes=tuple(map(tuple, run.position.tolist())))
    light = illuminate(scenes[0].scene, run.volume.grid, config, "direct", seed=scenes[0].seed)
    position, normal = scenes[0].position, scenes[0].normal
    found = Lpv(light.grid, config)(light, light.receivers(position, normal)).detach().numpy()
    np.testing.assert_allclose(found, run.lookup(run.solve()), rtol=1e-4, atol=1e-6)
    content = run.content(run.volume.solve())
    rows, normals = run._reads(position, normal)
    np.testing.assert_allclose(found, probe_irradiance(rows, content, normals).numpy(), rtol=1e-4, atol=1e-6)
