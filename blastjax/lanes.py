"""Many copies of one graph side by side: islands by sweeps over lanes.

Labels are rows of nodes by columns of copies, so that the neighbour that a node reads
is one contiguous row for all of them: no scatter, and no gather that differs from copy
to copy. A forward sweep lets every node take the least label of its neighbours before
it, a backward sweep of those behind it; both see what the sweep already wrote
(symmetric Gauss-Seidel), so a label crosses the whole graph in one sweep if the order
of the nodes follows the way, and a few pairs of sweeps are enough.

Nodes are visited in an order of their own; labels are node numbers all the same.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

LANES = 128
"""Copies in a tile: its labels and bonds fit a core's second cache at 512 nodes."""
LIMIT = 65535
"""Nodes from which labels no longer fit 16 bits."""
PATIENCE = 6
"""Pairs of sweeps before a tile also jumps: few tiles need it, and it costs a pair."""
DEGREES = (0, 1, 2, 3, 4, 6, 8, 12, 16)
"""A node's neighbours on one side are read in one step of the next such size."""
ROWS = 8
"""Rows of labels summed at a time."""


class Order(NamedTuple):
    """What every turn of a sweep reads, forward (0) and backward (1).

    A node's neighbours are those that the sweep has visited before it.
    """

    visit: jax.Array
    """(2, N,) node by turn."""
    kind: jax.Array
    """(2, N,) by turn, index into DEGREES; one beyond its end for hubs."""
    near: jax.Array
    """(2, N, K) by turn, the first neighbours; the node itself where there are less."""
    by: jax.Array
    """(2, N, K) by turn, the edges to them; B where there are less."""
    start: jax.Array
    """(2, N,) by turn, where its neighbours begin in `node`."""
    degree: jax.Array
    """(2, N,) by turn, how many it has."""
    node: jax.Array
    """(2, B,) all neighbours, one node's after the other's."""
    edge: jax.Array
    """(2, B,) the edges to them."""


def label_dtype(num_nodes: int) -> type[np.unsignedinteger]:
    """Return the smallest unsigned integer that holds labels and one more."""
    return np.uint8 if num_nodes < 255 else np.uint16


def order(edges: jax.Array, num_nodes: int, place: jax.Array | None = None) -> Order:
    """Prepare sweeps over a graph.

    Args:
      edges: (B, 2) nodes.
      num_nodes: N.
      place: (N,) nodes are visited from low to high; None visits them by number.
    """
    nodes = jnp.arange(num_nodes, dtype=jnp.int32)
    visit = turn = nodes
    if place is not None:
        visit = jnp.argsort(place).astype(jnp.int32)
        turn = jnp.zeros_like(nodes).at[visit].set(nodes, unique_indices=True)
    a, b = edges[:, 0], edges[:, 1]
    swap = turn[a] > turn[b]
    early, late = jnp.where(swap, b, a), jnp.where(swap, a, b)
    ways = _way(late, early, visit), _way(early, late, visit[::-1])
    return jax.tree.map(lambda *x: jnp.stack(x), *ways)


def _way(here: jax.Array, there: jax.Array, visit: jax.Array) -> Order:
    num_edges = here.shape[0]
    edge = jnp.arange(num_edges, dtype=jnp.int32)
    _, edge = lax.sort_key_val(here, edge)
    node = there[edge]
    count = jnp.zeros_like(visit).at[here].add(1)
    start = (jnp.cumsum(count, dtype=jnp.int32) - count)[visit]
    count = count[visit]
    steps = jnp.asarray(DEGREES, jnp.int32)
    kind = jnp.sum(count[:, None] > steps[None], axis=1, dtype=jnp.int32)
    slot = jnp.arange(DEGREES[-1], dtype=jnp.int32)[None]
    there_is = slot < count[:, None]
    entry = jnp.minimum(start[:, None] + slot, num_edges - 1)
    near = jnp.where(there_is, node[entry], visit[:, None])
    by = jnp.where(there_is, edge[entry], num_edges)
    return Order(visit, kind, near, by, start, count, node, edge)


def islands(way: Order, dead: jax.Array) -> jax.Array:
    """Label the nodes of every copy with the smallest node that they reach.

    Args:
      way: the way through the graph, of N nodes and B edges.
      dead: (B + 1, T) of the label's dtype: 0 where an edge connects, all ones where it
        does not; the last row is all ones.

    Returns:
      (N, T) labels.
    """
    num_nodes, lanes = way.visit.shape[1], dead.shape[1]
    rows = -(-num_nodes // ROWS) * ROWS
    labels = lax.broadcasted_iota(dead.dtype, (rows, lanes), 0)

    def offer(
        labels: jax.Array, here: jax.Array, node: jax.Array, edge: jax.Array
    ) -> jax.Array:
        del here
        return _row(labels, node) | _row(dead, edge)

    def half(
        carry: tuple[jax.Array, jax.Array, jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        labels, total, count, _ = carry
        jumps = (count >= 2 * PATIENCE) & (count % 2 == 0)
        labels = lax.cond(jumps, _jump, lambda x: x, labels)
        labels = _sweep(labels, way, count % 2, offer)
        now = _total(labels)
        # A sweep without a change is the end, for the one before went the other way.
        return labels, now, count + 1, (count == 0) | jnp.any(now != total)

    start = labels, _total(labels), jnp.int32(0), jnp.array(True)
    return lax.while_loop(lambda c: c[3], half, start)[0][:num_nodes]


def _sweep(
    rows: jax.Array,
    way: Order,
    side: jax.Array,
    offer: Callable[[jax.Array, jax.Array, jax.Array, jax.Array], jax.Array],
) -> jax.Array:
    """Lower each node's row to the least of offer(rows, node, neighbour, edge)."""

    def of_degree(degree: int) -> Callable[[jax.Array, jax.Array], jax.Array]:
        def relax(rows: jax.Array, i: jax.Array) -> jax.Array:
            here = way.visit[side, i]
            low = _row(rows, here)
            for j in range(degree):
                node, edge = way.near[side, i, j], way.by[side, i, j]
                low = jnp.minimum(low, offer(rows, here, node, edge))
            return low

        return relax

    def hub(rows: jax.Array, i: jax.Array) -> jax.Array:
        here = way.visit[side, i]

        def one(j: jax.Array, low: jax.Array) -> jax.Array:
            j = way.start[side, i] + j
            node, edge = way.node[side, j], way.edge[side, j]
            return jnp.minimum(low, offer(rows, here, node, edge))

        return lax.fori_loop(0, way.degree[side, i], one, _row(rows, here))

    branches = [*map(of_degree, DEGREES), hub]

    def turn(i: jax.Array, rows: jax.Array) -> jax.Array:
        low = lax.switch(way.kind[side, i], branches, rows, i)
        # Without the barrier XLA computes the row anew wherever it is read.
        low = lax.optimization_barrier(low)
        here = way.visit[side, i], jnp.int32(0)
        return lax.dynamic_update_slice(rows, low, here)

    return lax.fori_loop(0, way.visit.shape[1], turn, rows)


def _row(x: jax.Array, i: jax.Array) -> jax.Array:
    return x.at[i].get(mode="promise_in_bounds")[None]


def _total(labels: jax.Array) -> jax.Array:
    """Sum up each column; below 2^32, so it falls whenever a label falls."""
    rows, lanes = labels.shape

    def add(i: jax.Array, total: jax.Array) -> jax.Array:
        slab = lax.dynamic_slice(labels, (i * ROWS, jnp.int32(0)), (ROWS, lanes))
        return total + slab.astype(jnp.uint32)

    start = jnp.zeros((ROWS, lanes), jnp.uint32)
    return lax.fori_loop(0, rows // ROWS, add, start).sum(axis=0)


def _jump(labels: jax.Array) -> jax.Array:
    index = labels.astype(jnp.int32)
    return jnp.take_along_axis(labels, index, axis=0, mode="promise_in_bounds")


def to_dead(alive: jax.Array, dtype: type[np.unsignedinteger]) -> jax.Array:
    """Turn the edges of copies (T, B) bool into (B + 1, T) for `islands`."""
    lanes, num_edges = alive.shape
    words = -(-num_edges // 4)
    alive = jnp.pad(alive, ((0, 0), (0, 4 * words - num_edges)))
    # Four flags move as one word: a transpose costs by the element.
    packed = alive.astype(jnp.uint8).reshape(lanes, words, 4)
    word = lax.optimization_barrier(lax.bitcast_convert_type(packed, jnp.uint32).T)
    shift = jnp.arange(4, dtype=jnp.uint32)[None, :, None] * jnp.uint32(8)
    flag = (word[:, None, :] >> shift).astype(dtype) & dtype(1)
    dead = (flag - dtype(1)).reshape(4 * words, lanes)[:num_edges]
    none = jnp.full((1, lanes), np.iinfo(dtype).max, dtype)
    return jnp.concatenate([dead, none])


def from_labels(labels: jax.Array) -> jax.Array:
    """Turn labels (N, T) into (T, N) int32."""
    num_nodes, lanes = labels.shape
    each = 4 // labels.dtype.itemsize
    words = -(-num_nodes // each)
    labels = jnp.pad(labels, ((0, each * words - num_nodes), (0, 0)))
    parts = labels.reshape(words, each, lanes).astype(jnp.uint32)
    word = parts[:, 0]
    for i in range(1, each):
        word = word | (parts[:, i] << jnp.uint32(8 * labels.dtype.itemsize * i))
    word = lax.optimization_barrier(word).T
    flat = lax.bitcast_convert_type(lax.optimization_barrier(word), labels.dtype)
    return flat.reshape(lanes, -1)[:, :num_nodes].astype(jnp.int32)


def in_tiles(edges: jax.Array, place: jax.Array, alive: jax.Array) -> jax.Array:
    """Label the nodes of copies (T, B) of one graph: (T, N) int32."""
    num_nodes = place.shape[0]
    dtype, way = label_dtype(num_nodes), order(edges, num_nodes, place)
    return tiled(lambda x: from_labels(islands(way, to_dead(x, dtype))), alive)


def tiled(tile: Callable[..., Any], *copies: jax.Array) -> Any:
    """Call tile on so many copies (T, ...) at a time, and join what it returns."""
    size = copies[0].shape[0]
    width = min(LANES, -(-size // 32) * 32)
    tiles = -(-size // width)

    def split(x: jax.Array) -> jax.Array:
        x = jnp.pad(x, ((0, tiles * width - size), (0, 0)))
        return x.reshape(tiles, width, -1)

    # Not a vmap: every tile stops when it is done.
    found = lax.map(lambda x: tile(*x), tuple(map(split, copies)))
    return jax.tree.map(lambda x: x.reshape(tiles * width, -1)[:size], found)
