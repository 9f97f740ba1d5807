import dataclasses

import numpy as np
import pytest
from hand_scenes import box_scene

from difflpv.config import LpvConfig, grid_for
from difflpv.grid import Grid
from difflpv.io import load_scene
from difflpv.stencil import FaceStencil


def test_defaults_are_the_publications():
    config = LpvConfig()
    assert (config.method, config.steps, config.occlusion, config.normalization) == ("holpv", 32, "none", "energy")
    assert (config.clamp, config.deposit, config.occlude_first_step, config.reprojection) == (True, "nearest", False, "face")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "LPV"}, r"method: expected one of lpv, holpv.*, got 'LPV'"),
        ({"occlusion": "soft"}, "occlusion: expected one of none, clamp, exp, traced, got 'soft'"),
        ({"normalization": "flux"}, "normalization: expected one of energy, thesis, got 'flux'"),
        ({"reprojection": "lobe"}, "reprojection: expected one of face, ray, got 'lobe'"),
        ({"deposit": "cubic"}, "deposit: expected one of nearest, trilinear, visible, got 'cubic'"),
        ({"steps": -1}, "steps: expected an integer >= 0, got -1"),
        ({"steps": 2.5}, "steps: expected an integer >= 0, got 2.5"),
        ({"steps": True}, "steps: expected an integer >= 0, got True"),
        ({"coarsen_after": 1.5}, "coarsen_after: expected an integer >= 1, got 1.5"),
        ({"l_max": 2.0}, "l_max: expected an integer >= 0, got 2.0"),
        ({"clamp": "no"}, "clamp: expected true or false, got 'no'"),
        ({"occlude_first_step": 1}, "occlude_first_step: expected true or false, got 1"),
        ({"tolerance": -0.1}, "tolerance: expected a number >= 0, got -0.1"),
        ({"tolerance": float("nan")}, "tolerance: expected a number >= 0, got nan"),
        ({"tolerance": "0"}, "tolerance: expected a number >= 0, got '0'"),
        ({"l_max": 4}, "l_max"),
    ],
)
def test_messages(options, message):
    with pytest.raises(ValueError, match=message):
        LpvConfig(**options)


@pytest.mark.parametrize("method", ["lpv", "holpv"])
@pytest.mark.parametrize("normalization", ["energy", "thesis"])
def test_critical_factor_keeps_an_isotropic_field(method, normalization):
    """Gain of l = 0 per step: sum over faces of weight times lobe, times the factor, is 1 at the critical factor."""
    config = LpvConfig(method=method, normalization=normalization)
    stencil = config.stencil
    assert isinstance(stencil, FaceStencil)
    gain = (stencil.flux_weights[:, 0] * stencil.lobes[:, 0]).sum()
    assert config.critical_factor * gain == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("method", ["lpv", "holpv"])
def test_json_round_trip(method):
    config = LpvConfig(method=method, steps=7, deposit="trilinear", tolerance=0.01)
    assert LpvConfig.from_json(config.to_json()) == config
    assert set(config.to_json()) == {f.name for f in dataclasses.fields(LpvConfig)}


def test_json_of_another_version():
    with pytest.raises(ValueError, match=r"configuration: unknown names \['bounces'\]"):
        LpvConfig.from_json({"method": "lpv", "bounces": 2})


def test_grid_of_the_scene_and_of_no_scene():
    cornell = load_scene("cornell")
    assert grid_for(cornell) == cornell.grid
    coarse = grid_for(cornell, 16)
    assert coarse.resolution == (16, 16, 16) and coarse.cell_size == pytest.approx(0.75)
    assert coarse.minimum == cornell.grid.minimum
    box = box_scene()
    grid = grid_for(box)
    assert grid.resolution == (32, 32, 32) and grid.contains(np.array([[-1.0, -1, -1], [0.999, 1, 1]])).all()
    assert grid_for(box, 10) == Grid.around(*box.bounds, 10)
    with pytest.raises(ValueError, match="grid: expected at least 3 cells, got 2"):
        grid_for(cornell, 2)
