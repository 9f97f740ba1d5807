"""Torch twin of the tetrahedral lookup: every tetrahedron and every triangle is tried, autograd does the rest.

A point belongs to the tetrahedron in which its lowest barycentric weight is highest, if that is not below 0; else to the
closest point of the hull: of its triangles' interiors, edges and corners, the nearest. [m, t] of memory; ties go to the first.
"""

from __future__ import annotations

import torch

__all__ = ["dense_weights"]


def dense_weights(
    position: torch.Tensor, points: torch.Tensor, vertices: torch.Tensor, hull: torch.Tensor, *, inside: float = 1e-12
) -> torch.Tensor:
    """Weights [m,n] of points [m,3] over probes [n,3].

    Args:
        position: probes [n,3] m.
        points: [m,3] m.
        vertices: tetrahedra [t,4]; t may be 0.
        hull: triangles [f,3], which may be segments or points (repeated vertices).
        inside: a lowest weight down to minus this counts as inside.
    """
    simplices = [tuple(row) for row in vertices.tolist()]
    faces = {tuple(sorted(set(face))) for face in hull.tolist()}
    parts = sorted({p for face in faces for p in _parts(face)})
    result = position.new_zeros(len(points), len(position))
    lowest = [_project(position, points, s).detach().amin(1) for s in simplices]
    outside = torch.ones(len(points), dtype=torch.bool)
    if simplices:
        value, chosen = torch.stack(lowest, 1).max(1)
        outside = value < -inside
        for k in chosen[~outside].unique().tolist():
            here = torch.nonzero(~outside & (chosen == k))[:, 0]
            result = _put(result, here, simplices[k], _project(position, points[here], simplices[k]))
    away = torch.nonzero(outside)[:, 0]
    distance = []
    for part in parts:
        weight = _project(position, points[away], part).detach()
        gap = (points[away] - weight @ position[list(part)]).norm(dim=1).detach()
        distance.append(torch.where((weight >= 0).all(1), gap, torch.inf))
    chosen = torch.stack(distance, 1).argmin(1)
    for k in chosen.unique().tolist():
        here = away[chosen == k]
        result = _put(result, here, parts[k], _project(position, points[here], parts[k]))
    return result


def _parts(face: tuple[int, ...]) -> list[tuple[int, ...]]:
    """The corners, edges and interior of a triangle, segment or point."""
    edges = [(a, b) for i, a in enumerate(face) for b in face[i + 1 :]] if len(face) == 3 else []
    return [face, *edges, *((a,) for a in face)]


def _project(position: torch.Tensor, points: torch.Tensor, simplex: tuple[int, ...]) -> torch.Tensor:
    """Barycentric weights [m,k] of the projections of points [m,3] onto the plane (line, space) through k probes."""
    corner = position[list(simplex)]
    if len(simplex) == 1:
        return torch.ones_like(points[:, :1])
    edges = corner[1:] - corner[0]
    rest = torch.linalg.solve(edges @ edges.T, edges @ (points - corner[0]).T).T
    return torch.cat([1 - rest.sum(1, keepdim=True), rest], 1)


def _put(result: torch.Tensor, rows: torch.Tensor, simplex: tuple[int, ...], weight: torch.Tensor) -> torch.Tensor:
    columns = torch.tensor(simplex)
    index = (rows[:, None].expand_as(weight), columns[None].expand_as(weight))
    return result.index_put(index, weight)
