import json
import os
import stat

import pytest

from difflpv.io.atomic import atomic_path, write_bytes, write_json, write_text


def test_writes_and_replaces(tmp_path):
    write_text(tmp_path / "a.txt", "é")
    assert (tmp_path / "a.txt").read_bytes() == "é".encode()
    write_bytes(tmp_path / "a.txt", b"new")
    assert (tmp_path / "a.txt").read_bytes() == b"new"
    write_json(tmp_path / "a.json", {"x": [1, 2.5, None]})
    assert json.loads((tmp_path / "a.json").read_text()) == {"x": [1, 2.5, None]}
    assert sorted(os.listdir(tmp_path)) == ["a.json", "a.txt"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_failed_write_leaves_the_old_file(tmp_path, error):
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(error), atomic_path(tmp_path / "a.txt") as temporary:
        temporary.write_text("half")
        assert temporary.suffix == ".txt" and temporary.parent == tmp_path
        assert (tmp_path / "a.txt").read_text() == "old"
        raise error
    assert (tmp_path / "a.txt").read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_ordinary_permissions(tmp_path):
    write_text(tmp_path / "a.txt", "x")
    (tmp_path / "b.txt").write_text("x")
    modes = {stat.S_IMODE(os.stat(tmp_path / name).st_mode) for name in ("a.txt", "b.txt")}
    assert len(modes) == 1


def test_errors(tmp_path):
    with pytest.raises(FileNotFoundError, match="folder '.*none' does not exist"):
        write_text(tmp_path / "none" / "a.txt", "x")
    with pytest.raises(ValueError, match=r"a\.json: not valid JSON"):
        write_json(tmp_path / "a.json", float("nan"))
    with pytest.raises(TypeError):
        write_json(tmp_path / "a.json", object())
    assert not os.listdir(tmp_path)
