"""Where methods fail: experiments that push each until it breaks, and the document that says so.

    run_stress("out/stress", settings=StressSettings.quick())

An experiment is a function ``(Bench) -> Experiment`` listed in ``difflpv.stress.registry``; a method is a line of
``difflpv.stress.settings.STRESS_METHODS``.
"""

from __future__ import annotations

from difflpv.stress.run import run_stress
from difflpv.stress.settings import STRESS_METHODS, StressSettings

__all__ = ["STRESS_METHODS", "StressSettings", "run_stress"]
