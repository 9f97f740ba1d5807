"""Who is worth its time: the Pareto front of error and time, and what it says about families of methods."""

from __future__ import annotations

from collections.abc import Sequence

from difflpv.bench.measure import Point

__all__ = ["front_verdict", "pareto_front", "volume_solves"]

_PROBES = ("traced probes", "LPV-lit probes")


def pareto_front(points: Sequence[Point]) -> list[Point]:
    """Points that no other beats in both error and time, the fastest first; the constant, which costs nothing, bounds them.

    Points without a time are no part of it.
    """
    bound = min((p.error for p in points if p.family == "constant"), default=float("inf"))
    front: list[Point] = []
    for point in sorted((p for p in points if p.seconds is not None), key=lambda p: (p.seconds, p.error)):
        if point.error < bound:
            front.append(point)
            bound = point.error
    return front


def volume_solves(points: Sequence[Point]) -> list[Point]:
    """Those that solve a volume and read it, and the constant that they have to beat."""
    return [p for p in points if p.family in ("constant", "LPV", "HOLPV", "learned")]


def front_verdict(points: Sequence[Point], published: Sequence[str]) -> str:
    """What a scene says: whose volume solves lie on their front, whether tracing paths beats them all, which probes do best.

    Args:
        points: of one scene and component.
        published: names of configurations as in a publication.
    """
    front = pareto_front(volume_solves(points))
    learned = [p for p in front if p.family == "learned"]
    old = [p.name for p in front if p.name in published]
    if not front:
        return "No volume solve beats the constant here."
    parts = [
        f"Among volume solves {_rungs(len(learned), 'lie')} on the Pareto front"
        + (", none as published" if not old else f", and so do, as published: {', '.join(old)}")
        + "."
    ]
    if not learned:
        parts = [f"No learned rung lies on the Pareto front; there lie {', '.join(p.name for p in front)}."]
    everyone = pareto_front([p for p in points if p.family not in _PROBES])
    traced = [p for p in everyone if p.family in ("path tracer", "Mitsuba 3")]
    kept = [p for p in everyone if p.family == "learned"]
    count = max(p.receivers for p in points)
    if traced and not kept:
        parts.append(f"For these {count} receivers tracing paths beats them all.")
    elif traced:
        parts.append(f"With path tracers in the race, {_rungs(len(kept), 'stay')} on it for these {count} receivers.")
    if probes := [p.name for p in pareto_front(points) if p.family in _PROBES]:
        parts.append(f"On the front of all methods: {'; '.join(probes)}.")
    return " ".join(parts)


def _rungs(count: int, verb: str) -> str:
    return f"1 learned rung {verb}s" if count == 1 else f"{count} learned rungs {verb}"
