"""The rows of the contact problem, from contacts and the user's own constraints.

A contact moves with the slots on its sides, and with the user's joints where a geom of
theirs can meet it. Its stiffness and the acceleration that it asks for follow MuJoCo's
computation chapter: impedance from depth, reference from depth and velocity.
"""

import jax
import jax.numpy as jnp
from mujoco import mjx

from blastjax.core import NONE
from blastjax.rigid import engine, solver
from blastjax.rigid.bodies import Bodies, Frames, slot_inertia
from blastjax.rigid.contact import Riders
from blastjax.rigid.scene import Scene


def problem(
    scene: Scene,
    model: mjx.Model,
    data: mjx.Data,
    own: engine.Own,
    bodies: Bodies,
    frames: Frames,
    carried: Riders,
) -> solver.Problem:
    """Return the contact problem of this step."""
    inertia = jnp.zeros((0, 0), data.qvel.dtype)
    if scene.users:
        inertia = engine.mass_matrix(own)
    return solver.Problem(
        user_inertia=inertia,
        slot_inertia=slot_inertia(bodies),
        free=motion(scene, data.qacc_smooth),
        rows=engine.user_rows(own),
        contacts=_contacts(scene, model, data, own, frames, carried),
    )


def resolve(
    scene: Scene,
    model: mjx.Model,
    data: mjx.Data,
    own: engine.Own,
    bodies: Bodies,
    frames: Frames,
    carried: Riders,
) -> tuple[mjx.Data, solver.Report]:
    """Solve for the acceleration and the constraint forces."""
    posed = problem(scene, model, data, own, bodies, frames, carried)
    if posed.rows is None and not posed.contacts:
        free = data.replace(qacc=data.qacc_smooth)
        # Nothing to solve, and nothing to hide: what is not finite stays so.
        residual = 0.0 * jax.lax.stop_gradient(data.qacc_smooth).sum()
        return free, solver.Report(residual, jnp.zeros((), jnp.int32))
    acceleration, forces, pull, report = solver.solve(
        posed,
        motion(scene, data.qacc_warmstart),
        model.opt.tolerance,
        iterations=model.opt.iterations,
        search_steps=scene.line_search,
    )
    data = data.tree_replace(
        {
            "qacc": vector(acceleration),
            "qfrc_constraint": vector(pull),
            "_impl.efc_force": mjx_order(forces),
        }
    )
    return data, report


def motion(scene: Scene, flat: jax.Array) -> solver.Motion:
    """Take a vector (V,) apart into the user's joints and the slots."""
    users = scene.users
    return solver.Motion(
        user=flat[:users], slots=flat[users:].reshape(scene.slots, 6).T
    )


def vector(motion: solver.Motion) -> jax.Array:
    """Put a motion together, (V,)."""
    return jnp.concatenate([motion.user, motion.slots.T.reshape(-1)])


def mjx_order(forces: solver.Forces) -> jax.Array:
    """Return the force of each row as MJX orders them."""
    parts = [] if forces.rows is None else [forces.rows]
    for edges in forces.edges:
        # MJX goes contact by contact, and from each edge to the opposite one.
        signs = min(edges.shape[0], 2)
        pairs = edges.reshape(signs, -1, edges.shape[1])
        parts.append(pairs.transpose(2, 1, 0).reshape(-1))
    return jnp.concatenate(parts)


def _contacts(
    scene: Scene,
    model: mjx.Model,
    data: mjx.Data,
    own: engine.Own,
    frames: Frames,
    carried: Riders,
) -> tuple[solver.Contacts, ...]:
    found = []
    for size, contacts in engine.contacts_by_size(data):
        made = _pyramids(scene, model, data, own, frames, carried, size, contacts)
        found.append(made)
    return tuple(found)


def _pyramids(
    scene: Scene,
    model: mjx.Model,
    data: mjx.Data,
    own: engine.Own,
    frames: Frames,
    carried: Riders,
    size: int,
    contacts: mjx.Contact,
) -> solver.Contacts:
    """Return contacts of one dimension."""
    depth = contacts.dist - contacts.includemargin
    active = (depth < 0).astype(depth.dtype)
    friction = contacts.friction[:, : size - 1].T
    # Rows are the normal, then the axes of friction times their coefficients.
    scale = jnp.concatenate([active[None], active * friction])
    axes = contacts.frame.transpose(1, 2, 0)

    sides = []
    for side in scene.host.chunk_sides:
        slot = carried.slot[contacts.geom[:, side]]
        slot = jnp.where(slot == NONE, scene.slots, slot)
        jacobian = _slot_jacobian(frames, slot, contacts.pos.T, axes, size)
        jacobian = (scale if side else -scale)[:, None] * jacobian
        sides.append((slot, jacobian))
    user = None
    if scene.host.user_meets:
        user = _user_jacobian(scene, own, contacts, size) * scale[..., None]

    unset = jnp.zeros_like(depth), jnp.zeros_like(scale)
    found = solver.Contacts(tuple(sides), user, *unset)
    moving = solver.contact_motion(found, motion(scene, data.qvel))
    spring, damping, impedance = engine.impedance(
        model, contacts.solref, contacts.solimp, depth
    )
    weight = model.body_invweight0[carried.body[contacts.geom], 0].sum(axis=1)
    if size > 1:
        # All edges of a pyramid are as stiff as its first pair.
        square = friction[0] * friction[0]
        weight = (weight + square * weight) * 2 * square / model.opt.impratio
    softness = jnp.maximum(weight * (1 - impedance) / impedance, engine.LEAST)
    reference = -damping * moving
    return found.replace(
        stiffness=1 / softness,
        reference=reference.at[0].add(-spring * impedance * depth * active),
    )


def _slot_jacobian(
    frames: Frames, slot: jax.Array, point: jax.Array, axes: jax.Array, size: int
) -> jax.Array:
    """Return the motion of points (3, C) along axes (3, 3, C) by the slot's, (D, 6, C).

    A slot's linear velocity is in the world's axes, its angular velocity in its own.
    """
    turn = frames.rotation[slot].transpose(1, 2, 0)
    arm = point - frames.position[slot].T
    linear = list(axes[:3])
    angular = [_rotate_back(turn, _cross(arm, axis)) for axis in linear]
    if size > 3:
        angular += [_rotate_back(turn, axis) for axis in linear]
        linear += [jnp.zeros_like(axis) for axis in linear]
    rows = [jnp.concatenate(row) for row in zip(linear, angular, strict=True)]
    return jnp.stack(rows[:size])


def _cross(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.stack(
        [
            a[1] * b[2] - a[2] * b[1],
            a[2] * b[0] - a[0] * b[2],
            a[0] * b[1] - a[1] * b[0],
        ]
    )


def _rotate_back(turn: jax.Array, vector: jax.Array) -> jax.Array:
    """Return R' v of (3, 3, C) and (3, C)."""
    return turn[0] * vector[0] + turn[1] * vector[1] + turn[2] * vector[2]


def _user_jacobian(
    scene: Scene, own: engine.Own, contacts: mjx.Contact, size: int
) -> jax.Array:
    """Return the motion of contacts by the user's joints, (D, C, U)."""
    # The bodies of chunks are on no joint, so they add nothing.
    body = jnp.asarray(scene.host.geom_weld, jnp.int32)[contacts.geom]
    first, second = (
        engine.point_jacobian(own, contacts.pos, body[:, side]) for side in (0, 1)
    )
    linear, angular = second[0] - first[0], second[1] - first[1]
    along = jnp.einsum("cij,cuj->icu", contacts.frame, linear)
    if size > 3:
        about = jnp.einsum("cij,cuj->icu", contacts.frame, angular)
        along = jnp.concatenate([along, about])
    return along[:size]
