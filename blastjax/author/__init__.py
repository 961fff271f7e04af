"""Making assets, on the host: descriptions in, an immutable `Asset` out.

`build` checks and orders descriptions of chunks and bonds. `shapes` has ready-made
ones. `pad` and `stack` bring different assets to one capacity, so that they share a
batch.
"""

from blastjax.author import shapes
from blastjax.author.asset import Built, build
from blastjax.author.descriptions import Bonds, Chunks
from blastjax.author.hierarchy import ensure_coverage, reorder, reorder_map
from blastjax.author.padding import Capacity, capacity, pad, stack

__all__ = [
    "Bonds",
    "Built",
    "Capacity",
    "Chunks",
    "build",
    "capacity",
    "ensure_coverage",
    "pad",
    "reorder",
    "reorder_map",
    "shapes",
    "stack",
]
