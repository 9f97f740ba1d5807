"""Timings that the theses printed, with their hardware: frames of a renderer, not solves of ours."""

from __future__ import annotations

from collections.abc import Sequence

from difflpv.bench.measure import Point

__all__ = ["published_tables"]

# Martin 2012, Table 5.1: scene, resolution, steps, occlusion, LPV and HOLPV frame time [ms]; our scene beside it.
_HOLPV = (
    ("Diagonal Propagation", "900x900", 20, "no", 6.0, 48.0, "diagonal/direct"),
    ("Sponza Hallway", "1024x768", 8, "yes", 49.0, 102.7, "atrium/bounce1"),
    ("Stanford Bunny", "900x900", 10, "no", 5.9, 26.6, "bunny/bounce1"),
    ("Sponza Planter", "1024x768", 8, "yes", 49.0, 99.0, "planter/bounce1"),
    ("Cornell Box", "900x900", 16, "yes", 9.9, 174.0, "cornell/bounce1"),
)
# Octree thesis, Table 1: part, octree and uniform average per call [ms]; None is not printed.
_OCTREE = (
    ("Frame", 106, 115),
    ("GVInject", 10, 10),
    ("LPVInject", 13, 15),
    ("LPVPropagate", 7, 18),
)
_OURS = ("LPV as published", "HOLPV as published", "learned_9x26")


def published_tables(points: Sequence[Point], machine: str) -> str:
    """Both tables as Markdown, our solves (32 steps) beside them.

    Args:
        points: what was measured.
        machine: processor and threads of these.
    """
    by_key = {(p.scene, p.name): p for p in points}

    def ours(scene: str) -> str:
        found = [by_key.get((scene, name)) for name in _OURS]
        return " | ".join("" if p is None or p.seconds is None else f"{1e3 * p.seconds:.0f}" for p in found)

    lines = [
        "Martin 2012 (HOLPV), Table 5.1: whole frames on an NVIDIA GTX 460 with an AMD X6 1055T, 32³ cells, 16-bit floats.",
        f"Beside it our solve with its lookup, 32³ cells, 32 steps, RGB in float32, on {machine}. A frame also draws the",
        "picture and the reflective shadow map; ours does not. The comparison is one of magnitude.",
        "",
        "| scene | image | steps | occlusion | LPV frame [ms] | HOLPV frame [ms] | our LPV [ms] | our HOLPV [ms] | "
        "learned_9x26 [ms] |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, image, steps, blocked, lpv, holpv, scene in _HOLPV:
        lines.append(f"| {name} | {image} | {steps} | {blocked} | {lpv} | {holpv} | {ours(scene)} |")
    lines += [
        "",
        "Octree thesis, Table 1: averages per call on an NVIDIA GeForce GTX 480, 18 reflective shadow maps; 16 iterations on",
        "the uniform grid, 4 on the octree.",
        "",
        "| part | octree [ms] | uniform [ms] |",
        "|---|---|---|",
        *(f"| {part} | {octree} | {uniform} |" for part, octree, uniform in _OCTREE),
    ]
    return "\n".join(lines)
