import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from difflpv.grid import Grid


def test_layout():
    grid = Grid.from_bounds((0, -1, 2), (4, 1, 3), (8, 4, 2))
    assert (grid.cell_size, grid.resolution, grid.shape, grid.cell_count) == (0.5, (8, 4, 2), (2, 4, 8), 64)
    assert (grid.minimum, grid.maximum) == ((0.0, -1.0, 2.0), (4.0, 1.0, 3.0))
    centers = grid.cell_centers()
    assert centers.shape == (2, 4, 8, 3)
    np.testing.assert_allclose(centers[0, 0, 0], [0.25, -0.75, 2.25])
    np.testing.assert_allclose(centers[1, 2, 5], [2.75, 0.25, 2.75])  # z, y, x


def test_contains_is_half_open():
    grid = Grid((0, 0, 0), 1.0, (2, 3, 4))
    points = np.array([[0, 0, 0], [1.99, 2.99, 3.99], [2, 1, 1], [-1e-9, 1, 1], [np.nan, 1, 1]])
    np.testing.assert_array_equal(grid.contains(points), [True, True, False, False, False])
    assert grid.contains(grid.cell_centers()).all()


@settings(deadline=None)
@given(
    st.tuples(*[st.floats(-100, 100)] * 3), st.tuples(*[st.floats(0, 50)] * 3), st.integers(3, 64)
)
def test_around_keeps_a_margin(low, extent, cells):
    high = np.add(low, extent)
    if not (high - np.array(low)).max() > 1e-3:
        return
    grid = Grid.around(low, high, cells)
    assert grid.resolution == (cells,) * 3
    tolerance = 1e-9 * (100 + grid.cell_size)
    assert (np.array(grid.minimum) <= np.array(low) - grid.cell_size + tolerance).all()
    assert (np.array(grid.maximum) >= high + grid.cell_size - tolerance).all()


def test_with_cells():
    grid = Grid.from_bounds((0, 0, 0), (4, 2, 1), (32, 16, 8))
    assert grid.with_cells(16) == Grid.from_bounds((0, 0, 0), (4, 2, 1), (16, 8, 4))
    assert grid.with_cells(32) == grid
    grown = grid.with_cells(6)  # cells of 2/3 m: 2 m take exactly 3, 1 m takes 1.5
    assert (grown.resolution, grown.cell_size) == ((6, 3, 2), pytest.approx(2 / 3))
    assert grown.minimum == grid.minimum
    assert (np.array(grown.maximum) >= np.array(grid.maximum) - 1e-9).all()


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda: Grid((0, 0), 1.0, (2, 2, 2)), "grid minimum: expected three finite numbers"),
        (lambda: Grid((0, 0, np.nan), 1.0, (2, 2, 2)), "grid minimum"),
        (lambda: Grid((0, 0, 0), 0.0, (2, 2, 2)), "grid cell_size: expected a positive length, got 0.0"),
        (lambda: Grid((0, 0, 0), 1.0, (2, 0, 2)), "grid resolution: expected three positive integers"),
        (lambda: Grid((0, 0, 0), 1.0, (2**11, 2**10, 2**10)), "grid resolution: expected at most 2147483647 cells in all, got"),
        (lambda: Grid.from_bounds((0, 0, 0), (1, 2, 1), 4), "expected cubic cells, got"),
        (lambda: Grid.from_bounds((0, 0, 0), (1, -1, 1), 4), "expected cubic cells"),
        (lambda: Grid.from_bounds((0, 0, 0), (1, 1, 1), 0), "grid resolution: expected positive integers, got 0"),
        (lambda: Grid.from_bounds((0, 0, 0), (1, 1, 1), 2.5), "grid resolution: expected positive integers, got 2.5"),
        (lambda: Grid.around((0, 0, 0), (1, 1, 1), 2), "grid cells: expected at least 3, got 2"),
        (lambda: Grid.around((0, 0, 0), (0, 0, 0), 8), "expected a box with an extent"),
        (lambda: Grid((0, 0, 0), 1.0, (2, 2, 2)).with_cells(0), "grid cells: expected at least 1, got 0"),
    ],
)
def test_errors(call, expected):
    with pytest.raises(ValueError, match=expected):
        call()
