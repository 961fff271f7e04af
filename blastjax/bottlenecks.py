"""Ways to sources whose dearest edge is as cheap as possible: one graph, many copies.

The level of a node is what the dearest edge on its best way costs, and that edge is its
bottleneck. One graph is solved by Boruvka's rounds, many copies side by side by sweeps
over lanes (see `lanes`): first the levels, then by which neighbour each node came to
its own, then along these neighbours to the bottleneck.

Costs are integers of the order of floats: a vector's least of two floats, which must
heed NaN, takes several times as long.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from blastjax import lanes


def rounds(
    edges: jax.Array, place: jax.Array, weight: jax.Array, source: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Search one graph.

    Every tree without a source hooks onto the tree behind the cheapest edge that leaves
    it. No edge inside a tree is dearer than the one by which it hooks, so the maximum
    along the hooks is the answer, found by pointer doubling.

    Args:
      edges: (B, 2) nodes.
      place: (N,) not looked at.
      weight: (B,) floats; an edge costs the less, the more it weighs.
      source: (N,) bool.

    Returns:
      (N,) the weight of the bottleneck, infinite at sources, minus infinity where no
      way leads; and (N,) int32, which edge it is, any where the weight is infinite.
    """
    num_nodes, num_edges = place.shape[0], edges.shape[0]
    cost, (free, none) = _cost(weight), _bounds(weight.dtype)
    nodes = jnp.arange(num_nodes, dtype=jnp.int32)
    first, second = edges[:, 0], edges[:, 1]
    index = jnp.arange(num_edges, dtype=jnp.int32)

    def hook(
        carry: tuple[jax.Array, jax.Array, jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        root, up, edge, _ = carry
        a, b = root[first], root[second]
        out = jnp.where(a != b, cost, none)
        best = jnp.full(num_nodes, none).at[a].min(out).at[b].min(out)
        # Of equal edges the first: without one order for all, hooks could form rings.
        at_a = jnp.where((out < none) & (out == best[a]), index, num_edges)
        at_b = jnp.where((out < none) & (out == best[b]), index, num_edges)
        pick = jnp.full(num_nodes, num_edges, jnp.int32).at[a].min(at_a).at[b].min(at_b)
        chosen = jnp.minimum(pick, num_edges - 1)
        to = jnp.where(a[chosen] == nodes, b[chosen], a[chosen])
        hooks = (pick < num_edges) & ~source
        # Two trees that choose the same edge: the one of the lower root stays.
        hooks = hooks & ~((pick[to] == pick) & ~source[to] & (nodes < to))
        to = jnp.where(hooks, to, nodes)
        up, edge = jnp.where(hooks, to, up), jnp.where(hooks, pick, edge)
        return _ends(to)[root], up, edge, jnp.any(hooks)

    start = nodes, nodes, jnp.full_like(nodes, -1), jnp.array(True)
    _, up, edge, _ = lax.while_loop(lambda c: c[3], hook, start)

    def double(
        carry: tuple[jax.Array, jax.Array, jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        up, level, edge, _ = carry
        dearer = level[up] > level
        level = jnp.where(dearer, level[up], level)
        edge = jnp.where(dearer, edge[up], edge)
        return up[up], level, edge, jnp.any(up[up] != up)

    # Trees that reach no source end at a root of their own.
    level = jnp.where(source, free, jnp.where(edge < 0, none, cost[edge]))
    carry = up, level, edge, jnp.array(True)
    _, level, edge, _ = lax.while_loop(lambda c: c[3], double, carry)
    return _weight(level, weight.dtype), jnp.maximum(edge, 0)


def _ends(pointer: jax.Array) -> jax.Array:
    """Follow (N,) pointers to where they end."""

    def jump(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        pointer, _ = carry
        further = pointer[pointer]
        return further, jnp.any(further != pointer)

    start = (pointer, jnp.array(True))
    return lax.while_loop(lambda c: c[1], jump, start)[0]


def in_tiles(
    edges: jax.Array, place: jax.Array, weight: jax.Array, source: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Search copies of one graph.

    Args:
      edges: (B, 2) nodes.
      place: (N,) see `lanes.order`.
      weight: (T, B) see `rounds`.
      source: (T, N) bool.

    Returns:
      (T, N) weights and (T, N) edges, see `rounds`.
    """
    num_edges, num_nodes = edges.shape[0], place.shape[0]
    way = lanes.order(edges, num_nodes, place)
    free, none = _bounds(weight.dtype)
    # A step must not lead to where it began.
    loops = edges[:, 0] == edges[:, 1]

    def tile(weight: jax.Array, source: jax.Array) -> tuple[jax.Array, jax.Array]:
        cost = jnp.where(loops[None], none, _cost(weight))
        row = jnp.full((1, weight.shape[0]), none)
        cost = jnp.concatenate([lax.optimization_barrier(cost.T), row])
        level, sweep = _levels(way, cost, jnp.where(source.T, free, none))
        step = lanes.from_labels(_steps(way, cost, level, sweep))
        edge = jnp.minimum(_follow(step, num_nodes) - num_nodes, num_edges - 1)
        return _weight(lax.optimization_barrier(level).T, weight.dtype), edge

    return lanes.tiled(tile, weight, source)


Lowest = Callable[..., jax.Array]
"""Of way, costs, levels, side, turn and the node's own row: the lowest of offers."""


def _by(
    level: jax.Array, cost: jax.Array, node: jax.Array, edge: jax.Array
) -> jax.Array:
    return jnp.maximum(_row(level, node), _row(cost, edge))


def _of_degree(degree: int) -> Lowest:
    def lowest(
        way: lanes.Order,
        cost: jax.Array,
        level: jax.Array,
        side: jax.Array,
        i: jax.Array,
        low: jax.Array,
    ) -> jax.Array:
        for j in range(degree):
            by = _by(level, cost, way.near[side, i, j], way.by[side, i, j])
            low = jnp.minimum(low, by)
        return low

    return lowest


def _of_hub(
    way: lanes.Order,
    cost: jax.Array,
    level: jax.Array,
    side: jax.Array,
    i: jax.Array,
    low: jax.Array,
) -> jax.Array:
    def one(j: jax.Array, low: jax.Array) -> jax.Array:
        by = _by(level, cost, way.node[side, j], way.edge[side, j])
        return jnp.minimum(low, by)

    start = way.start[side, i]
    return lax.fori_loop(start, start + way.degree[side, i], one, low)


LOWEST = [*map(_of_degree, lanes.DEGREES), _of_hub]
"""By the kind of a turn."""


def _levels(
    way: lanes.Order, cost: jax.Array, level: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Sweep to and fro until no level falls.

    Args:
      way: the way through the graph, of N nodes and B edges.
      cost: (B + 1, T) of `_cost`, the last row the greatest.
      level: (N, T) least at sources, else greatest.

    Returns:
      (N, T) levels, and (N, T) unsigned, the sweep in which each fell last: odd for
      backward sweeps, 0 for those that never fell.
    """
    num_nodes, size = level.shape

    def sweep(
        carry: tuple[jax.Array, jax.Array, jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        level, last, count, _ = carry
        side, now = count % 2, count.astype(last.dtype)

        def turn(
            i: jax.Array, carry: tuple[jax.Array, jax.Array, jax.Array]
        ) -> tuple[jax.Array, jax.Array, jax.Array]:
            level, last, moved = carry
            here = way.visit[side, i]

            def branch(lowest: Lowest) -> Callable[..., tuple[jax.Array, ...]]:
                def rows(level: jax.Array, last: jax.Array) -> tuple[jax.Array, ...]:
                    old = _row(level, here)
                    low = lowest(way, cost, level, side, i, old)
                    when = jnp.where(low < old, now, _row(last, here))
                    return low, when, moved | (low < old)

                return rows

            found = lax.switch(way.kind[side, i], [*map(branch, LOWEST)], level, last)
            # Without the barrier XLA copies all rows to write one.
            low, when, moved = lax.optimization_barrier(found)
            return _put(level, low, here), _put(last, when, here), moved

        none = jnp.zeros((1, size), bool)
        level, last, moved = lax.fori_loop(0, num_nodes, turn, (level, last, none))
        # A sweep without a change is the end, for the one before went the other way.
        return level, last, count + 1, (count == 1) | jnp.any(moved)

    last = jnp.zeros(level.shape, _step_dtype(num_nodes + cost.shape[0]))
    carry = level, last, jnp.int32(1), jnp.array(True)
    return lax.while_loop(lambda c: c[3], sweep, carry)[:2]


def _steps(
    way: lanes.Order, cost: jax.Array, level: jax.Array, last: jax.Array
) -> jax.Array:
    """Find from where each node has its level.

    A node fell last by a neighbour that its sweep had visited before. If their edge
    does not cost the level, the neighbour has it too, and had it before: so steps to
    such neighbours never go round in circles.

    Args:
      way: see `_levels`.
      cost: see `_levels`.
      level: (N, T) of `_levels`.
      last: (N, T) of `_levels`.

    Returns:
      (N, T) unsigned: N + edge where the step is over a bottleneck, else the node to
      step to. N + B where no step leads on.
    """
    num_nodes, num_edges = level.shape[0], cost.shape[0] - 1

    def turn(side: jax.Array, i: jax.Array, step: jax.Array) -> jax.Array:
        here = way.visit[side, i]
        near, when = _row(level, here), _row(last, here)

        def offer(j: jax.Array, best: jax.Array) -> jax.Array:
            node, edge = way.node[side, j], way.edge[side, j]
            far, price = _row(level, node), _row(cost, edge)
            leads = jnp.maximum(far, price) == near
            before = (_row(last, node) <= when) | (far < near)
            to = jnp.where(price == near, num_nodes + edge, node).astype(best.dtype)
            return jnp.where(leads & before, to, best)

        start, none = way.start[side, i], jnp.full_like(when, num_nodes + num_edges)
        best = lax.fori_loop(start, start + way.degree[side, i], offer, none)
        mine = when % 2 == side.astype(when.dtype)
        best = jnp.where(mine, best, _row(step, here))
        return _put(step, lax.optimization_barrier(best), here)

    step = jnp.zeros_like(last)
    for side in (0, 1):
        step = lax.fori_loop(
            0, num_nodes, functools.partial(turn, jnp.int32(side)), step
        )
    return step


def _follow(step: jax.Array, num_nodes: int) -> jax.Array:
    """Follow (T, N) steps from node to node to what is none, by pointer doubling."""

    def double(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        step, _ = carry
        node = jnp.minimum(step, num_nodes - 1)
        next_ = jnp.take_along_axis(step, node, axis=1, mode="promise_in_bounds")
        step = jnp.where(step < num_nodes, next_, step)
        return step, jnp.any(step < num_nodes)

    return lax.while_loop(lambda c: c[1], double, (step, jnp.array(True)))[0]


def _row(x: jax.Array, i: jax.Array) -> jax.Array:
    return x.at[i].get(mode="promise_in_bounds")[None]


def _put(x: jax.Array, row: jax.Array, i: jax.Array) -> jax.Array:
    return lax.dynamic_update_slice(x, row, (i, jnp.int32(0)))


def _step_dtype(steps: int) -> type[np.unsignedinteger]:
    return np.uint16 if steps <= lanes.LIMIT else np.uint32


def _cost(weight: jax.Array) -> jax.Array:
    """Turn weights into integers of the opposite order; NaN costs the most."""
    cost = -jnp.where(weight > -jnp.inf, weight, -jnp.inf)
    integer = jnp.dtype(f"int{8 * cost.dtype.itemsize}")
    return _flip(lax.bitcast_convert_type(cost, integer))


def _weight(cost: jax.Array, dtype: jnp.dtype) -> jax.Array:
    """Invert `_cost`."""
    return -lax.bitcast_convert_type(_flip(cost), dtype)


def _bounds(dtype: jnp.dtype) -> tuple[jax.Array, jax.Array]:
    """Return the least and the greatest cost."""
    return _cost(jnp.array(jnp.inf, dtype)), _cost(jnp.array(-jnp.inf, dtype))


def _flip(integer: jax.Array) -> jax.Array:
    """Change the order of the negative ones: its own inverse."""
    return jnp.where(integer < 0, integer ^ jnp.iinfo(integer.dtype).max, integer)
