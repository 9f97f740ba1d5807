"""What a user installs: pins are complete, versions agree, and the wheel works away from the source tree."""

from __future__ import annotations

import importlib.metadata
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import difflpv

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("difflpv", "warp_kernels", "data_gen")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def pins() -> dict[str, str]:
    """Canonical name -> exact version of constraints.txt."""
    lines = [line.split("#")[0].strip() for line in (ROOT / "constraints.txt").read_text().splitlines()]
    pairs = [line.partition("==") for line in lines if line]
    assert all(separator and version for _, separator, version in pairs), "constraints.txt: exact versions only"
    names = [canonicalize_name(name) for name, _, _ in pairs]
    assert len(names) == len(set(names)), "constraints.txt: a package stands there twice"
    return dict(zip(names, (version for _, _, version in pairs), strict=True))


def unpinned(requirements: list[str], pinned: dict[str, str]) -> set[str]:
    """Names that the requirements need, directly or not, and that have no pin."""
    missing, seen = set(), set()
    queue = [Requirement(text) for text in requirements]
    while queue:
        requirement = queue.pop()
        name = canonicalize_name(requirement.name)
        if name in seen or (requirement.marker and not requirement.marker.evaluate({"extra": ""})):
            continue
        seen.add(name)
        missing |= {name} - set(pinned)
        try:
            queue += [Requirement(text) for text in importlib.metadata.requires(name) or []]
        except importlib.metadata.PackageNotFoundError:
            pass  # an optional extra that is not installed here: its own requirements are out of reach
    return missing


def test_every_requirement_is_pinned():
    extras = [text for group in PROJECT["project"]["optional-dependencies"].values() for text in group]
    requirements = [*PROJECT["build-system"]["requires"], *PROJECT["project"]["dependencies"], *extras]
    assert unpinned(requirements, pins()) == set()


def test_pins_satisfy_the_ranges():
    pinned = pins()
    for text in [*PROJECT["build-system"]["requires"], *PROJECT["project"]["dependencies"]]:
        requirement = Requirement(text)
        assert requirement.specifier.contains(pinned[canonicalize_name(requirement.name)]), text


def test_a_missing_pin_is_found():
    pinned = pins()
    del pinned["sympy"]  # only torch asks for it
    assert unpinned(PROJECT["project"]["dependencies"], pinned) == {"sympy"}


def test_versions_agree():
    version = PROJECT["project"]["version"]
    assert difflpv.__version__ == version
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    headings = re.findall(r"^## \[([^\]]+)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert headings and (headings[0] == "Unreleased" or headings[0] == version)


def test_entry_points_exist():
    for target in PROJECT["project"]["scripts"].values():
        module, _, name = target.partition(":")
        assert callable(getattr(importlib.import_module(module), name))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel, built from a copy so that no build output lands in the source tree."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    program = "import sys, setuptools.build_meta as backend; backend.build_wheel(sys.argv[1])"
    built = subprocess.run(
        [sys.executable, "-c", program, str(folder)], cwd=source, capture_output=True, text=True, timeout=300
    )
    assert built.returncode == 0, built.stderr[-2000:]
    (path,) = folder.glob("difflpv-*.whl")
    return path


def test_wheel_holds_the_packages_and_their_data(wheel):
    inside = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    files = {
        str(path.relative_to(ROOT))
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert inside == files
    assert {"difflpv/py.typed", "difflpv/data/light_sets.json", "difflpv/data/scenes/cornell.glb"} <= inside


def test_installed_wheel_finds_its_scenes(wheel, tmp_path):
    site = tmp_path / "site"
    zipfile.ZipFile(wheel).extractall(site)
    program = (
        f"import sys; sys.path.insert(0, {str(site)!r})\n"
        "import difflpv.io as io\n"
        f"assert io.__file__.startswith({str(site)!r}), io.__file__\n"
        "print(*io.bundled_scenes()); io.load_scene('cornell')"
    )
    result = subprocess.run(
        [sys.executable, "-P", "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 0, result.stderr
    bundled = sorted(path.stem for path in (ROOT / "difflpv" / "data" / "scenes").glob("*.glb"))
    assert result.stdout.split() == bundled
