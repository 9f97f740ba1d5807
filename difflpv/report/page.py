"""The report: one HTML file that needs nothing beside it. Tables and sentences are made from ``summary.json`` alone."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

from difflpv.report.story import caption_renders, fitted_values, limits, three_sentences, verdict

__all__ = ["build_page", "format_number"]

_COLUMNS = (
    ("relative_l2", "rel. L2"),
    ("scaled_l2", "at best scale (scale)"),
    ("mean_error", "mean error"),
    ("percentile_95", "95th percentile"),
)


def format_number(value: float) -> str:
    """Three digits after the point, as in every table of the report."""
    return f"{value:.3f}"


def build_page(values: Mapping[str, Any], figures: Mapping[str, bytes]) -> str:
    """The report as HTML.

    Args:
        values: the content of ``summary.json``.
        figures: PNG files by name: renders, convergence, lights, factors, speed.

    Returns:
        A page that loads nothing from anywhere.
    """
    scene = values["scene"]
    bounce = [row for row in values["rows"] if row["component"] == "bounce1"]
    direct = [row for row in values["rows"] if row["component"] == "direct"]
    noise = values["targets"]["noise"]
    quick = " These are the small sizes of <code>--quick</code>: a look at the job, not a result." if values["quick"] else ""
    parts = [
        f"<h1>Light propagation volumes in “{escape(scene)}”: how far from the truth?</h1>",
        f"<p>{three_sentences(values)}{quick}</p>",
        "<h2>Errors of the first bounce</h2>",
        f"<p>{verdict(values)}</p>",
        _table(bounce, noise["bounce1"], values),
        '<p class="quiet">Irradiance of surface points, weighted by area, against the path tracer; smaller is better, the '
        "best of each column is set bold. <em>rel. L2</em>: ‖E − E*‖ / ‖E*‖. <em>At best scale</em>: the same after the "
        "one factor that fits best, so 1.00 means that the method is calibrated. <em>Mean error</em> and <em>95th "
        "percentile</em>: of |E − E*|, over the mean of E*. Each number is a mean over the lights named above it. "
        "<em>Constant</em> predicts the mean of the targets everywhere, which a method has to beat to be of any use. "
        "<em>Floor</em> reads the true light in the cells (second order, path-traced) by the learned stencil’s lookup.</p>",
        "<h2>What it looks like</h2>",
        _figure("renders", figures, caption_renders(values), "Path-traced image, predictions, and their errors"),
        "<h2>Gradients against searches without</h2>",
        _figure("convergence", figures, _convergence_words(values), "Loss against forward-equivalents and against seconds"),
        "<h2>Light by light</h2>",
        _figure(
            "lights",
            figures,
            "Open marks: before any fit. Filled marks: fitted on the train lights. A fit that only remembered its lights "
            "would be better on the left than on the right.",
            "Error under each light",
        ),
        "<h2>Speed against accuracy</h2>",
        _figure(
            "speed",
            figures,
            "Untuned methods at the receivers of this page, timed on this machine: one solve with its lookup, set-up and rays "
            "of the lights apart. A path tracer’s time grows with the receivers, a solve’s hardly: <code>difflpv bench</code> "
            "measures from how many on a solve wins.",
            "Error over time",
        ),
        "<h2>What was found</h2>",
        fitted_values(values),
        _figure(
            "factors",
            figures,
            "Left: the share of light that each step hands on. Right: their product, so how much the light counts that "
            "has gone that many steps; the published volumes count all of it alike.",
            "Propagation factors by step",
        ),
        "<h2>Where the fitted volumes still fail</h2>",
        f"<ul>{''.join(f'<li>{line}</li>' for line in limits(values))}</ul>",
        "<h2>Direct light through the volume</h2>",
        "<p>The same test for light that comes straight from the lights (each light’s surface is put into the volume as "
        "virtual point lights). Nothing was fitted here: these are the kernels as published, and the learned one as trained in "
        "free space.</p>",
        _table(direct, noise["direct"], values),
        "<h2>How to reproduce this</h2>",
        _reproduce(values),
    ]
    template = (Path(str(resources.files("difflpv"))) / "data" / "report.html").read_text(encoding="utf-8")
    return Template(template).substitute(title=f"difflpv: {escape(scene)}", body="\n".join(parts))


def _figure(name: str, figures: Mapping[str, bytes], caption: str, alt: str) -> str:
    data = base64.b64encode(figures[name]).decode("ascii")
    image = f'<img alt="{escape(alt)}" src="data:image/png;base64,{data}">'
    return f'<figure id="{name}">{image}<figcaption>{caption}</figcaption></figure>'


def _table(rows: Sequence[Mapping[str, Any]], noise: Mapping[str, float], values: Mapping[str, Any]) -> str:
    splits = ("train", "test")
    methods = [row for row in rows if row["method"] != "floor"]  # which no method can be
    best = {(s, c): min(row[s][c] for row in methods) for s in splits for c, _ in _COLUMNS}
    lights = {s: f"{s} light{'s' * (len(values[s]) > 1)} {', '.join(str(k) for k in values[s])}" for s in splits}
    groups = "".join(f'<th class="group edge" colspan="{len(_COLUMNS)}">{lights[s]}</th>' for s in splits)
    heads = "".join(
        f'<th{" class=edge" if k == 0 else ""}>{title}</th>' for _ in splits for k, (_, title) in enumerate(_COLUMNS)
    )
    lines = [f"<tr><th></th>{groups}</tr>", f"<tr><th>method</th>{heads}</tr>"]
    for row in rows:
        cells = [f"<td>{escape(row['method'])}</td>"]
        for split in splits:
            for k, (column, _) in enumerate(_COLUMNS):
                value = row[split][column]
                kinds = [kind for kind, on in (("edge", k == 0), ("best", value == best[split, column])) if on]
                text = format_number(value) + (f" ({row[split]['scale']:.2f})" if column == "scaled_l2" else "")
                cells.append(f'<td class="{" ".join(kinds)}">{text}</td>' if kinds else f"<td>{text}</td>")
        lines.append(f"<tr>{''.join(cells)}</tr>")
    floor = "".join(
        f'<td class="edge">{format_number(noise[s])}</td>' + "<td></td>" * (len(_COLUMNS) - 1) for s in splits
    )
    lines.append(f'<tr class="floor"><td>noise of the targets</td>{floor}</tr>')
    return f'<div class="scroll"><table>{"".join(lines)}</table></div>'


def _convergence_words(values: Mapping[str, Any]) -> str:
    fits, sizes = values["fits"], values["settings"]
    count = {name: sum(_count(v) for v in fit["parameters"].values()) for name, fit in fits.items()}
    return (
        "Lines: the best loss so far; dots: every evaluation, at the upper edge where it is off the scale. A gradient "
        f"counts as three forward-equivalents, a loss alone as one. Each LPV fit may spend {sizes['lpv_budget']:g}, each "
        f"HOLPV fit {sizes['holpv_budget']:g}, as its solve takes about twice as long, and that of the learned stencil "
        f"{sizes['learned_budget']:g}. Solid: L-BFGS with gradients, over {count['HOLPV fitted']} numbers (one less where "
        "nothing blocks), one factor for every step among them. Dashed: NLopt’s BOBYQA without gradients, "
        f"over the {count['HOLPV nlopt']} numbers that are no such factors: it needs about two evaluations per number "
        "before its first step."
    )


def _count(value: Any) -> int:
    return sum(_count(v) for v in value) if isinstance(value, list) else 1


def _reproduce(values: Mapping[str, Any]) -> str:
    machine, sizes, targets, fits = values["machine"], values["settings"], values["targets"], values["fits"]
    fitted = fits["HOLPV fitted"]
    commands = [
        values["command"],
        f"difflpv fit {values['scene']} --targets {values['folder']}/targets --component bounce1 --method holpv \\\n"
        f"    --learn {','.join(fitted['parameters'])} \\\n"
        f"    --solver {fitted['solver']} --budget {sizes['holpv_budget']:g} --seed {values['seed']} --out out/fit",
    ]
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    load = f", load {machine['load'][0]:g} at the end" if machine["load"] else ""
    seconds = ", ".join(f"{escape(name)} {fit['seconds']:.0f} s" for name, fit in fits.items())
    reused = " Parts of it were there from an earlier run." if values["resumed"] else ""
    lines = [
        f"seed {values['seed']}; {targets['receivers']} receivers, {targets['spp']} paths each "
        f"({targets['rays'] / 1e6:.0f} million rays, {targets['processor_seconds']:.0f} s of processor time); grid "
        f"{sizes['cells']}³, {sizes['steps']} steps",
        f"fits: {seconds}; the whole run: {values['seconds']:.0f} s.{reused}",
        f"{escape(machine['processor'])}, {machine['cores']} cores{load}; {escape(machine['system'])}; {machine['date']}",
        f"difflpv {escape(values['difflpv'])}, Python {machine['python']}, {escape(versions)}; sources "
        f"{values['identity']['code'][:12]}",
        "every number of this page: <code>summary.json</code>; fitted models: <code>fits/</code>, for "
        "<code>difflpv simulate --fitted</code>; figures: <code>figures/</code>",
    ]
    listed = "".join(f"<li>{line}</li>" for line in lines)
    return f"<pre><code>{escape(chr(10).join(commands))}</code></pre><ul>{listed}</ul>"
