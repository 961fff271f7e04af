"""The only tie to MJX's private functions.

MJX's own `forward` cannot be told which body a geom belongs to at run time, nor replace
the inertia of a body by a full tensor; its stages can. They are private and may move
between releases, so they are all called here, and `tests/test_rigid.py` watches them.
Every function maps (model, data) to data, as MJX's do.
"""

import dataclasses
import functools
from collections.abc import Callable

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

from blastjax.rigid import solver

Points = tuple[jax.Array, jax.Array, jax.Array]
"""Distance (n,) m, position (n, 3) m and frame (n, 3, 3) of contacts."""

LEAST = mujoco.mjMINVAL
"""Least softness of a constraint."""
_ROWS = ("D", "aref", "pos", "margin", "frictionloss")
_UPPER = ((0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2))


def numeric(model: mjx.Model, name: str) -> int:
    """Return a whole number from the model's `<custom><numeric>`, -1 if absent."""
    return collision_driver._numeric(model, name)


def kinematics(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Place every body, and find the axes of motion about the centres of mass."""
    data = smooth.kinematics(model, data)
    data = smooth.com_pos(model, data)
    if model.ncam:
        data = smooth.camlight(model, data)
    if not model.ntendon:
        return data
    found = smooth.tendon(model, data)
    # With x64 it makes some counts wider than it was given them.
    kept = jax.tree.map(lambda x, old: x.astype(old.dtype), found._impl, data._impl)
    return found.replace(_impl=kept)


def set_inertia(
    data: mjx.Data, body: np.ndarray, mass: jax.Array, inertia: jax.Array
) -> mjx.Data:
    """Give bodies (K,) their mass (K,) and inertia (K, 3, 3), in the axes of each body.

    The whole tensor goes in, without principal axes: an eigenvector of a cube's inertia
    has no derivative.
    """
    turn = data.xmat[body]
    spatial_inertia = turn @ inertia @ jnp.swapaxes(turn, 1, 2)
    entries = jnp.concatenate(
        [
            spatial_inertia[:, _UPPER[0], _UPPER[1]],
            jnp.zeros_like(mass)[:, None].repeat(3, 1),
            mass[:, None],
        ],
        axis=1,
    )
    cinert = data._impl.cinert.at[body].set(entries)
    return data.tree_replace({"_impl.cinert": cinert})


def set_inertia_matrix(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute the joint-space inertia matrix."""
    data = smooth.crb(model, data)
    return smooth.tendon_armature(model, data) if model.ntendon else data


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
    model: mjx.Model,
    data: mjx.Data,
    point: jax.Array,
    body: jax.Array | np.ndarray,
    count: int,
) -> tuple[jax.Array, jax.Array]:
    """Return how points (n, 3) on bodies (n,) move and turn, each (n, count, 3).

    By the first `count` degrees of freedom.
    """
    linear, angular = jax.vmap(functools.partial(support.jac, model, data))(point, body)
    return linear[:, :count], angular[:, :count]


def user_rows(model: mjx.Model, data: mjx.Data, count: int) -> solver.Rows | None:
    """Return the constraints that are no contacts, on the first `count` joints.

    Equality rows pull and push, dry friction is bounded, limits only push; a force is
    counted as minus the derivative of the cost, so pushing is the lower side.
    """
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
        jacobian=made.efc_J[:, :count],
        stiffness=made.efc_D,
        reference=made.efc_aref,
        lower=jnp.where(rubs, -friction, -endless),
        upper=jnp.where(pulls, endless, jnp.where(rubs, friction, 0.0)),
    )


def set_smooth_force(model: mjx.Model, data: mjx.Data, frozen: jax.Array) -> mjx.Data:
    """Compute the forces without constraints; frozen dofs (V,) feel no bias.

    What the user applies to bodies is not among them: see `pushes`.
    """
    data = smooth.transmission(model, data)
    data = forward.fwd_velocity(model, data)
    data = sensor.sensor_vel(model, data) if model.nsensor else data
    data = forward.fwd_actuation(model, data)
    bias = jnp.where(frozen, 0.0, data.qfrc_bias)
    force = data.qfrc_passive - bias + data.qfrc_actuator + data.qfrc_applied
    return data.replace(qfrc_bias=bias, qfrc_smooth=force)


def pushes(model: mjx.Model, data: mjx.Data, body: np.ndarray, count: int) -> jax.Array:
    """Return what the user applies to bodies (n,), by the first `count` dofs."""
    linear, angular = point_jacobian(model, data, data.xipos[body], body, count)
    push = data.xfrc_applied[body]
    moved = jnp.concatenate([linear, angular], axis=2)
    return jnp.einsum("nui,ni->u", moved, push, precision="highest")


def without_matrices(data: mjx.Data) -> mjx.Data:
    """Drop the matrices that every step computes anew: most of a world's bytes."""
    impl = data._impl
    return data.tree_replace(
        {
            "_impl.efc_J": jnp.zeros((0, data.qvel.shape[0]), impl.efc_J.dtype),
            **{f"_impl.efc_{name}": jnp.zeros(0, data.qvel.dtype) for name in _ROWS},
            "_impl.M": jnp.zeros((0,) * impl.M.ndim, impl.M.dtype),
            "_impl.qLD": jnp.zeros((0,) * impl.qLD.ndim, impl.qLD.dtype),
        }
    )


def position_sensors(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Read the sensors of position, where there are any."""
    return sensor.sensor_pos(model, data) if model.nsensor else data


def mass_matrix(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Return the joint-space inertia matrix, (V, V)."""
    return support.full_m(model, data)


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


def integrate(model: mjx.Model, data: mjx.Data, users: int) -> mjx.Data:
    """Advance one time step by the model's integrator.

    What damps implicitly are the first `users` joints: slots have no damping.
    """
    data = sensor.sensor_acc(model, data) if model.nsensor else data
    acceleration = data.qacc
    slope = _damping(model, data, users) if users else None
    if slope is not None:
        inertia = mass_matrix(model, data)[:users, :users]
        force = (data.qfrc_smooth + data.qfrc_constraint)[:users]
        damped = inertia - model.opt.timestep * slope
        acceleration = acceleration.at[:users].set(divide(damped, force))
    return forward._advance(model, data, data.act_dot, acceleration)


def _damping(model: mjx.Model, data: mjx.Data, users: int) -> jax.Array | None:
    """Return how the force on the user's joints changes by velocity, or None."""
    if model.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER:
        slope = derivative.deriv_smooth_vel(model, data)
        return None if slope is None else slope[:users, :users]
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP:
        return None
    return -jnp.diag(model.dof_damping[:users])


def divide(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Solve a symmetric positive definite system."""
    factor = jax.scipy.linalg.cho_factor(matrix, lower=True)
    return jax.scipy.linalg.cho_solve(factor, right)
