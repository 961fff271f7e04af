"""Ready-made destructibles, one line each. Lengths in metres, z up, standing on z = 0.

Those of boxes are assets: `boxes`, `grid`, `beam`, `tower`, `wall`, `masonry`. Those of
other solids come with their meshes: `arch`, `dome`, `column`, `bridge`, and those cut
into shards, which need the geometry extra, `pane` and `vase`. Bonds lie where faces
touch, exactly.
"""

from blastjax.author.shapes.boxes import beam, boxes, grid, tower, wall
from blastjax.author.shapes.brittle import pane, vase
from blastjax.author.shapes.masonry import masonry
from blastjax.author.shapes.vaults import arch, bridge, column, dome

__all__ = [
    "arch",
    "beam",
    "boxes",
    "bridge",
    "column",
    "dome",
    "grid",
    "masonry",
    "pane",
    "tower",
    "vase",
    "wall",
]
