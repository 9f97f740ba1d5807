"""Lookups of receivers in a volume, forward and backward, against the same in torch and with a volume's numbers far apart.

    python benchmarks/lookups.py [--cells 32] [--points 1000 10000 100000] [--repeats 5]

Each point reads 27 cells around it at random places, four in ten with weight zero, as the affine lookup of the bundled scenes
has it. "torch" is ``embedding_bag`` over rows of cells and a product with the lobes, its gradients those of autograd; "apart"
are the Warp kernels on the volume as it is. CPU time of one thread, for the machine is shared; the best of the repeats, taken
in turns; ratios to ours.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable
from contextlib import nullcontext
from unittest import mock

import torch
from probes_lookup import best_seconds

from difflpv import weighted
from difflpv.weighted import gather_lobes

AROUND = torch.tensor(list(itertools.product((-1, 0, 1), repeat=3)))


def in_torch(volume: torch.Tensor, cells: torch.Tensor, weights: torch.Tensor, lobes: torch.Tensor) -> torch.Tensor:
    """``gather_lobes`` with torch's own operators."""
    rows = volume.flatten(2).flatten(0, 1).t().contiguous()
    held = torch.nn.functional.embedding_bag(cells, rows, per_sample_weights=weights, mode="sum")
    return torch.einsum("nck,nk->nc", held.view(len(cells), *volume.shape[:2]), lobes)


def problem(cells: int, points: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Volume, cells, weights and lobes."""
    generator = torch.Generator().manual_seed(points)
    volume = torch.rand(3, 9, cells, cells, cells, generator=generator)
    home = torch.randint(1, cells - 1, (points, 1, 3), generator=generator) + AROUND
    listed = (home[..., 2] * cells + home[..., 1]) * cells + home[..., 0]
    weights = torch.rand(points, 27, generator=generator) * (torch.rand(points, 27, generator=generator) > 0.4)
    return volume, listed.int(), weights, torch.randn(points, 9, generator=generator)


def calls_of(
    read: Callable[..., torch.Tensor], volume: torch.Tensor, cells: torch.Tensor, weights: torch.Tensor, lobes: torch.Tensor,
    *, turns: bool = True,
) -> dict[str, Callable[[], object]]:  # fmt: skip
    """Forward, and forward + backward of the volume, and of volume and lobes; ``turns``: it may turn the volume."""

    def call_of(*learned: bool) -> Callable[[], object]:
        light, read_with = (t.clone().requires_grad_(need) for t, need in zip((volume, lobes), learned, strict=True))

        def call() -> None:
            with nullcontext() if turns else mock.patch.object(weighted, "_turning_pays", lambda *_: False):
                result = read(light, cells, weights, read_with)
                if any(learned):
                    result.sum().backward()

        return call

    return {
        "forward": call_of(False, False),
        "and backward to the volume": call_of(True, False),
        "to volume and lobes": call_of(True, True),
    }


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=32)
    parser.add_argument("--points", type=int, nargs="+", default=[1000, 10_000, 100_000])
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    print("| points | | ours [ms] | torch / ours | apart / ours |\n|---|---|---|---|---|")
    for points in args.points:
        given = problem(args.cells, points)
        ways = (calls_of(gather_lobes, *given), calls_of(in_torch, *given), calls_of(gather_lobes, *given, turns=False))
        calls = {f"{i} {name}": call for i, way in enumerate(ways) for name, call in way.items()}
        best = best_seconds(calls, args.repeats)
        for name in ways[0]:
            ours, in_torchs, apart = (best[f"{i} {name}"] for i in range(len(ways)))
            print(f"| {points:,} | {name} | {ours * 1e3:.2f} | {in_torchs / ours:.1f} | {apart / ours:.1f} |", flush=True)


if __name__ == "__main__":
    main()
