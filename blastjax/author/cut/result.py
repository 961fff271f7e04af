"""From a tree of pieces to an asset with its meshes."""

import dataclasses
from typing import Any

import numpy as np

from blastjax.author.asset import Built, build
from blastjax.author.cut import contacts, geometry
from blastjax.author.cut.contacts import Contacts
from blastjax.author.cut.tree import Tree
from blastjax.author.descriptions import Bonds, Chunks, flags, reals
from blastjax.author.mesh import Destructible, Mesh, moments
from blastjax.core import WORLD

TOUCH = 1e-6
"""Distance from a plane, in extents of the solid, up to which a face lies in it."""


@dataclasses.dataclass(frozen=True)
class Result:
    """A destructible, and how it came from the pieces of a tree."""

    destructible: Destructible
    """The asset and the meshes of its chunks."""
    built: Built
    """The asset's maps; `chunk_map` gives the chunk of each piece of the tree."""
    contacts: Contacts
    """Between support pieces, in the tree's numbering."""
    warnings: tuple[str, ...]
    """What was repaired, and what looks wrong."""


def destructible(
    tree: Tree,
    *,
    support_level: int | None = None,
    support: Any = None,
    world: Any = None,
    dtype: Any = None,
) -> Result:
    """Make an asset of a tree of pieces: chunks, meshes, and bonds where they touch.

    Args:
      tree: the pieces.
      support_level: how many cuts lie above the support chunks: 0 makes the solid the
        only one. Leaves above that level are support chunks too. None takes all leaves.
      support: (P,) bool instead, which pieces are support chunks.
      world: pairs of a point and a normal out of the solid, each (3,): support chunks
        are bonded to the world by their faces in these planes.
      dtype: of the asset's real arrays, as in `author.build`.

    Raises:
      ValueError: the support level is below 0, or both it and `support` are given.
    """
    parent = np.array(tree.parent)
    chosen = _support(tree, support_level, support)
    found = [geometry.mesh(body, tree.skin) for body in tree.bodies]
    meshes = [mesh for mesh, _ in found]
    measures = [moments(mesh) for mesh in meshes]
    centroid = np.stack([center for _, center, _ in measures])
    size = [
        np.abs(mesh.vertices - center).max(axis=0)
        for mesh, center in zip(meshes, centroid, strict=True)
    ]
    low, high = tree.bounds()
    scale = float((high - low).max())
    shared = _contacts(found, chosen, scale)
    warnings = list(tree.warnings)
    bonds = _with_world(shared, _held(meshes, chosen, world, scale, warnings))
    built = build(
        Chunks(
            parent=parent,
            centroid=centroid,
            volume=np.array([volume for volume, _, _ in measures]),
            support=chosen,
            size=np.stack(size),
            inertia=np.stack([inertia for _, _, inertia in measures]),
        ),
        bonds,
        dtype=dtype,
    )
    ordered: list[Mesh] = [meshes[i] for i in np.argsort(built.chunk_map)]
    return Result(
        Destructible(built.asset, tuple(ordered)), built, shared, tuple(warnings)
    )


def _support(tree: Tree, level: int | None, support: Any) -> np.ndarray:
    count = len(tree.parent)
    if support is not None:
        if level is not None:
            raise ValueError("give support_level or support, not both")
        return flags("support", support, count)
    leaf = np.isin(np.arange(count), tree.leaves)
    if level is None:
        return leaf
    if level < 0:
        raise ValueError(f"support_level is {level}; it must be 0 or more")
    return (tree.level == level) | leaf & (tree.level < level)


def _contacts(
    found: list[tuple[Mesh, np.ndarray]], support: np.ndarray, scale: float
) -> Contacts:
    corners, piece, facets = [np.zeros((0, 3, 3))], [np.zeros(0, int)], []
    facets.append(np.zeros(0, int))
    for i in np.flatnonzero(support):
        mesh, facet = found[i]
        inner = facet != geometry.SKIN
        corners.append(mesh.vertices[mesh.faces[inner]])
        piece.append(np.full(int(inner.sum()), i))
        facets.append(facet[inner])
    return contacts.find(
        np.concatenate(corners), np.concatenate(piece), np.concatenate(facets), scale
    )


def _held(
    meshes: list[Mesh],
    support: np.ndarray,
    world: Any,
    scale: float,
    warnings: list[str],
) -> list[tuple[int, float, np.ndarray, np.ndarray]]:
    """Return piece, area, centroid and normal of the bonds to the world."""
    held: dict[int, tuple[float, np.ndarray, np.ndarray]] = {}
    for point, normal in () if world is None else world:
        point = reals("world point", point, (3,))
        normal = reals("world normal", normal, (3,))
        normal = normal / np.linalg.norm(normal)
        bonded = 0
        for i in np.flatnonzero(support):
            mesh = meshes[i]
            corners = mesh.vertices[mesh.faces]
            vector = np.cross(
                corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
            )
            length = np.linalg.norm(vector, axis=1)
            near = np.abs((corners - point) @ normal).max(axis=1) <= TOUCH * scale
            flat = near & (vector @ normal > 0.999 * length) & (length > 0)
            if not flat.any():
                continue
            area, middle = length[flat] / 2, corners[flat].mean(axis=1)
            old = held.get(int(i), (0.0, np.zeros(3), np.zeros(3)))
            held[int(i)] = (
                old[0] + area.sum(),
                old[1] + area @ middle,
                old[2] + area.sum() * normal,
            )
            bonded += 1
        if not bonded:
            warnings.append(
                f"nothing lies in the plane through {point.tolist()} facing "
                f"{normal.tolist()}: no bond to the world there"
            )
    return [
        (i, area, moment / area, vector / np.linalg.norm(vector))
        for i, (area, moment, vector) in held.items()
    ]


def _with_world(
    shared: Contacts, held: list[tuple[int, float, np.ndarray, np.ndarray]]
) -> Bonds:
    count = len(held)
    return Bonds(
        chunks=np.concatenate(
            [shared.pieces, np.array([(i, WORLD) for i, *_ in held]).reshape(-1, 2)]
        ).astype(int),
        normal=np.concatenate(
            [shared.normal, np.array([row[3] for row in held]).reshape(count, 3)]
        ),
        area=np.concatenate([shared.area, np.array([row[1] for row in held])]),
        centroid=np.concatenate(
            [shared.centroid, np.array([row[2] for row in held]).reshape(count, 3)]
        ),
    )
