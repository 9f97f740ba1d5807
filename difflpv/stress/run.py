"""Runs experiments, each kept in a file of its own: what is there already, made by the same code, is not run again."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from difflpv.config import LpvConfig
from difflpv.demo.summary import PRESENTATION, code_digest
from difflpv.io.atomic import write_json
from difflpv.stress.measure import Bench
from difflpv.stress.page import write_page
from difflpv.stress.registry import EXPERIMENTS
from difflpv.stress.results import Experiment
from difflpv.stress.settings import STRESS_METHODS, StressSettings

__all__ = ["run_stress"]

# Sources that change no reading.
_PRESENTATION = (*PRESENTATION, "difflpv/bench/", "difflpv/stress/page.py", "difflpv/stress/run.py")


def run_stress(
    out: str | Path = "out/stress",
    *,
    settings: StressSettings | None = None,
    methods: Mapping[str, LpvConfig] = STRESS_METHODS,
    only: Sequence[str] | None = None,
    markdown: str | Path | None = None,
    command: str = "difflpv stress",
    progress: Callable[[str], object] = print,
) -> list[Experiment]:
    """Run experiments, or what is left of them, and write ``<experiment>.json`` and the document.

    Args:
        out: folder for results, truth and, unless ``markdown`` says otherwise, ``stability.md`` with its charts.
        settings: sizes; the full run by default.
        methods: solves by name.
        only: names of ``EXPERIMENTS``; all by default.
        markdown: where to write the document.
        command: that the document names as its origin.
        progress: told lines of text.

    Returns:
        The experiments in the order of the document.

    Raises:
        ValueError: an unknown experiment.
        KeyboardInterrupt: passed on; finished experiments are kept.
    """
    sizes, folder = settings or StressSettings(), Path(out)
    unknown = [name for name in only or () if name not in EXPERIMENTS]
    if unknown:
        raise ValueError(f"experiment '{unknown[0]}': expected one of {', '.join(EXPERIMENTS)}")
    (folder / "truth").mkdir(parents=True, exist_ok=True)
    identity = {"code": code_digest(without=_PRESENTATION), "settings": asdict(sizes)}
    identity["methods"] = {name: config.to_json() for name, config in methods.items()}
    bench, found = Bench(sizes, methods, folder / "truth"), []
    for name, experiment in EXPERIMENTS.items():
        if only and name not in only:
            continue
        path = folder / f"{name}.json"
        done = _finished(path, identity)
        if done is None:
            begun = time.perf_counter()
            progress(f"{name} ...")
            done = experiment(bench)
            seconds = time.perf_counter() - begun
            write_json(path, {"identity": identity, "seconds": round(seconds, 1), "experiment": done.to_json()})
            progress(f"{name}: {len(done.readings)} readings, {len(done.limits)} limits, {seconds:.0f} s")
        else:
            progress(f"{name}: finished before")
        found.append(done)
    target = Path(markdown) if markdown is not None else folder / "stability.md"
    write_page(target, found, command=command, settings=asdict(sizes))
    progress(f"limits and charts: {target}")
    return found


def _finished(path: Path, identity: dict[str, Any]) -> Experiment | None:
    """The experiment that was run by this code with these settings and kept in ``path``, or None."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["identity"] != json.loads(json.dumps(identity)):
            return None
        return Experiment.from_json(content["experiment"])
    except (OSError, ValueError, KeyError, TypeError):
        return None  # nothing there, damaged, or something else: run anew
