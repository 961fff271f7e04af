"""Questions about actors: who owns what, what is visible, how heavy it is.

Arrays "by label" have one row an element; the row of a label describes the actor of
that name, and rows that name no actor are zero or False. All of it is computed from the
state when asked, nothing is stored.
"""

import jax
import jax.numpy as jnp

from blastjax import graph, lanes, pytree, sums
from blastjax.core import NONE, Asset, State


@pytree.dataclass
class Moments(pytree.Node):
    """Mass, centre and inertia of each actor, in the rest frame of the asset."""

    mass: jax.Array
    """(A,) by label, kg."""
    center: jax.Array
    """(A, 3) by label, centre of mass, m."""
    inertia: jax.Array
    """(A, 3, 3) by label, about the centre of mass, rest axes, kg m^2."""


def _take(values: jax.Array, index: jax.Array, fill: float) -> jax.Array:
    """Return values[index], and fill where the index is NONE."""
    if values.shape[0] == 0:
        return jnp.full((index.shape[0], *values.shape[1:]), fill, values.dtype)
    rows = values[jnp.maximum(index, 0)]
    here = (index >= 0).reshape(-1, *[1] * (values.ndim - 1))
    return jnp.where(here, rows, jnp.asarray(fill, values.dtype))


def element_values(asset: Asset, values: jax.Array, fill: float = 0) -> jax.Array:
    """Return per-chunk values (C, ...) per element (A, ...), fill where no chunk is.

    A copy of values: differentiable, exactly.
    """
    return _take(values, asset.element_chunk, fill)


def is_chunk(asset: Asset) -> jax.Array:
    """Return which elements are chunks, (A,) bool: not the world, not padding.

    Piecewise constant: no derivative passes.
    """
    return asset.element_chunk >= 0


def active(asset: Asset, state: State) -> jax.Array:
    """Return which labels name an actor, (A,) bool.

    The world alone is no actor.

    Piecewise constant: no derivative passes.
    """
    labels = jnp.arange(state.actor.shape[0], dtype=jnp.int32)
    named = state.actor == labels
    if asset.has_world:
        named = named.at[0].set(jnp.any((state.actor == 0) & is_chunk(asset)))
    return named


def node_count(asset: Asset, state: State) -> jax.Array:
    """Return the graph nodes of each actor, the world included, (A,) int32 by label.

    Sub-support actors have none.

    Piecewise constant: no derivative passes.
    """
    owner = state.actor[: asset.span_node.shape[0]]
    return graph.group_count(owner, state.actor.shape[0])


def several(asset: Asset, state: State) -> jax.Array:
    """Return which actors have several graph nodes, the world included, (A,) bool.

    By label; it relies on each actor being named by one of its elements. An actor that
    has not several is a single chunk, or the world.

    Piecewise constant: no derivative passes.
    """
    nodes = asset.span_node.shape[0]
    owner = state.actor[:nodes]
    # An actor is named by one of its elements: with another node it has two.
    other = owner != jnp.arange(nodes, dtype=owner.dtype)
    return graph.group_any(other, owner, state.actor.shape[0])


def alone(asset: Asset, state: State) -> jax.Array:
    """Return which elements are an actor by themselves, (A,) bool.

    These take damage to their chunk; an actor of several nodes takes it to its bonds.

    Piecewise constant: no derivative passes.
    """
    named = state.actor == jnp.arange(state.actor.shape[0], dtype=jnp.int32)
    return is_chunk(asset) & named & ~several(asset, state)


def held(asset: Asset, state: State) -> jax.Array:
    """Return which actors the world holds, (A,) bool by label.

    Piecewise constant: no derivative passes.
    """
    first = jnp.arange(state.actor.shape[0], dtype=jnp.int32) == 0
    return active(asset, state) & first & asset.has_world


def can_fracture(asset: Asset, state: State) -> jax.Array:
    """Return which actors damage can still change, (A,) bool by label.

    An actor of several nodes always can; a single chunk only while it has health.

    Piecewise constant: no derivative passes.
    """
    breakable = several(asset, state) | (state.chunk_health > 0)
    return active(asset, state) & breakable


def split_required(asset: Asset, state: State) -> jax.Array:
    """Return which actors may come apart at the next split, (A,) bool by label.

    True of an actor of several nodes that lost a bond (it may still hold together), and
    of a single chunk without health that has children.

    Piecewise constant: no derivative passes.
    """
    capacity = state.actor.shape[0]
    nodes = asset.span_node.shape[0]
    touched = graph.group_any(state.dirty, state.actor[:nodes], capacity)
    gives_way = (state.chunk_health <= 0) & has_children(asset)
    comes_apart = jnp.where(several(asset, state), touched, gives_way)
    return active(asset, state) & comes_apart


def has_children(asset: Asset) -> jax.Array:
    """Return which elements' chunks have children, (A,) bool.

    Piecewise constant: no derivative passes.
    """
    return element_values(asset, asset.chunk_children) > 0


def owner(asset: Asset, state: State) -> jax.Array:
    """Return the actor that owns each chunk whole, (C,) int32 labels or NONE.

    A chunk above the support level belongs to an actor if all support chunks below it
    do; a chunk below it, if the support chunk above gave way and its turn has come.

    Piecewise constant: no derivative passes.
    """
    if asset.height == 0:
        return _take(state.actor, asset.chunk_element, NONE)
    return graph.side_by_side(_owner, 3)(*_tree(asset), _small(state.actor))


def _tree(asset: Asset) -> tuple[jax.Array, jax.Array, jax.Array]:
    return asset.chunk_element, asset.chunk_span, asset.span_node


def _small(actor: jax.Array) -> jax.Array:
    """Return labels in the smallest type that holds them: half the memory to move."""
    fits = actor.shape[0] - 1 <= jnp.iinfo(jnp.int16).max
    return actor.astype(jnp.int16) if fits else actor


def _owner(
    element: jax.Array, span: jax.Array, node: jax.Array, actor: jax.Array
) -> jax.Array:
    """Return the owners of chunks (C, T), by the elements' actors (A, T)."""
    none = jnp.asarray(NONE, actor.dtype)
    direct = _rows(actor, element)
    # In depth-first order a subtree is a range: it has one owner if no neighbours in
    # the range differ, which a running count of changes tells. Behind barriers, or XLA
    # computes anew what is looked up, for each that looks.
    label = jax.lax.optimization_barrier(_rows(actor, node))
    count = jax.lax.optimization_barrier(graph.count_changes(label))
    first = span[:, 0]
    last = jnp.maximum(span[:, 1] - 1, first)
    one = (span[:, 1] > first)[:, None] & (_rows(count, last) == _rows(count, first))
    whole = jnp.where(one, _rows(label, first), none)
    return jnp.where((element < 0)[:, None], whole, direct)


def _rows(values: jax.Array, index: jax.Array) -> jax.Array:
    """Return rows of values (n, T) by index; the first where that is negative."""
    # Unsigned, it is not checked for counting from the end.
    return lanes.take_rows(values, jnp.maximum(index, 0).astype(jnp.uint32))


def _visible(
    element: jax.Array,
    span: jax.Array,
    node: jax.Array,
    parent: jax.Array,
    actor: jax.Array,
) -> jax.Array:
    """Return which chunks are visible (C, T), by the elements' actors (A, T)."""
    owner = jax.lax.optimization_barrier(_owner(element, span, node, actor))
    above = jnp.where((parent >= 0)[:, None], _rows(owner, parent), NONE)
    return (owner != NONE) & (above != owner)


def visible(asset: Asset, state: State) -> jax.Array:
    """Return the visible chunks, (C,) bool: the coarsest that stand for each actor.

    Piecewise constant: no derivative passes.
    """
    if asset.height == 0 and asset.depth == 0:
        return owner(asset, state) != NONE
    see = graph.side_by_side(_visible, 4, bool)
    return see(*_tree(asset), asset.chunk_parent, _small(state.actor))


def moments(asset: Asset, state: State, density: float | jax.Array) -> Moments:
    """Sum up the chunks of each actor.

    Args:
      asset: the asset.
      state: its state.
      density: kg/m^3, one for all or (C,).

    Returns:
      Moments by label. Differentiable in density, volumes, centroids and inertias; the
      grouping is constant.

    A `vmap` over states alone, on the CPU, sums up actors of several chunks only.
    """
    density = jnp.broadcast_to(
        jnp.asarray(density, asset.chunk_volume.dtype), asset.chunk_volume.shape
    )
    weight = element_values(asset, density * asset.chunk_volume)
    place = element_values(asset, asset.chunk_centroid)
    spin = element_values(asset, density[:, None, None] * asset.chunk_inertia)
    mass, center, inertia = sums.moments(
        state.actor, weight, place, spin.reshape(-1, 9)
    )
    return Moments(mass, center.reshape(-1, 3), inertia.reshape(-1, 3, 3))
