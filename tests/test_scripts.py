"""The programs that researchers copy run, with tiny settings."""

import importlib.util
from pathlib import Path

import pytest

from data_gen.targets import make_targets
from difflpv.io import load_scene
from difflpv.lights import load_light_sets
from difflpv.pipeline import Lpv
from difflpv.probes.probe_files import load_probes

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"


def load_script(name):
    spec = importlib.util.spec_from_file_location(name, SCRIPTS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", sorted(path.stem for path in SCRIPTS.glob("*.py")))
def test_every_script_has_main_and_help(name, capsys):
    with pytest.raises(SystemExit) as end:
        load_script(name).main(["--help"])
    assert end.value.code == 0 and capsys.readouterr().out.startswith("usage: ")


@pytest.mark.slow
def test_fit_cornell(tmp_path, capsys):
    arguments = ["--receivers", "40", "--spp", "64", "--cells", "10", "--steps", "5", "--budget", "12"]
    outcome = load_script("fit_cornell").main(["--out", str(tmp_path), *arguments])
    out = capsys.readouterr().out
    assert "test lights" in out and "holpv fitted" in out
    constant, untuned, fitted = outcome.mean_scores(outcome.test)
    assert (outcome.train, outcome.test) == ((0, 1, 2, 3, 4), (5, 6, 7))
    assert fitted.relative_l2 < untuned.relative_l2 and fitted.relative_l2 < constant.relative_l2
    assert set(Lpv.load(tmp_path / "fitted").learned) == {"propagation", "occlusion", "sampling_bias"}


@pytest.mark.slow
def test_training_loop(tmp_path, capsys):
    scene, sets = load_scene("cornell"), load_light_sets(None, "cornell")[:2]
    make_targets(scene, tmp_path / "targets", receiver_count=40, components=["bounce1"], spp=64, light_sets=sets)
    arguments = ["--cells", "10", "--steps", "4", "--epochs", "5", "--out", str(tmp_path / "model")]
    losses = load_script("training_loop").main(["cornell", str(tmp_path / "targets"), *arguments])
    assert len(losses) == 5 and losses[-1] < losses[0]
    assert Lpv.load(tmp_path / "model").values()["propagation_steps"].shape == (4,)


@pytest.mark.slow
def test_place_probes(tmp_path, capsys):
    arguments = ["--count", "12", "--steps", "30", "--points", "240", "--spp", "128", "--cells", "8"]
    found = load_script("place_probes").main(["--out", str(tmp_path), *arguments])
    assert "gradient / grid: 0." in capsys.readouterr().out
    assert found["gradient"].error < found["grid"].error and found["gradient"].count <= 12
    record = load_probes(tmp_path / "gradient")
    assert len(record.probes) == found["gradient"].count and record.method == "gradient"
