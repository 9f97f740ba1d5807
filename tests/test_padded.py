"""Padded buffers: what ends one row begins the next, and yet no cell is another's neighbour across an edge of the grid."""

import itertools

import torch
from hypothesis import given
from hypothesis import strategies as st

from difflpv.padded import Layout

layouts = st.builds(
    Layout, channels=st.integers(1, 3), coeffs=st.sampled_from([1, 4]), z=st.integers(1, 5), y=st.integers(1, 5),
    x=st.integers(1, 19), lanes=st.sampled_from([1, 8, 16]),
)  # fmt: skip


@given(layouts)
def test_neighbours_are_those_of_the_grid_and_zero_outside(layout):
    volume = 1 + torch.arange(layout.fields * layout.z * layout.y * layout.x, dtype=torch.float64)
    volume = volume.reshape(layout.channels, layout.coeffs, layout.z, layout.y, layout.x)
    buffer = layout.pad(volume)
    assert torch.equal(layout.unpad(buffer), volume)
    zero_around = torch.nn.functional.pad(volume.flatten(0, 1), (1, 1, 1, 1, 1, 1))
    for dx, dy, dz in itertools.product((-1, 0, 1), repeat=3):
        z, y, x = 1 + dz, 1 + dy, 1 + dx
        there = zero_around[:, z : z + layout.z, y : y + layout.y, x : x + layout.x]
        assert torch.equal(layout.inside(buffer, layout.fields, (dx, dy, dz)), there)


@given(layouts)
def test_clearing_the_border_spares_the_cells(layout):
    buffer = torch.full((layout.length(layout.fields),), float("nan"), dtype=torch.float64)
    layout.clear_border(buffer, layout.fields)
    layout.inside(buffer, layout.fields).fill_(1)
    layout.clear_border(buffer, layout.fields)
    assert bool((layout.inside(buffer, layout.fields) == 1).all())
    rows = layout.view(buffer, layout.fields)[..., : layout.pitch]
    assert not rows[[0, -1]].any() and not rows[:, [0, -1]].any() and not buffer[-layout.lanes :].any()
