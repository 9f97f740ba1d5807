"""``fit`` and ``evaluate`` on a small room."""

import json

import numpy as np
import pytest
from cli_room import difflpv, make_targets, write_room

import difflpv.cli.fit as fit_command
from data_gen.load import load_targets
from difflpv.cli.held_out import overfitting
from difflpv.evaluate import Score
from difflpv.fitted import read_fitted
from difflpv.io import load_scene
from difflpv.pipeline import Lpv

QUICK = ["--steps", 4, "--budget", 18]


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room")
    scene = write_room(folder)
    make_targets(folder, scene, "--images", "--image-spp", 8)
    return folder


def fit_of(room, out, *arguments):
    return ["fit", room / "room.glb", "--targets", room / "targets", "--out", out, *QUICK, *arguments]


def run_json(capsys, *arguments, code=0):
    capsys.readouterr()
    assert difflpv(*arguments, "--json") == code
    out, err = capsys.readouterr()
    assert out.count("\n") == 1
    return json.loads(out), err


@pytest.mark.slow
def test_fit_then_evaluate_agree(room, tmp_path, capsys):
    out = tmp_path / "fit"
    report, err = run_json(capsys, *fit_of(room, out, "--learn", "propagation,occlusion,sampling_bias"))
    assert err == "" and report["component"] == "bounce1" and report["config"]["occlusion"] == "exp"
    assert (report["train_lights"], report["test_lights"]) == ([0, 1], [2, 3])
    assert [s["method"] for s in report["test"]] == ["constant", "holpv as published", "holpv untuned", "holpv fitted"]
    assert sorted(p.name for p in out.iterdir()) == ["checkpoint.pt", "fit.json", "fitted.json", "fitted.safetensors"]
    assert json.loads((out / "fit.json").read_text()) == report
    constant, published, untuned, fitted = (s["relative_l2"] for s in report["train"])
    assert fitted == pytest.approx(report["loss"], rel=1e-4) and fitted < min(untuned, published)
    provenance = read_fitted(out).provenance
    assert provenance["scene"]["hash"] == load_scene(room / "room.glb").hash and provenance["train_lights"] == [0, 1]

    scores, _ = run_json(capsys, "evaluate", room / "room.glb", "--targets", room / "targets", "--fitted", out)
    assert {(s["component"], s["light"]) for s in scores["scores"]} == {(c, k) for c in ("direct", "bounce1") for k in range(4)}
    test = [s for s in scores["scores"] if s["component"] == "bounce1" and s["light"] in (2, 3)]
    for name, row in (("holpv", 2), ("holpv fitted", 3), ("constant", 0)):
        mean = np.mean([s["relative_l2"] for s in test if s["method"] == name])
        assert mean == pytest.approx(report["test"][row]["relative_l2"], rel=1e-5)
    assert [(s["method"], s["component"]) for s in scores["means"]] == [
        (m, c) for c in ("direct", "bounce1") for m in ("constant", "holpv", "holpv fitted")
    ]


def test_text_says_what_was_chosen_and_shows_both_splits(room, tmp_path, capsys):
    assert difflpv(*fit_of(room, tmp_path / "f", "--learn", "injection_bias", "--method", "lpv", "--train-lights", "1-2")) == 0
    out, err = capsys.readouterr()
    assert err == "" and "deposit trilinear" in out and "occlusion none" in out and "lookup trilinear" in out
    assert "learn injection_bias by lbfgs on lights 1, 2, judged on 0, 3" in out
    train, test = out.partition("test lights 0, 3")[::2]
    for part in (train.partition("train lights 1, 2")[2], test):
        assert all(name in part for name in ("constant", "lpv as published", "lpv untuned", "lpv fitted"))


@pytest.mark.slow
def test_fitted_models_carry_over(room, tmp_path, capsys):
    """To another grid by --grid, to another scene by its own box; options that contradict the model are refused."""
    out = tmp_path / "fit"
    assert difflpv(*fit_of(room, out, "--learn", "propagation", "--grid", 6)) == 0
    table = room / "targets" / "light_0.npz"
    common = ["simulate", "--fitted", out, "--receivers", table, "--out", tmp_path / "p.npz"]
    assert difflpv(*common, room / "room.glb") == 0 and "grid 6 x 6 x 6" in capsys.readouterr().out
    assert difflpv(*common, room / "room.glb", "--grid", 9, "--steps", 4) == 0
    assert "holpv fitted, grid 9 x 9 x 9 cells" in capsys.readouterr().out
    other = write_room(tmp_path, "moved", grid_low=(-1.6, -1.5, -0.6))
    content, _ = run_json(capsys, *common, other)
    assert content["method"] == "holpv fitted"
    for arguments, message in (
        (["--steps", 5], f"--steps 5: the fitted model in {out} has steps 4"),
        (["--method", "lpv"], f"--method lpv: the fitted model in {out} has method holpv"),
        (["--no-clamp"], f"--no-clamp: the fitted model in {out} has clamp True"),
    ):
        assert difflpv(*common, room / "room.glb", *arguments) == 2
        assert capsys.readouterr().err == f"difflpv: error: {message}\n"


def test_image_loss_and_albedo(room, tmp_path, capsys):
    out = tmp_path / "fit"
    report, _ = run_json(
        capsys, *fit_of(room, out, "--learn", "albedo", "--loss", "image-l1", "--solver", "adam", "--lr", "0.2",
                        "--train-lights", "0", "--test-lights", "none"),
    )  # fmt: skip
    assert report["loss"] < report["history"][0][2] and report["test"] == []
    assert np.shape(report["values"]["albedo"]) == (3, 3)
    scene = load_scene(room / "room.glb")
    loaded = Lpv.load(out, scene=scene).values()["albedo"]
    np.testing.assert_allclose(loaded.detach(), report["values"]["albedo"], atol=3e-6)
    table = room / "targets" / "light_0.npz"
    assert difflpv("simulate", room / "room.glb", "--fitted", out, "--receivers", table, "--out", tmp_path / "p.npz") == 0


def test_light_intensity_by_least_squares(room, tmp_path, capsys):
    report, _ = run_json(
        capsys, *fit_of(room, tmp_path / "f", "--learn", "light_intensity", "--solver", "nnls", "--train-lights", 2)
    )
    assert report["status"] == "converged" and report["train_lights"] == [2] and report["test_lights"] == []
    constant, published, untuned, fitted = report["train"]
    assert fitted["relative_l2"] <= untuned["scaled_l2"] + 1e-3  # one light: its intensity is the best scale


def test_interrupted_fits_go_on(room, tmp_path, capsys, monkeypatch):
    arguments = ["--learn", "propagation,sampling_bias", "--solver", "adam", "--train-lights", 0, "--test-lights", "none"]
    whole, _ = run_json(capsys, *fit_of(room, tmp_path / "whole", *arguments))
    show, count = fit_command.Progress.show, [0]

    def interrupt(self, line):
        count[0] += "loss" in line
        if count[0] == 3:
            count[0] += 1
            raise KeyboardInterrupt
        show(self, line)

    monkeypatch.setattr(fit_command.Progress, "show", interrupt)
    stopped, _ = run_json(capsys, *fit_of(room, tmp_path / "f", *arguments), code=130)
    assert stopped["status"] == "interrupted" and (tmp_path / "f" / "fitted.json").exists()
    assert stopped["forward_equivalents"] < whole["forward_equivalents"]
    resumed, _ = run_json(capsys, *fit_of(room, tmp_path / "f", *arguments))
    assert resumed["status"] == whole["status"] == "budget"
    assert (resumed["values"], resumed["loss"]) == (whole["values"], whole["loss"])
    assert difflpv(*fit_of(room, tmp_path / "f", *arguments, "--seed", 1)) == 2
    assert "belongs to another fit" in capsys.readouterr().err
    fresh, _ = run_json(capsys, *fit_of(room, tmp_path / "f", *arguments, "--overwrite"))
    assert fresh["values"] == whole["values"]


def test_a_fit_that_overflows_is_code_1(room, tmp_path, capsys):
    """In the theses' normalisation p = 1 is dark: Adam leaps to p = 8, twice the critical value."""
    arguments = ["--learn", "propagation", "--solver", "adam", "--lr", 100, "--steps", 250, "--method", "lpv",
                 "--normalization", "thesis", "--train-lights", 0, "--test-lights", "none"]  # fmt: skip
    report, _ = run_json(capsys, *fit_of(room, tmp_path / "f", *arguments), code=1)
    assert report["status"] == "non_finite" and "because of parameter 'propagation'" in report["message"]
    assert (tmp_path / "f" / "fitted.json").exists()


@pytest.mark.slow
def test_a_stencil_fit_is_judged_on_a_scene_it_never_saw(room, tmp_path, capsys):
    """The same room serves as the other scene: what was carried there must do what it does at home."""
    arguments = ["--method", "learned_4x6", "--learn", "stencil,lookup_gains"]
    other = f"{room / 'room.glb'}={room / 'targets'}"
    report, _ = run_json(capsys, *fit_of(room, tmp_path / "f", *arguments, "--unseen", other))
    (scores,) = report["unseen"].values()
    assert [s["method"] for s in scores] == ["constant", "learned_4x6 untuned", "learned_4x6 fitted"]
    here = [s["relative_l2"] for s in report["scores"] if s["method"] == "learned_4x6 fitted"]
    assert scores[2]["relative_l2"] == pytest.approx(np.mean(here), rel=1e-4)
    assert len(report["values"]["stencil"]) == 6
    assert difflpv(*fit_of(room, tmp_path / "f", *arguments, "--unseen", other)) == 0
    assert "never seen" in capsys.readouterr().out


@pytest.mark.slow
def test_a_field_of_cells_stays_at_one_where_sparsity_says_so(room, tmp_path, capsys):
    moved = {}
    for weight in ("1e-6", "100"):
        arguments = ["--method", "learned_4x6", "--learn", "cell_propagation", "--sparsity", weight]
        report, _ = run_json(capsys, *fit_of(room, tmp_path / weight, *arguments))
        moved[weight] = np.abs(np.log(report["values"]["cell_propagation"])).mean()
    assert moved["100"] < 0.2 * moved["1e-6"]


def score_of(method, error):
    return Score(method, "bounce1", -1, error, error, 1.0, error, error)


def test_overfitting_is_said_where_only_train_lights_gain():
    train = [score_of("a untuned", 0.4), score_of("a fitted", 0.2)]
    assert overfitting(train, [score_of("a untuned", 0.4), score_of("a fitted", 0.25)]) == []
    (line,) = overfitting(train, [score_of("a untuned", 0.4), score_of("a fitted", 0.42)])
    assert line.startswith("overfitting: error fell by 50 % on train lights, by -5 % on test lights")
    assert overfitting([score_of("a untuned", 0.4), score_of("a fitted", 0.4)], train) == []


BAD = {
    "name": (["--learn", "gain"], "learn: expected names from propagation, propagation_steps"),
    "twice": (["--learn", "occlusion,occlusion"], "learn: 'occlusion' is named twice"),
    "none": (["--learn", "occlusion", "--occlusion", "none"], "learn: 'occlusion' needs occlusion='clamp', 'exp' or 'traced'"),
    "nearest": (["--learn", "injection_bias", "--deposit", "nearest"], "learn: 'injection_bias' needs deposit='trilinear'"),
    "albedo": (["--learn", "albedo", "--component", "direct"], "learn: 'albedo' has no part in component 'direct'"),
    "lights": (["--learn", "light_color"], "--learn: light_color belong to one light: name it with --train-lights K"),
    "range": (["--train-lights", "0-4"], "--train-lights: 4 is out of range, TARGETS has 4 light sets (0-3)"),
    "test": (["--test-lights", "9"], "--test-lights: 9 is out of range"),
    "both": (["--train-lights", "0-2", "--test-lights", "2,3"], "--test-lights: 2 would be judged on what was learned"),
    "nothing": (["--train-lights", "none"], "--train-lights: expected at least one light"),
    "syntax": (["--train-lights", "4-0"], "argument --train-lights: expected numbers and ranges such as 0-4,7"),
    "budget": (["--budget", "1"], "budget: expected at least 3 forward-equivalents for lbfgs, got 1.0"),
    "solver": (["--solver", "newton"], "argument --solver: invalid choice: 'newton'"),
    "lr": (["--lr", "0.1"], "--lr: belongs to --solver adam, got --solver lbfgs"),
    "sparsity": (["--sparsity", "0.1"], "--sparsity: belongs to --learn cell_propagation or cell_occlusion"),
    "unseen": (["--unseen", "cornell"], "as two_rooms_90=out/targets, got 'cornell'"),
    "unseen folder": (["--unseen", "cornell=/nowhere"], "/nowhere"),
    "unseen field": (["--learn", "albedo", "--unseen", "cornell=x"], "--unseen: albedo can not be carried"),
    "constant": (["--method", "constant"], "argument --method: invalid choice: 'constant'"),
    "component": (["--component", "full"], "argument --component: invalid choice: 'full'"),
    "nnls loss": (["--solver", "nnls", "--loss", "log"], "loss: solver 'nnls' knows 'l2' alone, got 'log'"),
    "nnls": (["--solver", "nnls", "--budget", "3"], "budget: expected at least 4 forward-equivalents for nnls"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_options(name, room, tmp_path, capsys):
    arguments, message = BAD[name]
    learn = [] if "--learn" in arguments else ["--learn", "propagation"]
    assert difflpv(*fit_of(room, tmp_path / "f", *learn, *arguments, "--json")) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("difflpv: error: ") and err.count("\n") == 1
    assert message.replace("TARGETS", str(room / "targets")) in err
    assert not (tmp_path / "f" / "fitted.json").exists()


def test_targets_without_what_is_asked_for(room, tmp_path, capsys):
    scene = room / "room.glb"
    made = ["targets", scene, "--receivers", 4, "--spp", 32, "--component", "full", "--out", tmp_path / "full"]
    assert difflpv(*made) == 0
    for command, message in (
        (["fit", scene, "--targets", tmp_path / "full", "--learn", "propagation", "--out", "f"], "has full: need direct or"),
        (["evaluate", scene, "--targets", tmp_path / "full"], "has full: need direct or bounce1"),
        (["evaluate", scene, "--targets", tmp_path / "full", "--component", "direct"], "has full, not direct"),
        (["fit", scene, "--targets", tmp_path, "--learn", "propagation", "--out", "f"], "no manifest.json"),
        (["evaluate", scene, "--targets", room / "targets", "--light", "7"], "--light: 7 is out of range"),
        (["evaluate", scene, "--targets", room / "targets", "--light", "none"], "--light: expected at least one light"),
    ):
        capsys.readouterr()
        assert difflpv(*command) == 2
        err = capsys.readouterr().err
        assert message in err and err.count("\n") == 1
    assert difflpv(*made[:-4], "--component", "bounce1", "--out", tmp_path / "plain") == 0
    capsys.readouterr()
    fit = ["fit", scene, "--targets", tmp_path / "plain", "--learn", "propagation", "--loss", "image-l1", "--out", "f"]
    assert difflpv(*fit) == 2
    assert "--loss: image-l1 needs images, make the targets with 'difflpv targets ... --images'" in capsys.readouterr().err


def test_evaluate_as_text(room, capsys):
    scene, targets = room / "room.glb", room / "targets"
    assert difflpv("evaluate", scene, "--targets", targets, "--method", "lpv", "--steps", 2, "--light", 1) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1 + 1 + 4 and lines[0].startswith("room: lpv, grid 8 x 8 x 8")
    assert difflpv("evaluate", scene, "--targets", targets, "--method", "constant", "--component", "direct") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].split()[:3] == ["constant", "direct", "mean"] and len(lines) == 1 + 1 + 4 + 1
    truth = load_targets(targets).lights[0]
    mean = np.average(truth.irradiance["direct"], axis=0, weights=truth.area_weight)
    weight, direct = truth.area_weight[:, None], truth.irradiance["direct"]
    error = np.sqrt((weight * (direct - mean) ** 2).sum() / (weight * direct**2).sum())
    assert f"{error:.3f}" in lines[2]


def test_tables_show_the_floor_once_it_is_known(room, capsys):
    scene, targets = room / "room.glb", room / "targets"
    some = ["evaluate", scene, "--targets", targets, "--light", 1, "--component", "bounce1"]
    assert difflpv(*some, "--method", "floor", "--spp", 1024) == 0
    floor = capsys.readouterr().out.splitlines()[-1]
    assert floor.split()[0] == "floor"
    assert difflpv(*some, "--method", "learned_9x26") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[2:]] == ["constant", "learned_9x26", "floor"]
    assert lines[-1].split() == floor.split()  # the same lookup, the same numbers
    assert difflpv(*some, "--method", "learned_9x26", "--grid", 6) == 0
    assert "floor" not in capsys.readouterr().out  # of other cells
    assert load_targets(targets)  # still sound
