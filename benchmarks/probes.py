"""Ways of placing light probes, judged by points and lights that none of them has seen; writes docs/probes.md and its charts.

    python benchmarks/probes.py [--scenes cornell two_rooms_90 atrium PATH.obj ...] [--counts 16 64 256] [--seeds 3]
        [--pictured 64] [--methods NAME ...] [--targets out/probe_targets] [--folder out/probes] [--again] [--rejudge]
        [--out docs/probes.md]

Each scene has two folders of targets, SCENE (places) and SCENE_judge (judges), which are made where they are missing, as

    difflpv probes targets SCENE --lights moved:9 --count 8000 --spp 1024 --lattice-spp 128 --out SCENE
    difflpv probes targets SCENE --lights moved:4 --count 6000 --spp 2048 --lattice-spp 32 --seed 1 --out SCENE_judge

do. Every placement is a file in --folder, with its positions and what was judged: what lies there is not placed again, unless
method, options or targets have changed. Changes of the code are not noticed: ``--again`` places all the same, with
``--methods`` those alone; ``--rejudge`` judges the same positions anew. A line more in ``ENTRIES`` is a method more. A seed
draws the points that a method is shown, too, so that methods without chance in them have a spread as well.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from probes_page import chart_folder, write_page

from data_gen.probe_content import trace_probes
from data_gen.probe_targets import ProbeTargets, make_probe_targets
from difflpv.cli.output import jsonable
from difflpv.io import load_scene
from difflpv.io.atomic import write_bytes, write_json
from difflpv.io.png import shrink_png
from difflpv.placement.edge_rays import with_edge_rays
from difflpv.placement.from_targets import placement_task
from difflpv.placement.held_out import BakedContent, HeldOut
from difflpv.placement.judge import judge
from difflpv.placement.place import PLACEMENT_METHODS, place
from difflpv.placement.task import Placement
from difflpv.planning.lights import moved_light_sets
from difflpv.probes.probe_set import ProbeSet
from difflpv.probes.reader import ProbeReader
from difflpv.report.scene_figures import draw_pictures, probe_picture
from difflpv.scene import Scene

TRAIN_POINTS = 6000  # of those of the placing targets, drawn by the seed
USEFUL = 16  # probes, up to which solvers without derivatives get anywhere in 750 evaluations
SOLVED = "cornell"  # the scene that they are run in, with one seed, for time
PICTURED = ("uniform grid", "greedy removal", "ours, tetrahedra", "ours, footprints")
SEEDED = 64  # probes, up to which all seeds run; above, the first one alone, for time
WITH_EDGE_RAYS = 2 / 3  # share of the probes that a method places itself, where edge rays place the rest


@dataclass(frozen=True)
class Entry:
    """A line of the chart: a method with its options, and the content that it stands for in the comparison."""

    name: str
    method: str
    options: Mapping[str, Any] = field(default_factory=dict)
    content: BakedContent = "traced"
    most: int = 2**20  # probes, above which it is left out
    edge_rays: bool = False  # the last third by edge rays
    sight: bool = False  # points read only probes that they see


ENTRIES = (
    Entry("uniform grid", "grid"),
    Entry("grid out of solids", "grid_moved"),
    Entry("grid, edge rays", "grid", edge_rays=True),
    Entry("grid, read by sight", "grid", sight=True),
    Entry("spawn and merge", "spawn_merge"),
    Entry("spawn and merge, 8 corners", "spawn_merge_hierarchical"),
    Entry("irradiance ascent", "irradiance_ascent"),
    Entry("greedy removal", "greedy_removal"),
    Entry("SBPLX", "sbplx", most=USEFUL),
    Entry("CRS2", "crs2", most=USEFUL),
    Entry("BOBYQA", "bobyqa", most=USEFUL),
    Entry("CMA-ES", "cma", most=USEFUL),
    Entry("ours, tetrahedra", "gradient", {"interpolation": "tetrahedra"}, "fitted"),
    Entry("ours, footprints", "gradient", {"interpolation": "gaussian"}, "fitted"),
)


@dataclass(frozen=True)
class Bench:
    """A scene with its targets, and where its results lie."""

    scene: Scene
    placing: ProbeTargets
    held_out: HeldOut
    folder: Path
    again: bool = False
    rejudge: bool = False

    @property
    def digest(self) -> str:
        """Of the targets: other targets, other results."""
        files = [targets.manifest["files"] for targets in (self.placing, self.held_out.targets)]
        return hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()[:16]

    def result(self, entry: Entry, count: int, seed: int, *, tolerance: float | None = None) -> dict[str, Any]:
        """One placement and its judgements, from its file if it lies there."""
        options = dict(entry.options) | ({} if tolerance is None else {"tolerance": tolerance})
        run = {"options": options, "count": count, "seed": seed, "points": TRAIN_POINTS, "targets": self.digest}
        key = asdict(entry) | run
        del key["name"], key["content"], key["most"]
        slug = re.sub(r"\W+", "_", entry.name) + ("" if tolerance is None else "_tolerance")
        path = self.folder / slug / f"{count}_{seed}.json"
        kept = json.loads(path.read_text()) if path.exists() else None
        if self.again or kept is None or kept["key"] != jsonable(key):
            kept = {"key": key, "placed": self.place(entry, options, count, seed)}
        elif not self.rejudge:
            return kept
        kept |= self.judge(kept["placed"])
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, jsonable(kept))
        row = ", ".join(f"{content} {j['error']:.3f}" for content, j in kept["judged"].items())
        seconds = kept["placed"]["processor_seconds"]
        print(f"{self.scene.name}, {count} probes, seed {seed}: {entry.name}: {row} ({seconds:.0f} s)", flush=True)
        return kept

    def place(self, entry: Entry, options: dict[str, Any], count: int, seed: int) -> dict[str, Any]:
        """Positions, how they are read, and what placing took."""
        points = np.random.default_rng(seed).permutation(len(self.placing.points))[:TRAIN_POINTS]
        task = placement_task(self.scene, self.placing, points=points)
        start = time.process_time()
        first = round(WITH_EDGE_RAYS * count) if entry.edge_rays else count
        found: Placement = place(task, first, entry.method, seed=seed, **options)  # type: ignore[arg-type]
        if entry.edge_rays:
            found = with_edge_rays(task, found, count=count, rounds=3)
        reader = found.reader
        return {
            "position": found.position.tolist(),
            "metric": None if reader.metric is None else np.asarray(reader.metric).tolist(),
            "reader": {
                "interpolation": reader.interpolation, "neighbours": reader.neighbours, "sight": reader.sight or entry.sight,
            },
            "seconds": found.seconds,
            "processor_seconds": time.process_time() - start,
            "evaluations": found.evaluations,
            "history": [list(point) for point in found.history[:: max(1, len(found.history) // 50)]],
            "details": {name: value for name, value in found.details.items() if isinstance(value, (int, float, str, tuple))},
        }  # fmt: skip

    def judge(self, placed: dict[str, Any]) -> dict[str, Any]:
        """Judgements with either content."""
        position = np.array(placed["position"])
        metric = None if placed["metric"] is None else np.array(placed["metric"])
        reader = ProbeReader(metric=metric, **placed["reader"])
        held_out = self.held_out
        traced = held_out.traced(position)
        contents = {"traced": traced, "fitted": held_out.fitted(position, reader, traced)}
        judged = {
            name: judge(
                held_out.judge, position, reader, content, surface=held_out.surface, timed=name == "traced",
                seconds=placed["processor_seconds"],
            ).to_json()
            for name, content in contents.items()
        }  # fmt: skip
        return {"judged": judged, "in_solids": held_out.in_solids(position)}


def bench(name: str, targets: Path, folder: Path, *, workers: int, **options: bool) -> Bench:
    """A scene by name or path with its targets, which are made if missing."""
    scene = load_scene(name)
    placing = make_probe_targets(
        scene, targets / scene.name, count=8000, spp=1024, lattice_spp=128,
        light_sets=moved_light_sets(scene, 9), workers=workers,
    )  # fmt: skip
    judging = make_probe_targets(
        scene, targets / f"{scene.name}_judge", count=6000, spp=2048, lattice_spp=32,
        light_sets=moved_light_sets(scene, 4, seed=1), seed=1, workers=workers,
    )  # fmt: skip
    return Bench(scene, placing, HeldOut.of(scene, judging, placing), folder / scene.name, **options)


def placed_picture(scene: Bench, results: dict[str, Any], names: list[str], count: int) -> bytes:
    """Where probes stand, each lit by the scene's own lights, for a few entries side by side."""
    pictures, titles = [], []
    for name in names:
        result = results[name][str(count)][0]
        position = np.array(result["placed"]["position"])
        content = trace_probes(scene.scene, position, component=scene.placing.component, progress=False).mean[0]
        pictures.append(probe_picture(scene.scene, ProbeSet(position, content)))
        error = result["judged"][next(e.content for e in ENTRIES if e.name == name)]["error"]
        titles.append(f"{name}: {len(position)} probes, error {error:.3f}")
    return shrink_png(draw_pictures(pictures, titles), colors=128)


def tolerances(scene: Bench, results: dict[str, Any], counts: list[int]) -> list[dict[str, Any]]:
    """How few of our probes meet the error that the uniform grid of so many probes is judged with."""
    rows = []
    for entry in (e for e in ENTRIES if e.method == "gradient" and e.method in PLACEMENT_METHODS):
        for count in counts:
            grid = results["uniform grid"][str(count)]
            wanted = float(np.mean([r["judged"]["traced"]["error"] for r in grid]))
            found = scene.result(entry, count, 0, tolerance=wanted)
            judged = found["judged"][entry.content]
            placed = float(np.mean([r["judged"]["traced"]["count"] for r in grid]))
            rows.append(
                {"name": entry.name, "grid": placed, "wanted": wanted, "count": judged["count"], "error": judged["error"]}
            )
    return rows


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["cornell", "two_rooms_90", "atrium"], metavar="SCENE")
    parser.add_argument("--counts", nargs="+", type=int, default=[16, 64, 256])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--methods", nargs="+", choices=PLACEMENT_METHODS, default=list(PLACEMENT_METHODS), metavar="NAME")
    parser.add_argument("--tolerance-counts", nargs="*", type=int, default=[64], help="grids whose error ours has to meet")
    parser.add_argument("--pictured", type=int, default=64, help="number of probes in the pictures")
    parser.add_argument("--targets", type=Path, default=Path("out/probe_targets"))
    parser.add_argument("--folder", type=Path, default=Path("out/probes"))
    parser.add_argument("--workers", type=int, default=2, help="processes that trace targets")
    parser.add_argument("--again", action="store_true", help="place what lies in --folder, too")
    parser.add_argument("--rejudge", action="store_true", help="judge what lies in --folder, too")
    parser.add_argument("--out", type=Path, help="the document whose generated part is written, charts beside it")
    args = parser.parse_args(argv)
    if args.out and "grid" not in args.methods:
        parser.error("--out: needs the method 'grid', which others are compared with")
    torch.set_num_threads(1)
    scenes = [
        bench(name, args.targets, args.folder, workers=args.workers, again=args.again, rejudge=args.rejudge)
        for name in args.scenes
    ]
    entries = [entry for entry in ENTRIES if entry.method in args.methods]
    results: dict[str, Any] = {scene.scene.name: {} for scene in scenes}
    for seed in range(args.seeds):  # a whole comparison first, then its spread
        for scene in scenes:
            for count in (c for c in args.counts if seed == 0 or c <= SEEDED):
                for entry in (e for e in entries if count <= e.most):
                    if entry.most == USEFUL and (seed, scene.scene.name) != (0, SOLVED):
                        continue
                    by_count = results[scene.scene.name].setdefault(entry.name, {})
                    by_count.setdefault(str(count), []).append(scene.result(entry, count, seed))
    if args.out:
        pictured = args.pictured if args.pictured in args.counts else args.counts[0]
        for scene in (s for s, name in zip(scenes, args.scenes, strict=True) if name == s.scene.name):  # others' are not ours
            names = [name for name in PICTURED if str(pictured) in results[scene.scene.name].get(name, {})]
            picture = placed_picture(scene, results[scene.scene.name], names, pictured)
            write_bytes(chart_folder(args.out) / f"{scene.scene.name}.png", picture)
        wanted = [count for count in args.tolerance_counts if count in args.counts]
        write_page(
            args.out,
            _command(args),
            results,
            {
                entry.name: {"method": entry.method, "content": entry.content, "variant": entry.edge_rays or entry.sight}
                for entry in entries
            },
            {s.scene.name: tolerances(s, results[s.scene.name], wanted) for s in scenes}
            if "gradient" in args.methods else {},
            {
                s.scene.name: {
                    "noise": s.held_out.noise, "points": len(s.held_out.judge.points), "fit": len(s.held_out.fit.points),
                    "lights": len(s.held_out.lights), "placing_lights": len(s.placing.light_sets),
                }
                for s in scenes
            },
        )  # fmt: skip
        print(f"-> {args.out}")


def _command(args: argparse.Namespace) -> str:
    """What makes the document anew, without the folders of this machine."""
    scenes = " ".join(Path(name).name for name in args.scenes)
    counts = " ".join(map(str, args.counts))
    return f"python benchmarks/probes.py --scenes {scenes} --counts {counts} --seeds {args.seeds} --out docs/probes.md"


if __name__ == "__main__":
    main()
