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
    edges: jax.Array, weight: jax.Array, source: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Search one graph.

    Every tree without a source hooks onto the tree behind the cheapest edge that leaves
    it. No edge inside a tree is dearer than the one by which it hooks, so the maximum
    along the hooks is the answer, found by pointer doubling.

    Args:
      edges: (B, 2) nodes.
      weight: (B,) floats; an edge costs the less, the more it weighs.
      source: (N,) bool.

    Returns:
      (N,) the weight of the bottleneck, infinite at sources, minus infinity where no
      way leads; and (N,) int32, which edge it is, any where the weight is infinite.
    """
    num_nodes, num_edges = source.shape[0], edges.shape[0]
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
    sweep: jax.Array, weight: jax.Array, source: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Search copies of one graph.

    Args:
      sweep: (M,) its `lanes.order`.
      weight: (T, B) see `rounds`.
      source: (T, N) bool.

    Returns:
      (T, N) weights and (T, N) edges, see `rounds`.
    """
    way = lanes.unpack(sweep, source.shape[1], weight.shape[1])

    def tile(weight: jax.Array, source: jax.Array) -> tuple[jax.Array, jax.Array]:
        cost, (free, none) = _cost(weight), _bounds(weight.dtype)
        start = jnp.where(lanes.take_rows(source, way.visit), free, none)
        level, last = _levels(way, cost, start)
        edge = _follow(_steps(way, cost, level, last), cost.shape[0])
        return lanes.take_rows(level, way.turn), edge

    level, edge = lanes.tiled(tile, None, weight, source)
    return _weight(level, weight.dtype), edge.astype(jnp.int32)


Lowest = Callable[[lanes.Order, jax.Array, jax.Array, jax.Array, jax.Array], jax.Array]
"""Of way, costs, levels, side and row: the lowest of what it has and is offered."""


def _of_degree(degree: int) -> Lowest:
    def lowest(
        way: lanes.Order,
        cost: jax.Array,
        level: jax.Array,
        side: jax.Array,
        row: jax.Array,
    ) -> jax.Array:
        low = lanes.row(level, row)
        for j in range(degree):
            near, by = way.near[side, row, j], way.by[side, row, j]
            low = jnp.minimum(
                low, jnp.maximum(lanes.row(level, near), lanes.row(cost, by))
            )
        return low

    return lowest


def _of_hub(
    way: lanes.Order,
    cost: jax.Array,
    level: jax.Array,
    side: jax.Array,
    row: jax.Array,
) -> jax.Array:
    def lower(low: jax.Array, near: jax.Array, by: jax.Array) -> jax.Array:
        return jnp.minimum(
            low, jnp.maximum(lanes.row(level, near), lanes.row(cost, by))
        )

    return _over_neighbours(way, side, row, lower, lanes.row(level, row))


def _over_neighbours(
    way: lanes.Order,
    side: jax.Array,
    row: jax.Array,
    fold: Callable[[jax.Array, jax.Array, jax.Array], jax.Array],
    start: jax.Array,
) -> jax.Array:
    """Fold a row's neighbours on one side, and the edges to them, one by one."""

    def one(j: jax.Array, folded: jax.Array) -> jax.Array:
        return fold(folded, way.node[side, j], way.edge[side, j])

    first = way.start[side, row]
    return lax.fori_loop(first, first + way.degree[side, row], one, start)


def _levels(
    way: lanes.Order, cost: jax.Array, level: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Sweep to and fro until no level falls.

    Args:
      way: the way through the graph, of N nodes and B edges.
      cost: (B, T) of `_cost`.
      level: (N, T) by row, least at sources, else greatest.

    Returns:
      Levels, and the sweep in which each fell last, unsigned: odd for backward sweeps,
      0 for those that never fell. (N, T) each.
    """
    num_rows, size = level.shape
    # Row by row: groups, as for islands, would visit more than they save.
    steps = lanes.steps(way.near.shape[2])
    kind = jnp.sum(
        way.degree[..., None] > jnp.array(steps, jnp.uint32)[None, None],
        axis=-1,
        dtype=jnp.int32,
    )
    ways = [*map(_of_degree, steps), _of_hub]
    last = jnp.zeros(level.shape, _step_dtype(num_rows + cost.shape[0]))
    none = jnp.zeros((1, size), bool)

    def sweep(
        carry: tuple[jax.Array, jax.Array, jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        level, last, count, _ = carry
        side, now = count % 2, count.astype(last.dtype)

        def visit(
            i: jax.Array, carry: tuple[jax.Array, jax.Array, jax.Array]
        ) -> tuple[jax.Array, jax.Array, jax.Array]:
            level, last, moved = carry
            row = jnp.where(side == 0, i, jnp.uint32(num_rows - 1) - i)

            def branch(lowest: Lowest) -> Callable[..., tuple[jax.Array, ...]]:
                def new(level: jax.Array, last: jax.Array) -> tuple[jax.Array, ...]:
                    low = lowest(way, cost, level, side, row)
                    fell = low < lanes.row(level, row)
                    when = jnp.where(fell, now, lanes.row(last, row))
                    return low, when, moved | fell

                return new

            found = lax.switch(kind[side, row], [*map(branch, ways)], level, last)
            # Without the barrier XLA copies all rows to write one.
            low, when, moved = lax.optimization_barrier(found)
            return _put(level, low, row), _put(last, when, row), moved

        start, stop = jnp.uint32(0), jnp.uint32(num_rows)
        level, last, moved = lax.fori_loop(start, stop, visit, (level, last, none))
        # A sweep without a change is the end, for the one before went the other way.
        return level, last, count + 1, (count == 1) | jnp.any(moved)

    carry = level, last, jnp.uint32(1), jnp.array(True)
    return lax.while_loop(lambda c: c[3], sweep, carry)[:2]


def _steps(
    way: lanes.Order, cost: jax.Array, level: jax.Array, last: jax.Array
) -> jax.Array:
    """Find from where each node has its level.

    A node fell last by a neighbour on that side of it. If their edge does not cost the
    level, the neighbour has it too, and had it before: so steps to such neighbours
    never go round in circles.

    Args:
      way: see `_levels`.
      cost: see `_levels`.
      level: of `_levels`.
      last: of `_levels`.

    Returns:
      (N, T) by node, unsigned: the edge where the step is over a bottleneck, else B +
      the node to step to. Edge 0 where no step leads on.
    """
    num_rows, num_edges = level.shape[0], cost.shape[0]

    def visit(side: jax.Array, row: jax.Array, step: jax.Array) -> jax.Array:
        here, when = lanes.row(level, row), lanes.row(last, row)

        def find(best: jax.Array, near: jax.Array, by: jax.Array) -> jax.Array:
            there, price = lanes.row(level, near), lanes.row(cost, by)
            leads = (jnp.maximum(there, price) == here) & (near != row)
            before = (lanes.row(last, near) <= when) | (there < here)
            on = num_edges + way.visit[near].astype(by.dtype)
            to = jnp.where(price == here, by, on)
            return jnp.where(leads & before, to.astype(best.dtype), best)

        best = _over_neighbours(way, side, row, find, jnp.zeros_like(when))
        mine = when % 2 == side.astype(when.dtype)
        best = jnp.where(mine, best, lanes.row(step, row))
        return _put(step, lax.optimization_barrier(best), row)

    step = jnp.zeros_like(last)
    for side in (0, 1):
        one = functools.partial(visit, jnp.uint32(side))
        step = lax.fori_loop(jnp.uint32(0), jnp.uint32(num_rows), one, step)
    return lanes.take_rows(step, way.turn)


def _follow(step: jax.Array, num_edges: int) -> jax.Array:
    """Follow steps (N, T) from node to node to an edge, by pointer doubling."""

    def double(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        step, _ = carry
        node = jnp.maximum(step.astype(jnp.int32) - num_edges, 0)
        then = jnp.take_along_axis(step, node, axis=0, mode="promise_in_bounds")
        step = jnp.where(step < num_edges, step, then)
        return step, jnp.any(step >= num_edges)

    return lax.while_loop(lambda c: c[1], double, (step, jnp.array(True)))[0]


def _put(x: jax.Array, row: jax.Array, i: jax.Array) -> jax.Array:
    return lax.dynamic_update_slice(x, row, (i, jnp.uint32(0)))


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
