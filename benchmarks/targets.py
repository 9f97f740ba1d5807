"""Speed of the path tracer: rays per second, and seconds until the mean standard error of ``full`` is 1 % of the mean.

python benchmarks/targets.py [--scene cornell] [--receivers 4000] [--workers 2] [--error 0.01]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from data_gen.components import Components
from data_gen.estimators import irradiance_block
from data_gen.pathtracer import PathTracer
from data_gen.receivers import draw_receivers
from data_gen.targets import make_targets
from difflpv.io import load_scene


def main(argv: list[str] | None = None) -> None:
    """Print one line per measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="cornell", help="scene file or bundled scene (default: cornell)")
    parser.add_argument("--receivers", type=int, default=4000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--error", type=float, default=0.01, help="share of the mean (default: 0.01)")
    options = parser.parse_args(argv)
    scene = load_scene(options.scene)

    start = time.perf_counter()
    receivers = draw_receivers(scene, options.receivers)
    print(f"{scene.name}: {options.receivers} receivers drawn in {time.perf_counter() - start:.2f} s")

    tracer, part = PathTracer(scene), slice(0, 256)
    start = time.perf_counter()
    for number in range(4):
        irradiance_block(
            tracer,
            receivers.position[part],
            receivers.normal[part],
            Components.of(["direct", "bounce1", "full"]),
            samples=16,
            seed=0,
            address=(0,),
            round=number,
        )
    seconds = time.perf_counter() - start
    print(f"one process: {tracer.rays / seconds / 1e6:.2f} M rays/s ({tracer.rays / 1e6:.1f} M rays in {seconds:.2f} s)")

    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        targets = make_targets(
            scene,
            Path(folder) / "targets",
            receiver_count=options.receivers,
            target_error=options.error,
            workers=options.workers,
        )
        seconds = time.perf_counter() - start
    light = targets.manifest["lights"][0]
    print(
        f"direct, bounce1, full with {options.workers} workers: standard error {100 * light['error']['full']:.2f} % of "
        f"the mean after {light['spp']} paths a receiver, {targets.manifest['rays'] / 1e6:.1f} M rays, {seconds:.1f} s "
        f"({targets.manifest['rays'] / seconds / 1e6:.2f} M rays/s)"
    )


if __name__ == "__main__":
    main()
