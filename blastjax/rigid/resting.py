"""How what lies comes to rest: the resistance of contacts that stick, and sleep.

Soft contacts never quite hold anything. Friction that sticks creeps, in proportion to
its load; nothing resists rocking and rolling; a contact that slides is lifted off the
ground, falls back and stops, over and over. Shards that lean on each other therefore
move by millimetres a second, for seconds.

Here a slot loses speed at the rate c L / m of its mass m and the load L that it bears
on contacts that stick: dry friction against all six motions at once, speed being that
of the kinetic energy. What would come to a stop within the step if all its contacts
stuck does stop. A contact that parts is left out: what slides is lifted, what was
pressed too deep is pushed out, and to hold either sets off the hopping again.

A slot that has hardly moved for a while is asleep, and then brakes by more, on all
contacts, whether they stick or slide: it is what slides so slowly that would otherwise
hop on for seconds, or creep: a shard wedged among others slips at a few centimetres a
second, for soft friction is viscous. What gains speed is not taken to creep, so what
friction cannot hold does slide. Only what pops out of another is left out. Only the
ground resists, and what stands on it, directly or through others: among pieces in
flight momentum is kept. Sizes: K slots, C contacts.
"""

import math

import jax
import jax.numpy as jnp
from mujoco import mjx

from blastjax import spatial
from blastjax.core import NONE
from blastjax.rigid import engine
from blastjax.rigid.bodies import Bodies, Frames
from blastjax.rigid.contact import Riders
from blastjax.rigid.scene import Scene

_SLACK = 0.01
"""Contacts that part faster than by this part of a step of gravity do not resist."""
_POP = 0.1
"""The same part for what is asleep: where it only slides, contacts part more slowly."""


def resist(
    scene: Scene,
    model: mjx.Model,
    bodies: Bodies,
    frames: Frames,
    carried: Riders,
    data: mjx.Data,
) -> tuple[mjx.Data, Bodies]:
    """Slow down what lies, once the contact forces are known.

    Differentiable in velocities and forces. What stops has the derivative 0; who
    sleeps, and who stands on the ground, is constant.
    """
    resting, way, calm = scene.resting, bodies.way, bodies.calm
    if data._impl.ncon == 0 or resting is None or way is None or calm is None:
        return data, bodies
    dof, timestep = scene.host.slot_dof, model.opt.timestep
    velocity = data.qvel[dof] + timestep * data.qacc[dof]
    momentum = _momentum(bodies, velocity)
    square = bodies.mass * jnp.sum(momentum * velocity, axis=1)
    moving = square > 0
    size = jnp.sqrt(jnp.where(moving, square, 1.0))

    # What is pushed out of another is not held in it.
    apart = _parting(carried, frames, data, velocity)
    fall = spatial.norm(model.opt.gravity) * timestep
    parts, pops = apart > _SLACK * fall, apart > _POP * fall
    sticking, pressing = engine.stuck_force(data).T
    stuck = jnp.where(parts, 0.0, jnp.stack([sticking, pressing]))
    forces = jnp.concatenate([stuck, jnp.where(pops, 0.0, pressing)[None]]).T
    sticks, presses, bears = load(scene, carried, data, forces).T * timestep
    asleep = calm > resting.delay
    drag = jnp.where(asleep, resting.hold * bears, resting.resistance * sticks)
    stops = ~asleep & (resting.resistance * presses >= size)
    lost = jnp.where(stops, 1.0, jnp.minimum(drag / size, 1.0))
    lost = jnp.where(moving, lost, 0.0)[:, None]
    # Integrators that damp implicitly start from the force, others from its effect.
    pull = data.qfrc_constraint.at[dof].add(-lost * momentum / timestep)
    slowed = data.qacc.at[dof].add(-lost * velocity / timestep)

    # From rest, what slides comes half as far as by its last speed, what creeps as far.
    left = jax.lax.stop_gradient((1.0 - lost) * velocity)
    way, calm = way + timestep * left, calm + timestep
    last = jnp.minimum(calm, resting.delay) * _pace(bodies, left)
    far = _pace(bodies, way)
    far = jnp.maximum(far, jnp.minimum(2.0 * far, last))
    away = far > resting.speed * resting.delay
    bodies = bodies.replace(
        way=jnp.where(away[:, None], 0.0, way),
        calm=jnp.where(away, 0.0, calm),
    )
    return data.replace(qacc=slowed, qfrc_constraint=pull), bodies


def load(scene: Scene, carried: Riders, data: mjx.Data, force: jax.Array) -> jax.Array:
    """Sum forces (C, n) on the ground and on what stands on it, over slots, (K, n).

    A slot stands if forces of the last kind lead from it to the ground.
    """
    slots, pair = scene.slots, data._impl.contact.geom
    # What the world holds is ground, and so are the user's geoms that cannot move.
    still = jnp.asarray(scene.host.geom_weld == 0)
    place = jnp.where(carried.slot != NONE, carried.slot, slots + ~still)[pair]
    between = jnp.zeros((slots + 2, slots + 2, force.shape[1]), force.dtype)
    between = between.at[place[:, 0], place[:, 1]].add(force)
    between = (between + between.swapaxes(0, 1))[:slots]
    ground, others = between[:, slots], between[:, :slots]
    if not scene.host.chunk_kinds:
        return ground
    reach = jnp.eye(slots, dtype=bool) | (others[..., -1] > 0)
    for _ in range(math.ceil(math.log2(slots))):
        reach = jnp.any(reach[:, :, None] & reach[None], axis=1)
    stands = jnp.any(reach & (ground[:, -1] > 0)[None], axis=1)
    return ground + jnp.sum(jnp.where(stands[:, None], others, 0.0), axis=1)


def _parting(
    carried: Riders, frames: Frames, data: mjx.Data, velocity: jax.Array
) -> jax.Array:
    """Return how fast the sides of contacts part, (C,) m/s, the user's joints aside."""
    touch = data._impl.contact
    total = jnp.zeros_like(touch.dist)
    velocity = jnp.concatenate([velocity, jnp.zeros_like(velocity[:1])])
    for side, sign in ((0, -1.0), (1, 1.0)):
        slot = carried.slot[touch.geom[:, side]]
        slot = jnp.where(slot == NONE, len(velocity) - 1, slot)
        spin = spatial.rotate(velocity[slot, 3:], frames.quaternion[slot])
        arm = touch.pos - frames.position[slot]
        moving = velocity[slot, :3] + jnp.cross(spin, arm)
        total = total + sign * spatial.dot(moving, touch.frame[:, 0])
    return jax.lax.stop_gradient(total)


def _pace(bodies: Bodies, motion: jax.Array) -> jax.Array:
    """Return the speed, (K,) m/s, that is the kinetic energy's of a motion (K, 6)."""
    square = jnp.sum(_momentum(bodies, motion) * motion, axis=1) / bodies.mass
    return jnp.sqrt(jax.lax.stop_gradient(square))


def _momentum(bodies: Bodies, velocity: jax.Array) -> jax.Array:
    """Return M v of each slot, (K, 6)."""
    turned = jnp.einsum("kij,kj->ki", bodies.inertia, velocity[:, 3:])
    return jnp.concatenate([bodies.mass[:, None] * velocity[:, :3], turned], axis=1)
