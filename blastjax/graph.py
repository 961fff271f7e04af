"""Kernels on plain arrays: islands of a graph, best ways, sums over groups.

Node numbers are int32. A group number outside the range, such as a negative one, is
dropped: padding needs no special case.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from blastjax import bottlenecks, lanes

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


Kernel = Callable[..., Any]
"""A search: of edges (B, 2), place (N,), and arrays of what it is to know of them."""


@functools.cache
def _one(rounds: Kernel, sweeps: Kernel) -> Kernel:
    """Return the search of one graph, which knows what a batch of it should do.

    Args:
      rounds: searches one graph.
      sweeps: searches many copies of one graph; all but edges and place is (T, ...).
    """

    @jax.custom_batching.custom_vmap
    def one(edges: jax.Array, place: jax.Array, *known: jax.Array) -> Any:
        return rounds(edges, place, *known)

    @one.def_vmap
    def batched(
        size: int, is_batched: Sequence[bool], *args: jax.Array
    ) -> tuple[Any, Any]:
        edges, place, *known = _full(size, is_batched, args)
        if is_batched[0]:
            return _all(jax.vmap(rounds)(edges, place, *known))
        # The place changes no result: that of the first copy is as good as any.
        return _all(_many(rounds, sweeps)(edges[0], place[0], *known))

    return one


@functools.cache
def _many(rounds: Kernel, sweeps: Kernel) -> Kernel:
    """Return the search of many copies of one graph."""

    @jax.custom_batching.custom_vmap
    def many(edges: jax.Array, place: jax.Array, *known: jax.Array) -> Any:
        def each(edges: jax.Array, place: jax.Array, *known: jax.Array) -> Any:
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
    ) -> tuple[Any, Any]:
        edges, place, *known = _full(size, is_batched, args)
        if is_batched[0]:
            # Different graphs: together if each has one copy, else one by one.
            if known[0].shape[1] == 1:
                only = jax.vmap(rounds)(edges, place, *[x[:, 0] for x in known])
                return _all(jax.tree.map(lambda x: x[:, None], only))
            return _all(jax.lax.map(lambda x: many(*x), (edges, place, *known)))
        copies = [x.reshape(-1, *x.shape[2:]) for x in known]
        found = many(edges[0], place[0], *copies)
        shape = known[0].shape[:2]
        return _all(jax.tree.map(lambda x: x.reshape(*shape, -1), found))

    return many


def _all(out: Any) -> tuple[Any, Any]:
    """Say of all that a batching rule returns that it is batched."""
    return out, jax.tree.map(lambda _: True, out)


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
    if edges.shape[0] == 0:
        least = jnp.where(source, jnp.inf, -jnp.inf).astype(weight.dtype)
        return least, jnp.full(num_nodes, -1, jnp.int32)
    if place is None:
        place = jnp.arange(num_nodes, dtype=jnp.int32)
    search = _one(bottlenecks.rounds, bottlenecks.in_tiles)
    # Searches run on constants: nothing in there is differentiated.
    least, edge = search(edges, *jax.lax.stop_gradient((place, weight)), source)
    edge = jnp.where(jnp.isfinite(least), edge, -1)
    return _as_weight_of(edge, least, weight), edge


@jax.custom_jvp
def _as_weight_of(edge: jax.Array, value: jax.Array, weight: jax.Array) -> jax.Array:
    """Return the value, which moves as the weight of the edge, if it is one."""
    del edge, weight
    return value


@_as_weight_of.defjvp
def _(
    primals: tuple[jax.Array, ...], tangents: tuple[Any, ...]
) -> tuple[jax.Array, jax.Array]:
    edge, value, _ = primals
    return value, jnp.where(edge >= 0, tangents[2][jnp.maximum(edge, 0)], 0)


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
