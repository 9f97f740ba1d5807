import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from difflpv.sh import sh_basis
from difflpv.stencil import LinearStencil, holpv_stencil, lpv_stencil
from difflpv.symmetry import (
    asymmetry,
    cube_symmetries,
    equivariant_basis,
    neighborhood_offsets,
    project_equivariant,
    sh_representation,
)

COUNTS = {(1, 6): 7, (2, 6): 19, (1, 26): 18, (2, 26): 62, (3, 26): 172}


def test_group_has_48_orthogonal_members_and_is_closed():
    group = cube_symmetries()
    assert group.shape == (48, 3, 3) and (group[0] == np.eye(3)).all()
    known = {g.tobytes() for g in group}
    assert len(known) == 48
    assert all((a @ b).tobytes() in known for a in group[::5] for b in group[::7])


@pytest.mark.parametrize("l_max", [0, 1, 2, 3])
def test_representation_moves_the_basis_and_multiplies_like_the_group(l_max):
    group, rep = cube_symmetries(), sh_representation(l_max)
    w = np.random.default_rng(0).normal(size=(50, 3))
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    for symmetry, matrix in zip(group, rep, strict=True):
        np.testing.assert_allclose(sh_basis(w @ symmetry.T, l_max), sh_basis(w, l_max) @ matrix.T, atol=1e-13)
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(len(matrix)), atol=1e-13)
    products = {g.tobytes(): m for g, m in zip(group, rep, strict=True)}
    for a, b in ((3, 17), (30, 44), (9, 9)):
        np.testing.assert_allclose(products[(group[a] @ group[b]).tobytes()], rep[a] @ rep[b], atol=1e-13)


@pytest.mark.parametrize("rung", COUNTS)
def test_number_of_free_stencils(rung):
    assert len(equivariant_basis(*rung)) == COUNTS[rung]


@pytest.mark.parametrize("rung", COUNTS)
def test_count_agrees_with_the_characters(rung):
    # Independent of the construction: the dimension of the invariants is the mean trace of the group's action.
    l_max, neighbors = rung
    offsets = neighborhood_offsets(neighbors)
    group = zip(cube_symmetries(), sh_representation(l_max), strict=True)
    traces = [np.trace(m) ** 2 * (offsets @ g.T == offsets).all(1).sum() for g, m in group]
    assert np.mean(traces) == pytest.approx(COUNTS[rung], abs=1e-9)


@pytest.mark.parametrize("rung", COUNTS)
def test_basis_is_orthonormal_and_equivariant(rung):
    l_max, neighbors = rung
    basis, offsets, rep = equivariant_basis(*rung), neighborhood_offsets(neighbors), sh_representation(l_max)
    flat = basis.reshape(len(basis), -1)
    np.testing.assert_allclose(flat @ flat.T, np.eye(len(flat)), atol=1e-12)
    rows = {tuple(n): i for i, n in enumerate(offsets.tolist())}
    for r in (1, 13, 29, 47):
        image = [rows[tuple(n)] for n in (offsets @ cube_symmetries()[r].T).tolist()]
        np.testing.assert_allclose(basis[:, image], rep[r] @ basis @ rep[r].T, atol=1e-12)


@pytest.mark.parametrize("l_max", [1, 2, 3])
def test_published_kernels_lie_in_the_span(l_max):
    for stencil, neighbors in ((lpv_stencil(l_max=l_max), 6), (holpv_stencil(l_max=l_max), 26)):
        linear = stencil.linear_part
        assert asymmetry(linear) < 1e-14
        rebuilt = np.tensordot(project_equivariant(linear, neighbors=neighbors), equivariant_basis(l_max, neighbors), 1)
        np.testing.assert_allclose(rebuilt.sum(0), linear.uniform_gain(), atol=1e-13)
        assert np.linalg.norm(rebuilt) == pytest.approx(np.linalg.norm(linear.matrices), rel=1e-13)


def test_a_stencil_that_prefers_an_axis_is_found():
    matrices = np.array(holpv_stencil().linear_part.matrices)
    matrices[3] *= 1.5
    assert asymmetry(LinearStencil("skewed", holpv_stencil().linear_part.offsets, matrices)) > 0.01


@given(st.integers(0, 2**31))
@settings(max_examples=20, deadline=None)
def test_projection_is_idempotent_and_finds_the_nearest(seed):
    rng = np.random.default_rng(seed)
    offsets, basis = np.array(neighborhood_offsets(6)), equivariant_basis(1, 6)
    raw = rng.normal(size=(7, 4, 4))
    theta = project_equivariant(LinearStencil("raw", offsets, raw), neighbors=6)
    nearest = np.tensordot(theta, basis, 1)
    np.testing.assert_allclose(project_equivariant(LinearStencil("near", offsets, nearest), neighbors=6), theta, atol=1e-12)
    assert abs(((raw - nearest) * basis).sum((1, 2, 3))).max() < 1e-12


def test_errors_name_what_was_expected():
    with pytest.raises(ValueError, match="neighbors: expected 6 or 26, got 18"):
        neighborhood_offsets(18)
    with pytest.raises(ValueError, match="outside 6 neighbours"):
        project_equivariant(holpv_stencil().linear_part, neighbors=6)


def test_cached_arrays_can_not_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        equivariant_basis(1, 6)[0, 0, 0, 0] = 1.0
