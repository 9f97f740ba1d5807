"""Probes on disk: every bit comes back, and files that are damaged, foreign or mixed up are refused in one line."""

from __future__ import annotations

import hashlib
import json
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from safetensors.numpy import load_file, save

from difflpv.probes.probe_files import CONVENTION, ProbeFileError, ProbeRecord, load_probes, save_probes
from difflpv.probes.probe_set import ProbeSet
from difflpv.probes.reader import ProbeReader
from difflpv.sh import sh_basis

NUMBERS = st.floats(-1e6, 1e6, width=64)


METRIC = np.random.default_rng(4).normal(size=(5, 3, 3))


def some_probes(count: int = 5) -> ProbeSet:
    rng = np.random.default_rng(3)
    return ProbeSet(rng.normal(size=(count, 3)), rng.normal(size=(count, 9, 3)), np.arange(count) != 1)


def saved(folder: Path) -> Path:
    footprints = ProbeReader("gaussian", METRIC, neighbours=3, sight=True)
    described = {"name": "box", "hash": "ab12"}
    record = ProbeRecord(some_probes(), described, "gradient", {"relative L2": 0.25}, {"seed": 7}, footprints)
    save_probes(folder / "probes", record)
    return folder / "probes"


@settings(max_examples=20, deadline=None)
@given(arrays(np.float64, (3, 3), elements=NUMBERS), arrays(np.float64, (3, 9, 3), elements=NUMBERS), arrays(bool, 3))
def test_every_bit_comes_back(position, radiance, valid) -> None:
    with tempfile.TemporaryDirectory() as folder:
        save_probes(folder, ProbeRecord(ProbeSet(position, radiance, valid)))
        back = load_probes(folder).probes
        assert back.position.tobytes() == position.tobytes() and back.radiance.tobytes() == radiance.tobytes()
        assert (back.valid == valid).all()


def test_record_comes_back_and_says_what_the_numbers_are(tmp_path) -> None:
    folder = saved(tmp_path)
    back = load_probes(folder)
    assert (back.scene, back.method) == ({"name": "box", "hash": "ab12"}, "gradient")
    assert (back.errors, back.provenance) == ({"relative L2": 0.25}, {"seed": 7})
    assert back.reader.metric is not None and back.reader.metric.tobytes() == METRIC.tobytes()
    assert (back.reader.interpolation, back.reader.neighbours, back.reader.sight) == ("gaussian", 3, True)
    np.testing.assert_array_equal(back.usable_reader.metric, METRIC[[0, 2, 3, 4]])  # without the invalid probe
    described = json.loads((folder / "probes.json").read_text())
    assert described["reader"] == {"interpolation": "gaussian", "neighbours": 3, "sight": True}
    assert described["convention"]["quantity"] == "radiance" and (described["count"], described["invalid"]) == (5, 1)
    assert sorted(p.name for p in folder.iterdir()) == ["probes.json", "probes.safetensors"]  # no temporary files


def test_files_of_before_are_read_by_tetrahedra(tmp_path) -> None:
    save_probes(tmp_path, ProbeRecord(some_probes()))
    assert sorted(load_file(tmp_path / "probes.safetensors")) == ["position", "radiance", "valid"]
    remove(tmp_path, "reader")
    reader = load_probes(tmp_path).reader
    assert (reader.interpolation, reader.metric, reader.sight) == ("tetrahedra", None, False)


def test_convention_describes_the_basis_of_the_project() -> None:
    # The words of the record, evaluated as a reader without this package would.
    direction = np.array([0.48, -0.6, 0.64])
    x, y, z = direction
    words = [word.replace("^", "**") for word in CONVENTION["polynomials"]]
    words = [{"xy": "x*y", "yz": "y*z", "3z**2-1": "3*z**2-1", "xz": "x*z"}.get(word, word) for word in words]
    values = np.array([eval(word, {"x": x, "y": y, "z": z}) for word in words])
    ratio = sh_basis(direction, 2) / values
    norms = np.sqrt([1, 3, 3, 3, 15, 15, 5 / 4, 15, 15 / 4]) / (2 * np.sqrt(np.pi))
    np.testing.assert_allclose(ratio, norms)


def test_content_of_an_invalid_probe_need_not_be_finite(tmp_path) -> None:
    radiance = np.ones((2, 9, 3))
    radiance[1] = np.nan
    save_probes(tmp_path, ProbeRecord(ProbeSet(np.zeros((2, 3)), radiance, np.array([True, False]))))
    assert np.isfinite(load_probes(tmp_path).probes.radiance).all()


def rewrite(folder: Path, **changes) -> None:
    described = json.loads((folder / "probes.json").read_text())
    (folder / "probes.json").write_text(json.dumps(described | changes))


def retensor(folder: Path, **tensors) -> None:
    merged = {**load_file(folder / "probes.safetensors"), **tensors}
    content = save({name: np.ascontiguousarray(tensor) for name, tensor in merged.items() if tensor is not None})
    (folder / "probes.safetensors").write_bytes(content)
    rewrite(folder, sha256=hashlib.sha256(content).hexdigest())


def reread(folder: Path, **changes) -> None:
    rewrite(folder, reader=json.loads((folder / "probes.json").read_text())["reader"] | changes)


def remove(folder: Path, name: str) -> None:
    described = json.loads((folder / "probes.json").read_text())
    del described[name]
    (folder / "probes.json").write_text(json.dumps(described))


DAMAGE = {
    "no folder": (lambda f: (f / "probes.json").unlink(), r"probes\.json: not found"),
    "no numbers": (lambda f: (f / "probes.safetensors").unlink(), r"probes\.safetensors: not found"),
    "not JSON": (lambda f: (f / "probes.json").write_text("{"), r"probes\.json: damaged"),
    "deep JSON": (lambda f: (f / "probes.json").write_text("[" * 10**5), r"probes\.json: damaged"),
    "not text": (lambda f: (f / "probes.json").write_bytes(b"\xff\xfe\x00"), r"probes\.json: damaged"),
    "foreign JSON": (lambda f: (f / "probes.json").write_text("[1]"), "another JSON file"),
    "later format": (lambda f: rewrite(f, format=2), "expected format 1, got 2"),
    "other axes": (
        lambda f: rewrite(f, convention=dict(CONVENTION) | {"axes": "left-handed, y up"}),
        "convention: expected axes 'right-handed, y up', got 'left-handed, y up'",
    ),
    "no convention": (lambda f: rewrite(f, convention=None), "convention: expected quantity 'radiance'"),
    "truncated": (lambda f: (f / "probes.safetensors").write_bytes(b"123"), "damaged, or not the file"),
    "no tensors": (
        lambda f: ((f / "probes.safetensors").write_bytes(b"123"), rewrite(f, sha256=hashlib.sha256(b"123").hexdigest())),
        r"probes\.safetensors: damaged",
    ),
    "wrong shape": (lambda f: retensor(f, radiance=np.zeros((5, 4, 3))), r"expected shape \[5,9,3\]"),
    "not finite": (lambda f: retensor(f, position=np.full((5, 3), np.inf)), "probe position: expected finite"),
    "no probes": (
        lambda f: retensor(f, position=np.zeros((0, 3)), radiance=np.zeros((0, 9, 3)), valid=np.zeros(0, np.uint8)),
        "expected at least one",
    ),
    "huge": (lambda f: (f / "probes.json").write_bytes(b" " * (2**24 + 1)), "at most 16777216 are read"),
    "footprints without metric": (lambda f: retensor(f, metric=None), "metric: expected one a probe with gaussian footprints"),
    "tetrahedra with metric": (lambda f: reread(f, interpolation="tetrahedra"), "metric: .* none with tetrahedra"),
    "unknown interpolation": (lambda f: reread(f, interpolation=["cubic"]), "expected tetrahedra or gaussian, got .'cubic'"),
    "metric of other probes": (lambda f: retensor(f, metric=METRIC[:4]), "expected metrics of 5 probes, got 4"),
    "metric not square": (lambda f: retensor(f, metric=METRIC[:, 0]), r"metric: expected shape .*, got \[5, 3\]"),
    "metric not finite": (lambda f: retensor(f, metric=METRIC * np.inf), "metric: expected finite numbers"),
    "no neighbours": (lambda f: reread(f, neighbours=0), "neighbours: expected a whole number > 0, got 0"),
    "part of a neighbour": (lambda f: reread(f, neighbours=2.5), "neighbours: expected a whole number > 0, got 2.5"),
    "unclear sight": (lambda f: reread(f, sight="yes"), "sight: expected True or False, got 'yes'"),
    "metric without reader": (lambda f: remove(f, "reader"), r"probes\.json: 'reader' is missing"),
    "reader in a list": (lambda f: rewrite(f, reader=["gaussian"]), "reader: expected a dictionary, got list"),
    "reader in part": (lambda f: rewrite(f, reader={"interpolation": "gaussian"}), "reader: neighbours, sight missing"),
    "errors missing": (lambda f: rewrite(f, errors=None), "probe errors: expected a dictionary, got NoneType"),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_damaged_and_foreign_files_are_refused_in_one_line(kind, tmp_path) -> None:
    damage, message = DAMAGE[kind]
    folder = saved(tmp_path)
    damage(folder)
    with pytest.raises(ProbeFileError, match=message) as caught:
        load_probes(folder)
    assert "\n" not in str(caught.value) and str(folder) in str(caught.value)


def test_pair_of_two_runs_is_refused(tmp_path) -> None:
    folder = saved(tmp_path)
    save_probes(tmp_path / "other", ProbeRecord(some_probes(3)))
    (tmp_path / "other" / "probes.safetensors").replace(folder / "probes.safetensors")
    with pytest.raises(ProbeFileError, match="checksum differs"):
        load_probes(folder)


def test_what_json_cannot_hold_leaves_the_old_files(tmp_path) -> None:
    folder = saved(tmp_path)
    with pytest.raises(ValueError):
        save_probes(folder, ProbeRecord(some_probes(2), errors={"relative L2": float("nan")}))
    assert len(load_probes(folder).probes) == 5


def test_records_check_themselves() -> None:
    with pytest.raises(ValueError, match="expected at least one, got none"):
        ProbeRecord(some_probes(0))
    with pytest.raises(ValueError, match="probe scene: expected name and hash, got name"):
        ProbeRecord(some_probes(), {"name": "box"})
    with pytest.raises(TypeError, match="probe reader: expected a ProbeReader, got str"):
        ProbeRecord(some_probes(), reader="gaussian")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="probe method: expected text, got int"):
        ProbeRecord(some_probes(), method=3)  # type: ignore[arg-type]
