import numpy as np
import pytest
import torch
from hand_scenes import box_scene, panel_scene

from difflpv.config import LpvConfig
from difflpv.grid import Grid
from difflpv.learnables import GLOBAL_LEARNABLES, LEARNABLES, describe_learnables, fixed_values
from difflpv.parameters import Parameter

GRID = Grid((0.0, 0, 0), 0.25, (4, 4, 4))
FULL = LpvConfig(method="learned_4x6", steps=3, deposit="trilinear", lookup="trilinear")


@pytest.mark.parametrize(
    ("learn", "options", "message"),
    [
        (["gain"], {}, "learn: expected names from propagation, .*albedo, got 'gain'"),
        (["propagation", "propagation"], {}, "learn: 'propagation' is named twice"),
        (["occlusion"], {}, "learn: 'occlusion' needs occlusion='clamp', 'exp' or 'traced', got 'none'"),
        (["injection_bias"], {}, "learn: 'injection_bias' needs deposit='trilinear' or 'visible', got 'nearest'"),
        (["light_position"], {}, "learn: 'light_position' needs deposit='trilinear'"),
        (["cell_occlusion"], {}, "learn: 'cell_occlusion' needs occlusion='clamp', 'exp' or 'traced', got 'none'"),
        (["occlusion_correction"], {"occlusion": "exp"}, "learn: 'occlusion_correction' needs occlusion='traced', got 'exp'"),
        (["sampling_bias"], {"lookup": "front"}, "learn: 'sampling_bias' needs lookup='trilinear' or 'damped', got 'front'"),
        (["stencil"], {}, "learn: 'stencil' needs a learned stencil, got method 'holpv'"),
        (["propagation_steps"], {"steps": 0}, "learn: 'propagation_steps' needs at least one step"),
        (["albedo"], {}, "learn: 'albedo' belongs to a scene: pass scene="),
    ],
)
def test_messages(learn, options, message):
    with pytest.raises(ValueError, match=message):
        describe_learnables(learn, LpvConfig(**options), GRID)


def test_initial_values_only_for_what_is_learned():
    with pytest.raises(ValueError, match=r"initial: expected names that are learned, got \['albedo'\]"):
        describe_learnables(["propagation"], FULL, GRID, initial={"albedo": 1.0})
    with pytest.raises(ValueError, match="parameter 'propagation': initial must be finite and strictly inside"):
        describe_learnables(["propagation"], FULL, GRID, initial={"propagation": 2.5})
    (parameter,) = describe_learnables(["propagation_steps"], FULL, GRID, initial={"propagation_steps": [0.5, 1, 1.5]})
    assert parameter.initial.tolist() == [0.5, 1, 1.5]


def test_shapes_and_starts_of_everything():
    scene = box_scene()
    described: dict[str, Parameter] = {p.name: p for p in describe_learnables(LEARNABLES, FULL, GRID, scene)}
    assert tuple(described) == LEARNABLES
    shapes = {name: list(p.shape) for name, p in described.items()}
    assert shapes["propagation_steps"] == [3] and shapes["light_position"] == [1, 3] and shapes["albedo"] == [6, 3]
    assert shapes["stencil"] == [6] and shapes["cell_occlusion"] == [4, 4, 4] and shapes["lookup_gains"] == [2]
    fixed = fixed_values(FULL)
    assert set(GLOBAL_LEARNABLES) - set(fixed) == {"stencil", "occlusion_correction"}
    for name in fixed:  # a learnable starts where the fixed quantity stands: switching it on changes nothing
        assert torch.equal(described[name].initial, fixed[name])
    assert described["light_position"].scale == GRID.cell_size


@pytest.mark.parametrize(("normalization", "upper"), [("energy", 2.0), ("thesis", 8.0)])
def test_propagation_reaches_twice_its_critical_value(normalization, upper):
    (parameter,) = describe_learnables(["propagation"], LpvConfig(normalization=normalization), GRID)
    assert parameter.upper.item() == upper


def test_black_and_white_surfaces_can_be_learned():
    scene = panel_scene()  # the panel's albedo is 0
    (parameter,) = describe_learnables(["albedo"], FULL, GRID, scene)
    assert np.all((parameter.initial > 0).numpy()) and parameter.initial.min().item() == pytest.approx(1e-3)
