"""Worlds: impact, splitting, grace, debris, transforms and derivatives of the step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from blastjax import chunks, fracture, world
from blastjax.author import shapes
from blastjax.core import Damage
from blastjax.rigid import bodies, build

EDGE = (0.5, 0.5, 0.5)
WEIGHT = 8 * 125.0 * 9.81


@pytest.fixture(autouse=True)
def mjx_promotion():
    """MJX itself mixes dtypes and ranks."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture(scope="module")
def rubble():
    """A block of 8 cubes on the floor, and its compiled step with damage."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        scene = build(shapes.grid((2, 2, 2), EDGE), slots=8, timestep=0.004)
        start = world.init(scene)
        impact = world.Impact(1e9, 1.0, 0.2, 1.0)

        @jax.jit
        def step(moment, bond, chunk):
            hit = Damage(bond=bond, chunk=chunk)
            return world.step(scene, moment, damage=hit, impact=impact)

        zero = (np.zeros(12, np.float32), np.zeros(8, np.float32))
        return scene, start, lambda m, hit=zero: step(m, *hit)


def finite(tree):
    leaves = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]
    return all(bool(jnp.isfinite(x).all()) for x in leaves)


def roll(step, moment, count):
    for _ in range(count):
        moment, events = step(moment)
    return moment, events


def test_block_rests_on_its_weight_and_stays_rigid(rubble):
    scene, start, step = rubble
    moment, events = roll(step, start, 250)
    force = float(events.impulse.sum()) / 0.004
    assert abs(force / WEIGHT - 1) < 1e-3
    assert float(jnp.abs(moment.data.qvel).max()) < 1e-4
    place, _ = bodies.chunk_poses(scene, moment.bodies, moment.data)
    rest = np.asarray(scene.asset.chunk_centroid)
    far = np.linalg.norm(np.asarray(place)[:, None] - np.asarray(place)[None], axis=-1)
    near = np.linalg.norm(rest[:, None] - rest[None], axis=-1)
    assert np.abs(far - near).max() < 1e-6
    assert int(moment.dropped.contacts) == int(moment.dropped.pairs) == 0


def test_block_broken_at_rest_does_not_burst(rubble):
    _, start, step = rubble
    moment, _ = roll(step, start, 100)
    dust, events = step(moment, (np.full(12, 2.0, np.float32), np.zeros(8, np.float32)))
    assert int(events.split.created.sum()) == 8
    assert sorted(dust.bodies.label.tolist()) == list(range(8))
    assert int(dust.debris.count) == 0
    fastest = 0.0
    for _ in range(60):
        dust, _ = step(dust)
        fastest = max(fastest, float(jnp.abs(dust.data.qvel).max()))
    # The upper cubes fall for one step of grace, then sink in until they are carried.
    assert fastest < 0.1
    assert float(dust.data.qpos[2::7].min()) > 0.2
    assert finite(dust)


def test_step_survives_full_empty_and_dead_slots(rubble):
    scene, start, step = rubble
    asset = scene.asset
    state = fracture.deactivate(asset, fracture.init(asset), jnp.ones(8, bool))
    empty, events = roll(step, world.init(scene, state), 3)
    assert finite(empty) and finite(events)
    assert float(events.impulse.sum()) == 0.0
    dead, events = step(
        start, (np.full(12, 1e30, np.float32), np.full(8, 1e30, np.float32))
    )
    dead, events = roll(step, dead, 3)
    assert finite(dead) and finite(events)
    # A dead leaf stays, as in Blast.
    assert int(chunks.active(asset, dead.state).sum()) == 8


def test_same_world_same_future(rubble):
    _, start, step = rubble
    hit = (np.full(12, 2.0, np.float32), np.zeros(8, np.float32))
    one, two = (roll(step, step(start, hit)[0], 5) for _ in range(2))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        assert bool(jnp.all(a == b))


# Extremes, each a lane of one batch: (density of the upper cube, time constant of the
# floor, time step, height).

EXTREMES = {
    "plain": (1e3, 0.02, 0.004, 0.001),
    "mass ratio 1e6": (1e-3, 0.02, 0.004, 0.001),
    "stiff": (1e3, 0.008, 0.004, 0.001),
    "stiffer than the step": (1e3, 1e-5, 0.004, 0.001),
    "huge step": (1e3, 0.02, 0.1, 0.001),
    "tiny step": (1e3, 0.02, 1e-5, 0.001),
    "in the floor": (1e3, 0.02, 0.004, -0.2),
    "not finite": (1e3, 0.02, 0.004, np.nan),
}


@pytest.fixture(scope="module")
def extremes():
    """Worlds after 400 steps, their last events and the greatest speed, by name."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        scene = build(shapes.grid((1, 1, 2), EDGE), slots=2, chunk_contacts=False)

        def varied(density, constant, dt):
            model = scene.model
            solref = model.geom_solref.at[:, 0].set(constant)
            return scene.replace(
                density=jnp.stack([jnp.float32(1e3), density]),
                model=model.tree_replace({"geom_solref": solref, "opt.timestep": dt}),
            )

        def roll(lane, moment):
            scene = varied(*lane[:3])

            def one(moment, _):
                moment, events = world.step(scene, moment)
                return moment, (events, jnp.abs(moment.data.qvel).max())

            moment, (events, speed) = jax.lax.scan(one, moment, length=400)
            return moment, jax.tree.map(lambda x: x[-1], events), speed.max()

        def start(lane):
            moment = world.init(varied(*lane[:3]))
            z = int(scene.host.slot_qpos[0, 2])
            qpos = moment.data.qpos.at[z].add(lane[3])
            return moment.replace(data=moment.data.replace(qpos=qpos))

        lanes = jnp.asarray(list(EXTREMES.values()), jnp.float32)
        moment = jax.jit(jax.vmap(start))(lanes)
        moment, events, fastest = jax.jit(jax.vmap(roll))(lanes, moment)

        def pick(tree, i):
            return jax.tree.map(lambda x: x[i], tree)

        return scene, {
            name: (pick(moment, i), pick(events, i), float(fastest[i]))
            for i, name in enumerate(EXTREMES)
        }


@pytest.mark.parametrize("name", EXTREMES)
def test_extremes_stay_finite_or_say_so(extremes, name):
    scene, found = extremes
    moment, events, fastest = found[name]
    density, _, dt, _ = EXTREMES[name]
    if name == "not finite":
        # It says so, and the worlds beside it in the batch do not notice.
        assert np.isnan(events.solver.residual)
        return
    assert finite(moment)
    assert float(events.solver.residual) < 1e-3
    assert fastest < {"in the floor": 10.0}.get(name, 2.0)
    if name == "tiny step":
        time = 400 * dt
        np.testing.assert_allclose(moment.data.qvel[2], -9.81 * time, rtol=1e-3)
        return
    weight = 9.81 * 0.125 * (1e3 + density)
    force = float(events.impulse.sum()) / dt
    assert abs(force / weight - 1) < 1e-3
    assert float(jnp.abs(moment.data.qvel).max()) < 1e-3
    place, _ = bodies.chunk_poses(scene, moment.bodies, moment.data)
    assert abs(float(jnp.linalg.norm(place[1] - place[0])) - 0.5) < 1e-6
    assert float(place[0, 2]) > 0.24


# A ball against a wall that the world holds.

BALL = """
<mujoco>
  <worldbody>
    <body name="ball" pos="0.46 0 0.5">
      <joint name="x" type="slide" axis="1 0 0"/>
      <geom name="ball" type="sphere" size="0.2" mass="1" contype="1" conaffinity="1"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def wall():
    """A held wall, a ball of variable mass, and lanes of compiled steps."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        asset = shapes.grid((1, 2, 2), EDGE, anchor=("x-",))
        scene = build(asset, slots=4, model=BALL, chunk_contacts=False)
        impact = world.Impact(
            threshold=0.0, hardness=1.0, min_radius=2.0, max_radius=3.0
        )

        def step(moment, mass, dt):
            model = scene.model
            model = model.replace(
                body_mass=model.body_mass.at[1].set(mass),
                body_invweight0=model.body_invweight0.at[1, 0].set(1 / mass),
            ).tree_replace({"opt.timestep": dt})
            moment, events = world.step(
                scene.replace(model=model), moment, impact=impact
            )
            return moment, events.damage.bond.max()

        def start(speed, health):
            moment = world.init(scene, bond_health=health)
            qvel = moment.data.qvel.at[0].set(-speed)
            return moment.replace(data=moment.data.replace(qvel=qvel))

        return scene, start, jax.jit(jax.vmap(step))


def strike(wall, mass, speed, dt, health, seconds=0.15):
    """Return the worlds after the strike and the health it took at the centre."""
    _, start, step = wall
    lanes = [start(v, h) for v, h in zip(speed, health, strict=True)]
    moment = jax.tree.map(lambda *x: jnp.stack(x), *lanes)
    mass, dt = jnp.asarray(mass), jnp.asarray(dt)
    total = jnp.zeros(len(lanes))
    for i in range(round(seconds / float(dt.min()))):
        now, dealt = step(moment, mass, dt)
        running = i * dt < seconds
        moment = now
        total = total + jnp.where(running, dealt, 0.0)
    return moment, np.asarray(total)


def test_damage_is_the_impulse_for_light_and_heavy_and_any_time_step(wall):
    mass, speed = [1.0, 16.0, 4.0, 4.0], [8.0, 0.5, 2.0, 2.0]
    dt = [0.002, 0.002, 0.002, 0.001]
    moment, dealt = strike(wall, mass, speed, dt, [1e6] * 4)
    change = np.array(mass) * (np.asarray(moment.data.qvel[:, 0]) + np.array(speed))
    # All bonds are within the whole radius: what they lose is the impulse.
    np.testing.assert_allclose(dealt, change, rtol=1e-4)
    # The same momentum, nearly no rebound: the same damage.
    np.testing.assert_allclose(dealt, dealt[0], rtol=0.05)
    assert abs(dealt[3] / dealt[2] - 1) < 0.02


def test_strike_breaks_the_wall_from_the_world(wall):
    scene, _, _ = wall
    health = [1.0, 1e6, 1e6, 1e6]
    moment, _ = strike(wall, [1.0] * 4, [8.0] * 4, [0.002] * 4, health)
    loose, held = (jax.tree.map(lambda x, i=i: x[i], moment) for i in (0, 1))
    assert int((held.bodies.label >= 0).sum()) == 0
    assert int((loose.bodies.label >= 0).sum()) == 4
    assert float(loose.data.qpos[scene.host.slot_qpos[:, 2]].max()) < 0.72
    assert finite(moment)


# A body that is as small as can be: transforms and derivatives.


@pytest.fixture(scope="module")
def tiny():
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        asset = shapes.grid((2, 1, 1), EDGE)
        scene = build(
            asset,
            slots=2,
            position=(0, 0, 0.001),
            chunk_contacts=False,
            collision="sphere",
        )
        impact = world.Impact(
            threshold=10.0, hardness=200.0, min_radius=0.1, max_radius=1.0
        )
        step = jax.jit(lambda w: world.step(scene, w, impact=impact))
        return scene, impact, step


def lanes(scene):
    return [world.init(scene, velocity=(0.0, 0.0, -v)) for v in (0.5, 6.0)]


def close(a, b, tolerance=1e-5):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        scale = max(1.0, float(jnp.abs(y).max())) if y.size else 1.0
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance * scale)


@pytest.mark.slow
def test_scan_of_a_batch_is_a_loop_of_loops(tiny):
    scene, _, step = tiny
    apart = [roll(step, w, 5)[0] for w in lanes(scene)]
    assert {int((m.bodies.label >= 0).sum()) for m in apart} == {1, 2}
    together = jax.tree.map(lambda *x: jnp.stack(x), *lanes(scene))

    def five(start):
        return jax.lax.scan(
            lambda w, _: jax.vmap(step.__wrapped__)(w), start, None, length=5
        )[0]

    close(jax.jit(five)(together), jax.tree.map(lambda *x: jnp.stack(x), *apart), 1e-4)


@pytest.mark.slow
def test_jit_is_eager(tiny):
    scene, impact, step = tiny
    start = roll(step, lanes(scene)[1], 2)[0]
    close(step(start), world.step(scene, start, impact=impact))


@pytest.mark.slow
def test_derivative_of_a_rollout_is_its_difference_quotient():
    with jax.enable_x64(True):
        asset = shapes.grid((2, 1, 1), EDGE, dtype=np.float64)
        scene = build(
            asset,
            slots=2,
            position=(0, 0, 0.002),
            chunk_contacts=False,
            timestep=0.004,
            tolerance=1e-14,
            line_search=15,
        )
        impact = world.Impact(
            threshold=10.0, hardness=100.0, min_radius=0.1, max_radius=1.0
        )
        start = world.init(scene, bond_health=10.0, velocity=(0.5, 0.1, -1.0))

        def loss(push):
            qvel = start.data.qvel.at[:6].add(push)
            moment = start.replace(data=start.data.replace(qvel=qvel))

            moment, seen = world.rollout(
                scene,
                moment,
                8,
                impact=impact,
                record=lambda w, _: w.state.bond_health.sum(),
            )
            place = jnp.sum(moment.data.qpos[:3] * jnp.array([1.0, 2.0, 3.0]))
            return place + seen[-1]

        push = np.array([0.0, 0.0, 0.0, 0.2, -0.1, 0.3])
        both = jax.jit(jax.value_and_grad(loss))
        slope = np.asarray(both(push)[1])
        assert np.isfinite(slope).all()
        assert np.abs(slope[2]) > 1e-3
        h = 1e-6
        for axis in (0, 2, 4):
            step = h * np.eye(6)[axis]
            above, below = float(both(push + step)[0]), float(both(push - step)[0])
            difference = (above - below) / (2 * h)
            assert abs(slope[axis] - difference) < 1e-5 * max(1.0, abs(difference))


# What a scene does not have is not in its program.


def operations(**options):
    choice = {k: options.pop(k) for k in ("impact", "remove_dead") if k in options}
    scene = build(shapes.grid((2, 1, 1), EDGE), slots=2, **options)
    start = jax.eval_shape(lambda: world.init(scene))
    program = jax.make_jaxpr(lambda w: world.step(scene, w, **choice))(start)

    def count(jaxpr):
        total = 0
        for equation in jaxpr.eqns:
            total += 1
            for part in jax.tree.leaves(
                equation.params, is_leaf=lambda x: hasattr(x, "eqns")
            ):
                inner = getattr(part, "jaxpr", part)
                total += count(inner) if hasattr(inner, "eqns") else 0
        return total

    return count(program.jaxpr)


def test_scene_pays_for_what_it_has():
    bare = operations(model="<mujoco/>", chunk_contacts=False)
    floor = operations(chunk_contacts=False)
    touching = operations()
    breaking = operations(chunk_contacts=False, impact=world.Impact())
    sweeping = operations(chunk_contacts=False, impact=world.Impact(), remove_dead=True)
    assert bare < floor < touching
    assert floor < breaking < sweeping


def test_dead_pieces_leave_when_told_to():
    scene = build(shapes.grid((2, 1, 1), EDGE), slots=2, chunk_contacts=False)
    start = world.init(scene)
    asset = scene.asset
    state, _ = fracture.apply(asset, start.state, Damage(bond=jnp.full(1, 2.0)))
    state, parted = fracture.split(asset, state)
    regroup = jax.jit(world._regroup, static_argnums=4)
    moment, _ = regroup(scene, start, state, parted, True, 0)
    assert int(moment.debris.count) == 0
    state, _ = fracture.apply(asset, state, Damage(chunk=jnp.array([0.0, 2.0])))
    state, parted = fracture.split(asset, state)
    moment, gone = regroup(scene, moment, state, parted, True, 0)
    assert gone.tolist() == [False, True]
    assert int(moment.debris.count) == 1
    assert np.isclose(float(moment.debris.mass), 125.0)
    assert moment.bodies.label.tolist() == [0, -1]
