"""Targets for placing probes: closed forms, signs, equal bits, resume, recognition; and the task made of them."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from hand_scenes import box_scene, box_walls, rectangle

from data_gen import blocks
from data_gen.freespace import default_clearance, is_free
from data_gen.load import TargetsError, load_targets
from data_gen.probe_targets import load_probe_targets, make_probe_targets
from data_gen.request import make_folder
from difflpv.placement.from_targets import placement_task, split_points
from difflpv.scene import AreaLight, DirectionalLight, PointLight, Scene
from difflpv.sh import sh_basis
from difflpv.triangle_distance import triangle_distance

SMALL = {"count": 60, "cells": 6, "component": "bounce1", "spp": 64, "lattice_spp": 32, "seed": 3}
SUN = DirectionalLight(np.array([0.6, -0.8, 0.0]), np.array([3.0, 2.0, 1.0]))
ROOF = rectangle("roof", (-1, 1, -1), (0, 0, 2), (2, 0, 0))
CAMP = Scene("camp", (rectangle("floor", (-2, 0, -2), (0, 0, 4), (4, 0, 0)), ROOF), (SUN,))  # open on all sides


def block_room():
    """A room of 4 x 2 x 2 m with a closed box of 1 m in its right half, a solid."""
    solid = box_walls((0.5, -0.5, -0.5), (1.5, 0.5, 0.5))
    walls = box_walls((-2, -1, -1), (2, 1, 1))
    light = PointLight(np.array([-1.0, 0.2, 0.1]), np.array([2.0, 3.0, 4.0]))
    return Scene("block room", walls + tuple(replace(wall, name=f"block {wall.name}") for wall in solid), (light,))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return make_probe_targets(block_room(), tmp_path_factory.mktemp("probes") / "new", **SMALL, light_sets=two_lights())


def two_lights():
    light = {"type": "point", "position": [-1.0, 0.2, 0.1], "intensity": [1.0, 2.0, 3.0]}
    return [[light], [light | {"intensity": [2.0, 2.0, 2.0], "position": [0.0, 0.5, 0.5]}]]


def test_enclosure_of_equal_radiance_is_constant(tmp_path):
    """Every direction shows L: c_00 = L sqrt(4 pi), the others 0."""
    walls = box_walls(albedo=(0, 0, 0))
    radiance = np.array([1.0, 2.0, 0.5])
    furnace = Scene("furnace", walls, tuple(AreaLight(wall.name, radiance) for wall in walls))
    samples = {"spp": 2048, "lattice_spp": 1024}
    made = make_probe_targets(furnace, tmp_path, count=30, surface_share=0, cells=4, component="direct", **samples)
    expected = np.zeros((9, 3))
    expected[0] = radiance * np.sqrt(4 * np.pi)
    error = (made.radiance - expected) / np.maximum(made.standard_error, 1e-6)
    assert np.abs(error).max() < 6 and (made.standard_error / radiance).max() < 0.05
    assert np.abs(made.lattice[0, made.free].mean(0) - expected).max() < 0.15
    assert made.surface_count == 0 and len(made.points) == 30
    with pytest.raises(TargetsError, match="every surface emits"):
        make_probe_targets(furnace, tmp_path / "other", count=4, surface_share=1.0, cells=4)


def test_sun_has_exact_coefficients_where_it_shines_and_none_in_the_shadow(tmp_path):
    made = make_probe_targets(CAMP, tmp_path, count=80, cells=8, component="direct", spp=32, lattice_spp=32)
    expected = sh_basis(-SUN.direction[None], 2)[0][:, None] * SUN.irradiance

    def lit(x):
        return (x[..., 1] > 1) | (np.abs(x[..., 0] - 0.75 * (1 - x[..., 1])) > 1) | (np.abs(x[..., 2]) > 1)

    for x, radiance in ((made.points, made.radiance[0]), (made.grid.cell_centers()[made.free], made.lattice[0][made.free])):
        assert lit(x).any() and not lit(x).all()
        np.testing.assert_allclose(radiance, lit(x)[:, None, None] * expected, rtol=1e-6, atol=1e-6)
    assert not made.standard_error.any()
    low, high = CAMP.bounds  # neither over the roof nor under the floor
    assert ((made.points > low) & (made.points < high)).all() and made.surface_count == 20
    assert made.free.sum() == np.prod(np.array(made.grid.resolution) - 2)  # all cells within the bounds of an open scene


def test_points_are_free_and_the_last_lie_over_surfaces(made):
    scene = block_room()
    clearance = default_clearance(scene.bounds)
    assert clearance == pytest.approx(0.004 * 4) and made.surface_count == 15 and len(made.points) == 60
    distance = triangle_distance(scene.triangle_vertices, made.points)
    assert distance.min() >= clearance * (1 - 1e-5)
    np.testing.assert_allclose(distance[-15:], clearance, rtol=1e-5)
    assert np.median(distance[:-15]) > 0.1
    assert not inside_block(made.points).any() and is_free(scene, made.points, 9).all()
    assert not is_free(scene, np.array([[1.0, 0.1, 0.2]])).any()
    whole = make_probe_targets(scene, made.folder.parent / "surface", **(SMALL | {"count": 8, "surface_share": 1, "cells": 2}))
    assert whole.surface_count == len(whole.points) == 8


def inside_block(x):
    return (np.abs(x - [1.0, 0, 0]) < 0.5).all(-1)


def test_clearance_is_negative_in_the_block_and_beyond_the_walls(made):
    x = made.grid.cell_centers()
    assert made.grid.resolution == (8, 5, 5)  # 6 cells along 4 m, 3 along 2 m, and one more on every side
    wall = (np.array([2.0, 1, 1]) - np.abs(x)).min(-1)
    block = np.linalg.norm(np.maximum(np.abs(x - [1.0, 0, 0]) - 0.5, 0), axis=-1)
    depth = (0.5 - np.abs(x - [1.0, 0, 0])).min(-1)
    beyond = np.linalg.norm(np.maximum(np.abs(x) - [2.0, 1, 1], 0), axis=-1)
    expected = np.where(inside_block(x), -depth, np.where(wall > 0, np.minimum(wall, block), -beyond))
    assert inside_block(x).any() and (beyond > 0).any()
    np.testing.assert_allclose(made.clearance, expected, atol=1e-9)
    assert not made.lattice[:, ~made.free].any()
    assert (made.lattice[:, made.free, 0] > 0).all()


def test_centres_on_a_wall_hold_no_light(tmp_path):
    """An odd number of cells puts centres on the wall at x = 0: rays from there see either side of it."""
    wall = rectangle("wall", (0, -1, -1), (0, 2, 0), (0, 0, 2))
    scene = box_scene()
    made = make_probe_targets(replace(scene, meshes=(*scene.meshes, wall)), tmp_path, **(SMALL | {"cells": 5, "count": 8}))
    on_wall = np.abs(made.grid.cell_centers()[..., 0]) < 1e-9
    assert on_wall.any() and not made.free[on_wall].any() and not made.lattice[:, on_wall].any()


def test_points_and_cells_have_random_numbers_of_their_own(tmp_path):
    """Where points are the centres of cells, equal numbers would give equal light."""
    points = blocks.JobPart(blocks.Components.of(["bounce1"]), 4, 2)
    x = np.random.default_rng(0).uniform(-0.5, 0.5, (4, 3))
    job = blocks.Job((box_scene(),), {"probes": points, "lattice": points}, 0, *np.empty((2, 0, 3)), probes=x, lattice=x)
    found = [blocks.compute_block(job, {}, blocks.Block(0, quantity, 0, 0))[0] for quantity in ("probes", "lattice")]
    assert (found[0] != found[1]).any() and np.allclose(found[0].mean((0, 1)), found[1].mean((0, 1)), rtol=0.5, atol=0.2)


def assert_same(a, b):
    for name in ("points", "radiance", "standard_error", "lattice", "clearance"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_interrupted_run_goes_on_and_workers_change_no_bit(made, tmp_path, monkeypatch):
    compute, done, again = blocks.compute_block, [], []

    def interrupted(job, tracers, block):
        if len(done) == 3:
            raise KeyboardInterrupt
        done.append(block)
        return compute(job, tracers, block)

    def counted(job, tracers, block):
        again.append(block)
        return compute(job, tracers, block)

    monkeypatch.setattr(blocks, "compute_block", interrupted)
    with pytest.raises(KeyboardInterrupt):
        make_probe_targets(block_room(), tmp_path, light_sets=two_lights(), **SMALL)
    with pytest.raises(TargetsError, match="not finished"):
        load_probe_targets(tmp_path)
    monkeypatch.setattr(blocks, "compute_block", counted)
    resumed = make_probe_targets(block_room(), tmp_path, light_sets=two_lights(), **SMALL)
    assert again and set(again).isdisjoint(done)
    assert_same(resumed, made)
    assert not list(tmp_path.glob(".blocks-*"))
    monkeypatch.setattr(blocks, "compute_block", None)
    assert_same(make_probe_targets(block_room(), tmp_path, light_sets=two_lights(), **SMALL), made)  # recognised


@pytest.mark.slow
def test_two_workers_give_the_same_bits(made, tmp_path):
    assert_same(make_probe_targets(block_room(), tmp_path, light_sets=two_lights(), workers=2, **SMALL), made)


def test_manifest_tells_lights_samples_and_noise(made):
    assert made.light_sets == tuple([dict(entry) for entry in entries] for entries in two_lights())
    assert [(row["spp"], row["lattice_spp"]) for row in made.manifest["lights"]] == [(64, 32)] * 2
    for row, radiance, error in zip(made.manifest["lights"], made.radiance, made.standard_error, strict=True):
        rms = [np.sqrt((values.astype(float) ** 2).mean()) for values in (error, radiance)]
        assert row["noise"]["points"] == pytest.approx(rms[0] / rms[1], rel=1e-4)
    assert made.component == made.manifest["request"]["component"] == "bounce1"
    assert made.manifest["rays"] > 1000 and made.manifest["request"]["scene"]["hash"] == block_room().hash


def test_other_requests_damage_and_bad_arguments_are_refused(made, tmp_path):
    scene = block_room()
    with pytest.raises(TargetsError, match=r"another request \(different lights, points, component\)"):
        make_probe_targets(scene, made.folder, **(SMALL | {"component": "direct", "count": 61}))
    with pytest.raises(TargetsError, match="of targets: 'difflpv probes targets' made it, expected 'difflpv targets'"):
        load_targets(made.folder)
    tiny = {"count": 4, "cells": 3, "spp": 32, "lattice_spp": 32}
    kept = make_probe_targets(scene, tmp_path, **tiny)
    assert make_probe_targets(scene, tmp_path, seed=1, overwrite=True, **tiny).manifest["request"]["seed"] == 1
    table = tmp_path / "probe_targets.npz"
    table.write_bytes(table.read_bytes()[:-8])
    with pytest.raises(TargetsError, match="was changed"):
        load_probe_targets(tmp_path)
    with pytest.raises(TargetsError, match="lattice: expected shape"):
        replace(kept, lattice=kept.lattice[:, 1:])
    for option, value in (("count", 0), ("cells", 0), ("spp", 0), ("surface_share", 1.5), ("light_sets", []), ("workers", 0)):
        with pytest.raises(TargetsError, match=option):
            make_probe_targets(scene, tmp_path / "other", **{option: value})
    with pytest.raises(TargetsError, match="expected direct, bounce1"):
        make_probe_targets(scene, tmp_path / "other", component="bounce")
    assert not (tmp_path / "other").exists()


def test_task_has_the_light_of_the_chosen_lights_and_points(made):
    scene = block_room()
    train, test = split_points(made, 0.6, seed=2)
    assert len(np.intersect1d(train, test)) == 0 and len(train) + len(test) == 60
    assert (train >= 45).sum() == 9 and (test >= 45).sum() == 6  # of 15 over surfaces
    assert np.array_equal(train, split_points(made, 0.6, seed=2)[0]) and not np.array_equal(
        train, split_points(made, 0.6, seed=1)[0]
    )
    task = placement_task(scene, made, lights=[1, 0], points=train)
    np.testing.assert_array_equal(task.points, made.points[train])
    for channel, (light, rgb) in enumerate([(1, 0), (1, 1), (1, 2), (0, 0), (0, 1), (0, 2)]):
        np.testing.assert_array_equal(task.radiance[:, :, channel], made.radiance[light][train, :, rgb])
        np.testing.assert_array_equal(
            task.field.values[..., channel].numpy()[made.free], made.lattice[light][made.free][..., rgb]
        )
    assert (task.field.values[..., 0, :] > 0).all()  # walls and block hold their neighbours' light
    centers = made.grid.cell_centers().reshape(-1, 3)
    np.testing.assert_array_equal(task.clearance(torch.as_tensor(centers)).numpy() > 0, made.free.ravel())
    assert not task.in_free_space(np.array([[1.0, 0, 0], [2.2, 0, 0], [0, 9.0, 0]])).any()
    assert placement_task(scene, made, points=slice(10, 14)).radiance.shape == (4, 9, 6)


def test_task_refuses_what_does_not_fit(made):
    for options, message in (({"lights": [2]}, "from 0 to 1"), ({"lights": []}, "lights"), ({"points": [60]}, "of 60 points")):
        with pytest.raises(ValueError, match=message):
            placement_task(block_room(), made, **options)
    with pytest.raises(TargetsError, match="another scene"):
        placement_task(box_scene(), made)
    for share in (0, 1, 1e-9):
        with pytest.raises(ValueError, match="share"):
            split_points(made, share)


@pytest.mark.skipif(os.name != "posix", reason="needs flock")
@pytest.mark.parametrize("seeds", [(5, 5), (5, 6)])
def test_two_runs_at_once_in_one_folder_do_not_mix(seeds, tmp_path, monkeypatch):
    """The second waits; it finds what the first made, or is told that another request is there."""
    computed = []
    monkeypatch.setattr(blocks, "compute_block", lambda *a, real=blocks.compute_block: (computed.append(a[2]), real(*a))[1])
    tiny = {"count": 4, "cells": 3, "spp": 32, "lattice_spp": 32}
    both_asked = threading.Barrier(2, timeout=60)
    monkeypatch.setattr("data_gen.probe_targets.make_folder", lambda out: (make_folder(out), both_asked.wait()))

    def run(seed):
        try:
            return make_probe_targets(block_room(), tmp_path, seed=seed, **tiny)
        except TargetsError as error:
            return str(error)

    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(run, seeds)
    assert len(computed) == len(set(computed)) == 2
    refused = [found for found in (first, second) if isinstance(found, str)]
    if seeds[0] == seeds[1]:
        assert not refused and np.array_equal(first.radiance, second.radiance)
    else:
        assert len(refused) == 1 and "holds targets of another request (different seed)" in refused[0]
