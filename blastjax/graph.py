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
    if num_nodes >= lanes.LIMIT:
        return _hook_and_jump(edges, alive, num_nodes)
    if place is None:
        place = jnp.arange(num_nodes, dtype=jnp.int32)
    return _one(num_nodes)(edges, alive, jax.lax.stop_gradient(place))


def _hook_and_jump(edges: jax.Array, alive: jax.Array, num_nodes: int) -> jax.Array:
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


Kernel = Callable[[jax.Array, jax.Array, jax.Array], jax.Array]


@functools.cache
def _one(num_nodes: int) -> Kernel:
    """Return the islands of one graph, which know what a batch of them should do."""

    @jax.custom_batching.custom_vmap
    def one(edges: jax.Array, alive: jax.Array, place: jax.Array) -> jax.Array:
        del place
        return _hook_and_jump(edges, alive, num_nodes)

    @one.def_vmap
    def batched(
        size: int,
        is_batched: Sequence[bool],
        edges: jax.Array,
        alive: jax.Array,
        place: jax.Array,
    ) -> tuple[jax.Array, bool]:
        if is_batched[0]:
            return _each(one, size, is_batched, edges, alive, place), True
        if not is_batched[1]:
            alive = jnp.broadcast_to(alive, (size, *alive.shape))
        if is_batched[2]:
            place = place[0]  # It changes no result.
        return _many(num_nodes)(edges, alive, place), True

    return one


@functools.cache
def _many(num_nodes: int) -> Kernel:
    """Return the islands of many copies (T, B) of one graph."""

    @jax.custom_batching.custom_vmap
    def many(edges: jax.Array, alive: jax.Array, place: jax.Array) -> jax.Array:
        def rounds(edges: jax.Array, alive: jax.Array, place: jax.Array) -> jax.Array:
            del place
            return jax.vmap(lambda x: _hook_and_jump(edges, x, num_nodes))(alive)

        def sweeps(edges: jax.Array, alive: jax.Array, place: jax.Array) -> jax.Array:
            return lanes.in_tiles(edges, alive, place)

        # A sweep is one long chain of small steps, the wrong thing for an accelerator,
        # and for a handful of copies.
        if alive.shape[0] < FEW:
            return rounds(edges, alive, place)
        return jax.lax.platform_dependent(
            edges, alive, place, cpu=sweeps, default=rounds
        )

    @many.def_vmap
    def batched(
        size: int,
        is_batched: Sequence[bool],
        edges: jax.Array,
        alive: jax.Array,
        place: jax.Array,
    ) -> tuple[jax.Array, bool]:
        if is_batched[0]:
            return _each(many, size, is_batched, edges, alive, place), True
        if not is_batched[1]:
            alive = jnp.broadcast_to(alive, (size, *alive.shape))
        if is_batched[2]:
            place = place[0]
        copies = alive.reshape(-1, alive.shape[-1])
        label = many(edges, copies, place)
        return label.reshape(*alive.shape[:2], num_nodes), True

    return many


def _each(
    kernel: Kernel, size: int, is_batched: Sequence[bool], *args: jax.Array
) -> jax.Array:
    """Solve different graphs: together if each has one copy, else one by one."""
    full = [
        x if b else jnp.broadcast_to(x, (size, *x.shape))
        for x, b in zip(args, is_batched, strict=True)
    ]
    edges, alive, place = full
    num_nodes = place.shape[-1]
    if alive.ndim == 2:
        return jax.vmap(lambda e, a: _hook_and_jump(e, a, num_nodes))(edges, alive)
    return jax.lax.map(lambda x: kernel(*x), (edges, alive, place))


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
    edges: jax.Array, weight: jax.Array, source: jax.Array, num_nodes: int
) -> tuple[jax.Array, jax.Array]:
    """Find the way to a source whose weakest edge is as strong as possible.

    Args:
      edges: (B, 2) nodes.
      weight: (B,) strength, any sign; minus infinity or NaN if an edge leads nowhere.
      source: (N,) bool, the nodes to reach.
      num_nodes: N.

    Returns:
      (N,) weight of the weakest edge on the best way: infinite at the sources, minus
      infinity where no way leads; and (N,) int32, which edge it is, -1 where the weight
      is infinite. A node reaches a source over edges above t if and only if its weight
      is above t. The derivative is one for the weakest edge and zero for all others,
      exact wherever no two weights tie; of equal edges one is chosen.

    Boruvka's rounds: every tree without a source hooks onto the tree behind the
    strongest edge that leaves it. No edge inside a tree is weaker than the one by which
    it hooks, so the minimum along the hooks is the answer, found by pointer doubling.
    """
    num_edges = edges.shape[0]
    lowest = jnp.array(-jnp.inf, weight.dtype)
    nodes = jnp.arange(num_nodes, dtype=jnp.int32)
    if num_edges == 0:
        return jnp.where(source, jnp.inf, lowest), jnp.full_like(nodes, -1)
    first, second = edges[:, 0], edges[:, 1]
    index = jnp.arange(num_edges, dtype=jnp.int32)
    # Loops run on constants: nothing in here is differentiated.
    strength = jax.lax.stop_gradient(weight)
    strength = jnp.where(strength > lowest, strength, lowest)

    def hook(
        carry: tuple[jax.Array, jax.Array, jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        root, up, edge, _ = carry
        a, b = root[first], root[second]
        out = jnp.where(a != b, strength, lowest)
        best = jnp.full(num_nodes, lowest).at[a].max(out).at[b].max(out)
        # Of equal edges the first: without one order for all, hooks could form rings.
        at_a = jnp.where((out > lowest) & (out == best[a]), index, num_edges)
        at_b = jnp.where((out > lowest) & (out == best[b]), index, num_edges)
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
        up, least, edge, _ = carry
        weaker = least[up] < least
        least = jnp.where(weaker, least[up], least)
        edge = jnp.where(weaker, edge[up], edge)
        return up[up], least, edge, jnp.any(up[up] != up)

    least = jnp.where(edge < 0, lowest, strength[edge])
    least = jnp.where(source, jnp.inf, least)
    carry = up, least, edge, jnp.array(True)
    _, least, edge, _ = jax.lax.while_loop(lambda c: c[3], double, carry)
    finite = jnp.isfinite(least)
    return jnp.where(finite, weight[edge], least), jnp.where(finite, edge, -1)


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
