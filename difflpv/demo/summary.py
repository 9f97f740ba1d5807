"""``summary.json``: every number of the demo, and the tables made from it."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from data_gen.load import Targets
from difflpv.evaluate import Score, format_scores, mean_score, relative_noise

__all__ = [
    "PRESENTATION",
    "DemoSummary",
    "code_digest",
    "describe_machine",
    "describe_targets",
    "finished_summary",
    "mean_rows",
]

_SUMMARY, _REPORT = "summary.json", "report.html"
_PACKAGES = ("torch", "warp-lang", "numpy", "embreex", "nlopt")
PRESENTATION = (
    "difflpv/cli/", "difflpv/demo/", "difflpv/report/", "difflpv/viewer/", "difflpv/shapes/", "difflpv/planning/",
    "difflpv/probes/", "difflpv/placement/", "difflpv/io/exports/",
)  # fmt: skip
"""Sources that change no solve and no fit, for ``code_digest``."""


@dataclass(frozen=True, eq=False)
class DemoSummary:
    """What a demo found.

    Attributes:
        folder: where everything lies.
        train: mean errors over the train lights, a score per component and method.
        test: the same over the test lights.
        values: the content of ``summary.json``.
    """

    folder: Path
    train: tuple[Score, ...]
    test: tuple[Score, ...]
    values: dict[str, Any]

    @classmethod
    def read(cls, folder: Path) -> DemoSummary:
        """The summary of a finished demo.

        Raises:
            FileNotFoundError: there is none.
        """
        values = json.loads((folder / _SUMMARY).read_text(encoding="utf-8"))
        train, test = (tuple(Score(**row[split]) for row in values["rows"]) for split in ("train", "test"))
        return cls(folder, train, test, values)

    @property
    def report(self) -> Path:
        """The report."""
        return self.folder / _REPORT

    @property
    def table(self) -> str:
        """Mean errors as text."""
        parts = []
        for split, scores in (("train", self.train), ("test", self.test)):
            lights = ", ".join(str(k) for k in self.values[split])
            parts.append(f"mean over the {split} lights {lights}\n{format_scores(scores)}")
        return "\n\n".join(parts)


def finished_summary(folder: Path, identity: Mapping[str, Any]) -> DemoSummary | None:
    """The summary of a demo of this identity that has been finished here, or None."""
    try:
        summary = DemoSummary.read(folder)
        same = summary.values["identity"] == json.loads(json.dumps(identity))
        return summary if same and summary.report.is_file() else None
    except (OSError, ValueError, KeyError, TypeError):
        return None  # nothing there, or something else: made anew


def code_digest(*, without: Sequence[str] = ()) -> str:
    """SHA-256 of the project's sources: results of other code are not results of this one.

    Args:
        without: beginnings of paths such as "difflpv/report/" that do not matter.

    Raises:
        ValueError: one of ``without`` names no source.
    """
    digest, unused = hashlib.sha256(), set(without)
    for package in ("difflpv", "warp_kernels", "data_gen"):
        spec = importlib.util.find_spec(package)
        assert spec is not None and spec.submodule_search_locations
        root = Path(spec.submodule_search_locations[0])
        for path in sorted(root.rglob("*.py")):
            name = path.relative_to(root.parent).as_posix()
            if name.startswith(tuple(without)):
                unused = {beginning for beginning in unused if not name.startswith(beginning)}
            else:
                digest.update(name.encode() + path.read_bytes())
    if unused:
        raise ValueError(f"without: no source begins with {', '.join(sorted(unused))}")
    return digest.hexdigest()


def mean_rows(scores: Sequence[Score], train: Sequence[int], test: Sequence[int]) -> list[dict[str, Any]]:
    """A row per component and method, in the order of ``scores``: means over the train and over the test lights."""
    rows = []
    for component, method in dict.fromkeys((s.component, s.method) for s in scores):
        own = [s for s in scores if (s.component, s.method) == (component, method)]
        means = {
            split: mean_score([s for s in own if s.light in lights]).to_json()
            for split, lights in (("train", train), ("test", test))
        }
        rows.append({"component": component, "method": method, **means})
    return rows


def describe_targets(targets: Targets, train: Sequence[int], test: Sequence[int]) -> dict[str, Any]:
    """Size and cost of the targets, and their noise: the relative L2 error that a perfect prediction would show."""
    noise: dict[str, dict[str, float]] = {}
    for component in targets.components:
        floors = [
            relative_noise(light.standard_error[component], light.irradiance[component], light.area_weight)
            for light in targets.lights
        ]
        noise[component] = {
            split: float(np.mean([floors[k] for k in lights])) for split, lights in (("train", train), ("test", test))
        }
    manifest = targets.manifest
    return {
        "receivers": len(targets.receivers),
        "spp": manifest["lights"][0]["spp"],
        "rays": manifest["rays"],
        "processor_seconds": manifest["seconds"],
        "noise": noise,
    }


def describe_machine() -> dict[str, Any]:
    """Machine, versions and date."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8", errors="replace").splitlines() if info.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.lower().startswith("model name")]
    return {
        "processor": models[0] if models else platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "load": [round(x, 2) for x in os.getloadavg()] if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": {name: metadata.version(name) for name in _PACKAGES},
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    }
