"""How what lies comes to rest: against the textbook, and where it must do nothing."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from blastjax import world
from blastjax.author import shapes
from blastjax.core import Damage
from blastjax.rigid import Resting, build
from tests.operations import trace

EDGE = (0.5, 0.5, 0.5)
FRICTION, GRAVITY, TIMESTEP = 0.5, 9.81, 0.004
FLOOR = f"""
<mujoco><option timestep="{TIMESTEP}" impratio="10"/><worldbody>
<geom type="plane" size="0 0 .05" friction="{FRICTION} 0.005 0.0001"/>
</worldbody></mujoco>
"""


@pytest.fixture(autouse=True)
def mjx_promotion():
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def scene(resting, cubes=2, sunk=1e-4, **options):
    return build(
        shapes.grid((cubes, 1, 1), EDGE),
        friction=FRICTION,
        model=FLOOR,
        position=(0, 0, -sunk),
        resting=resting,
        **options,
    )


def tilted(scene, angle):
    """Turn gravity, which is the same as to tilt the floor by degrees."""
    down = GRAVITY * jnp.array(
        [np.sin(np.radians(angle)), 0, -np.cos(np.radians(angle))]
    )
    model = scene.model.tree_replace({"opt.gravity": down.astype(jnp.float32)})
    return scene.replace(model=model)


@functools.cache
def program(steps):
    def run(scene, now, damage):
        def one(now, _):
            now, _ = world.step(scene, now, damage=Damage(bond=damage))
            data = now.data
            slots = scene.host.slot_dof, scene.host.slot_qpos
            return now, (data.qvel[slots[0]], data.qpos[slots[1]])

        return jax.lax.scan(one, now, length=steps)

    return jax.jit(run)


def run(scene, now, steps=25, damage=0.0):
    """Return the world after so many steps, and velocities and poses of all of them."""
    parts = []
    for i in range(steps // 25):
        hurt = jnp.full(len(scene.asset.bond_nodes), damage if i == 0 else 0.0)
        now, found = program(25)(scene, now, hurt)
        parts.append(jax.tree.map(np.asarray, found))
    return now, *(np.concatenate(x) for x in zip(*parts, strict=True))


@pytest.fixture(scope="module")
def block():
    """Two cubes as one, with and without resistance."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        return scene(Resting()), scene(None)


def test_friction_that_sticks_no_longer_creeps(block):
    speed = []
    for case in block:
        case = tilted(case, 20)
        _, velocity, _ = run(case, world.init(case), 75)
        speed.append(np.abs(velocity[-25:]).max())
    assert speed[0] < 1e-6 and speed[1] > 5e-5


def test_what_slides_is_left_to_friction(block):
    for angle in (28, 40):
        way = []
        for case in block:
            case = tilted(case, angle)
            _, _, pose = run(case, world.init(case), 100)
            way.append(pose[-1, 0, 0] - pose[0, 0, 0])
        free = np.sin(np.radians(angle)) - FRICTION * np.cos(np.radians(angle))
        assert way[0] == pytest.approx(way[1], rel=0.05)
        assert way[0] == pytest.approx(GRAVITY * free * 0.4**2 / 2, rel=0.1)


def test_a_sleeper_wakes_when_pushed_and_when_something_parts(block):
    case, _ = block
    flat = tilted(case, 20)
    asleep, *_ = run(flat, world.init(flat), 75)
    assert asleep.bodies.calm[0] > case.resting.delay
    for angle, moves in ((24, False), (40, True)):
        later, _, pose = run(tilted(case, angle), asleep, 75)
        assert (np.ptp(pose[:, 0, 0]) > 0.02) == moves
        assert (later.bodies.calm[0] > case.resting.delay) != moves
    parted, *_ = run(flat, asleep, 25, damage=2.0)
    np.testing.assert_allclose(parted.bodies.calm[:2], 24 * TIMESTEP, rtol=0.1)


@pytest.mark.slow
def test_flight_is_untouched_and_keeps_momentum(block):
    ends = []
    for case in block:
        now = world.init(case)
        high = now.data.qpos.at[case.host.slot_qpos[:, 2]].add(9.0)
        now = now.replace(data=now.data.replace(qpos=high))
        now, _, pose = run(case, now, damage=2.0)
        # The left cube flies into the right one.
        left = case.host.slot_dof[np.argmin(pose[-1, :, 0]), 0]
        flying = now.data.replace(qvel=now.data.qvel.at[left].add(1.0))
        _, velocity, pose = run(case, now.replace(data=flying))
        ends.append((velocity, pose))
    np.testing.assert_array_equal(*(pose for _, pose in ends))
    total = ends[0][0][:, :2, 0].sum(axis=1)
    assert ends[0][0][-1, :2, 0].min() > 0.3
    np.testing.assert_allclose(total, 1.0, atol=1e-5)


@pytest.mark.slow
def test_a_rolling_ball_slows_down_by_the_resistance():
    # As deep as it lies: what is pushed out of the floor is not resisted.
    case = scene(Resting(resistance=0.1), cubes=1, sunk=6.9e-6, collision="sphere")
    # Of a cube's inertia, on a ball that touches its faces: it rolls without slip.
    size = np.sqrt(1 + (0.5**2 / 6) / 0.25**2)

    def travel(speed):
        now = world.init(case, velocity=jnp.array([1.0, 0, 0]) * speed)
        spin = jnp.array([0, 1.0, 0]) * speed / 0.25
        rolling = now.data.qvel.at[case.host.slot_dof[0, 3:]].set(spin)
        now = now.replace(data=now.data.replace(qvel=rolling))
        after, _ = world.rollout(case, now, 100)
        return after.data.qpos[0] - now.data.qpos[0], after.data.qvel[0]

    (way, speed), (slope, _) = jax.jit(lambda x: jax.jvp(travel, (x,), (1.0,)))(1.0)
    duration, loss = 100 * TIMESTEP, 0.1 * GRAVITY / size
    assert speed == pytest.approx(1 - loss * duration, rel=0.02)
    assert way == pytest.approx(duration - loss * duration**2 / 2, rel=0.02)
    assert slope == pytest.approx(duration, rel=0.02)


def test_without_the_option_nothing_of_it_is_in_the_program(block):
    programs = []
    for case in block:
        start = jax.eval_shape(lambda case=case: world.init(case))
        programs.append(trace(functools.partial(world.step, case), start))
    on, off = programs
    assert {"resting.resist", "resting.load"} <= on.sources - off.sources
    assert off.operations < on.operations
    assert not any("resting" in name or "stuck" in name for name in off.sources)


@pytest.mark.parametrize("field", ["resistance", "hold", "speed", "delay"])
def test_resting_refuses_what_is_no_resistance(field):
    with pytest.raises(ValueError, match=field):
        scene(Resting(**{field: -0.1}))
