"""From a tree of pieces to an asset with its meshes."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from blastjax.author import bonds, solids
from blastjax.author.asset import Built, build
from blastjax.author.cut import contacts, geometry
from blastjax.author.cut.contacts import Contacts
from blastjax.author.cut.tree import Tree
from blastjax.author.descriptions import Bonds, flags
from blastjax.author.mesh import Destructible, Mesh


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
    world: Sequence[Bonds] = (),
    dtype: Any = None,
) -> Result:
    """Make an asset of a tree of pieces: chunks, meshes, and bonds where they touch.

    Bonds are exact: of flat cuts the face that both pieces have, of rough ones its area
    and mean normal, also where later cuts divided the two sides differently.

    Args:
      tree: the pieces.
      support_level: how many cuts lie above the support chunks: 0 makes the solid the
        only one. Leaves above that level are support chunks too. None takes all leaves.
      support: (P,) bool instead, which pieces are support chunks.
      world: bonds to the world or others, such as `author.bonds.to_plane(tree.meshes,
        ...)`; those of pieces that are no support chunks are dropped, several of one
        pair made one of all their area.
      dtype: of the asset's real arrays, as in `author.build`.

    Raises:
      ValueError: the support level is below 0, or both it and `support` are given.
    """
    chosen = _support(tree, support_level, support)
    found = [geometry.mesh(body, tree.skin) for body in tree.bodies]
    meshes = [mesh for mesh, _ in found]
    low, high = tree.bounds()
    shared = _contacts(found, chosen, float((high - low).max()))
    own = Bonds(shared.pieces, shared.normal, shared.area, shared.centroid)
    chunks = solids.describe(meshes, np.array(tree.parent), chosen)
    built = build(chunks, bonds.together(own, _united(world)), dtype=dtype)
    return Result(
        Destructible(built.asset, solids.in_order(built, meshes)),
        built,
        shared,
        tree.warnings,
    )


def _united(found: Sequence[Bonds]) -> Bonds:
    """Return bonds with one for each pair: a piece may touch the world on two sides."""
    every = bonds.together(*found)
    area = np.asarray(every.area, float)
    pairs, place = np.unique(every.chunks, axis=0, return_inverse=True)
    totals = np.zeros((len(pairs), 7))
    rows = np.column_stack([area, area[:, None] * every.normal])
    rows = np.column_stack([rows, area[:, None] * every.centroid])
    np.add.at(totals, place.ravel(), rows)
    length = np.linalg.norm(totals[:, 1:4], axis=1, keepdims=True)
    # Held from two opposite sides a piece has no direction of its own.
    upright = np.array([0.0, 0.0, 1.0])
    normal = np.where(length > 0, totals[:, 1:4] / np.where(length > 0, length, 1), 0)
    normal = np.where(length > 1e-6 * totals[:, :1], normal, upright)
    return Bonds(pairs, normal, totals[:, 0], totals[:, 4:] / totals[:, :1])


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
