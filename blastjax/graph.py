"""Kernels on plain arrays: islands of a graph, best ways, sums over groups.

Node numbers are int32. A group number outside the range, such as a negative one, is
dropped: padding needs no special case.
"""

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from blastjax import lanes

FEW = 8
"""Copies below which sweeps do not pay."""


def islands(
    edges: jax.Array,
    alive: jax.Array,
    num_nodes: int,
    *,
    place: jax.Array | None = None,
) -> jax.Array:
    """Label every node with the smallest node that it can reach.

    Args:
      edges: (B, 2) nodes.
      alive: (B,) bool, the edges that connect.
      num_nodes: N.
      place: (N,) a coordinate along which most edges are short. It changes no result,
        only how fast batches are; None takes the numbers of the nodes.

    Returns:
      (N,) int32 labels. Piecewise constant: it has no derivative to speak of.

    One graph is solved in rounds that hook the larger root of every edge to the smaller
    one, then halve the paths twice. A `vmap` over `alive` alone, on the CPU, sweeps
    over all copies side by side instead (see `lanes`).
    """
    if edges.shape[0] == 0:
        return jnp.arange(num_nodes, dtype=jnp.int32)
    if place is None:
        place = jnp.arange(num_nodes, dtype=jnp.int32)
    if num_nodes >= lanes.LIMIT:
        return _hook_and_jump(edges, place, alive)
    search = _one(_hook_and_jump, lanes.in_tiles)
    return search(edges, jax.lax.stop_gradient(place), alive)


def _hook_and_jump(edges: jax.Array, place: jax.Array, alive: jax.Array) -> jax.Array:
    num_nodes = place.shape[0]
    first, second = edges[:, 0], edges[:, 1]
    nodes = jnp.arange(num_nodes, dtype=jnp.int32)

    def hook(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        label, _ = carry
        a, b = label[first], label[second]
        low = jnp.where(alive, jnp.minimum(a, b), num_nodes)
        new = label.at[jnp.maximum(a, b)].min(low)
        new = new[new]
        new = new[new]
        return new, jnp.any(new != label)

    start = (nodes, jnp.array(True))
    return jax.lax.while_loop(lambda carry: carry[1], hook, start)[0]


Kernel = Callable[..., jax.Array]
"""A search: of edges (B, 2), place (N,), and arrays of what it is to know of them."""


@functools.cache
def _one(rounds: Kernel, sweeps: Kernel) -> Kernel:
    """Return the search of one graph, which knows what a batch of it should do.

    Args:
      rounds: searches one graph.
      sweeps: searches many copies of one graph; all but edges and place is (T, ...).
    """

    @jax.custom_batching.custom_vmap
    def one(edges: jax.Array, place: jax.Array, *known: jax.Array) -> jax.Array:
        return rounds(edges, place, *known)

    @one.def_vmap
    def batched(
        size: int, is_batched: Sequence[bool], *args: jax.Array
    ) -> tuple[jax.Array, bool]:
        edges, place, *known = _full(size, is_batched, args)
        if is_batched[0]:
            return jax.vmap(rounds)(edges, place, *known), True
        # The place changes no result: that of the first copy is as good as any.
        return _many(rounds, sweeps)(edges[0], place[0], *known), True

    return one


@functools.cache
def _many(rounds: Kernel, sweeps: Kernel) -> Kernel:
    """Return the search of many copies of one graph."""

    @jax.custom_batching.custom_vmap
    def many(edges: jax.Array, place: jax.Array, *known: jax.Array) -> jax.Array:
        def each(edges: jax.Array, place: jax.Array, *known: jax.Array) -> jax.Array:
            return jax.vmap(lambda *x: rounds(edges, place, *x))(*known)

        # A sweep is one long chain of small steps, the wrong thing for an accelerator,
        # and for a handful of copies.
        if known[0].shape[0] < FEW:
            return each(edges, place, *known)
        return jax.lax.platform_dependent(
            edges, place, *known, cpu=sweeps, default=each
        )

    @many.def_vmap
    def batched(
        size: int, is_batched: Sequence[bool], *args: jax.Array
    ) -> tuple[jax.Array, bool]:
        edges, place, *known = _full(size, is_batched, args)
        if is_batched[0]:
            # Different graphs: together if each has one copy, else one by one.
            if known[0].shape[1] == 1:
                only = jax.vmap(rounds)(edges, place, *[x[:, 0] for x in known])
                return only[:, None], True
            return jax.lax.map(lambda x: many(*x), (edges, place, *known)), True
        copies = [x.reshape(-1, *x.shape[2:]) for x in known]
        found = many(edges[0], place[0], *copies)
        return found.reshape(*known[0].shape[:2], -1), True

    return many


def _full(
    size: int, is_batched: Sequence[bool], args: Sequence[jax.Array]
) -> list[jax.Array]:
    return [
        x if b else jnp.broadcast_to(x, (size, *x.shape))
        for x, b in zip(args, is_batched, strict=True)
    ]


def shortest_ways(
    edges: jax.Array,
    length: jax.Array,
    source: jax.Array,
    limit: jax.Array,
    num_nodes: int,
) -> jax.Array:
    """Return the length of the shortest way from a source to every node.

    Args:
      edges: (B, 2) nodes.
      length: (B,) not negative, infinite for edges that lead nowhere.
      source: () node, negative for none.
      limit: () ways this long and longer are not followed further.
      num_nodes: N.

    Returns:
      (N,) lengths, infinite where no way leads. Constant under differentiation.
    """
    length, limit = jax.lax.stop_gradient((length, limit))
    start = jnp.where(
        jnp.arange(num_nodes, dtype=jnp.int32) == source, 0, jnp.inf
    ).astype(length.dtype)
    if edges.shape[0] == 0:
        return start
    near = jnp.concatenate([edges[:, 0], edges[:, 1]])
    far = jnp.concatenate([edges[:, 1], edges[:, 0]])
    both = jnp.concatenate([length, length])

    def relax(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        way, _ = carry
        offer = way[near] + both
        new = way.at[far].min(jnp.where(offer < limit, offer, jnp.inf))
        return new, jnp.any(new < way)

    return jax.lax.while_loop(lambda c: c[1], relax, (start, jnp.array(True)))[0]


def bottleneck(
    edges: jax.Array,
    weight: jax.Array,
    source: jax.Array,
    num_nodes: int,
    *,
    place: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Find the way to a source whose weakest edge is as strong as possible.

    Args:
      edges: (B, 2) nodes.
      weight: (B,) strength, any sign; minus infinity or NaN if an edge leads nowhere.
      source: (N,) bool, the nodes to reach.
      num_nodes: N.
      place: (N,) see `islands`.

    Returns:
      (N,) weight of the weakest edge on the best way: infinite at the sources, minus
      infinity where no way leads; and (N,) int32, which edge it is, -1 where the weight
      is infinite. A node reaches a source over edges above t if and only if its weight
      is above t. The derivative is one for the weakest edge and zero for all others,
      exact wherever no two weights tie; of equal edges one is chosen.

    One graph is solved by Boruvka's rounds. A `vmap` over weights and sources, on the
    CPU, sweeps over all copies side by side instead (see `lanes`).
    """
    num_edges = edges.shape[0]
    lowest = jnp.array(-jnp.inf, weight.dtype)
    if num_edges == 0:
        none = jnp.full(num_nodes, -1, jnp.int32)
        return jnp.where(source, jnp.inf, lowest), none
    # Searches run on constants: nothing in there is differentiated.
    strength = jax.lax.stop_gradient(weight)
    strength = jnp.where(strength > lowest, strength, lowest)
    if place is None:
        place = jnp.arange(num_nodes, dtype=jnp.int32)
    search = _one(_boruvka, lanes.bottlenecks_in_tiles)
    cost = lanes.to_rank(-strength)
    edge = search(edges, jax.lax.stop_gradient(place), cost, source)
    # Sources and what infinite weights lead to have one past the last edge.
    found = (edge >= 0) & (edge < num_edges)
    pick = jnp.where(found, edge, 0)
    finite = found & jnp.isfinite(strength[pick])
    bound = jnp.where(found, strength[pick], jnp.where(edge < 0, -jnp.inf, jnp.inf))
    least = jnp.where(finite, weight[pick], bound.astype(weight.dtype))
    return least, jnp.where(finite, edge, -1)


def _boruvka(
    edges: jax.Array, place: jax.Array, cost: jax.Array, source: jax.Array
) -> jax.Array:
    """Return which edge is the dearest on the cheapest way to a source, (N,) int32.

    Every tree without a source hooks onto the tree behind the cheapest edge that leaves
    it. No edge inside a tree is dearer than the one by which it hooks, so the maximum
    along the hooks is the answer, found by pointer doubling.

    Args:
      edges: (B, 2) nodes.
      place: (N,) not looked at.
      cost: (B,) integers.
      source: (N,) bool.

    Returns:
      The edge; B at the sources, -1 where no way leads.
    """
    num_nodes, num_edges = place.shape[0], edges.shape[0]
    nodes = jnp.arange(num_nodes, dtype=jnp.int32)
    first, second = edges[:, 0], edges[:, 1]
    index = jnp.arange(num_edges, dtype=jnp.int32)
    top = jnp.array(jnp.iinfo(cost.dtype).max, cost.dtype)

    def hook(
        carry: tuple[jax.Array, jax.Array, jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        root, up, edge, _ = carry
        a, b = root[first], root[second]
        out = jnp.where(a != b, cost, top)
        best = jnp.full(num_nodes, top).at[a].min(out).at[b].min(out)
        # Of equal edges the first: without one order for all, hooks could form rings.
        at_a = jnp.where((out < top) & (out == best[a]), index, num_edges)
        at_b = jnp.where((out < top) & (out == best[b]), index, num_edges)
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
    _, up, edge, _ = jax.lax.while_loop(lambda c: c[3], hook, start)

    def double(
        carry: tuple[jax.Array, jax.Array, jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        up, dearest, edge, _ = carry
        dearer = dearest[up] > dearest
        dearest = jnp.where(dearer, dearest[up], dearest)
        edge = jnp.where(dearer, edge[up], edge)
        return up[up], dearest, edge, jnp.any(up[up] != up)

    # Trees that reach no source end at a root of their own.
    dearest = jnp.where(edge < 0, top, cost[edge])
    dearest = jnp.where(source, jnp.iinfo(cost.dtype).min, dearest)
    edge = jnp.where(source, num_edges, edge)
    carry = up, dearest, edge, jnp.array(True)
    return jax.lax.while_loop(lambda c: c[3], double, carry)[2]


def _ends(pointer: jax.Array) -> jax.Array:
    """Follow (N,) pointers to where they end."""

    def jump(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        pointer, _ = carry
        further = pointer[pointer]
        return further, jnp.any(further != pointer)

    start = (pointer, jnp.array(True))
    return jax.lax.while_loop(lambda c: c[1], jump, start)[0]


def group_sum(values: jax.Array, group: jax.Array, num_groups: int) -> jax.Array:
    """Sum rows of values (n, ...) by their group (n,) into (num_groups, ...).

    Differentiable in values, exactly.
    """
    # Negative numbers would count from the end; out of range, they are dropped.
    group = jnp.where(group < 0, num_groups, group)
    zeros = jnp.zeros((num_groups, *values.shape[1:]), values.dtype)
    return zeros.at[group].add(values, mode="drop")


def group_any(flags: jax.Array, group: jax.Array, num_groups: int) -> jax.Array:
    """Return whether any flag (n,) of each group is set, (num_groups,) bool.

    Piecewise constant: no derivative passes.
    """
    group = jnp.where(group < 0, num_groups, group)
    return jnp.zeros(num_groups, bool).at[group].max(flags, mode="drop")
