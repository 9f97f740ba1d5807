"""What still moves after the last step, from each of the three ways to propagate, and its gradient."""

import pytest
import torch

from difflpv.propagation import propagate, propagate_moving
from difflpv.stencil import lpv_stencil
from difflpv.stencil_files import learned_stencil

SHAPE = (2, 2, 3)
LEARNED = learned_stencil("learned_4x6")
# stencil, options, fields of the transmittance (0: none)
WAYS = {
    "faces, clamp, occlusion": (lpv_stencil(), {}, 30),
    "faces": (lpv_stencil(), {"clamp": False}, 0),
    "pairs, occlusion": (LEARNED, {"occlude_first_step": True}, 3),
    "pairs": (LEARNED, {}, 0),
    "convolution": (LEARNED, {"backend": "conv3d"}, 0),
}


def problem(way, generator, *, channels=1, steps=3, dtype=torch.float64):
    stencil, _, fields = WAYS[way]

    def rand(*size):
        return torch.rand(*size, generator=generator, dtype=dtype)

    volume = (rand(channels, (stencil.l_max + 1) ** 2, *SHAPE) + 0.1).requires_grad_()
    with torch.no_grad():
        volume[:, 1:] *= 0.1  # far from the clamp's kink, where finite differences mean nothing
    factors = (0.5 + rand(steps)).requires_grad_()
    passed = rand(fields, *SHAPE).requires_grad_() if fields else None
    return volume, factors, passed


def run(way, volume, factors, passed, function=propagate_moving, steps=None):
    stencil, options, _ = WAYS[way]
    steps = len(factors) if steps is None else steps
    return function(volume, stencil, steps=steps, factor=factors[:steps], transmittance=passed, **options)


@pytest.mark.parametrize("way", WAYS)
def test_it_is_what_the_last_step_adds(way, generator):
    inputs = problem(way, generator, channels=3)
    total, moving = run(way, *inputs)
    assert torch.equal(total, run(way, *inputs, propagate))
    torch.testing.assert_close(moving, total - run(way, *inputs, propagate, steps=2))
    total, moving = run(way, *inputs, steps=0)
    assert torch.equal(total, inputs[0]) and torch.equal(moving, inputs[0])


@pytest.mark.parametrize("way", WAYS)
def test_gradcheck_of_both_outputs(way, generator):
    """All inputs that learn, through both results at once and through what moves alone."""
    volume, factors, passed = problem(way, generator)
    learned = [x for x in (volume, factors, passed) if x is not None]

    def both(*inputs):
        return run(way, *inputs, *([None] if passed is None else []))

    assert torch.autograd.gradcheck(both, learned)
    assert torch.autograd.gradcheck(lambda *inputs: both(*inputs)[1], learned)


@pytest.mark.parametrize("way", ["faces", "pairs", "convolution"])
@pytest.mark.parametrize("every", [1, 2])
def test_two_halves_are_one_march(way, every, generator):
    """Steps 1 to 3 and, from what still moves, 4 and 5: values and gradients of all five in one go."""
    volume, factors, _ = problem(way, generator, steps=5)
    stencil, options, _ = WAYS[way]
    options = {**options, "checkpoint_every": every}
    target = torch.rand(volume.shape, generator=generator, dtype=volume.dtype)
    whole = propagate(volume, stencil, steps=5, factor=factors, **options)
    expected = torch.autograd.grad((whole * target).sum(), [volume, factors])
    first, moving = propagate_moving(volume, stencil, steps=3, factor=factors[:3], **options)
    pieces = first - moving + propagate(moving, stencil, steps=2, factor=factors[3:], **options)
    torch.testing.assert_close(pieces, whole)
    for found, wanted in zip(torch.autograd.grad((pieces * target).sum(), [volume, factors]), expected, strict=True):
        torch.testing.assert_close(found, wanted)


@pytest.mark.parametrize("way", ["faces", "pairs", "convolution"])
def test_where_tolerance_ends_the_march_the_last_step_taken_counts(way, generator):
    volume, _, _ = problem(way, generator)
    stencil, options, _ = WAYS[way]
    total, moving = propagate_moving(volume, stencil, steps=50, factor=0.1, tolerance=0.05, **options)
    taken = [propagate(volume, stencil, steps=n, factor=0.1, **options) for n in range(4)]
    n = next(n for n in range(4) if torch.allclose(taken[n], total))
    assert 1 <= n < 3
    torch.testing.assert_close(moving, taken[n] - taken[n - 1])
