"""Loads: forces and torques on the nodes of a structure.

A `Load` is a sum; make parts with these functions and add them with `add`. Torques are
about each node's centroid. Everything is in the rest frame of the asset.
"""

import jax
import jax.numpy as jnp

from blastjax import chunks, pytree, spatial
from blastjax.core import NONE, Asset, State


@pytree.dataclass
class Load(pytree.Node):
    """What pulls at the nodes."""

    force: jax.Array
    """(N, 3) N."""
    torque: jax.Array
    """(N, 3) about the centroid of each node's chunk, N m."""


def node_mass(asset: Asset, density: float | jax.Array) -> jax.Array:
    """Return the mass of each node, (N,) kg; density is one or (C,), kg/m^3.

    Differentiable, exactly.
    """
    volume = asset.chunk_volume
    density = jnp.broadcast_to(jnp.asarray(density, volume.dtype), volume.shape)
    return chunks.element_values(asset, density * volume)[: asset.span_node.shape[0]]


def node_place(asset: Asset) -> jax.Array:
    """Return the centroid of each node's chunk, (N, 3) m. Differentiable, exactly."""
    place = chunks.element_values(asset, asset.chunk_centroid)
    return place[: asset.span_node.shape[0]]


def gravity(mass: jax.Array, acceleration: jax.Array) -> Load:
    """Return the load of one acceleration (3,) on all nodes of mass (N,), m/s^2.

    Differentiable, exactly.
    """
    force = mass[:, None] * jnp.asarray(acceleration, mass.dtype)[None]
    return Load(force=force, torque=jnp.zeros_like(force))


def centrifugal(
    asset: Asset, mass: jax.Array, center: jax.Array, spin: jax.Array
) -> Load:
    """Return the outward load of a spin (3,), rad/s, about a centre (3,), m.

    Blast's load of this name points inward, as it stands there; this one is what the
    spinning body feels. Differentiable, exactly.
    """
    arm = node_place(asset) - jnp.asarray(center, mass.dtype)[None]
    turn = jnp.broadcast_to(jnp.asarray(spin, mass.dtype), arm.shape)
    force = -mass[:, None] * jnp.cross(turn, jnp.cross(turn, arm))
    return Load(force=force, torque=jnp.zeros_like(force))


def at_node(asset: Asset, node: jax.Array | int, force: jax.Array) -> Load:
    """Return the load of a force (3,) at the centroid of one node, N.

    Differentiable in the force, exactly.
    """
    here = jnp.arange(asset.span_node.shape[0], dtype=jnp.int32) == node
    force = jnp.asarray(force, asset.chunk_centroid.dtype)[None]
    force = jnp.where(here[:, None], force, 0)
    return Load(force=force, torque=jnp.zeros_like(force))


def at_position(
    asset: Asset,
    state: State,
    position: jax.Array,
    force: jax.Array,
    *,
    actors: jax.Array | None = None,
) -> Load:
    """Return the load of a force (3,) at a point (3,), carried by the nearest node.

    Args:
      asset: the asset.
      state: its state; only nodes that an actor owns count.
      position: where the force acts, m; its arm to the node makes a torque.
      force: N.
      actors: (A,) bool by label, the actors it may act on; None for all.

    Differentiable in the force and in places; misses that another node may be nearer.
    """
    num_nodes = asset.span_node.shape[0]
    place = node_place(asset)
    owner = state.actor[:num_nodes]
    eligible = (owner != NONE) & chunks.is_chunk(asset)[:num_nodes]
    if actors is not None:
        eligible = eligible & actors[jnp.maximum(owner, 0)]
    position = jnp.asarray(position, place.dtype)
    arm = position[None] - place
    square = jnp.where(eligible, spatial.dot(arm, arm), jnp.inf)
    node = jnp.argmin(square).astype(jnp.int32)
    node = jnp.where(eligible[node], node, NONE)
    load = at_node(asset, node, force)
    return load.replace(torque=jnp.cross(arm, load.force))


def add(first: Load, *others: Load) -> Load:
    """Return the sum of loads. Differentiable, exactly."""
    total = first
    for load in others:
        total = jax.tree.map(jnp.add, total, load)
    return total
