import json

import numpy as np
import pytest
import torch
from hand_scenes import box_scene, panel_scene
from safetensors.torch import save_file

from difflpv.config import LpvConfig
from difflpv.fitted import FORMAT, FittedError, FittedRecord, read_fitted, write_fitted
from difflpv.grid import Grid
from difflpv.illumination import illuminate
from difflpv.pipeline import Lpv

GRID = Grid((-1.3, -1.2, -1.4), 0.4, (7, 7, 7))
CONFIG = LpvConfig(method="lpv", steps=2, occlusion="exp", deposit="trilinear", tolerance=0.01)


@pytest.fixture
def folder(tmp_path):
    record = FittedRecord(CONFIG, GRID, {"propagation": torch.tensor(0.1, dtype=torch.float64)}, {"scene": {"name": "box"}})
    write_fitted(tmp_path / "model", record)
    return tmp_path / "model"


def edit(folder, **changes):
    path = folder / "fitted.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_record_round_trip(folder):
    record = read_fitted(folder)
    assert (record.config, record.grid, record.provenance) == (CONFIG, GRID, {"scene": {"name": "box"}})
    assert record.values["propagation"].dtype == torch.float64 and record.values["propagation"].item() == 0.1
    assert sorted(p.name for p in folder.iterdir()) == ["fitted.json", "fitted.safetensors"]


@pytest.mark.parametrize("provenance", [{"loss": float("nan")}, {"loss": torch.tensor(0.1)}])
def test_what_is_no_json_leaves_the_model_that_lies_there(folder, provenance):
    other = FittedRecord(CONFIG, GRID, {"propagation": torch.tensor(0.7, dtype=torch.float64)}, provenance)
    with pytest.raises((TypeError, ValueError), match="JSON"):
        write_fitted(folder, other)
    assert read_fitted(folder).values["propagation"].item() == 0.1


def test_module_round_trip_predicts_the_same(tmp_path):
    scene = box_scene()
    learn = ["propagation", "propagation_steps", "occlusion", "sampling_bias", "injection_bias", "light_color", "albedo"]
    initial = {"propagation": 0.9, "propagation_steps": [0.7, 1.3], "occlusion": 2.5, "sampling_bias": -0.1}
    lpv = Lpv(GRID, CONFIG, learn=learn, scene=scene, initial=initial)
    lpv.save(tmp_path / "deep" / "model", provenance={"solver": "none"})
    loaded = Lpv.load(tmp_path / "deep" / "model", scene=scene)
    assert set(loaded.learned) == set(learn) and loaded.config == CONFIG and loaded.grid == GRID
    light = illuminate(scene, GRID, CONFIG, rsm_resolution=8, surface_samples=64, dtype=torch.float64)
    receivers = light.receivers(np.array([[0.1, -1.0, 0.2]]), np.array([[0.0, 1, 0]]))
    torch.testing.assert_close(loaded(light, receivers), lpv(light, receivers), rtol=1e-12, atol=0)
    for name, value in lpv.values().items():
        torch.testing.assert_close(loaded.values()[name], value, rtol=1e-13, atol=0)
    json.loads((tmp_path / "deep" / "model" / "fitted.json").read_text())


def test_another_grid_takes_the_same_factors(folder):
    finer = Grid(GRID.minimum, 0.2, (14, 14, 14))
    lpv = Lpv.load(folder, grid=finer)
    assert lpv.grid == finer and lpv.values()["propagation"].item() == pytest.approx(0.1)


def test_saving_again_replaces_both_files(folder):
    write_fitted(folder, FittedRecord(CONFIG, GRID, {"occlusion": torch.tensor(2.0, dtype=torch.float64)}))
    assert set(read_fitted(folder).values) == {"occlusion"}


def test_nothing_there(tmp_path):
    with pytest.raises(FittedError, match="fitted.json: not found: expected a folder written by 'difflpv fit'"):
        read_fitted(tmp_path / "none")


@pytest.mark.parametrize("text", ['{"format": 1', "\udcff", "nonsense"])
def test_damaged_json(folder, text):
    (folder / "fitted.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(FittedError, match="fitted.json: damaged: "):
        read_fitted(folder)


@pytest.mark.parametrize(("content", "got"), [("[]", "'list'"), ("{}", "None"), ('{"format": 99}', "99")])
def test_another_format(folder, content, got):
    (folder / "fitted.json").write_text(content)
    with pytest.raises(FittedError, match=f"fitted.json: expected format {FORMAT}, got {got}"):
        read_fitted(folder)


def test_numbers_missing(folder):
    (folder / "fitted.safetensors").unlink()
    with pytest.raises(FittedError, match="fitted.safetensors: not found"):
        read_fitted(folder)


def test_numbers_damaged(folder):
    path = folder / "fitted.safetensors"
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(FittedError, match="fitted.safetensors: damaged: "):
        read_fitted(folder)


def test_numbers_of_another_model(folder):
    save_file({"propagation": torch.tensor(0.2, dtype=torch.float64)}, folder / "fitted.safetensors")
    with pytest.raises(FittedError, match="values differ from those of fitted.safetensors: the two files do not belong"):
        read_fitted(folder)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"grid": {"minimum": [0, 0, 0], "cell_size": -1, "resolution": [3, 3, 3]}}, "grid cell_size: expected a positive"),
        ({"grid": None}, "fitted.json: "),
        ({"config": {"method": "lpv", "bounces": 3}}, r"configuration: unknown names \['bounces'\]"),
        ({"config": {"method": "radiosity"}}, "method: expected one of"),
        ({"provenance": 3}, "fitted.json: "),
    ],
)
def test_bad_descriptions(folder, changes, message):
    edit(folder, **changes)
    with pytest.raises(FittedError, match=message):
        read_fitted(folder)


def test_a_model_that_does_not_fit_its_scene(tmp_path):
    scene = box_scene()
    Lpv(GRID, CONFIG, learn=["albedo"], scene=scene).save(tmp_path)
    with pytest.raises(FittedError, match="'albedo' belongs to a scene: pass scene="):
        Lpv.load(tmp_path)
    with pytest.raises(FittedError, match=r"parameter 'albedo': value: expected shape \[2, 3\], got \[6, 3\]"):
        Lpv.load(tmp_path, scene=panel_scene())


def test_a_name_that_this_version_does_not_know(tmp_path):
    write_fitted(tmp_path, FittedRecord(CONFIG, GRID, {"gain": torch.tensor(1.0, dtype=torch.float64)}))
    with pytest.raises(FittedError, match="learn: expected names from .*, got 'gain'"):
        Lpv.load(tmp_path)
