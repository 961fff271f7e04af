"""The geometry libraries, imported when something is cut, and bodies of theirs."""

import importlib
from typing import Any

import numpy as np

from blastjax.author.mesh import Mesh

EXTRA = "pip install 'blastjax[geometry]'"
SKIN = -1
"""Facet of a triangle that no cut made."""


def need(module: str) -> Any:
    """Return a module of the geometry extra.

    Raises:
      ImportError: it is missing; the message names the extra.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.split(".")[0]
        raise ImportError(f"{package} is missing; it comes with {EXTRA}") from error


def body(
    vertices: np.ndarray,
    faces: np.ndarray,
    facet: np.ndarray | None = None,
    original: int | None = None,
) -> Any:
    """Return a closed mesh as a `manifold3d.Manifold`.

    Args:
      vertices: (V, 3).
      faces: (F, 3).
      facet: (F,) which planar facet of a cut each triangle lies in. It survives later
        cuts.
      original: identity of what the triangles come from, which survives as well.
    """
    manifold3d = need("manifold3d")
    marks = {}
    if original is not None:
        marks["run_original_id"] = np.array([original], np.uint32)
        marks["run_index"] = np.array([0, 3 * len(faces)], np.uint64)
    if facet is not None:
        marks["face_id"] = np.ascontiguousarray(facet, np.uint64)
    mesh = manifold3d.Mesh64(
        np.ascontiguousarray(vertices, np.float64),
        np.ascontiguousarray(faces, np.uint64),
        **marks,
    )
    return manifold3d.Manifold(mesh)


def mesh(solid: Any, skin: int) -> tuple[Mesh, np.ndarray]:
    """Return the mesh of a body, and the facet of each triangle, SKIN for the skin.

    Args:
      solid: a `manifold3d.Manifold`.
      skin: identity of what was there before all cuts.
    """
    raw = solid.to_mesh64()
    faces = np.asarray(raw.tri_verts, np.int32)
    starts = np.asarray(raw.run_index, np.int64) // 3
    counts = starts[1:] - starts[:-1]
    original = np.repeat(np.asarray(raw.run_original_id, np.int64), counts)
    facet = np.where(original == skin, SKIN, np.asarray(raw.face_id, np.int64))
    vertices = np.array(raw.vert_properties[:, :3], np.float64)
    return Mesh(vertices, faces, facet != SKIN), facet


def bounds(solid: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and greatest corner of a body, both (3,)."""
    box = np.asarray(solid.bounding_box(), np.float64)
    return box[:3], box[3:]


def extent(vertices: np.ndarray) -> np.ndarray:
    """Return the extents of points along x, y and z, (3,)."""
    return vertices.max(axis=0) - vertices.min(axis=0)


def contains(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Return which points (P, 3) lie inside a closed mesh, (P,) bool.

    Counts the faces above each point, those that look up for and those that look down
    against. Only points exactly above an edge can be wrong.
    """
    shapely = need("shapely")
    corners = mesh.vertices[mesh.faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    boxes = shapely.box(low[:, 0], low[:, 1], high[:, 0], high[:, 1])
    point, face = shapely.STRtree(boxes).query(shapely.points(points[:, :2]))
    a, b, c = np.moveaxis(corners[face] - points[point][:, None], 1, 0)

    def turn(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]

    weight = np.stack([turn(b, c), turn(c, a), turn(a, b)], axis=1)
    total = weight.sum(axis=1)
    sign = np.sign(total)
    hit = (weight * sign[:, None] > 0).all(axis=1)
    height = np.stack([a[:, 2], b[:, 2], c[:, 2]], axis=1)
    above = hit & (np.einsum("ki,ki->k", weight, height) * sign > 0)
    return np.bincount(point[above], sign[above], len(points)) > 0.5
