"""``difflpv bench``: fronts, crossings, growth, what is kept, what is written, and its peers."""

import json
import math
import re

import numpy as np
import pytest
import torch

from difflpv.bench.baseline import compare, ratios, read_baseline
from difflpv.bench.breakeven import crossing
from difflpv.bench.configuration import Configuration, chosen
from difflpv.bench.equal_error import equal_paths
from difflpv.bench.growth import exponent
from difflpv.bench.images import flip, flip_unavailable
from difflpv.bench.measure import Point, errors
from difflpv.bench.mitsuba_peer import MitsubaRun, unavailable
from difflpv.bench.pareto import front_verdict, pareto_front
from difflpv.bench.peers import convolution, convolution_weight, eager_twin
from difflpv.bench.run import BenchResult, run_bench
from difflpv.bench.scenes import bench_scenes
from difflpv.bench.settings import BenchSettings
from difflpv.bench.store import Store, points_csv
from difflpv.bench.timing import Timing
from difflpv.cli import main
from difflpv.stencil_files import learned_stencil

TINY = BenchSettings(receivers=40, spp=64, image_width=16, image_spp=32, cell_spp=32, repeats=1, patience=0.01)
NAMES = ["constant", "LPV as published", "learned_9x6, 8 cells, 8 steps", "path tracer, 4", "probes 64, path-traced"]


def point(name, family, error, seconds, receivers=100):
    solve = None if seconds is None else Timing(seconds, seconds, seconds, 3)
    return Point(
        scene="s/bounce1", name=name, family=family, error=error, scaled_error=error, percentile_95=error, leak=None, ssim=None,
        flip=None, receivers=receivers, solve=solve, lookup=None, both=None, setup_seconds={}, lights_seconds=0.0,
        memory_bytes=None, memory_volumes=None,
    )  # fmt: skip


def test_nothing_on_the_front_is_beaten_and_everything_else_is():
    rng = np.random.default_rng(3)
    points = [point(str(i), "learned", *v) for i, v in enumerate(rng.uniform(0.1, 1, (60, 2)))]
    front = pareto_front(points)
    for p in points:
        beaten = any(q.error <= p.error and q.seconds <= p.seconds and q is not p for q in points)
        assert beaten != (p in front)


def test_what_is_no_better_than_a_constant_is_not_on_the_front():
    points = [point("constant", "constant", 0.5, None), point("LPV", "LPV", 2.0, 0.01), point("a", "learned", 0.2, 0.1)]
    assert [p.name for p in pareto_front(points)] == ["a"]


def test_the_verdict_says_what_the_scene_says():
    constant, old = point("constant", "constant", 0.5, None), point("HOLPV as published", "HOLPV", 0.3, 0.01)
    learned, traced = point("learned", "learned", 0.2, 0.1), point("path tracer, 4", "path tracer", 0.1, 0.001)
    said = front_verdict([constant, old, learned], ["HOLPV as published"])
    assert "1 learned rung" in said and "so do, as published: HOLPV as published" in said
    assert "none as published" in front_verdict([constant, learned], ["HOLPV as published"])
    assert "tracing paths beats them all" in front_verdict([constant, learned, traced], [])
    probes = point("probes 64, LPV-lit", "LPV-lit probes", 0.19, 0.05)
    said = front_verdict([constant, learned, traced, probes], [])
    assert "beats them all" in said and "On the front" not in said  # one sample is faster and nearer
    said = front_verdict([constant, learned, probes], [])
    assert "1 learned rung" in said and said.endswith("On the front of all methods: probes 64, LPV-lit.")
    assert "No learned rung" in front_verdict([constant, old], [])
    assert "No volume solve beats" in front_verdict([constant, point("LPV", "LPV", 2, 1)], [])


def test_exponent_of_a_power_law():
    sizes = [10, 100, 1000]
    assert exponent(sizes, [3 * n**0.7 for n in sizes]) == pytest.approx(0.7)
    with pytest.raises(ValueError, match="sizes: expected at least two positive"):
        exponent([1], [1])


def test_crossing_of_a_fixed_cost_and_a_cost_per_receiver():
    counts = [10**k for k in range(3, 8)]
    assert crossing(counts, [1.0] * 5, [n * 2e-5 for n in counts]) == pytest.approx(50_000)
    assert crossing(counts, [1e-9] * 5, [1.0] * 5) == 1000
    assert crossing(counts, [1.0] * 5, [0.5] * 5) is None


def test_paths_of_equal_error_follow_the_points_and_then_the_root():
    points = [point(f"path tracer, {n}", "path tracer", 2 / math.sqrt(n), 0.1) for n in (1, 4, 16)]
    assert equal_paths(points, "path tracer", 2 / math.sqrt(8)) == pytest.approx(8)
    assert equal_paths(points, "path tracer", 0.05) == pytest.approx(1600)
    assert equal_paths(points, "Mitsuba 3", 0.05) is None


def test_the_store_keeps_records_of_its_identity_and_survives_damage(tmp_path):
    path = tmp_path / "points.jsonl"
    Store(path, {"code": 1}).put({"a": {"x": 1}, "b": 2})
    path.write_text(path.read_text() + "{half a li")
    assert Store(path, {"code": 1}).get("a") == {"x": 1} and Store(path, {"code": 2}).get("a") is None
    Store(path, {"code": 1}).put({"c": 3})
    assert [json.loads(line)["key"] for line in path.read_text().splitlines()] == ["a", "b", "c"]


def test_table_of_points_has_a_column_for_every_number():
    lines = points_csv([point("a, b", "learned", 0.25, 0.5), point("constant", "constant", 0.5, None)]).splitlines()
    assert len(lines) == 3 and lines[1].startswith('s/bounce1,"a, b",learned,0.25')
    assert {len(re.findall(r'(?:"[^"]*"|[^,])*(?:,|$)', line)) for line in lines} and "solve_seconds" in lines[0]


def test_a_run_is_not_repeated_and_writes_what_it_says(tmp_path):
    told = []
    options = {"scenes": ["diagonal"], "names": NAMES, "settings": TINY, "threads": 1}
    options |= {"growth": False, "break_even": False, "scanlines": False}
    first = run_bench(tmp_path, progress=told.append, **options)
    assert any("measuring" in line for line in told)
    told.clear()
    again = run_bench(tmp_path, progress=told.append, **options)
    assert not any("measuring" in line for line in told)
    assert again.points == first.points and {p.scene for p in first.points} == {"diagonal/direct"}
    more = run_bench(tmp_path, progress=told.append, **{**options, "names": [*NAMES, "path tracer, 1"]})
    assert any("measuring 1 of 6" in line for line in told) and more.points[:5] == first.points
    lines = (tmp_path / "points.csv").read_text().splitlines()
    assert len(lines) == 1 + len(more.points) and any(line.count("traced probes") for line in lines)
    picture = next(p for p in first.points if p.name == "learned_9x6, 8 cells, 8 steps")
    assert 0 < picture.ssim < 0.5 and (picture.flip is None or 0 < picture.flip < 1)


def test_command_writes_tables_charts_and_an_interactive_page(tmp_path, capsys):
    out, page = tmp_path / "out", tmp_path / "docs" / "speed.md"
    page.parent.mkdir()
    page.write_text("# Mine\n\nKept.\n\n<!-- generated -->\n\nold")
    run_bench(out, scenes=["diagonal"], names=NAMES, settings=TINY, threads=1, growth=False, break_even=False, progress=str)
    from difflpv.bench.page import write_charts, write_document

    result = run_bench(
        out, scenes=["diagonal"], names=NAMES, settings=TINY, threads=1, growth=False, break_even=False, progress=str
    )
    write_charts(out / "charts", result)
    write_document(page, result, command="difflpv bench")
    text = page.read_text()
    assert text.startswith("# Mine\n\nKept.") and "old" not in text
    chart = "speed/line_diagonal_direct_floor.png"
    assert chart in text and (page.parent / chart).is_file()
    assert "GTX 460" in text and "GTX 480" in text and "speed/diagonal_direct.png" in text
    drawn = (out / "charts" / "diagonal_direct.svg").read_text()
    assert drawn.lstrip().startswith("<?xml") and "traced probes" in drawn
    html = (out / "charts" / "bench.html").read_text()
    data = json.loads(re.search(r'type="application/json">(.*?)</script>', html)[1])
    assert len(data["scenes"]["diagonal/direct"]["points"]) == len(NAMES)
    assert not re.search(r'(src|href)="?https?:', html)  # no network


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--only", "magic"], "no 'magic'"), (["--markdown", "x.txt"], "ending in .md"), (["nowhere.glb"], "nowhere.glb")],
)
def test_command_errors_are_one_line(arguments, message, tmp_path, capsys):
    assert main(["bench", "--out", str(tmp_path), *arguments]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1 and message in error[0]


def test_peers_take_the_same_steps():
    stencil, generator = learned_stencil("learned_4x6"), torch.Generator().manual_seed(0)
    volume, factors = torch.randn(3, 4, 6, 5, 4, generator=generator), torch.tensor([0.9, 0.8])
    free = torch.ones(3, 6, 5, 4)
    for layout in (torch.contiguous_format, torch.channels_last_3d):
        weight = convolution_weight(stencil).contiguous(memory_format=layout)
        torch.testing.assert_close(convolution(volume, weight, factors), eager_twin(stencil, free)(volume, factors))


@pytest.mark.skipif(bool(flip_unavailable()), reason="flip-evaluator is not installed")
def test_flip_is_zero_for_equal_images_one_at_most_and_grows_with_the_difference():
    truth = np.random.default_rng(0).uniform(0.2, 1, (24, 32, 3)).astype(np.float32)
    assert flip(truth, truth) == 0
    small, large = flip(1.1 * truth, truth), flip(2 * truth, truth)
    assert 0 < small < large <= 1
    assert flip(20 * truth, 10 * truth) == pytest.approx(flip(2 * truth, truth), rel=1e-3)  # the unit does not count


@pytest.mark.slow
@pytest.mark.skipif(bool(unavailable()), reason="Mitsuba 3 cannot be used here")
@pytest.mark.parametrize("component", ["bounce1", "direct"])
def test_mitsuba_agrees_with_the_truth_within_the_noise_of_both(component, tmp_path):
    scene = bench_scenes("cornell", tmp_path, components=(component,), receivers=200, spp=4096)[0]
    runs = [MitsubaRun(Configuration("m", "mitsuba", "Mitsuba 3", samples=n), scene) for n in (1024, 4096)]
    found = [errors(run.solve(), scene)["error"] for run in runs]
    own = scene.noise
    noise = [math.sqrt(max(e**2 - own**2, 0)) for e in found]
    assert noise[1] < 0.62 * noise[0] + own  # four times the paths, half the noise
    bias = abs((scene.weight @ runs[1].solve()).sum() / (scene.weight @ scene.truth).sum() - 1)
    assert bias < 0.01


def test_ladder_of_a_quick_run_is_part_of_the_whole():
    assert set(chosen(quick=True)) < set(chosen())


def test_ratios_tell_what_moved(tmp_path):
    assert compare({"a": 1.0, "b": 2.0, "c": 1.0}, {"a": 1.1, "b": 3.0, "d": 4.0}) == ["b: 2 -> 3", "c: gone", "d: new, 4"]
    points = [point("learned_9x26", "learned", 0.2, 0.1), point("x", "LPV", 0.4, 0.3)]
    result = BenchResult(points=points, scenes={"s/bounce1": {}})
    found = ratios(result)
    assert found["s/bounce1: time of x / learned_9x26"] == pytest.approx(3) and found["s/bounce1: error of x"] == 0.4
    (tmp_path / "b.json").write_text("[1]")
    with pytest.raises(ValueError, match="not a file of ratios"):
        read_baseline(tmp_path / "b.json")
    assert read_baseline(tmp_path / "none.json") == {}
