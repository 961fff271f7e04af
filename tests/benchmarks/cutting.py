"""Exactness and speed of cuts: `python -m tests.benchmarks.cutting`.

Cuts generated and shipped solids into Voronoi cells and prints how far the pieces are
from filling the solid, from each other, and from their bonds; then the time that a cut
takes, and how much of it is the boolean library's.
"""

import argparse
import itertools
import json
import time

from blastjax.author import cut
from blastjax.author.cut import complexes, geometry
from tests import solids

HEAD = ("solid", "triangles", "pieces", "bonds", "volume", "overlap", "sides")
HEAD = (*HEAD, "unbonded", "gap", "parts", "again")


def exactness(sites):
    """Print a row for each solid and return them."""
    print(" ".join(f"{word:>9}" for word in HEAD).replace("    solid", "solid    ", 1))
    rows = []
    for name, make in solids.ALL.items():
        tree, result = solids.voronoi(make(), sites)
        found = solids.figures(tree, result)
        again = solids.same(result, solids.voronoi(make(), sites)[1])
        row = {
            "solid": name,
            "triangles": len(tree.mesh(0).faces),
            "pieces": len(tree.leaves),
            "bonds": len(result.contacts.area),
            **found,
            "again": again,
        }
        rows.append(row)
        cells = [f"{row[k]:9d}" for k in ("triangles", "pieces", "bonds")]
        exact = ("volume", "overlap", "sides", "unbonded", "gap")
        cells += [f"{row[k]:9.1e}" for k in exact]
        cells += [f"{row['parts']:5d}/{row['solid parts']}".rjust(9)]
        print(f"{name[:18]:18s}", *cells, "     same" if again else "  DIFFERS")
    return rows


def speed(repeats):
    """Print and return the time of 256 cells of a box and of 10,000 triangles."""
    rows = []
    print(
        "\n256 cells of   triangles   solid   sites     cut   asset   total  booleans"
    )
    for name, make in (("box", solids.box), ("torus", solids.torus)):
        best = None
        for _ in range(repeats):
            times = _timed(make())
            if best is None or times["total"] < best["total"]:
                best = times
        rows.append({"solid": name, **best})
        cells = [f"{best[k]:6.2f} s" for k in ("solid s", "sites", "cut", "asset")]
        cells[0] = f"{best['solid s']:6.2f} s"
        print(
            f"{name:15s}{best['triangles']:9d}",
            *cells,
            f"{best['total']:6.2f} s",
            f"{best['booleans'] / best['total']:7.0%}",
        )
    return rows


def _timed(mesh):
    marks = [time.perf_counter()]

    def mark(value):
        marks.append(time.perf_counter())
        return value

    solid = mark(cut.solid(mesh))
    sites = mark(cut.uniform(solid, 256, seed=0))
    tree = mark(cut.voronoi(solid, sites))
    mark(cut.destructible(tree))
    parts = [b - a for a, b in itertools.pairwise(marks)]
    cells = complexes.bodies(complexes.voronoi(sites.points, *solid.bounds()), 0)
    # The library works when a result is asked for, and never twice: a fresh solid.
    whole = geometry.mesh(solid.bodies[0], solid.skin)[0]
    body = geometry.body(whole.vertices, whole.faces)
    start = time.perf_counter()
    for cell in cells:
        (body ^ cell).decompose()
    booleans = time.perf_counter() - start
    names = ("solid s", "sites", "cut", "asset")
    return {
        "triangles": len(whole.faces),
        **dict(zip(names, parts, strict=True)),
        "total": sum(parts),
        "booleans": booleans,
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sites", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", help="file to write the figures to")
    args = parser.parse_args()
    result = {"exactness": exactness(args.sites), "speed": speed(args.repeats)}
    if args.json:
        with open(args.json, "w") as file:
            json.dump(result, file, indent=1, default=float)


if __name__ == "__main__":
    main()
