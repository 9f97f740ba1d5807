import numpy as np
import pytest
import torch

from difflpv.grid import Grid
from difflpv.probes.lattice import LatticeField, fill_from_neighbours
from difflpv.probes.probe_set import DIRECTIONS_26, ProbeSet, irradiance_of
from difflpv.probes.rows import Rows
from difflpv.sh import sh_basis

GRID = Grid((0.0, -1.0, 2.0), 0.5, (6, 5, 4))


def test_irradiance_of_uniform_radiance_is_pi_times_it() -> None:
    radiance = np.zeros((1, 9, 3))
    radiance[0, 0] = 2 * np.sqrt(4 * np.pi)  # L = 2 everywhere
    np.testing.assert_allclose(ProbeSet(np.zeros((1, 3)), radiance).irradiance(DIRECTIONS_26), 2 * np.pi)


def test_irradiance_of_a_directional_light_is_largest_toward_it() -> None:
    toward = np.array([0.6, 0.0, 0.8])
    radiance = torch.as_tensor(sh_basis(toward[None], 2))[0][:, None]  # unit irradiance on a surface that faces the light
    facing = irradiance_of(radiance, np.stack([toward, -toward]))
    np.testing.assert_allclose(facing[:, 0], [17 / 16, 1 / 16], atol=1e-12)  # degree 2 of the clamped cosine, physics.md


def test_directions_are_26_unit_vectors_without_a_preferred_one() -> None:
    assert DIRECTIONS_26.shape == (26, 3)
    np.testing.assert_allclose(np.linalg.norm(DIRECTIONS_26, axis=1), 1)
    np.testing.assert_allclose(DIRECTIONS_26.sum(0), 0, atol=1e-12)


@pytest.mark.parametrize(
    ("position", "radiance", "valid", "message"),
    [
        (np.zeros((2, 2)), np.zeros((2, 9, 3)), None, r"probe position: expected shape \[n,3\], got \[2, 2\]"),
        (np.zeros((2, 3)), np.zeros((2, 4, 3)), None, r"probe radiance: expected shape \[2,9,3\], got \[2, 4, 3\]"),
        (np.full((1, 3), np.nan), np.zeros((1, 9, 3)), None, "probe position: expected finite"),
        (np.zeros((2, 3)), np.zeros((2, 9, 3)), np.ones(2), "probe valid: expected 2 booleans, got float64"),
    ],
)
def test_bad_probes_are_named(position: np.ndarray, radiance: np.ndarray, valid: np.ndarray | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ProbeSet(position, radiance, valid)


def test_invalid_probes_may_hold_anything_and_are_left_out() -> None:
    radiance = np.stack([np.full((9, 3), np.nan), np.ones((9, 3))])
    probes = ProbeSet(np.array([[0.0, 0, 0], [1, 1, 1]]), radiance, np.array([False, True]))
    assert probes.usable.position.tolist() == [[1, 1, 1]]


def test_rows_apply_as_their_dense_matrix() -> None:
    rows = Rows(torch.tensor([[0, 2], [1, 1]]), torch.tensor([[0.25, 0.75], [1.0, 0.0]], dtype=torch.float64))
    content = torch.arange(18, dtype=torch.float64).reshape(3, 2, 3)
    assert torch.equal(rows.apply(content), (rows.dense(3) @ content.reshape(3, 6)).reshape(2, 2, 3))


def test_lattice_reproduces_quadratics_and_its_own_values() -> None:
    centers = torch.as_tensor(GRID.cell_centers())

    def quadratic(x: torch.Tensor) -> torch.Tensor:
        return 1 + 2 * x[..., 0] - x[..., 1] * x[..., 2] + 0.5 * x[..., 0] ** 2

    field = LatticeField(GRID, quadratic(centers))
    torch.testing.assert_close(field(centers.reshape(-1, 3)).reshape(GRID.shape), field.values)
    inner = torch.tensor([[1.1, 0.2, 3.05], [1.6, 0.35, 2.95]], dtype=torch.float64)  # a cell off the border
    torch.testing.assert_close(field(inner), quadratic(inner))


def test_lattice_has_the_right_gradient_and_is_constant_outside() -> None:
    values = torch.as_tensor(np.random.default_rng(0).normal(size=(*GRID.shape, 2)))
    field = LatticeField(GRID, values)
    points = torch.tensor([[1.1, 0.2, 3.05], [0.3, -0.7, 2.3], [9.0, 9, 9]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(field, (points,))
    torch.testing.assert_close(field(points)[2].detach(), values[-1, -1, -1])
    flat = LatticeField(Grid((0.0, 0, 0), 1.0, (1, 1, 1)), torch.ones(1, 1, 1, dtype=torch.float64))
    assert flat(torch.zeros(1, 3, dtype=torch.float64)).item() == 1


def test_unknown_cells_take_their_nearest_known_neighbour() -> None:
    values = np.arange(4.0).reshape(1, 1, 4)
    known = np.array([True, False, False, True]).reshape(1, 1, 4)
    assert fill_from_neighbours(values, known).ravel().tolist() == [0, 0, 3, 3]
    with pytest.raises(ValueError, match="no cell lies in free space"):
        fill_from_neighbours(values, np.zeros_like(known))
