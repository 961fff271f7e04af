"""The frame that a state leaves of a structure, and how its bonds and nodes connect.

C takes bond forces to what they add up to at the nodes, and its transpose takes the
displacements of nodes to what bonds feel of them. Neither is ever a matrix. A bond acts
at its centroid, so both know the arms from the nodes to there. Lengths and stiffnesses
are over their means, so that residuals of forces and of torques may be added.
"""

import jax
import jax.numpy as jnp

from blastjax import graph, pytree, spatial
from blastjax.core import Asset, State
from blastjax.stress.loads import node_place
from blastjax.stress.structures import Structure

Target = tuple[jax.Array, jax.Array]
"""What bonds (B, 6) and nodes (N, 6) should come to; also the strains (B, 6) and
displacements (N, 6) that bring them there."""


@pytree.dataclass
class Frame(pytree.Node):
    """The connected structure in units of its own: lengths over `length`."""

    first: jax.Array  # (B,) nodes
    second: jax.Array
    arm: jax.Array  # (B, 2, 3) from the nodes to the bond
    root: jax.Array  # (B, 6) square roots of the stiffnesses, 0 for dead bonds
    alive: jax.Array  # (B,) bool
    node_bonds: jax.Array  # (N, K)
    node_sign: jax.Array  # (N, K), 0 for dead bonds
    node_arm: jax.Array  # (N, K, 3)
    bears: jax.Array  # (N,) bool, nodes with an equation
    place: jax.Array  # (N, 3)
    label: jax.Array  # (N,) smallest node of the piece
    floats: jax.Array  # (N,) bool, nodes of pieces that nothing holds
    length: jax.Array  # () m
    sweep: jax.Array | None  # see `graph.islands`


def assemble(structure: Structure, asset: Asset, state: State) -> Frame:
    """Return what connects of a structure in a state, in units of its own."""
    first, second = asset.bond_nodes[:, 0], asset.bond_nodes[:, 1]
    place = node_place(asset)
    num_nodes = place.shape[0]
    alive = state.bond_intact & (first != second) & (structure.stiffness > 0)
    is_chunk = asset.element_chunk[:num_nodes] >= 0
    arm = asset.bond_centroid[:, None] - place[asset.bond_nodes]
    to_world = jnp.stack([jnp.zeros_like(alive), ~is_chunk[second]], axis=1)
    arm = jnp.where(to_world[..., None], 0, arm)
    reach = jax.lax.stop_gradient(spatial.norm(arm[:, 0]))
    count = jnp.maximum(jnp.sum(alive), 1).astype(reach.dtype)
    length = jnp.sum(jnp.where(alive, reach, 0)) / count
    length = jnp.where(length > 0, length, 1.0)
    arm, place = arm / length, place / length

    mean = jnp.sum(jnp.where(alive, structure.stiffness, 0)) / count
    mean = jax.lax.stop_gradient(jnp.where(mean > 0, mean, 1.0))
    weight = jnp.stack([structure.stiffness, structure.bending / length**2]) / mean
    weight = jnp.where(alive[None] & (weight > 0), weight, 0)
    # The root has no derivative where there is no stiffness: it never sees that.
    root = jnp.where(weight > 0, jnp.sqrt(jnp.where(weight > 0, weight, 1)), 0)
    root = jnp.repeat(root.T, 3, axis=1)

    label = graph.islands(asset.bond_nodes, alive, num_nodes, sweep=asset.sweep)
    held = (label == 0) & asset.has_world
    sign = rows(alive.astype(place.dtype), structure.node_bonds) * structure.node_sign
    side = (structure.node_sign < 0).astype(jnp.int32)
    both = rows(arm, structure.node_bonds)
    node_arm = jnp.where((side == 0)[..., None], both[:, :, 0], both[:, :, 1])
    return Frame(
        first=first,
        second=second,
        arm=arm,
        root=root,
        alive=alive,
        node_bonds=structure.node_bonds,
        node_sign=sign,
        node_arm=node_arm,
        bears=is_chunk & jnp.any(sign != 0, axis=1),
        place=place,
        label=label,
        floats=is_chunk & ~held,
        length=length,
        sweep=asset.sweep,
    )


def rows(values: jax.Array, index: jax.Array) -> jax.Array:
    """Return values[index], zero where the index is one past the end."""
    if values.shape[0] == 0:
        return jnp.zeros((*index.shape, *values.shape[1:]), values.dtype)
    return values.at[index].get(mode="fill", fill_value=0)


def size(vector: jax.Array) -> jax.Array:
    """Return the root of the sum of all squares."""
    return jnp.sqrt(jnp.sum(vector * vector))


def stretch(frame: Frame, shift: jax.Array) -> jax.Array:
    """C^T: displacements (N, 6) to what bonds feel of them, (B, 6)."""
    shift = jnp.where(frame.bears[:, None], shift, 0)
    a, b = shift[frame.first], shift[frame.second]
    turn = jnp.cross(a[:, 3:], frame.arm[:, 0]) - jnp.cross(b[:, 3:], frame.arm[:, 1])
    return jnp.concatenate([a[:, :3] - b[:, :3] + turn, a[:, 3:] - b[:, 3:]], axis=1)


def gather(frame: Frame, bond: jax.Array) -> jax.Array:
    """C: bond forces (B, 6) to what they add up to at the nodes, (N, 6)."""
    each = rows(bond, frame.node_bonds) * frame.node_sign[..., None]
    force = each[..., :3]
    torque = each[..., 3:] + jnp.cross(frame.node_arm, force)
    total = jnp.concatenate([force.sum(axis=1), torque.sum(axis=1)], axis=1)
    return jnp.where(frame.bears[:, None], total, 0)


def unbalanced(frame: Frame, load: jax.Array, strain: jax.Array) -> jax.Array:
    """Return the residual; the forces of a long lever dwarf its load."""
    bond = frame.root * strain
    left = size(load - gather(frame, bond))
    return spatial.ratio(left, jnp.maximum(size(load), size(bond)))
