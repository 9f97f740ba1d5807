"""The experiments by name, in the order of the document."""

from __future__ import annotations

from collections.abc import Callable

from difflpv.stress.fits import fit_rate, fit_start
from difflpv.stress.growth import factor, gradients, steps
from difflpv.stress.inverse import inverse
from difflpv.stress.lobes import albedo, clamp
from difflpv.stress.measure import Bench
from difflpv.stress.placement import rotation, translation
from difflpv.stress.refinement import door, refinement, refinement_direct, rooms, walls
from difflpv.stress.results import Experiment
from difflpv.stress.samples import samples
from difflpv.stress.scale import length, radiance

__all__ = ["EXPERIMENTS"]

EXPERIMENTS: dict[str, Callable[[Bench], Experiment]] = {
    "factor": factor,
    "steps": steps,
    "fit_start": fit_start,
    "fit_rate": fit_rate,
    "clamp": clamp,
    "albedo": albedo,
    "refinement": refinement,
    "refinement_direct": refinement_direct,
    "samples": samples,
    "rooms": rooms,
    "walls": walls,
    "door": door,
    "translation": translation,
    "rotation": rotation,
    "length": length,
    "radiance": radiance,
    "gradients": gradients,
    "inverse": inverse,
}
