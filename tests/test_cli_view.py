"""``difflpv view``: its options, its picture, and its page in a real browser."""

import argparse
import io
import json
import re
import signal
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from chromium import Browser, find_chromium
from cli_room import difflpv, make_targets, write_room
from PIL import Image

from difflpv.cli import view
from difflpv.config import LpvConfig, grid_for
from difflpv.io import load_scene
from difflpv.io.srgb import linear_to_srgb
from difflpv.pipeline import Lpv
from difflpv.probes.probe_files import ProbeRecord, save_probes
from difflpv.probes.probe_set import ProbeSet
from difflpv.report.picture import picture
from difflpv.sh import cosine_lobe
from difflpv.viewer.look import Look, layers
from difflpv.viewer.probe_view import ProbeView
from difflpv.viewer.state import Knobs, ViewState

ROOM = ("--method", "learned_9x6", "--grid", 6, "--steps", 5, "--facets", 100)


@pytest.fixture
def room(tmp_path):
    return write_room(tmp_path)


def test_probe_grid_leaves_solids_out_however_they_are_wound():
    scene, asked = load_scene("cornell"), argparse.Namespace(probes=None, probe_grid=8)
    kept = view._probes(asked, scene).position
    short = (np.abs(kept - [0.89, 0.8, 1.06]) < [0.6, 0.6, 0.6]).all(1)  # well within the short block
    assert not short.any() and 400 < len(kept) < 512
    turned = replace(scene, meshes=tuple(replace(m, triangles=m.triangles[:, ::-1]) for m in scene.meshes))
    turned = turned.with_lights([replace(light, two_sided=True) for light in scene.lights])
    np.testing.assert_array_equal(view._probes(asked, turned).position, kept)


@pytest.mark.slow
def test_picture_of_probes_from_a_file(room, tmp_path, capsys):
    radiance = cosine_lobe(np.array([[0.0, 0, 1]]), 2)[:, :, None] * np.ones(3)
    save_probes(tmp_path / "probes", ProbeRecord(ProbeSet(np.array([[0.2, 0.1, 0.4]]), radiance)))
    out = tmp_path / "new" / "view.png"
    capsys.readouterr()
    assert difflpv("view", room, *ROOM, "--probes", tmp_path / "probes", "--png", out, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["png"] == str(out) and told["relative_l2"] is None
    with Image.open(out) as image:
        assert image.width > 2 * image.height


@pytest.mark.slow
def test_errors_are_those_of_evaluate(room, tmp_path, capsys):
    targets = make_targets(tmp_path, room)
    capsys.readouterr()
    options = ("--targets", targets, "--light", 1, "--component", "bounce1")
    assert difflpv("view", room, *ROOM, *options, "--png", tmp_path / "view.png", "--json") == 0
    shown = json.loads(capsys.readouterr().out)["relative_l2"]
    solve = ROOM[: ROOM.index("--facets")]
    assert difflpv("evaluate", room, *solve, "--targets", targets, "--component", "bounce1", "--json") == 0
    scores = json.loads(capsys.readouterr().out)["scores"]
    (judged,) = [s for s in scores if s["method"] == "learned_9x6" and s["light"] == 1]
    assert shown == pytest.approx(judged["relative_l2"], rel=1e-4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--png", "view.jpg"), "--png: expected a file name ending in .png, got view.jpg"),
        (("--host", "nowhere.invalid"), "--host nowhere.invalid: cannot listen there: "),
        (("--host", "192.0.2.1"), "--host 192.0.2.1: cannot listen there: Cannot assign requested address"),
        (("--port", 70000), "--port: expected at most 65535, got 70000"),
        (("--png", "v.png", "--height", 9), "--height: expected a place within the grid, -1.5..1.7 m, got 9"),
        (("--png", "v.png", "--step", 6), "--step: expected at most the 5 steps of the solve, got 6"),
        (("--png", "v.png", "--probes", "a", "--probe-grid", 2), "--probe-grid: --probes already says"),
        (("--png", "v.png", "--probes", "nowhere"), "nowhere/probes.json: "),
        (("--png", "v.png", "--targets", "t", "--lights", "x.json"), "--lights: with --targets"),
    ],
)
def test_bad_options_are_one_line(room, options, message, capsys):
    if "--height" in options:
        options = (*options, "--axis", "x")
    assert difflpv("view", room, *ROOM, *options) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"difflpv: error: {message}") and err.count("\n") == 1


def test_without_viser_one_line_says_what_to_install(room, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert difflpv("view", room) == 2
    assert capsys.readouterr().err == (
        "difflpv: error: the page needs viser: pip install 'difflpv[view]' (--png draws without it)\n"
    )


class Served:
    """``difflpv view`` in a process of its own."""

    def __init__(self, *arguments):
        command = [sys.executable, "-m", "difflpv.cli", "view", *map(str, arguments), "--port", "18080", "--json"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        line = self.process.stdout.readline()
        assert line, self.process.stderr.read()
        self.told = json.loads(line)

    def interrupt(self):
        self.process.send_signal(signal.SIGINT)
        out, err = self.process.communicate(timeout=60)
        return self.process.returncode, out, err

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate()


def region(png, x, y):
    """Mean colour around a place given as shares of the width and height."""
    with Image.open(io.BytesIO(png)) as image:
        pixels = np.asarray(image.convert("RGB"), float)
    h, w = pixels.shape[:2]
    return pixels[int(y * h) - 4 : int(y * h) + 4, int(x * w) - 4 : int(x * w) + 4].mean((0, 1))


def set_slider(browser, label, value):
    """Type a value into the number beside the slider of ``label`` (arrow keys would turn the camera too)."""
    found = browser.run(
        f"""(() => {{
            let box = [...document.querySelectorAll('label')].find(l => l.textContent.trim() === {json.dumps(label)});
            while (box && !box.querySelector('input[type=text]')) box = box.parentElement;
            const field = box.querySelector('input[type=text]');
            field.focus();
            field.select();
            return field.value;
        }})()"""
    )
    assert found is not None
    browser.type(str(value))
    browser.run("document.activeElement.blur()")


def own_pictures(*intensities, width, height):
    """What the page should show of the surfaces, drawn without it: PNG bytes for each intensity of the light."""
    scene = load_scene("cornell")
    state = ViewState(scene, Lpv(grid_for(scene, 16), LpvConfig(method="learned_9x6", steps=16)), facets=3000)
    look, camera = Look(lobes=False, probes=False), replace(scene.cameras[0], width=width, height=height)
    for intensity in intensities:
        solved = state.solve(Knobs(1.0, 1.0, (intensity,), ((0.0, 0.0, 0.0),)))
        (drawn,) = (m() for n, _, m in layers(state, solved, look, ProbeView.of(np.zeros((0, 3)))) if n == "surfaces")
        linear = picture(drawn, camera, width=width, samples=1)
        out = io.BytesIO()
        Image.fromarray(np.round(255 * linear_to_srgb(linear)).astype(np.uint8)).save(out, "PNG")
        yield out.getvalue()


@pytest.mark.slow
@pytest.mark.skipif(find_chromium() is None, reason="no Chromium (apt-get install chromium, or CHROMIUM=path)")
def test_page_shows_the_scene_and_follows_its_sliders(tmp_path):
    pytest.importorskip("viser")
    options = ("--method", "learned_9x6", "--grid", 16, "--steps", 16, "--facets", 3000, "--probe-grid", 3)
    with Served("cornell", *options) as served, closing(Browser(find_chromium(), width=1500, height=800)) as browser:
        assert re.fullmatch(r"http://localhost:\d+", served.told["url"]) and "ssh -L" in served.told["ssh"]
        browser.open(served.told["url"])

        def until(condition, what):
            deadline = time.monotonic() + 120
            while time.monotonic() < deadline:
                png = browser.screenshot()
                if condition(png):
                    return png
                time.sleep(0.5)
            (tmp_path / "page.png").write_bytes(png)
            said = browser.run("document.body.innerText")[-500:]
            raise AssertionError(f"the page never showed {what} (see {tmp_path / 'page.png'}); it says: {said}")

        left, right = (0.239, 0.3), (0.761, 0.3)  # of the window: the red and the green wall, before the slice

        bright, dim = own_pictures(1.0, 0.25, width=1500, height=800)
        red, green = region(bright, *left), region(bright, *right)
        assert red[0] > 2 * red[1:].max() and red[0] > 60 and green[1] > 1.3 * green[[0, 2]].max() and green[1] > 60
        assert region(dim, *left)[0] < 0.7 * red[0]

        def like(expected):
            return lambda png: all(np.abs(region(png, *at) - region(expected, *at)).max() < 2 for at in (left, right))

        until(like(bright), "the red and the green wall in their colours")
        set_slider(browser, "intensity", -2)  # stops
        until(like(dim), "them under a quarter of the light")
        code, out, err = served.interrupt()
    assert code == 0 and "Traceback" not in err + out
