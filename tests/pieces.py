"""Voronoi pieces of convex solids for the tests of hulls, with their bonds."""

import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection

from blastjax.author import Bonds, Chunks, build
from blastjax.author.mesh import Destructible, Mesh, moments

BOX = np.array([[s * (a == k) for a in range(3)] for k in range(3) for s in (1.0, -1)])


def convex_mesh(points):
    """Return the hull of points as a closed mesh."""
    solid = ConvexHull(points)
    kept, faces = np.unique(solid.simplices, return_inverse=True)
    points, faces = points[kept], faces.reshape(-1, 3)
    a, b, c = (points[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    wrong = np.einsum("fi,fi->f", normal, solid.equations[:, :3]) < 0
    faces = np.where(wrong[:, None], faces[:, ::-1], faces)
    return Mesh(points, faces.astype(np.int32))


def cell(planes, inside):
    """Return the mesh of {x: normal . x <= offset}; planes (n, 4)."""
    signed = np.concatenate([planes[:, :3], -planes[:, 3:]], axis=1)
    corners = HalfspaceIntersection(signed, inside).intersections
    return convex_mesh(np.unique(np.round(corners, 10), axis=0))


def box_planes(half):
    return np.concatenate([BOX, np.repeat(half, 2)[:, None]], axis=1)


def voronoi(half, sites, seed=0, ground=False):
    """Cut a box of the half extents into Voronoi cells."""
    rng = np.random.default_rng(seed)
    place = rng.uniform(-0.95, 0.95, (sites, 3)) * half
    meshes, pairs, middles, normals = [], [], [], []
    for i, site in enumerate(place):
        other = np.delete(place, i, axis=0)
        normal = other - site
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        normal = normal / length
        offset = np.sum(normal * (site + other) / 2, axis=1, keepdims=True)
        planes = np.concatenate([box_planes(half), np.append(normal, offset, axis=1)])
        mesh = cell(planes, site)
        meshes.append(mesh)
        for j in range(i + 1, sites):
            n, d = normal[j - 1], offset[j - 1, 0]
            on = np.abs(mesh.vertices @ n - d) < 1e-7
            if on.sum() > 2:
                pairs.append((i, j))
                middles.append(mesh.vertices[on].mean(axis=0))
                normals.append(n)
    return destructible(meshes, pairs, middles, normals)


def destructible(meshes, pairs=(), middles=(), normals=()):
    """Return an asset of single pieces with their meshes."""
    volume, center, inertia = map(
        np.array, zip(*(moments(mesh) for mesh in meshes), strict=True)
    )
    extent = [
        np.abs(mesh.vertices - c).max(axis=0)
        for mesh, c in zip(meshes, center, strict=True)
    ]
    count = len(meshes)
    built = build(
        Chunks(
            parent=np.full(count, -1),
            support=np.ones(count, bool),
            centroid=center,
            volume=volume,
            inertia=inertia,
            size=np.array(extent),
        ),
        Bonds(
            chunks=np.array(pairs, int).reshape(-1, 2),
            normal=np.array(normals).reshape(-1, 3),
            centroid=np.array(middles).reshape(-1, 3),
            area=np.ones(len(pairs)),
        ),
    )
    order = np.argsort(built.chunk_map)
    return Destructible(built.asset, tuple(meshes[i] for i in order))


def vase(height=0.5, sections=24):
    """Return a hollow vase, closed and watertight, as a trimesh object."""
    import trimesh

    outline = [
        [0, 0],
        [0.18, 0],
        [0.28, 0.25],
        [0.3, 0.45],
        [0.2, 0.7],
        [0.15, 0.85],
        [0.19, 1],
        [0.13, 1],
        [0.09, 0.85],
        [0.14, 0.7],
        [0.24, 0.45],
        [0.22, 0.25],
        [0.14, 0.06],
        [0, 0.06],
    ]
    profile = np.array(outline) * height
    return trimesh.creation.revolve(profile, sections=sections)
