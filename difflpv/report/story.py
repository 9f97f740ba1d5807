"""The sentences of the report, each a function of the numbers: what they say holds for any outcome, good or bad."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

__all__ = ["caption_renders", "fitted_values", "limits", "three_sentences", "verdict"]

_MEANING = {
    "propagation": ("propagation factor", "share of its light that a cell hands on in every step; 1 keeps an even field even"),
    "propagation_steps": ("propagation factor by step", "the same for each step alone, times the factor above (figure below)"),
    "occlusion": ("occlusion strength", "how strongly surfaces between cells block light; 0: not at all, 1: as sampled"),
    "sampling_bias": ("sampling bias", "cells in front of a surface at which it reads its light; published ½"),
    "injection_bias": ("injection bias", "cells in front of a lit surface at which its light enters the volume; published ½"),
}


def three_sentences(values: Mapping[str, Any]) -> str:
    """What was done."""
    targets, train, test = values["targets"], values["train"], values["test"]
    return (
        f"A path tracer computed the irradiance of {targets['receivers']} points on the surfaces of the scene under "
        f"{len(train) + len(test)} different lights, with a noise of {_percent(targets['noise']['bounce1']['test'])}. "
        "Light propagation volumes of first order (LPV) and second order (HOLPV) predicted the same, once as published "
        f"and once with their factors fitted to the lights {_listed(train)}, by gradients through the solve and by NLopt "
        f"without gradients. learned_9x26 has HOLPV's shape with a stencil that was trained in free space, before it met any "
        f"scene. All were then judged on the lights {_listed(test)}, which no fit had seen."
    )


def verdict(values: Mapping[str, Any]) -> str:
    """Who is best on the test lights, and by how much."""
    error = _test_errors(values)
    methods = {name: e for name, e in error.items() if name not in ("constant", "floor")}
    best = min(methods, key=lambda name: methods[name])
    parts = [f"On the test lights <strong>{escape(best)}</strong> comes closest, with a relative error of {error[best]:.3f}"]
    base = best.split()[0]
    against = []
    if base != best:
        against.append(f"{error[base]:.3f} for {_unfitted(base)}")
    against.append(f"{error['constant']:.3f} for a constant")
    noise = values["targets"]["noise"]["bounce1"]["test"]
    floor = values["floor"]
    parts.append(
        f" The floor is {error['floor']:.3f}: the true light in the cells, path-traced and read by the learned stencil’s "
        "lookup. No propagation of second order on this grid can be expected to beat it by much; a fit can a little, because "
        f"fitted gains mend some of what the lookup loses. Its own noise ({floor['spp']} paths a cell) would alone measure "
        f"{floor['noise']['test']:.3f}."
    )
    published = _test_row(values, base)
    parts.append(f" against {' and '.join(against)}; a perfect method would measure {noise:.3f}, the noise of the targets.")
    if published["scaled_l2"] < 0.8 * published["relative_l2"]:
        parts.append(
            f" Much of the error of {_unfitted(base)} is overall brightness: times {published['scale']:.2f}, it would "
            f"measure {published['scaled_l2']:.3f}."
        )
    worse = [name for name, e in methods.items() if e > error["constant"]]
    if worse:
        parts.append(f" Worse than a constant: {_listed([f'{n} ({error[n]:.2f})' for n in worse])}.")
    return "".join(parts)


def caption_renders(values: Mapping[str, Any]) -> str:
    """Under the pictures."""
    return (
        f"Light reflected once (the part that the volume carries), under test light {values['settings']['image_light']}, "
        "which no fit had seen. All pictures have the exposure of the path-traced one. Beneath: how much too bright (red) "
        "or too dark (blue) each pixel is; grey: nothing is hit there. Where light comes straight from the lamp is not "
        "shown: it is computed by other means."
    )


def fitted_values(values: Mapping[str, Any]) -> str:
    """A table of what the fits found, with what each number means."""
    fits = values["fits"]
    names = [n for n in _MEANING if any(n in fit["parameters"] for fit in fits.values())]
    heads = "".join(f"<th>{escape(name)}</th>" for name in fits)
    lines = [f"<tr><th></th>{heads}<th></th></tr>"]
    for name in names:
        title, meaning = _MEANING[name]
        cells = "".join(f"<td>{_value(fit['parameters'].get(name))}</td>" for fit in fits.values())
        lines.append(f'<tr><td>{title}</td>{cells}<td class="words">{meaning}</td></tr>')
    ends = "".join(f"<td>{escape(fit['status'].replace('_', ' '))}</td>" for fit in fits.values())
    lines.append(f'<tr><td>stopped by</td>{ends}<td class="words">“budget”: the loss might still fall with more</td></tr>')
    return f'<div class="scroll"><table>{"".join(lines)}</table></div>'


def limits(values: Mapping[str, Any]) -> list[str]:
    """Where the fitted volumes still fail, a line each."""
    lines = []
    noise = values["targets"]["noise"]["bounce1"]["test"]
    rows = {row["method"]: row["test"] for row in values["rows"] if row["component"] == "bounce1"}
    for method in ("learned_9x26", "HOLPV", "LPV"):
        name, row = f"{method} fitted", rows.get(f"{method} fitted")
        if row is None:
            continue
        by_light = {k: _under(values, name, k) for k in values["test"]}
        worst = max(by_light, key=lambda k: by_light[k])
        far = f", {row['relative_l2'] / noise:.0f} times the noise of the targets" if noise > 0 else ""
        beaten = [k for k in (*values["train"], *values["test"]) if _under(values, name, k) > _under(values, "constant", k)]
        lost = f" A constant beats it under light{'s' * (len(beaten) > 1)} {_listed(beaten)}." if beaten else ""
        lines.append(
            f"{name}: {row['relative_l2']:.3f} on the test lights{far}; one point in twenty is off by more than "
            f"{row['percentile_95']:.2f} times the mean irradiance; worst under light {worst} ({by_light[worst]:.3f}).{lost}"
        )
    above = {n: f["factors"] for n, f in values["fits"].items() if n.endswith("fitted") and max(f["factors"]) > 1}
    if above:
        counts = [f"{sum(x > 1 for x in f)} of {len(f)} for {n} (up to {max(f):.2f})" for n, f in above.items()]
        lines.append(
            f"Some step factors lie above 1: {_listed(counts)}. Such steps add light that no lamp emitted: the fit makes up "
            "for light that the stencil smears out. The numbers belong to this scene, this grid and this number of steps, "
            "and are no physics to carry elsewhere."
        )
    leaky = [n for n, f in values["fits"].items() if n.endswith("fitted") and f["parameters"].get("occlusion", 1.0) < 0.05]
    if leaky:
        lines.append(
            f"{_listed(leaky)}: the occlusion strength went to (nearly) 0, so light passes through walls and blocks: "
            "blocking took more light than the stencil could bring around them."
        )
    lines.append("Shadow edges and contact shadows finer than a cell cannot appear, whatever the factors.")
    return lines


def _unfitted(method: str) -> str:
    """What a method is called before any fit."""
    return f"{method} before the fit" if method.startswith("learned") else f"{method} as published"


def _test_errors(values: Mapping[str, Any]) -> dict[str, float]:
    return {row["method"]: row["test"]["relative_l2"] for row in values["rows"] if row["component"] == "bounce1"}


def _test_row(values: Mapping[str, Any], method: str) -> Mapping[str, float]:
    return next(r["test"] for r in values["rows"] if (r["component"], r["method"]) == ("bounce1", method))


def _under(values: Mapping[str, Any], method: str, light: int) -> float:
    """Error of the first bounce under one light."""
    found = (s for s in values["scores"] if (s["component"], s["method"], s["light"]) == ("bounce1", method, light))
    return next(found)["relative_l2"]


def _value(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, list):
        return f"{min(value):.2f} … {max(value):.2f}"
    return f"{value:.3f}"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _listed(items: Sequence[Any]) -> str:
    texts = [escape(str(item)) for item in items]
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}"
