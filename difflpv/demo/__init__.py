"""The main job in one call: targets, published and fitted volumes, and a report that says how far each is from the truth.

    summary = run_demo("out/demo")

The Cornell box under eight lights; factors are fitted on five of them and judged on the other three. Everything lies in
one folder: ``targets/``, ``image/``, ``fits/<name>/`` (each readable by ``Lpv.load``), ``figures/``, ``cornell.png``,
``summary.json``, ``report.html``. What is there already and was made by the same code from the same settings is not made
again; a fit by gradients goes on from its checkpoint with the same bits as if it had never stopped.
"""

from __future__ import annotations

from difflpv.demo.run import run_demo
from difflpv.demo.settings import DemoSettings
from difflpv.demo.summary import DemoSummary

__all__ = ["DemoSettings", "DemoSummary", "run_demo"]
