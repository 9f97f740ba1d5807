"""Lookups of light probes: points per second of CPU time on one thread, against scipy and the torch twins, and jumps at flips.

    python benchmarks/probes_lookup.py [--probes 16 64 256 1024] [--points 200000] [--repeats 5] [--dtype float32|float64]
        [--scenes NAME ...] [--json OUT]

Probes and points are uniform in a box, the probes' hull reaching its corners ("inside") or not ("mixed": some points lie
outside and take the closest point of the hull). "cold": each walk starts in the first tetrahedron; "hinted": near where the
same point was found last, after a move of 1 % of the box. A full lookup is locating, weighing and the irradiance of one normal
from 9 x RGB. Gaussian footprints, 8 neighbours: round ones, and "skewed" ones (a random matrix added, its entries 0.3 of the
round one's); nothing is kept from call to call. CPU time, because this machine is shared; the best of the repeats, taken in
turns. Sight: in a bundled scene, 64 probes and 4,000 receivers at random; the share of weight on probes that a ray shows to be
blocked, before and after weights by sight.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import Delaunay

from difflpv.io import load_scene
from difflpv.probes.flips import flip_jumps
from difflpv.probes.gaussian import GaussianInterpolation, isotropic_metric
from difflpv.probes.lookup import probe_irradiance
from difflpv.probes.rows import Interpolation
from difflpv.probes.tetrahedra import Tetrahedra, TetrahedralInterpolation
from difflpv.probes.visible import Sight, VisibleInterpolation
from difflpv.raycast import Raycaster
from difflpv.reference.gaussian import dense_footprint_weights
from difflpv.reference.tetrahedra import dense_weights

TWIN_POINTS = 500  # the twin tries every tetrahedron
CORNERS = np.array(list(itertools.product((0.0, 1.0), repeat=3)))


def best_seconds(calls: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """CPU seconds of each call, the best of several taken in turns after a warm-up."""
    best = dict.fromkeys(calls, np.inf)
    for number in range(repeats + 1):
        for name, call in calls.items():
            start = time.process_time()
            call()
            if number:
                best[name] = min(best[name], time.process_time() - start)
    return best


def lookups(probes: int, points: int, repeats: int, dtype: torch.dtype, *, inside: bool) -> dict[str, float]:
    """Million points per second of each way, and milliseconds to triangulate."""
    rng = np.random.default_rng(probes)
    x = np.concatenate([CORNERS, rng.random((probes - 8, 3))]) if inside else rng.random((probes, 3))
    read = rng.random((points, 3))
    position, here = torch.as_tensor(x, dtype=dtype), torch.as_tensor(read, dtype=dtype)
    there = torch.as_tensor(np.clip(read + rng.normal(size=read.shape) * 0.01, 0, 1), dtype=dtype)
    normals = torch.nn.functional.normalize(torch.as_tensor(rng.normal(size=read.shape), dtype=dtype), dim=1)
    radiance = torch.as_tensor(rng.random((probes, 9, 3)), dtype=dtype)
    scipys = Delaunay(x)
    places = itertools.cycle((there, here))

    def cold() -> object:
        grid.forget()
        return grid.rows(position, here)

    def full() -> object:
        grid.forget()
        return probe_irradiance(grid.rows(position, here), radiance, normals)

    grid = TetrahedralInterpolation(position)
    vertices, hull = (torch.as_tensor(t) for t in (grid.tetrahedra.vertices, grid.tetrahedra.hull))
    few = torch.as_tensor(read[:TWIN_POINTS])
    hinted = TetrahedralInterpolation(position)
    metric = isotropic_metric(position)
    noise = torch.as_tensor(rng.normal(size=metric.shape), dtype=dtype)
    skewed = metric + 0.3 * metric.amax((1, 2), keepdim=True) * noise
    footprints = {"gaussian": GaussianInterpolation(metric), "skewed gaussian": GaussianInterpolation(skewed)}
    calls: dict[str, Callable[[], object]] = {
        "cold rows": cold,
        "hinted rows": lambda: hinted.rows(position, next(places)),
        "cold full lookup": full,
        "hinted full lookup": lambda: probe_irradiance(hinted.rows(position, next(places)), radiance, normals),
        "scipy find_simplex": lambda: scipys.find_simplex(read),
    }
    for name, reader in footprints.items():
        calls[f"{name} rows"] = lambda reader=reader: reader.rows(position, here)
        calls[f"{name} full lookup"] = lambda reader=reader: probe_irradiance(reader.rows(position, here), radiance, normals)
    rates = {name: points / s / 1e6 for name, s in best_seconds(calls, repeats).items()}
    (twin,) = best_seconds({"twin": lambda: dense_weights(torch.as_tensor(x), few, vertices, hull)}, 1).values()
    made = best_seconds({"ours": lambda: Tetrahedra.of(x), "scipy": lambda: Delaunay(x)}, repeats)
    rates["torch twin"] = TWIN_POINTS / twin / 1e6
    (twin,) = best_seconds({"twin": lambda: dense_footprint_weights(position, skewed, here[:TWIN_POINTS], 8)}, 1).values()
    rates["gaussian torch twin"] = TWIN_POINTS / twin / 1e6
    return rates | {"triangulate ms": made["ours"] * 1e3, "scipy Delaunay ms": made["scipy"] * 1e3}


def optimiser_step(probes: int, points: int, repeats: int) -> dict[str, float]:
    """Milliseconds of rows and of their gradient in float64: triangulated anew in each call, held, or by footprints."""
    rng = np.random.default_rng(probes)
    x, read = rng.random((probes, 3)), torch.as_tensor(rng.random((points, 3)))
    result = {}
    metric = isotropic_metric(torch.as_tensor(x)).requires_grad_()
    readers: dict[str, Interpolation] = {
        "fresh": TetrahedralInterpolation(x),
        "held": TetrahedralInterpolation(x, connectivity="held"),
        "gaussian": GaussianInterpolation(metric),
    }
    for kind, reader in readers.items():
        forward, backward = [], []
        for _ in range(repeats + 1):
            position = torch.as_tensor(x + rng.normal(size=x.shape) * 1e-4).requires_grad_()
            start = time.process_time()
            weight = reader.rows(position, read).weight
            middle = time.process_time()
            weight.square().sum().backward()
            forward.append(middle - start)
            backward.append(time.process_time() - middle)
        result |= {f"{kind} rows ms": min(forward[1:]) * 1e3, f"{kind} gradient ms": min(backward[1:]) * 1e3}
    return result


def flips(probes: int) -> dict[str, float]:
    """The jump where tetrahedra change, beside a step of 0.1 % and 1 % of the mean distance between probes."""
    rng = np.random.default_rng(probes)
    x, read = np.concatenate([CORNERS, rng.random((probes - 8, 3))]), rng.random((2000, 3))
    lamp = np.array([0.3, 0.7, 1.2])
    radiance = np.zeros((probes, 9, 3))
    toward = lamp - x
    radiance[:, 0] = (1 / (toward**2).sum(1))[:, None]  # the fall-off of a lamp above the box
    radiance[:, [3, 1, 2]] = radiance[:, :1] * (toward / np.linalg.norm(toward, axis=1, keepdims=True))[:, :, None]
    spacing = probes ** (-1 / 3)
    return {
        f"{name} at {share:.1%}": value
        for share in (0.001, 0.01)
        for name, value in flip_jumps(x, radiance, read, length=share * spacing, steps=200).summary.items()
    }


def sight(name: str) -> dict[str, float]:
    """What weights by sight take from blocked probes, how often they agree with a ray, and what they cost in a step."""
    scene, rng = load_scene(name), np.random.default_rng(0)
    raycaster, (low, high) = Raycaster(scene), scene.bounds
    x, read = rng.uniform(low, high, (64, 3)), rng.uniform(low, high, (4000, 3))
    position, points = torch.as_tensor(x), torch.as_tensor(read)
    inner = TetrahedralInterpolation(position)
    eyes = Sight(scene, raycaster=raycaster)
    seeing = VisibleInterpolation(inner, eyes)
    plain = inner.rows(position, points)
    pairs = np.repeat(read, 4, axis=0), x[plain.probe.numpy()].reshape(-1, 3)
    blocked = torch.as_tensor(raycaster.blocked(*pairs, shortened=False).reshape(-1, 4))
    counted = plain.weight > 1e-3
    lit = (~blocked & (plain.weight > 0.05)).any(1)
    weight = seeing.rows(position, points).weight
    agree = (eyes.visibility(position, points, plain.probe) > 0.5) != blocked
    steps = []
    for k in range(6):
        moved = (position + 0.001 * k).requires_grad_()
        start = time.process_time()
        seeing.rows(moved, points).weight.square().sum().backward()
        steps.append(time.process_time() - start)
    return {
        "blocked weight": float((plain.weight * blocked).sum(1).mean()),
        "by sight": float((weight * blocked).sum(1).mean()),
        "by sight, where a probe is seen": float((weight * blocked).sum(1)[lit].mean()),
        "agrees with a ray": float(agree[counted].double().mean()),
        "rows and gradient ms": min(steps) * 1e3,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--probes", type=int, nargs="+", default=[16, 64, 256, 1024])
    parser.add_argument("--points", type=int, default=200_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--dtype", choices=("float32", "float64"), default="float32")
    parser.add_argument("--scenes", nargs="*", default=["two_rooms_90", "atrium"])
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    results: dict[str, dict[str, float]] = {}
    for count in arguments.probes:
        for inside in (True, False):
            name = f"{count} probes, {'inside' if inside else 'mixed'}"
            dtype = getattr(torch, arguments.dtype)
            results[name] = lookups(count, arguments.points, arguments.repeats, dtype, inside=inside)
            print(f"{name} [million points / s]: " + ", ".join(f"{k} {v:.3g}" for k, v in results[name].items()), flush=True)
    for count in arguments.probes:
        for points in (1000, 8000):
            name = f"step, {count} probes, {points} points"
            results[name] = optimiser_step(count, points, arguments.repeats)
            print(f"{name}: " + ", ".join(f"{k} {v:.2f}" for k, v in results[name].items()), flush=True)
    for count in arguments.probes:
        name = f"flips, {count} probes"
        results[name] = flips(count)
        print(f"{name}: " + ", ".join(f"{k} {v:.3g}" for k, v in results[name].items()), flush=True)
    for name in arguments.scenes:
        results[f"sight, {name}"] = sight(name)
        print(f"sight, {name}: " + ", ".join(f"{k} {v:.3g}" for k, v in results[f"sight, {name}"].items()), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
