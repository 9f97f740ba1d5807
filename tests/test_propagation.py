import math

import numpy as np
import pytest
import torch

from difflpv.propagation import propagate
from difflpv.reference import propagation as reference
from difflpv.sh import cosine_lobe
from difflpv.stencil import LinearStencil, holpv_stencil, lpv_stencil


def offsets_of(stencil):
    return [tuple(o) for o in stencil.offsets.tolist()]


def twin(volume, stencil, factors, transmittance=None, **options):
    weights = torch.tensor(stencil.flux_weights, dtype=volume.dtype)
    lobes = torch.tensor(stencil.lobes, dtype=volume.dtype)
    return reference.propagate_faces(volume, offsets_of(stencil), weights, lobes, factors, transmittance, **options)


def random_problem(stencil, shape, steps, generator, *, channels=3, dtype=torch.float64, occluded=True):
    def rand(*size):
        return torch.rand(*size, generator=generator, dtype=dtype)

    volume = (rand(channels, (stencil.l_max + 1) ** 2, *shape) - 0.3).requires_grad_()
    transmittance = rand(len(stencil.offsets), *shape).requires_grad_() if occluded else None
    factors = (0.5 + rand(steps)).requires_grad_()
    return volume, transmittance, factors


def emitter(stencil, cells, direction, dtype=torch.float64):
    """1 W of cosine emission in the centre cell."""
    volume = torch.zeros(3, (stencil.l_max + 1) ** 2, cells, cells, cells, dtype=dtype)
    volume[:, :, cells // 2, cells // 2, cells // 2] = torch.tensor(
        cosine_lobe(np.array([direction], float), stencil.l_max)[0] / math.pi, dtype=dtype
    )
    return volume


def total_flux(volume):
    """Integral of the intensity over the sphere and all cells [W]."""
    return volume[:, 0].sum() * 2 * math.sqrt(math.pi)


STENCILS = {
    "lpv": lpv_stencil(),
    "holpv": holpv_stencil(),
    "holpv thesis": holpv_stencil(normalization="thesis"),
    "holpv 16": holpv_stencil(l_max=3),
    "lpv ray": lpv_stencil(reprojection="ray"),
}


TWINS = [(name, torch.float64) for name in STENCILS] + [("lpv", torch.float32), ("holpv", torch.float32)]


@pytest.mark.parametrize("name, dtype", TWINS)
@pytest.mark.parametrize("clamp, occluded", [(True, True), (True, False), (False, True)])
def test_values_and_gradients_agree_with_the_twin(name, dtype, clamp, occluded, generator):
    stencil = STENCILS[name]
    volume, passed, factors = random_problem(stencil, (3, 4, 11), 4, generator, dtype=dtype, occluded=occluded)
    inputs = [volume, factors] + ([passed] if occluded else [])
    expected = twin(volume, stencil, factors, passed, clamp=clamp)
    cotangent = torch.rand(expected.shape, generator=generator, dtype=dtype) - 0.5
    expected_gradients = torch.autograd.grad(expected, inputs, cotangent)
    result = propagate(
        volume, stencil, steps=4, factor=factors, transmittance=passed, clamp=clamp, backend="warp"
    )
    gradients = torch.autograd.grad(result, inputs, cotangent)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-13
    for ours, theirs in zip((result, *gradients), (expected, *expected_gradients), strict=True):
        assert (ours - theirs).norm() <= tolerance * theirs.norm()
        assert ours.abs().max() > 0


@pytest.mark.parametrize("channels, shape", [(6, (2, 3, 8)), (2, (1, 2, 3)), (1, (5, 1, 17)), (3, (1, 1, 1))])
def test_odd_shapes_and_channel_counts(channels, shape, generator):
    stencil = lpv_stencil()
    volume, passed, factors = random_problem(stencil, shape, 3, generator, channels=channels)
    expected = twin(volume, stencil, factors, passed, occlude_first_step=True)
    cotangent = torch.rand(expected.shape, generator=generator, dtype=torch.float64)
    inputs = (volume, factors, passed)
    wanted = torch.autograd.grad(expected, inputs, cotangent, allow_unused=True)
    result = propagate(volume, stencil, steps=3, factor=factors, transmittance=passed, occlude_first_step=True)
    torch.testing.assert_close(result, expected, rtol=1e-12, atol=1e-12)
    for ours, theirs in zip(torch.autograd.grad(result, inputs, cotangent), wanted, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("every", [1, 2, 3, 7, 20])
def test_checkpointing_equals_storing(every, generator):
    volume, passed, factors = random_problem(STENCILS["lpv"], (3, 4, 5), 7, generator)
    options = {"steps": 7, "factor": factors, "transmittance": passed}
    inputs = (volume, factors, passed)
    stored = torch.autograd.grad(propagate(volume, STENCILS["lpv"], **options, checkpoint_every=1).sum(), inputs)
    sparse = torch.autograd.grad(propagate(volume, STENCILS["lpv"], **options, checkpoint_every=every).sum(), inputs)
    assert all(torch.equal(a, b) for a, b in zip(stored, sparse, strict=True))


@pytest.mark.parametrize("name", ["lpv", "holpv"])
def test_convolution_and_warp_agree(name, dtype, generator):
    stencil = STENCILS[name]
    volume, _, factors = random_problem(stencil, (5, 6, 9), 5, generator, dtype=dtype, occluded=False)
    cotangent = torch.rand(volume.shape, generator=generator, dtype=dtype)
    both = []
    for backend in ("warp", "conv3d"):
        result = propagate(volume, stencil, steps=5, factor=factors, clamp=False, backend=backend)
        both.append((result, *torch.autograd.grad(result, (volume, factors), cotangent)))
    for ours, theirs in zip(*both, strict=True):
        assert (ours - theirs).norm() <= (1e-6 if dtype == torch.float32 else 1e-13) * theirs.norm()


def test_linear_stencil_against_the_twin_with_matrix_gradients(generator):
    linear = holpv_stencil(l_max=1).linear_part
    matrices = torch.tensor(linear.matrices).requires_grad_()
    volume, _, factors = random_problem(lpv_stencil(), (3, 4, 5), 3, generator, occluded=False)
    cotangent = torch.rand(volume.shape, generator=generator, dtype=torch.float64)
    inputs = (volume, factors, matrices)
    expected = reference.propagate_linear(volume, offsets_of(linear), matrices, factors)
    result = propagate(volume, linear, steps=3, factor=factors, matrices=matrices)
    torch.testing.assert_close(result, expected, rtol=1e-12, atol=1e-12)
    wanted = torch.autograd.grad(expected, inputs, cotangent)
    for ours, theirs in zip(torch.autograd.grad(result, inputs, cotangent), wanted, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("occluded", [True, False])
def test_gradcheck_and_op_contract(occluded, generator, check_op):
    lpv = lpv_stencil()
    volume, passed, factors = random_problem(lpv, (2, 2, 3), 3, generator, channels=1, occluded=occluded)
    if occluded:
        check_op(lambda v, p, t: propagate(v, lpv, steps=3, factor=p, transmittance=t), (volume, factors, passed))
    else:
        check_op(lambda v, p: propagate(v, lpv, steps=3, factor=p, clamp=False), (volume, factors))


def test_energy_is_kept_without_the_clamp_and_grows_with_it():
    """With room to spare the linear stencil moves 1 W per step and colour; the clamp may only add to it."""
    for stencil in (lpv_stencil(), holpv_stencil()):
        volume = emitter(stencil, 15, (0.0, 0.6, 0.8))
        steps = 6
        linear = propagate(volume, stencil, steps=steps, clamp=False)
        assert total_flux(linear).item() == pytest.approx(3 * (steps + 1), rel=1e-12)
        assert total_flux(propagate(volume, stencil, steps=steps)).item() > 3 * (steps + 1)


def test_thesis_normalisation_is_a_quarter_per_step():
    volume = emitter(lpv_stencil(), 9, (0.0, 0.0, 1.0))
    energy = propagate(volume, lpv_stencil(), steps=3, factor=0.25)
    thesis = propagate(volume, lpv_stencil(normalization="thesis"), steps=3)
    torch.testing.assert_close(energy, thesis, rtol=1e-12, atol=1e-15)


def test_light_travels_one_cell_a_step():
    volume = emitter(holpv_stencil(), 9, (0.0, 0.0, 1.0))
    cells = propagate(volume, holpv_stencil(), steps=2, clamp=False).abs().amax((0, 1)).nonzero() - 4
    assert cells.abs().max() == 2
    assert len(cells) == 5**3


def test_opaque_cells_stop_the_light():
    stencil = lpv_stencil()
    volume = emitter(stencil, 7, (0.0, 0.0, 1.0))
    dark = torch.zeros(len(stencil.offsets), 7, 7, 7, dtype=torch.float64)
    assert torch.equal(propagate(volume, stencil, steps=5, transmittance=dark, occlude_first_step=True), volume)
    freed = propagate(volume, stencil, steps=5, transmittance=dark)
    torch.testing.assert_close(freed, propagate(volume, stencil, steps=1))


def test_tolerance_stops_when_the_moving_flux_has_faded(generator):
    stencil, steps, factor = lpv_stencil(), 40, 0.5
    volume = emitter(stencil, 11, (1.0, 0.0, 0.0)).requires_grad_()
    for backend in ("warp", "conv3d"):
        stopped = propagate(volume, stencil, steps=steps, factor=factor, clamp=False, tolerance=0.01, backend=backend)
        seven = propagate(volume, stencil, steps=7, factor=factor, clamp=False, backend=backend)  # 2^-7 < 0.01
        torch.testing.assert_close(stopped, seven)
        a, b = (torch.autograd.grad(r.square().sum(), volume)[0] for r in (stopped, seven))
        torch.testing.assert_close(a, b)


def test_nothing_is_kept_where_no_gradient_needs_it(generator):
    saved: list[torch.Tensor] = []
    volume, _, factors = random_problem(lpv_stencil(), (4, 4, 4), 5, generator)
    cases = {
        "light only, linear": (propagate, {"factor": 1.0, "clamp": False, "backend": "warp"}, 0),
        "light only, conv3d": (propagate, {"factor": 1.0, "clamp": False, "backend": "conv3d"}, 0),
        "clamp": (propagate, {"factor": 1.0}, 5),
        "factors": (propagate, {"factor": factors, "clamp": False}, 5),
    }
    for name, (function, options, slots) in cases.items():
        saved.clear()
        with torch.autograd.graph.saved_tensors_hooks(lambda t: (saved.append(t), t)[1], lambda t: t):
            function(volume, lpv_stencil(), steps=5, **options)
        kept = sum(t.numel() for t in saved if t.numel() >= volume.numel())
        assert (kept >= slots * volume.numel()) and (slots or not kept), name


def test_backward_twice_and_non_contiguous_input(generator):
    volume, passed, factors = random_problem(lpv_stencil(), (3, 4, 5), 3, generator)
    turned = volume.detach().permute(0, 1, 4, 3, 2).contiguous().permute(0, 1, 4, 3, 2).requires_grad_()
    strided = passed.detach()[..., None].expand(*passed.shape, 2)[..., 0]
    result = propagate(turned, lpv_stencil(), steps=3, factor=factors, transmittance=strided)
    torch.testing.assert_close(result, propagate(volume, lpv_stencil(), steps=3, factor=factors, transmittance=passed))
    first = torch.autograd.grad(result.sum(), turned, retain_graph=True)[0]
    assert torch.equal(first, torch.autograd.grad(result.sum(), turned)[0])


def test_no_steps_and_no_channels():
    volume = torch.rand(3, 4, 2, 2, 2, dtype=torch.float64, requires_grad=True)
    result = propagate(volume, lpv_stencil(), steps=0)
    assert torch.equal(result, volume)
    assert torch.equal(torch.autograd.grad(result.sum(), volume)[0], torch.ones_like(volume))
    assert propagate(torch.zeros(0, 4, 2, 2, 2), lpv_stencil(), steps=3).shape == (0, 4, 2, 2, 2)


@pytest.mark.parametrize("channels", [3, 4])
def test_threads_do_not_change_a_bit(channels, generator):
    """Four channels are four groups, which share the transmittance's gradient."""
    volume, passed, factors = random_problem(
        holpv_stencil(), (5, 6, 7), 3, generator, channels=channels, dtype=torch.float32
    )
    threads = torch.get_num_threads()
    results = []
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            result = propagate(volume, holpv_stencil(), steps=3, factor=factors, transmittance=passed)
            results.append((result, *torch.autograd.grad(result.sum(), (volume, factors, passed))))
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.slow
def test_128_steps_of_holpv_at_64_fit_in_4_gib():
    """The volumes kept for the backward pass: 2 GiB at most, where storing all would take 3.9 GiB."""
    import resource

    volume = torch.rand(3, 9, 64, 64, 64, requires_grad=True)
    saved: list[int] = []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: (saved.append(t.numel() * t.element_size()), t)[1], lambda t: t):
        result = propagate(volume, holpv_stencil(), steps=128, factor=torch.ones(128, requires_grad=True))
    del result
    assert sum(saved) < 2**30
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 4 * 2**20


MESSAGES = [
    (TypeError, "volume: expected a torch.Tensor, got int", lambda v: propagate(3, lpv_stencil(), steps=1)),
    (TypeError, "volume: expected dtype torch.float32 or torch.float64, got torch.int64",
     lambda v: propagate(v.long(), lpv_stencil(), steps=1)),
    (ValueError, r"volume: expected shape \[C, K, n_z, n_y, n_x\], got \[3, 4, 2, 2\]",
     lambda v: propagate(v[..., 0], lpv_stencil(), steps=1)),
    (ValueError, "volume: stencil 'holpv' has 9 coefficients, got 4", lambda v: propagate(v, holpv_stencil(), steps=1)),
    (ValueError, "steps: expected an integer >= 0, got -1", lambda v: propagate(v, lpv_stencil(), steps=-1)),
    (ValueError, r"factor: expected one number or one per step \[2\], got shape \[3\]",
     lambda v: propagate(v, lpv_stencil(), steps=2, factor=torch.ones(3))),
    (ValueError, r"transmittance: expected shape \[30, 2, 2, 2\], got \[6, 2, 2, 2\]",
     lambda v: propagate(v, lpv_stencil(), steps=2, transmittance=torch.ones(6, 2, 2, 2))),
    (TypeError, "transmittance: expected torch.float32 on cpu, got torch.float64 on cpu",
     lambda v: propagate(v, lpv_stencil(), steps=2, transmittance=torch.ones(30, 2, 2, 2).double())),
    (ValueError, "backend: conv3d has neither clamp nor occlusion",
     lambda v: propagate(v, lpv_stencil(), steps=2, backend="conv3d")),
    (ValueError, "clamp: stencil 'lpv' is linear, it has none",
     lambda v: propagate(v, lpv_stencil().linear_part, steps=2, clamp=True)),
    (ValueError, "matrices: only a linear stencil takes them",
     lambda v: propagate(v, lpv_stencil(), steps=2, matrices=torch.ones(6, 4, 4))),
    (ValueError, "checkpoint_every: expected at least 1, got 0",
     lambda v: propagate(v, lpv_stencil(), steps=2, checkpoint_every=0)),
    (ValueError, "tolerance: expected a number >= 0, got -1", lambda v: propagate(v, lpv_stencil(), steps=2, tolerance=-1)),
]  # fmt: skip


@pytest.mark.parametrize("kind, message, call", MESSAGES, ids=[m[1][:40] for m in MESSAGES])
def test_messages(kind, message, call):
    with pytest.raises(kind, match=message):
        call(torch.zeros(3, 4, 2, 2, 2))


def test_linear_stencils_may_leave_out_neighbours(generator):
    one_way = LinearStencil("drift", np.array([[1, 0, 0]]), np.eye(4)[None])
    volume, _, _ = random_problem(lpv_stencil(), (2, 2, 4), 1, generator)
    moved = propagate(volume, one_way, steps=1) - volume
    torch.testing.assert_close(moved[..., 1:], volume[..., :-1])
    assert not moved[..., 0].any()


@pytest.mark.gpu
@pytest.mark.parametrize("name", ["lpv", "holpv"])
def test_cuda_equals_cpu(name, cuda, dtype, generator):
    stencil = STENCILS[name]
    volume, passed, factors = random_problem(stencil, (5, 6, 9), 5, generator, dtype=dtype)
    cotangent = torch.rand(volume.shape, generator=generator, dtype=dtype)
    results = []
    for device in (torch.device("cpu"), cuda):
        inputs = [t.detach().to(device).requires_grad_() for t in (volume, factors, passed)]
        result = propagate(inputs[0], stencil, steps=5, factor=inputs[1], transmittance=inputs[2])
        results.append((result, *torch.autograd.grad(result, inputs, cotangent.to(device))))
    for host, device_result in zip(*results, strict=True):
        difference = (device_result.cpu() - host).norm()
        assert difference <= (1e-5 if dtype == torch.float32 else 1e-12) * host.norm()


@pytest.mark.parametrize("steps", [1, 3])
def test_nothing_beyond_the_factors_is_read(steps, generator):
    """A NaN right behind the factors in memory must not reach a gradient."""
    volume, passed, _ = random_problem(lpv_stencil(), (3, 4, 5), steps, generator)
    memory = torch.full((steps + 1,), torch.nan, dtype=torch.float64)
    memory[:steps] = 0.9
    factors = memory[:steps].requires_grad_()
    result = propagate(volume, lpv_stencil(), steps=steps, factor=factors, transmittance=passed)
    for gradient in torch.autograd.grad(result.sum(), (volume, passed, factors)):
        assert gradient.isfinite().all()


def test_transmittance_alone_has_a_gradient(generator):
    """Without one for the factors, which the same kernel makes."""
    volume, passed, factors = random_problem(holpv_stencil(), (3, 4, 5), 3, generator)

    def gradient(*inputs):
        factor = factors if len(inputs) > 1 else factors.detach()
        result = propagate(volume.detach(), holpv_stencil(), steps=3, factor=factor, transmittance=passed)
        return torch.autograd.grad(result.square().sum(), inputs)[0]

    assert torch.equal(gradient(passed), gradient(passed, factors))
