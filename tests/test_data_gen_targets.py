"""Targets on disk: equal bits, resume, recognition, messages, files."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from data_gen import blocks
from data_gen.blocks import Block, BlockRunner, BlockStore, WorkerError, round_samples
from data_gen.few_paths import PathPool
from data_gen.load import TargetsError, load_targets
from data_gen.receivers import draw_receivers
from data_gen.targets import make_targets
from data_gen.workers import start_pool
from difflpv.io import load_scene
from difflpv.io.exr import read_image
from difflpv.io.tables import load_table
from difflpv.lights import apply_light_set, load_light_sets
from difflpv.scene import Camera

OPTIONS = {"receiver_count": 300, "components": ("direct", "upto2", "full"), "spp": 1024, "seed": 4}


@pytest.fixture(scope="module")
def cornell():
    return load_scene("cornell")


@pytest.fixture(scope="module")
def light_sets():
    return load_light_sets(None, "cornell")[:2]


@pytest.fixture(scope="module")
def made(tmp_path_factory, cornell, light_sets):
    folder = tmp_path_factory.mktemp("targets") / "new" / "cornell"
    return make_targets(cornell, folder, light_sets=light_sets, probes=6, probe_spp=64, **OPTIONS)


def assert_same_tables(a, b):
    names = sorted(p.name for p in a.glob("*.npz"))
    assert names == sorted(p.name for p in b.glob("*.npz"))
    for name in names:
        one, two = load_table(a / name), load_table(b / name)
        assert one.keys() == two.keys()
        for key in one:
            np.testing.assert_array_equal(one[key], two[key], err_msg=f"{name} {key}")


def test_what_is_made(made, cornell, light_sets):
    assert made.components == OPTIONS["components"]
    assert len(made.lights) == 2 and len(made.receivers) == 300
    assert made.probe_positions.shape == (6, 3)
    for light, entries in zip(made.lights, light_sets, strict=True):
        assert light.entries == [dict(entry) for entry in entries]
        assert apply_light_set(cornell, light.entries).hash == made.manifest["lights"][light.index]["hash"]
        for name in made.components:
            assert light.irradiance[name].shape == light.standard_error[name].shape == (300, 3)
        assert (light.irradiance["full"] >= light.irradiance["upto2"]).all()
        assert (light.irradiance["upto2"] >= light.irradiance["direct"]).all()
        assert set(light.probe_sh) == {"direct", "bounce1", "full_indirect"}
        assert light.probe_sh["bounce1"].shape == light.probe_standard_error["bounce1"].shape == (6, 9, 3)
    table = load_table(made.folder / "light_0.npz")
    assert {"position", "normal", "albedo", "area_weight", "mesh_id", "irr_direct", "se_direct"} <= set(table)
    manifest = made.manifest
    assert manifest["request"]["scene"] == {"name": "cornell", "hash": cornell.hash}
    assert manifest["lights"][0]["spp"] == 1024 and manifest["rays"] > 1e6 and manifest["seconds"] > 0
    assert {"numpy", "embreex", "python"} <= set(manifest["versions"])
    assert not list(made.folder.glob(".blocks-*"))


def test_receivers_behind_the_panel_have_no_weight(made):
    panels = [np.array(light.entries[0]["vertices"]) for light in made.lights]
    for light, panel in zip(made.lights, panels, strict=True):
        x = made.receivers.position
        over = ((x >= panel.min(0) - 1e-9) & (x <= panel.max(0) + 1e-9))[:, [0, 2]].all(1)
        behind = over & (x[:, 1] > 5.49)
        np.testing.assert_array_equal(light.area_weight == 0, behind)
    assert (made.receivers.area_weight > 0).all()


def test_relit_moved_light_changes_the_result(made):
    first, second = made.lights
    assert np.abs(first.irradiance["direct"] - second.irradiance["direct"]).max() > 0.1


@pytest.mark.slow
def test_two_workers_give_the_same_bits(made, cornell, light_sets, tmp_path):
    make_targets(cornell, tmp_path, light_sets=light_sets, probes=6, probe_spp=64, workers=2, **OPTIONS)
    assert_same_tables(made.folder, tmp_path)


def test_interrupted_run_goes_on_where_it_stopped(made, cornell, light_sets, tmp_path, monkeypatch):
    compute, done = blocks.compute_block, []

    def interrupted(job, tracers, block):
        if len(done) == 3:
            raise KeyboardInterrupt
        done.append(block)
        return compute(job, tracers, block)

    options = {"light_sets": light_sets, "probes": 6, "probe_spp": 64} | OPTIONS
    monkeypatch.setattr(blocks, "compute_block", interrupted)
    with pytest.raises(KeyboardInterrupt):
        make_targets(cornell, tmp_path, **options)
    assert not (tmp_path / "manifest.json").exists()
    with pytest.raises(TargetsError, match="not finished"):
        load_targets(tmp_path)
    folder = next(tmp_path.glob(".blocks-*"))
    damaged = BlockStore(folder).path(done[0])
    damaged.write_bytes(damaged.read_bytes()[:100])  # a damaged block is computed again
    again = []

    def counted(job, tracers, block):
        again.append(block)
        return compute(job, tracers, block)

    monkeypatch.setattr(blocks, "compute_block", counted)
    make_targets(cornell, tmp_path, **options)
    assert set(again).isdisjoint(done[1:]) and done[0] in again
    assert_same_tables(made.folder, tmp_path)


def test_finished_targets_are_not_repeated(made, cornell, light_sets, monkeypatch):
    monkeypatch.setattr(blocks, "compute_block", None)
    stamp = (made.folder / "manifest.json").stat().st_mtime_ns
    again = make_targets(cornell, made.folder, light_sets=light_sets, probes=6, probe_spp=64, **OPTIONS)
    assert (made.folder / "manifest.json").stat().st_mtime_ns == stamp
    np.testing.assert_array_equal(again.lights[0].irradiance["full"], made.lights[0].irradiance["full"])


def test_other_request_is_refused_and_can_overwrite(cornell, tmp_path):
    small = {"receiver_count": 20, "components": ("direct",), "spp": 32}
    make_targets(cornell, tmp_path, **small)
    with pytest.raises(TargetsError, match=r"another request \(different receivers, seed\)"):
        make_targets(cornell, tmp_path, **(small | {"receiver_count": 21, "seed": 1}))
    other = replace(cornell, name="box", lights=(replace(cornell.lights[0], radiance=np.ones(3)),))
    with pytest.raises(TargetsError, match="different scene"):
        make_targets(other, tmp_path, **small)
    targets = make_targets(other, tmp_path, overwrite=True, **small)
    targets.check_scene(other)
    with pytest.raises(TargetsError, match="belong to another scene: made for 'box'"):
        targets.check_scene(cornell)
    assert targets.lights[0].entries[0]["radiance"] == [1, 1, 1]


def test_damaged_targets_have_clear_messages(cornell, tmp_path):
    with pytest.raises(TargetsError, match="no such folder"):
        load_targets(tmp_path / "none")
    with pytest.raises(TargetsError, match=r"no manifest\.json"):
        load_targets(tmp_path)
    make_targets(cornell, tmp_path, receiver_count=20, components=("direct",), spp=32)
    manifest, table = tmp_path / "manifest.json", tmp_path / "light_0.npz"
    text, content = manifest.read_text(), table.read_bytes()
    table.write_bytes(content[:-10])
    with pytest.raises(TargetsError, match=r"light_0\.npz: was changed"):
        load_targets(tmp_path)
    table.unlink()
    with pytest.raises(TargetsError, match=r"light_0\.npz: missing"):
        load_targets(tmp_path)
    for bad, message in (
        (text[:50], "damaged manifest"),
        ("[]", "not a manifest of targets"),
        (text.replace('"format": 1', '"format": 99', 1), "format 99, this version reads format 1"),
        (json.dumps({"kind": "difflpv-targets", "format": 1}), "'request' is missing"),
    ):
        manifest.write_text(bad)
        with pytest.raises(TargetsError, match=message) as error:
            load_targets(tmp_path)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spp": 0}, "spp: expected an integer >= 1, got 0"),
        ({"spp": 10**7}, "spp: expected at most 2097152"),
        ({"seed": -1}, "seed: expected an integer >= 0"),
        ({"spp": 16, "target_error": 0.1}, "spp or target_error, not both"),
        ({"target_error": 1.5}, "share between 0 and 1"),
        ({"workers": 0}, "workers"),
        ({"components": ("bounce9",)}, "component 'bounce9': expected direct"),
        ({"components": ()}, "at least one"),
        ({"light_sets": []}, "at least one light set"),
        ({"receiver_count": 0}, "receiver_count"),
    ],
)
def test_arguments(cornell, tmp_path, options, message):
    with pytest.raises(TargetsError, match=message):
        make_targets(cornell, tmp_path, **options)
    assert not list(tmp_path.iterdir())


def test_images_need_a_camera(cornell, tmp_path):
    with pytest.raises(TargetsError, match="no camera"):
        make_targets(replace(cornell, cameras=()), tmp_path, images=True)


def test_target_error_is_reached_with_given_receivers(cornell, tmp_path):
    receivers = draw_receivers(cornell, 64, 1)
    targets = make_targets(cornell, tmp_path, receivers=receivers, components=("full", "bounce1"), target_error=0.02)
    light = targets.manifest["lights"][0]
    counted = targets.lights[0].area_weight > 0
    mean, error = (a["full"][counted] for a in (targets.lights[0].irradiance, targets.lights[0].standard_error))
    assert light["error"]["full"] == pytest.approx(error.mean() / mean.mean())
    assert light["error"]["full"] < 0.02
    assert light["spp"] > 512 and light["spp"] % 512 == 0
    np.testing.assert_array_equal(targets.receivers.position, receivers.position)
    gave_up = make_targets(
        cornell, tmp_path / "b", receivers=receivers, components=("full",), target_error=0.001, max_spp=512
    )
    assert gave_up.manifest["lights"][0]["spp"] == 512
    assert gave_up.manifest["lights"][0]["error"]["full"] > 0.001


def test_images(cornell, tmp_path):
    # from the middle of the room straight up at the panel, the green wall on the right
    up = np.array([[1.0, 0, 0, 0], [0, 0, -1, 2.75], [0, 1, 0, 0], [0, 0, 0, 1]])
    scene = replace(cornell, cameras=(Camera(up, 1.6, 32, 24),))
    targets = make_targets(scene, tmp_path, receiver_count=8, components=("direct", "full"), spp=32, images=True,
                           image_spp=64)  # fmt: skip
    light = targets.lights[0]
    assert set(light.images) == {"direct", "full"}
    direct, error = read_image(light.images["direct"])
    full, _ = read_image(light.images["full"])
    assert direct.shape == error.shape == (24, 32, 3)
    assert (full - direct >= -1e-6).all() and (error > 0).any()
    # the visible panel shows its radiance, in every component that holds the direct light
    for image in (direct, full):
        np.testing.assert_allclose(image[11:13, 15:17].mean((0, 1)), cornell.lights[0].radiance, rtol=1e-5)
    assert light.images["full"].with_suffix(".png").is_file()
    assert full[12, 30, 1] > 1.5 * full[12, 30, 0]


def test_round_samples_cover_what_was_asked():
    for spp in (1, 31, 32, 33, 100, 512, 513, 4096):
        samples, rounds = round_samples(spp)
        assert samples & (samples - 1) == 0 and 32 * samples * rounds >= spp
        assert 32 * samples * (rounds - 1) < spp
    assert round_samples(4096) == (16, 8)


@pytest.mark.slow
def test_dead_worker_is_told(cornell, tmp_path):
    from data_gen.blocks import Job, JobPart
    from data_gen.components import Components

    class Bomb:
        """Unpickling this in a worker ends the worker."""

        def __reduce__(self):
            return (sys.exit, (3,))

    job = Job((cornell,), {"surface": JobPart(Components.of(["direct"]), 1, 1)}, 0, np.zeros((1, 3)), Bomb(), None)
    with (
        pytest.raises(WorkerError, match="finished blocks are kept"),
        BlockRunner(job, BlockStore(tmp_path), workers=2) as runner,
    ):
        runner.run([Block(0, "surface", 0, 0)], "surface")


@pytest.mark.slow
def test_workers_leave_ctrl_c_to_their_parent():
    """A terminal sends it to all processes at once; a worker that died of it would take its block along."""
    pool = PathPool(load_scene("cornell"), workers=2)
    try:
        assert pool._pool.submit(signal.getsignal, signal.SIGINT).result() == signal.SIG_IGN
        x = np.array([[0.0, 1.0, 0.0], [0.5, 1.0, 0.0]])
        assert pool.trace(x, np.array([[0, 1.0, 0]] * 2), "direct", samples=4, seed=0).shape == (2, 3)
        assert pool.trace_probes(x, "direct", samples=4, seed=0).shape == (2, 9, 3)
    finally:
        pool.close()


def test_workers_start_without_torch_warp_and_scipy():
    code = (
        "import sys, data_gen.targets, data_gen.blocks\n"
        "print([m for m in ('torch', 'warp', 'scipy', 'trimesh', 'kornia') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.skipif(os.name != "posix", reason="needs SIGINT")
def test_workers_that_are_still_starting_do_not_hear_ctrl_c():
    pool = start_pool(1)
    try:
        found = pool.submit(os.getpid)
        (process,) = list(pool._processes)
        os.kill(process, signal.SIGINT)
        assert found.result(timeout=120) == process
    finally:
        pool.shutdown()
