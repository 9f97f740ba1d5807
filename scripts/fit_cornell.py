"""Fit HOLPV's factors to the Cornell box by gradients, and judge them on lights that they were not fitted to.

    python scripts/fit_cornell.py --out out/fit_cornell

Copy it, then change the scene, what is learned, the solver or the split.
"""

import argparse
from pathlib import Path

from data_gen.targets import make_targets
from difflpv.config import LpvConfig, grid_for
from difflpv.evaluate import format_scores
from difflpv.fit import fit, light_target
from difflpv.io import load_scene
from difflpv.lights import load_light_sets


def main(argv=None):
    """Run with the arguments ``argv``; returns the outcome of the fit."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/fit_cornell"), help="folder for targets and model")
    parser.add_argument("--receivers", type=int, default=1000, help="points where the truth is path-traced")
    parser.add_argument("--spp", type=int, default=2048, help="paths per receiver")
    parser.add_argument("--cells", type=int, default=32, help="cells along an edge of the grid")
    parser.add_argument("--steps", type=int, default=32, help="propagation steps")
    parser.add_argument("--budget", type=float, default=60, help="forward-equivalents, one being a solve of all train lights")
    args = parser.parse_args(argv)

    scene = load_scene("cornell")
    targets = make_targets(
        scene,
        args.out / "targets",
        receiver_count=args.receivers,
        components=["bounce1"],
        spp=args.spp,
        light_sets=load_light_sets(None, "cornell"),
        workers=2,
    )
    config = LpvConfig(method="holpv", steps=args.steps, occlusion="exp")
    lights = [
        light_target(
            scene,
            light.entries,
            grid_for(scene, args.cells),
            config,
            "bounce1",
            index=light.index,
            position=targets.receivers.position,
            normal=targets.receivers.normal,
            irradiance=light.irradiance["bounce1"],
            weight=light.area_weight,
        )
        for light in targets.lights
    ]
    train, test = range(5), range(5, 8)
    learn = ("propagation", "occlusion", "sampling_bias")
    outcome = fit(scene, lights, config=config, learn=learn, train=train, test=test, solver="lbfgs", budget=args.budget)
    outcome.lpv.save(args.out / "fitted")

    print(outcome.result.message)
    print({name: round(float(value), 4) for name, value in outcome.result.parameters.items()})
    print("train lights", format_scores(outcome.mean_scores(train)), sep="\n")
    print("test lights", format_scores(outcome.mean_scores(test)), sep="\n")
    return outcome


if __name__ == "__main__":
    main()
