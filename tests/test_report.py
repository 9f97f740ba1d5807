import copy
import io
import json

import matplotlib
import numpy as np
import pytest
from page_reader import Page, check_table
from PIL import Image

from difflpv.report.bench import draw_error_over_time, small_png
from difflpv.report.figures import draw_convergence, draw_factors, draw_lights, draw_renders
from difflpv.report.page import build_page, format_number
from difflpv.report.story import limits, verdict

METHODS = ("constant", "LPV", "LPV fitted", "LPV nlopt", "HOLPV", "HOLPV fitted", "HOLPV nlopt")


def error(value):
    return {
        "relative_l2": value,
        "scaled_l2": 0.9 * value,
        "scale": 1 + value,
        "mean_error": 0.8 * value,
        "percentile_95": 3 * value,
    }


def summary(errors=(0.6, 2.0, 0.5, 0.55, 0.8, 0.31, 0.4)):
    """What a demo writes, with test errors by method."""
    found = dict(zip(METHODS, errors, strict=True)) | {"floor": 0.1}
    history = [[1.0, 0.5, 0.9], [2.0, 1.0, None], [3.0, 1.5, 0.4]]
    fits = {}
    for name in METHODS:
        if name.endswith(("fitted", "nlopt")):
            many = {"propagation_steps": [0.5, 1.2, 1.1]} if name.endswith("fitted") else {}
            fits[name] = {
                "solver": "lbfgs" if many else "nlopt-bobyqa",
                "status": "budget",
                "seconds": 1.5,
                "history": history,
                "parameters": {"propagation": 0.9, "occlusion": 0.01, "sampling_bias": 0.7, "injection_bias": 0.4, **many},
                "factors": [0.9 * f for f in many.get("propagation_steps", [1.0] * 3)],
            }
    rows = [
        {"component": c, "method": m, "train": error(0.9 * found[m]), "test": error(found[m])}
        for c, methods in (("bounce1", (*METHODS, "floor")), ("direct", ("constant", "LPV", "HOLPV")))
        for m in methods
    ]
    scores = [
        {"method": m, "component": "bounce1", "light": k, **error(found[m] * (1 + 0.1 * k))} for m in found for k in range(4)
    ]
    noise = {c: {"train": 0.04, "test": 0.05} for c in ("bounce1", "direct")}
    return {
        "difflpv": "0.0",
        "command": "difflpv demo --out <out>",
        "folder": "out",
        "scene": "cornell",
        "quick": False,
        "seed": 3,
        "settings": {"cells": 8, "steps": 3, "image_light": 2, "lpv_budget": 9.0, "holpv_budget": 6.0, "learned_budget": 6.0},
        "train": [0, 1],
        "test": [2, 3],
        "targets": {"receivers": 10, "spp": 32, "rays": 12345678, "processor_seconds": 3.0, "noise": noise},
        "rows": rows,
        "scores": scores,
        "fits": fits,
        "floor": {"spp": 64, "noise": {"train": 0.03, "test": 0.02}},
        "machine": {
            "processor": "a <fast> one",
            "cores": 2,
            "load": [0.5, 0.4, 0.3],
            "system": "Linux x86_64",
            "python": "3.11",
            "versions": {"torch": "2"},
            "date": "2026-01-01",
        },
        "resumed": False,
        "identity": {"code": "0123456789abcdef"},
        "seconds": 12.3,
    }


def pixels(png):
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def count(image, color):
    return int((image == np.array(color, np.uint8)).all(-1).sum())


@pytest.fixture(scope="module")
def figures():
    values = summary()
    rng = np.random.default_rng(0)
    truth = rng.uniform(0, 1, (12, 16, 3))
    hit = np.ones((12, 16), bool)
    return {
        "renders": draw_renders(truth, {"LPV": truth, "HOLPV": 2 * truth}, hit, {"LPV": "a caption"}),
        "convergence": draw_convergence(values["fits"], 0.6),
        "lights": draw_lights(values["scores"], [0, 1], [2, 3], 0.05),
        "speed": small_png(
            draw_error_over_time(
                [{"name": "a", "family": "learned", "error": 0.2, "seconds": 0.1}], ["a"], title="a", noise=0.1
            )
        ),
        "factors": draw_factors({"LPV fitted": [0.1, 1.5, 1.4], "HOLPV fitted": [0.7, 1.0, 1.1]}),
    }


def test_page_is_well_formed_and_shows_the_numbers(figures):
    values = summary()
    page = Page(build_page(values, figures))
    check_table(page, 0, [row for row in values["rows"] if row["component"] == "bounce1"])
    check_table(page, len(page.tables) - 1, [row for row in values["rows"] if row["component"] == "direct"])
    assert page.tables[0][-1][:2] == ["noise of the targets", format_number(0.04)]
    assert len(page.images) == 5
    assert page.headings[0].startswith("Light propagation volumes") and page.headings[-1] == "How to reproduce this"


def test_page_survives_json(figures):
    values = summary()
    assert build_page(json.loads(json.dumps(values)), figures) == build_page(values, figures)


def test_foreign_text_is_escaped(figures):
    html = build_page(summary(), figures)
    assert "a &lt;fast&gt; one" in html and "--out &lt;out&gt;" in html


def test_quick_is_told(figures):
    values = {**summary(), "quick": True}
    assert "not a result" in build_page(values, figures)
    assert "not a result" not in build_page(summary(), figures)


def test_verdict_names_the_best_and_those_that_are_worse_than_a_constant():
    text = verdict(summary())
    assert "<strong>HOLPV fitted</strong>" in text and "0.310" in text and "0.800 for HOLPV as published" in text
    assert "overall brightness" not in text  # at best scale it gains a tenth
    assert "Worse than a constant: LPV (2.00) and HOLPV (0.80)" in text
    assert "The floor is 0.100" in text and "(64 paths a cell) would alone measure 0.020" in text


def test_verdict_is_honest_where_a_published_method_wins():
    text = verdict(summary((0.2, 0.6, 0.5, 0.5, 0.3, 0.4, 0.4)))
    assert "<strong>HOLPV</strong>" in text and "as published and" not in text
    assert all(name in text.partition("Worse than a constant")[2] for name in ("LPV fitted", "HOLPV fitted"))


def test_verdict_tells_what_is_only_brightness():
    values = summary()
    row = next(r for r in values["rows"] if r["method"] == "HOLPV")
    row["test"]["scaled_l2"], row["test"]["scale"] = 0.35, 0.6
    assert "times 0.60, it would measure 0.350" in verdict(values)


def test_limits_tell_amplification_and_leaks_only_where_there_are_any():
    text = " ".join(limits(summary()))
    assert "above 1: 1 of 3 for LPV fitted (up to 1.08)" in text and "(nearly) 0" in text and "worst under light 3" in text
    assert "A constant beats" not in text
    tame = copy.deepcopy(summary())
    next(s for s in tame["scores"] if (s["method"], s["light"]) == ("LPV fitted", 1))["relative_l2"] = 0.9
    for fit in tame["fits"].values():
        fit["factors"], fit["parameters"]["occlusion"] = [0.9, 1.0], 0.8
    text = " ".join(limits(tame))
    assert "above 1" not in text and "nearly" not in text
    assert text.count("A constant beats it under light 1.") == 1


def test_error_maps_show_sign_size_and_mask():
    truth = np.full((20, 20, 3), 0.5)
    hit = np.ones((20, 20), bool)
    colors = matplotlib.colormaps["RdBu_r"]
    red, white, blue = (colors(x, bytes=True)[:3] for x in (1.0, 0.5, 0.0))
    grey = (184, 184, 184)

    def drawn(prediction, hit=hit):
        return pixels(draw_renders(truth, {"LPV": prediction}, hit, {}))

    same, bright, dark = drawn(truth), drawn(4 * truth), drawn(-2 * truth)
    area = count(same, white) - count(bright, white)
    assert area > 10000
    assert count(bright, red) - count(same, red) == pytest.approx(area, rel=0.02)
    assert count(dark, blue) - count(same, blue) == pytest.approx(area, rel=0.02)
    half = hit.copy()
    half[:, :10] = False
    assert count(drawn(truth, half), grey) == pytest.approx(area / 2, rel=0.05)
    assert count(same, grey) < area / 20


def test_pictures_share_the_exposure_of_the_path_traced_one():
    truth = np.full((20, 20, 3), 0.18)
    truth[:2] = 1.0  # the brightest pixels are white
    image = pixels(draw_renders(truth, {"LPV": truth / 4}, np.ones((20, 20), bool), {}))
    same = pixels(draw_renders(truth, {"LPV": truth}, np.ones((20, 20), bool), {}))
    middle = tuple(np.round(255 * (1.055 * np.array([0.18, 0.045]) ** (1 / 2.4) - 0.055)))
    bright, dim = (count(image, (level,) * 3) for level in middle)
    assert bright > 5000 and dim == pytest.approx(bright, rel=0.05)
    assert count(same, (middle[0],) * 3) == pytest.approx(2 * bright, rel=0.05)


def test_a_scene_that_the_camera_misses_draws_nothing_but_does_not_fail():
    nothing = np.zeros((4, 4, 3))
    assert pixels(draw_renders(nothing, {"LPV": nothing}, np.zeros((4, 4), bool), {})).size


def test_figures_are_not_blank_and_equal_input_gives_equal_bytes(figures):
    for png in figures.values():
        assert pixels(png).std() > 5
    assert draw_factors({"LPV fitted": [0.1, 1.5, 1.4], "HOLPV fitted": [0.7, 1.0, 1.1]}) == figures["factors"]
