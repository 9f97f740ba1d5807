"""What a run shows: tables and charts as Markdown, PNG, SVG and one interactive HTML file. Made from the result alone."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from difflpv.bench.breakeven import EQUAL_ERROR
from difflpv.bench.measure import Point
from difflpv.bench.pareto import front_verdict, pareto_front, volume_solves
from difflpv.bench.published import published_tables
from difflpv.bench.run import BenchResult
from difflpv.bench.sections import gradient_section, pay_off_section
from difflpv.io.atomic import write_bytes, write_text
from difflpv.report.bench import (
    FAMILY_COLORS,
    draw_break_even,
    draw_error_over_time,
    draw_growth,
    draw_scanline,
    small_png,
    svg_text,
)  # fmt: skip

__all__ = ["axes_text", "summary_table", "write_charts", "write_document"]

_MARK = "<!-- generated -->"


def axes_text() -> str:
    """What stands before the generated part of a new document."""
    return (files("difflpv") / "data" / "bench_axes.md").read_text(encoding="utf-8")


def write_charts(folder: Path, result: BenchResult, *, svg: bool = True) -> dict[str, str]:
    """Write every chart as PNG (and SVG) and ``bench.html``; returns file names by key of the chart.

    Raises:
        OSError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    figures: dict[str, Any] = {}
    for key, scene in result.scenes.items():
        own = _of(result, key)
        front, volumes = ([p.name for p in pareto_front(part)] for part in (own, volume_solves(own)))
        shown = [_plain(p) for p in own]
        figures[key] = draw_error_over_time(shown, front, title=key, noise=scene["noise"], volumes=volumes)
    for even in result.break_even:
        figures[f"break-even {even['scene']}"] = draw_break_even(even)
    for row in result.scanlines:
        figures[f"line {row['scene']} {row['line']}"] = draw_scanline(row)
    if result.growth:
        figures["growth"] = draw_growth(result.growth)
    names = {}
    for key, figure in figures.items():
        names[key] = key.replace("/", "_").replace(" ", "_")
        write_bytes(folder / f"{names[key]}.png", small_png(figure))
        if svg:
            write_text(folder / f"{names[key]}.svg", svg_text(figure))
    write_text(folder / "bench.html", interactive(result))
    return names


def interactive(result: BenchResult) -> str:
    """One self-contained HTML file: error over time of every scene, one marker per configuration."""
    scenes = {}
    for key, scene in result.scenes.items():
        own = _of(result, key)
        points = [{**_plain(p), "about": _about(p)} for p in own]
        scenes[key] = {"noise": scene["noise"], "points": points, "front": [p.name for p in pareto_front(own)]}
    content = json.dumps({"colors": FAMILY_COLORS, "scenes": scenes}).replace("</", "<\\/")
    return (files("difflpv") / "data" / "bench.html").read_text(encoding="utf-8").replace("@DATA@", content)


def _of(result: BenchResult, key: str) -> list[Point]:
    return [p for p in result.points if p.scene == key]


def _plain(point: Point) -> dict[str, Any]:
    return {"name": point.name, "family": point.family, "error": point.error, "seconds": point.seconds}


def _about(p: Point) -> str:
    lines = [f"{p.name}: error {p.error:.3f}, 95th percentile {p.percentile_95:.2f}"]
    if p.leak is not None:
        lines[0] += f", leak {p.leak:.3f}"
    if p.solve is not None:
        lines.append(f"solve {_ms(p.solve.median)} ms ({_ms(p.solve.low)} to {_ms(p.solve.high)})")
        lines[-1] += f", lookup {_ms(p.lookup.median)} ms" if p.lookup else ""
        lines[-1] += f", forward and backward {_ms(p.both.median)} ms" if p.both else ""
    setup = ", ".join(f"{name} {_ms(s)} ms" for name, s in p.setup_seconds.items())
    lines.append("once: " + setup + f"; moved lights {_ms(p.lights_seconds)} ms" if setup else "")
    if p.memory_volumes:
        lines.append(f"peak memory {p.memory_volumes:.1f} volumes")
    return "\n".join(line for line in lines if line)


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3g}"


def summary_table(points: Sequence[Point]) -> str:
    """One scene as a Markdown table; a star marks the Pareto front."""
    front = {p.name for p in pareto_front(points)}
    leaks = any(p.leak is not None for p in points)
    heads = ["method", "error", "at best scale", "95th", *(["leak"] if leaks else []), "1-SSIM /2", "FLIP"]
    heads += ["solve [ms]", "lookup", "forward + backward", "lights move", "set-up", "volumes"]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for p in points:
        solve = f"{_ms(p.solve.median)} ({_ms(p.solve.low)}-{_ms(p.solve.high)})" if p.solve else ""
        setup = ", ".join(f"{name} {_ms(s)}" for name, s in p.setup_seconds.items())
        cells = [
            ("**\\*** " if p.name in front else "") + p.name,
            f"{p.error:.3f}", f"{p.scaled_error:.3f}", f"{p.percentile_95:.2f}",
            *([_or(p.leak, ".3f")] if leaks else []), _or(p.ssim, ".3f"), _or(p.flip, ".3f"), solve,
            _ms(p.lookup.median) if p.lookup else "", _ms(p.both.median) if p.both else "",
            _ms(p.lights_seconds) if p.lights_seconds else "", setup, _or(p.memory_volumes, ".1f"),
        ]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _or(value: float | None, how: str) -> str:
    return "" if value is None else format(value, how)


def write_document(path: Path, result: BenchResult, *, command: str) -> None:
    """Write, or renew, the generated part of a document; what stands before its mark is kept.

    Args:
        path: ``<name>.md``; charts go into a folder ``<name>`` beside it.
        result: what to show.
        command: that makes it anew.
    """
    names = write_charts(path.parent / path.stem, result, svg=False)
    known = path.read_text(encoding="utf-8").partition(_MARK)[0] if path.is_file() else axes_text()
    machine = f"{result.machine['processor']}, {result.machine['threads']} threads"
    parts = [
        known.rstrip(),
        _MARK,
        f"Everything below was written by `{command}` ({result.machine['date']}; {machine}); edits there are lost.",
        *(f"{line[0].upper()}{line[1:]}." for line in result.skipped),
        "## What each scene says",
        _verdicts(result),
        "## Break-even",
        _break_even(result, path.stem, names),
        "## Gradients",
        gradient_section(result.gradients),
        "## When a fit pays off",
        pay_off_section(result.pay_off),
        "## How cost grows",
        _growth(result, path.stem, names),
        "## Along a line",
        _scanlines(result, path.stem, names),
        "## Beside the theses",
        published_tables(result.points, machine),
        "## Every point",
        "Milliseconds; solves as median (quartiles). A star marks the Pareto front of error over solve + lookup.",
    ]
    for key, scene in result.scenes.items():
        cells = " x ".join(map(str, scene["cells"]))
        about = f"{cells} cells of {scene['cell_size']:.4g} m; noise of the truth {scene['noise']:.3f}; "
        about += f"{scene['receivers']} receivers; the truth took {scene['target_seconds']:.0f} s of processor time."
        parts += [f"### {key}", about, f"![error over time]({path.stem}/{names[key]}.png)", summary_table(_of(result, key))]
    write_text(path, "\n\n".join(parts) + "\n")


def _verdicts(result: BenchResult) -> str:
    return "\n".join(f"- **{key}**: {front_verdict(_of(result, key), result.published)}" for key in result.scenes)


def _break_even(result: BenchResult, folder: str, names: dict[str, str]) -> str:
    if not result.break_even:
        return "No scene was measured where a learned solve meets 0.2."
    lines = [
        "The learned configuration that meets an error of 0.2 soonest without a fit, against as many paths per receiver as",
        "give its error. Wanted: at most 20,000 receivers, and ten times as fast at a million.",
        "",
        "| scene | configuration | error | peer | paths | break-even, power changes | lights move | all anew | at 1 M: power | "
        "move | anew |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    kinds = ("power changes", "lights move", "all anew")
    for even in result.break_even:
        for family, peer in even["peers"].items():
            at = [_receivers(peer["break_even"][kind]) for kind in kinds]
            speed = [f"{peer['speedup_at_million'][kind]:.1f} x" for kind in kinds]
            cells = [even["scene"], even["configuration"], f"{even['error']:.3f}", family, f"{peer['paths']:.0f}", *at, *speed]
            lines.append("| " + " | ".join(cells) + " |")
    rest = [key for key in result.scenes if key not in {even["scene"] for even in result.break_even}]
    unfitted = [p for p in result.points if p.family == "learned" and "fit" not in p.setup_seconds]
    able = {p.scene for p in unfitted if p.error <= EQUAL_ERROR}
    if missed := [key for key in rest if key not in able]:
        lines += ["", f"No learned configuration of this run meets 0.2 without a fit on {', '.join(missed)}."]
    if left := [key for key in rest if key in able]:
        lines += ["", f"Not measured in this run: {', '.join(left)}."]
    for even in result.break_even:
        lines += ["", f"![time over receivers]({folder}/{names['break-even ' + even['scene']]}.png)"]
    return "\n".join(lines)


def _scanlines(result: BenchResult, folder: str, names: dict[str, str]) -> str:
    if not result.scanlines:
        return "No line was measured in this run."
    methods = list(result.scanlines[0]["methods"])
    lines = [
        "Relative L2 error of irradiance along each line; methods as published may leave their charts at the top.",
        "",
        "| scene | line | " + " | ".join(methods) + " |",
        "|---|---|" + "---|" * len(methods),
    ]
    for row in result.scanlines:
        errors = [f"{row['errors'][name]:.3f}" for name in methods]
        lines.append("| " + " | ".join([row["scene"], row["line"], *errors]) + " |")
    for row in result.scanlines:
        key = f"line {row['scene']} {row['line']}"
        lines += ["", f"![{row['scene']}, {row['line']} line]({folder}/{names[key]}.png)"]
    return "\n".join(lines)


def _receivers(value: float | None) -> str:
    return "never" if value is None else "below 1,000" if value <= 1000 else f"{value:,.0f}"


def _growth(result: BenchResult, folder: str, names: dict[str, str]) -> str:
    if not result.growth:
        return "Not measured in this run."
    step, rates = result.step, result.rates
    lines = ["| what | sizes | ms | exponent |", "|---|---|---|---|"]
    for row in result.growth:
        sizes = ", ".join(f"{n:,}" for n in row["sizes"])
        lines.append(f"| {row['what']} | {sizes} | {', '.join(_ms(s) for s in row['seconds'])} | {row['exponent']:.2f} |")
    cells: dict[str, list[float]] = next((row for row in result.growth if "volumes" in row), {})
    peak, opened, buffers = (
        ", ".join(f"{v:.2f}" for v in cells.get(name, [])) for name in ("volumes", "volumes_open", "volumes_buffers")
    )
    seconds = step["seconds"]["ours"]
    flops, moved = step["flops"] / seconds, step["bytes"] / seconds
    lines += [
        "",
        f"Peak memory of propagation without gradients beyond the injected volume, in volumes: {opened} where nothing blocks.",
        f"That is two buffers with a halo of one cell, which are {buffers} volumes at these sizes: all steps are alike, so",
        "they are summed from the inside out. Three are held where they are not (LPV, HOLPV, a first step that nothing",
        f"blocks) or a tolerance ends them. With occlusion {peak}: a padded copy of the transmittance, 13 numbers",
        "beside the 27 of a cell.",
        "",
        f"![growth]({folder}/{names['growth']}.png)",
        "",
        f"One step of learned_9x26 with occlusion at {step['cells']}³, RGB, against peers in the same run:",
        "",
        "| | ms per step | times ours |",
        "|---|---|---|",
        *(f"| {name} | {_ms(s)} | {step['ratios'][name]:.2f} |" for name, s in step["seconds"].items()),
        "",
        f"A step does {flops / 1e9:.1f} Gflop/s of the {rates['flops_per_second'] / 1e9:.0f} of a matrix product here "
        f"({100 * flops / rates['flops_per_second']:.0f} %), and moves at least {moved / 1e9:.1f} GB/s of the "
        f"{rates['copy_bytes_per_second'] / 1e9:.1f} of a copy ({100 * moved / rates['copy_bytes_per_second']:.0f} %).",
    ]
    return "\n".join(lines)
