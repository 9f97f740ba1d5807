"""Weights by sight: a probe behind a wall counts for nothing, by rays, and smoothly so that they can be learned through.

Each receiver x looks around once: rays along the R x R directions of an octahedral map (Cigolle et al., JCGT 2014) find the
plane that it sees there, through a_k with the normal n_k toward x. Planes are kept as long as the receivers stay where they
are; only directions that some probe was asked for are traced. (Irradiance fields with visibility, Majercik et al. 2019, look
from the probes and keep distances; here the probes move and the receivers do not, and a plane is right however slanted it is
seen.) For direction k, a probe p counts by how far it lies before what is seen; in all, by the bilinear weights b_k of its
direction:

    v_k = smoothstep(1 + n_k . (p - a_k) / s),    V = sum over four k of b_k v_k

v is 1 in front of the surface and 0 deeper than the softness s behind it; V is continuous also where the edge of an occluder
passes. The weights w of the interpolation become

    w'_j = w_j (f + (1 - f) V_j) / sum_i w_i (f + (1 - f) V_i)

so that a receiver that sees none of its probes falls back to w. Gradients reach the probes through w and V, and the receivers
too, the planes being held; finer occluders than the map's step (11 degrees for R = 16) may be missed or seen too large.
"""

from __future__ import annotations

import numpy as np
import torch

from difflpv.coordinates import check_points
from difflpv.probes.rows import Interpolation, Rows
from difflpv.raycast import Raycaster
from difflpv.scene import Scene

__all__ = ["Sight", "VisibleInterpolation"]

_NEAR = 1e-6  # m; a probe this close to a receiver has no direction
_UNKNOWN, _MISS = -2, -1


class Sight:
    """How far receivers see probes: V of the module. What receivers saw is kept as long as they stay where they are."""

    def __init__(
        self,
        scene: Scene,
        *,
        raycaster: Raycaster | None = None,
        softness: float | None = None,
        resolution: int = 16,
    ) -> None:
        """Set up; nothing is traced before it is asked for.

        Args:
            scene: its triangles block, from either side.
            raycaster: over the scene; made, if None.
            softness: s of the module [m]; 0.005 of the scene's extent, if None.
            resolution: R of the module: R x R directions around a receiver, each held with 4 bytes once it was traced.

        Raises:
            ValueError: naming the argument, what was expected and what came.
        """
        low, high = scene.bounds
        self._softness = 0.005 * float((high - low).max()) if softness is None else float(softness)
        if not self._softness > 0:
            raise ValueError(f"softness: expected a length > 0 m, got {softness}")
        if resolution < 2:
            raise ValueError(f"resolution: expected at least 2 directions a side, got {resolution}")
        self._resolution = resolution
        self._raycaster = Raycaster(scene) if raycaster is None else raycaster
        side = (np.arange(resolution) + 0.5) / resolution * 2 - 1
        self._direction = _direction_at(np.stack(np.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2))
        self._wrapped = torch.from_numpy(_wrapped(resolution))
        normal = scene.triangle_normals
        through = (normal * scene.triangle_vertices[:, 0]).sum(1)
        self._normal, self._through = torch.from_numpy(normal), torch.from_numpy(through)
        self._receivers = np.empty((0, 3))
        self._seen = np.empty((0, resolution**2), np.int32)

    def visibility(self, position: torch.Tensor, points: torch.Tensor, probe: torch.Tensor) -> torch.Tensor:
        """How far ``points`` [m,3] m see the probes [m,k] that they name, in [0, 1]: V of the module."""
        tap, share = self._taps(position[probe] - points[:, None])
        hit = torch.from_numpy(self._look(points.detach().cpu().double().numpy(), tap.cpu().numpy())).to(points.device)
        ray = torch.from_numpy(self._direction).to(points)[tap]
        normal, through = (t.to(points)[hit.clamp_min(0)] for t in (self._normal, self._through))
        facing = torch.where((normal * ray).sum(-1) > 0, -1.0, 1.0).to(points)  # turns normals toward the receiver
        before = facing * ((normal * position[probe][:, :, None]).sum(-1) - through)
        u = torch.where(hit < 0, 1.0, 1 + before / self._softness).clamp(0, 1)
        return (share * (3 - 2 * u) * u.square()).sum(-1)

    def _taps(self, toward: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The four texels [m,k,4] around directions [m,k,3], any length, and their bilinear weights."""
        length = toward.abs().sum(-1, keepdim=True)
        flat = toward / (length.square() + _NEAR**2).sqrt()
        x, y, z = flat.unbind(-1)
        one = torch.ones_like(x)
        below = z < 0
        s = torch.where(below, (1 - y.abs()) * torch.where(x < 0, -one, one), x)
        t = torch.where(below, (1 - x.abs()) * torch.where(y < 0, -one, one), y)
        uv = (torch.stack([s, t], -1) + 1) * (0.5 * self._resolution) + 0.5  # a rim of one texel lies around the map
        first = uv.detach().floor().long().clamp(0, self._resolution)
        (a, b), (i, j) = (uv - first).unbind(-1), first.unbind(-1)
        share = torch.stack([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b], -1)
        wrapped = self._wrapped.to(first.device)
        return torch.stack([wrapped[i, j], wrapped[i, j + 1], wrapped[i + 1, j], wrapped[i + 1, j + 1]], -1), share

    def _look(self, points: np.ndarray, tap: np.ndarray) -> np.ndarray:
        """Triangle [m,k,4] that each point sees along each texel's direction, -1 for none; traced once for each place."""
        if not np.array_equal(points, self._receivers):
            self._receivers = points.copy()
            self._seen = np.full((len(points), self._resolution**2), _UNKNOWN, np.int32)
        seen = self._seen
        receiver = np.broadcast_to(np.arange(len(points))[:, None, None], tap.shape)
        wanted = np.zeros(seen.shape, bool)
        wanted[receiver, tap] = True
        row, texel = np.nonzero(wanted & (seen == _UNKNOWN))
        hits = self._raycaster.closest(points[row], self._direction[texel])
        seen[row, texel] = np.where(hits.valid, hits.triangle, _MISS)
        return seen[receiver, tap].astype(np.int64)


class VisibleInterpolation:
    """The weights of another interpolation, multiplied by how far a receiver sees each probe (see the module)."""

    def __init__(self, inner: Interpolation, sight: Sight, *, floor: float = 1e-3) -> None:
        """Wrap.

        Args:
            inner: whose weights are multiplied.
            sight: how far receivers see; several interpolations may share one, and what was seen with it.
            floor: f of the module: what an unseen probe counts, relative to a seen one.

        Raises:
            ValueError: naming the argument, what was expected and what came.
        """
        if not 0 < floor <= 1:
            raise ValueError(f"floor: expected a number in (0, 1], got {floor}")
        self._inner, self._sight, self._floor = inner, sight, floor

    def rows(self, position: torch.Tensor, points: torch.Tensor) -> Rows:
        """Weights of ``points`` [m,3] m, off every surface, over probes at ``position`` [n,3] m; differentiable in both.

        Raises:
            TypeError, ValueError: naming the argument, what was expected and what came.
        """
        check_points("position", position)
        check_points("points", points, like=position)
        rows = self._inner.rows(position, points)
        share = self._floor + (1 - self._floor) * self._sight.visibility(position, points, rows.probe)
        weight = rows.weight * share
        return Rows(rows.probe, weight / weight.sum(1, keepdim=True))


def _direction_at(uv: np.ndarray) -> np.ndarray:
    """Unit vectors [n,3] of places [n,2] in [-1, 1] on the octahedral map."""
    z = 1 - np.abs(uv).sum(1)
    fold = np.where(uv < 0, -1.0, 1.0) * (1 - np.abs(uv[:, ::-1]))
    v = np.concatenate([np.where(z[:, None] < 0, fold, uv), z[:, None]], 1)
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def _wrapped(resolution: int) -> np.ndarray:
    """Texel of each place of the map with a rim of one around it [R+2, R+2]: over an edge, the map goes on mirrored."""
    i, j = np.meshgrid(np.arange(-1, resolution + 1), np.arange(-1, resolution + 1), indexing="ij")
    out_i, out_j = (i < 0) | (i >= resolution), (j < 0) | (j >= resolution)
    top = resolution - 1
    a = np.clip(np.where(out_j, top - i, i), 0, top)
    b = np.clip(np.where(out_i, top - j, j), 0, top)
    return a * resolution + b
