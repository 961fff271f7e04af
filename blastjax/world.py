"""Worlds: physics and fracture together, one step at a time.

A World is everything that changes: MJX's data, the fracture state, and who rides in
which slot. `step` moves it by one time step; it can be jitted, vmapped over worlds,
scanned and differentiated. What a call leaves out (no impact, no damage, no sensors, no
pairs of chunks) is not in the program.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from mujoco import mjx

from blastjax import chunks, fracture, graph, pytree, spatial
from blastjax.core import NONE, Damage, FractureEvents, SplitEvents, State
from blastjax.damage import falloff
from blastjax.rigid import bodies, contact, engine, resting, rows, solver
from blastjax.rigid.scene import Scene
from blastjax.stress.failure import Verdict, judge, stress_damage
from blastjax.stress.limits import Limits
from blastjax.stress.loads import Load, add, gravity, node_place
from blastjax.stress.structures import Structure

GRACE_STEPS = 1
"""Steps for which the pieces of one split do not collide, unless told otherwise."""
_MOTION = "qpos", "qvel", "qacc_warmstart"
"""What a split changes in MJX's data."""


@pytree.dataclass
class Debris(pytree.Node):
    """What left the simulation, in all."""

    count: jax.Array
    """() int32 actors."""
    volume: jax.Array
    """() m^3."""
    mass: jax.Array
    """() kg."""


@pytree.dataclass
class World(pytree.Node):
    """Everything in a scene that changes."""

    data: mjx.Data
    """MJX's data: positions, velocities, controls; poses as the step found them. Axes
    and velocities of bodies only where the user's joints, sensors or cameras ask for
    them. No constraint Jacobian and inertia matrix: steps need none of the whole."""
    state: State
    """Healths and actors."""
    bodies: bodies.Bodies
    """The slots of the moving actors, and what they carry."""
    debris: Debris
    """What was removed so far."""
    dropped: contact.Dropped
    """What the caps left out so far: raise `max_pairs`, `max_contacts` if not 0."""


@pytree.dataclass
class Impact(pytree.Node):
    """How contacts hurt.

    A contact with normal force F takes max(F - threshold, 0) dt / hardness of health
    from the actors that it touches: damage follows the impulse, whatever the time step
    and whether the striker was light and fast or heavy and slow, and a load below the
    threshold may rest forever.
    """

    threshold: jax.Array | float = 0.0
    """() normal force that does no harm, N."""
    hardness: jax.Array | float = 1.0
    """() impulse that takes one unit of health, N s."""
    min_radius: jax.Array | float = 0.0
    """() distance from the contact up to which bonds take all of it, m."""
    max_radius: jax.Array | float = 1.0
    """() distance from which they take none of it, m."""


@pytree.dataclass
class Stress(pytree.Node):
    """How loads hurt.

    In each step the bonds balance gravity and the step's contacts as if at rest, or as
    rigid pieces where the world does not hold them, and what they bear takes health by
    `stress.damage`: all of it beyond a fatal limit. Between an elastic and a fatal
    limit it is a part of the health every step, the faster the shorter the time step.
    """

    structure: Structure
    """Of the scene's asset, at the scene's density."""
    limits: Limits
    """Of one material, or of M."""
    material: jax.Array | None = None
    """(B,) int32 material of each bond; None if there is one only."""
    area: jax.Array | None = None
    """(B,) that bears the load, m^2; None for the bonded areas."""
    gravity: bool = pytree.static(default=True)
    """Whether what the world holds bears its own weight. Other pieces fall freely."""
    contacts: bool = pytree.static(default=True)
    """Whether contacts load the chunks that they touch."""
    iterations: int = pytree.static(default=200)
    """Most steps of the two-level method."""


@pytree.dataclass
class Events(pytree.Node):
    """What happened in a step."""

    impulse: jax.Array
    """(A,) normal impulse on each element's chunk, N s."""
    solver: solver.Report
    """How the contact solver did."""
    dropped: contact.Dropped
    """What the caps left out in this step."""
    damage: Damage | None
    """All damage that was dealt, or None if the call left it out."""
    fracture: FractureEvents | None
    """What broke, or None likewise."""
    split: SplitEvents | None
    """What came apart, or None likewise."""
    removed: jax.Array | None
    """(A,) bool by label, actors that became debris, or None likewise."""
    verdict: Verdict | None = None
    """What the bonds bore and whether its solution converged; None without stress."""


def init(
    scene: Scene,
    state: State | None = None,
    *,
    bond_health: Any = 1.0,
    chunk_health: Any = 1.0,
    velocity: Any = (0.0, 0.0, 0.0),
    spin: Any = (0.0, 0.0, 0.0),
    remove_dead: bool = False,
) -> World:
    """Return a world at its start.

    Args:
      scene: the scene.
      state: the asset's state; by default unbroken, with the healths given.
      bond_health: one for all bonds or (B,); unused with a state.
      chunk_health: one for all chunks or (A,); unused with a state.
      velocity: (3,) of the rest frame's origin, m/s; the world's part stays still.
      spin: (3,) angular velocity in world axes, rad/s.
      remove_dead: see `step`.

    Differentiable in healths, velocity and spin.
    """
    if state is None:
        state = fracture.init(scene.asset, bond_health, chunk_health)
    data = engine.lean(contact.make_data(scene), scene.watched)
    return _begin(scene, data, state, velocity, spin, remove_dead)


@functools.partial(jax.jit, static_argnums=5)
def _begin(
    scene: Scene,
    data: mjx.Data,
    state: State,
    velocity: Any,
    spin: Any,
    remove_dead: bool,
) -> World:
    asset, dtype = scene.asset, scene.position.dtype
    zero = jnp.zeros((), jnp.int32)
    nothing = jnp.zeros((), dtype)
    start = bodies.nobody(scene)
    everything = jnp.full_like(start.slot, scene.slots)
    here = chunks.active(asset, state)
    labels = jnp.arange(here.shape[0], dtype=jnp.int32)
    # As if the world had held all of it and let go now.
    world = World(
        data=data,
        state=state,
        bodies=start.replace(slot=everything),
        debris=Debris(count=zero, volume=nothing, mass=nothing),
        dropped=contact.Dropped(pairs=zero, contacts=zero),
    )
    released = SplitEvents(
        parent=jnp.where(here, labels, -1), created=here, released=jnp.zeros_like(here)
    )
    world, _ = _regroup(scene, world, state, released, remove_dead, 0)
    return _push(scene, world, velocity, spin)


def step(
    scene: Scene,
    world: World,
    *,
    ctrl: jax.Array | None = None,
    damage: Damage | None = None,
    impact: Impact | None = None,
    stress: Stress | None = None,
    remove_dead: bool = False,
    grace_steps: int | jax.Array = GRACE_STEPS,
) -> tuple[World, Events]:
    """Advance by one time step, then break what was hit.

    Args:
      scene: the scene.
      world: the world.
      ctrl: (nu,) controls of the user's actuators; by default those in the data.
      damage: health to take away in this step, besides that by impact.
      impact: how contacts hurt; None if they do not.
      stress: how loads hurt; None if they do not.
      remove_dead: whether single chunks without health and without children leave the
        simulation as debris. In Blast they stay.
      grace_steps: steps for which the pieces of one split do not collide. What they
        overlap when it ends is forgiven: see `rigid.contact`.

    Returns:
      The world and what happened. Without damage, impact and stress nothing can break,
      and nothing of fracture is in the program.

    Differentiable, forward and reverse, through contact (by the implicit function
    theorem), friction and damage. Misses the jumps: contacts that begin or end within
    the step, bonds that break, actors that part, what the caps leave out.
    """
    riding, data = world.bodies, world.data
    data = data if ctrl is None else data.replace(ctrl=ctrl)
    model = bodies.weigh(scene, riding)
    frames = bodies.frames(scene, riding, data)

    data, own = bodies.kinematics(scene, model, riding, frames, data)
    data, found = contact.collide(scene, riding, model, data)
    data = engine.position_sensors(model, data)
    data, own = bodies.accelerate(scene, model, riding, frames, data, own)
    data, report = rows.resolve(scene, model, data, own, riding, frames, found.riders)
    if scene.resting is None:
        data = engine.integrate(model, data, own)
    else:
        solved = data.qacc
        data, riding = resting.resist(scene, model, riding, frames, found.riders, data)
        # The solver's own answer is the better guess for its next one.
        data = engine.integrate(model, data, own)
        data = data.replace(qacc_warmstart=solved)
    force = contact.normal_force(data)

    world = world.replace(
        data=data,
        bodies=bodies.settle(scene, riding.replace(overlap=found.overlap)),
        dropped=jax.tree.map(jnp.add, world.dropped, found.dropped),
    )
    events = Events(
        impulse=contact.element_force(scene, data, force) * model.opt.timestep,
        solver=report,
        dropped=found.dropped,
        damage=None,
        fracture=None,
        split=None,
        removed=None,
    )
    if damage is None and impact is None and stress is None:
        return world, events

    if impact is not None:
        struck = impact_damage(scene, world, frames, found.riders, force, impact)
        damage = struck if damage is None else _add(damage, struck)
    if stress is not None:
        verdict = bear(scene, world, frames, found.riders, stress)
        strained = _strain(world.state, verdict, stress)
        damage = strained if damage is None else _add(damage, strained)
        events = events.replace(verdict=verdict)
    assert damage is not None
    state, (broken, parted) = fracture.step(scene.asset, world.state, damage)
    world, removed = _regroup(scene, world, state, parted, remove_dead, grace_steps)
    events = events.replace(
        damage=damage, fracture=broken, split=parted, removed=removed
    )
    return world, events


def rollout(
    scene: Scene,
    world: World,
    length: int,
    *,
    ctrl: jax.Array | None = None,
    record: Callable[[World, Events], Any] | None = None,
    **options: Any,
) -> tuple[World, Any]:
    """Advance by many steps, in little memory when differentiated in reverse.

    Args:
      scene: the scene.
      world: the world.
      length: number of steps.
      ctrl: (length, nu) controls of each step; by default those in the data.
      record: what to keep of each step, of the world after it and its events.
      **options: of `step`, the same for all steps.

    Returns:
      The world at its end, and the records, stacked (length, ...); None without.
      Derivatives are those of `step`, forward and reverse. Reverse mode keeps one
      world a step, and computes each step a second time to get at its inside.

    Raises:
      ValueError: `length` is below 1.
    """
    if length < 1:
        raise ValueError(f"length is {length}; give 1 or more")

    def one(world: World, ctrl: jax.Array | None) -> tuple[World, Any]:
        world, events = step(scene, world, ctrl=ctrl, **options)
        return world, None if record is None else record(world, events)

    # Within a scan nothing can be shared with the first time anyway.
    again = jax.checkpoint(one, prevent_cse=False)
    return jax.lax.scan(again, world, ctrl, length=length)


def impact_damage(
    scene: Scene,
    world: World,
    frames: bodies.Frames,
    carried: contact.Riders,
    force: jax.Array,
    impact: Impact,
) -> Damage:
    """Return what the step's contacts do to bonds and chunks.

    Args:
      scene: the scene.
      world: with the step's contacts in its data, and actors as they were then.
      frames: of the slots when the contacts were found.
      carried: what carried each geom then.
      force: (contacts,) normal forces, N.
      impact: how contacts hurt.

    Returns:
      Damage: for each bond, and each chunk that is an actor by itself, the sum over all
      contacts on its actor, each weighted by the falloff of the distance in the rest
      frame. Every contact counts, there is no cap.

    Differentiable in forces, places and how contacts hurt.
    """
    asset, state, touch = scene.asset, world.state, world.data._impl.contact
    excess = jnp.maximum(force - impact.threshold, 0.0)
    amount = excess * scene.model.opt.timestep / impact.hardness
    bond_owner = state.actor[asset.bond_nodes[:, 0]]
    element = jnp.asarray(scene.host.geom_element, jnp.int32)
    nothing = Damage(
        bond=jnp.zeros_like(state.bond_health), chunk=jnp.zeros_like(state.chunk_health)
    )

    def one(point: jax.Array, amount: jax.Array, label: jax.Array) -> Damage:
        dealt = falloff(
            asset, state, point, amount, impact.min_radius, impact.max_radius
        )
        own = bond_owner == label, state.actor == label
        return jax.tree.map(
            lambda mine, health: jnp.where(mine, health, 0), Damage(*own), dealt
        )

    def all_of_them() -> Damage:
        total = nothing
        for side in scene.host.chunk_sides:
            geom = touch.geom[:, side]
            slot = carried.slot[geom]
            hit = jnp.where(slot == NONE, 0.0, amount)
            point = bodies.to_rest(frames, jnp.maximum(slot, 0), touch.pos)
            owner = state.actor[jnp.maximum(element[geom], 0)]
            # Behind a barrier, or XLA turns the point anew for each bond.
            contacts = jax.lax.optimization_barrier((point, hit, owner))
            dealt = jax.vmap(one)(*contacts)
            total = jax.tree.map(lambda sum_, each: sum_ + each.sum(0), total, dealt)
        return total

    # Most steps see no contact that hurts.
    hurts = graph.anywhere(jnp.any(amount > 0))
    return jax.lax.cond(hurts, all_of_them, lambda: nothing)


def bear(
    scene: Scene,
    world: World,
    frames: bodies.Frames,
    carried: contact.Riders,
    stress: Stress,
) -> Verdict:
    """Return how the bonds bear the step's loads.

    Args:
      scene: the scene.
      world: with the step's contacts in its data, and actors as they were then.
      frames: of the slots when the contacts were found.
      carried: what carried each geom then.
      stress: how loads hurt.

    Differentiable in loads, by the implicit function theorem; the grouping into
    actors is constant.
    """
    asset, none = scene.asset, jnp.zeros_like(node_place(scene.asset))
    load = Load(force=none, torque=none)
    if stress.gravity and asset.has_world:
        load = add(load, held_weight(scene, world.state, stress.structure.mass))
    if stress.contacts and scene.host.chunk_sides:
        load = add(load, contact_load(scene, world.data, frames, carried))
    return judge(
        stress.structure,
        asset,
        world.state,
        load,
        stress.limits,
        material=stress.material,
        area=stress.area,
        iterations=stress.iterations,
    )


def held_weight(scene: Scene, state: State, mass: jax.Array) -> Load:
    """Return the weight (N,) of what the world holds, in the rest frame.

    Differentiable in mass and gravity; what is held is constant.
    """
    held = state.actor[: mass.shape[0]] == 0
    back = spatial.conjugate(scene.quaternion)
    down = spatial.rotate(scene.model.opt.gravity.astype(mass.dtype), back)
    return gravity(jnp.where(held, mass, 0), down)


def contact_load(
    scene: Scene, data: mjx.Data, frames: bodies.Frames, carried: contact.Riders
) -> Load:
    """Return the contact forces on the nodes, each in its actor's rest frame.

    Chunks below the support level have no bonds, and no load.

    Differentiable in forces and places of contacts.
    """
    place = node_place(scene.asset)
    num_nodes, touch = place.shape[0], data._impl.contact
    element = jnp.asarray(scene.host.geom_element, jnp.int32)
    total = Load(force=jnp.zeros_like(place), torque=jnp.zeros_like(place))
    push = engine.contact_force(data)
    for side in scene.host.chunk_sides:
        geom = touch.geom[:, side]
        slot = jnp.maximum(carried.slot[geom], 0)
        node = jnp.where(carried.slot[geom] == NONE, NONE, element[geom])
        back = spatial.conjugate(frames.quaternion[slot])
        force = spatial.rotate(push if side else -push, back)
        point = bodies.to_rest(frames, slot, touch.pos)
        arm = point - place[jnp.clip(node, 0, num_nodes - 1)]
        part = Load(
            force=graph.group_sum(force, node, num_nodes),
            torque=graph.group_sum(jnp.cross(arm, force), node, num_nodes),
        )
        total = add(total, part)
    return total


def _strain(state: State, verdict: Verdict, stress: Stress) -> Damage:
    return stress_damage(state, verdict, stress.limits, material=stress.material)


def _regroup(
    scene: Scene,
    world: World,
    state: State,
    parted: SplitEvents,
    remove_dead: bool,
    grace_steps: int | jax.Array,
) -> tuple[World, jax.Array]:
    """Remove debris and give the actors of a new state their slots."""
    before, debris = state, world.debris
    gone = jnp.zeros(state.actor.shape[0], bool)
    # With a slot for every chunk no actor is ever too many.
    crowded = scene.slots < scene.host.element.size
    if remove_dead:
        gone = _dead(scene, state)
        state = fracture.deactivate(scene.asset, state, gone)
    if crowded:
        light = bodies.outcasts(scene, state)
        state = fracture.deactivate(scene.asset, state, light)
        gone = gone | light
    if remove_dead or crowded:
        debris = _swept(scene, debris, before, gone)

    def anew(riding: bodies.Bodies, *motion: jax.Array) -> Any:
        data = world.data.replace(**dict(zip(_MOTION, motion, strict=True)))
        riding, data = bodies.reassign(scene, riding, data, state, parted, grace_steps)
        return riding, *(getattr(data, name) for name in _MOTION)

    # Most steps see nothing come apart.
    parts = graph.anywhere(jnp.any(parted.created) | jnp.any(gone))
    kept = world.bodies, *(getattr(world.data, name) for name in _MOTION)
    riding, *motion = jax.lax.cond(parts, anew, lambda *same: same, *kept)
    data = world.data.replace(**dict(zip(_MOTION, motion, strict=True)))
    world = world.replace(state=state, bodies=riding, data=data, debris=debris)
    return world, gone


def _dead(scene: Scene, state: State) -> jax.Array:
    """Return single chunks with no health and no children, (A,) bool by label."""
    asset = scene.asset
    leaf = chunks.alone(asset, state) & ~chunks.has_children(asset)
    held = chunks.held(asset, state)[jnp.maximum(state.actor, 0)]
    dead = leaf & ~held & (state.chunk_health <= 0)
    return graph.group_any(dead, state.actor, state.actor.shape[0])


def _swept(scene: Scene, debris: Debris, state: State, gone: jax.Array) -> Debris:
    """Add the actors that go, as they were in the state before, to the debris."""
    asset = scene.asset
    out = (state.actor != NONE) & gone[jnp.maximum(state.actor, 0)]
    volume = chunks.element_values(asset, asset.chunk_volume)
    mass = chunks.element_values(asset, asset.chunk_volume * scene.density)
    return Debris(
        count=debris.count + jnp.sum(gone, dtype=jnp.int32),
        volume=debris.volume + jnp.sum(jnp.where(out, volume, 0.0)),
        mass=debris.mass + jnp.sum(jnp.where(out, mass, 0.0)),
    )


def _push(scene: Scene, world: World, velocity: Any, spin: Any) -> World:
    """Give every actor the velocity field of one rigid motion."""
    dtype, host = scene.position.dtype, scene.host
    linear, angular = jnp.asarray(velocity, dtype), jnp.asarray(spin, dtype)
    used = (world.bodies.label != NONE)[:, None]
    pose = world.data.qpos[host.slot_qpos]
    arm = pose[:, :3] - scene.position[None]
    about = jnp.broadcast_to(angular, arm.shape)
    moving = linear[None] + jnp.cross(about, arm)
    turning = spatial.rotate(about, spatial.conjugate(pose[:, 3:]))
    motion = jnp.where(used, jnp.concatenate([moving, turning], axis=1), 0.0)
    qvel = world.data.qvel.at[host.slot_dof].set(motion)
    return world.replace(data=world.data.replace(qvel=qvel))


def _add(first: Damage, second: Damage) -> Damage:
    def total(a: jax.Array | None, b: jax.Array | None) -> jax.Array | None:
        return b if a is None else a if b is None else a + b

    return Damage(
        bond=total(first.bond, second.bond), chunk=total(first.chunk, second.chunk)
    )
