"""The generated part of docs/probes.md from the numbers of benchmarks/probes.py: wanted beside reached, charts, tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from difflpv.io.atomic import write_bytes, write_text
from difflpv.report.probe_charts import draw_curves

MARK = "<!-- generated -->"
GRID = "uniform grid"
HEURISTICS = ("spawn_merge", "spawn_merge_hierarchical", "irradiance_ascent", "greedy_removal")  # methods 2 to 4
OURS = "gradient"
PLACE_LIMIT, LOOKUP_LIMIT = 180.0, 1e6  # seconds for 64 probes; points per second of a core at 256

Results = Mapping[str, Mapping[str, Mapping[str, Sequence[Mapping[str, Any]]]]]
"""Scene -> entry -> count -> one result a seed."""


class Reader:
    """Means over seeds of what was judged.

    Attributes:
        results: by scene, entry and count.
        entries: method, content and "variant" (beside the chart) of each entry.
    """

    def __init__(self, results: Results, entries: Mapping[str, Mapping[str, Any]]) -> None:
        self.results, self.entries = results, entries

    def values(self, scene: str, name: str, count: str, what: str, content: str | None = None) -> list[float]:
        """One value for each seed; empty where the entry has none."""
        runs = self.results[scene].get(name, {}).get(count, ())
        return [run["judged"][content or self.entries[name]["content"]][what] for run in runs]

    def mean(self, scene: str, name: str, count: str, what: str = "error", content: str | None = None) -> float:
        """Mean over the seeds; NaN where there is none."""
        found = self.values(scene, name, count, what, content)
        return float(np.mean(found)) if found else float("nan")

    def named(self, *methods: str) -> list[str]:
        """Entries of these methods, without the variants that are beside the chart."""
        return [name for name, entry in self.entries.items() if entry["method"] in methods and not entry["variant"]]

    def best_heuristic(self, scene: str, count: str, content: str | None = None) -> tuple[float, str]:
        """The least error of methods 2 to 4, and whose it is."""
        found = [(self.mean(scene, name, count, content=content), name) for name in self.named(*HEURISTICS)]
        return min(((error, name) for error, name in found if error == error), default=(float("nan"), ""))

    def counts(self) -> list[str]:
        """All counts, ascending."""
        return sorted({c for scene in self.results.values() for by in scene.values() for c in by}, key=int)


def chart_folder(path: Path) -> Path:
    """Where the charts of a document lie; made if missing."""
    folder = path.parent / path.stem
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def write_page(
    path: Path,
    command: str,
    results: Results,
    entries: Mapping[str, Mapping[str, Any]],
    tolerances: Mapping[str, Sequence[Mapping[str, Any]]],
    about: Mapping[str, Mapping[str, Any]],
) -> None:
    """Write, or renew, what stands behind the mark of a document, and charts into a folder of its name beside it.

    Pictures that lie there by a scene's name are shown.
    """
    reader = Reader(results, entries)
    folder = chart_folder(path)
    for what, label in (("error", "relative L2 error of irradiance"), ("leak", "the same where walls cut the tetrahedra")):
        floors = {scene: row["noise"] for scene, row in about.items()} if what == "error" else None
        curves = {scene: _curves(reader, scene, what) for scene in results}
        write_bytes(folder / f"{what}.png", draw_curves(curves, quantity=label, ours=reader.named(OURS), floors=floors))
    known = path.read_text(encoding="utf-8").partition(MARK)[0] if path.is_file() else "# Light probes\n"
    parts = [
        known.rstrip(), MARK,
        f"Everything below was written by `{command}`; edits there are lost.",
        "## Wanted and reached", _wanted(reader, tolerances),
        "## Error against count",
        f"![Error against the number of probes]({path.stem}/error.png)",
        "Line: mean of the seeds; band: their range. Published methods with traced content, ours with fitted content.",
        f"![Leak against the number of probes]({path.stem}/leak.png)",
    ]  # fmt: skip
    parts += ["## Against walls: edge rays, sight, footprints", _walls(reader)]
    if any(tolerances.values()):
        parts += ["## As few as a tolerance needs", _tolerance_table(tolerances)]
    for scene in results:
        picture = [f"![Where the probes stand in {scene}]({path.stem}/{scene}.png)"]
        pictured = picture if (folder / f"{scene}.png").exists() else []
        parts += [f"## {scene}", _about(about[scene]), *pictured, *_tables(reader, scene)]
    write_text(path, "\n\n".join(parts) + "\n")


def _curves(reader: Reader, scene: str, what: str) -> dict[str, dict[int, list[tuple[float, float]]]]:
    found: dict[str, dict[int, list[tuple[float, float]]]] = {}
    for name in (name for name, entry in reader.entries.items() if not entry["variant"]):
        for count in reader.results[scene].get(name, {}):
            placed = reader.values(scene, name, count, "count")
            values = reader.values(scene, name, count, what)
            if min(values) > 0:
                found.setdefault(name, {})[int(count)] = list(zip(placed, values, strict=True))
    return found


def _wanted(reader: Reader, tolerances: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    ours = [name for name in reader.named(OURS) if any(name in scene for scene in reader.results.values())]
    if not ours:
        return "No method of ours was run."
    lines = ["| wanted | " + " | ".join(ours) + " |", "|---|" + "---|" * len(ours)]

    def row(text: str, cell: Callable[[str], str]) -> None:
        lines.append(f"| {text} | {' | '.join(cell(name) for name in ours)} |")

    for count in reader.counts():
        grid = {s: reader.mean(s, GRID, count) for s in reader.results}
        best = {s: reader.best_heuristic(s, count)[0] for s in reader.results}
        row(
            f"{count} probes: error at most 0.5 of the uniform grid's",
            lambda n, g=grid, c=count: _ratios(reader, n, c, g, 0.5),
        )
        row(
            f"{count} probes: at most 0.75 of the best of methods 2 to 4",
            lambda n, b=best, c=count: _ratios(reader, n, c, b, 0.75),
        )
        row(
            f"{count} probes: each scene better than uniform",
            lambda n, g=grid, c=count: _every([reader.mean(s, n, c) < g[s] for s in g]),
        )
    if any(tolerances.values()):
        shares = {n: [r["count"] / r["grid"] for rows in tolerances.values() for r in rows if r["name"] == n] for n in ours}
        met = {n: [r["error"] <= r["wanted"] for rows in tolerances.values() for r in rows if r["name"] == n] for n in ours}
        row(
            "the grid's error with at most 1/3 of its probes",
            lambda n: f"{np.mean(shares[n]):.2f} of them ({min(shares[n]):.2f} to {max(shares[n]):.2f}); error met in "
            f"{sum(met[n])} of {len(met[n])}: {_verdict(float(np.mean(shares[n])) <= 1 / 3 and all(met[n]))}",
        )
    row("no probe inside a solid", lambda n: _solids(reader, n))
    row("64 probes placed within 180 s (processor time of one core)", lambda n: _slowest(reader, n))
    row("1 M lookups per second and core with 256 probes", lambda n: _slowest_lookups(reader, n))
    lines += ["", "Not asked for: content fitted for every method, so that only positions and reading count.", ""]
    lines += ["| fitted against fitted | " + " | ".join(ours) + " |", "|---|" + "---|" * len(ours)]
    for count in reader.counts():
        grid = {s: reader.mean(s, GRID, count, content="fitted") for s in reader.results}
        best = {s: reader.best_heuristic(s, count, "fitted")[0] for s in reader.results}
        row(f"{count} probes: over the uniform grid's", lambda n, g=grid, c=count: _ratios(reader, n, c, g))
        row(f"{count} probes: over the best of methods 2 to 4", lambda n, b=best, c=count: _ratios(reader, n, c, b))
    return "\n".join(lines)


def _ratios(reader: Reader, name: str, count: str, other: Mapping[str, float], limit: float | None = None) -> str:
    found = [reader.mean(scene, name, count) / error for scene, error in other.items()]
    found = [ratio for ratio in found if ratio == ratio]
    if not found:
        return "-"
    mean = float(np.mean(found))
    verdict = "" if limit is None else f": {_verdict(mean <= limit)}"
    return f"{mean:.2f} ({min(found):.2f} to {max(found):.2f}){verdict}"


def _verdict(reached: bool) -> str:
    return "reached" if reached else "**not reached**"


def _every(better: Sequence[bool]) -> str:
    return f"{sum(better)} of {len(better)}: {_verdict(all(better))}"


def _solids(reader: Reader, name: str) -> str:
    runs = [run for scene in reader.results.values() for by in scene.get(name, {}).values() for run in by]
    inside, placed = sum(run["in_solids"] for run in runs), sum(len(run["placed"]["position"]) for run in runs)
    return f"{inside} of {placed}: {_verdict(inside == 0)}"


def _slowest(reader: Reader, name: str) -> str:
    found = [value for scene in reader.results for value in reader.values(scene, name, "64", "seconds")]
    return "-" if not found else f"{max(found):.0f} s at most: {_verdict(max(found) <= PLACE_LIMIT)}"


def _slowest_lookups(reader: Reader, name: str) -> str:
    found = [v for scene in reader.results for v in reader.values(scene, name, "256", "lookups_per_second", "traced")]
    return "-" if not found else f"{min(found) / 1e6:.2f} M at least: {_verdict(min(found) >= LOOKUP_LIMIT)}"


def _walls(reader: Reader) -> str:
    names = [GRID, *(name for name, entry in reader.entries.items() if entry["variant"]), *reader.named(OURS)]
    lines = [
        "Error; leak, and in brackets the share of points that it is taken at: those whose tetrahedron of the method's own "
        "probes is cut by a wall. Edge rays spend probes on walls; sight leaves the probes as they are and costs lookups; ours "
        "has neither.", "",
        f"| scene, probes | {' | '.join(names)} |", "|---|" + "---|" * len(names),
    ]  # fmt: skip
    for scene in reader.results:
        for count in reader.counts():
            cells = []
            for name in names:
                values = [reader.mean(scene, name, count, what) for what in ("error", "leak", "cut_share")]
                cells.append("-" if values[0] != values[0] else "{:.3f}; {:.3f} ({:.2f})".format(*values))
            lines.append(f"| {scene}, {count} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _tolerance_table(tolerances: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    lines = [
        "The error that the uniform grid was judged with is asked of ours (`tolerance=`), by what it is shown.", "",
        "| scene | method | grid: probes, error | ours: probes, error |", "|---|---|---|---|",
    ]  # fmt: skip
    for scene, rows in tolerances.items():
        for r in rows:
            lines.append(f"| {scene} | {r['name']} | {r['grid']:.0f}, {r['wanted']:.3f} | {r['count']}, {r['error']:.3f} |")
    return "\n".join(lines)


def _about(about: Mapping[str, Any]) -> str:
    return (
        f"Placed under {about['placing_lights']} light sets; judged at {about['points']} points under {about['lights']} others;"
        f" content fitted by {about['fit']} further points. Noise of the truth: {about['noise']:.3f}."
    )


def _tables(reader: Reader, scene: str) -> list[str]:
    heads = (
        "method", "probes", "**error**", "other content", "p95", "leak", "cut", "free", "surface", "kB", "place [s]",
        "M lookups/s", "in solids",
    )  # fmt: skip
    tables = []
    for count in reader.counts():
        rows = [name for name in reader.entries if count in reader.results[scene].get(name, {})]
        if not rows:
            continue
        best = min(reader.mean(scene, name, count) for name in rows)
        lines = [f"### {count} probes", "", f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
        for name in rows:
            lines.append(f"| {' | '.join(_cells(reader, scene, name, count, best))} |")
        tables.append("\n".join(lines))
    return tables


def _cells(reader: Reader, scene: str, name: str, count: str, best: float) -> list[str]:
    def mean(what: str, content: str | None = None) -> float:
        return reader.mean(scene, name, count, what, content)

    content = reader.entries[name]["content"]
    other = "fitted" if content == "traced" else "traced"
    errors = reader.values(scene, name, count, "error")
    shown = f"{np.mean(errors):.3f}"
    shown = f"**{shown}**" if np.mean(errors) == best else shown
    spread = f" ± {(max(errors) - min(errors)) / 2:.3f}" if len(errors) > 1 else ""
    inside = sum(run["in_solids"] for run in reader.results[scene][name][count])
    return [
        name, f"{mean('count'):.0f}", f"{shown}{spread} {content}", f"{mean('error', other):.3f} {other}",
        *(f"{mean(what):.3f}" for what in ("p95", "leak")), f"{mean('cut_share'):.2f}",
        *(f"{mean(what):.3f}" for what in ("free_error", "surface_error")), f"{mean('bytes') / 1e3:.1f}",
        f"{mean('seconds'):.1f}", f"{mean('lookups_per_second', 'traced') / 1e6:.2f}", str(inside),
    ]  # fmt: skip
