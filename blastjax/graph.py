"""Kernels on plain arrays: islands of a graph, sums over groups.

Node numbers are int32. A group number outside the range, such as a negative one, is
dropped: padding needs no special case.
"""

import jax
import jax.numpy as jnp


def islands(edges: jax.Array, alive: jax.Array, num_nodes: int) -> jax.Array:
    """Label every node with the smallest node that it can reach.

    Args:
      edges: (B, 2) nodes.
      alive: (B,) bool, the edges that connect.
      num_nodes: N.

    Returns:
      (N,) int32 labels. Piecewise constant: it has no derivative to speak of.

    Each round hooks the larger root of every edge to the smaller one, then halves the
    paths twice; rounds grow with the logarithm of the diameter for all but adversarial
    numberings.
    """
    first, second = edges[:, 0], edges[:, 1]
    nodes = jnp.arange(num_nodes, dtype=jnp.int32)
    if edges.shape[0] == 0:
        return nodes

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


def group_sum(values: jax.Array, group: jax.Array, num_groups: int) -> jax.Array:
    """Sum rows of values (n, ...) by their group (n,) into (num_groups, ...)."""
    # Negative numbers would count from the end; out of range, they are dropped.
    group = jnp.where(group < 0, num_groups, group)
    zeros = jnp.zeros((num_groups, *values.shape[1:]), values.dtype)
    return zeros.at[group].add(values, mode="drop")


def group_any(flags: jax.Array, group: jax.Array, num_groups: int) -> jax.Array:
    """Return whether any flag (n,) of each group is set, (num_groups,) bool."""
    group = jnp.where(group < 0, num_groups, group)
    return jnp.zeros(num_groups, bool).at[group].max(flags, mode="drop")
