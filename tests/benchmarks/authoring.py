"""Speed of authoring, and bonds of cuts found again from the meshes alone.

    python -m tests.benchmarks.authoring

The first table says how long building, files and assembly of large assets take. The
second cuts solids, whose bonds `author.cut` knows exactly, and finds them again with
`author.bonds`, which knows only triangles: as many, of the same area.
"""

import pathlib
import tempfile
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh

from blastjax import author, serialize
from blastjax.author import bonds, cut, shapes


def timed(name: str, call: Callable[[], Any]) -> Any:
    start = time.perf_counter()
    result = call()
    print(f"{name:52s} {time.perf_counter() - start:6.2f} s")
    return result


def speeds() -> None:
    shapes.grid((2, 2, 2))
    block = timed("grid of 99,452 boxes", lambda: shapes.grid((46, 46, 47)))
    described = author.describe(block)
    timed(
        f"build of its {len(block.bond_area):,} bonds", lambda: author.build(*described)
    )
    parent = np.concatenate([[-1], np.arange(99_999) // 8])
    tree = author.Chunks(parent, np.zeros((100_000, 3)), np.ones(100_000))
    timed("build of a tree of 100,000 chunks", lambda: author.build(tree))
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "block.npz"
        timed("save", lambda: serialize.save(path, block))
        timed("load, with all checks", lambda: serialize.load(path))
    small = shapes.grid((20, 20, 20))
    timed("unite 8,000 boxes by 8", lambda: author.unite(small, 8))
    dome = timed("dome of 1,025 stones", lambda: shapes.dome(rings=16, segments=64))
    far = author.placed((20, 0, 0))
    timed(
        "merge of two, with touching faces",
        lambda: author.merge([dome, dome], [np.eye(4), far], touching=True),
    )


def again(name: str, tree: cut.Tree) -> None:
    whole = cut.destructible(tree).destructible
    leaf = np.flatnonzero(np.asarray(whole.asset.chunk_children) == 0)
    meshes = [whole.meshes[i] for i in leaf]
    start = time.perf_counter()
    found = bonds.between(meshes)
    took = time.perf_counter() - start
    exact = author.describe(whole.asset)[1]
    pairs = map(tuple, np.sort(exact.chunks, axis=1).tolist())
    area = dict(zip(pairs, exact.area, strict=True))
    mine = dict(zip(map(tuple, leaf[found.chunks].tolist()), found.area, strict=True))
    both = area.keys() & mine.keys()
    worst = max(abs(mine[p] / area[p] - 1) for p in both)
    triangles = sum(len(m.faces) for m in meshes)
    print(
        f"{name:12s} {len(leaf):5d} {triangles:9,d} {len(area):6d} {len(mine):6d} "
        f"{len(both):6d} {worst:9.1e} {took:6.2f} s"
    )


def main() -> None:
    speeds()
    print("\nsolid       pieces triangles  bonds  found common    area off    time")
    solids = {
        "torus": trimesh.creation.torus(1.0, 0.35),
        "sphere": trimesh.creation.icosphere(4),
        "tube": trimesh.creation.annulus(0.5, 1.0, 1.0),
        "box": trimesh.creation.box(),
    }
    for name, mesh in solids.items():
        tree = cut.solid(mesh)
        again(name, cut.voronoi(tree, cut.uniform(tree, 64)))
    box = cut.solid(solids["box"])
    again("bricks", cut.bricks(box, (0.2, 0.4, 0.1)))
    again("slices", cut.slices(box, (3, 3, 3), offset=0.5, angle=0.2))


if __name__ == "__main__":
    main()
