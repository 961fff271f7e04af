"""Convex solids given by their corners and faces: meshes, moments, and their boxes.

A *solid* is a list of faces, each a row of corners in a plane, counter-clockwise seen
from outside.
"""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from blastjax.author import bonds as find
from blastjax.author.asset import Built, build
from blastjax.author.descriptions import Bonds, Chunks, refuse
from blastjax.author.mesh import Destructible, Mesh, moments
from blastjax.core import NO_PARENT

# Corners in binary order of (x, y, z) low or high.
_BOX_FACES = (
    (0, 1, 3, 2),
    (4, 6, 7, 5),
    (0, 4, 5, 1),
    (2, 3, 7, 6),
    (0, 2, 6, 4),
    (1, 5, 7, 3),
)
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


def solid(faces: Sequence[Any]) -> Mesh:
    """Return the mesh of a solid, its faces fanned into triangles."""
    rows = [np.asarray(face, float) for face in faces]
    points = np.concatenate(rows)
    # One vertex where corners coincide to within rounding.
    scale = np.ptp(points, axis=0).max() or 1.0
    key = np.round((points - points.min(axis=0)) / (1e-9 * scale)).astype(np.int64)
    _, first, place = np.unique(key, axis=0, return_index=True, return_inverse=True)
    place = place.reshape(-1)
    triangles, start = [], 0
    for row in rows:
        corner = place[start : start + len(row)]
        start += len(row)
        triangles += [(corner[0], b, c) for b, c in itertools.pairwise(corner[1:])]
    kept = [t for t in triangles if len(set(t)) == 3]
    return Mesh(points[first], np.array(kept, np.int32).reshape(-1, 3))


def box(center: np.ndarray, size: np.ndarray) -> Mesh:
    """Return the mesh of an axis-aligned box, given its half extents."""
    corners = center + _CORNERS * size
    return solid([corners[list(face)] for face in _BOX_FACES])


def prism(low: Any, high: Any) -> Mesh:
    """Return the mesh between two polygons (M, 3), corner to corner.

    Both run counter-clockwise seen from beyond the high one, and the sides between them
    must be flat.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    after = np.roll(np.arange(len(low)), -1)
    sides = [[low[i], low[j], high[j], high[i]] for i, j in enumerate(after.tolist())]
    return solid([low[::-1], high, *sides])


def equal_box(volume: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """Return the half extents of boxes that stand for solids, (n, 3).

    The box has the solid's volume, and its extents the proportions of the solid's
    second moments along the axes. Of a box with these axes it is the box itself.

    Args:
      volume: (n,).
      inertia: (n, 3, 3) about the centroid at unit density.
    """
    diagonal = np.diagonal(inertia, axis1=1, axis2=2)
    second = np.maximum(diagonal.sum(axis=1, keepdims=True) / 2 - diagonal, 0)
    half = np.sqrt(3 * second / np.where(volume > 0, volume, 1)[:, None])
    size = 8 * np.prod(half, axis=1)
    scale = np.cbrt(np.where(size > 0, volume / np.where(size > 0, size, 1), 0))
    return half * scale[:, None]


def describe(meshes: Sequence[Mesh], parent: Any = None, support: Any = None) -> Chunks:
    """Return descriptions of chunks with exact volume, centre, inertia and their box.

    Raises:
      ValueError: a mesh has no volume, or is inside out.
    """
    found = [moments(mesh) for mesh in meshes]
    volume = np.array([x[0] for x in found])
    refuse(
        ~(volume > 0),
        volume,
        "mesh {i} has volume {v}; it must be closed, its faces counter-clockwise seen "
        "from outside",
    )
    centroid, inertia = (np.array([x[i] for x in found]) for i in (1, 2))
    if parent is None:
        parent = np.full(len(meshes), NO_PARENT)
    size = equal_box(volume, inertia)
    return Chunks(parent, centroid, volume, support, size, inertia)


def assemble(
    meshes: Sequence[Mesh],
    bonds: Bonds | None = None,
    *,
    world: Sequence[Bonds] = (),
    dtype: Any = None,
) -> Destructible:
    """Build solids into a destructible, bonded where they touch.

    Args:
      meshes: one a chunk.
      bonds: between them; None finds those of faces that touch.
      world: bonds to the world.
      dtype: see `author.build`.
    """
    bonds = find.between(meshes) if bonds is None else bonds
    built = build(describe(meshes), find.together(bonds, *world), dtype=dtype)
    return Destructible(built.asset, in_order(built, meshes))


def in_order(built: Built, meshes: Sequence[Mesh]) -> tuple[Mesh, ...]:
    """Return the meshes of described chunks in the order of the asset's."""
    return tuple(meshes[i] for i in np.argsort(built.chunk_map))
