import numpy as np
import pytest
import torch

from difflpv.propagation import propagate
from difflpv.reference import propagation as reference
from difflpv.stencil import LinearStencil, holpv_stencil, pair_offsets
from difflpv.stencil_files import learned_stencil
from difflpv.symmetry import equivariant_basis, neighborhood_offsets

KINDS = [(4, 6), (9, 6), (16, 6), (4, 26), (9, 26), (16, 26)]


def stencil_of(coeffs, neighbors, *, equivariant=False, seed=5):
    """Random numbers, or random coordinates in the space of stencils that the cube's symmetries leave alone."""
    random, offsets = np.random.default_rng(seed), neighborhood_offsets(neighbors)
    if equivariant:
        basis = equivariant_basis(round(coeffs**0.5) - 1, neighbors)
        return LinearStencil("equivariant", offsets, np.tensordot(random.normal(size=len(basis)), basis, 1) / 4)
    return LinearStencil("random", offsets, random.normal(size=(len(offsets), coeffs, coeffs)) / 20)


def problem(stencil, shape, steps, generator, *, channels=3, dtype=torch.float64):
    """Volume, matrices, factors, transmittance, all of them learnable."""

    def rand(*size):
        return torch.rand(*size, generator=generator, dtype=dtype)

    volume = rand(channels, (stencil.l_max + 1) ** 2, *shape) - 0.3
    matrices = torch.tensor(stencil.matrices, dtype=dtype)
    inputs = (volume, matrices, 0.5 + rand(steps), rand(len(pair_offsets(stencil.offsets)), *shape))
    return [t.requires_grad_() for t in inputs]


def solve(stencil, volume, matrices, factors, passed, **options):
    return propagate(
        volume, stencil, steps=len(factors), factor=factors, transmittance=passed, matrices=matrices, **options
    )


def twin(stencil, volume, matrices, factors, passed, **options):
    offsets = [tuple(n) for n in stencil.offsets.tolist()]
    return reference.propagate_linear(volume, offsets, matrices, factors, passed, **options)


def assert_agree(ours, theirs, tolerance):
    for a, b in zip(ours, theirs, strict=True):
        assert (a - b).norm() <= tolerance * b.norm()
        assert b.norm() > 0


def test_pairs_are_the_later_half_in_lexicographic_order():
    assert pair_offsets(neighborhood_offsets(6)).tolist() == [[0, 0, 1], [0, 1, 0], [1, 0, 0]]
    pairs = [tuple(n) for n in pair_offsets(neighborhood_offsets(26)).tolist()]
    assert len(pairs) == 13
    assert pairs == sorted(pairs)
    assert all(n > (0, 0, 0) for n in pairs)
    assert pair_offsets(neighborhood_offsets(26)[::-1]).tolist() == [list(n) for n in pairs]
    assert pair_offsets(np.array([[-1, 0, 0]])).tolist() == [[1, 0, 0]]
    assert pair_offsets(np.zeros((1, 3), int)).shape == (0, 3)


@pytest.mark.parametrize("equivariant", [False, True])
@pytest.mark.parametrize("coeffs, neighbors", KINDS)
def test_values_and_gradients_agree_with_the_twin(coeffs, neighbors, equivariant, generator):
    stencil = stencil_of(coeffs, neighbors, equivariant=equivariant)
    inputs = problem(stencil, (3, 4, 11), 3, generator)
    expected = twin(stencil, *inputs)
    cotangent = torch.rand(expected.shape, generator=generator, dtype=torch.float64) - 0.5
    result = solve(stencil, *inputs)
    theirs = torch.autograd.grad(expected, inputs, cotangent)
    assert_agree((result, *torch.autograd.grad(result, inputs, cotangent)), (expected, *theirs), 1e-12)


@pytest.mark.parametrize("equivariant", [False, True])
@pytest.mark.parametrize("occlude_first_step", [False, True])
def test_float32_agrees_with_the_twin(equivariant, occlude_first_step, generator):
    stencil = stencil_of(9, 26, equivariant=equivariant)
    inputs = problem(stencil, (4, 5, 18), 3, generator, dtype=torch.float32)
    expected = twin(stencil, *inputs, occlude_first_step=occlude_first_step)
    cotangent = torch.rand(expected.shape, generator=generator) - 0.5
    result = solve(stencil, *inputs, occlude_first_step=occlude_first_step)
    theirs = torch.autograd.grad(expected, inputs, cotangent)
    assert_agree((result, *torch.autograd.grad(result, inputs, cotangent)), (expected, *theirs), 1e-5)


@pytest.mark.parametrize("channels, shape", [(6, (2, 3, 8)), (2, (1, 2, 3)), (1, (5, 1, 17)), (3, (1, 1, 1)), (4, (3, 1, 16))])
def test_odd_shapes_and_channel_counts(channels, shape, generator, dtype, relative_tolerance):
    stencil = stencil_of(4, 26)
    inputs = problem(stencil, shape, 3, generator, channels=channels, dtype=dtype)
    expected = twin(stencil, *inputs, occlude_first_step=True)
    cotangent = torch.rand(expected.shape, generator=generator, dtype=dtype)
    result = solve(stencil, *inputs, occlude_first_step=True)
    theirs = torch.autograd.grad(expected, inputs, cotangent)
    for a, b in zip((result, *torch.autograd.grad(result, inputs, cotangent)), (expected, *theirs), strict=True):
        assert (a - b).norm() <= relative_tolerance(dtype) * b.norm()


def test_two_cells_by_hand():
    """Two cells along x: light goes to and fro through one pair, and what stands for the outside does not matter."""
    random = np.random.default_rng(2)
    stencil = LinearStencil("line", np.array([[1, 0, 0], [0, 0, 0], [-1, 0, 0]]), random.normal(size=(3, 4, 4)))
    ahead, stay, back = stencil.matrices
    left, right = random.normal(size=(2, 4))
    t, p, q = 0.3, 0.9, 0.7
    passed = torch.tensor([t, torch.nan], dtype=torch.float64).view(1, 1, 1, 2).requires_grad_()
    volume = torch.tensor(np.stack([left, right], -1)).view(1, 4, 1, 1, 2)
    result = solve(stencil, volume, None, torch.tensor([p, q], dtype=torch.float64), passed)
    left1, right1 = p * (stay @ left + back @ right), p * (stay @ right + ahead @ left)
    left2, right2 = q * (stay @ left1 + t * back @ right1), q * (stay @ right1 + t * ahead @ left1)
    expected = np.stack([left + left1 + left2, right + right1 + right2], -1)
    np.testing.assert_allclose(result.detach().numpy().reshape(4, 2), expected, rtol=1e-13)
    gradient = torch.autograd.grad(result.sum(), passed)[0].flatten()
    assert gradient[0].item() == pytest.approx(q * (back @ right1 + ahead @ left1).sum(), rel=1e-12)
    assert gradient[1] == 0


@pytest.mark.parametrize("equivariant", [False, True])
def test_nothing_in_the_way_equals_conv3d(equivariant, generator):
    stencil = stencil_of(9, 26, equivariant=equivariant)
    volume, matrices, factors, passed = problem(stencil, (5, 6, 9), 4, generator)
    cotangent = torch.rand(volume.shape, generator=generator, dtype=torch.float64)
    clear = torch.ones_like(passed).requires_grad_()
    results = []
    for options in ({"backend": "conv3d"}, {"backend": "warp"}, {"transmittance": clear, "occlude_first_step": True}):
        result = propagate(volume, stencil, steps=4, factor=factors, matrices=matrices, **options)
        results.append((result, *torch.autograd.grad(result, (volume, factors, matrices), cotangent)))
    assert_agree(results[1], results[0], 1e-13)
    assert_agree(results[2], results[0], 1e-13)


def test_behind_opaque_pairs_light_stays_where_it_is(generator):
    """The first step is free, then each cell keeps only what its own matrix leaves there."""
    stencil = learned_stencil("learned_9x26")
    volume, matrices, _, passed = (t.detach() for t in problem(stencil, (5, 6, 7), 1, generator))
    free = propagate(volume, stencil, steps=1) - volume
    stay = matrices[13]
    assert not stencil.offsets[13].any()
    once = torch.einsum("ij,cjzyx->cizyx", stay, free)
    expected = volume + free + once + torch.einsum("ij,cjzyx->cizyx", stay, once)
    dark = torch.zeros_like(passed)
    torch.testing.assert_close(propagate(volume, stencil, steps=3, transmittance=dark), expected, rtol=1e-12, atol=1e-12)
    kept = torch.einsum("ij,cjzyx->cizyx", stay, volume)
    all_dark = propagate(volume, stencil, steps=1, transmittance=dark, occlude_first_step=True)
    torch.testing.assert_close(all_dark, volume + kept, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("equivariant", [False, True])
def test_the_adjoint_is_the_transpose(equivariant, generator):
    """<G, F S> = <F^T G, S>, F being linear in the light."""
    stencil = stencil_of(9, 26, equivariant=equivariant)
    volume, _, factors, passed = problem(stencil, (4, 5, 6), 5, generator)
    result = solve(stencil, volume, None, factors.detach(), passed.detach())
    cotangent = torch.randn(result.shape, generator=generator, dtype=torch.float64)
    back = torch.autograd.grad(result, volume, cotangent)[0]
    assert (cotangent * result).sum().item() == pytest.approx((back * volume).sum().item(), rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("occluded", [True, False])
def test_gradcheck_and_op_contract(occluded, generator, check_op):
    stencil = stencil_of(4, 6)
    inputs = problem(stencil, (2, 2, 3), 3, generator, channels=1)
    if occluded:
        check_op(lambda *i: solve(stencil, *i, occlude_first_step=True), inputs)
    else:
        check_op(lambda v, m, p: solve(stencil, v, m, p, None, backend="warp"), inputs[:3])


def test_one_way_stencils_run_unoccluded(generator):
    one_way = LinearStencil("drift", np.array([[1, 0, 0], [0, -1, 1]]), np.random.default_rng(1).normal(size=(2, 4, 4)))
    inputs = problem(one_way, (3, 4, 5), 3, generator)[:3]
    both = []
    for backend in ("warp", "conv3d"):
        result = solve(one_way, *inputs, None, backend=backend)
        both.append((result, *torch.autograd.grad(result.square().sum(), inputs)))
    assert_agree(*both, 1e-13)


@pytest.mark.parametrize("every", [1, 2, 3, 7, 20])
def test_checkpointing_equals_storing(every, generator):
    stencil = stencil_of(4, 26)
    inputs = problem(stencil, (3, 4, 5), 7, generator)

    def gradients(every):
        return torch.autograd.grad(solve(stencil, *inputs, checkpoint_every=every).square().sum(), inputs)

    assert all(torch.equal(a, b) for a, b in zip(gradients(1), gradients(every), strict=True))


@pytest.mark.parametrize("channels", [2, 3])
def test_threads_do_not_change_a_bit(channels, generator):
    stencil = learned_stencil("learned_9x26")
    inputs = problem(stencil, (5, 6, 7), 3, generator, channels=channels, dtype=torch.float32)
    threads = torch.get_num_threads()
    results = []
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            result = solve(stencil, *inputs)
            results.append((result, *torch.autograd.grad(result.sum(), inputs)))
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_each_learnable_alone_has_the_same_gradient(generator):
    """Every set of flags is another kernel; only what is asked for is made."""
    stencil = stencil_of(9, 26, equivariant=True)
    inputs = problem(stencil, (3, 4, 5), 3, generator)
    together = torch.autograd.grad(solve(stencil, *inputs).square().sum(), inputs)
    for i, expected in enumerate(together):
        alone = [t.detach().requires_grad_(j == i) for j, t in enumerate(inputs)]
        (gradient,) = torch.autograd.grad(solve(stencil, *alone).square().sum(), [alone[i]])
        torch.testing.assert_close(gradient, expected, rtol=1e-12, atol=1e-12)


def test_nothing_is_kept_where_only_light_learns(generator):
    stencil = learned_stencil("learned_4x26")
    volume, matrices, factors, passed = problem(stencil, (4, 4, 4), 5, generator)
    saved: list[torch.Tensor] = []
    for inputs, slots in (((None, factors.detach(), passed.detach()), 0), ((matrices, factors, passed), 5)):
        saved.clear()
        with torch.autograd.graph.saved_tensors_hooks(lambda t: (saved.append(t), t)[1], lambda t: t):
            solve(stencil, volume, *inputs)
        kept = [t for t in saved if t.ndim == 2 and t.shape[1] >= volume.numel()]
        assert sum(len(t) for t in kept) == slots


def test_backward_twice_and_non_contiguous_input(generator):
    stencil = stencil_of(4, 26)
    volume, matrices, factors, passed = problem(stencil, (3, 4, 5), 3, generator)
    turned = volume.detach().permute(0, 1, 4, 3, 2).contiguous().permute(0, 1, 4, 3, 2).requires_grad_()
    strided = passed.detach()[..., None].expand(*passed.shape, 2)[..., 0]
    columns = matrices.detach().transpose(1, 2).contiguous().transpose(1, 2)
    result = solve(stencil, turned, columns, factors, strided)
    torch.testing.assert_close(result, solve(stencil, volume, matrices, factors, passed))
    first = torch.autograd.grad(result.sum(), (turned, factors), retain_graph=True)
    assert all(torch.equal(a, b) for a, b in zip(first, torch.autograd.grad(result.sum(), (turned, factors)), strict=True))


def test_no_steps_and_no_channels(generator):
    stencil = stencil_of(4, 6)
    inputs = problem(stencil, (2, 2, 2), 0, generator)
    result = solve(stencil, *inputs)
    assert torch.equal(result, inputs[0])
    gradients = torch.autograd.grad(result.sum(), inputs)
    assert [float(g.abs().sum()) for g in gradients] == [inputs[0].numel(), 0, 0, 0]
    inputs = problem(stencil, (2, 2, 2), 2, generator, channels=0)
    assert solve(stencil, *inputs).shape == inputs[0].shape
    assert all(not g.any() for g in torch.autograd.grad(solve(stencil, *inputs).sum(), inputs))


def test_tolerance_stops_when_the_moving_flux_has_faded(generator):
    stencil = learned_stencil("learned_4x26")
    inputs = problem(stencil, (5, 5, 5), 40, generator)[:1] + problem(stencil, (5, 5, 5), 40, generator)[1:]
    with torch.no_grad():
        inputs[2].fill_(0.4)
    stopped = solve(stencil, *inputs, tolerance=0.01)
    counts = [int((t != 0).sum()) for t in torch.autograd.grad(stopped.sum(), inputs[2:3], retain_graph=True)]
    assert 1 < counts[0] < 8
    short = [*inputs[:2], inputs[2][: counts[0]].detach().requires_grad_(), inputs[3]]
    expected = solve(stencil, *short)
    assert torch.equal(stopped, expected)
    for i in (0, 1, 3):
        a, b = (torch.autograd.grad(r.square().sum(), inputs[i], retain_graph=True)[0] for r in (stopped, expected))
        torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("shape", [(3, 4, 5), (2, 1, 16)])
def test_nothing_beyond_the_inputs_is_read(shape, generator):
    """NaN right behind every input in memory, and freed memory full of NaN, must reach neither value nor gradient."""
    stencil = learned_stencil("learned_9x26")
    inputs = []
    for tensor in problem(stencil, shape, 3, generator):
        memory = torch.full((tensor.numel() + 64,), torch.nan, dtype=torch.float64)
        memory[: tensor.numel()] = tensor.detach().flatten()
        inputs.append(memory[: tensor.numel()].view(tensor.shape).requires_grad_())
    expected = twin(stencil, *inputs)
    wanted = torch.autograd.grad(expected.square().sum(), inputs)
    for _ in range(3):
        poison = [torch.full((size,), torch.nan, dtype=torch.float64) for size in (2**10, 2**13, 2**16, 2**19)]
        del poison
        result = solve(stencil, *inputs, checkpoint_every=2)
        assert_agree((result, *torch.autograd.grad(result.square().sum(), inputs)), (expected, *wanted), 1e-12)


MESSAGES = [
    (ValueError, r"transmittance: expected shape \[13, 2, 2, 2\], got \[26, 2, 2, 2\]",
     lambda v, s: propagate(v, s, steps=1, transmittance=torch.ones(26, 2, 2, 2))),
    (TypeError, "transmittance: expected torch.float32 on cpu, got torch.float64 on cpu",
     lambda v, s: propagate(v, s, steps=1, transmittance=torch.ones(13, 2, 2, 2).double())),
    (ValueError, "backend: conv3d has no occlusion; use 'auto' or 'warp'",
     lambda v, s: propagate(v, s, steps=1, transmittance=torch.ones(13, 2, 2, 2), backend="conv3d")),
    (ValueError, r"transmittance: stencil 'drift' lacks the opposite of offset \[1, 0, 0\]",
     lambda v, s: propagate(v, LinearStencil("drift", np.array([[1, 0, 0]]), np.eye(4)[None]), steps=1,
                            transmittance=torch.ones(1, 2, 2, 2))),
    (ValueError, "clamp: stencil 'holpv' is linear, it has none", lambda v, s: propagate(v, s, steps=1, clamp=True)),
    (ValueError, r"matrices: expected shape \[26, 4, 4\], got \[27, 4, 4\]",
     lambda v, s: propagate(v, s, steps=1, matrices=torch.ones(27, 4, 4))),
]  # fmt: skip


@pytest.mark.parametrize("kind, message, call", MESSAGES, ids=[m[1][:40] for m in MESSAGES])
def test_messages(kind, message, call):
    with pytest.raises(kind, match=message):
        call(torch.zeros(3, 4, 2, 2, 2), holpv_stencil(l_max=1).linear_part)


@pytest.mark.gpu
@pytest.mark.parametrize("equivariant", [False, True])
def test_cuda_equals_cpu(equivariant, cuda, dtype, generator):
    stencil = stencil_of(9, 26, equivariant=equivariant)
    inputs = problem(stencil, (5, 6, 9), 4, generator, dtype=dtype)
    cotangent = torch.rand(inputs[0].shape, generator=generator, dtype=dtype)
    results = []
    for device in (torch.device("cpu"), cuda):
        moved = [t.detach().to(device).requires_grad_() for t in inputs]
        result = solve(stencil, *moved)
        results.append([t.cpu() for t in (result, *torch.autograd.grad(result, moved, cotangent.to(device)))])
    assert_agree(results[1], results[0], 1e-5 if dtype == torch.float32 else 1e-12)
