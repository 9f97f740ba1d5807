"""A step leaves out dark and unread cells: same bits where anything is read, and what is left out is never touched."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from difflpv.padded import Layout, Spans
from difflpv.propagation import propagate, propagate_moving
from difflpv.stencil import LinearStencil, holpv_stencil, lpv_stencil
from difflpv.stencil_files import learned_stencil

STENCILS = {
    "lpv": lpv_stencil(), "holpv": holpv_stencil(), "6": learned_stencil("learned_4x6"), "26": learned_stencil("learned_9x26"),
}  # fmt: skip


def fields_of(stencil):
    return stencil.pair_count if isinstance(stencil, LinearStencil) else len(stencil.offsets)


def sparse_problem(stencil, shape, *, seed, lit, closed, channels=3):
    """Light in a few cells, and transmittance that is zero in many places."""
    generator = torch.Generator().manual_seed(seed)
    volume = torch.randn(channels, (stencil.l_max + 1) ** 2, *shape, generator=generator)
    volume *= torch.rand(shape, generator=generator) < lit
    passed = torch.rand(fields_of(stencil), *shape, generator=generator)
    return volume, passed * (torch.rand(passed.shape, generator=generator) >= closed)


shapes = st.tuples(st.integers(1, 7), st.integers(1, 7), st.integers(1, 37))


@settings(max_examples=60, deadline=None)
@given(data=st.data(), shape=shapes, name=st.sampled_from(sorted(STENCILS)), seed=st.integers(0, 99))
def test_what_is_read_has_the_same_bits(data, shape, name, seed):
    stencil, steps = STENCILS[name], data.draw(st.integers(0, 9))
    lit, closed = data.draw(st.sampled_from([0.0, 0.01, 0.1, 1.0])), data.draw(st.sampled_from([0.0, 0.5, 0.95]))
    channels = data.draw(st.sampled_from([1, 3]))
    volume, passed = sparse_problem(stencil, shape, seed=seed, lit=lit, closed=closed, channels=channels)
    ends = [sorted(data.draw(st.tuples(st.integers(0, n), st.integers(0, n)))) for n in shape]
    options = {"steps": steps, "transmittance": passed, "occlude_first_step": True}
    everywhere = Spans.arguments

    def dense(self, moving, into):
        self._of.clear()
        return everywhere(self, moving, into)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Spans, "arguments", dense)
        expected = propagate(volume, stencil, **options)
    assert torch.equal(propagate(volume, stencil, **options), expected)
    z, y, x = (slice(*pair) for pair in ends)
    partial = propagate(volume, stencil, read_box=[v for pair in ends for v in pair], **options)
    assert torch.equal(partial[..., z, y, x], expected[..., z, y, x])


@settings(max_examples=40, deadline=None)
@given(shape=shapes, name=st.sampled_from(["6", "26"]), seed=st.integers(0, 99), occluded=st.booleans(), box=st.booleans())
def test_the_sum_from_the_inside_out_is_the_sum_of_the_steps(shape, name, seed, occluded, box):
    """Without anything but the sum asked for, the last step is taken first; with the moving light, the first."""
    volume, passed = (t.double() for t in sparse_problem(STENCILS[name], shape, seed=seed, lit=0.3, closed=0.3))
    factors = 0.5 + torch.rand(6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    options = {"steps": 6, "factor": factors, "transmittance": passed if occluded else None, "occlude_first_step": True}
    expected, _ = propagate_moving(volume, STENCILS[name], **options)
    z, y, x = (n // 2 + 1 for n in shape) if box else shape
    found = propagate(volume, STENCILS[name], read_box=(0, z, 0, y, 0, x), **options)
    torch.testing.assert_close(found[..., :z, :y, :x], expected[..., :z, :y, :x], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", STENCILS)
def test_gradients_through_a_box_equal_those_without(name, generator):
    stencil = STENCILS[name]
    volume, passed = sparse_problem(stencil, (6, 5, 20), seed=4, lit=0.1, closed=0.5)
    factors = torch.rand(5, generator=generator) + 0.5
    inputs = [t.double().requires_grad_() for t in (volume, passed, factors)]
    results = []
    for box in (None, (1, 3, 0, 2, 4, 9)):
        result = propagate(inputs[0], stencil, steps=5, transmittance=inputs[1], factor=inputs[2], read_box=box)
        results.append(torch.autograd.grad(result[..., 1:3, 0:2, 4:9].square().sum(), inputs))
    for whole, boxed in zip(*results, strict=True):
        assert whole.abs().max() > 0
        torch.testing.assert_close(boxed, whole, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("name", STENCILS)
def test_dark_rows_are_not_computed(name):
    """A transmittance that is NaN where no light comes near would spread if it were ever multiplied."""
    stencil = STENCILS[name]
    volume, passed = sparse_problem(stencil, (12, 4, 9), seed=1, lit=1.0, closed=0.0)
    volume[..., 2:, :, :] = 0
    passed[:, 8:] = torch.nan  # four steps reach plane 5, and the first step of all looks everywhere
    result = propagate(volume, stencil, steps=4, transmittance=passed)
    assert result.isfinite().all()
    assert (result[..., 5, :, :] != 0).any()
    assert (result[..., 6:, :, :] == 0).all()


@pytest.mark.parametrize("name", STENCILS)
def test_cells_too_far_from_what_is_read_are_not_computed(name):
    stencil = STENCILS[name]
    volume, passed = sparse_problem(stencil, (12, 4, 9), seed=1, lit=1.0, closed=0.0)
    clean = propagate(volume, stencil, steps=4, transmittance=passed)
    volume[..., 6:, :, :] = torch.nan  # read_box ends at plane 2; four steps bring plane 5 there
    result = propagate(volume, stencil, steps=4, transmittance=passed, read_box=(0, 2, 0, 4, 0, 9))
    assert torch.equal(result[..., :2, :, :], clean[..., :2, :, :])


@pytest.mark.parametrize("name", ["lpv", "26"])
def test_tolerance_counts_the_flux_of_every_row(name):
    """The kernel's sums stop the solve at the same step as sums over the moving volume do."""
    stencil = STENCILS[name]
    volume, passed = sparse_problem(stencil, (5, 6, 18), seed=3, lit=0.3, closed=0.2)
    solved = [propagate(volume, stencil, steps=n, transmittance=passed, factor=0.7) for n in range(14)]
    moved = np.array([float((b - a)[:, 0].abs().sum()) for a, b in zip(solved, solved[1:], strict=False)])
    tolerance = 0.05
    expected = 1 + int(np.argmax(moved <= tolerance * float(volume[:, 0].abs().sum())))
    assert 1 < expected < 13
    stopped = propagate(volume, stencil, steps=40, transmittance=passed, factor=0.7, tolerance=tolerance)
    assert torch.equal(stopped, solved[expected])


@pytest.mark.parametrize(("name", "tolerance", "volumes"), [("lpv", 0.0, 3), ("26", 1e-30, 3), ("26", 0.0, 2)])
def test_volumes_held_without_gradients(name, tolerance, volumes):
    stencil = STENCILS[name]
    volume, _ = sparse_problem(stencil, (24, 24, 24), seed=3, lit=1.0, closed=0.0)
    cpu = [torch.profiler.ProfilerActivity.CPU]
    with torch.no_grad(), torch.profiler.profile(activities=cpu, profile_memory=True) as profile:
        propagate(volume, stencil, steps=12, tolerance=tolerance)
    sizes = [e.nbytes() for e in profile.profiler.kineto_results.events() if e.name() == "[memory]"]
    one = Layout.of(volume, 16 if name == "26" else 8).length(volume.shape[0] * volume.shape[1]) * volume.element_size()
    assert max(np.cumsum(sizes)) / one == pytest.approx(volumes, abs=0.1)


@pytest.mark.parametrize("box", [(0, 2, 0, 4), (0, 5, 0, 4, 0, 4), (3, 2, 0, 4, 0, 4), (-1, 2, 0, 4, 0, 4)])
def test_a_box_that_does_not_fit_is_named(box):
    with pytest.raises(ValueError, match=r"read_box: expected \(begin, end\) of z, y, x within \[4, 4, 4\]"):
        propagate(torch.zeros(3, 4, 4, 4, 4), lpv_stencil(), steps=1, read_box=box)
