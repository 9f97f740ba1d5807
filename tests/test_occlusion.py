import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from difflpv import occlusion
from difflpv.grid import Grid
from difflpv.occlusion import Blockers, attenuate, blocking_potential, geometry_volume, transmittance
from difflpv.reference import occlusion as twin

GRID = Grid((-1.0, 0.5, 2.0), 0.3, (5, 4, 6))
MODELS = ("clamp", "exp")
OFFSETS = np.array([d for d in itertools.product((-1, 0, 1), repeat=3) if any(d)])
DIRECTIONS = OFFSETS / np.linalg.norm(OFFSETS, axis=1, keepdims=True)


def random_blockers(generator, dtype, count=200, *, margin=1.0):
    """Surfels in the grid's box grown by ``margin`` cells on every side."""
    size = torch.tensor(GRID.resolution, dtype=dtype) + 2 * margin
    low = torch.tensor(GRID.minimum, dtype=dtype) - margin * GRID.cell_size
    position = low + torch.rand(count, 3, generator=generator, dtype=dtype) * size * GRID.cell_size
    normal = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=dtype), dim=1)
    return Blockers(position, normal, 0.2 * GRID.cell_size**2 * torch.rand(count, generator=generator, dtype=dtype))


def wall(l_max, *, two_sided, plane=2):
    """Geometry volume of a full wall across x: one surfel of area h^2 per corner of the lattice, normal +x, 4^3 cells."""
    grid = Grid((0.0, 0.0, 0.0), 0.5, (4, 4, 4))
    index = torch.cartesian_prod(torch.tensor([plane]), torch.arange(5), torch.arange(5)).double()
    normal = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64).expand(25, 3)
    blockers = Blockers(index * 0.5, normal, torch.full((25,), 0.25, dtype=torch.float64))
    return geometry_volume(blockers, grid, l_max=l_max, two_sided=two_sided)


@pytest.mark.parametrize("two_sided", [True, False])
@pytest.mark.parametrize("l_max", [1, 2, 3])
def test_geometry_volume_equals_twin(generator, dtype, relative_tolerance, l_max, two_sided):
    blockers = random_blockers(generator, dtype)
    fields = (blockers.position, blockers.normal, blockers.area)
    result = geometry_volume(blockers, GRID, l_max=l_max, two_sided=two_sided)
    expected = twin.geometry_volume(*fields, GRID.minimum, GRID.cell_size, GRID.resolution, l_max=l_max, two_sided=two_sided)
    assert result.shape == ((l_max + 1) ** 2, 7, 5, 6)
    torch.testing.assert_close(result, expected, rtol=0, atol=relative_tolerance(dtype) * float(expected.abs().max()))


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("l_max", [1, 2, 3])
def test_transmittance_equals_twin(generator, dtype, relative_tolerance, l_max, model):
    blocking = geometry_volume(random_blockers(generator, dtype), GRID, l_max=l_max)
    result = transmittance(blocking, OFFSETS, DIRECTIONS, model=model, strength=1.3)
    directions = torch.from_numpy(DIRECTIONS).to(dtype)
    expected = twin.transmittance(blocking, OFFSETS.tolist(), directions, model=model, strength=1.3)
    assert result.shape == (26, *GRID.shape)
    assert 0.05 < float((expected < 1).double().mean()), "nothing is blocked: the case checks nothing"
    torch.testing.assert_close(result, expected, rtol=0, atol=relative_tolerance(dtype))


@pytest.mark.parametrize("model", MODELS)
def test_gradients_equal_twin(generator, model):
    blocking = (0.1 * torch.randn(9, 4, 3, 5, generator=generator, dtype=torch.float64)).requires_grad_()
    strength = torch.tensor(1.4, dtype=torch.float64, requires_grad=True)
    ours = transmittance(blocking, OFFSETS, DIRECTIONS, model=model, strength=strength)
    theirs = twin.transmittance(blocking, OFFSETS.tolist(), torch.from_numpy(DIRECTIONS), model=model, strength=strength)
    cotangent = torch.randn(ours.shape, generator=generator, dtype=torch.float64)
    for a, b in zip(
        torch.autograd.grad(ours, (blocking, strength), cotangent),
        torch.autograd.grad(theirs, (blocking, strength), cotangent),
        strict=True,
    ):
        assert float(a.abs().max()) > 0
        torch.testing.assert_close(a, b, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize(
    ("l_max", "two_sided", "facing", "behind"),
    [(1, False, 3 / 4, -1 / 4), (2, False, 17 / 16, 1 / 16), (3, False, 17 / 16, 1 / 16)]
    + [(1, True, 1 / 2, 1 / 2), (2, True, 9 / 8, 9 / 8), (3, True, 9 / 8, 9 / 8)],
)
def test_full_wall_at_normal_incidence(l_max, two_sided, facing, behind):
    # B(n.v = c) = sum_l A_l (2l+1)/4pi P_l(c) = 1/4 + c/2 + 5/16 P_2(c); two-sided doubles the even degrees.
    blocking = wall(l_max, two_sided=two_sided)
    offsets = [[-1, 0, 0], [1, 0, 0]]  # light that travels along -x meets the wall's front
    potential = blocking_potential(blocking, np.array(offsets), np.array(offsets, float))
    assert potential[0, :, :, 2].numpy() == pytest.approx(facing, rel=1e-12)
    assert potential[1, :, :, 1].numpy() == pytest.approx(behind, rel=1e-12)
    potential[0, :, :, 2] = potential[1, :, :, 1] = 0
    assert not potential.any(), "only the cells at the wall are blocked"


def test_full_wall_at_oblique_incidence():
    # Edge neighbours meet the wall at cos^2 = 1/2, corner neighbours at 1/3, whatever number of corners is averaged.
    blocking = wall(2, two_sided=True)
    across = OFFSETS[:, 0] == 1
    potential = blocking_potential(blocking, OFFSETS[across], DIRECTIONS[across])[:, :, :, 1]
    cos2 = DIRECTIONS[across, 0] ** 2
    expected = 2 * (1 / 4 + 5 / 16 * (3 * cos2 - 1) / 2)
    assert sorted(set(expected.round(6))) == [0.5, 0.65625, 1.125]
    torch.testing.assert_close(potential, torch.from_numpy(expected)[:, None, None].expand(-1, 4, 4), rtol=1e-12, atol=0)
    # Twice the published strength closes a wall for all 26 neighbours.
    closed = transmittance(blocking, OFFSETS[across], DIRECTIONS[across], strength=2.0)[:, :, :, 1]
    assert float(closed.max()) < 1e-12


@pytest.mark.parametrize("model", MODELS)
def test_empty_geometry_volume_blocks_nothing(dtype, model):
    nothing = torch.zeros(0, 3, dtype=dtype)
    blocking = geometry_volume(Blockers(nothing, nothing, nothing[:, 0]), GRID, l_max=2)
    assert torch.equal(transmittance(blocking, OFFSETS, DIRECTIONS, model=model), torch.ones(26, *GRID.shape, dtype=dtype))


def test_both_directions_of_a_pair_see_the_same_wall(generator):
    # A two-sided potential is even: light from s to d is blocked as light from d to s.
    blocking = geometry_volume(random_blockers(generator, torch.float64), GRID, l_max=2)
    forth, back = transmittance(blocking, np.array([[1, 0, 0], [-1, 0, 0]]), np.array([[1.0, 0, 0], [-1, 0, 0]]))
    torch.testing.assert_close(forth[:, :, :-1], back[:, :, 1:], rtol=1e-12, atol=1e-12)


def test_area_is_conserved(generator, dtype):
    blockers = random_blockers(generator, dtype, margin=0.4)  # within half a cell of the grid: all have a corner
    result = geometry_volume(blockers, GRID, l_max=2)
    total = 2 * math.sqrt(math.pi) / 2 * blockers.area.sum() / GRID.cell_size**2  # two lobes of A_0 Y_00 = sqrt(pi)/2
    torch.testing.assert_close(result[0].sum(), total, rtol=1e-5, atol=0)


def test_surfels_without_a_corner_are_ignored():
    grid = Grid((0.0, 0.0, 0.0), 1.0, (2, 2, 2))
    position = torch.tensor([[-0.4, 0.0, 2.4], [-0.6, 0.0, 0.0], [0.0, 2.6, 0.0]])
    normal = torch.tensor([[0.0, 0.0, 1.0]]).expand(3, 3)
    result = geometry_volume(Blockers(position, normal, torch.ones(3)), grid, l_max=1)
    assert result[0].nonzero().tolist() == [[2, 0, 0]]


@settings(max_examples=30, deadline=None)
@given(
    blocking=hnp.arrays("float64", (9, 3, 2, 3), elements=st.floats(-4, 4)),
    strength=st.floats(0, 10),
    model=st.sampled_from(MODELS),
)
def test_transmittance_lies_between_0_and_1(blocking, strength, model):
    result = transmittance(torch.from_numpy(blocking), OFFSETS, DIRECTIONS, model=model, strength=strength)
    assert torch.isfinite(result).all()
    assert float(result.min()) >= 0
    assert float(result.max()) <= 1


def test_strength_zero_blocks_nothing_and_more_blocks_more(generator):
    blocking = geometry_volume(random_blockers(generator, torch.float64), GRID, l_max=2)
    for model in MODELS:
        stronger = [transmittance(blocking, OFFSETS, DIRECTIONS, model=model, strength=s) for s in (0.0, 0.5, 1, 2)]
        assert torch.equal(stronger[0], torch.ones_like(stronger[0]))
        assert all((a >= b).all() for a, b in itertools.pairwise(stronger))


def test_many_faces_may_share_an_offset(generator):
    # The 30-face stencil: one neighbour, five directions.
    blocking = torch.rand(9, 3, 3, 3, generator=generator, dtype=torch.float64)
    offsets, directions = np.array([[1, 0, 0]] * 26), DIRECTIONS
    result = transmittance(blocking, offsets, directions, model="exp")
    expected = twin.transmittance(blocking, offsets.tolist(), torch.from_numpy(directions), model="exp")
    torch.testing.assert_close(result, expected, rtol=1e-12, atol=1e-12)


def test_offsets_and_directions_may_be_tensors(generator):
    blocking = torch.rand(4, 3, 3, 3, generator=generator)
    as_arrays = blocking_potential(blocking, OFFSETS, DIRECTIONS)
    as_tensors = blocking_potential(blocking, torch.from_numpy(OFFSETS), torch.from_numpy(DIRECTIONS))
    assert torch.equal(as_arrays, as_tensors)


def test_non_contiguous_input(generator, dtype):
    blocking = torch.rand(9, 4, 3, 5, generator=generator, dtype=dtype)
    strided = blocking.permute(3, 2, 1, 0).contiguous().permute(3, 2, 1, 0)
    assert not strided.is_contiguous()
    torch.testing.assert_close(
        transmittance(strided, OFFSETS, DIRECTIONS), transmittance(blocking, OFFSETS, DIRECTIONS), rtol=1e-5, atol=1e-6
    )


def test_no_faces():
    nothing = transmittance(torch.zeros(4, 3, 3, 3), np.zeros((0, 3), int), np.zeros((0, 3)))
    assert nothing.shape == (0, 2, 2, 2)


@pytest.mark.parametrize("model", MODELS)
def test_promises_of_transmittance(generator, check_op, model):
    blocking = 0.1 * torch.randn(9, 3, 2, 3, generator=generator, dtype=torch.float64)
    chosen = [0, 4, 9, 13]

    def passed(blocking):
        return transmittance(blocking, OFFSETS[chosen], DIRECTIONS[chosen], model=model, strength=1.2)

    check_op(passed, [blocking])
    strength = torch.tensor(1.2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s: transmittance(blocking, OFFSETS, DIRECTIONS, model=model, strength=s), [strength])


def test_promises_of_the_geometry_volume(generator, check_op):
    blockers = random_blockers(generator, torch.float64, count=5, margin=0.0)
    check_op(
        lambda normal, area: geometry_volume(Blockers(blockers.position, normal, area.abs()), GRID, l_max=2),
        [blockers.normal, blockers.area],
    )


def test_opcheck(generator, dtype):
    offsets = torch.from_numpy(OFFSETS[:5]).to(torch.int32)
    corners = torch.rand(5, 3, 4, 2, generator=generator, dtype=dtype, requires_grad=True)
    torch.library.opcheck(occlusion._corner_mean, (corners, offsets))
    torch.library.opcheck(occlusion._corner_mean_adjoint, (torch.rand(5, 2, 3, 1, dtype=dtype), offsets))


@pytest.mark.gpu
def test_cuda_equals_cpu(cuda, generator, dtype, relative_tolerance):
    blockers = random_blockers(generator, dtype, count=1000)
    results = []
    for device in (torch.device("cpu"), cuda):
        fields = [t.to(device).requires_grad_() for t in (blockers.position, blockers.normal, blockers.area)]
        passed = transmittance(geometry_volume(Blockers(*fields), GRID, l_max=2), OFFSETS, DIRECTIONS, model="exp")
        gradients = torch.autograd.grad(passed.square().sum(), fields[1:])
        results.append([t.detach().cpu() for t in (passed, *gradients)])
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=10 * relative_tolerance(dtype) * float(a.abs().max()))


X, A = torch.zeros(2, 3), torch.ones(2)
NAN = torch.tensor([[0.0, 0, 0], [math.nan, 0, 0]])
SURFELS = Blockers(X, X, A)
B = torch.zeros(9, 3, 3, 3)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: Blockers(X[:, :2], X, A), ValueError, r"position: expected shape \[2, 3\], got \[2, 2\]"),
        (lambda: Blockers(X, X[:1], A), ValueError, r"normal: expected shape \[2, 3\], got \[1, 3\]"),
        (lambda: Blockers(X, X, A[:1]), ValueError, r"area: expected shape \[2\], got \[1\]"),
        (lambda: Blockers(X, X, A.double()), TypeError, "area: expected torch.float32 on cpu, got torch.float64 on cpu"),
        (lambda: geometry_volume(X, GRID, l_max=2), TypeError, "blockers: expected difflpv.*Blockers, got Tensor"),
        (lambda: geometry_volume(SURFELS, 8, l_max=2), TypeError, "grid: expected difflpv.grid.Grid, got int"),
        (lambda: geometry_volume(SURFELS, GRID, l_max=7), ValueError, r"l_max: expected an integer in 0\.\.3, got 7"),
        (lambda: geometry_volume(Blockers(NAN, X, A), GRID, l_max=2), ValueError, "blockers.position: expected finite"),
        (lambda: geometry_volume(Blockers(X, X, -A), GRID, l_max=2), ValueError, "blockers.area: expected areas >= 0"),
        (lambda: transmittance(B[:5], OFFSETS, DIRECTIONS), ValueError, r"blocking: expected shape .* got \[5, 3, 3, 3\]"),
        (lambda: transmittance(B + math.nan, OFFSETS, DIRECTIONS), ValueError, "blocking: expected finite numbers"),
        (lambda: transmittance(B, OFFSETS * 2, DIRECTIONS), ValueError, "offsets: expected entries -1, 0 or 1, got 2"),
        (lambda: transmittance(B, OFFSETS * 1.0, DIRECTIONS), TypeError, "offsets: expected integers, got torch.float64"),
        (lambda: transmittance(B, OFFSETS[0], DIRECTIONS), ValueError, r"offsets: expected shape \[F, 3\], got \[3\]"),
        (lambda: transmittance(B, OFFSETS, DIRECTIONS[:3]), ValueError, r"directions: expected shape \[26, 3\], got"),
        (lambda: transmittance(B, OFFSETS, DIRECTIONS * 2), ValueError, "directions: expected unit vectors, got .* row 0"),
        (
            lambda: transmittance(B, OFFSETS, DIRECTIONS, model="soft"),
            ValueError,
            "model: expected 'clamp' or 'exp', got 'soft'",
        ),
        (lambda: attenuate(B, strength=-1), ValueError, "strength: expected a finite number >= 0, got -1"),
        (lambda: attenuate(B, strength=torch.tensor(math.nan)), ValueError, "strength: expected a finite number >= 0"),
        (lambda: attenuate([1.0]), TypeError, "potential: expected a torch.Tensor, got list"),
    ],
)
def test_errors(call, error, message):
    with pytest.raises(error, match=message):
        call()
