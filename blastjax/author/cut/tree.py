"""The tree of pieces that cuts make of a solid."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from blastjax.author.cut import complexes, geometry
from blastjax.author.cut.complexes import Complex
from blastjax.author.descriptions import depths
from blastjax.author.mesh import Mesh
from blastjax.core import NO_PARENT

SLIVER = 1e-12
"""Pieces below this part of the solid's volume are rounding, and are left out."""


@dataclasses.dataclass(frozen=True)
class Tree:
    """Pieces, each cut from its parent; piece 0 is the solid. Made by `cut.solid`."""

    bodies: tuple[Any, ...]
    """(P,) `manifold3d.Manifold`."""
    parent: tuple[int, ...]
    """(P,) piece that each was cut from, NO_PARENT for the solid."""
    skin: int
    """Identity of the triangles that were there before all cuts."""
    facets: int = 0
    """How many facets the cuts had so far."""
    warnings: tuple[str, ...] = ()
    """What was repaired, and what looks wrong."""

    @property
    def leaves(self) -> np.ndarray:
        """Pieces that were not cut further."""
        whole = np.ones(len(self.parent), bool)
        whole[[p for p in self.parent if p != NO_PARENT]] = False
        return np.flatnonzero(whole)

    @property
    def level(self) -> np.ndarray:
        """(P,) how many cuts lie above each piece."""
        return depths(np.array(self.parent))

    @property
    def volume(self) -> np.ndarray:
        """(P,) m^3."""
        return np.array([body.volume() for body in self.bodies])

    @property
    def meshes(self) -> tuple[Mesh, ...]:
        """The mesh of each piece."""
        return tuple(self.mesh(i) for i in range(len(self.bodies)))

    def mesh(self, piece: int) -> Mesh:
        """Return the mesh of a piece."""
        return geometry.mesh(self.bodies[piece], self.skin)[0]

    def bounds(self, piece: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and greatest corner of a piece, both (3,)."""
        return geometry.bounds(self.bodies[piece])


def chosen(tree: Tree, pieces: Sequence[int] | None) -> np.ndarray:
    """Return the pieces to cut: all leaves, or the given ones.

    Raises:
      ValueError: one does not exist, or was cut already.
    """
    if pieces is None:
        return tree.leaves
    numbers = np.atleast_1d(np.asarray(pieces))
    if numbers.size and numbers.dtype.kind not in "iu":
        raise ValueError(f"pieces are {pieces!r}; give numbers of leaves of the tree")
    leaves = set(tree.leaves.tolist())
    for number in numbers.tolist():
        if not 0 <= number < len(tree.parent):
            raise ValueError(
                f"there is no piece {number}; the tree has {len(tree.parent)}"
            )
        if number not in leaves:
            raise ValueError(
                f"piece {number} was cut already; give leaves of the tree, such as its "
                "children"
            )
    return np.unique(numbers).astype(int)


def cut(tree: Tree, cutters: Mapping[int, Sequence[Complex]]) -> Tree:
    """Return the tree with the given leaves cut by one complex after the other.

    All that the complexes make of a leaf becomes its children. Parts of one cell that
    hang together nowhere become pieces of their own. A leaf that no complex divides
    stays a leaf.
    """
    bodies, parent = list(tree.bodies), list(tree.parent)
    facets, prepared = tree.facets, {}
    smallest = SLIVER * tree.bodies[0].volume()
    for piece, partitions in cutters.items():
        parts = [tree.bodies[piece]]
        for partition in partitions:
            if id(partition) not in prepared:
                cells = complexes.bodies(partition, facets)
                prepared[id(partition)] = cells
                facets += int(partition.facet.max()) + 1
            cells = prepared[id(partition)]
            parts = [new for old in parts for new in _divide(old, cells)]
        parts = [
            island
            for part in parts
            for island in _islands(part)
            if island.volume() > smallest
        ]
        if len(parts) > 1:
            bodies += parts
            parent += [piece] * len(parts)
    return dataclasses.replace(
        tree, bodies=tuple(bodies), parent=tuple(parent), facets=facets
    )


def _divide(part: Any, cells: list[Any]) -> Iterator[Any]:
    low, high = geometry.bounds(part)
    if len(cells) == 2:
        met = list(part.split(cells[0]))
    else:
        boxes = [geometry.bounds(cell) for cell in cells]
        met = [
            part ^ cell
            for cell, (least, most) in zip(cells, boxes, strict=True)
            if (least <= high).all() and (most >= low).all()
        ]
    yield from (each for each in met if not each.is_empty())


def _islands(part: Any) -> list[Any]:
    """Return the parts of a body that hang together, each with its own cavities."""
    shells = part.decompose()
    solids = [shell for shell in shells if shell.volume() > 0]
    cavities = [shell for shell in shells if shell.volume() < 0]
    if not cavities or len(solids) < 2:
        return solids if not cavities else [part]
    meshes = [geometry.mesh(shell, 0)[0] for shell in solids]
    inside: list[list[Any]] = [[shell] for shell in solids]
    for cavity in cavities:
        probe = geometry.mesh(cavity, 0)[0].vertices[:1]
        around = [i for i, mesh in enumerate(meshes) if geometry.contains(mesh, probe)]
        # Of shells within each other the innermost has the cavity.
        inside[min(around, key=lambda i: solids[i].volume())].append(cavity)
    compose = geometry.need("manifold3d").Manifold.compose
    return [compose(each) for each in inside]
