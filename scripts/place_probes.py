"""Place light probes in the Cornell box by gradients, and judge them beside a uniform grid on points and lights of their own.

    python scripts/place_probes.py --out out/place_probes

Copy it, then change the scene, the lights, the number of probes or the method.
"""

import argparse
from pathlib import Path

from data_gen.probe_targets import make_probe_targets
from difflpv.io import load_scene
from difflpv.placement.content import probe_record
from difflpv.placement.from_targets import placement_task
from difflpv.placement.held_out import HeldOut
from difflpv.placement.judge import judge
from difflpv.placement.place import place
from difflpv.planning.lights import moved_light_sets
from difflpv.probes.probe_files import save_probes


def main(argv=None):
    """Run with the arguments ``argv``; returns how each way of placing was judged, by name."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/place_probes"), help="folder for targets and probes")
    parser.add_argument("--count", type=int, default=64, help="probes")
    parser.add_argument("--steps", type=int, default=300, help="of descent")
    how = "how points read probes: as engines do, or by fitted footprints"
    parser.add_argument("--interpolation", choices=("tetrahedra", "gaussian"), default="tetrahedra", help=how)
    parser.add_argument("--points", type=int, default=4000, help="where the truth is path-traced")
    parser.add_argument("--spp", type=int, default=1024, help="paths per point")
    parser.add_argument("--cells", type=int, default=24, help="of the field along the longest edge")
    args = parser.parse_args(argv)

    scene = load_scene("cornell")
    common = {"count": args.points, "spp": args.spp, "lattice_spp": max(args.spp // 4, 1), "cells": args.cells, "workers": 2}
    # The first light set is the scene's own in both; it places and does not judge.
    placing = make_probe_targets(scene, args.out / "placing", light_sets=moved_light_sets(scene, 5, seed=0), **common)
    judging = make_probe_targets(scene, args.out / "judging", light_sets=moved_light_sets(scene, 4, seed=1), seed=1, **common)
    held_out = HeldOut.of(scene, judging, placing)

    task, found = placement_task(scene, placing), {}
    ours = {"interpolation": args.interpolation, "steps": args.steps}
    ours["checkpoint"] = args.out / f"{args.interpolation}.pt"  # the same command goes on where it was stopped
    for method, options in (("grid", {}), ("gradient", ours)):
        placement = place(task, args.count, method, **options)
        traced = held_out.traced(placement.position, spp=args.spp, workers=2)  # what the probes hold under the judging lights
        content = held_out.fitted(placement.position, placement.reader, traced)
        found[method] = judge(
            held_out.judge, placement.position, placement.reader, content, surface=held_out.surface, seconds=placement.seconds
        )
        save_probes(args.out / method, probe_record(task, placement))
        j = found[method]
        print(
            f"{method:9} {j.count} probes, error {j.error:.3f}, 95th percentile {j.p95:.3f}, leak {j.leak:.3f}, "
            f"placed in {j.seconds:.1f} s"
        )
    print(f"gradient / grid: {found['gradient'].error / found['grid'].error:.2f}; noise of the truth {held_out.noise:.3f}")
    return found


if __name__ == "__main__":
    main()
