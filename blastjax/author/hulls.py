"""Convex hulls of chunks, padded into one table for one collider. Host data.

A chunk collides as the convex hull of its mesh, with at most so many vertices. A hull
with fewer vertices than the mesh's own is spanned by some of them, so it lies inside:
pieces that touch keep clear of each other, and the volume that it lacks is reported. A
chunk whose hull fills much more than the chunk can be made of several hulls, by coacd.
Mass, centre and inertia remain those of the mesh, whatever collides for it.

Padding repeats what is there (the first vertex, face or edge), so that the least or the
greatest over a padded row is that of the hull. Sizes: H hulls, V vertices, F faces, P
corners of a face, E edges.
"""

import dataclasses
import importlib
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from blastjax.author.mesh import Destructible, Mesh, moments

FLAT = 1e-3
"""Sine of the angle up to which neighbouring facets count as one face."""


@dataclasses.dataclass(frozen=True)
class Hulls:
    """Convex polyhedra, each about an origin of its own."""

    vertices: np.ndarray
    """(H, V, 3) m."""
    normal: np.ndarray
    """(H, F, 3) outward unit normal of each face."""
    offset: np.ndarray
    """(H, F) distance of each face from the origin, m."""
    corners: np.ndarray
    """(H, F, P) int32 vertices of each face, counter-clockwise seen from outside."""
    size: np.ndarray
    """(H, F) int32 how many of them there are."""
    edges: np.ndarray
    """(H, E, 2) int32 vertices of each edge."""
    sides: np.ndarray
    """(H, E, 2) int32 faces on the left and the right of it, seen from outside."""
    chunk: np.ndarray
    """(H,) int32 chunk that the hull stands for."""
    volume: np.ndarray
    """(H,) m^3."""


@dataclasses.dataclass(frozen=True)
class Hull:
    """One convex polyhedron; the fields are those of `Hulls`, without padding."""

    vertices: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    loops: list[list[int]]
    edges: np.ndarray
    sides: np.ndarray
    volume: float


def fit(
    destructible: Destructible,
    *,
    vertices: int = 32,
    max_hulls: int = 1,
    convexity: float = 0.8,
) -> Hulls:
    """Return hulls for all chunks that can collide, about each chunk's centroid.

    Args:
      destructible: an asset and its meshes.
      vertices: most vertices of a hull. Fewer cost less time in every step.
      max_hulls: most hulls of a chunk. With more than 1, a chunk that fills less than
        `convexity` of its hull is decomposed (package coacd, extra "geometry").
      convexity: volume of a chunk over that of its hull, below which it is.

    Raises:
      ValueError: a chunk has no mesh or spans no volume; it names the chunk.
      ImportError: a package is missing; it names the extra.
    """
    if vertices < 4:
        raise ValueError(f"vertices is {vertices}; a hull needs 4 at least")
    if max_hulls < 1:
        raise ValueError(f"max_hulls is {max_hulls}; a chunk needs 1 at least")
    asset = destructible.asset
    center = np.asarray(asset.chunk_centroid, dtype=float)
    chosen = np.asarray(asset.element_chunk)
    found: list[Hull] = []
    owner: list[int] = []
    for c in chosen[chosen >= 0]:
        mesh = destructible.meshes[c]
        for points in _parts(mesh, int(c), max_hulls, convexity):
            try:
                found.append(hull(points - center[c], vertices))
            except ValueError as error:
                raise ValueError(f"chunk {c}: {error}") from error
            owner.append(int(c))
    return pad(found, owner)


def hull(points: np.ndarray, vertices: int = 32) -> Hull:
    """Return the convex hull of points (n, 3), spanned by at most so many of them.

    The points are taken greedily, each time the one that is farthest outside of what is
    spanned already.

    Raises:
      ValueError: the points are not finite or span no volume.
    """
    points = np.asarray(points, dtype=float)
    if not np.isfinite(points).all():
        row = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise ValueError(f"point {row} is {points[row].tolist()}; it must be finite")
    solid = _qhull(points)
    points = points[solid.vertices]
    if len(points) > vertices:
        points = points[_farthest(points, vertices)]
    solid = _qhull(points)
    # All that remains are corners: QHull numbers its vertices in points' order.
    points, renumber = points[solid.vertices], np.full(len(points), -1)
    renumber[solid.vertices] = np.arange(len(solid.vertices))
    triangles = _oriented(points, renumber[solid.simplices], solid.equations)
    group = _faces(triangles, solid.equations[:, :3], solid.neighbors)
    loops, edges, sides = _outline(triangles, group)
    normal = np.array([_normal(points[loop]) for loop in loops])
    # No corner may stand outside of its own face's plane.
    offset = np.array(
        [(points[loop] @ n).max() for loop, n in zip(loops, normal, strict=True)]
    )
    return Hull(points, normal, offset, loops, edges, sides, float(solid.volume))


def pad(hulls: Sequence[Hull], chunk: Sequence[int]) -> Hulls:
    """Put hulls, and the chunk that each stands for, into one table."""
    corners = max(len(loop) for h in hulls for loop in h.loops)
    faces = max(len(h.loops) for h in hulls)
    loops, sizes = [], []
    for h in hulls:
        rows = [loop + loop[:1] * (corners - len(loop)) for loop in h.loops]
        loops.append(_repeat(np.array(rows, np.int32), faces))
        size = np.array([len(loop) for loop in h.loops], np.int32)
        sizes.append(_repeat(size, faces))
    vertices = max(len(h.vertices) for h in hulls)
    edges = max(len(h.edges) for h in hulls)
    return Hulls(
        vertices=np.stack([_repeat(h.vertices, vertices) for h in hulls]),
        normal=np.stack([_repeat(h.normal, faces) for h in hulls]),
        offset=np.stack([_repeat(h.offset, faces) for h in hulls]),
        corners=np.stack(loops),
        size=np.stack(sizes),
        edges=np.stack([_repeat(h.edges, edges) for h in hulls]),
        sides=np.stack([_repeat(h.sides, edges) for h in hulls]),
        chunk=np.array(chunk, np.int32),
        volume=np.array([h.volume for h in hulls]),
    )


def unpad(hulls: Hulls, row: int) -> Mesh:
    """Return one hull as a closed mesh, its faces as fans of triangles."""
    seen: dict[tuple[int, ...], None] = {}
    for loop, size in zip(hulls.corners[row], hulls.size[row], strict=True):
        seen.setdefault(tuple(int(i) for i in loop[:size]))
    faces = [(loop[0], b, c) for loop in seen for b, c in itertools.pairwise(loop[1:])]
    used, flat = np.unique(np.array(faces, np.int32), return_inverse=True)
    return Mesh(hulls.vertices[row][used], flat.reshape(-1, 3).astype(np.int32))


def fit_error(destructible: Destructible, hulls: Hulls) -> np.ndarray:
    """Return volume of the hulls over that of the mesh, less 1, by chunk, (C,).

    Above 0 a chunk collides where it has no matter (it is hollow, or its several hulls
    overlap), below 0 its hull lacks corners. 0 for chunks without a hull.
    """
    chunks = len(destructible.meshes)
    total = np.zeros(chunks)
    np.add.at(total, hulls.chunk, hulls.volume)
    own = np.array([moments(mesh)[0] for mesh in destructible.meshes])
    has = total > 0
    return np.where(has, total / np.where(has, own, 1.0) - 1.0, 0.0)


def _repeat(rows: np.ndarray, count: int) -> np.ndarray:
    extra = np.repeat(rows[:1], count - len(rows), axis=0)
    return np.concatenate([rows, extra])


def _need(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f"hulls need {module.split('.')[0]}: pip install 'blastjax[geometry]'"
        ) from error


def _qhull(points: np.ndarray) -> Any:
    spatial = _need("scipy.spatial")
    if len(points) < 4:
        raise ValueError(f"{len(points)} points span no volume; a hull needs 4")
    try:
        return spatial.ConvexHull(points)
    except spatial.QhullError as error:
        extent = np.ptp(points, axis=0).tolist()
        raise ValueError(
            f"{len(points)} points with extents {extent} m span no volume; leave the "
            "piece out or give it thickness"
        ) from error


def _farthest(points: np.ndarray, count: int) -> np.ndarray:
    """Return the rows of points that span most, chosen one after the other."""
    chosen = _simplex(points)
    while len(chosen) < count:
        planes = _qhull(points[chosen]).equations
        outside = (points @ planes[:, :3].T + planes[:, 3]).max(axis=1)
        outside[chosen] = -np.inf
        best = int(outside.argmax())
        if outside[best] <= 0:
            break
        chosen.append(best)
    return np.sort(chosen)


def _simplex(points: np.ndarray) -> list[int]:
    """Return four rows of points that span a tetrahedron, as large as comes easily."""
    a = int(np.argmin(points[:, 0]))
    b = int(np.argmax(np.linalg.norm(points - points[a], axis=1)))
    along = np.cross(points - points[a], points[b] - points[a])
    c = int(np.argmax(np.linalg.norm(along, axis=1)))
    d = int(np.argmax(np.abs((points - points[a]) @ along[c])))
    return [a, b, c, d]


def _oriented(
    points: np.ndarray, triangles: np.ndarray, planes: np.ndarray
) -> np.ndarray:
    """Turn triangles so that they are counter-clockwise seen from outside."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    wrong = np.einsum("fi,fi->f", np.cross(b - a, c - a), planes[:, :3]) < 0
    return np.where(wrong[:, None], triangles[:, ::-1], triangles)


def _faces(
    triangles: np.ndarray, normal: np.ndarray, neighbors: np.ndarray
) -> np.ndarray:
    """Return the face (f,) of each triangle: neighbours that are flat with its seed."""
    group = np.full(len(triangles), -1)
    count = 0
    for seed in range(len(triangles)):
        if group[seed] >= 0:
            continue
        group[seed], todo = count, [seed]
        while todo:
            for other in neighbors[todo.pop()]:
                flat = np.linalg.norm(normal[other] - normal[seed]) < FLAT
                if group[other] < 0 and flat:
                    group[other] = count
                    todo.append(int(other))
        count += 1
    return group


def _outline(
    triangles: np.ndarray, group: np.ndarray
) -> tuple[list[list[int]], np.ndarray, np.ndarray]:
    """Return the corners of each face in order, the edges and the faces beside them."""
    left = {}
    for triangle, face in zip(triangles.tolist(), group.tolist(), strict=True):
        for k in range(3):
            left[triangle[k], triangle[(k + 1) % 3]] = face
    border = {(a, b): f for (a, b), f in left.items() if left[b, a] != f}
    following: dict[int, dict[int, int]] = {}
    for (a, b), face in border.items():
        following.setdefault(face, {})[a] = b
    loops = []
    for face in range(int(group.max()) + 1):
        after = following[face]
        loop = [min(after)]
        while after[loop[-1]] != loop[0]:
            loop.append(after[loop[-1]])
        loops.append(loop)
    edges = [(a, b) for a, b in border if a < b]
    sides = [(left[a, b], left[b, a]) for a, b in edges]
    return loops, np.array(edges, np.int32), np.array(sides, np.int32)


def _normal(loop: np.ndarray) -> np.ndarray:
    middle = loop - loop.mean(axis=0)
    normal = np.cross(middle, np.roll(middle, -1, axis=0)).sum(axis=0)
    return normal / np.linalg.norm(normal)


def _parts(
    mesh: Mesh, chunk: int, max_hulls: int, convexity: float
) -> list[np.ndarray]:
    """Return the points of each convex part of a mesh."""
    if len(mesh.vertices) < 4:
        raise ValueError(f"chunk {chunk} has {len(mesh.vertices)} points; it needs 4")
    whole = [np.asarray(mesh.vertices, dtype=float)]
    if max_hulls == 1:
        return whole
    volume = moments(mesh)[0]
    if volume >= convexity * _qhull(whole[0]).volume:
        return whole
    coacd = _need("coacd")
    coacd.set_log_level("error")
    # coacd works in units of the mesh's size; the seed makes it repeat itself.
    parts = coacd.run_coacd(
        coacd.Mesh(whole[0], np.asarray(mesh.faces)),
        max_convex_hull=max_hulls,
        preprocess_mode="off",
        seed=0,
    )
    return [np.asarray(points, dtype=float) for points, _ in parts]
