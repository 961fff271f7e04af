"""Faces of a mesh that cross each other."""

import numpy as np

from blastjax.author.cut import geometry
from blastjax.author.mesh import Mesh

PAIRS = 500_000
"""Pairs of faces that are looked at together."""


def find(mesh: Mesh) -> np.ndarray:
    """Return pairs of faces of which one has an edge through the other, (K, 2).

    Faces that share a vertex, and ones that only touch, do not count.
    """
    shapely = geometry.need("shapely")
    corners = mesh.vertices[mesh.faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    # Boxes are sorted along the two axes along which the mesh is longest.
    thin = int(np.argmin(geometry.extent(mesh.vertices)))
    one, two = np.delete(np.arange(3), thin)
    boxes = shapely.box(low[:, one], low[:, two], high[:, one], high[:, two])
    tree = shapely.STRtree(boxes)
    found = []
    for start in range(0, len(boxes), 20_000):
        pairs = tree.query(boxes[start : start + 20_000]).T
        pairs[:, 0] += start
        pairs = pairs[pairs[:, 0] < pairs[:, 1]]
        first, second = pairs.T
        near = (low[first, thin] <= high[second, thin]) & (
            low[second, thin] <= high[first, thin]
        )
        pairs = pairs[near]
        faces = mesh.faces[pairs]
        joined = (faces[:, 0, :, None] == faces[:, 1, None, :]).any(axis=(1, 2))
        pairs = pairs[~joined]
        for i in range(0, len(pairs), PAIRS):
            part = pairs[i : i + PAIRS]
            found.append(part[_cross(corners[part[:, 0]], corners[part[:, 1]])])
    return np.concatenate([np.zeros((0, 2), np.int64), *found])


def _cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return which pairs of triangles (K, 3, 3) have an edge through the other."""
    crossed = np.zeros(len(first), bool)
    for a, b in ((first, second), (second, first)):
        for k in range(3):
            crossed |= _pierces(a[:, k], a[:, (k + 1) % 3], b)
    return crossed


def _pierces(start: np.ndarray, end: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    p, q, r = np.moveaxis(triangle, 1, 0)
    size = np.linalg.norm(end - start, axis=1) * np.linalg.norm(q - p, axis=1)
    size *= np.linalg.norm(r - p, axis=1)
    # What touches by rounding alone does not cross.
    slack = 1e-9 * size
    before, behind = _volume(start, p, q, r), _volume(end, p, q, r)
    apart = (before > slack) & (behind < -slack)
    apart |= (before < -slack) & (behind > slack)
    sides = np.stack(
        [_volume(start, end, a, b) for a, b in ((p, q), (q, r), (r, p))], axis=1
    )
    slack = slack[:, None]
    return apart & ((sides > slack).all(axis=1) | (sides < -slack).all(axis=1))


def _volume(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return six times the signed volume of tetrahedra, corners (K, 3) each."""
    return np.einsum("ki,ki->k", b - a, np.cross(c - a, d - a))
