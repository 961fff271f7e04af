"""The data: an immutable asset, the state of one instance, damage and events.

Sizes: C chunks, N graph nodes, B bonds, A elements.

A *node* is a support chunk, or the world. The world, when an asset is bonded to it, is
node 0: the smallest label of an island then says for free whether the world holds it.

An *element* is whatever carries a health and can belong to an actor: the N nodes first,
then the sub-support chunks, A in all. There can never be more than A actors.

An *actor* is named by its label: the smallest element in it. Labels say nothing about
history (Blast's own indices depend on the order in which bonds broke).

No docstring here speaks of a batch: these describe one destructible, and `jax.vmap`
does the rest. Padding is dead matter: no parent, no volume, no health, no actor.
"""

import jax

from blastjax import pytree

NO_PARENT = -1
"""Parent of a root chunk."""
WORLD = -1
"""The world's place in a bond description's pair of chunks, and node 0's chunk."""
NONE = -1
"""Absent: no chunk, no element, no actor."""
NO_WORLD = -2
"""Node 0's chunk where padding made room for a world that the asset does not have."""
UNBREAKABLE = 1.7e38
"""Healths from here up (half of the largest float32) mean unbreakable, as in Blast."""


@pytree.dataclass
class Asset(pytree.Node):
    """What a destructible is made of; made by `author.build`, never changed."""

    chunk_parent: jax.Array
    """(C,) parent chunk, NO_PARENT for roots."""
    chunk_children: jax.Array
    """(C,) number of children."""
    chunk_centroid: jax.Array
    """(C, 3) centre of mass in the asset's rest frame, m."""
    chunk_volume: jax.Array
    """(C,) volume, m^3."""
    chunk_inertia: jax.Array
    """(C, 3, 3) inertia about the centroid at unit density, rest axes, m^5."""
    chunk_size: jax.Array
    """(C, 3) half extents of the box that stands for the chunk in collisions, m."""
    chunk_element: jax.Array
    """(C,) element of the chunk, NONE above the support level."""
    chunk_span: jax.Array
    """(C, 2) the support chunks of its subtree: this range of `span_node`."""
    span_node: jax.Array
    """(N,) nodes in depth-first order of the hierarchy, the world and padding last."""
    element_chunk: jax.Array
    """(A,) chunk of the element; WORLD or NO_WORLD for node 0, NONE for padding."""
    element_parent: jax.Array
    """(A,) parent element of a sub-support chunk, NONE for nodes and padding."""
    bond_nodes: jax.Array
    """(B, 2) nodes, the lower first, but the world always second."""
    bond_normal: jax.Array
    """(B, 3) unit normal, from the first node to the second."""
    bond_centroid: jax.Array
    """(B, 3) centroid of the bonded face in the rest frame, m."""
    bond_area: jax.Array
    """(B,) bonded area, m^2."""
    has_world: bool = pytree.static()
    """Whether node 0 is the world."""
    depth: int = pytree.static()
    """Levels of the hierarchy below the support chunks; 0 if there are none."""
    height: int = pytree.static()
    """Levels of the hierarchy above the support chunks; 0 if there are none."""
    sweep: jax.Array | None = None
    """(M,) `lanes.order` of the support graph, by which batches on the CPU are swept;
    None does without. It follows from the bonds: who changes them puts None there."""


@pytree.dataclass
class State(pytree.Node):
    """Everything about one instance of an asset that damage can change."""

    bond_health: jax.Array
    """(B,) health, 0 once broken."""
    bond_intact: jax.Array
    """(B,) bool, whether the bond still connects its nodes."""
    chunk_health: jax.Array
    """(A,) health of each element's chunk; below 0 by what it could not absorb."""
    actor: jax.Array
    """(A,) label of the actor that owns the element, NONE if no actor does."""
    dirty: jax.Array
    """(N,) bool, whether the node lost a bond since the last split."""
    bond_unbreakable: jax.Array | None = None
    """(B,) bool, bonds that damage passes by; None when every bond can break."""
    chunk_unbreakable: jax.Array | None = None
    """(A,) bool, elements that damage passes by; None when every chunk can break."""


@pytree.dataclass
class Damage(pytree.Node):
    """Health to take away. None in place of an array: nothing of that kind is hit."""

    bond: jax.Array | None = None
    """(B,) health taken from each bond; entries that are not above 0 do nothing."""
    chunk: jax.Array | None = None
    """(A,) health taken from each element; entries not above 0 do nothing."""


@pytree.dataclass
class FractureEvents(pytree.Node):
    """What `fracture.apply` did."""

    bond_damage: jax.Array
    """(B,) damage that reached bonds."""
    bond_broken: jax.Array
    """(B,) bool, bonds that stopped connecting."""
    chunk_damage: jax.Array
    """(A,) damage that reached elements, excess from their parents included."""
    excess: jax.Array
    """(A,) damage beyond the health of an element, offered to its children."""


@pytree.dataclass
class SplitEvents(pytree.Node):
    """What `fracture.split` did."""

    parent: jax.Array
    """(A,) by label: the label of the actor that it was part of before, or NONE."""
    created: jax.Array
    """(A,) bool, by label: actors that own other elements than any actor before."""
    released: jax.Array
    """(A,) bool, elements that gave way to their children."""
