import io
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scene_files import FUZZ

from difflpv.io.tables import ReceiverTable, TableError, load_receivers, load_table, save_receivers, save_table

POSITION = np.arange(12.0).reshape(4, 3)
NORMAL = np.array([[0, 1, 0], [0, 0, 1], [0.6, 0.8, 0], [-1, 0, 0.0]])


def test_round_trip(tmp_path):
    table = ReceiverTable(POSITION, NORMAL, np.array([1, 2, 0, 4.0]), np.full((4, 3), 0.5), {"irr_full": POSITION})
    save_receivers(tmp_path / "r.npz", table)
    again = load_receivers(tmp_path / "r.npz")
    assert len(again) == 4 and again.arrays().keys() == table.arrays().keys()
    for name, array in table.arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], array)


def test_defaults_and_float32(tmp_path):
    arrays = {"position": POSITION.astype(np.float32), "normal": NORMAL.astype(np.float32), "mesh_id": np.arange(4)}
    save_table(tmp_path / "r.npz", **arrays)
    table = load_receivers(tmp_path / "r.npz")
    np.testing.assert_array_equal(table.area_weight, np.ones(4))
    assert table.albedo is None and set(table.extras) == {"mesh_id"}
    assert table.position.dtype == np.float64 and table.extras["mesh_id"].dtype == np.int64


def test_same_arrays_give_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        save_table(tmp_path / f"{name}.npz", position=POSITION, text=np.array("cornell"))
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert str(load_table(tmp_path / "a.npz")["text"]) == "cornell"


RECEIVERS = {"position": POSITION, "normal": NORMAL}
ERRORS = {
    "missing": ({"position": POSITION}, "array 'normal' is missing, the file has position"),
    "shape": (RECEIVERS | {"normal": NORMAL[:3]}, "normal: expected shape [4, 3], got [3, 3]"),
    "columns": (RECEIVERS | {"position": POSITION[:, :2]}, "position: expected shape [n, 3], got [4, 2]"),
    "unit": (RECEIVERS | {"normal": NORMAL * [[1], [2], [1], [1]]}, "normal: expected unit length, row 1 has length 2"),
    "none": ({"position": np.zeros((0, 3)), "normal": np.zeros((0, 3))}, "position: expected at least one receiver"),
    "weight": (RECEIVERS | {"area_weight": [1, -1, 1, 1]}, "area_weight: expected weights >= 0"),
    "zero": (RECEIVERS | {"area_weight": [0, 0, 0, 0]}, "area_weight: expected weights >= 0 with at least one above 0"),
    "albedo": (RECEIVERS | {"albedo": np.full((4, 3), 1.5)}, "albedo: must lie in [0, 1], row 0 is [1.5, 1.5, 1.5]"),
    "dtype": (RECEIVERS | {"position": np.full((4, 3), "x")}, "position: expected real numbers"),
    "complex": (RECEIVERS | {"position": POSITION + 0j}, "position: expected real numbers"),
}


@pytest.mark.parametrize("case", sorted(ERRORS))
def test_errors(tmp_path, case):
    arrays, expected = ERRORS[case]
    save_table(tmp_path / "r.npz", **arrays)
    with pytest.raises(TableError) as info:
        load_receivers(tmp_path / "r.npz")
    assert str(info.value).startswith(f"{tmp_path / 'r.npz'}: ") and expected in str(info.value)


def test_not_finite(tmp_path):
    bad = POSITION.copy()
    bad[2, 1] = np.inf
    with pytest.raises(TableError, match="array 'position' holds 1 values that are not finite"):
        save_table(tmp_path / "r.npz", position=bad)
    assert not list(tmp_path.iterdir())
    np.savez(tmp_path / "r.npz", position=bad, normal=NORMAL)
    with pytest.raises(TableError, match="position: row 2 is not finite"):
        load_receivers(tmp_path / "r.npz")


def test_objects_names_and_foreign_files(tmp_path):
    with pytest.raises(TableError, match="array 'a' holds Python objects"):
        save_table(tmp_path / "r.npz", a=np.array([{}], object))
    with pytest.raises(TableError, match=r"ending in \.npz"):
        save_table(tmp_path / "r.txt", a=POSITION)
    with pytest.raises(TableError, match="no such file"):
        load_table(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(TableError, match=r"not a readable \.npz table"):
        load_table(tmp_path / "text.npz")
    np.savez(tmp_path / "o.npz", a=np.array([{}], object))
    with pytest.raises(TableError, match="'a' holds Python objects"):
        load_table(tmp_path / "o.npz")


def test_a_header_that_claims_more_than_it_holds(tmp_path):
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(out, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 3)})
    with zipfile.ZipFile(tmp_path / "r.npz", "w") as archive:
        archive.writestr("position.npy", out.getvalue())
    with pytest.raises(TableError, match="'position' is damaged"):
        load_table(tmp_path / "r.npz")


@settings(max_examples=200, **FUZZ)
@given(st.lists(st.tuples(st.integers(0, 10**4), st.integers(0, 255)), min_size=1, max_size=5))
def test_damaged_bytes(tmp_path, changes):
    path = tmp_path / "r.npz"
    out = io.BytesIO()
    np.savez_compressed(out, **RECEIVERS)
    content = bytearray(out.getvalue())
    for position, value in changes:
        content[position % len(content)] = value
    path.write_bytes(content)
    try:
        load_receivers(path)
    except TableError as error:
        assert "\n" not in str(error) and "r.npz" in str(error)
