import io
import json
from types import SimpleNamespace

import numpy as np
import pytest
from page_reader import Page, check_table
from PIL import Image

import difflpv.demo.fits as fits
import difflpv.demo.run as run
from data_gen.load import load_targets
from difflpv.config import grid_for
from difflpv.demo import DemoSettings, DemoSummary, run_demo
from difflpv.demo.summary import PRESENTATION, code_digest, describe_targets, finished_summary, mean_rows
from difflpv.evaluate import Score, score
from difflpv.io import load_scene
from difflpv.io.exr import read_image
from difflpv.lights import apply_light_set
from difflpv.pipeline import Lpv
from difflpv.simulate import simulate

TINY = DemoSettings(
    receivers=60,
    spp=32,
    image_width=12,
    image_height=10,
    image_spp=32,
    image_light=1,
    train=(0,),
    test=(1,),
    cells=8,
    steps=4,
    lpv_budget=12.0,
    holpv_budget=12.0,
)


@pytest.fixture(scope="module")
def told():
    return []


@pytest.fixture(scope="module")
def demo(tmp_path_factory, told):
    return run_demo(tmp_path_factory.mktemp("demo") / "out", settings=TINY, workers=1, seed=5, progress=told.append)


def numbers(summary):
    """Everything that must not depend on when and how often a run was interrupted."""
    values = summary.values
    found = {
        name: (fit["parameters"], fit["loss"], fit["status"], [(row[0], row[2]) for row in fit["history"]], fit["factors"])
        for name, fit in values["fits"].items()
    }
    return values["rows"], values["scores"], found, values["targets"]["noise"]


@pytest.mark.slow
def test_demo_writes_everything_and_tells_the_table(demo, told):
    out = demo.folder
    assert told[-1].startswith(f"\n{demo.table}") and str(demo.report) in told[-1]
    assert {path.stem for path in (out / "figures").iterdir()} == {"renders", "convergence", "lights", "factors", "speed"}
    assert DemoSummary.read(out).values == demo.values
    assert [s.method for s in demo.test if s.component == "bounce1"] == [*run._IN_TABLE, "floor"]
    assert [s.method for s in demo.test if s.component == "direct"] == ["constant", "LPV", "HOLPV", "learned_9x26"]
    for row in demo.values["rows"]:
        assert row["test"]["relative_l2"] > 0 and f"{row['test']['relative_l2']:7.3f}" in demo.table
    Image.open(out / "cornell.png").verify()


@pytest.mark.slow
def test_report_is_one_sound_file_with_the_numbers_of_the_summary(demo):
    page = Page(demo.report.read_text(encoding="utf-8"))
    rows = json.loads((demo.folder / "summary.json").read_text())["rows"]
    check_table(page, 0, [row for row in rows if row["component"] == "bounce1"])
    check_table(page, len(page.tables) - 1, [row for row in rows if row["component"] == "direct"])
    assert len(page.images) == 5
    for image, name in zip(page.images, ("renders", "convergence", "lights", "speed", "factors"), strict=True):
        assert np.array_equal(image, Image.open(demo.folder / "figures" / f"{name}.png").convert("RGB"))


@pytest.mark.slow
def test_scores_are_those_of_simulate(demo):
    scene, targets = load_scene("cornell"), load_targets(demo.folder / "targets")
    light = targets.lights[1]
    for component in ("bounce1", "direct"):
        prediction = simulate(
            apply_light_set(scene, light.entries),
            targets.receivers.position,
            targets.receivers.normal,
            grid=grid_for(scene, TINY.cells),
            config=TINY.published("holpv"),
            component=component,
            seed=5,
        )
        truth = light.irradiance[component]
        expected = score(prediction.irradiance, truth, light.area_weight, method="HOLPV", component=component, light=1)
        found = next(s for s in demo.test if (s.method, s.component) == ("HOLPV", component))
        assert found.relative_l2 == pytest.approx(expected.relative_l2, rel=1e-5)
        assert found.scale == pytest.approx(expected.scale, rel=1e-5)


@pytest.mark.slow
def test_fits_lower_their_loss_and_can_be_loaded(demo):
    for plan in run.FITS:
        fit = demo.values["fits"][plan.name]
        losses = [row[2] for row in fit["history"]]
        assert fit["loss"] == min(losses) < losses[0]
        assert fit["forward_equivalents"] <= TINY.budget(plan.method)
        lpv = Lpv.load(demo.folder / "fits" / plan.folder)
        assert lpv.config == TINY.fitted(plan.method) and set(lpv.learned) == set(plan.learn)
        train = next(s for s in demo.train if s.method == plan.name)
        assert train.relative_l2 == pytest.approx(fit["loss"], rel=1e-4)  # with one train light, the loss is its error
    assert not list(demo.folder.rglob("checkpoint*"))


@pytest.mark.slow
def test_second_run_repeats_nothing(demo, monkeypatch):
    monkeypatch.setattr(run, "fit_once", None)
    monkeypatch.setattr(run, "make_targets", None)
    said = []
    again = run_demo(demo.folder, settings=TINY, workers=1, seed=5, progress=said.append)
    assert again.values == demo.values and demo.table in said[-1]


@pytest.mark.slow
def test_interrupted_run_goes_on_to_the_same_bits(demo, tmp_path, monkeypatch):
    monkeypatch.setattr(fits, "_TOLD_EVERY", 0.0)
    lines = []

    def interrupt(line):
        lines.append(line)
        if sum("HOLPV fitted" in text for text in lines) == 3:
            raise KeyboardInterrupt  # as Ctrl-C in the middle of a fit

    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        run_demo(out, settings=TINY, workers=1, seed=5, progress=interrupt)
    assert not (out / "report.html").exists() and not (out / "summary.json").exists()
    assert (out / "fits/lpv_nlopt/fitted.json").is_file() and not (out / "fits/holpv_fitted/fitted.json").exists()
    assert len(list((out / "fits/holpv_fitted").glob("checkpoint-*.pt"))) == 1
    said = []
    resumed = run_demo(out, settings=TINY, workers=1, seed=5, progress=said.append)
    assert not any("LPV fitted (" in line and "HO" not in line for line in said), "a finished fit was repeated"
    assert resumed.values["resumed"] and not demo.values["resumed"]
    assert numbers(resumed) == numbers(demo)
    assert (out / "cornell.png").read_bytes() == (demo.folder / "cornell.png").read_bytes()


@pytest.mark.slow
def test_predicted_image_has_the_frame_of_the_path_traced_one(demo):
    truth, _ = read_image(demo.folder / "image" / "image_0_bounce1.exr")
    assert truth.shape == (TINY.image_height, TINY.image_width, 3) and truth.max() > 0
    image = np.asarray(Image.open(io.BytesIO((demo.folder / "cornell.png").read_bytes())).convert("RGB"))
    assert image.std() > 10


def test_other_identity_or_damage_is_not_finished(tmp_path):
    assert finished_summary(tmp_path, {"seed": 0}) is None
    (tmp_path / "report.html").write_text("")
    for text in ("{", "[]", '{"identity": {"seed": 1}, "rows": []}'):
        (tmp_path / "summary.json").write_text(text)
        assert finished_summary(tmp_path, {"seed": 0}) is None
    (tmp_path / "summary.json").write_text('{"identity": {"seed": 0}, "rows": []}')
    assert finished_summary(tmp_path, {"seed": 0}) is not None
    (tmp_path / "report.html").unlink()
    assert finished_summary(tmp_path, {"seed": 0}) is None


def test_code_digest_sees_sources_and_leaves_out_what_is_named():
    assert code_digest() == code_digest() != code_digest(without=PRESENTATION)
    assert len(code_digest()) == 64
    with pytest.raises(ValueError, match="no source begins with difflpv/report_of_old/"):
        code_digest(without=("difflpv/report/", "difflpv/report_of_old/"))


def test_noise_is_the_error_of_a_perfect_prediction():
    rng = np.random.default_rng(1)
    truth, sigma, weight = rng.uniform(1, 2, (50000, 3)), 0.1, rng.uniform(0, 1, 50000)
    measured = truth + sigma * rng.standard_normal(truth.shape)
    light = SimpleNamespace(
        area_weight=weight, irradiance={"direct": measured}, standard_error={"direct": np.full_like(truth, sigma)}
    )
    manifest = {"lights": [{"spp": 8}], "rays": 1, "seconds": 1.0}
    targets = SimpleNamespace(lights=[light, light], components=("direct",), receivers=truth, manifest=manifest)
    noise = describe_targets(targets, [0], [1])["noise"]["direct"]
    perfect = score(truth, measured, weight, method="truth", component="direct", light=0)
    assert noise["train"] == noise["test"] == pytest.approx(perfect.relative_l2, rel=0.02)


def test_rows_are_means_over_train_and_test():
    scores = [Score("LPV", "direct", k, *[float(k)] * 5) for k in range(4)]
    (row,) = mean_rows(scores, [0, 1], [2, 3])
    assert row["train"]["relative_l2"] == 0.5 and row["test"]["percentile_95"] == 2.5
    assert row["method"] == "LPV" and row["component"] == "direct"


@pytest.mark.parametrize("wrong", [{"train": ()}, {"train": (0, 5)}, {"image_light": 0}])
def test_light_sets_must_be_apart(wrong):
    with pytest.raises(ValueError, match="light sets: expected"):
        DemoSettings(**wrong)
