"""The whole round trip of breaking bodies: this library and its peers.

`python -m tests.benchmarks.fracture_step [--json FILE] [--picture FILE]` prints
microseconds a body for: reset, radial damage, apply, split, visible chunks and events,
of distinct damage for every body of a batch, all on one core of one process, laps of
all in turn, the least of each. The moments of the actors are timed apart, and so are
the same with `apply` and `split` in place of `step`, and a step of a rollout in a scan.
Peers in the same run are the islands alone in C++ (union-find), and a plain NumPy Blast
around SciPy's and NetworkX's islands; Blast's own figures were recorded elsewhere.
"""

import argparse
import json
import pathlib

import jax
import jax.numpy as jnp
import networkx
import numpy as np
import scipy.sparse
from scipy.sparse import csgraph

from blastjax import chunks, damage, fracture
from blastjax.author import shapes
from tests.benchmarks.islands import union_find
from tests.benchmarks.timing import keep_memory, least, one_core

# Reset by memcpy, generate, apply, split: microseconds, on another machine.
BLAST_ELSEWHERE = {64: (1.3, 2.6), 512: (12.0, 26.0), 4096: (115.0, 294.0)}
SIDES = {64: (4, 4, 4), 512: (8, 8, 8), 4096: (16, 16, 16), 32768: (32, 32, 32)}
FEW = 8
"""Bodies that the slow peers break."""
SLOW = 4096
"""Nodes beyond which NetworkX is left out."""
DENSITY = 1000.0
STEPS = 8
"""Of a rollout."""


def blasts(batch, rng):
    """Return points in a unit cube, and radii: from a scratch to half of the body."""
    place = rng.random((batch, 3)) - [0.5, 0.5, 0.0]
    return place.astype(np.float32), rng.uniform(0.1, 0.6, batch).astype(np.float32)


def generate(asset, point, radius):
    """Reset one body; return its state and the damage of a blast to it."""
    whole = fracture.init(asset)
    return whole, damage.falloff(asset, whole, point, 2.0, radius, radius)


def broken(asset, point, radius):
    """Return the state and the events after damage and split."""
    return fracture.step(asset, *generate(asset, point, radius))


def in_two(asset, point, radius):
    """Return the same as `broken`, by a call to apply and one to split."""
    state, dealt = generate(asset, point, radius)
    state, fractured = fracture.apply(asset, state, dealt)
    state, parted = fracture.split(asset, state)
    return state, (fractured, parted)


def round_trip(asset, point, radius):
    """Return the state, the visible chunks and the events of a step of one body."""
    state, events = broken(asset, point, radius)
    return state, chunks.visible(asset, state), events


def moments(asset, state):
    """Return mass, centre and inertia of the actors."""
    return chunks.moments(asset, state, DENSITY)


def several_blasts(batch, rng):
    """Return the blasts of a rollout, of all its bodies."""
    each = [blasts(batch, rng) for _ in range(STEPS)]
    point, radius = map(np.stack, zip(*each, strict=True))
    return point.swapaxes(0, 1), 0.5 * radius.T


def rollout(asset, state, point, radius):
    """Return one body's state after a blast in every step of a scan."""

    def step(state, blast):
        where, reach = blast
        dealt = damage.falloff(asset, state, where, 2.0, reach, reach)
        return fracture.step(asset, state, dealt)[0], None

    return jax.lax.scan(step, state, (point, radius))[0]


class Plain:
    """One body in NumPy: what one would write without this library."""

    def __init__(self, asset, whole):
        self.edges = np.asarray(asset.bond_nodes)
        self.middle = np.asarray(asset.bond_centroid)
        self.parent = np.asarray(asset.chunk_parent)
        self.element = np.asarray(asset.chunk_element)
        self.health = np.asarray(whole.bond_health)
        self.nodes = asset.span_node.shape[0]

    def step(self, point, radius, islands):
        away = np.linalg.norm(self.middle - point, axis=1)
        dealt = np.where(away <= radius, np.float32(2.0), np.float32(0.0))
        health = np.maximum(self.health - dealt, 0)
        intact = health > 0
        label = islands(self.edges[intact], self.nodes)
        visible = np.zeros(len(self.parent), bool)
        visible[self.element >= 0] = True
        roots = (self.parent < 0) & (self.element < 0)
        if roots.any() and label.max() == 0:
            visible = roots
        return health, label, visible


def by_scipy(edges, nodes):
    ones = np.ones(len(edges), np.int8)
    matrix = scipy.sparse.coo_matrix((ones, edges.T), (nodes, nodes))
    _, part = csgraph.connected_components(matrix, directed=False)
    _, first = np.unique(part, return_index=True)
    return first[part]


def by_networkx(edges, nodes):
    graph = networkx.empty_graph(nodes)
    graph.add_edges_from(edges.tolist())
    label = np.zeros(nodes, np.int64)
    for part in networkx.connected_components(graph):
        label[list(part)] = min(part)
    return label


def batch_of(step, asset, *each):
    """Compile a step over a batch; return the call and the bytes of scratch."""
    axes = None, *[0 for _ in each]
    compiled = jax.jit(jax.vmap(step, axes)).lower(asset, *each).compile()
    scratch = compiled.memory_analysis().temp_size_in_bytes
    return lambda: jax.block_until_ready(compiled(asset, *each)), scratch


def measure(nodes, batch, cpp, repeats):
    """Return the figures of one size; every result is checked against the peers."""
    side = np.array(SIDES[nodes])
    asset = shapes.grid(tuple(side), tuple(1.0 / side), root=True)
    whole = fracture.init(asset)
    rng = np.random.default_rng(nodes)
    point, radius = blasts(batch, rng)
    ours, scratch = batch_of(round_trip, asset, point, radius)
    state, visible, _ = ours()

    edges = np.ascontiguousarray(asset.bond_nodes)
    alive = np.array(state.bond_intact)
    label = np.zeros((batch, nodes), np.int32)
    plain, few = Plain(asset, whole), list(zip(point, radius, strict=True))[:FEW]
    starts = jax.vmap(lambda _: whole)(point)
    calls = {
        "union-find": lambda: cpp(edges, alive, label),
        "round trip": ours,
        "moments": batch_of(moments, asset, state)[0],
        "in a scan": batch_of(rollout, asset, starts, *several_blasts(batch, rng))[0],
        "SciPy": lambda: [plain.step(*x, by_scipy) for x in few],
    }
    if nodes <= SLOW:
        calls["NetworkX"] = lambda: [plain.step(*x, by_networkx) for x in few]
    parts = {"generate": generate, "+ step": broken, "+ apply, split": in_two}
    for name, part in parts.items():
        calls[name], _ = batch_of(part, asset, point, radius)
    times = least(calls, repeats)

    np.testing.assert_array_equal(state.actor[:, :nodes], label)
    for i, hit in enumerate(few):
        _, islands, seen = plain.step(*hit, by_scipy)
        np.testing.assert_array_equal(islands, label[i])
        np.testing.assert_array_equal(seen, visible[i])
    row = {"nodes": nodes, "bonds": len(edges), "batch": batch}
    bodies = {"SciPy": len(few), "NetworkX": len(few), "in a scan": batch * STEPS}
    row |= {k: 1e6 * t / bodies.get(k, batch) for k, t in times.items()}
    row["broken"] = float(1 - alive.mean())
    row["scratch"] = scratch // batch
    return row


def alone(nodes, cpp, repeats):
    """Return the figures of one body, dispatch included."""
    side = np.array(SIDES[nodes])
    asset = shapes.grid(tuple(side), tuple(1.0 / side), root=True)
    point, radius = blasts(1, np.random.default_rng(nodes))
    step = jax.jit(round_trip)
    one = asset, jnp.asarray(point[0]), jnp.asarray(radius[0])
    edges = np.ascontiguousarray(asset.bond_nodes)
    alive = np.array(step(*one)[0].bond_intact)[None]
    label = np.zeros((1, nodes), np.int32)
    found, hand_back = step(*one), jax.jit(lambda x: x)
    calls = {
        "union-find": lambda: cpp(edges, alive, label),
        "round trip": lambda: jax.block_until_ready(step(*one)),
        "hand back": lambda: jax.block_until_ready(hand_back(found)),
    }
    times = least(calls, 10 * repeats)
    row = {"nodes": nodes, "bonds": len(edges), "batch": 1}
    return row | {k: 1e6 * t for k, t in times.items()}


COLUMNS = ("union-find", "round trip", "moments", "SciPy", "NetworkX")
STAGES = ("generate", "+ step", "+ apply, split", "in a scan")


def report(row):
    """Print one row."""

    def number(name):
        size = max(len(name), 11)
        return f"{row[name]:{size}.2f}" if name in row else f"{'-':>{size}}"

    ratio = [row.get(k, np.nan) / row["union-find"] for k in ("round trip", "moments")]
    low, high = BLAST_ELSEWHERE.get(row["nodes"], (np.nan, np.nan))
    there = f"{low:.4g}-{high:.4g}" if low == low else "-"
    print(
        f"{row['nodes']:6d} {row['batch']:6d}",
        *map(number, (*COLUMNS, *STAGES)),
        f"{ratio[0]:7.2f} {ratio[1]:7.2f}",
        f"{1e3 * row['round trip'] / row['nodes']:9.1f} {there:>9}",
        flush=True,
    )


def picture(rows, path):
    from matplotlib import figure

    canvas = figure.Figure(figsize=(6, 4), layout="constrained")
    axes = canvas.add_subplot()
    rows = [r for r in rows if r["batch"] > 1]
    for name in COLUMNS:
        some = [r for r in rows if name in r]
        axes.loglog([r["nodes"] for r in some], [r[name] for r in some], "o-")
        axes.lines[-1].set_label(name)
    known = sorted(BLAST_ELSEWHERE)
    low, high = zip(*(BLAST_ELSEWHERE[n] for n in known), strict=True)
    axes.fill_between(known, low, high, alpha=0.3, label="Blast C++, elsewhere")
    axes.set(xlabel="nodes", ylabel="microseconds a body")
    axes.legend(loc="lower right")
    canvas.savefig(path, dpi=150)


def main(arguments=None):
    """Print the tables; write JSON and a picture where told to."""
    one_core()
    keep_memory()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nodes", type=int, nargs="+", default=[64, 512, 4096, 32768])
    parser.add_argument("--batch", type=int, default=1024, help="of 512 nodes")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--json", type=pathlib.Path)
    parser.add_argument("--picture", type=pathlib.Path)
    chosen = parser.parse_args(arguments)
    unknown = set(chosen.nodes) - set(SIDES)
    if unknown:
        parser.error(f"no asset of {min(unknown)} nodes; choose from {sorted(SIDES)}")
    cpp = union_find()
    print(f"jax {jax.__version__}, one core, microseconds a body, least of runs;")
    print("ratios of the round trip and of the moments to union-find in the same run;")
    print("'Blast C++' was recorded elsewhere: reset, generate, apply, split")
    heads = [f"{x:>11}" for x in (*COLUMNS, *STAGES)]
    print(
        f"{'nodes':>6} {'batch':>6}",
        *heads,
        f"{'ratio':>7} {'moments':>7} {'ns a node':>9} Blast C++",
    )
    rows = []
    for nodes in chosen.nodes:
        # As many nodes in all as in so many bodies of 512: memory is not what differs.
        batch = max(chosen.batch * 512 // nodes, 32)
        rows.append(measure(nodes, batch, cpp, chosen.repeats))
        report(rows[-1])
    print("one body, dispatch included")
    for nodes in [n for n in chosen.nodes if n <= 4096]:
        rows.append(alone(nodes, cpp, chosen.repeats))
        report(rows[-1])
        nothing = rows[-1]["hand back"]
        print(f"{'':13} a call that hands back the same arrays: {nothing:.1f}")
    if chosen.json:
        chosen.json.write_text(json.dumps(rows, indent=1))
    if chosen.picture:
        picture(rows, chosen.picture)


if __name__ == "__main__":
    main()
