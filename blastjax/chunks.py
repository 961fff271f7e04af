"""Questions about actors: who owns what, what is visible, how heavy it is.

Arrays "by label" have one row an element; the row of a label describes the actor of
that name, and rows that name no actor are zero or False. All of it is computed from the
state when asked, nothing is stored.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp

from blastjax import graph, pytree, spatial
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


def alone(asset: Asset, state: State) -> jax.Array:
    """Return which elements are an actor by themselves, (A,) bool.

    These take damage to their chunk; an actor of several nodes takes it to its bonds.

    Piecewise constant: no derivative passes.
    """
    count = node_count(asset, state)
    owned = (state.actor != NONE) & is_chunk(asset)
    return owned & (count[jnp.maximum(state.actor, 0)] <= 1)


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
    several = node_count(asset, state) > 1
    return active(asset, state) & (several | (state.chunk_health > 0))


def split_required(asset: Asset, state: State) -> jax.Array:
    """Return which actors may come apart at the next split, (A,) bool by label.

    True of an actor of several nodes that lost a bond (it may still hold together), and
    of a single chunk without health that has children.

    Piecewise constant: no derivative passes.
    """
    capacity = state.actor.shape[0]
    several = node_count(asset, state) > 1
    nodes = asset.span_node.shape[0]
    touched = graph.group_any(state.dirty, state.actor[:nodes], capacity)
    gives_way = (state.chunk_health <= 0) & has_children(asset)
    return active(asset, state) & jnp.where(several, touched, gives_way)


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
    fits = actor.shape[0] <= jnp.iinfo(jnp.int16).max
    return actor.astype(jnp.int16) if fits else actor


def _owner(
    element: jax.Array, span: jax.Array, node: jax.Array, actor: jax.Array
) -> jax.Array:
    """Return the owners of chunks, by the elements' actors (A,)."""
    direct = _take(actor, element, NONE)
    # In depth-first order a subtree is a range: it has one owner if no neighbours in
    # the range differ, which a running count of differences tells.
    label = jax.lax.optimization_barrier(actor[node])
    differs = jnp.concatenate([jnp.zeros(1, bool), label[1:] != label[:-1]])
    count = graph.running_count(differs)
    first = span[:, 0]
    last = jnp.maximum(span[:, 1] - 1, first)
    one = (span[:, 1] > first) & (count[last] == count[first])
    whole = jnp.where(one, label[first], jnp.asarray(NONE, actor.dtype))
    return jnp.where(element < 0, whole, direct)


def _visible(
    element: jax.Array,
    span: jax.Array,
    node: jax.Array,
    parent: jax.Array,
    actor: jax.Array,
) -> jax.Array:
    """Return which chunks are visible, by the elements' actors (A,)."""
    # Behind a barrier, or XLA computes the owner anew for each chunk that asks for it.
    owner = jax.lax.optimization_barrier(_owner(element, span, node, actor))
    return (owner != NONE) & (_take(owner, parent, NONE) != owner)


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

    A `vmap` over states alone, on the CPU, sums only over actors of several chunks.
    """
    density = jnp.broadcast_to(
        jnp.asarray(density, asset.chunk_volume.dtype), asset.chunk_volume.shape
    )
    weight = element_values(asset, density * asset.chunk_volume)
    place = element_values(asset, asset.chunk_centroid)
    spin = element_values(asset, density[:, None, None] * asset.chunk_inertia)
    mass, center, inertia = _sums(state.actor, weight, place, spin.reshape(-1, 9))
    return Moments(mass, center.reshape(-1, 3), inertia.reshape(-1, 3, 3))


ROUNDS = 8
"""Actors of several chunks that a body may have to be summed up with others."""
TOGETHER = 8192
"""Elements of bodies that are summed up side by side."""

Sums = tuple[jax.Array, jax.Array, jax.Array]
"""Masses (A,), centres (A * 3,) and inertias (A * 9,), or of a batch of bodies."""


@jax.custom_jvp
def _sums(
    actor: jax.Array, weight: jax.Array, place: jax.Array, spin: jax.Array
) -> Sums:
    """Sum up elements of some weight (A,), place (A, 3) and inertia (A, 9) by actor."""
    return graph.one_of_many(_by_scatter, _by_rounds, 3)(weight, place, spin, actor)


@_sums.defjvp
def _(primals: tuple[jax.Array, ...], tangents: tuple[Any, ...]) -> tuple[Sums, Sums]:
    actor, *tables = primals
    return jax.jvp(lambda *x: _by_scatter(*x, actor), tables, tangents[1:])


def _middle(weight: jax.Array, place: jax.Array) -> jax.Array:
    """Return a point to measure from, or float32 loses digits far from the origin."""
    return jax.lax.stop_gradient(spatial.ratio(weight @ place, weight.sum()))


def _by_scatter(
    weight: jax.Array, place: jax.Array, spin: jax.Array, actor: jax.Array
) -> Sums:
    """Sum up one body: in two passes, for the second needs the actors' centres."""
    middle = _middle(weight, place)
    place = place - middle
    sums = graph.group_sum(
        jnp.concatenate([weight[:, None], weight[:, None] * place], axis=1),
        actor,
        actor.shape[0],
    )
    mass = sums[:, :1]
    center = spatial.ratio(sums[:, 1:], mass)
    # About the actor's own centre: the difference of two large sums would cost float32
    # its digits.
    arm = place - _take(center, actor, 0.0)
    square = spatial.dot(arm, arm)[:, None, None] * jnp.eye(3, dtype=arm.dtype)[None]
    steiner = (square - arm[:, :, None] * arm[:, None, :]).reshape(-1, 9)
    inertia = graph.group_sum(spin + weight[:, None] * steiner, actor, actor.shape[0])
    center = center + jnp.where(mass != 0, middle, 0)
    return mass[:, 0], center.reshape(-1), inertia.reshape(-1)


def _by_rounds(
    weight: jax.Array, place: jax.Array, spin: jax.Array, actor: jax.Array
) -> Sums:
    """Sum up many bodies (T, A), of which most actors are one chunk: that is no sum."""
    size, capacity = actor.shape
    element = jnp.arange(capacity, dtype=actor.dtype)
    width = min(max(TOGETHER // capacity, 4), size)
    tiles = -(-size // width)
    padded = jnp.pad(actor, ((0, tiles * width - size), (0, 0)), constant_values=-1)
    # Not a vmap: every tile stops when it is done.
    found = jax.lax.map(
        functools.partial(_rounds, weight, place, spin),
        padded.reshape(tiles, width, capacity),
    )
    label, mass, center, inertia, late = (
        x.reshape(-1, *x.shape[2:])[:size] for x in found
    )
    # A product vectorises where a choice would not.
    single = (actor == element).astype(weight.dtype)
    near = jnp.where(weight[:, None] != 0, place, 0)
    copy = jnp.arange(size, dtype=actor.dtype)[:, None]
    out = (
        (single * weight).at[copy, label].set(mass, mode="drop"),
        (single[..., None] * near).at[copy, label].set(center, mode="drop"),
        (single[..., None] * spin).at[copy, label].set(inertia, mode="drop"),
    )
    out = jax.tree.map(lambda x: x.reshape(size, -1), out)
    # In the end what is in many pieces.
    turn = jnp.argsort(~late)
    number = late.sum()

    def some(i: jax.Array, out: Sums) -> Sums:
        place_in_turn = i * width + jnp.arange(width)
        which = turn[jnp.minimum(place_in_turn, size - 1)]
        group = actor[which]
        group = jnp.where(group < 0, -1, group + capacity * jnp.arange(width)[:, None])
        tables = (_repeat(x, width) for x in (weight, place, spin))
        found = _by_scatter(*tables, group.reshape(-1))
        which = jnp.where(place_in_turn < number, which, size)
        return jax.tree.map(lambda x, y: x.at[which].set(y.reshape(width, -1), mode="drop"), out, found)

    return jax.lax.fori_loop(0, -(-number // width), some, out)


def _repeat(x: jax.Array, times: int) -> jax.Array:
    return jnp.broadcast_to(x, (times, *x.shape)).reshape(-1, *x.shape[1:])


def _rounds(
    weight: jax.Array, place: jax.Array, spin: jax.Array, actor: jax.Array
) -> tuple[jax.Array, ...]:
    """Sum up a few bodies' actors of several chunks, one actor of each at a time.

    Returns:
      Their labels (n, ROUNDS), out of range where there is none; mass, centre and
      inertia (n, ROUNDS, ...); and which bodies have more such actors, (n,) bool.
    """
    size, capacity = actor.shape
    middle = _middle(weight, place)
    place = place - middle
    table = jnp.concatenate([weight[:, None], weight[:, None] * place, spin], axis=1)
    # Who is in the actor of another; the labels they name are all there is to sum up.
    joins = (actor >= 0) & (actor != jnp.arange(capacity, dtype=actor.dtype))
    joined = jnp.where(joins, actor, capacity)

    def after(label: jax.Array) -> jax.Array:
        return jnp.min(jnp.where(joined > label[:, None], joined, capacity), axis=1)

    def more(carry: tuple[Any, ...]) -> jax.Array:
        return (carry[0] < ROUNDS) & jnp.any(carry[1] < capacity)

    def take(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        i, label, out = carry
        mask = jax.lax.optimization_barrier((actor == label[:, None]).astype(weight.dtype))
        sums = jnp.dot(mask, table, precision="highest")
        mass = sums[:, 0]
        center = jax.lax.optimization_barrier(spatial.ratio(sums[:, 1:4], mass[:, None]))
        arm = [mask * (place[:, k] - center[:, k, None]) for k in range(3)]
        second = [[None] * 3 for _ in range(3)]
        pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
        for j, k in pairs:
            product = jax.lax.optimization_barrier(arm[j] * arm[k])
            second[j][k] = second[k][j] = jnp.dot(product, weight, precision="highest")
        trace = second[0][0] + second[1][1] + second[2][2]
        inertia = jnp.stack(
            [
                sums[:, 4 + 3 * j + k] + ((trace if j == k else 0) - second[j][k])
                for j in range(3)
                for k in range(3)
            ],
            axis=1,
        )
        center = center + jnp.where(mass[:, None] != 0, middle, 0)
        found = label, mass, center, inertia
        out = [x.at[:, i].set(y) for x, y in zip(out, found, strict=True)]
        return i + 1, after(label), out

    none = jnp.full((size, ROUNDS), capacity, actor.dtype)
    zero = jnp.zeros((size, ROUNDS), weight.dtype)
    start = [none, zero, jnp.stack([zero] * 3, -1), jnp.stack([zero] * 9, -1)]
    first = after(jnp.full(size, -1, actor.dtype))
    bits = jnp.where(joins, jnp.left_shift(1, actor % 32), 0)
    seen = jax.lax.reduce(bits, jnp.int32(0), jax.lax.bitwise_or, (1,))
    many = jax.lax.population_count(seen) > ROUNDS
    first = jnp.where(many, capacity, first)
    _, label, out = jax.lax.while_loop(more, take, (jnp.int32(0), first, start))
    return *out, many | (label < capacity)
