"""Speed of propagation as ratios measured in one run: a step against conv3d, the adjoint against the forward.

    python benchmarks/propagation.py [--cells 32 64] [--stencils NAME ...] [--steps 32] [--repeats 5] [--device cpu|cuda]
        [--own-only] [--json OUT]

Peers: torch's conv3d with the equivalent linear weights (channels_last_3d; autograd through it in both layouts) and the best
vectorised torch formulation of clamp and occlusion that we know (a product to all face fluxes, clamp, occlusion, shifted
sums per lobe axis, a product back). A learned stencil is measured with occlusion between pairs of cells, against conv3d
without. Configurations take turns, so that the machine's drift hits all alike; medians are printed. The slow peers run fewer
times.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable

import torch

from difflpv.bench.peers import convolution, convolution_weight
from difflpv.bench.timing import interleaved
from difflpv.propagation import propagate
from difflpv.stencil import FaceStencil, LinearStencil, holpv_stencil, lpv_stencil
from difflpv.stencil_files import learned_stencil


def medians(calls: dict[str, Callable[[], object]], repeats: int, device: torch.device) -> dict[str, float]:
    """Median seconds of each call, taken in turns; those named "torch ..." run twice at most."""
    times = interleaved(calls, repeats, device=device, few=lambda name: name.startswith("torch"))
    return {name: timing.median for name, timing in times.items()}


def torch_faces(volume: torch.Tensor, stencil: FaceStencil, factors: torch.Tensor, passed: torch.Tensor) -> torch.Tensor:
    """Vectorised torch: fluxes of all faces by one product, clamp, occlusion; per lobe axis shifted sums, one product back."""
    weights = torch.tensor(stencil.flux_weights, dtype=volume.dtype, device=volume.device)
    axes = torch.tensor(stencil.lobe_axes)
    names = torch.unique(axes, dim=0)
    owner = [int((names == a).all(1).nonzero()) for a in axes]
    lobes = torch.stack([torch.tensor(stencil.lobes[owner.index(i)]) for i in range(len(names))]).to(volume)
    moving = total = volume
    size = volume.shape[2:]
    for factor in factors:
        flux = torch.relu(torch.einsum("fk,ckzyx->cfzyx", weights, moving)) * passed
        padded = torch.nn.functional.pad(flux, (1,) * 6)
        parts: list[list[torch.Tensor]] = [[] for _ in names]
        for f, (x, y, z) in enumerate(stencil.offsets.tolist()):
            window = padded[:, f, 1 - z : 1 - z + size[0], 1 - y : 1 - y + size[1], 1 - x : 1 - x + size[2]]
            parts[owner[f]].append(window)
        arrived = torch.stack([sum(p[1:], start=p[0]) for p in parts], 1)
        moving = factor * torch.einsum("ak,cazyx->ckzyx", lobes, arrived)
        total = total + moving
    return total


def measure_pairs(stencil: LinearStencil, cells: int, steps: int, repeats: int, device: torch.device) -> dict[str, float]:
    """A linear stencil with occlusion: its step against conv3d without, its gradients against its forward."""
    generator = torch.Generator().manual_seed(0)
    volume = torch.randn(3, (stencil.l_max + 1) ** 2, cells, cells, cells, generator=generator)
    cotangent = torch.randn(volume.shape, generator=generator).to(device)
    weight = convolution_weight(stencil).to(device, memory_format=torch.channels_last_3d)
    inputs = {
        "volume": volume.to(device),
        "matrices": torch.tensor(stencil.matrices, dtype=torch.float32, device=device),
        "factor": torch.full((steps,), 0.97, device=device),
        "transmittance": torch.rand(stencil.pair_count, cells, cells, cells, generator=generator).to(device),
    }

    def conv_forward() -> object:
        with torch.no_grad():
            return convolution(inputs["volume"], weight, inputs["factor"])

    def forward() -> object:
        with torch.no_grad():
            return propagate(stencil=stencil, steps=steps, **inputs)  # type: ignore[arg-type]

    def both(*learned: str) -> Callable[[], object]:
        def call() -> object:
            leaves = {name: t.clone().requires_grad_(name in learned) for name, t in inputs.items()}
            result = propagate(stencil=stencil, steps=steps, **leaves)  # type: ignore[arg-type]
            return torch.autograd.grad(result, [leaves[name] for name in learned], cotangent)

        return call

    kinds = {
        "light": ("volume",),
        "light, transmittance": ("volume", "transmittance"),
        "light, matrices, factors": ("volume", "matrices", "factor"),
        "all": tuple(inputs),
    }
    calls: dict[str, Callable[[], object]] = {"conv3d forward": conv_forward, "occlusion forward": forward}
    calls |= {f"occlusion both, {kind}": both(*learned) for kind, learned in kinds.items()}
    t = medians(calls, repeats, device)
    table = {f"{name} [ms]": 1e3 * seconds for name, seconds in t.items()}
    table["step with occlusion / conv3d"] = t["occlusion forward"] / t["conv3d forward"]
    for kind in kinds:
        table[f"forward+backward / forward, {kind}"] = t[f"occlusion both, {kind}"] / t["occlusion forward"]
    return table


def measure(
    stencil: FaceStencil, cells: int, steps: int, repeats: int, device: torch.device, own_only: bool
) -> dict[str, float]:
    """All ratios of one stencil at one size; ``own_only`` leaves out the torch peers, which take minutes at 64^3."""
    generator = torch.Generator().manual_seed(0)
    coeffs = (stencil.l_max + 1) ** 2
    volume = torch.randn(3, coeffs, cells, cells, cells, generator=generator)
    volume[:, 0] = volume[:, 0].abs() * 3
    passed = torch.rand(len(stencil.offsets), cells, cells, cells, generator=generator)
    weight = convolution_weight(stencil.linear_part)
    volume, passed, weight = volume.to(device), passed.to(device), weight.to(device)
    fast_weight = weight.contiguous(memory_format=torch.channels_last_3d)
    factors = torch.full((steps,), 0.97, device=device)
    cotangent = torch.randn(volume.shape, generator=generator).to(device)

    def forward(**options: object) -> Callable[[], object]:
        def call() -> object:
            with torch.no_grad():
                return propagate(volume, stencil, steps=steps, factor=factors, **options)  # type: ignore[arg-type]

        return call

    def both(solve: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]) -> Callable[[], object]:
        def call() -> object:
            light, learned = volume.clone().requires_grad_(), factors.clone().requires_grad_()
            return torch.autograd.grad(solve(light, learned), (light, learned), cotangent)

        return call

    def ours(**options: object) -> Callable[[], object]:
        return both(lambda v, p: propagate(v, stencil, steps=steps, factor=p, **options))  # type: ignore[arg-type]

    def conv_forward() -> object:
        with torch.no_grad():
            return convolution(volume, fast_weight, factors)

    calls: dict[str, Callable[[], object]] = {
        "conv3d forward": conv_forward,
        "torch autograd through conv3d": both(lambda v, p: convolution(v, fast_weight, p)),
        "torch autograd through conv3d, contiguous": both(lambda v, p: convolution(v, weight, p)),
        "linear on conv3d forward": forward(clamp=False, backend="conv3d"),
        "linear on conv3d both": ours(clamp=False, backend="conv3d"),
        "clamp forward": forward(),
        "clamp both": ours(),
        "clamp+occlusion forward": forward(transmittance=passed),
        "clamp+occlusion both": ours(transmittance=passed),
        "torch faces forward": lambda: torch_faces(volume, stencil, factors, passed),
        "linear forward": forward(clamp=False, backend="warp"),
        "linear both": ours(clamp=False, backend="warp"),
        "torch faces both": both(lambda v, p: torch_faces(v, stencil, p, passed)),
    }
    if own_only:
        calls = {name: call for name, call in calls.items() if not name.startswith("torch")}
    t = medians(calls, repeats, device)
    occluded = t["clamp+occlusion forward"]
    table = {f"{name} [ms]": 1e3 * seconds for name, seconds in t.items()}
    table |= {
        "step with clamp and occlusion / conv3d": occluded / t["conv3d forward"],
        "step with clamp / conv3d": t["clamp forward"] / t["conv3d forward"],
        "step, linear / conv3d": t["linear forward"] / t["conv3d forward"],
        "forward+backward / forward, linear on conv3d": t["linear on conv3d both"] / t["linear on conv3d forward"],
        "forward+backward / forward, linear": t["linear both"] / t["linear forward"],
        "forward+backward / forward, clamp": t["clamp both"] / t["clamp forward"],
        "forward+backward / forward, clamp and occlusion": t["clamp+occlusion both"] / occluded,
    }
    if not own_only:
        table |= {
            "autograd through conv3d / ours, linear": t["torch autograd through conv3d"] / t["linear both"],
            "autograd through conv3d / ours, clamp": t["torch autograd through conv3d"] / t["clamp both"],
            "  the same, contiguous layout / ours, clamp": t["torch autograd through conv3d, contiguous"] / t["clamp both"],
            "torch faces / ours, clamp and occlusion, forward": t["torch faces forward"] / occluded,
            "torch faces / ours, clamp and occlusion, both": t["torch faces both"] / t["clamp+occlusion both"],
        }
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, nargs="+", default=[32, 64])
    parser.add_argument("--stencils", nargs="+", help="only these of lpv, holpv, learned_9x26")
    parser.add_argument("--steps", type=int, default=32)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--own-only", action="store_true", help="leave out the slow torch peers")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    results = {}
    device = torch.device(arguments.device)
    for cells in arguments.cells:
        for stencil in (lpv_stencil(), holpv_stencil(), learned_stencil("learned_9x26")):
            if arguments.stencils and stencil.name not in arguments.stencils:
                continue
            if isinstance(stencil, LinearStencil):
                row = measure_pairs(stencil, cells, arguments.steps, arguments.repeats, device)
            else:
                row = measure(stencil, cells, arguments.steps, arguments.repeats, device, arguments.own_only)
            results[f"{stencil.name} {cells}"] = row
            print(f"{stencil.name} {cells}^3, {arguments.steps} steps, {torch.get_num_threads()} threads")
            for name, value in row.items():
                print(f"  {name:52s} {value:9.2f}", flush=True)
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump(results, file, indent=1)


if __name__ == "__main__":
    main()
