"""A tree of planes that leads a point to the tetrahedron it lies in, as Godot looks probes up.

Each node splits its tetrahedra by the plane of a face of one of them; one that the plane cuts goes to both sides. No plane is
used twice on a path, and below all four faces of a tetrahedron only that one is left: the tree ends.
Source: Fuchs, Kedem and Naylor, "On visible surface generation by a priori tree structures", 1980.
"""

from __future__ import annotations

import numpy as np

from difflpv.probes.tetrahedra import Tetrahedra

__all__ = ["EMPTY", "plane_tree"]

EMPTY = -(2**31)
"""A leaf without a tetrahedron: outside of all."""
_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])  # opposite to vertices 0, 1, 2, 3
_TRIED = 128  # planes for each node


def plane_tree(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The tetrahedra of ``points`` [n,3] and a tree that finds them.

    Returns:
        Tetrahedra [t,4] int (vertex indices); planes [m,4] float32, unit normal and distance d of
        n.p = d; children [m,2] int, of points over the plane (n.p > d) and of the others: a later node, ``-1 - tetrahedron``,
        or ``EMPTY``.
    """
    span = float(np.ptp(points, axis=0).max())
    corners = Tetrahedra.of(points).vertices.astype(np.int64)
    planes = _face_planes(points, corners)
    tolerance = 1e-5 * span
    nodes: list[tuple[int, int, int]] = []

    def grow(members: np.ndarray, used: frozenset[int]) -> int:
        if not len(members):
            return EMPTY
        candidates = _candidates(members, used)
        if len(members) == 1 or not len(candidates):
            return -1 - int(members[0])
        height = points[corners[members]] @ planes[candidates, :3].T - planes[candidates, 3]  # [members, 4, candidates]
        over, under = (height > tolerance).any(1), (height < -tolerance).any(1)
        over, under = over | ~under, under | ~over  # one as thin as the tolerance goes to both sides
        first, second = over.sum(0), under.sum(0)
        best = int((first**2 + second**2).argmin())  # few on both sides, and as many on either
        plane, index = int(candidates[best]), len(nodes)
        nodes.append((plane, EMPTY, EMPTY))
        spent = used | {plane}
        nodes[index] = (plane, grow(members[over[:, best]], spent), grow(members[under[:, best]], spent))
        return index

    everything = np.arange(len(corners))
    if grow(everything, frozenset()) < 0:  # a single tetrahedron still needs a node
        nodes.append((0, -1, -1))
    table = np.array(nodes)
    return corners, planes[table[:, 0]].astype(np.float32), table[:, 1:]


def _face_planes(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Planes [4 t, 4] of the faces, each tetrahedron's in turn, its inside under them."""
    face = points[corners[:, _FACES]]  # [t, 4, 3, 3]
    normal = np.cross(face[:, :, 1] - face[:, :, 0], face[:, :, 2] - face[:, :, 0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    distance = (normal * face[:, :, 0]).sum(-1)
    inward = (normal * points[corners]).sum(-1) > distance  # the opposite vertex lies over: turn the plane round
    sign = np.where(inward, -1.0, 1.0)[..., None]
    return (np.concatenate([normal, distance[..., None]], -1) * sign).reshape(-1, 4)


def _candidates(members: np.ndarray, used: frozenset[int]) -> np.ndarray:
    """Planes of some of the members' faces, evenly drawn, none of which was used above."""
    planes = (4 * members[:, None] + np.arange(4)).ravel()
    free = planes[~np.isin(planes, list(used))] if used else planes
    return free[:: max(1, len(free) // _TRIED)]
