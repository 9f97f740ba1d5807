"""Does a stencil let light grow? Von Neumann analysis of linear stencils, and how positive the light they make is.

Over an endless grid a step multiplies the field e^{ik.x} v by the symbol A(k) = sum_n A_n e^{-ik.n}, so that no field grows
if and only if the spectral radius of A(k) stays at or below 1 for every wave vector k. At k = 0 the l=0 gain of a conserving
stencil is an eigenvalue 1 itself; growth faster than rounding begins above 1 + ``TOLERANCE``.

Source: Charney, Fjortoft and von Neumann 1950, in the form for systems of Lax and Richtmyer 1956.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from difflpv.propagation import propagate
from difflpv.sh import cosine_lobe
from difflpv.stencil import FaceStencil, LinearStencil
from difflpv.symmetry import asymmetry

__all__ = ["TOLERANCE", "StabilityReport", "negative_share", "spectral_radius", "stability", "symbol"]

TOLERANCE = 1e-6
_SAMPLES, _SEEDS, _ROUNDS = 13, 6, 14


@dataclass(frozen=True)
class StabilityReport:
    """Result of ``stability``.

    Attributes:
        radius: largest spectral radius of the symbol over all wave vectors.
        wave_vector: where it is reached [rad per cell] (x, y, z).
        uniform_gain: l=0 gain of one step in a field that is the same everywhere.
        stable: ``radius`` is at most 1 + ``TOLERANCE``.
        advice: what that means and what to do, in words.
    """

    radius: float
    wave_vector: tuple[float, float, float]
    uniform_gain: float
    stable: bool
    advice: str


def _linear(stencil: LinearStencil | FaceStencil) -> LinearStencil:
    return stencil.linear_part if isinstance(stencil, FaceStencil) else stencil


def symbol(stencil: LinearStencil | FaceStencil, wave_vectors: np.ndarray) -> np.ndarray:
    """Fourier symbol A(k) = sum_n A_n exp(-i k.n) of a stencil without its clamp.

    Args:
        stencil: any stencil.
        wave_vectors: k [rad per cell], shape [m,3].

    Returns:
        Shape [m,K,K] complex128.
    """
    linear = _linear(stencil)
    phases = np.exp(-1j * np.asarray(wave_vectors, dtype=float) @ np.asarray(linear.offsets, dtype=float).T)
    return np.tensordot(phases, np.asarray(linear.matrices, dtype=float), 1)


def spectral_radius(stencil: LinearStencil | FaceStencil, wave_vectors: np.ndarray) -> np.ndarray:
    """Largest modulus of the symbol's eigenvalues at each wave vector [m,3], shape [m]."""
    return np.abs(np.linalg.eigvals(symbol(stencil, wave_vectors))).max(-1)


def stability(stencil: LinearStencil | FaceStencil, *, factor: float = 1.0) -> StabilityReport:
    """Spectral radius over all wave vectors, and what it means.

    13 samples per axis, over the irreducible wedge k_x >= k_y >= k_z >= 0 where the stencil respects the cube's symmetries
    and over half of all wave vectors otherwise, then a pattern search from the six largest.

    Args:
        stencil: any stencil; a face stencil is judged without its clamp.
        factor: propagation factor p that multiplies every step.
    """
    linear = _linear(stencil)
    axis = np.linspace(0.0, np.pi, _SAMPLES)
    if asymmetry(linear) < 1e-6:
        k = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
        k = k[(k[:, 0] >= k[:, 1]) & (k[:, 1] >= k[:, 2])]
    else:  # A(-k) is the conjugate of A(k): half of the cube of wave vectors suffices
        both = np.concatenate([-axis[:0:-1], axis])
        k = np.stack(np.meshgrid(axis, both, both, indexing="ij"), -1).reshape(-1, 3)
    radii = factor * spectral_radius(linear, k)
    seeds = np.argsort(-radii, kind="stable")[:_SEEDS]
    points, values = k[seeds], radii[seeds]
    pattern = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), -1).reshape(-1, 3)
    step = axis[1] / 2
    for _ in range(_ROUNDS):
        trials = points[:, None] + step * pattern
        found = factor * spectral_radius(linear, trials.reshape(-1, 3)).reshape(len(points), -1)
        best = found.argmax(1)
        better = found.max(1) > values
        points = np.where(better[:, None], trials[range(len(points)), best], points)
        values = np.where(better, found.max(1), values)
        step /= 2
    worst = int(values.argmax())
    gain = factor * float(linear.uniform_gain()[0, 0])
    x, y, z = (float(v) for v in points[worst])
    radius = float(values[worst])
    return StabilityReport(radius, (x, y, z), gain, radius <= 1 + TOLERANCE, _advice(linear.name, radius, (x, y, z), factor))


def _advice(name: str, radius: float, k: tuple[float, float, float], factor: float) -> str:
    where = f"wave vector ({k[0]:.3f}, {k[1]:.3f}, {k[2]:.3f})"
    if radius <= 1 + TOLERANCE:
        return f"stencil '{name}' is stable: no field grows, spectral radius {radius:.7f} at {where}"
    steps = int(np.ceil(np.log(1000) / np.log(radius)))
    return (
        f"stencil '{name}' is unstable: a field at {where} grows by {radius:.7f} per step, a thousandfold in {steps} steps; "
        f"use a propagation factor of at most {factor / radius:.6f}, or train it with a larger stability margin"
    )


def negative_share(
    stencil: LinearStencil | FaceStencil, *, near: float = 2.0, far: float = 9.5, steps: int = 20, seed: int = 0
) -> float:
    """Negative irradiance that a cosine emitter causes, as a share of the positive: 0 for positive transport.

    Sums of r^2 max(0, -E) and r^2 max(0, E) over 6 random emitter directions, all cells between ``near`` and ``far`` [cells]
    and one random normal each, without the clamp. The two lobes' own truncation gives 0.02 to 0.03 with perfect transport.
    """
    linear, rng = _linear(stencil), np.random.default_rng(seed)
    half = int(np.ceil(far)) + 1
    axis = np.arange(-half, half + 1)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    square = x * x + y * y + z * z
    inside = (square >= near * near) & (square <= far * far)
    directions = rng.normal(size=(6, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    volume = torch.zeros((6, linear.matrices.shape[1], *square.shape))
    volume[:, :, half, half, half] = torch.tensor(cosine_lobe(directions, linear.l_max) / np.pi, dtype=volume.dtype)
    with torch.no_grad():
        light = propagate(volume, linear, steps=steps).numpy()[:, :, inside]
    normals = rng.normal(size=(light.shape[2], 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    irradiance = np.einsum("bkm,mk->bm", light, cosine_lobe(-normals, linear.l_max)) * square[inside]
    return float(np.maximum(-irradiance, 0).sum() / np.maximum(irradiance, 0).sum())
