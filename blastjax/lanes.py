"""Many copies of one graph side by side: islands by sweeps over lanes.

Labels are rows of nodes by columns of copies, so that the neighbour that a node reads
is one contiguous row for all of them: no scatter, and no gather that differs from copy
to copy. A forward sweep lets every node take the least label of its neighbours before
it, a backward sweep of those behind it; both see what the sweep already wrote
(symmetric Gauss-Seidel), so a label crosses the whole graph in one sweep if the order
of the nodes follows the way, and a few pairs of sweeps are enough.

Nodes are visited in an order of their own; labels are node numbers all the same.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

LANES = 256
"""Copies in a tile: many share what a step costs, few wait long for the slowest."""
CACHE = 2**20
"""Entries of a tile beyond which it is half as wide, to stay in a core's own cache."""
LIMIT = 65535
"""Nodes from which labels no longer fit 16 bits."""
PATIENCE = 16
"""Pairs of sweeps before a tile also jumps, now and then: most tiles never need it."""
MOST = 16
"""Neighbours on one side that are read in one step; nodes with more are hubs."""
DEGREES = (0, 1, 2, 3, 4, 6, 8, 12, MOST)
"""Nodes' neighbours on one side are read in one step of the next such size."""
GROUP = 6
"""Nodes that a sweep visits at a time: a step of a loop costs as much as some rows."""
BLOCK = 8
"""Copies that are turned into lanes at a time; they divide those in a tile."""
WINDOW = 256
"""Nodes among which those are sought that go well into one group."""
SURE = 3
"""Sweeps before it is worth a look whether anything still changes."""


Where = tuple[jax.Array, jax.Array, int | jax.Array]
Offer = Callable[[jax.Array, Where, jax.Array, jax.Array], jax.Array]
"""What neighbours offer to a group of rows: see `_sweep`."""


class Order(NamedTuple):
    """The way through a graph of N nodes and B edges.

    Rows are the nodes in the order of their visits. They are visited in groups of
    neighbours in that order, none of which is joined to another of its group. A row's
    neighbours are those before it, for the sweep forward (0), and those behind it, for
    the sweep backward (1).

    Numbers are unsigned: such an index is not checked for counting from the end.
    """

    visit: jax.Array
    """(N,) node by row."""
    turn: jax.Array
    """(N,) row by node."""
    groups: jax.Array
    """() how many there are."""
    first: jax.Array
    """(N,) by group, its first row."""
    kind: jax.Array
    """(2, N) by group, index into DEGREES; the one behind that of K for hubs."""
    near: jax.Array
    """(2, N + GROUP, K) by row, the first neighbours; itself where there are less."""
    by: jax.Array
    """(2, N + GROUP, K) by row, the edges to them; any where there are less."""
    start: jax.Array
    """(2, N + GROUP) by row, where its neighbours begin in `node`."""
    degree: jax.Array
    """(2, N + GROUP) by row, how many it has."""
    node: jax.Array
    """(2, B) all neighbours, one row's after the other's."""
    edge: jax.Array
    """(2, B) the edges to them."""


def label_dtype(num_nodes: int) -> type[np.unsignedinteger]:
    """Return the smallest unsigned integer that holds labels and one more."""
    return np.uint8 if num_nodes < 255 else np.uint16


def order(
    edges: np.ndarray, num_nodes: int, place: np.ndarray | None = None
) -> jax.Array | None:
    """Prepare sweeps over a graph, on the host.

    Args:
      edges: (B, 2) nodes; an edge of a node with itself is padding.
      num_nodes: N.
      place: (N,) nodes are visited from low to high; None visits them by number. It
        changes no result, but sweeps are fewer if most edges are short along it.

    Returns:
      A sweep (M,), an `Order` in one array, whose size follows from N and B alone; None
      where sweeps are not for the graph: it has no edges, or too many nodes.
    """
    edges = np.asarray(edges)
    if len(edges) == 0 or num_nodes >= LIMIT:
        return None
    turn = np.arange(num_nodes)
    if place is not None:
        turn = _inverse(np.argsort(np.asarray(place), kind="stable"))
    pairs = np.sort(turn[edges], axis=1)
    visit, group = _groups(pairs[pairs[:, 0] < pairs[:, 1]], num_nodes)
    visit = _inverse(turn)[visit]
    turn = _inverse(visit)
    early, late = np.sort(turn[edges], axis=1).T
    width = _width(num_nodes, len(edges))
    sides = [_side(late, early, num_nodes, width), _side(early, late, num_nodes, width)]
    near, by, start, degree, node, edge = map(np.stack, zip(*sides, strict=True))
    most = np.zeros((2, num_nodes), int)
    for busiest, each in zip(most, degree[:, :num_nodes], strict=True):
        np.maximum.at(busiest, group, each)
    kind = np.searchsorted(steps(width), most)
    first = np.full(num_nodes, num_nodes)
    first[: group[-1] + 1] = np.flatnonzero(np.diff(group, prepend=-1))
    groups = group[-1:] + 1
    found = visit, turn, groups, first, kind, near, by, start, degree, node, edge
    return jnp.asarray(np.concatenate([x.reshape(-1) for x in found]).astype(np.uint32))


def unpack(sweep: jax.Array, num_nodes: int, num_edges: int) -> Order:
    """Return what `order` packed into one array (M,)."""
    rows, width = num_nodes + GROUP, _width(num_nodes, num_edges)
    shapes: dict[str, tuple[int, ...]] = dict(
        visit=(num_nodes,),
        turn=(num_nodes,),
        groups=(),
        first=(num_nodes,),
        kind=(2, num_nodes),
        near=(2, rows, width),
        by=(2, rows, width),
        start=(2, rows),
        degree=(2, rows),
        node=(2, num_edges),
        edge=(2, num_edges),
    )
    ends = np.cumsum([math.prod(x) for x in shapes.values()])
    parts = zip(jnp.split(sweep, ends[:-1]), shapes.items(), strict=True)
    return Order(**{name: x.reshape(shape) for x, (name, shape) in parts})


def _width(num_nodes: int, num_edges: int) -> int:
    """Return K of `Order`: twice what the nodes have on one side on average."""
    return next((d for d in DEGREES[1:] if d * num_nodes >= 2 * num_edges), MOST)


def steps(width: int) -> tuple[int, ...]:
    """Return the numbers of neighbours that are read in one step, by K of an order."""
    return DEGREES[: DEGREES.index(width) + 1]


def _inverse(permutation: np.ndarray) -> np.ndarray:
    inverse = np.empty_like(permutation)
    inverse[permutation] = np.arange(len(permutation))
    return inverse


def _groups(pairs: np.ndarray, num_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Gather nodes that a sweep can visit at once into groups.

    No node comes before a neighbour that is to come before it, so the labels are those
    of a sweep one by one. Who begins the longest chain leads a group, and those join
    that have about as many neighbours on either side, for a group is as slow as its
    busiest.

    Args:
      pairs: (B, 2) nodes by their turn, the earlier first.
      num_nodes: N.

    Returns:
      (N,) turns, in the order of the visits, and the group of each, (N,).
    """
    degree = np.stack([np.bincount(x, minlength=num_nodes) for x in pairs.T[::-1]], 1)
    behind: list[list[int]] = [[] for _ in range(num_nodes)]
    for early, late in pairs.tolist():
        behind[early].append(late)
    chain = np.zeros(num_nodes, int)
    for node in range(num_nodes - 1, -1, -1):
        chain[node] = max((chain[x] + 1 for x in behind[node]), default=0)
    waits = degree[:, 0].tolist()
    ready = np.flatnonzero(degree[:, 0] == 0)
    visit: list[int] = []
    group: list[int] = []
    while len(ready):
        near, rest = ready[:WINDOW], ready[WINDOW:]
        lead = near[np.argmax(chain[near])]
        unlike = np.abs(degree[near] - degree[lead]).sum(axis=1) - chain[near]
        unlike[near == lead] = -num_nodes - 1
        near = near[np.argsort(unlike, kind="stable")]
        chosen = near[:GROUP].tolist()
        group += [group[-1] + 1 if group else 0] * len(chosen)
        visit += chosen
        free: list[int] = []
        for late in (x for node in chosen for x in behind[node]):
            waits[late] -= 1
            if waits[late] == 0:
                free.append(late)
        ready = np.concatenate([near[GROUP:], rest, np.array(free, int)])
    return np.array(visit), np.array(group)


def _side(
    here: np.ndarray, there: np.ndarray, num_rows: int, width: int
) -> tuple[np.ndarray, ...]:
    """Return near, by, start, degree, node and edge of `Order`, of one side."""
    edge = np.flatnonzero(here != there)
    edge = edge[np.argsort(here[edge], kind="stable")]
    # The last group reads some rows more, and nothing comes of them.
    rows = np.arange(num_rows + GROUP)
    degree = np.bincount(here[edge], minlength=len(rows))
    start = np.cumsum(degree) - degree
    edge = np.pad(edge, (0, len(here) - len(edge)))
    node, slot = there[edge], np.arange(width)
    entry = np.minimum(start[:, None] + slot, len(here) - 1)
    near = np.where(slot < degree[:, None], node[entry], rows[:, None])
    return near, edge[entry], start, degree, node, edge


def islands(way: Order, alive: jax.Array) -> jax.Array:
    """Label the nodes of every copy with the smallest node that they reach.

    Args:
      way: the way through the graph, of N nodes and B edges.
      alive: (B, T) bool, where an edge connects.

    Returns:
      (N, T) labels.
    """
    num_nodes, num_copies = way.visit.shape[0], alive.shape[1]
    dtype = label_dtype(num_nodes)
    none = jnp.array(np.iinfo(dtype).max, dtype)
    names = jnp.pad(way.visit, (0, GROUP)).astype(dtype)
    labels = jnp.broadcast_to(names[:, None], (num_nodes + GROUP, num_copies))

    cut = _cut(way, alive)

    def offer(
        labels: jax.Array, at: Where, near: jax.Array, by: jax.Array
    ) -> jax.Array:
        side, first, which = at
        there = take_rows(labels, near)
        if not isinstance(which, int):
            return jnp.where(take_rows(alive, by), there, none)
        start = side, first, jnp.uint32(0)
        here = lax.dynamic_slice(cut, start, (1, GROUP, num_copies))[0]
        return there | _spread(here, which).astype(dtype)

    def ease(labels: jax.Array, count: jax.Array) -> jax.Array:
        jumps = (count >= 2 * PATIENCE) & (count % 8 == 0)
        return lax.cond(jumps, lambda x: _jump(x, way), lambda x: x, labels)

    return take_rows(_settle(labels, way, offer, ease), way.turn)


def _cut(way: Order, alive: jax.Array) -> jax.Array:
    """Pack which of each row's first neighbours are not joined to it.

    A sweep then reads one row for all of them.

    Args:
      way: the way through the graph, of N nodes and B edges.
      alive: (B, T) bool.

    Returns:
      (2, N + GROUP, T) unsigned, a bit for each of the K neighbours in `way.near`.
    """
    width = way.near.shape[2]
    dtype = jnp.uint8 if width <= 8 else jnp.uint16
    by = way.by.reshape(-1, width)

    def pack(most: int) -> jax.Array:
        packed = jnp.zeros((by.shape[0], alive.shape[1]), dtype)
        for j in range(most):
            bit = jnp.array(1 << j, dtype)
            packed |= jnp.where(take_rows(alive, by[:, j]), 0, bit).astype(dtype)
        return packed.reshape(*way.by.shape[:2], -1)

    # Every slot costs a row of edges from far away. K is twice what nodes have on one
    # side on average; in a lattice none has more than that average, nearly.
    half = -(-width // 2)
    few = jnp.max(way.degree) <= half
    packed = lax.cond(few, lambda: pack(half), lambda: pack(width))
    return lax.optimization_barrier(packed)


def _spread(bits: jax.Array, which: int) -> jax.Array:
    """Return all bits set where that one is set, none where it is not, 16 bits each."""
    # Shifts: a comparison would be made in the width of the bits, and then widened.
    first = bits.astype(jnp.uint16) << jnp.uint16(15 - which)
    signed = lax.bitcast_convert_type(first, jnp.int16)
    spread = lax.shift_right_arithmetic(signed, jnp.int16(15))
    return lax.bitcast_convert_type(spread, jnp.uint16)


def _sweep(
    rows: jax.Array,
    way: Order,
    side: jax.Array,
    offer: Offer,
) -> jax.Array:
    """Lower rows, group by group, to the least of what their neighbours offer.

    Args:
      rows: (N + GROUP or more, T).
      way: the way through the graph.
      side: () 0 forward, 1 backward.
      offer: of rows, where (side, the first row of a group, which of their neighbours,
        an int if it is in `way.near`), that neighbour of each of the group's rows (n,),
        or the row itself, and the edges to them (n,): (n, T).
    """
    zero = jnp.uint32(0)
    side = side.astype(jnp.uint32)
    width = way.near.shape[2]

    def of_degree(degree: int) -> Callable[[jax.Array, jax.Array], jax.Array]:
        def relax(rows: jax.Array, first: jax.Array) -> jax.Array:
            low = _group(rows, first)
            if degree == 0:
                return low
            at, size = (side, first, zero), (1, GROUP, degree)
            near = lax.dynamic_slice(way.near, at, size)[0]
            by = lax.dynamic_slice(way.by, at, size)[0]
            for j in range(degree):
                low = jnp.minimum(
                    low, offer(rows, (side, first, j), near[:, j], by[:, j])
                )
            return low

        return relax

    def hub(rows: jax.Array, first: jax.Array) -> jax.Array:
        at, size = (side, first), (1, GROUP)
        start = lax.dynamic_slice(way.start, at, size)[0]
        degree = lax.dynamic_slice(way.degree, at, size)[0]
        own = first + jnp.arange(GROUP, dtype=jnp.uint32)
        last = jnp.uint32(way.node.shape[1] - 1)

        def one(j: jax.Array, low: jax.Array) -> jax.Array:
            there_is = j < degree
            entry = jnp.minimum(start + j, last)
            near = jnp.where(there_is, way.node[side][entry], own)
            by = way.edge[side][entry]
            return jnp.minimum(low, offer(rows, (side, first, j), near, by))

        low = of_degree(width)(rows, first)
        return lax.fori_loop(jnp.uint32(width), jnp.max(degree), one, low)

    branches = [*map(of_degree, steps(width)), hub]

    def visit(i: jax.Array, rows: jax.Array) -> jax.Array:
        i = jnp.where(side == 0, i, way.groups - 1 - i)
        first = way.first[i]
        low = lax.switch(way.kind[side, i].astype(jnp.int32), branches, rows, first)
        # Without the barrier XLA computes the rows anew wherever they are read.
        low = lax.optimization_barrier(low)
        return lax.dynamic_update_slice(rows, low, (first, zero))

    return lax.fori_loop(zero, way.groups, visit, rows)


def take_rows(x: jax.Array, i: jax.Array) -> jax.Array:
    """Return rows i (n,) of x."""
    dims = lax.GatherDimensionNumbers((1,), (0,), (0,))
    sizes = (1, x.shape[1])
    return lax.gather(x, i[:, None], dims, sizes, mode="promise_in_bounds")


def row(x: jax.Array, i: jax.Array) -> jax.Array:
    """Return row i () of x (n, T): (1, T)."""
    return lax.dynamic_slice(x, (i, jnp.uint32(0)), (1, x.shape[1]))


def _group(x: jax.Array, first: jax.Array) -> jax.Array:
    return lax.dynamic_slice(x, (first, jnp.uint32(0)), (GROUP, x.shape[1]))


def _jump(labels: jax.Array, way: Order) -> jax.Array:
    """Take the label of the node that each is labelled with."""
    index = way.turn[labels.astype(jnp.int32)]
    return jnp.take_along_axis(labels, index, axis=0, mode="promise_in_bounds")


def _settle(
    rows: jax.Array,
    way: Order,
    offer: Offer,
    ease: Callable[[jax.Array, jax.Array], jax.Array] = lambda rows, count: rows,
) -> jax.Array:
    """Sweep to and fro until nothing changes.

    Args:
      rows: see `_sweep`.
      way: see `_sweep`.
      offer: see `_sweep`.
      ease: what may be done to the rows before a sweep, by the number of the sweep.
    """

    def half(
        carry: tuple[jax.Array, jax.Array, jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        rows, total, count, _ = carry
        rows = _sweep(ease(rows, count), way, count % 2, offer)
        now = lax.cond(count < SURE - 1, lambda x: total, _total, rows)
        # A sweep without a change is the end, for the one before went the other way.
        return rows, now, count + 1, (count < SURE) | jnp.any(now != total)

    total = jnp.zeros(rows.shape[1], jnp.uint32)
    start = rows, total, jnp.int32(0), jnp.array(True)
    return lax.while_loop(lambda c: c[3], half, start)[0]


def _total(rows: jax.Array) -> jax.Array:
    """Sum up each column; of labels below 2^32, so it falls whenever a label falls."""
    num_nodes = rows.shape[0] - GROUP
    # So many labels add up to 16 bits. The last few may count twice.
    some = min(32, LIMIT // num_nodes, num_nodes)

    def add(i: jax.Array, total: jax.Array) -> jax.Array:
        # Row by row: a slice of several would be copied. Eight at a time, as many as
        # there are registers to point at them. Behind a barrier: fused with the wider
        # sum, vectors would be half as long.
        start = jnp.minimum(i * some, jnp.uint32(num_nodes + GROUP - some))
        each = [row(rows, start + j).astype(jnp.uint16) for j in range(some)]
        eights = [each[j : j + 8] for j in range(0, some, 8)]
        sums = lax.optimization_barrier([functools.reduce(jnp.add, x) for x in eights])
        return total + functools.reduce(jnp.add, sums)[0].astype(jnp.uint32)

    count = jnp.uint32(-(-num_nodes // some))
    start = jnp.zeros(rows.shape[1], jnp.uint32)
    return lax.fori_loop(jnp.uint32(0), count, add, start)


def touched(way: Order, flags: jax.Array) -> jax.Array:
    """Return which nodes have an edge that is flagged, (B, T) bool: (N, T)."""
    num_nodes, num_copies = way.visit.shape[0], flags.shape[1]
    own = jnp.arange(GROUP, dtype=jnp.uint32)

    def offer(clean: jax.Array, at: Where, near: jax.Array, by: jax.Array) -> jax.Array:
        del clean
        return (near == at[1] + own)[:, None] | ~take_rows(flags, by)

    clean = jnp.ones((num_nodes + GROUP, num_copies), bool)
    for side in (0, 1):
        clean = _sweep(clean, way, jnp.uint32(side), offer)
    return take_rows(~clean, way.turn)


def in_tiles(num_nodes: int, sweep: jax.Array, alive: jax.Array) -> jax.Array:
    """Label the nodes of copies (T, B) of one graph, by its `order`: (T, N) int32."""
    way = unpack(sweep, num_nodes, alive.shape[1])
    return tiled(lambda x: islands(way, x), jnp.int32, alive)


def tile_width(num_rows: int) -> int:
    """Return how many copies of so many rows make a tile."""
    return LANES if num_rows * LANES <= CACHE else LANES // 2


def tiled(
    tile: Callable[..., Any],
    dtype: jax.typing.DTypeLike | None,
    *copies: jax.Array,
) -> Any:
    """Call a function of lanes on some copies at a time.

    Args:
      tile: of arrays (n, lanes), as many as `copies`: (m, lanes), one or several.
      dtype: of the result; None as it is.
      copies: arrays (T, n).

    Returns:
      (T, m), one or several.
    """
    size, num_rows = copies[0].shape
    width = min(tile_width(num_rows), -(-size // BLOCK) * BLOCK)
    tiles = -(-size // width)

    def split(x: jax.Array) -> jax.Array:
        x = jnp.pad(x, ((0, tiles * width - size), (0, 0)))
        return x.reshape(tiles, width, -1)

    # Behind a barrier, or each block that is turned would compute its part of them.
    tiles_of = lax.optimization_barrier(tuple(map(split, copies)))
    # Not a vmap: every tile stops when it is done.
    found = lax.map(lambda x: tile(*map(_to_lanes, x)), tiles_of)

    def join(x: jax.Array) -> jax.Array:
        x = x.swapaxes(1, 2).astype(dtype or x.dtype)
        return x.reshape(tiles * width, -1)[:size]

    # Or everything that reads it would turn it anew.
    return lax.optimization_barrier(jax.tree.map(join, found))


def _to_lanes(x: jax.Array) -> jax.Array:
    """Turn copies (T, n) into lanes (n, T)."""
    # By blocks: more rows at once would lie on more pages than a core keeps at hand.
    # Behind barriers: fused with what makes or reads it, a transpose is slow.
    blocks = lax.optimization_barrier(jnp.split(x, x.shape[0] // BLOCK))
    return lax.optimization_barrier(jnp.concatenate([b.T for b in blocks], axis=1))
