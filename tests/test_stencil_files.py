import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from difflpv.config import LpvConfig, grid_for
from difflpv.io import load_scene
from difflpv.simulate import simulate
from difflpv.stability import TOLERANCE, stability
from difflpv.stencil import LinearStencil, holpv_stencil
from difflpv.stencil_files import LEARNED_STENCILS, StencilError, learned_stencil, load_stencil, save_stencil
from difflpv.symmetry import asymmetry

SHEETS = Path(__file__).resolve().parents[1] / "difflpv" / "data" / "stencils"


@pytest.mark.parametrize("name", LEARNED_STENCILS)
def test_shipped_stencils_conserve_and_are_stable(name):
    stencil = learned_stencil(name)
    count, neighbors = (int(n) for n in name.removeprefix("learned_").split("x"))
    assert stencil.name == name and stencil.matrices.shape == (neighbors + 1, count, count)
    assert stencil.uniform_gain()[0, 0] == pytest.approx(1, abs=1e-15)
    assert asymmetry(stencil) < 1e-12
    report = stability(stencil)
    assert report.radius <= 1 + TOLERANCE and report.stable


def test_round_trip_keeps_every_bit(tmp_path):
    path = tmp_path / "mine.safetensors"
    save_stencil(path, holpv_stencil().linear_part)
    back = load_stencil(path)
    assert back.name == "mine"
    own = holpv_stencil().linear_part
    assert (back.matrices == own.matrices).all() and (back.offsets == own.offsets).all()


def test_unstable_file_warns_with_the_cure(tmp_path):
    own = holpv_stencil().linear_part
    save_stencil(tmp_path / "hot.safetensors", LinearStencil("hot", own.offsets, 1.1 * own.matrices))
    with pytest.warns(RuntimeWarning, match=r"'hot' is unstable.*factor of at most 0\.909"):
        load_stencil(tmp_path / "hot.safetensors")


def test_errors_name_file_and_reason(tmp_path):
    with pytest.raises(StencilError, match="missing.safetensors: not found"):
        load_stencil(tmp_path / "missing.safetensors")
    (tmp_path / "junk.safetensors").write_bytes(b"not a stencil")
    with pytest.raises(StencilError, match="junk.safetensors: damaged"):
        load_stencil(tmp_path / "junk.safetensors")
    save_file({"offsets": np.zeros((1, 3), np.int32)}, tmp_path / "half.safetensors")
    with pytest.raises(StencilError, match="missing matrices"):
        load_stencil(tmp_path / "half.safetensors")
    save_file({"offsets": np.zeros((2, 3), np.int32), "matrices": np.zeros((2, 4, 4))}, tmp_path / "twice.safetensors")
    with pytest.raises(StencilError, match="twice.safetensors: offsets: expected distinct"):
        load_stencil(tmp_path / "twice.safetensors")
    with pytest.raises(StencilError, match="expected one of learned_4x6.*got 'learned_5x5'"):
        learned_stencil("learned_5x5")


@pytest.mark.parametrize("name", LEARNED_STENCILS)
def test_every_stencil_has_its_configuration(name):
    sheet = json.loads((SHEETS / f"{name}.json").read_text())
    assert sheet["config"]["rung"] == name and sheet["training"]["errors"]


def test_learned_method_is_linear_in_a_configuration():
    config = LpvConfig(method="learned_4x26")
    assert not config.clamp and config.stencil is learned_stencil("learned_4x26") and config.critical_factor == 1.0
    assert LpvConfig.from_json(config.to_json()) == config
    assert (config.occlusion, config.lookup, config.occlude_first_step) == ("traced", "affine", True)
    for name, value in (("normalization", "thesis"), ("reprojection", "ray")):
        with pytest.raises(ValueError, match=f"{name}: the linear stencil 'learned_4x26' needs .* got '{value}'"):
            LpvConfig(method="learned_4x26", **{name: value})
    with pytest.raises(ValueError, match="l_max: 'learned_4x26' has 1, got 2"):
        LpvConfig(method="learned_4x26", l_max=2)


@pytest.mark.slow
def test_learned_method_beats_the_published_kernel_on_an_unseen_scene():
    # The box was never shown to the training. Truth: tests/data/truth, an independent renderer.
    truth = np.load(Path(__file__).parent / "data" / "truth" / "cornell.npz")
    scene = load_scene("cornell")
    weight = np.sqrt(truth["area_weight"])[:, None]
    errors = {}
    for method in ("holpv", "learned_9x26"):
        config, points = LpvConfig(method=method), (truth["position"], truth["normal"])
        found = simulate(scene, *points, grid=grid_for(scene), config=config, component="bounce1")
        gap = weight * (found.irradiance - truth["irr_bounce1"])
        errors[method] = np.linalg.norm(gap) / np.linalg.norm(weight * truth["irr_bounce1"])
    assert errors["learned_9x26"] < 0.5 * errors["holpv"]
