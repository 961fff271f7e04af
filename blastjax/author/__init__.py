"""Making assets, on the host: descriptions in, an immutable `Asset` out.

`build` checks and orders descriptions of chunks and bonds. `shapes` has ready-made
ones, `cut` breaks any closed mesh into chunks, `solids` makes chunks of meshes, `bonds`
finds what holds meshes together. `merge`, `transform`, `add_bonds`, `unite` and
`delete` work on what is there. `materials` says how strong it is. `pad` and `stack`
bring different assets to one capacity, so that they share a batch.
"""

from blastjax.author import blast, bonds, cut, materials, shapes, solids
from blastjax.author.affine import mirrored, placed
from blastjax.author.assembly import (
    Result,
    add_bonds,
    describe,
    merge,
    meshes_of,
    transform,
)
from blastjax.author.asset import Built, build
from blastjax.author.descriptions import Bonds, Chunks
from blastjax.author.hierarchy import ensure_coverage, reorder, reorder_map
from blastjax.author.levels import delete, unite
from blastjax.author.mesh import Destructible, Mesh
from blastjax.author.padding import Capacity, capacity, pad, stack

__all__ = [
    "Bonds",
    "Built",
    "Capacity",
    "Chunks",
    "Destructible",
    "Mesh",
    "Result",
    "add_bonds",
    "blast",
    "bonds",
    "build",
    "capacity",
    "cut",
    "delete",
    "describe",
    "ensure_coverage",
    "materials",
    "merge",
    "meshes_of",
    "mirrored",
    "pad",
    "placed",
    "reorder",
    "reorder_map",
    "shapes",
    "solids",
    "stack",
    "transform",
    "unite",
]
