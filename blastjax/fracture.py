"""Breaking: start whole, lower healths, come apart.

`init` makes the state of an unbroken asset, `apply` takes a `Damage` off its healths,
`split` finds the actors that result. As in Blast, the last is a step of its own: until
it is called, an actor stays whole whatever bonds it lost (and an asset of several parts
that never touched is one actor until its first split).

Healths, being sums, have exact derivatives; who belongs to whom is piecewise constant,
and a derivative through it misses the jumps.
"""

from collections.abc import Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from blastjax import chunks, graph
from blastjax.core import (
    NONE,
    UNBREAKABLE,
    WORLD,
    Asset,
    Damage,
    FractureEvents,
    SplitEvents,
    State,
)
from blastjax.damage import Buffer


class Program(Protocol):
    """Any function that turns one buffered event into damage."""

    def __call__(self, asset: Asset, state: State, event: Any, /) -> Damage:
        """Return the damage that the event does to this state."""


def init(
    asset: Asset,
    bond_health: float | jax.Array = 1.0,
    chunk_health: float | jax.Array = 1.0,
) -> State:
    """Return the state of an unbroken asset: one actor.

    Args:
      asset: the asset.
      bond_health: one for all bonds or (B,). UNBREAKABLE and above cannot be damaged; a
        bond that starts without health still connects until a chunk of it is damaged.
      chunk_health: one for all chunks, (N,) for each support chunk and all its
        descendants (the world's entry is not used), or (A,) for each element.

    Raises:
      ValueError: a health array has another shape.

    Differentiable in the healths of what is real.
    """
    dtype = asset.chunk_centroid.dtype
    num_nodes, capacity = asset.span_node.shape[0], asset.element_chunk.shape[0]
    num_bonds = asset.bond_nodes.shape[0]
    # Behind a barrier, or every body of a batch finds out anew.
    real_bond = jax.lax.optimization_barrier(
        asset.bond_nodes[:, 0] != asset.bond_nodes[:, 1]
    )
    real_chunk = chunks.is_chunk(asset)

    bond = _health("bond_health", bond_health, dtype, (num_bonds,))
    chunk = _health("chunk_health", chunk_health, dtype, (num_nodes,), (capacity,))
    if chunk.shape == (num_nodes,) != (capacity,):
        chunk = jnp.concatenate([chunk, jnp.zeros(capacity - num_nodes, dtype)])
        parent = jnp.maximum(asset.element_parent, 0)
        for _ in range(asset.depth):
            chunk = jnp.where(asset.element_parent >= 0, chunk[parent], chunk)

    in_graph = jnp.arange(capacity, dtype=jnp.int32) < num_nodes
    belongs = in_graph & real_chunk
    label = jnp.zeros((), jnp.int32)
    if asset.has_world:
        world = asset.element_chunk[0] == WORLD
        belongs = belongs.at[0].set(world)
        label = jnp.where(world, 0, 1).astype(jnp.int32)
    return State(
        # Behind a barrier: a batch reads numbers faster than it chooses them by flags.
        bond_health=jax.lax.optimization_barrier(jnp.where(real_bond, bond, 0)),
        bond_intact=real_bond,
        chunk_health=jnp.where(real_chunk, chunk, 0),
        actor=jnp.where(belongs, label, NONE),
        dirty=jnp.zeros(num_nodes, bool),
        bond_unbreakable=_unbreakable(bond_health, bond),
        chunk_unbreakable=_unbreakable(chunk_health, chunk),
    )


def _health(
    name: str, given: float | jax.Array, dtype: Any, *shapes: tuple[int, ...]
) -> jax.Array:
    health = jnp.asarray(given, dtype)
    if health.shape == ():
        return jnp.broadcast_to(health, shapes[-1])
    if health.shape not in shapes:
        wanted = " or ".join(map(str, dict.fromkeys(shapes)))
        raise ValueError(f"{name} has shape {health.shape}; give a scalar or {wanted}")
    return health


def _unbreakable(given: float | jax.Array, health: jax.Array) -> jax.Array | None:
    # A plain number is a static fact: nothing unbreakable, nothing traced for it.
    if isinstance(given, int | float) and not given >= UNBREAKABLE:
        return None
    return health >= UNBREAKABLE


def _damageable(health: jax.Array, unbreakable: jax.Array | None) -> jax.Array:
    return health > 0 if unbreakable is None else (health > 0) & ~unbreakable


def apply(asset: Asset, state: State, damage: Damage) -> tuple[State, FractureEvents]:
    """Take damage off the healths, chunks first, then bonds.

    Any damage to a chunk of an actor with several nodes cuts all bonds of its node, the
    unbreakable ones too. What a chunk cannot absorb is shared out equally among its
    children, and theirs again. A bond without health left stops connecting. Entries
    that are zero, negative or NaN do nothing.

    Returns:
      The state and what happened. Healths are differentiable in damage and healths.
    """
    return _apply(asset, state, damage, marks=True)


def _apply(
    asset: Asset, state: State, damage: Damage, marks: bool
) -> tuple[State, FractureEvents]:
    """Apply, and mark the dirty nodes unless a split of all actors follows at once."""
    bond_damage = jnp.zeros_like(state.bond_health)
    chunk_damage = excess = jnp.zeros_like(state.chunk_health)
    before = state.bond_intact
    if damage.chunk is not None:
        state, chunk_damage, excess = _apply_to_chunks(
            asset, state, damage.chunk, marks
        )
    if damage.bond is not None:
        state, bond_damage = _apply_to_bonds(asset, state, damage.bond, marks)
    broken = before & ~state.bond_intact
    return state, FractureEvents(
        bond_damage=bond_damage,
        bond_broken=broken,
        chunk_damage=chunk_damage,
        excess=excess,
    )


def _apply_to_chunks(
    asset: Asset, state: State, damage: jax.Array, marks: bool
) -> tuple[State, jax.Array, jax.Array]:
    num_nodes = asset.span_node.shape[0]
    damageable = _damageable(state.chunk_health, state.chunk_unbreakable)
    hit = (damage > 0) & damageable & (state.actor != NONE) & chunks.is_chunk(asset)
    taken = _once(jnp.where(hit, damage, 0))
    hit = taken > 0

    if asset.bond_nodes.shape[0]:
        cut = (hit & ~chunks.alone(asset, state))[:num_nodes]
        loses = _at_either_end(asset.bond_nodes, cut)
        dirty = state.dirty
        if marks:
            dirty = _dirty(asset, state, loses & state.bond_intact) | cut
        dead = loses & (state.bond_health > 0)
        state = state.replace(
            bond_health=jnp.where(dead, 0, state.bond_health),
            bond_intact=state.bond_intact & ~loses,
            dirty=dirty,
        )

    health = state.chunk_health - taken
    excess = jnp.where(hit & (health < 0), -health, 0)
    if asset.depth == 0:
        return state.replace(chunk_health=health), taken, excess
    parent = jnp.maximum(asset.element_parent, 0)
    siblings = jnp.maximum(chunks.element_values(asset, asset.chunk_children), 1)
    offer = excess
    for _ in range(asset.depth):
        share = _lookup(offer / siblings.astype(offer.dtype), parent)
        share = jnp.where((asset.element_parent >= 0) & damageable, share, 0)
        offer = jnp.maximum(share - health, 0)
        offer = jnp.where(share > 0, offer, 0)
        health = health - share
        taken = taken + share
        excess = excess + offer
    return state.replace(chunk_health=health), taken, excess


def _once(damage: jax.Array) -> jax.Array:
    """Return the same; XLA would repeat the program behind it wherever it is read."""
    return jax.lax.optimization_barrier(damage)


def _lookup(x: jax.Array, index: jax.Array) -> jax.Array:
    """Return the entries of x (A,) at index (A,), the same for all bodies."""
    # As if each body had its own: a gather of all at once would leave its result the
    # other way round in memory, and all that reads it would be slow. Behind a barrier,
    # or XLA computes x anew for each entry that is looked up.
    index = index + 0 * (x != x).astype(index.dtype)
    return jax.lax.optimization_barrier(x)[index]


@jax.custom_batching.custom_vmap
def _at_either_end(edges: jax.Array, flag: jax.Array) -> jax.Array:
    """Return which edges (B, 2) have a node that is flagged (N,)."""
    return _ends_of_any(edges, flag[None])[0]


@_at_either_end.def_vmap
def _at_either_end_of_many(
    size: int, is_batched: Sequence[bool], edges: jax.Array, flag: jax.Array
) -> tuple[jax.Array, bool]:
    if is_batched[0]:
        if not is_batched[1]:
            flag = jnp.broadcast_to(flag, (size, *flag.shape))
        return jax.vmap(lambda e, x: x[e[:, 0]] | x[e[:, 1]])(edges, flag), True
    return _ends_of_any(edges, flag), True


def _ends_of_any(edges: jax.Array, flag: jax.Array) -> jax.Array:
    """Do so for copies (T, N), at no cost if nothing is flagged, as most often."""
    shape = (flag.shape[0], edges.shape[0])
    # One by one: a gather of all at once would leave its result the other way round in
    # memory, whether it is taken or not, and all that reads it would be slow.
    return jax.lax.cond(
        graph.any_of_many(flag),
        lambda: jax.lax.map(lambda x: x[edges[:, 0]] | x[edges[:, 1]], flag),
        lambda: jnp.zeros(shape, bool),
    )


def _apply_to_bonds(
    asset: Asset, state: State, damage: jax.Array, marks: bool
) -> tuple[State, jax.Array]:
    damageable = _damageable(state.bond_health, state.bond_unbreakable)
    taken = _once(jnp.where((damage > 0) & damageable, damage, 0))
    left = state.bond_health - taken
    broken = (taken > 0) & (left <= 0)
    state = state.replace(
        bond_health=jnp.where(broken, 0, left),
        bond_intact=state.bond_intact & ~broken,
        dirty=_dirty(asset, state, broken) if marks else state.dirty,
    )
    return state, taken


def _dirty(asset: Asset, state: State, removed: jax.Array) -> jax.Array:
    nodes = state.dirty.shape[0]
    touched = graph.touched(asset.bond_nodes, removed, nodes, sweep=asset.sweep)
    return state.dirty | touched


def apply_buffer(
    asset: Asset, state: State, program: Program, buffer: Buffer
) -> tuple[State, FractureEvents]:
    """Apply buffered damage events in order, each to what the last one left.

    Args:
      asset: the asset.
      state: its state.
      program: what one event does, `(asset, state, event) -> Damage`.
      buffer: the events; see `damage.buffer`.

    Returns:
      The state, and the events summed over the buffer.

    Differentiable as `apply` and the program are; misses that a bond which broke
    earlier would change what later events see.
    """

    def one(state: State, item: tuple[Any, jax.Array]) -> tuple[State, Any]:
        event, index = item
        dealt = program(asset, state, event)
        pending = index < buffer.count
        dealt = jax.tree.map(lambda x: jnp.where(pending, x, 0), dealt)
        return apply(asset, state, dealt)

    capacity = jax.tree.leaves(buffer.events)[0].shape[0]
    steps = (buffer.events, jnp.arange(capacity, dtype=jnp.int32))
    state, events = jax.lax.scan(one, state, steps)

    def total(x: jax.Array) -> jax.Array:
        return jnp.any(x, axis=0) if x.dtype == bool else jnp.sum(x, axis=0)

    return state, jax.tree.map(total, events)


def split(
    asset: Asset, state: State, *, actors: jax.Array | None = None
) -> tuple[State, SplitEvents]:
    """Find the actors: islands of nodes, and children of chunks that gave way.

    A chunk that is an actor by itself, has no health left and has children is replaced
    by them, and they by theirs, as far as it goes. A dead chunk without children stays.

    Args:
      asset: the asset.
      state: its state.
      actors: (A,) bool by label, the actors to split; None for all.

    Returns:
      The state and which actors are new. Integers: no derivative passes through.
    """
    num_nodes, capacity = asset.span_node.shape[0], state.actor.shape[0]
    old = state.actor
    chosen = old != NONE
    if actors is not None:
        chosen = chosen & actors[jnp.maximum(old, 0)]
    edges, sweep = asset.bond_nodes, asset.sweep
    label = graph.islands(edges, state.bond_intact, num_nodes, sweep=sweep)
    label = jnp.where(chosen[:num_nodes], label, old[:num_nodes])
    actor = old.at[:num_nodes].set(label)
    state = state.replace(actor=actor, dirty=state.dirty & ~chosen[:num_nodes])

    origin = old
    released = jnp.zeros(capacity, bool)
    if asset.depth:
        elements = jnp.arange(capacity, dtype=jnp.int32)
        parent = jnp.maximum(asset.element_parent, 0)
        gives_way = (state.chunk_health <= 0) & chunks.has_children(asset)
        released = chosen & chunks.alone(asset, state) & gives_way
        for _ in range(asset.depth):
            freed = (asset.element_parent >= 0) & _lookup(released, parent)
            origin = jnp.where(freed, _lookup(origin, parent), origin)
            actor = jnp.where(freed, elements, actor)
            released = released | (freed & gives_way)
        state = state.replace(actor=jnp.where(released, NONE, actor))

    here = chunks.active(asset, state)
    # An actor that keeps its label is another one if anything left it.
    left = graph.group_any(state.actor != old, old, capacity)
    same = (old == state.actor) & ~left
    return state, SplitEvents(
        parent=jnp.where(here, origin, NONE),
        created=here & ~same,
        released=released,
    )


def deactivate(asset: Asset, state: State, actors: jax.Array) -> State:
    """Take actors out of the state for good; their elements belong to no actor.

    Args:
      asset: the asset.
      state: its state.
      actors: (A,) bool by label. The world itself always stays.

    Differentiable in healths; which actors go is constant.
    """
    num_nodes = asset.span_node.shape[0]
    out = (state.actor != NONE) & actors[jnp.maximum(state.actor, 0)]
    if asset.has_world:
        out = out.at[0].set(False)
    if asset.bond_nodes.shape[0]:
        gone = out[:num_nodes]
        loses = gone[asset.bond_nodes[:, 0]] | gone[asset.bond_nodes[:, 1]]
        state = state.replace(
            bond_health=jnp.where(loses, 0, state.bond_health),
            bond_intact=state.bond_intact & ~loses,
        )
    return state.replace(actor=jnp.where(out, NONE, state.actor))


def step(
    asset: Asset, state: State, damage: Damage
) -> tuple[State, tuple[FractureEvents, SplitEvents]]:
    """Apply damage and split.

    Healths are differentiable, as in `apply`; the split is not: `soft` has derivatives
    that see it.
    """
    state, fractured = _apply(asset, state, damage, marks=False)
    state, parted = split(asset, state)
    return state, (fractured, parted)
