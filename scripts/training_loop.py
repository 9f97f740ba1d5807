"""Your own training loop: an ``Lpv`` is a torch module, so any torch optimiser and any loss of yours will do.

    difflpv targets cornell --lights bundled --light 0-4 --receivers 1000 --component bounce1 --out out/targets
    python scripts/training_loop.py cornell out/targets --out out/loop

Learns one propagation factor per step, with a penalty of its own on factors that jump from one step to the next.
"""

import argparse
from pathlib import Path

import torch

from data_gen.load import load_targets
from difflpv.config import LpvConfig, grid_for
from difflpv.illumination import illuminate
from difflpv.io import load_scene
from difflpv.lights import apply_light_set
from difflpv.loss import relative_l2
from difflpv.pipeline import Lpv


def main(argv=None):
    """Run with the arguments ``argv``; returns the losses, one per epoch."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", help="scene file or bundled name")
    parser.add_argument("targets", type=Path, help="folder from 'difflpv targets' with component bounce1")
    parser.add_argument("--out", type=Path, default=Path("out/training_loop"), help="folder for the model")
    parser.add_argument("--cells", type=int, default=32, help="cells along x")
    parser.add_argument("--steps", type=int, default=32, help="propagation steps")
    parser.add_argument("--epochs", type=int, default=30, help="passes over all lights")
    args = parser.parse_args(argv)

    scene, targets = load_scene(args.scene), load_targets(args.targets)
    targets.check_scene(scene)
    grid, config = grid_for(scene, args.cells), LpvConfig(method="holpv", steps=args.steps, occlusion="exp")
    batches = []
    for light in targets.lights:
        illumination = illuminate(apply_light_set(scene, light.entries), grid, config, "bounce1")  # rays are cast here, once
        receivers = illumination.receivers(targets.receivers.position, targets.receivers.normal)
        truth, weight = (torch.tensor(a).float() for a in (light.irradiance["bounce1"], light.area_weight))
        batches.append((illumination, receivers, truth, weight))

    lpv = Lpv(grid, config, learn=("propagation_steps", "occlusion", "sampling_bias"))
    optimizer = torch.optim.Adam(lpv.parameters(), lr=0.05)
    losses = []
    for epoch in range(args.epochs):
        total = 0.0
        for illumination, receivers, truth, weight in batches:
            error = relative_l2(lpv(illumination, receivers), truth, weight)
            roughness = lpv.values()["propagation_steps"].diff().square().sum()
            optimizer.zero_grad()
            (error + 0.1 * roughness).backward()
            optimizer.step()
            total += error.item() / len(batches)
        losses.append(total)
        print(f"epoch {epoch}: relative L2 {total:.4f}")
    lpv.save(args.out)
    return losses


if __name__ == "__main__":
    main()
