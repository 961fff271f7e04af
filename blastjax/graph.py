"""Kernels on plain arrays: islands of a graph, best ways, sums over groups.

Node numbers are int32. A group number outside the range, such as a negative one, is
dropped: padding needs no special case.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from blastjax import bottlenecks, lanes

FEW = 8
"""Copies below which sweeps do not pay."""

Kernel = Callable[..., Any]
"""Of arrays that describe an asset, and arrays of one state of it."""


def islands(
    edges: jax.Array,
    alive: jax.Array,
    num_nodes: int,
    *,
    sweep: jax.Array | None = None,
) -> jax.Array:
    """Label every node with the smallest node that it can reach.

    Args:
      edges: (B, 2) nodes.
      alive: (B,) bool, the edges that connect.
      num_nodes: N.
      sweep: (M,) of this graph, from `lanes.order`. It changes no result, only how
        fast batches are. None finds one if the edges are known while tracing, and does
        without if they are traced themselves.

    Returns:
      (N,) int32 labels. Piecewise constant: it has no derivative to speak of.

    One graph is solved in rounds that hook the larger root of every edge to the smaller
    one, then halve the paths twice. With a sweep, a `vmap` over `alive` alone, on the
    CPU, sweeps over all copies side by side instead (see `lanes`).
    """
    if edges.shape[0] == 0:
        return jnp.arange(num_nodes, dtype=jnp.int32)
    sweep = _sweep(edges, alive, num_nodes) if sweep is None else sweep
    if sweep is None:
        return _hook_and_jump(edges, alive, num_nodes)
    return _search_islands(num_nodes)(edges, sweep, alive)


def _sweep(edges: jax.Array, each: jax.Array, num_nodes: int) -> jax.Array | None:
    """Return a sweep of edges that are known where what is on them is traced."""
    if isinstance(edges, jax.core.Tracer) or not isinstance(each, jax.core.Tracer):
        return None
    return lanes.order(np.asarray(edges), num_nodes)


@functools.cache
def _search_islands(num_nodes: int) -> Kernel:
    return one_of_many(
        lambda edges, sweep, alive: _hook_and_jump(edges, alive, num_nodes),
        lambda edges, sweep, alive: lanes.in_tiles(num_nodes, sweep, alive),
        2,
    )


def _hook_and_jump(edges: jax.Array, alive: jax.Array, num_nodes: int) -> jax.Array:
    # Unsigned: such an index is not checked for counting from the end.
    ends = edges.T.reshape(-1).astype(jnp.uint32)

    def hook(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        label, (a, b) = carry
        low = jnp.where(alive, jnp.minimum(a, b), num_nodes)
        label = label.at[jnp.maximum(a, b)].min(low, mode="promise_in_bounds")
        label = _at(label, label)
        label = _at(label, label)
        return label, _at(label, ends).reshape(2, -1)

    def apart(carry: tuple[jax.Array, jax.Array]) -> jax.Array:
        # Where no edge joins two labels each island has one, the least of its nodes:
        # that node has it, for labels only fall, and never leave an island.
        _, (a, b) = carry
        return jnp.any(alive & (a != b))

    nodes = jnp.arange(num_nodes, dtype=jnp.uint32)
    start = nodes, ends.reshape(2, -1)
    return jax.lax.while_loop(apart, hook, start)[0].astype(jnp.int32)


def _at(x: jax.Array, index: jax.Array) -> jax.Array:
    return x.at[index].get(mode="promise_in_bounds")


@functools.cache
def side_by_side(
    tile: Kernel, num_tables: int, dtype: jax.typing.DTypeLike = jnp.int32
) -> Kernel:
    """Return a function of one state that is computed in lanes, as batches are.

    Args:
      tile: of `num_tables` arrays that describe the asset, and arrays (n, T) of T
        states of it, to (m, T). Constant under differentiation.
      num_tables: so many arguments all states share.
      dtype: of the result.
    """

    def rounds(*args: jax.Array) -> jax.Array:
        tables, state = args[:num_tables], args[num_tables:]
        return tile(*tables, *[x[:, None] for x in state])[:, 0].astype(dtype)

    def sweeps(*args: jax.Array) -> jax.Array:
        tables, states = args[:num_tables], args[num_tables:]
        return lanes.tiled(functools.partial(tile, *tables), dtype, *states)

    return one_of_many(rounds, sweeps, num_tables)


@functools.cache
def one_of_many(rounds: Kernel, sweeps: Kernel, num_tables: int) -> Kernel:
    """Return a function of one state, which knows what a batch of states should do.

    Args:
      rounds: does it for one state.
      sweeps: does it for many states of one asset; all but the tables is (T, ...).
      num_tables: so many arguments describe the asset.
    """

    @jax.custom_batching.custom_vmap
    def one(*args: jax.Array) -> Any:
        return rounds(*args)

    @one.def_vmap
    def batched(
        size: int, is_batched: Sequence[bool], *args: jax.Array
    ) -> tuple[Any, Any]:
        args = _full(size, is_batched, args)
        if any(is_batched[:num_tables]):
            return _all(jax.vmap(rounds)(*args))
        tables = [x[0] for x in args[:num_tables]]
        many = _many(rounds, sweeps, num_tables)
        return _all(many(*tables, *args[num_tables:]))

    return one


@functools.cache
def _many(rounds: Kernel, sweeps: Kernel, num_tables: int) -> Kernel:
    """Return the function of many states of one asset."""

    @jax.custom_batching.custom_vmap
    def many(*args: jax.Array) -> Any:
        def each(*args: jax.Array) -> Any:
            tables, states = args[:num_tables], args[num_tables:]
            return jax.vmap(functools.partial(rounds, *tables))(*states)

        # A sweep is one long chain of small steps, the wrong thing for an accelerator,
        # and for a handful of copies.
        if args[num_tables].shape[0] < FEW:
            return each(*args)
        return jax.lax.platform_dependent(*args, cpu=sweeps, default=each)

    @many.def_vmap
    def batched(
        size: int, is_batched: Sequence[bool], *args: jax.Array
    ) -> tuple[Any, Any]:
        args = _full(size, is_batched, args)
        tables, states = args[:num_tables], args[num_tables:]
        if any(is_batched[:num_tables]):
            # Different assets: together if each has one state, else one by one.
            if states[0].shape[1] == 1:
                only = jax.vmap(rounds)(*tables, *[x[:, 0] for x in states])
                return _all(jax.tree.map(lambda x: x[:, None], only))
            return _all(jax.lax.map(lambda x: many(*x), args))
        copies = [x.reshape(-1, *x.shape[2:]) for x in states]
        found = many(*[x[0] for x in tables], *copies)
        shape = states[0].shape[:2]
        return _all(jax.tree.map(lambda x: x.reshape(*shape, -1), found))

    return many


def _all(out: Any) -> tuple[Any, Any]:
    """Say of all that a batching rule returns that it is batched."""
    return out, jax.tree.map(lambda _: True, out)


def _full(
    size: int, is_batched: Sequence[bool], args: Sequence[jax.Array]
) -> tuple[jax.Array, ...]:
    return tuple(
        x if b else jnp.broadcast_to(x, (size, *x.shape))
        for x, b in zip(args, is_batched, strict=True)
    )


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
    sweep: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Find the way to a source whose weakest edge is as strong as possible.

    Args:
      edges: (B, 2) nodes.
      weight: (B,) strength, any sign; minus infinity or NaN if an edge leads nowhere.
      source: (N,) bool, the nodes to reach.
      num_nodes: N.
      sweep: see `islands`.

    Returns:
      (N,) weight of the weakest edge on the best way: infinite at the sources, minus
      infinity where no way leads; and (N,) int32, which edge it is, -1 where the weight
      is infinite. A node reaches a source over edges above t if and only if its weight
      is above t. The derivative is one for the weakest edge and zero for all others,
      exact wherever no two weights tie; of equal edges one is chosen.

    One graph is solved by Boruvka's rounds. With a sweep, a `vmap` over weights
    and sources, on the CPU, sweeps over all copies side by side instead (see `lanes`).
    """
    if edges.shape[0] == 0:
        least = jnp.where(source, jnp.inf, -jnp.inf).astype(weight.dtype)
        return least, jnp.full(num_nodes, -1, jnp.int32)
    # Searches run on constants: nothing in there is differentiated.
    constant = jax.lax.stop_gradient(weight)
    sweep = _sweep(edges, weight, num_nodes) if sweep is None else sweep
    if sweep is None:
        least, edge = bottlenecks.rounds(edges, constant, source)
    else:
        search = one_of_many(_bottleneck_rounds, _bottleneck_sweeps, 2)
        least, edge = search(edges, sweep, constant, source)
    edge = jnp.where(jnp.isfinite(least), edge, -1)
    return _as_weight_of(edge, least, weight), edge


def _bottleneck_rounds(
    edges: jax.Array, sweep: jax.Array, weight: jax.Array, source: jax.Array
) -> Any:
    del sweep
    return bottlenecks.rounds(edges, weight, source)


def _bottleneck_sweeps(
    edges: jax.Array, sweep: jax.Array, weight: jax.Array, source: jax.Array
) -> Any:
    del edges
    return bottlenecks.in_tiles(sweep, weight, source)


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


def count_changes(label: jax.Array) -> jax.Array:
    """Count the changes down each column (n, T) to each row: (n, T) integers.

    Piecewise constant: no derivative passes.
    """
    size, width = label.shape
    dtype = jnp.int16 if size <= jnp.iinfo(jnp.int16).max else jnp.int32

    def walk(label: jax.Array) -> jax.Array:
        # On a CPU one pass, of whole rows where there are lanes.
        def row(i: jax.Array) -> jax.Array:
            return jax.lax.dynamic_slice(label, (i, zero), (1, width))

        def add(
            i: jax.Array, carry: tuple[jax.Array, jax.Array]
        ) -> tuple[jax.Array, jax.Array]:
            count, counts = carry
            i = i.astype(jnp.uint32)
            count = count + (row(i) != row(i - 1)).astype(dtype)
            return count, jax.lax.dynamic_update_slice(counts, count, (i, zero))

        zero = jnp.uint32(0)
        start = jnp.zeros((1, width), dtype), jnp.zeros((size, width), dtype)
        return jax.lax.fori_loop(1, size, add, start)[1]

    def whole(label: jax.Array) -> jax.Array:
        differs = jnp.pad(label[1:] != label[:-1], ((1, 0), (0, 0)))
        return jnp.cumsum(differs, axis=0, dtype=dtype)

    return jax.lax.platform_dependent(label, cpu=walk, default=whole)


def group_sum(values: jax.Array, group: jax.Array, num_groups: int) -> jax.Array:
    """Sum rows of values (n, ...) by their group (n,) into (num_groups, ...).

    Differentiable in values, exactly.
    """
    # Negative numbers would count from the end; out of range, they are dropped.
    group = jnp.where(group < 0, num_groups, group)
    zeros = jnp.zeros((num_groups, *values.shape[1:]), values.dtype)
    return zeros.at[group].add(values, mode="drop")


def touched(
    edges: jax.Array,
    flags: jax.Array,
    num_nodes: int,
    *,
    sweep: jax.Array | None = None,
) -> jax.Array:
    """Return which nodes have an edge to another that is flagged, (N,) bool.

    Args:
      edges: (B, 2) nodes.
      flags: (B,) bool.
      num_nodes: N.
      sweep: see `islands`.

    Piecewise constant: no derivative passes. Of a batch without a flag it is free.
    """
    sweep = _sweep(edges, flags, num_nodes) if sweep is None else sweep
    if sweep is None:
        return _touched(edges, flags, num_nodes)
    return _search_touched(num_nodes)(edges, sweep, flags)


def _touched(edges: jax.Array, flags: jax.Array, num_nodes: int) -> jax.Array:
    flags = flags & (edges[:, 0] != edges[:, 1])
    return group_any(jnp.tile(flags, 2), edges.T.reshape(-1), num_nodes)


@functools.cache
def _search_touched(num_nodes: int) -> Kernel:
    def sweeps(edges: jax.Array, sweep: jax.Array, flags: jax.Array) -> jax.Array:
        through = lanes.unpack(sweep, num_nodes, edges.shape[0])
        return jax.lax.cond(
            any_of_many(flags),
            lambda: lanes.tiled(lambda x: lanes.touched(through, x), bool, flags),
            lambda: jnp.zeros((flags.shape[0], num_nodes), bool),
        )

    def rounds(edges: jax.Array, sweep: jax.Array, flags: jax.Array) -> jax.Array:
        del sweep
        return _touched(edges, flags, num_nodes)

    return one_of_many(rounds, sweeps, 2)


def any_of_many(flags: jax.Array) -> jax.Array:
    """Return whether any flag of many copies (T, n) is set, ().

    Piecewise constant: no derivative passes.
    """
    # Copies upon copies first, in vectors, or a CPU would look at them one by one.
    return jnp.any(jax.lax.optimization_barrier(jnp.any(flags, axis=0)))


@jax.custom_batching.custom_vmap
def anywhere(flag: jax.Array) -> jax.Array:
    """Return a flag (); under `vmap` whether it is set in any of the batch.

    That is one flag for the whole batch, so a `cond` on it stays one: what no body
    needs in this step is left out for all. The branches must agree where the flag of a
    body is not set. Piecewise constant: no derivative passes.
    """
    return flag


@anywhere.def_vmap
def _(size: int, is_batched: Sequence[bool], flag: jax.Array) -> tuple[jax.Array, bool]:
    return anywhere(jnp.any(flag)), False


def group_any(flags: jax.Array, group: jax.Array, num_groups: int) -> jax.Array:
    """Return whether any flag (n,) of each group is set, (num_groups,) bool.

    Piecewise constant: no derivative passes.
    """
    return _scattered(num_groups, bool)(flags, group)


def group_count(group: jax.Array, num_groups: int) -> jax.Array:
    """Return how many entries (n,) name each group, (num_groups,) int32.

    Piecewise constant: no derivative passes.
    """
    return _scattered(num_groups, int)(jnp.ones(group.shape, bool), group)


@functools.cache
def _scattered(num_groups: int, kind: type) -> Kernel:
    """Return the scatter of flags (n,) to groups (n,): any of them, or how many."""
    # Not by `.at[]`: there the places go once more through memory.
    scatter_to = jax.lax.scatter if kind is bool else jax.lax.scatter_add
    dtype = bool if kind is bool else jnp.int32
    dims = jax.lax.ScatterDimensionNumbers((), (0,), (0,))

    def put(size: int, place: jax.Array) -> jax.Array:
        zeros, ones = jnp.zeros(size, dtype), jnp.ones(place.shape, dtype)
        return scatter_to(zeros, place[:, None], ones, dims, mode="drop")

    def one(flags: jax.Array, group: jax.Array) -> jax.Array:
        return put(num_groups, jnp.where(flags & (group >= 0), group, num_groups))

    scatter = jax.custom_batching.custom_vmap(one)

    @scatter.def_vmap
    def batched(
        size: int, is_batched: Sequence[bool], *args: jax.Array
    ) -> tuple[jax.Array, bool]:
        flags, group = _full(size, is_batched, args)
        if size * num_groups > jnp.iinfo(jnp.int32).max:
            return jax.vmap(one)(flags, group), True
        # One scatter of all, several times faster than a batch of them. Behind a
        # barrier, or its places are computed in the order of the scatter: not in
        # vectors.
        everything = size * num_groups
        copy = jnp.arange(size, dtype=jnp.int32)[:, None]
        within = flags & (group >= 0) & (group < num_groups)
        place = jnp.where(within, copy * num_groups + group, everything)
        place = jax.lax.optimization_barrier(place).reshape(-1)
        return put(everything, place).reshape(size, num_groups), True

    return scatter
