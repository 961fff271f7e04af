"""Contacts between actors, the floor and the user's bodies; forces on the chunks.

MJX names the pairs of geoms and the parameters of their contacts; which of them are
real this step is decided here, before any cap: chunks of one actor do not meet, nor do
pieces of one split in their grace, nor chunks of no actor. Where more contacts are
found than the solver takes, each pair of actors keeps its outline first: dropping the
shallowest instead makes resting bodies tremble.

The shapes that collide may be larger than the chunks they stand for, so pieces of one
split can overlap from the start, and would burst apart. They may therefore overlap as
deep as they do when their grace ends, and only less deep from then on: a contact's
distance counts from there. Sizes: G geoms, K slots.
"""

import dataclasses
import itertools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from blastjax import graph, pytree
from blastjax.core import NONE
from blastjax.rigid import box, engine, hull
from blastjax.rigid.bodies import Bodies
from blastjax.rigid.scene import Scene

_PLANE, _BOX = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_BOX)
_ENDLESS = (_PLANE, int(mujoco.mjtGeom.mjGEOM_HFIELD))
_OFF = 1.0
"""Distance given to contacts that must not act, m beyond their margin."""

# Directions in which a manifold's extreme points are kept: crooked on purpose, so that
# a face's corners do not tie.
_OUTLINE = np.array(
    [
        [0.93, 0.31, 0.19],
        [-0.29, 0.91, 0.23],
        [0.62, 0.73, -0.17],
        [0.71, -0.64, 0.21],
        [-0.23, -0.27, 0.94],
    ]
)


@pytree.dataclass
class Riders(pytree.Node):
    """What carries each geom this step."""

    body: jax.Array
    """(G,) int32 body that moves with the geom; 0 for all that cannot move."""
    slot: jax.Array
    """(G,) int32 slot, K for what the world holds, NONE for the user's geoms."""
    active: jax.Array
    """(G,) bool, False for chunks of no actor."""


@dataclasses.dataclass(frozen=True)
class Collider:
    """How pairs of geoms collide."""

    find: Callable[[mjx.Model, mjx.Data, jax.Array], engine.Points]
    """Maps (model, data, pairs (n, 2)) to distance, position and frame."""
    count: int
    """Contacts that it finds for each pair, one pair's after the other's."""


@pytree.dataclass
class Dropped(pytree.Node):
    """What the caps left out this step."""

    pairs: jax.Array
    """() int32, pairs of geoms near each other and not looked at."""
    contacts: jax.Array
    """() int32, touching points that were not handed to the solver."""


@pytree.dataclass
class Found(pytree.Node):
    """What a search for contacts found besides them."""

    riders: Riders
    """What carried each geom."""
    overlap: jax.Array
    """(K + 1, K + 1) depth to which two slots may overlap from now on, m."""
    dropped: Dropped
    """What the caps left out."""


def riders(scene: Scene, bodies: Bodies) -> Riders:
    """Look up what carries each geom."""
    host = scene.host
    element = np.maximum(host.geom_element, 0)
    chunk = jnp.asarray(host.geom_element >= 0)
    slot = jnp.where(chunk, bodies.slot[element], NONE)
    carrier = jnp.asarray(np.append(host.slot_body, 0), jnp.int32)
    weld = jnp.asarray(host.geom_weld, jnp.int32)
    return Riders(
        body=jnp.where(chunk, carrier[jnp.maximum(slot, 0)], weld),
        slot=slot,
        active=~chunk | (slot != NONE),
    )


def collide(
    scene: Scene, bodies: Bodies, model: mjx.Model, data: mjx.Data
) -> tuple[mjx.Data, Found]:
    """Find the contacts of this step."""
    carried = riders(scene, bodies)
    zero = jnp.zeros((), jnp.int32)
    dropped = Dropped(pairs=zero, contacts=zero)
    overlap = bodies.overlap
    if data._impl.ncon == 0:
        return data, Found(riders=carried, overlap=overlap, dropped=dropped)
    cap = engine.numeric(model, "max_geom_pairs")
    found: dict[int, list] = {}
    for group, parameters in engine.contact_groups(model, data):
        for rows, collider in _colliders(scene, group):
            contacts = jax.tree.map(lambda x, rows=rows: x[rows], parameters)
            meets = _meets(carried, bodies.grace, contacts.geom)
            if group.types[0] not in _ENDLESS and len(rows) > cap:
                contacts, meets, lost = _nearest(model, data, contacts, meets, cap)
                dropped = dropped.replace(pairs=dropped.pairs + lost)
            points = collider.find(model, data, contacts.geom)
            contacts = _fill(contacts, meets, collider.count, points)
            if group.types in scene.host.chunk_kinds:
                contacts, overlap = _excuse_overlap(contacts, carried, bodies)
            found.setdefault(group.condim, []).append(contacts)

    limit = engine.numeric(model, "max_contact_points")
    merged = []
    for condim in sorted(found):
        contacts = jax.tree.map(lambda *x: jnp.concatenate(x), *found[condim])
        if contacts.dist.shape[0] > limit:
            contacts, lost = _thin(scene, contacts, carried, limit)
            dropped = dropped.replace(contacts=dropped.contacts + lost)
        merged.append(contacts)
    contacts = jax.tree.map(lambda *x: jnp.concatenate(x), *merged)
    data = data.tree_replace({"_impl.contact": contacts})
    return data, Found(riders=carried, overlap=overlap, dropped=dropped)


def make_data(scene: Scene) -> mjx.Data:
    """Return data at the model's start, with room for what the colliders find."""
    model = scene.model
    data = mjx.make_data(model, impl="jax")
    if data._impl.ncon == 0 or scene.hulls is None:
        return data
    cap = engine.numeric(model, "max_geom_pairs")
    counts: dict[int, int] = {}
    for group, _ in engine.contact_groups(model, data):
        for rows, collider in _colliders(scene, group):
            pairs = len(rows) if group.types[0] in _ENDLESS else min(len(rows), cap)
            counts[group.condim] = counts.get(group.condim, 0) + pairs * collider.count
    limit = engine.numeric(model, "max_contact_points")
    return engine.make_data(model, {c: min(n, limit) for c, n in counts.items()})


def _colliders(scene: Scene, group: engine.Group) -> list[tuple[np.ndarray, Collider]]:
    """Return which rows of a group collide by what."""
    chunk = scene.host.geom_element[group.pair] >= 0
    table = None if scene.hulls is None else hull.colliders(scene.hulls)
    parts: dict[Collider, list] = {}
    for first, second in itertools.product((False, True), repeat=2):
        sides = first, second
        rows = np.flatnonzero((chunk == sides).all(axis=1))
        if rows.size:
            how = _collider(group, sides, table)
            parts.setdefault(how, []).append(rows)
    return [(np.sort(np.concatenate(rows)), how) for how, rows in parts.items()]


def _collider(
    group: engine.Group,
    sides: tuple[bool, bool],
    table: dict[int, tuple[hull.Find, int]] | None,
) -> Collider:
    """Return how pairs of a group collide whose first or second geom is a chunk.

    A shape that MJX does not know is one more function (model, data, pairs) here.
    """
    if table is not None and any(sides):
        # A hull is a box to MJX; the other geom's type says how they meet.
        other = group.types[1] if sides[0] else group.types[0]
        return Collider(*table[other])
    if group.types == (_PLANE, _BOX):
        return Collider(_plane_box, 4)
    if group.types == (_BOX, _BOX):
        return Collider(box.box_box, box.POINTS)
    return Collider(group.find, group.count)


def _fill(
    contacts: mjx.Contact, meets: jax.Array, count: int, points: engine.Points
) -> mjx.Contact:
    """Put what a collider found, count points a pair, into the pairs' contacts."""
    if count > 1:
        contacts, meets = jax.tree.map(
            lambda x: jnp.repeat(x, count, axis=0), (contacts, meets)
        )
    distance, position, frame = points
    off = contacts.includemargin + _OFF
    distance = jnp.where(meets, distance, off)
    return contacts.replace(dist=distance, pos=position, frame=frame)


def normal_force(data: mjx.Data) -> jax.Array:
    """Return the normal force at each contact, (contacts,) N, 0 or more."""
    if data._impl.ncon == 0:
        return jnp.zeros(0, data.qacc.dtype)
    return engine.normal_force(data)


def element_force(scene: Scene, data: mjx.Data, force: jax.Array) -> jax.Array:
    """Sum the normal forces on each element's chunk, (A,) N."""
    capacity = scene.asset.element_chunk.shape[0]
    element = jnp.asarray(scene.host.geom_element, jnp.int32)
    pair = data._impl.contact.geom
    both = element[pair].T.reshape(-1)
    return graph.group_sum(jnp.tile(force, 2), both, capacity)


def _meets(carried: Riders, grace: jax.Array, pair: jax.Array) -> jax.Array:
    """Return which pairs of geoms (n, 2) can touch at all, (n,) bool."""
    first, second = pair[:, 0], pair[:, 1]
    apart = carried.body[first] != carried.body[second]
    here = carried.active[first] & carried.active[second]
    a, b = carried.slot[first], carried.slot[second]
    waiting = grace[jnp.maximum(a, 0), jnp.maximum(b, 0)] > 0
    return apart & here & ~(waiting & (a != NONE) & (b != NONE))


def _excuse_overlap(
    contacts: mjx.Contact, carried: Riders, bodies: Bodies
) -> tuple[mjx.Contact, jax.Array]:
    """Count the distance between two actors from the overlap they are allowed."""
    slots = carried.slot[contacts.geom]
    chunks = jnp.all(slots != NONE, axis=1)
    first, second = jnp.maximum(slots[:, 0], 0), jnp.maximum(slots[:, 1], 0)
    depth = jnp.maximum(contacts.includemargin - contacts.dist, 0.0)
    depth = jax.lax.stop_gradient(jnp.where(chunks, depth, 0.0))
    deepest = jnp.zeros_like(bodies.overlap).at[first, second].max(depth)
    deepest = jnp.maximum(deepest, deepest.T)
    less = jnp.minimum(bodies.overlap, deepest)
    overlap = jnp.where(bodies.grace > 0, bodies.overlap, less)
    excused = jnp.where(chunks, overlap[first, second], 0.0)
    return contacts.replace(dist=contacts.dist + excused), overlap


def _nearest(
    model: mjx.Model, data: mjx.Data, contacts: mjx.Contact, meets: jax.Array, cap: int
) -> tuple[mjx.Contact, jax.Array, jax.Array]:
    """Keep the pairs whose bounding spheres overlap most."""
    first, second = contacts.geom[:, 0], contacts.geom[:, 1]
    offset = jax.lax.stop_gradient(data.geom_xpos[second] - data.geom_xpos[first])
    reach = model.geom_rbound[first] + model.geom_rbound[second]
    gap = jnp.sqrt(jnp.sum(offset * offset, axis=1)) - reach
    near = meets & (gap < contacts.includemargin)
    _, kept = jax.lax.top_k(jnp.where(near, -gap, -jnp.inf), cap)
    lost = jnp.maximum(jnp.sum(near, dtype=jnp.int32) - cap, 0)
    contacts, near = jax.tree.map(lambda x: x[kept], (contacts, near))
    return contacts, near, lost


def _plane_box(model: mjx.Model, data: mjx.Data, pair: jax.Array) -> engine.Points:
    """Collide planes with boxes by MuJoCo C's rule, four contacts a pair.

    These are the corners below the box's centre along the normal. Of two opposite
    corners one is, so four diagonals give all of them. MJX's own function keeps corners
    close to the deepest one only, and a tilted beam then lands elsewhere.
    """
    plane, box = pair[:, 0], pair[:, 1]
    normal = data.geom_xmat[plane][:, :, 2]
    halves = np.array([[1, 1, 1], [1, 1, -1], [1, -1, 1], [1, -1, -1]])
    diagonal = halves[None].astype(normal.dtype) * model.geom_size[box][:, None, :]
    arm = jnp.einsum("nij,ncj->nci", data.geom_xmat[box], diagonal)
    height = jnp.sum(arm * normal[:, None, :], axis=-1)
    below = jnp.where(height > 0, -1.0, 1.0).astype(normal.dtype)
    arm, height = arm * below[..., None], height * below
    center = data.geom_xpos[box] - data.geom_xpos[plane]
    distance = jnp.sum(center * normal, axis=-1)[:, None] + height
    point = data.geom_xpos[box][:, None, :] + arm
    point = point - 0.5 * distance[..., None] * normal[:, None, :]
    frame = jax.vmap(engine.contact_frame)(normal)
    return (
        distance.reshape(-1),
        point.reshape(-1, 3),
        jnp.repeat(frame, 4, axis=0),
    )


def _thin(
    scene: Scene, contacts: mjx.Contact, carried: Riders, limit: int
) -> tuple[mjx.Contact, jax.Array]:
    """Keep the outline of every pair of bodies, then the deepest points."""
    depth = jax.lax.stop_gradient(contacts.includemargin - contacts.dist)
    point = jax.lax.stop_gradient(contacts.pos)
    touching = depth > 0
    # Most bodies are chunks, and carry no geom but by a slot.
    host = scene.host
    own = host.geom_weld[host.geom_element < 0]
    carriers = np.unique(np.concatenate([[0], host.slot_body, own]))
    number = np.searchsorted(carriers, np.arange(host.model.nbody))
    body = jnp.asarray(number, jnp.int32)[carried.body[contacts.geom]]
    pair = body[:, 0] * len(carriers) + body[:, 1]
    along = point @ _OUTLINE.T.astype(point.dtype)
    # The deepest point counts too; a slope settles which it is on a flat face.
    deepest = depth + 1e-5 * along[:, 0]
    along = jnp.concatenate([along, -along, deepest[:, None]], axis=1)
    along = jnp.where(touching[:, None], along, -jnp.inf)
    farthest = jnp.full((len(carriers) ** 2, along.shape[1]), -jnp.inf, along.dtype)
    farthest = farthest.at[pair].max(along)
    outline = touching & jnp.any(along >= farthest[pair], axis=1)
    # Any depth is less than this in metres.
    first = jnp.where(outline, 1e6, 0.0).astype(depth.dtype)
    _, kept = jax.lax.top_k(jnp.where(touching, first + depth, depth - 1e6), limit)
    lost = jnp.maximum(jnp.sum(touching, dtype=jnp.int32) - limit, 0)
    return jax.tree.map(lambda x: x[kept], contacts), lost
