"""The only tie to MJX's private functions.

MJX's own `forward` cannot be told which body a geom belongs to at run time, nor replace
the inertia of a body by a full tensor; its stages can. They are private and may move
between releases, so they are all called here, and `tests/test_rigid.py` watches them.
Of the bodies, MJX moves those of the user alone (`Own`): the library's own are free or
carried, and `bodies` places them in closed form, which is faster to run and to
compile.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import (
    collision_driver,
    constraint,
    derivative,
    forward,
    sensor,
    smooth,
    support,
)
from mujoco.mjx._src import math as mjx_math

from blastjax import spatial
from blastjax.rigid import solver

Points = tuple[jax.Array, jax.Array, jax.Array]
"""Distance (n,) m, position (n, 3) m and frame (n, 3, 3) of contacts."""

LEAST = mujoco.mjMINVAL
"""Least softness of a constraint."""
_SOLVER = (
    "_impl.efc_type",
    "_impl.efc_J",
    "_impl.efc_D",
    "_impl.efc_aref",
    "_impl.efc_pos",
    "_impl.efc_margin",
    "_impl.efc_frictionloss",
    "_impl.M",
    "_impl.qLD",
    "_impl.crb",
)
"""What MJX's solver works with, and ours does not."""
_MOTION = (
    "subtree_com",
    "cdof",
    "cdof_dot",
    "cvel",
    "_impl.cinert",
    "_impl.cacc",
    "_impl.cfrc_int",
    "_impl.cfrc_ext",
)
"""How bodies move, and what of their forces sensors derive."""
JOINT_FORCES = "qfrc_passive", "qfrc_gravcomp", "qfrc_actuator"
"""What acts on the user's joints and not on slots."""
ACTUATION = (
    "act_dot",
    "actuator_force",
    "actuator_length",
    "_impl.actuator_velocity",
    "_impl.ten_velocity",
)
"""What is of actuators and tendons, all the user's."""
_GIVEN = (
    "time",
    "qpos",
    "qvel",
    "act",
    "history",
    "ctrl",
    "qfrc_applied",
    "xfrc_applied",
    "eq_active",
    "mocap_pos",
    "mocap_quat",
)
"""What MJX's stages start from."""
_UPPER = ((0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2))


def numeric(model: mjx.Model, name: str) -> int:
    """Return a whole number from the model's `<custom><numeric>`, -1 if absent."""
    return collision_driver._numeric(model, name)


class Own(NamedTuple):
    """The user's own bodies, as if nothing had been added to their model.

    All that the library adds comes after what is the user's, so that arrays of these
    are the beginnings of those of the whole.
    """

    model: mjx.Model
    data: mjx.Data


def own(model: mujoco.MjModel) -> Own:
    """Return the user's own model, on the host."""
    device = mjx.put_model(model, impl="jax")
    return jax.tree.map(np.asarray, Own(device, mjx.make_data(device, impl="jax")))


def part(template: Own, model: mjx.Model, data: mjx.Data) -> Own:
    """Return the user's part of a model and its data.

    Arrays are the whole's of now; what MJX has as constants is the template's.
    """

    def begin(own: np.ndarray | jax.Array, whole: jax.Array) -> jax.Array:
        return jnp.asarray(whole)[tuple(map(slice, own.shape))]

    leaves, shape = jax.tree.flatten(template.model)
    whole = zip(leaves, jax.tree.leaves(model), strict=True)
    blank = jax.tree.map(jnp.asarray, template.data)
    known = {name: begin(getattr(blank, name), getattr(data, name)) for name in _GIVEN}
    return Own(
        jax.tree.unflatten(shape, [begin(*pair) for pair in whole]),
        blank.replace(**known),
    )


def extended(
    data: mjx.Data, user: mjx.Data, rest: dict[str, jax.Array | None]
) -> mjx.Data:
    """Put the user's arrays into the whole, each followed by the rest, if it has any.

    Names with a prefix `_impl.` are of MJX's inner data.
    """

    def joined(name: str, after: jax.Array | None) -> jax.Array:
        inner = name.removeprefix("_impl.")
        first = getattr(user if inner == name else user._impl, inner)
        return first if after is None else jnp.concatenate([first, after])

    return data.tree_replace({name: joined(name, x) for name, x in rest.items()})


def kinematics(own: Own) -> Own:
    """Place the user's bodies, and find their axes of motion and their inertia."""
    model, data = own
    if not model.nv:
        # MJX has no way through a tree without joints.
        return Own(model, _without_joints(model, data))
    data = smooth.com_pos(model, smooth.kinematics(model, data))
    if model.ntendon:
        found = smooth.tendon(model, data)
        # With x64 it makes some counts wider than it was given them.
        kept = jax.tree.map(lambda x, old: x.astype(old.dtype), found._impl, data._impl)
        data = found.replace(_impl=kept)
    data = smooth.crb(model, data)
    data = smooth.tendon_armature(model, data) if model.ntendon else data
    return Own(model, data)


def _without_joints(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Place bodies that are fixed to the world or to a mocap body."""
    place = jnp.zeros_like(model.body_pos)
    turn = jnp.zeros_like(model.body_quat).at[:, 0].set(1.0)
    parent = np.asarray(model.body_parentid)
    body = np.flatnonzero(parent == 0)[1:]
    while body.size:
        up = parent[body]
        local = model.body_pos[body], model.body_quat[body]
        place = place.at[body].set(place[up] + spatial.rotate(local[0], turn[up]))
        turn = turn.at[body].set(spatial.multiply(turn[up], local[1]))
        moved = body[model.body_mocapid[body] >= 0]
        mocap = model.body_mocapid[moved]
        place = place.at[moved].set(data.mocap_pos[mocap])
        turn = turn.at[moved].set(spatial.unit_quaternion(data.mocap_quat[mocap]))
        body = np.flatnonzero(np.isin(parent, body) & (parent > 0))

    def on(
        body: np.ndarray, position: jax.Array, quaternion: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        center = place[body] + spatial.rotate(position, turn[body])
        return center, spatial.matrix(spatial.multiply(turn[body], quaternion))

    center, axes = on(np.arange(len(parent)), model.body_ipos, model.body_iquat)
    geom = on(model.geom_bodyid, model.geom_pos, model.geom_quat)
    site = on(model.site_bodyid, model.site_pos, model.site_quat)
    return data.replace(
        xpos=place,
        xquat=turn,
        xmat=spatial.matrix(turn),
        xipos=center,
        ximat=axes,
        geom_xpos=geom[0],
        geom_xmat=geom[1],
        site_xpos=site[0],
        site_xmat=site[1],
        subtree_com=center,
    )


def cameras(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Place the cameras, where there are any."""
    return smooth.camlight(model, data) if model.ncam else data


def geom_pairs(model: mujoco.MjModel) -> np.ndarray:
    """Return the pairs of geoms that may collide, (pairs, 2), as contacts have them."""
    pairs = [(a, b) for a, b, _ in collision_driver.geom_pairs(model)]
    return np.array(pairs, dtype=int).reshape(-1, 2)


@dataclasses.dataclass(frozen=True)
class Group:
    """The pairs of geoms of one kind, on the host."""

    types: tuple[int, int]
    """Types of the two geoms."""
    condim: int
    """Dimension of their contacts."""
    pair: np.ndarray
    """(pairs, 2) geoms."""
    count: int
    """Contacts that MJX finds for a pair."""
    find: Callable[[mjx.Model, mjx.Data, jax.Array], Points]
    """MJX's collider: of pairs (n, 2) it finds count contacts each."""


def contact_groups(model: mjx.Model, data: mjx.Data) -> list[tuple[Group, mjx.Contact]]:
    """Return the kinds of geom pairs in the model, with their contacts' parameters.

    The contacts have one row a pair; distance, position and frame are for a collider to
    find.
    """
    pairs = collision_driver._geom_groups(model)
    found = []
    for key, contacts in collision_driver._contact_groups(model, data).items():
        collider = collision_driver._COLLISION_FUNC[key.types]
        group = Group(
            types=(int(key.types[0]), int(key.types[1])),
            condim=int(key.condim),
            pair=np.array(pairs[key])[:, :2],
            count=collider.ncon,
            find=_with_key(collider, key),
        )
        found.append((group, contacts))
    return found


def make_data(model: mjx.Model, contacts: dict[int, int]) -> mjx.Data:
    """Return data at the model's start, with so many contacts of each dimension.

    MJX counts those that its own colliders find; ours may find more or fewer.
    """
    data = mjx.make_data(model, impl="jax")
    impl = data._impl
    dim = np.array([c for c in sorted(contacts) for _ in range(contacts[c])], int)
    if np.array_equal(dim, impl.contact.dim):
        return data
    kind = constraint.make_efc_type(model, dim)
    rows, count = kind.size, dim.size

    def sized(x: jax.Array, length: int) -> jax.Array:
        return jnp.zeros((length, *x.shape[1:]), x.dtype)

    touch = jax.tree.map(lambda x: sized(x, count), impl.contact)
    touch = touch.replace(
        dim=dim,
        efc_address=constraint.make_efc_address(model, dim, kind),
    )
    names = [f.name for f in dataclasses.fields(impl) if f.name.startswith("efc_")]
    arrays = [n for n in names if isinstance(getattr(impl, n), jax.Array)]
    changed = {f"_impl.{n}": sized(getattr(impl, n), rows) for n in arrays}
    changed |= {"_impl.contact": touch, "_impl.efc_type": kind}
    return data.tree_replace(
        {**changed, "_impl.nefc": int(rows), "_impl.ncon": int(count)}
    )


def _with_key(
    collider: Callable[..., Points], key: collision_driver.FunctionKey
) -> Callable[[mjx.Model, mjx.Data, jax.Array], Points]:
    return lambda model, data, pair: collider(model, data, key, pair)


def contact_frame(normal: jax.Array) -> jax.Array:
    """Return the contact frame (3, 3) of a normal (3,), rows normal, tangents."""
    return mjx_math.make_frame(normal)


def contacts_by_size(data: mjx.Data) -> list[tuple[int, mjx.Contact]]:
    """Return (dimension, contacts) for each dimension of contacts that there is."""
    contacts = data._impl.contact
    found = []
    for size in sorted(set(contacts.dim.tolist())):
        rows = np.flatnonzero(contacts.dim == size)
        part = slice(rows[0], rows[-1] + 1)
        found.append((size, jax.tree.map(lambda x, part=part: x[part], contacts)))
    return found


def impedance(
    model: mjx.Model, reference: jax.Array, impedance: jax.Array, depth: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return spring, damping and impedance of contacts: (n,) of solref and solimp."""
    return jax.vmap(functools.partial(constraint._kbi, model))(
        reference, impedance, depth
    )


def point_jacobian(
    own: Own, point: jax.Array, body: jax.Array | np.ndarray
) -> tuple[jax.Array, jax.Array]:
    """Return how points (n, 3) on the user's bodies (n,) move and turn by their joints.

    Each is (n, U, 3).
    """
    return jax.vmap(functools.partial(support.jac, *own))(point, body)


def user_rows(own: Own) -> solver.Rows | None:
    """Return the constraints that are no contacts, on the user's joints.

    Equality rows pull and push, dry friction is bounded, limits only push; a force is
    counted as minus the derivative of the cost, so pushing is the lower side.
    """
    model, data = own
    impl = data._impl
    equality, dry = impl.ne, impl.nf
    if equality + dry + impl.nl == 0:
        return None
    alone = data.tree_replace({"_impl.contact.dim": np.zeros(0, int)})
    made = constraint.make_constraint(model, alone)._impl
    friction = made.efc_frictionloss
    row = np.arange(friction.shape[0])
    pulls, rubs = row < equality, (row >= equality) & (row < equality + dry)
    endless = jnp.full_like(friction, jnp.inf)
    return solver.Rows(
        jacobian=made.efc_J,
        stiffness=made.efc_D,
        reference=made.efc_aref,
        lower=jnp.where(rubs, -friction, -endless),
        upper=jnp.where(pulls, endless, jnp.where(rubs, friction, 0.0)),
    )


def accelerate(own: Own) -> Own:
    """Compute the acceleration of the user's joints, constraints aside."""
    model, data = own
    data = smooth.transmission(model, data)
    data = forward.fwd_velocity(model, data)
    data = forward.fwd_actuation(model, data)
    force = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator
    force = force + data.qfrc_applied + _pushes(Own(model, data))
    free = divide(mass_matrix(own), force)
    return Own(model, data.replace(qfrc_smooth=force, qacc_smooth=free))


def _pushes(own: Own) -> jax.Array:
    """Return what the user applies to their bodies, by their joints, (U,)."""
    body = np.flatnonzero(own.model.body_weldid)
    linear, angular = point_jacobian(own, own.data.xipos[body], body)
    push = own.data.xfrc_applied[body]
    moved = jnp.concatenate([linear, angular], axis=2)
    return jnp.einsum("nui,ni->u", moved, push, precision="highest")


def composite(mass: jax.Array, inertia: jax.Array) -> jax.Array:
    """Return mass (n,) and inertia (n, 3, 3) about the centre as MJX has it, (n, 10).

    The whole tensor goes in, without principal axes: an eigenvector of a cube's inertia
    has no derivative.
    """
    offset = jnp.zeros((len(mass), 3), mass.dtype)
    return jnp.concatenate(
        [inertia[:, _UPPER[0], _UPPER[1]], offset, mass[:, None]], axis=1
    )


def lean(data: mjx.Data, watched: bool) -> mjx.Data:
    """Drop what no step reads or writes: most of a world's bytes.

    What says how bodies move is kept if it is watched.
    """
    names = _SOLVER if watched else (*_SOLVER, *_MOTION)

    def nothing(name: str) -> jax.Array:
        inner = name.removeprefix("_impl.")
        whole = getattr(data if inner == name else data._impl, inner)
        return jnp.zeros((0, *whole.shape[1:]), whole.dtype)

    return data.tree_replace({name: nothing(name) for name in names})


def position_sensors(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Read the sensors of position, where there are any."""
    return sensor.sensor_pos(model, data) if model.nsensor else data


def velocity_sensors(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Read the sensors of velocity, where there are any."""
    return sensor.sensor_vel(model, data) if model.nsensor else data


def gravity(model: mjx.Model) -> jax.Array:
    """Return the acceleration of free fall, (3,) m/s^2."""
    off = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
    return jnp.zeros_like(model.opt.gravity) if off else model.opt.gravity


def mass_matrix(own: Own) -> jax.Array:
    """Return the joint-space inertia matrix of the user's joints, (U, U)."""
    return support.full_m(*own)


def normal_force(data: mjx.Data) -> jax.Array:
    """Return the normal force of each contact from its rows' forces, (contacts,) N."""
    impl = data._impl
    start = impl.ne + impl.nf + impl.nl
    parts = []
    for condim in (1, 3, 4, 6):
        count = int(np.sum(impl.contact.dim == condim))
        # The edges of a friction pyramid add up to the normal force.
        rows = 1 if condim == 1 else 2 * (condim - 1)
        block = impl.efc_force[start : start + count * rows]
        parts.append(block.reshape(count, rows).sum(axis=1))
        start += count * rows
    return jnp.concatenate(parts)


def stuck_force(data: mjx.Data) -> jax.Array:
    """Return what of each contact's normal force sticks, and could, (contacts, 2) N.

    All of it sticks where friction does nothing, and none where it does all it can: the
    contact slides. Contacts without friction never stick.
    """
    impl = data._impl
    start = impl.ne + impl.nf + impl.nl
    parts = []
    for size in (1, 3, 4, 6):
        count = int(np.sum(impl.contact.dim == size))
        if size == 1:
            parts.append(jnp.zeros((count, 2), impl.efc_force.dtype))
            start += count
            continue
        rows = 2 * (size - 1)
        block = impl.efc_force[start : start + count * rows]
        start += count * rows
        # Of two opposite edges of the pyramid the weaker one is what friction spares.
        edges = block.reshape(count, size - 1, 2)
        spared = 2.0 * edges.min(axis=2).sum(axis=1)
        parts.append(jnp.stack([spared, edges.sum(axis=(1, 2))], axis=1))
    return jnp.concatenate(parts)


def contact_force(data: mjx.Data) -> jax.Array:
    """Return the force of each contact on its second geom, (contacts, 3) N, world axes.

    Friction of rolling and twisting is left out.
    """
    impl = data._impl
    touch, start = impl.contact, impl.ne + impl.nf + impl.nl
    parts = []
    for size in (1, 3, 4, 6):
        count = int(np.sum(touch.dim == size))
        rows = 1 if size == 1 else 2 * (size - 1)
        block = impl.efc_force[start : start + count * rows].reshape(count, rows)
        start += count * rows
        local = jnp.zeros((count, 3), block.dtype).at[:, 0].set(block.sum(axis=1))
        if size > 1:
            # Opposite edges of the pyramid: their difference is the friction.
            edges = block[:, :4].reshape(count, 2, 2)
            local = local.at[:, 1:].set(edges[..., 0] - edges[..., 1])
        parts.append(local)
    local = jnp.concatenate(parts)
    local = local.at[:, 1:].multiply(touch.friction[:, :2])
    return jnp.einsum("ni,nij->nj", local, touch.frame)


def integrate(model: mjx.Model, data: mjx.Data, own: Own) -> mjx.Data:
    """Advance one time step by the model's integrator.

    What damps implicitly are the user's joints: slots have no damping.
    """
    data = sensor.sensor_acc(model, data) if model.nsensor else data
    acceleration, users = data.qacc, own.model.nv
    slope = _damping(own) if users else None
    if slope is not None:
        damped = mass_matrix(own) - model.opt.timestep * slope
        force = (data.qfrc_smooth + data.qfrc_constraint)[:users]
        acceleration = acceleration.at[:users].set(divide(damped, force))
    return forward._advance(model, data, data.act_dot, acceleration)


def _damping(own: Own) -> jax.Array | None:
    """Return how the force on the user's joints changes by velocity, or None."""
    model, data = own
    if model.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER:
        return derivative.deriv_smooth_vel(model, data)
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP:
        return None
    return -jnp.diag(model.dof_damping)


def divide(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Solve a symmetric positive definite system."""
    factor = jax.scipy.linalg.cho_factor(matrix, lower=True)
    return jax.scipy.linalg.cho_solve(factor, right)
