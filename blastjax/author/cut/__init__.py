"""Cutting solids into chunks, on the host.

`solid` checks a mesh and makes it a tree of one piece. Each pattern (`voronoi`,
`slices`, `plane`, `cutout`, `bricks`) cuts leaves of a tree and returns the deeper
tree; sites come from `uniform`, `clustered`, `radial` or from the user. `destructible`
makes the asset with its meshes. Equal input and seeds give equal bits. Needs the
geometry extra.
"""

from blastjax.author.cut.contacts import Contacts
from blastjax.author.cut.loading import solid
from blastjax.author.cut.noise import Noise
from blastjax.author.cut.patterns import bricks, cutout, plane, slices, voronoi
from blastjax.author.cut.result import Result, destructible
from blastjax.author.cut.sites import Sites, clustered, radial, uniform
from blastjax.author.cut.tree import Tree

__all__ = [
    "Contacts",
    "Noise",
    "Result",
    "Sites",
    "Tree",
    "bricks",
    "clustered",
    "cutout",
    "destructible",
    "plane",
    "radial",
    "slices",
    "solid",
    "uniform",
    "voronoi",
]
