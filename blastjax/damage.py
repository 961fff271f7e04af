"""Damage programs: how much health an impact takes from every bond and chunk.

Each program looks at all actors at once, or at those named by `actors`, (A,) bool by
label. An actor of several nodes is hurt in its bonds; one that is a single chunk, in
that chunk. A custom program is any function of (asset, state, ...) that returns a
`Damage`.

Positions are in the rest frame of the asset, metres; amounts are health. A profile over
distance has two radii: the falloff profile is whole up to the first and falls linearly
to nothing at the second, the cutter profile is whole between them and nothing
elsewhere.

Amounts are differentiable in amount, radii, positions and geometry, almost everywhere:
where a profile has an edge, the jump is missed.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from blastjax import chunks, graph, pytree, spatial
from blastjax.core import NONE, Asset, Damage, State

Profile = Callable[[jax.Array], jax.Array]
Scalar = float | jax.Array


def falloff(
    asset: Asset,
    state: State,
    position: jax.Array,
    amount: Scalar,
    min_radius: Scalar,
    max_radius: Scalar,
    *,
    actors: jax.Array | None = None,
) -> Damage:
    """Damage around a point (3,): the falloff profile of the distance to it.

    Differentiable in position, amount and radii; misses the jump where the profile
    ends if both radii are equal.
    """
    profile = _falloff(asset, amount, min_radius, max_radius)
    return _radial(asset, state, lambda x: _distance(x, position), profile, actors)


def cutter(
    asset: Asset,
    state: State,
    position: jax.Array,
    amount: Scalar,
    min_radius: Scalar,
    max_radius: Scalar,
    *,
    actors: jax.Array | None = None,
) -> Damage:
    """Damage in a shell around a point (3,): the cutter profile of the distance.

    Differentiable in amount; misses the jumps at both radii, so the derivative by
    position and radii is zero.
    """
    amount, low, high = _scalars(asset, amount, min_radius, max_radius)

    def profile(r: jax.Array) -> jax.Array:
        return jnp.where((r >= low) & (r <= high), amount, 0)

    return _radial(asset, state, lambda x: _distance(x, position), profile, actors)


def capsule(
    asset: Asset,
    state: State,
    start: jax.Array,
    end: jax.Array,
    amount: Scalar,
    min_radius: Scalar,
    max_radius: Scalar,
    *,
    actors: jax.Array | None = None,
) -> Damage:
    """Damage around a segment, (3,) to (3,): the falloff profile of the distance.

    Differentiable in both ends, amount and radii, as `falloff` is.
    """
    profile = _falloff(asset, amount, min_radius, max_radius)

    def distance(x: jax.Array) -> jax.Array:
        return spatial.point_to_segment(x, _rows(start, x), _rows(end, x))

    return _radial(asset, state, distance, profile, actors)


def triangle(
    asset: Asset,
    state: State,
    corners: jax.Array,
    amount: Scalar,
    *,
    actors: jax.Array | None = None,
) -> Damage:
    """Damage where a triangle (3, 3) cuts: whole where it is crossed, else nothing.

    A bond is crossed if the segment between the centroids of its chunks is (to the
    world: the segment from the centroid straight through the bond's plane). A single
    chunk is crossed if a segment from one of its children to the chunk next in the
    asset's order is: siblings are contiguous, and the last one's neighbour is a
    stranger, as in Blast. The amount is differentiable, the hit is not.
    """
    dtype = asset.chunk_centroid.dtype
    (amount,) = _scalars(asset, amount)
    corners = jnp.asarray(corners, dtype)
    place = chunks.element_values(asset, asset.chunk_centroid)
    first, second = asset.bond_nodes[:, 0], asset.bond_nodes[:, 1]
    start, end = place[first], place[second]
    if asset.has_world:
        reach = spatial.dot(asset.bond_centroid - start, asset.bond_normal)
        through = start + asset.bond_normal * reach[:, None]
        end = jnp.where((second == 0)[:, None], through, end)
    crossed = spatial.segment_hits_triangle(start, end, corners)
    bond = _on_bonds(state, jnp.where(crossed, amount, 0))

    chunk = jnp.zeros_like(state.chunk_health)
    if asset.depth:
        here = asset.chunk_centroid
        after = jnp.concatenate([here[1:], here[-1:]])
        # Behind the last child there is no chunk, or padding: both look like a root.
        follows = jnp.append(asset.chunk_parent[1:], NONE) >= 0
        hit = follows & spatial.segment_hits_triangle(here, after, corners)
        parent_hit = graph.group_any(hit, asset.chunk_parent, here.shape[0])
        hit = chunks.element_values(asset, parent_hit)
        chunk = _on_chunks(asset, state, jnp.where(hit, amount, 0))
    dealt = Damage(bond=bond, chunk=chunk)
    return dealt if actors is None else restrict(asset, state, dealt, actors)


def shear(
    asset: Asset,
    state: State,
    position: jax.Array,
    normal: jax.Array,
    amount: Scalar,
    min_radius: Scalar,
    max_radius: Scalar,
    *,
    actors: jax.Array | None = None,
) -> Damage:
    """Damage along a walk through one actor, from the node closest to a point (3,).

    The chunk there takes the falloff profile at its centroid, which cuts it out if it
    is more than zero. The walk goes on from node to node along `normal` (3,), to the
    bond that lies furthest ahead each time, and stops where none lies further. Bonds at
    its nodes take the profile at their centroid, times |1 - |normal . bond normal||; a
    bond between two nodes of the walk takes it twice. The walk itself is constant under
    differentiation.
    """
    dtype = asset.chunk_centroid.dtype
    position = jnp.asarray(position, dtype)
    profile = _falloff(asset, amount, min_radius, max_radius)
    start, single = _closest(asset, state, position, actors)
    found = start != NONE
    only = jnp.arange(state.actor.shape[0], dtype=jnp.int32) == start

    centroid = chunks.element_values(asset, asset.chunk_centroid)
    at_chunk = profile(_distance(centroid, position))
    chunk = jnp.where(only, at_chunk, 0)

    direction = _rows(normal, asset.bond_normal)
    facing = spatial.dot(asset.bond_normal, direction)
    weight = jnp.abs(1 - jnp.abs(facing))
    at_bond = profile(_distance(asset.bond_centroid, position))
    ahead = spatial.dot(asset.bond_centroid - position[None], direction)
    walks = jnp.where(found & ~single, start, NONE)
    visits = _walk(asset, state, walks, jax.lax.stop_gradient(ahead))
    first, second = asset.bond_nodes[:, 0], asset.bond_nodes[:, 1]
    times = (visits[first] + visits[second]).astype(dtype)
    return Damage(bond=_on_bonds(state, times * weight * at_bond), chunk=chunk)


def impact_spread(
    asset: Asset,
    state: State,
    position: jax.Array,
    amount: Scalar,
    min_radius: Scalar,
    max_radius: Scalar,
    *,
    actors: jax.Array | None = None,
) -> Damage:
    """Damage that spreads through one actor from the node closest to a point (3,).

    A bond takes the falloff profile of its distance along the support graph: the
    shortest way over chunk centroids to its nearer node, and across it. It does not
    pass the world. A single chunk takes the whole amount. Distances are constant under
    differentiation.

    Blast measures the way by which a queue first arrives at a bond, which depends on
    the order of storage and loses entries when the queue is full; this measures the
    shortest.
    """
    amount, low, high = _scalars(asset, amount, min_radius, max_radius)
    profile = _falloff(asset, 1.0, low, high)
    start, single = _closest(asset, state, position, actors)
    only = jnp.arange(state.actor.shape[0], dtype=jnp.int32) == start
    chunk = jnp.where(only & single, amount, 0)

    first, second = asset.bond_nodes[:, 0], asset.bond_nodes[:, 1]
    place = chunks.element_values(asset, asset.chunk_centroid)
    stride = spatial.norm(place[second] - place[first])
    to_world = jnp.zeros_like(state.bond_intact)
    if asset.has_world:
        to_world = second == 0
        across = 2 * spatial.norm(asset.bond_centroid - place[first])
        stride = jnp.where(to_world, across, stride)
    stride = jax.lax.stop_gradient(stride)
    passable = _breakable(state) & ~to_world
    way = graph.shortest_ways(
        asset.bond_nodes,
        jnp.where(passable, stride, jnp.inf),
        jnp.where(single, NONE, start),
        high,
        asset.span_node.shape[0],
    )
    nearer = jnp.where(to_world, way[first], jnp.minimum(way[first], way[second]))
    reached = jnp.isfinite(nearer)
    length = jnp.where(reached, nearer + stride, 0)
    bond = jnp.where(reached, amount * profile(length), 0)
    return Damage(bond=_on_bonds(state, bond), chunk=chunk)


def restrict(asset: Asset, state: State, damage: Damage, actors: jax.Array) -> Damage:
    """Keep only the damage to the given actors, (A,) bool by label.

    Differentiable in damage; which actor a bond belongs to is constant.
    """
    bond, chunk = damage.bond, damage.chunk
    if bond is not None:
        bond = jnp.where(_chosen(state.actor[asset.bond_nodes[:, 0]], actors), bond, 0)
    if chunk is not None:
        chunk = jnp.where(_chosen(state.actor, actors), chunk, 0)
    return Damage(bond=bond, chunk=chunk)


@pytree.dataclass
class Material(pytree.Node):
    """How a material turns raw damage into health lost."""

    health: Scalar = 100.0
    """Raw damage that makes one unit."""
    min_threshold: Scalar = 0.0
    """Units at or below this do nothing."""
    max_threshold: Scalar = 1.0
    """Units are capped at this."""


def normalize(material: Material, amount: Scalar) -> jax.Array:
    """Return raw damage in units of the material's health, between its thresholds.

    To a material without health any damage is one unit. NaN does nothing.

    Differentiable in amount and health between the thresholds; misses the jump at
    the lower one.
    """
    amount = jnp.asarray(amount)
    health = jnp.asarray(material.health, amount.dtype)
    tough = health > 0
    units = jnp.where(tough, amount / jnp.where(tough, health, 1), 1)
    capped = jnp.where(units < material.max_threshold, units, material.max_threshold)
    return jnp.where(units > material.min_threshold, capped, 0)


@pytree.dataclass
class Buffer(pytree.Node):
    """Damage events that wait to be applied in order; a fixed number fits."""

    events: Any
    """Any pytree of event parameters; every leaf has one row an event, (E, ...)."""
    count: jax.Array
    """() int32, how many wait."""
    dropped: jax.Array
    """() int32, how many came when the buffer was full."""


def buffer(example: Any, capacity: int) -> Buffer:
    """Return an empty buffer for events shaped like the example.

    Raises:
      ValueError: the capacity is below 1.

    Holds zeros, with no derivative to speak of.
    """
    if capacity < 1:
        raise ValueError(f"capacity is {capacity}; a buffer holds at least one event")
    example = jax.tree.map(jnp.asarray, example)
    events = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), example)
    none = jnp.zeros((), jnp.int32)
    return Buffer(events=events, count=none, dropped=none)


def push(buffer: Buffer, event: Any) -> Buffer:
    """Append an event, or count it as dropped if the buffer is full.

    Differentiable in the event.
    """
    capacity = jax.tree.leaves(buffer.events)[0].shape[0]
    fits = buffer.count < capacity
    # Out of range, and so ignored, when the buffer is full.
    place = jnp.where(fits, buffer.count, capacity)
    events = jax.tree.map(
        lambda rows, x: rows.at[place].set(jnp.asarray(x, rows.dtype), mode="drop"),
        buffer.events,
        event,
    )
    return Buffer(
        events=events,
        count=buffer.count + fits.astype(jnp.int32),
        dropped=buffer.dropped + (~fits).astype(jnp.int32),
    )


def _scalars(asset: Asset, *values: Scalar) -> list[jax.Array]:
    return [_apart(value, asset.chunk_centroid.dtype) for value in values]


def _apart(value: Scalar, dtype: Any) -> jax.Array:
    """Return an array that a batch has at hand before it visits bonds and chunks.

    What is computed or looked up for a body, such as its turn of a scan, would be so
    again for each of its bonds.
    """
    array = jnp.asarray(value, dtype)
    if isinstance(value, int | float):
        return array
    return jax.lax.optimization_barrier(array)


def _rows(vector: jax.Array, like: jax.Array) -> jax.Array:
    return jnp.broadcast_to(_apart(vector, like.dtype), like.shape)


def _distance(points: jax.Array, position: jax.Array) -> jax.Array:
    return spatial.norm(_rows(position, points) - points)


def _by_axis(points: jax.Array) -> jax.Array:
    """Return points (n, 3), in memory axis by axis: a batch reads them in vectors."""
    # Flat, for XLA would choose another layout.
    flat = jax.lax.optimization_barrier(points.T.reshape(-1))
    return flat.reshape(3, -1).T


def _falloff(
    asset: Asset, amount: Scalar, min_radius: Scalar, max_radius: Scalar
) -> Profile:
    amount, low, high = _scalars(asset, amount, min_radius, max_radius)

    def profile(r: jax.Array) -> jax.Array:
        width = high - low
        fraction = (r - low) / jnp.where(width == 0, 1, width)
        ramp = jnp.where(width == 0, 0, (1 - fraction) * amount)
        return jnp.where(r > high, 0, jnp.where(r < low, amount, ramp))

    return profile


def _radial(
    asset: Asset,
    state: State,
    distance: Callable[[jax.Array], jax.Array],
    profile: Profile,
    actors: jax.Array | None,
) -> Damage:
    centroid = chunks.element_values(asset, asset.chunk_centroid)
    bond, chunk = map(_by_axis, (asset.bond_centroid, centroid))
    dealt = Damage(
        bond=_on_bonds(state, profile(distance(bond))),
        chunk=_on_chunks(asset, state, profile(distance(chunk))),
    )
    return dealt if actors is None else restrict(asset, state, dealt, actors)


def _breakable(state: State) -> jax.Array:
    if state.bond_unbreakable is None:
        return state.bond_health > 0
    return (state.bond_health > 0) & ~state.bond_unbreakable


def _on_bonds(state: State, amount: jax.Array) -> jax.Array:
    return jnp.where(_breakable(state) & (amount > 0), amount, 0)


def _on_chunks(asset: Asset, state: State, amount: jax.Array) -> jax.Array:
    return jnp.where(chunks.alone(asset, state) & (amount > 0), amount, 0)


def _chosen(actor: jax.Array, actors: jax.Array) -> jax.Array:
    return (actor != NONE) & actors[jnp.maximum(actor, 0)]


def _closest(
    asset: Asset, state: State, position: jax.Array, actors: jax.Array | None
) -> tuple[jax.Array, jax.Array]:
    """Return the element where an impact starts, or NONE, and whether it is alone."""
    single = chunks.alone(asset, state)
    owned = (state.actor != NONE) & chunks.is_chunk(asset)
    eligible = owned & (single | (state.chunk_health > 0))
    if actors is not None:
        eligible = eligible & _chosen(state.actor, actors)
    away = chunks.element_values(asset, asset.chunk_centroid)
    away = _rows(position, away) - away
    square = jnp.where(eligible, spatial.dot(away, away), jnp.inf)
    nearest = jnp.argmin(square).astype(jnp.int32)
    found = eligible[nearest]
    alone = single[nearest] & found

    # Between two chunks the bond decides on which side of it the point lies.
    if asset.bond_nodes.shape[0]:
        first, second = asset.bond_nodes[:, 0], asset.bond_nodes[:, 1]
        healthy = state.chunk_health > 0
        other = jnp.where(first == nearest, second, first)
        near = (first == nearest) | (second == nearest)
        near = near & (state.bond_health > 0) & healthy[other]
        if asset.has_world:
            near = near & (second != 0)
        offset = _rows(position, asset.bond_centroid) - asset.bond_centroid
        square = jnp.where(near, spatial.dot(offset, offset), jnp.inf)
        bond = jnp.argmin(square).astype(jnp.int32)
        below = spatial.dot(offset[bond], asset.bond_normal[bond]) < 0
        side = jnp.where(below, first[bond], second[bond])
        nearest = jnp.where(near[bond] & ~alone, side, nearest)
    return jnp.where(found, nearest, NONE), alone


def _walk(asset: Asset, state: State, start: jax.Array, ahead: jax.Array) -> jax.Array:
    """Return how often the walk of `shear` visits each node, (N,) int32."""
    num_nodes = asset.span_node.shape[0]
    if asset.bond_nodes.shape[0] == 0:
        return jnp.zeros(num_nodes, jnp.int32)
    first, second = asset.bond_nodes[:, 0], asset.bond_nodes[:, 1]
    open_bond = _breakable(state)

    def visit(
        carry: tuple[jax.Array, jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        node, best, visits = carry
        visits = visits.at[node].add(1)
        leads = open_bond & ((first == node) | (second == node))
        reach = jnp.where(leads, ahead, -jnp.inf)
        bond = jnp.argmax(reach)
        further = reach[bond] > best
        other = jnp.where(first[bond] == node, second[bond], first[bond])
        following = jnp.where(further, other, NONE)
        return following, jnp.where(further, reach[bond], best), visits

    # Each move leads further ahead than any before, so the walk ends.
    carry = (start, jnp.zeros((), ahead.dtype), jnp.zeros(num_nodes, jnp.int32))
    return jax.lax.while_loop(lambda c: c[0] != NONE, visit, carry)[2]
