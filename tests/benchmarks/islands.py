"""Islands of a batch of bond states: this library, C++ union-find and SciPy.

`python -m tests.benchmarks.islands [--json FILE] [--picture FILE]` prints microseconds
a body, the least of interleaved runs, all on one core of one process.
"""

import argparse
import ctypes
import json
import pathlib
import subprocess
import tempfile
import time

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax import lax
from scipy.sparse import csgraph
from scipy.spatial import Delaunay

from blastjax import graph, lanes
from tests.benchmarks.timing import keep_memory, least, one_core

UNION_FIND = r"""
#include <cstdint>
extern "C" void islands(const int32_t* edges, const uint8_t* alive, int32_t* label,
                        int64_t batch, int64_t bonds, int64_t nodes) {
  for (int64_t t = 0; t < batch; ++t) {
    const uint8_t* a = alive + t * bonds;
    int32_t* f = label + t * nodes;
    for (int32_t i = 0; i < nodes; ++i) f[i] = i;
    for (int64_t e = 0; e < bonds; ++e) {
      if (!a[e]) continue;
      int32_t x = edges[2 * e], y = edges[2 * e + 1];
      while (f[x] != x) x = f[x] = f[f[x]];
      while (f[y] != y) y = f[y] = f[f[y]];
      if (x < y) f[y] = x; else f[x] = y;
    }
    for (int32_t i = 0; i < nodes; ++i) f[i] = f[f[i]];
  }
}
"""


def union_find():
    """Compile the peer: path halving, the smaller root wins."""
    folder = pathlib.Path(tempfile.mkdtemp())
    source, library = folder / "islands.cpp", folder / "islands.so"
    source.write_text(UNION_FIND)
    flags = ["-O3", "-march=native", "-shared", "-fPIC"]
    subprocess.run(["g++", *flags, str(source), "-o", str(library)], check=True)
    function = ctypes.CDLL(str(library)).islands

    def islands(edges, alive, label):
        where = [x.ctypes.data_as(ctypes.c_void_p) for x in (edges, alive, label)]
        sizes = [*alive.shape, label.shape[1]]
        function(*where, *map(ctypes.c_int64, sizes))

    return islands


def grid(side):
    place = np.stack(np.meshgrid(*[np.arange(s) for s in side], indexing="ij"), -1)
    place = place.reshape(-1, 3)
    index = np.arange(len(place)).reshape(side)
    pairs = []
    for axis in range(3):
        along = np.moveaxis(index, axis, 0)
        pairs.append(np.stack([along[:-1].ravel(), along[1:].ravel()], 1))
    return place / max(side), np.unique(np.concatenate(pairs), axis=0).astype(np.int32)


def voronoi(count):
    """Random seeds, numbered along x; neighbours share a Voronoi face."""
    place = np.random.default_rng(0).random((count, 3))
    place = place[np.argsort(place[:, 0])]
    cells = Delaunay(place).simplices
    pairs = [cells[:, [i, j]] for i in range(4) for j in range(i)]
    pairs = np.unique(np.sort(np.concatenate(pairs), 1), axis=0)
    return place, pairs.astype(np.int32)


def damaged(place, edges, batch, rng):
    """1/6 intact, 1/3 blasts, 1/3 shattered to pieces, 1/6 random: 40 % of bonds."""
    alive = np.ones((batch, len(edges)), bool)
    middle = place[edges].mean(1)
    for i in range(batch):
        kind = i % 6
        if kind in (1, 2):
            near = np.linalg.norm(middle - rng.random(3), axis=1)
            alive[i] = near > rng.uniform(0.1, 0.6)
        elif kind in (3, 4):
            seeds = rng.random((rng.integers(2, 64), 3))
            piece = ((place[:, None] - seeds) ** 2).sum(-1).argmin(1)
            alive[i] = piece[edges[:, 0]] == piece[edges[:, 1]]
        elif kind == 5:
            alive[i] = rng.random(len(edges)) > 0.4
    return alive


def critical(edges, num_nodes, batch, rng):
    """Bonds kept at random so that about the largest pieces are about to form."""
    degree = 2 * len(edges) / num_nodes
    return rng.random((batch, len(edges))) < 1.4 / (degree - 1)


def margins(name, edges, num_nodes, batch, repeats):
    """Print what best ways to a source cost, in searches for islands."""
    rng = np.random.default_rng(2)
    weight = jnp.asarray(rng.normal(0.2, 1, (batch, len(edges))), jnp.float32)
    sweep = lanes.order(edges, num_nodes)
    alive, edges, source = weight > 0, jnp.asarray(edges), jnp.arange(num_nodes) == 0

    @jax.jit
    def islands(e, a):
        return jax.vmap(lambda x: graph.islands(e, x, num_nodes, sweep=sweep))(a)

    @jax.jit
    def bottleneck(e, w):
        def one(x):
            return graph.bottleneck(e, x, source, num_nodes, sweep=sweep)

        return jax.vmap(one)(w)

    calls = {
        "islands": lambda: jax.block_until_ready(islands(edges, alive)),
        "bottleneck": lambda: jax.block_until_ready(bottleneck(edges, weight)),
    }
    for call in calls.values():
        call()
    a, b = (1e6 * x / batch for x in least(calls, repeats).values())
    print(
        f"{name:22s} {batch:5d} islands {a:8.2f} bottleneck {b:8.2f} {b / a:5.1f}x",
        flush=True,
    )


def scipys(edges, alive, num_nodes):
    for row in alive:
        kept = edges[row]
        ones = np.ones(len(kept), np.int8)
        matrix = scipy.sparse.coo_matrix((ones, kept.T), (num_nodes, num_nodes))
        csgraph.connected_components(matrix, directed=False)


def measure(name, place, edges, alive, cpp, repeats):
    num_nodes, batch = len(place), len(alive)
    e, a = jnp.asarray(edges), jnp.asarray(alive)

    sweep = lanes.order(edges, num_nodes)

    @jax.jit
    def ours(e, a, sweep):
        return jax.vmap(lambda x: graph.islands(e, x, num_nodes, sweep=sweep))(a)

    start = time.perf_counter()
    ours = ours.lower(e, a, sweep).compile()
    compiled = time.perf_counter() - start
    label = np.zeros((batch, num_nodes), np.int32)
    few = alive[:24]
    calls = {
        "cpp": lambda: cpp(edges, alive, label),
        "vmap": lambda: jax.block_until_ready(ours(e, a, sweep)),
        "scipy": lambda: scipys(edges, few, num_nodes),
    }
    width = lanes.tile_width(len(edges))
    if batch >= width:
        tiles = a.reshape(-1, width, len(edges))
        kept = jnp.array(tiles.swapaxes(1, 2))
        through = lanes.unpack(sweep, num_nodes, len(edges))
        rollout = jax.jit(lambda w, x: lax.map(lambda y: lanes.islands(w, y), x))
        calls["lanes"] = lambda: jax.block_until_ready(rollout(through, kept))
        calls["lanes"]()
    times = least(calls, repeats)
    np.testing.assert_array_equal(ours(e, a, sweep), label)
    row = {"asset": name, "nodes": num_nodes, "bonds": len(edges), "batch": batch}
    for key, seconds in times.items():
        row[key] = 1e6 * seconds / (len(few) if key == "scipy" else batch)
    return {**row, "compile_s": compiled}


def report(row):
    def ratio(key):
        return f"{row['cpp'] / row[key]:5.1f}x" if key in row else "    - "

    print(
        f"{row['asset']:22s} {row['batch']:5d} {row['cpp']:8.2f} {row['scipy']:8.1f}"
        f" {row['vmap']:8.2f} {ratio('vmap')} {row.get('lanes', np.nan):8.2f}"
        f" {ratio('lanes')} {row['compile_s']:8.1f}",
        flush=True,
    )


NAMES = {
    "scipy": "SciPy",
    "cpp": "C++ union-find",
    "vmap": "jax.vmap",
    "lanes": "in lanes already",
}


def picture(rows, path):
    """Draw time against size and against batch, of grids with the mix of damage."""
    from matplotlib import figure

    canvas = figure.Figure(figsize=(9, 4), layout="constrained")
    left, right = canvas.subplots(1, 2, sharey=True)
    grids = [r for r in rows if r["asset"] == f"grid {r['nodes']}"]
    full = max(r["batch"] for r in grids)
    for axes, along, some in (
        (left, "nodes", [r for r in grids if r["batch"] == full]),
        (right, "batch", [r for r in grids if r["nodes"] == 512]),
    ):
        some = sorted(some, key=lambda r: r[along])
        for key, name in NAMES.items():
            with_it = [r for r in some if key in r]
            x, y = ([r[k] for r in with_it] for k in (along, key))
            axes.loglog(x, y, "o-", label=name)
        x = [r[along] for r in some]
        axes.grid(True, which="both", alpha=0.2)
        axes.set_xticks(x, map(str, x))
        axes.minorticks_off()
    left.set(xlabel=f"nodes, batch {full}", ylabel="microseconds a body")
    right.set(xlabel="batch, 512 nodes")
    left.legend()
    canvas.savefig(path, dpi=130)


def main():
    one_core()
    keep_memory()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=pathlib.Path)
    parser.add_argument("--picture", type=pathlib.Path)
    parser.add_argument("--quick", action="store_true", help="512 nodes only")
    parser.add_argument("--repeats", type=int, default=40)
    chosen = parser.parse_args()
    cpp, rng = union_find(), np.random.default_rng(1)
    print(f"jax {jax.__version__}, one core, microseconds a body, least of runs")
    print(
        "asset                  batch      C++    SciPy     vmap  ratio    lanes  ratio"
        "  compile s"
    )
    cases = [("grid 512", *grid((8, 8, 8))), ("voronoi 512", *voronoi(512))]
    if not chosen.quick:
        cases += [("grid 128", *grid((8, 4, 4))), ("grid 4096", *grid((16, 16, 16)))]
    rows = []
    for name, place, edges in cases:
        place = place.reshape(-1, 3)
        mix = damaged(place, edges, 1024, rng)
        worst = critical(edges, len(place), 1024, rng)
        for label, alive in (
            (name, mix),
            (f"{name} critical", worst),
            (name, mix[1:2]),
        ):
            rows.append(measure(label, place, edges, alive, cpp, chosen.repeats))
            report(rows[-1])
        if name == "grid 512" and not chosen.quick:
            for batch in (8, 32, 128):
                few = mix[:batch]
                rows.append(measure(name, place, edges, few, cpp, chosen.repeats))
                report(rows[-1])
    for name, edges, num_nodes in (
        ("wall 16 x 16", grid((16, 1, 16))[1], 256),
        ("grid 512", grid((8, 8, 8))[1], 512),
        ("voronoi 512", voronoi(512)[1], 512),
    ):
        for batch in (256, 1024):
            margins(name, edges, num_nodes, batch, chosen.repeats)
    if chosen.json:
        chosen.json.write_text(json.dumps(rows, indent=1))
    if chosen.picture:
        picture(rows, chosen.picture)


if __name__ == "__main__":
    main()
