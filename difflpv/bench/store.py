"""Results as JSON lines: what is finished, made by the same code with the same settings, is not measured again."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from difflpv.bench.measure import Point
from difflpv.io.atomic import write_text

__all__ = ["Store", "pay_off_csv", "points_csv"]


class Store:
    """Records by key, a line each: ``{"key": ..., "identity": ..., "value": ...}``; a damaged line is as if never written."""

    def __init__(self, path: Path, identity: Mapping[str, Any]) -> None:
        """Open, or begin, a file.

        Args:
            path: the file.
            identity: JSON values that decide the numbers; records of another identity are dropped when the next is added.
        """
        self.path = path
        self._identity = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:16]
        self._values: dict[str, Any] = {}
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else []:
            try:
                record = json.loads(line)
                if record["identity"] == self._identity:
                    self._values[record["key"]] = record["value"]
            except (ValueError, KeyError, TypeError):
                continue

    def get(self, key: str) -> Any:
        """The value of a key, or None."""
        return self._values.get(key)

    def put(self, values: Mapping[str, Any]) -> None:
        """Keep values by key; the file is replaced as a whole.

        Raises:
            OSError: the file cannot be written.
        """
        self._values |= values
        lines = [
            json.dumps({"key": key, "identity": self._identity, "value": value}, allow_nan=False)
            for key, value in self._values.items()
        ]
        write_text(self.path, "\n".join(lines) + "\n")


def points_csv(points: Sequence[Point]) -> str:
    """One line per point, seconds and bytes, empty where nothing was measured."""
    target = io.StringIO()
    parts = ("solve", "lookup", "both")
    setup = sorted({name for p in points for name in p.setup_seconds})
    plain = (
        "scene", "name", "family", "error", "scaled_error", "percentile_95", "leak", "ssim", "flip", "receivers",
        "lights_seconds", "memory_bytes", "memory_volumes",
    )  # fmt: skip
    writer = csv.writer(target, lineterminator="\n")
    heads = [f"{part}_{what}" for part in parts for what in ("seconds", "low", "high", "repeats")]
    writer.writerow([*plain, *heads, *(f"{name}_seconds" for name in setup)])
    for p in points:
        times = [getattr(p, part) for part in parts]
        cells = [v for t in times for v in ((t.median, t.low, t.high, t.repeats) if t else ("",) * 4)]
        values = ["" if getattr(p, name) is None else getattr(p, name) for name in plain]
        writer.writerow([*values, *cells, *(p.setup_seconds.get(name, "") for name in setup)])
    return target.getvalue()


def pay_off_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """One line per fitted configuration and number of receivers; solves are empty where a fit never pays off.

    Args:
        rows: of ``difflpv.bench.payoff.measure_pay_off``.
    """
    target = io.StringIO()
    plain = ("scene", "configuration", "error", "error_before", "targets_seconds", "fit_seconds", "paths")
    each = ("solve_seconds", "traced_seconds", "setup_seconds", "solves", "solves_with_setup")
    writer = csv.writer(target, lineterminator="\n")
    writer.writerow([*plain, "receivers", *each])
    for row in rows:
        for k, count in enumerate(row["counts"]):
            values = ["" if row[name][k] is None else row[name][k] for name in each]
            writer.writerow([*(row[name] for name in plain), count, *values])
    return target.getvalue()
