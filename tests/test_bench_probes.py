"""Probes in ``difflpv bench``: closed forms, where they stand, and what they cost."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hand_scenes import box_scene, box_walls

from data_gen.freespace import default_clearance, is_free
from difflpv.bench.configuration import Configuration, chosen
from difflpv.bench.measure import errors, measure, prepare
from difflpv.bench.probes import LitProbes, ProbeRun
from difflpv.bench.scenes import bench_scenes
from difflpv.config import LpvConfig
from difflpv.probes.lookup import probe_irradiance
from difflpv.probes.rows import Rows
from difflpv.sampling import sample_irradiance
from difflpv.scene import AreaLight, Scene
from difflpv.triangle_distance import triangle_distance

TRACED, LIT = "probes 64, path-traced", "probes 64, LPV-lit, 16 cells"


@pytest.fixture(scope="module")
def cornell(tmp_path_factory):
    return bench_scenes("cornell", tmp_path_factory.mktemp("truth"), components=("bounce1",), receivers=60, spp=256)[0]


@pytest.fixture(scope="module")
def lit(cornell):
    return prepare(chosen([LIT])[0], cornell)


def test_probes_of_an_enclosure_of_equal_radiance_read_back_pi_times_it(cornell):
    walls, radiance = box_walls(albedo=(0, 0, 0)), np.array([1.0, 2.0, 0.5])
    furnace = Scene("furnace", walls, tuple(AreaLight(wall.name, radiance) for wall in walls))
    position = np.random.default_rng(0).uniform(-1, 1, (60, 3)) * [1, 0, 1] - [0, 1, 0]
    normal, truth = np.tile((0.0, 1.0, 0.0), (60, 1)), np.tile(np.pi * radiance, (60, 1))
    scene = replace(cornell, scene=furnace, component="direct", position=position, normal=normal, truth=truth)
    (configuration,) = chosen([TRACED])
    run = prepare(replace(configuration, samples=1024), scene)
    assert isinstance(run, ProbeRun) and len(run.position) == 64
    assert list(run.setup) == ["probes", "receivers"] and run.lights == 0
    found = run.lookup(run.solve())
    np.testing.assert_allclose(found, truth, rtol=0.03)
    assert errors(found, scene)["error"] < 0.01
    np.testing.assert_array_equal(run.predict(position, normal), found)  # the same paths


def test_content_of_a_constant_volume_is_what_receivers_read_of_it(lit):
    assert isinstance(lit, LitProbes)
    grid = lit.volume.grid
    gains = torch.tensor(lit.volume.config.stencil.lookup_gains).repeat_interleave(torch.tensor([1, 3, 5]))
    held = torch.randn(3, 9, generator=torch.Generator().manual_seed(0))
    volume = held[:, :, None, None, None].expand(3, 9, *grid.shape).contiguous()
    count = len(lit.position)
    normal = torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    rows = Rows(torch.arange(count)[:, None], torch.ones(count, 1))  # every probe by itself
    found = probe_irradiance(rows, lit.content((volume,)), normal)
    position = torch.as_tensor(lit.position, dtype=torch.float32)
    expected = sample_irradiance(volume * gains[:, None, None, None], position, normal, grid)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)


def test_probes_stand_in_free_space_and_hardly_any_is_wasted(cornell, lit):
    assert 0.8 * 64 <= len(lit.position) <= 64
    low, high = cornell.scene.bounds
    assert ((lit.position > low) & (lit.position < high)).all()
    assert triangle_distance(cornell.scene.triangle_vertices, lit.position).min() >= default_clearance((low, high))
    assert is_free(cornell.scene, lit.position, seed=7).all()


def test_the_box_is_the_scenes_own_and_no_free_space_is_one_clear_error(cornell):
    one = replace(chosen([TRACED])[0], probes=1)
    room = box_scene()
    solid = tuple(replace(wall, name=f"solid {wall.name}") for wall in box_walls([-0.15] * 3, [0.15] * 3))
    np.testing.assert_allclose(prepare(one, replace(cornell, scene=room)).position, [[0, 0, 0]], atol=1e-12)
    with pytest.raises(ValueError, match="probes: none of at most 1 on a uniform grid of 'full' lies in free space"):
        prepare(one, replace(cornell, scene=Scene("full", room.meshes + solid, room.lights)))
    floor = replace(cornell, scene=Scene("floor", room.meshes[2:3], room.lights))  # at y = -1, with its grid's depth
    assert np.ptp(prepare(replace(one, probes=8), floor).position[:, 1]) > 0


def test_both_kinds_beat_a_constant_and_are_timed_in_two_parts(cornell):
    found = {p.name: p for p in measure(chosen(["constant", TRACED, LIT]), cornell, repeats=1, memory=False)}
    for name in (TRACED, LIT):
        p = found[name]
        assert p.error < 0.8 * found["constant"].error  # 0.27 and 0.2 of 0.54
        assert p.both is None and p.seconds == p.solve.median + p.lookup.median
        assert {"probes", "receivers"} <= set(p.setup_seconds)
    assert found[LIT].lights_seconds > 0


def test_configurations_of_probes_check_themselves():
    config = LpvConfig(method="learned_4x6")
    for wrong, message in (
        ({"kind": "traced probes", "samples": 4}, "probes: expected for"),
        ({"kind": "traced probes", "probes": 4}, "samples: expected for"),
        ({"kind": "lit probes", "probes": 4}, "config: expected for"),
        ({"kind": "lit probes", "probes": 4, "config": config}, "9 coefficients"),
        ({"kind": "paths", "samples": 4, "probes": 4}, "probes: expected for"),
        ({"kind": "traced probes", "samples": 4, "probes": 0}, "at least 1"),
    ):
        with pytest.raises(ValueError, match=message):
            Configuration("x", **{"family": "traced probes", **wrong})
    assert [c.name for c in chosen(quick=True) if c.probes] == [TRACED]
