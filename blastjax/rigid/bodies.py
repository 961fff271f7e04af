"""Which actor rides in which slot, and where that puts its chunks.

A slot's frame has the asset's rest axes and its origin at the actor's centre of mass,
so a chunk sits at (centroid - centre of mass) in it, without rotation. Index K stands
for what the world holds; its frame is the asset's placement. Sizes: K slots, A
elements.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from blastjax import chunks, graph, pytree, spatial
from blastjax.core import NONE, SplitEvents, State
from blastjax.rigid import engine, solver
from blastjax.rigid.scene import Scene

UNMEASURED = 1e3
"""Overlap of pieces that have not collided since their split, m."""
PARKED = (0.0, 0.0, -1000.0)
"""Where the geoms of chunks that belong to no actor wait, m."""


@pytree.dataclass
class Bodies(pytree.Node):
    """The slots and who rides in them."""

    slot: jax.Array
    """(A,) int32 slot of each element, K for the world's, NONE for no actor's."""
    label: jax.Array
    """(K,) int32 actor in each slot, NONE in an empty one."""
    mass: jax.Array
    """(K,) kg; 1 in an empty slot."""
    center: jax.Array
    """(K, 3) centre of mass in the rest frame, m."""
    inertia: jax.Array
    """(K, 3, 3) about the centre of mass, rest axes, kg m^2; 1 in an empty slot."""
    grace: jax.Array
    """(K + 1, K + 1) int32 steps for which two slots still do not collide."""
    overlap: jax.Array
    """(K + 1, K + 1) depth to which two slots may overlap, m: see `contact`."""
    way: jax.Array | None
    """(K, 6) how far slots have come since they were last counted as moving, m and rad;
    None in a scene without `resting`."""
    calm: jax.Array | None
    """(K,) for how long that has not been far, s; None likewise."""


@pytree.dataclass
class Frames(pytree.Node):
    """Pose and motion of the slots, the world's last."""

    position: jax.Array
    """(K + 1, 3) of the centre of mass, m."""
    quaternion: jax.Array
    """(K + 1, 4)."""
    rotation: jax.Array
    """(K + 1, 3, 3) the same as a matrix."""
    center: jax.Array
    """(K + 1, 3) the same point in the rest frame, m."""
    velocity: jax.Array
    """(K + 1, 3) of the centre of mass, m/s."""
    spin: jax.Array
    """(K + 1, 3) angular velocity in the slot's own axes, rad/s."""


def nobody(scene: Scene) -> Bodies:
    """Return empty slots."""
    slots, elements = scene.slots, scene.asset.element_chunk.shape[0]
    dtype, sleeps = scene.position.dtype, scene.resting is not None
    return Bodies(
        slot=jnp.full(elements, NONE, jnp.int32),
        label=jnp.full(slots, NONE, jnp.int32),
        mass=jnp.ones(slots, dtype),
        center=jnp.zeros((slots, 3), dtype),
        inertia=jnp.broadcast_to(jnp.eye(3, dtype=dtype), (slots, 3, 3)),
        grace=jnp.zeros((slots + 1, slots + 1), jnp.int32),
        overlap=jnp.zeros((slots + 1, slots + 1), dtype),
        way=jnp.zeros((slots, 6), dtype) if sleeps else None,
        calm=jnp.zeros(slots, dtype) if sleeps else None,
    )


def frames(scene: Scene, bodies: Bodies, data: mjx.Data) -> Frames:
    """Read where the slots are and how they move."""
    pose, motion = data.qpos[scene.host.slot_qpos], data.qvel[scene.host.slot_dof]
    still = jnp.zeros((1, 3), pose.dtype)
    # An orientation is stored unnormalised and read normalised, as MuJoCo does.
    turn = spatial.unit_quaternion(pose[:, 3:])
    turn = jnp.concatenate([turn, scene.quaternion[None]])
    return Frames(
        position=jnp.concatenate([pose[:, :3], scene.position[None]]),
        quaternion=turn,
        rotation=spatial.matrix(turn),
        center=jnp.concatenate([bodies.center, still]),
        velocity=jnp.concatenate([motion[:, :3], still]),
        spin=jnp.concatenate([motion[:, 3:], still]),
    )


def to_world(frames: Frames, slot: jax.Array, point: jax.Array) -> jax.Array:
    """Map rest-frame points (n, 3), carried by slots (n,), into the world."""
    arm = spatial.rotate(point - frames.center[slot], frames.quaternion[slot])
    return frames.position[slot] + arm


def to_rest(frames: Frames, slot: jax.Array, point: jax.Array) -> jax.Array:
    """Map world points (n, 3), seen from slots (n,), into the rest frame."""
    back = spatial.conjugate(frames.quaternion[slot])
    return frames.center[slot] + spatial.rotate(point - frames.position[slot], back)


def chunk_poses(
    scene: Scene, bodies: Bodies, data: mjx.Data
) -> tuple[jax.Array, jax.Array]:
    """Return where each element's chunk is: (A, 3) m, and its orientation (A, 4).

    Chunks that belong to no actor are parked far below.
    """
    seen = frames(scene, bodies, data)
    position, slot = _carried(scene, bodies, seen)
    return position, seen.quaternion[slot]


def _carried(scene: Scene, bodies: Bodies, seen: Frames) -> tuple[jax.Array, jax.Array]:
    """Return where each chunk is, (A, 3) m, and the slot that turns it, (A,)."""
    rest = chunks.element_values(scene.asset, scene.asset.chunk_centroid)
    here = (bodies.slot != NONE)[:, None]
    slot = jnp.maximum(bodies.slot, 0)
    parked = jnp.asarray(PARKED, rest.dtype)[None]
    return jnp.where(here, to_world(seen, slot, rest), parked), slot


def place(scene: Scene, bodies: Bodies, data: mjx.Data) -> mjx.Data:
    """Put every chunk's mocap body where its actor has it."""
    position, quaternion = chunk_poses(scene, bodies, data)
    host = scene.host
    return data.replace(
        mocap_pos=data.mocap_pos.at[host.mocap].set(position[host.element]),
        mocap_quat=data.mocap_quat.at[host.mocap].set(quaternion[host.element]),
    )


def weigh(scene: Scene, bodies: Bodies) -> mjx.Model:
    """Return the model with the actors' masses in their slots."""
    body = scene.host.slot_body
    mass, inertia = bodies.mass, bodies.inertia
    # Contacts are as soft as the inverse inertias of the bodies say.
    inverse = jnp.trace(_inverse(inertia), axis1=1, axis2=2) / 3.0
    softness = jnp.stack([1.0 / mass, inverse], axis=1)
    model = scene.model
    return model.replace(
        body_mass=model.body_mass.at[body].set(mass),
        body_invweight0=model.body_invweight0.at[body].set(softness),
    )


def kinematics(
    scene: Scene, model: mjx.Model, bodies: Bodies, seen: Frames, data: mjx.Data
) -> tuple[mjx.Data, engine.Own]:
    """Place every body and geom; return the user's part, with its inertia, besides."""
    host, slots = scene.host, scene.slots
    own = engine.kinematics(engine.part(host.own, model, data))
    center, slot = _carried(scene, bodies, seen)
    position, turn = seen.position[:slots], seen.quaternion[:slots]

    # Chunks come before slots, and have their geoms at their centres.
    chunk = slot[host.element]
    place = jnp.concatenate([center[host.element], position])
    rotation = jnp.concatenate([seen.rotation[chunk], seen.rotation[:slots]])
    element = host.geom_element[own.model.ngeom :]
    axis = jnp.broadcast_to(jnp.array([0, 0, 1], place.dtype), (slots, 3))
    rest: dict[str, jax.Array | None] = {
        "qpos": jnp.concatenate([position, turn], axis=1).reshape(-1),
        "mocap_pos": center[host.element],
        "mocap_quat": seen.quaternion[chunk],
        "xanchor": position,
        "xaxis": axis,
        "xpos": place,
        "xquat": jnp.concatenate([seen.quaternion[chunk], turn]),
        "xmat": rotation,
        "xipos": place,
        "ximat": rotation,
        "geom_xpos": center[element],
        "geom_xmat": seen.rotation[slot[element]],
        "site_xpos": None,
        "site_xmat": None,
    }
    if scene.watched:
        rest |= {"subtree_com": place, "cdof": _axes(seen.rotation[:slots])}
    if model.ntendon:
        rest["ten_length"] = None
    data = engine.extended(data, own.data, rest)
    return engine.cameras(model, data), own


def _axes(rotation: jax.Array) -> jax.Array:
    """Return the axes of slots turned so (K, 3, 3): (6 K, 6), as MJX has them."""
    zero = jnp.zeros_like(rotation)
    eye = zero + jnp.eye(3, dtype=zero.dtype)
    linear = jnp.concatenate([zero, eye], axis=2)
    angular = jnp.concatenate([jnp.swapaxes(rotation, 1, 2), zero], axis=2)
    return jnp.concatenate([linear, angular], axis=1).reshape(-1, 6)


def slot_inertia(bodies: Bodies) -> jax.Array:
    """Return the joint-space inertia of each slot, (6, 6, K)."""
    slots, axis = len(bodies.mass), np.arange(3)
    block = jnp.zeros((slots, 6, 6), bodies.mass.dtype)
    block = block.at[:, axis, axis].set(bodies.mass[:, None])
    block = block.at[:, 3:, 3:].set(bodies.inertia)
    return jnp.moveaxis(block, 0, -1)


def accelerate(
    scene: Scene,
    model: mjx.Model,
    bodies: Bodies,
    seen: Frames,
    data: mjx.Data,
    own: engine.Own,
) -> tuple[mjx.Data, engine.Own]:
    """Compute the acceleration without constraints, each slot's by itself."""
    host, slots = scene.host, scene.slots
    spin = seen.spin[:slots]
    # A slot's origin is its centre of mass; it turns in its own axes.
    weight = bodies.mass[:, None] * engine.gravity(model)
    gyroscopic = jnp.cross(spin, _times(bodies.inertia, spin))
    bias = jnp.concatenate([-weight, gyroscopic], axis=1)
    bias = jnp.where((bodies.label == NONE)[:, None], 0.0, bias)
    push = data.xfrc_applied[host.slot_body]
    back = jnp.swapaxes(seen.rotation[:slots], 1, 2)
    push = jnp.concatenate([push[:, :3], _times(back, push[:, 3:])], axis=1)
    force = data.qfrc_applied[host.slot_dof] + push - bias
    # By a factor: an inverse of a needle's inertia would lose what turns it over.
    moving = solver.divide_blocks(slot_inertia(bodies), force.T).T
    rest: dict[str, jax.Array | None] = {
        "qfrc_bias": bias.reshape(-1),
        "qfrc_smooth": force.reshape(-1),
        "qacc_smooth": moving.reshape(-1),
    }
    if scene.users:
        own = engine.accelerate(own)
        nothing = jnp.zeros_like(bias).reshape(-1)
        rest |= dict.fromkeys(engine.JOINT_FORCES, nothing)
        rest |= dict.fromkeys(engine.ACTUATION)
    if scene.watched:
        rest |= _motion(scene, bodies, seen)
    data = engine.extended(data, own.data, rest)
    return engine.velocity_sensors(model, data), own


def _motion(scene: Scene, bodies: Bodies, seen: Frames) -> dict[str, jax.Array]:
    """Return what MJX says of how bodies move, of chunks (nothing) and of slots."""
    slots = scene.slots
    turn, velocity = seen.rotation[:slots], seen.velocity[:slots]
    back = jnp.swapaxes(turn, 1, 2)
    motion = jnp.concatenate([_times(turn, seen.spin[:slots]), velocity], axis=1)
    inertia = engine.composite(bodies.mass, turn @ bodies.inertia @ back)
    drift = jnp.zeros((slots, 6, 6), turn.dtype)
    drift = drift.at[:, 3:, 3:].set(jnp.cross(velocity[:, None], back))
    still = len(scene.host.element)
    return {
        "cvel": jnp.pad(motion, ((still, 0), (0, 0))),
        "cdof_dot": drift.reshape(-1, 6),
        "_impl.cinert": jnp.pad(inertia, ((still, 0), (0, 0))),
    }


def outcasts(scene: Scene, state: State) -> jax.Array:
    """Return the actors too light for a slot, (A,) bool by label.

    The K heaviest that the world does not hold have one; among equals, the smaller
    label.
    """
    order, weight = _ranking(scene, state)
    kept = jnp.zeros(weight.shape[0], bool).at[order].set(True)
    return (weight > 0) & ~kept


def reassign(
    scene: Scene,
    bodies: Bodies,
    data: mjx.Data,
    state: State,
    parted: SplitEvents,
    grace_steps: int | jax.Array,
) -> tuple[Bodies, mjx.Data]:
    """Give every actor a slot and the motion that its parent had at that place.

    An actor's heaviest heir keeps its slot, the others take the lowest free slots,
    heavier first. Momentum, angular momentum and energy are those of the parent's rigid
    motion. What the world lets go starts at rest.

    Args:
      scene: the scene.
      bodies: slots before the split.
      data: positions and velocities before it.
      state: after the split; at most K moving actors (see `outcasts`).
      parted: what the split did.
      grace_steps: for so many steps the pieces of one actor do not collide.
    """
    capacity, slots = state.actor.shape[0], scene.slots
    moments = chunks.moments(scene.asset, state, scene.density)
    order, weight = _ranking(scene, state)
    live = weight[order] > 0
    parent = parted.parent[order]
    origin = jnp.where(parent != NONE, bodies.slot[jnp.maximum(parent, 0)], NONE)
    origin = jnp.where(live, origin, NONE)
    slot = _assign(origin, live, slots)

    # Slots look up their actor: index K of these tables is the place for nobody.
    where = jnp.where(live, slot, slots)
    rank = jnp.full(slots, slots, jnp.int32)
    rank = rank.at[where].set(jnp.arange(slots, dtype=jnp.int32), mode="drop")
    used = rank < slots
    rank = jnp.minimum(rank, slots - 1)
    label = jnp.where(used, order[rank], NONE)
    origin = jnp.where(used, origin[rank], NONE)
    pick = jnp.maximum(label, 0)
    eye = jnp.eye(3, dtype=moments.inertia.dtype)
    now = bodies.replace(
        slot=_element_slots(scene, state, label, capacity),
        label=label,
        mass=jnp.where(used, moments.mass[pick], 1.0),
        center=jnp.where(used[:, None], moments.center[pick], bodies.center),
        inertia=jnp.where(used[:, None, None], moments.inertia[pick], eye),
    )
    created = used & parted.created[pick]
    if scene.host.chunk_kinds:
        # What the world holds has a place in the tables too, and is its own heir.
        holder = parted.created[0] if scene.asset.has_world else False
        family = jnp.append(origin, slots), jnp.append(created, holder)
        now = now.replace(
            grace=_pass_on(bodies.grace, *family, grace_steps),
            overlap=_pass_on(bodies.overlap, *family, UNMEASURED),
        )
    if now.calm is not None:
        now = now.replace(calm=jnp.where(jnp.any(created), 0.0, now.calm))
    return now, _inherit(scene, bodies, now, data, origin, created)


def settle(scene: Scene, bodies: Bodies) -> Bodies:
    """Let one step of grace pass, where chunks can collide at all."""
    if not scene.host.chunk_kinds:
        return bodies
    return bodies.replace(grace=jnp.maximum(bodies.grace - 1, 0))


def host_data(scene: Scene, bodies: Bodies, data: mjx.Data) -> mujoco.MjData:
    """Return the same moment in MuJoCo C, for rendering: one world, not a batch."""
    placed = place(scene, bodies, data)
    out = mujoco.MjData(scene.host.model)
    for name in ("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat"):
        getattr(out, name)[:] = jax.device_get(getattr(placed, name))
    out.time = float(data.time)
    mujoco.mj_kinematics(scene.host.model, out)
    mujoco.mj_comPos(scene.host.model, out)
    mujoco.mj_camlight(scene.host.model, out)
    return out


def _times(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Return products of (K, 3, 3) and (K, 3)."""
    return jnp.sum(matrix * vector[:, None, :], axis=2)


def _inverse(matrix: jax.Array) -> jax.Array:
    """Invert (K, 3, 3) by cofactors: cheap, and differentiable."""
    a, b, c = matrix[:, 0], matrix[:, 1], matrix[:, 2]
    cofactors = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=-1)
    return cofactors / spatial.dot(a, jnp.cross(b, c))[:, None, None]


def _ranking(scene: Scene, state: State) -> tuple[jax.Array, jax.Array]:
    """Return the K heaviest moving actors, (K,) labels, and all weights (A,) or 0."""
    asset = scene.asset
    weight = chunks.element_values(asset, scene.density * asset.chunk_volume)
    mass = graph.group_sum(weight, state.actor, state.actor.shape[0])
    moving = chunks.active(asset, state) & ~chunks.held(asset, state)
    weight = jax.lax.stop_gradient(jnp.where(moving, mass, 0.0))
    _, order = jax.lax.top_k(weight, scene.slots)
    return order.astype(jnp.int32), weight


def _assign(origin: jax.Array, live: jax.Array, slots: int) -> jax.Array:
    """Return the slot (K,) of actors in order of weight, from their parents' slots."""
    index = jnp.arange(slots, dtype=jnp.int32)
    could = live & (origin >= 0) & (origin < slots)
    earlier = (index[None, :] < index[:, None]) & could[None, :]
    beaten = jnp.any(earlier & (origin[None, :] == origin[:, None]), axis=1)
    keeps = could & ~beaten
    taken = jnp.any(keeps[:, None] & (origin[:, None] == index[None, :]), axis=0)
    free = jnp.argsort(taken, stable=True).astype(jnp.int32)
    turn = jnp.cumsum((live & ~keeps).astype(jnp.int32)) - 1
    return jnp.where(keeps, origin, free[jnp.maximum(turn, 0)])


def _element_slots(
    scene: Scene, state: State, label: jax.Array, capacity: int
) -> jax.Array:
    slots = scene.slots
    # Empty slots write out of range, which drops them.
    at = jnp.where(label == NONE, capacity, label)
    table = jnp.full(capacity, NONE, jnp.int32)
    table = table.at[at].set(jnp.arange(slots, dtype=jnp.int32), mode="drop")
    if scene.asset.has_world:
        table = table.at[0].set(slots)
    return jnp.where(state.actor == NONE, NONE, table[jnp.maximum(state.actor, 0)])


def _pass_on(
    table: jax.Array,
    origin: jax.Array,
    created: jax.Array,
    fresh: int | float | jax.Array,
) -> jax.Array:
    """Give children their parents' entries (K + 1, K + 1), siblings a fresh one."""
    known = (origin[:, None] != NONE) & (origin[None, :] != NONE)
    parent = jnp.maximum(origin, 0)
    inherited = table[parent][:, parent]
    siblings = (origin[:, None] == origin[None, :]) & (
        created[:, None] | created[None, :]
    )
    entries = jnp.where(siblings, jnp.asarray(fresh, table.dtype), inherited)
    return jnp.where(known & ~jnp.eye(len(origin), dtype=bool), entries, 0)


def _inherit(
    scene: Scene,
    before: Bodies,
    after: Bodies,
    data: mjx.Data,
    origin: jax.Array,
    created: jax.Array,
) -> mjx.Data:
    used = (origin != NONE)[:, None]
    seen = frames(scene, before, data)
    parent = jnp.maximum(origin, 0)
    turn, spin = seen.quaternion[parent], seen.spin[parent]
    arm = spatial.rotate(after.center - seen.center[parent], turn)
    velocity = seen.velocity[parent] + jnp.cross(spatial.rotate(spin, turn), arm)
    pose = jnp.concatenate([seen.position[parent] + arm, turn], axis=1)
    motion = jnp.concatenate([velocity, spin], axis=1)
    qpos, dof = scene.host.slot_qpos, scene.host.slot_dof
    # An actor that no split touched must not even be rounded.
    other = origin != jnp.arange(scene.slots, dtype=origin.dtype)
    moved = used & (created | other)[:, None]
    pose = jnp.where(moved, pose, data.qpos[qpos])
    motion = jnp.where(moved, motion, jnp.where(used, data.qvel[dof], 0.0))
    warm = jnp.where(moved | ~used, 0.0, data.qacc_warmstart[dof])
    return data.replace(
        qpos=data.qpos.at[qpos].set(pose),
        qvel=data.qvel.at[dof].set(motion),
        qacc_warmstart=data.qacc_warmstart.at[dof].set(warm),
    )
