"""Judging structures, letting them collapse, and stress in the step of a world."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from blastjax import chunks, fracture, render, spatial, stress, world
from blastjax.author import shapes
from blastjax.core import Damage
from blastjax.rigid import bodies, build, contact
from blastjax.stress.failure import collapse, excess, judge

EDGE = (0.5, 0.5, 0.5)
G = 9.81
BRICK = 1000.0 * 0.5**3 * G
NEVER = 1e12


@pytest.fixture(autouse=True)
def careful(strict):
    """Implicit promotion is an error, but for MJX."""


@pytest.fixture
def relaxed(careful):
    """MJX itself mixes dtypes and ranks."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def weight(structure, sign=-1.0):
    return stress.gravity(structure.mass, jnp.array([0.0, 0.0, sign * G]))


def standing(asset, structure, limits, state=None):
    """Let it collapse under its weight."""
    state = fracture.init(asset) if state is None else state
    load = weight(structure)
    return jax.jit(collapse)(structure, asset, state, load, limits)


def test_column_uses_what_its_weight_asks():
    asset = shapes.grid((1, 1, 4), EDGE, anchor=("z-",))
    structure = stress.structure(asset)
    limits = stress.Limits(40e3, 50e3)
    verdict = jax.jit(judge)(
        structure, asset, fracture.init(asset), weight(structure), limits
    )
    above = np.asarray(asset.bond_centroid[:, 2])
    pressure = BRICK * (2.0 - above) / 0.5 / 0.25
    np.testing.assert_allclose(verdict.utilisation, pressure / 40e3, rtol=1e-4)
    np.testing.assert_allclose(verdict.safety[0], 40e3 / pressure.max(), rtol=1e-4)
    assert np.isinf(verdict.safety[1:]).all()
    assert not verdict.actor_utilisation[1:].any()


def test_cantilever_breaks_at_the_root_when_it_gets_too_long():
    """The moment at the root grows with the square of the length."""
    limits = stress.Limits(2.5e5, 3e5)
    for length, falls in ((4, False), (8, True)):
        asset = shapes.beam(length, EDGE)
        structure = stress.structure(asset)
        state, how = standing(asset, structure, limits)
        root = np.asarray(asset.bond_nodes[:, 1] == 0)
        # Blast's rule of bending over the distance, here one edge of a brick.
        moment = BRICK * length**2 * 0.5 / 2
        expected = moment / (0.5 * 0.25 / 2)
        assert falls == (expected > 3e5)
        np.testing.assert_array_equal(how.fracture.bond_broken, root & falls)
        assert int(how.rounds) == (2 if falls else 1) and bool(how.settled)
        assert bool((state.actor[1:] == (1 if falls else 0)).all())
        if falls:
            assert not how.verdict.utilisation.any()
        else:
            worst = how.verdict.actor_utilisation[0]
            np.testing.assert_allclose(worst, expected / 2.5e5, rtol=1e-4)


def test_hanging_chain_breaks_at_the_top_link_only():
    asset = shapes.grid((1, 1, 4), EDGE, anchor=("z+",))
    structure = stress.structure(asset)
    limits = stress.Limits(NEVER, NEVER, 3.6 * BRICK / 0.25, 3.8 * BRICK / 0.25)
    _, how = standing(asset, structure, limits)
    top = np.asarray(asset.bond_nodes[:, 1] == 0)
    np.testing.assert_array_equal(how.fracture.bond_broken, top)
    assert how.split.created.tolist() == [False, True, False, False, False]
    assert how.split.parent[1] == 0
    assert int(how.rounds) == 2 and bool(how.settled)


@pytest.fixture(scope="module")
def bridge():
    """A row of 4 bricks on a pillar of 2 at either end."""
    center = [(x, 0, z) for x in (0, 3) for z in (0, 1)] + [(x, 0, 2) for x in range(4)]
    center = (np.array(center) + 0.5) * 0.5
    asset = shapes.boxes(center, np.full((8, 3), 0.25), anchor=("z-",))
    return asset, stress.structure(asset), stress.Limits(1.05e5, 1.1e5)


def without(asset, node):
    blow = jnp.zeros(asset.element_chunk.shape[0]).at[node].set(1.0)
    return jax.jit(fracture.step)(asset, fracture.init(asset), Damage(chunk=blow))[0]


def test_bridge_stands_on_both_pillars_and_falls_off_one(bridge):
    asset, structure, limits = bridge
    states = [without(asset, node) for node in (8, 1, 3)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), fracture.init(asset), *states)
    run = jax.vmap(lambda s: collapse(structure, asset, s, weight(structure), limits))
    together, how = jax.jit(run)(stacked)
    assert bool(how.settled.all())
    broken = how.fracture.bond_broken.sum(axis=1)
    held = (together.actor[:, 1:] == 0).sum(axis=1)
    assert broken[0] == 0 and held[0] == 8
    assert (broken[2:] > 0).all() and (held[2:] < 7).all()
    assert how.rounds[0] == 1 and (how.rounds[2:] > 1).all()

    apart = [standing(asset, structure, limits, s) for s in states]
    apart = jax.tree.map(lambda *x: jnp.stack(x), *apart)
    lanes = jax.tree.map(lambda x: x[1:], (together, how))
    for a, b in zip(jax.tree.leaves(lanes), jax.tree.leaves(apart), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3)


def test_collapse_stops_at_the_cap_and_says_so(bridge):
    asset, structure, limits = bridge
    state = without(asset, 1)
    run = jax.jit(
        lambda s, n: collapse(structure, asset, s, weight(structure), limits, rounds=n)[
            1
        ]
    )
    one, many = run(state, 1), run(state, 100)
    assert int(one.rounds) == 1 and not bool(one.settled)
    assert int(many.rounds) > 1 and bool(many.settled)


def test_yielding_bonds_weaken_and_unbreakable_ones_do_not():
    asset = shapes.grid((1, 1, 1), EDGE, anchor=("z+",))
    structure = stress.structure(asset)
    pull = BRICK / 0.25
    limits = stress.Limits(NEVER, NEVER, 0.5 * pull, 2.5 * pull)
    state, how = standing(asset, structure, limits)
    np.testing.assert_allclose(state.bond_health, 0.75, rtol=1e-5)
    assert bool(how.settled) and int(how.rounds) == 1
    weak = stress.Limits(NEVER, NEVER, 0.1 * pull, 0.2 * pull)
    lasting = fracture.init(asset, bond_health=np.float32(3e38))
    state, how = standing(asset, structure, weak, lasting)
    assert bool(state.bond_intact.all()) and not how.fracture.bond_damage.any()


def test_safety_has_the_derivative_of_the_worst_bond():
    with jax.enable_x64(True):
        asset = shapes.beam(3, EDGE, anchor=("x-", "x+"), dtype=np.float64)
        structure, state = stress.structure(asset), fracture.init(asset)
        limits = stress.Limits(1e5, 2e5)
        load = stress.add(
            weight(structure), stress.at_node(asset, 1, jnp.array([0.0, 0.0, -900.0]))
        )

        def safety(scale):
            area = asset.bond_area * scale
            sized = structure.replace(
                stiffness=structure.stiffness * scale,
                bending=structure.bending * scale**2,
            )
            return judge(sized, asset, state, load, limits, area=area).safety[0]

        both = jax.jit(jax.value_and_grad(safety))
        scale = np.array([1.0, 0.8, 1.1, 0.9])
        slope, h = np.asarray(both(scale)[1]), 1e-6
        assert np.isfinite(slope).all() and np.abs(slope).max() > 0.1
        for step in np.eye(4) * h:
            quotient = (float(both(scale + step)[0]) - float(both(scale - step)[0])) / (
                2 * h
            )
            assert abs(slope @ step / h - quotient) < 1e-5 * np.abs(slope).max()


def test_excess_is_what_the_limit_left_of_the_load():
    asset = shapes.grid((1, 1, 2), EDGE, anchor=("z+",))
    structure = stress.structure(asset)
    bear = stress.Limits(NEVER, NEVER, 1.0, 1.5 * BRICK / 0.25)
    state = fracture.init(asset)
    verdict = jax.jit(judge)(structure, asset, state, weight(structure), bear)
    dealt = Damage(bond=jnp.where(asset.bond_nodes[:, 1] == 0, 2.0, 0.0))
    state, (broken, _) = jax.jit(fracture.step)(asset, state, dealt)
    center = chunks.moments(asset, state, 1000.0).center
    gone = broken.bond_broken
    force, torque = jax.jit(excess)(asset, state, verdict, gone, bear, center)
    # Two bricks hung from a bond that bears one and a half.
    np.testing.assert_allclose(force[1], [0, 0, -0.5 * BRICK], rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose(force[0], -force[1], rtol=1e-6)
    np.testing.assert_allclose(torque, 0, atol=1e-2)


def test_picture_of_utilisation(tmp_path, bridge):
    asset, _, _ = bridge
    used = np.linspace(0, 1.2, asset.bond_area.shape[0])
    state = without(asset, 1)
    path = render.draw_utilisation(asset, state, used, tmp_path / "bridge.png")
    assert path.stat().st_size > 5000
    with pytest.raises(ValueError, match=r"use \.png"):
        render.draw_utilisation(asset, state, used, tmp_path / "bridge.gif")
    with pytest.raises(ValueError, match="utilisation has shape"):
        render.draw_utilisation(asset, state, used[1:], tmp_path / "bridge.png")


# In a world.


def test_cantilever_falls_in_a_world_when_its_weight_is_too_much(relaxed):
    asset = shapes.beam(3, EDGE)
    # The placement turns the asset on its side: it hangs, and pulls at its root.
    scene = build(
        asset,
        slots=2,
        position=(0, 0, 3.0),
        quaternion=(np.sqrt(0.5), 0, np.sqrt(0.5), 0),
        chunk_contacts=False,
        model="<mujoco/>",
    )
    structure = stress.structure(scene.asset)
    start = world.init(scene)

    @jax.jit
    def step(moment, limits):
        return world.step(scene, moment, stress=world.Stress(structure, limits))

    pull = 3 * BRICK / 0.25
    for share, falls in ((1.05, False), (0.95, True)):
        limits = stress.Limits(NEVER, NEVER, share * pull, share * pull)
        moment, events = step(start, limits)
        root = events.verdict.utilisation[np.asarray(asset.bond_nodes)[:, 1] == 0]
        np.testing.assert_allclose(root, 1 / share, rtol=1e-4)
        assert bool(events.verdict.solution.converged)
        assert int(events.fracture.bond_broken.sum()) == falls
        moment, events = step(moment, limits)
        assert (float(moment.data.qvel[2]) < 0) == falls
        # In free fall nothing is borne.
        assert bool((events.verdict.utilisation > 0).any()) != falls


def test_contacts_load_the_chunks_as_they_push_the_body(relaxed):
    scene = build(
        shapes.grid((2, 1, 1), EDGE),
        slots=1,
        chunk_contacts=False,
        timestep=0.004,
        # Sunk in a little: on the floor, rounding decides whether they touch.
        position=(0, 0, -1e-4),
        quaternion=(0.9238795, 0, 0, 0.3826834),
        friction=0.6,
    )
    start = world.init(scene, velocity=(1.5, 0.4, -0.2), spin=(0.1, 0.2, 3.0))

    @jax.jit
    def both(start):
        moment, _ = world.step(scene, start)
        frames = bodies.frames(scene, start.bodies, start.data)
        carried = contact.riders(scene, start.bodies)
        load = world.contact_load(scene, moment.data, frames, carried)
        arm = stress.loads.node_place(scene.asset) - frames.center[0]
        turn = (load.torque + jnp.cross(arm, load.force)).sum(axis=0)
        push = spatial.rotate(load.force.sum(axis=0), frames.quaternion[0])
        return jnp.concatenate([push, turn]), moment.data.qfrc_constraint

    # MuJoCo keeps forces in world axes, torques in the body's own.
    load, body = both(start)
    assert np.abs(body[:2]).min() > 1e3
    np.testing.assert_allclose(load, body, rtol=1e-4, atol=1e-2)


def operations(scene, **options):
    """Count the operations of a step's program."""
    start = jax.eval_shape(lambda: world.init(scene))
    program = jax.make_jaxpr(lambda w: world.step(scene, w, **options))(start)

    def count(jaxpr):
        total = len(jaxpr.eqns)
        for equation in jaxpr.eqns:
            for part in jax.tree.leaves(
                equation.params, is_leaf=lambda x: hasattr(x, "eqns")
            ):
                inner = getattr(part, "jaxpr", part)
                total += count(inner) if hasattr(inner, "eqns") else 0
        return total

    return count(program.jaxpr)


def test_step_pays_for_the_stress_it_has(relaxed, monkeypatch):
    held = build(shapes.beam(2, EDGE), slots=1, chunk_contacts=False)
    options = stress.structure(held.asset), stress.Limits(1e5, 2e5)
    hit = Damage(bond=jnp.zeros(2))
    alone, weighed, full = (
        operations(held, damage=hit, stress=world.Stress(*options, **flags))
        for flags in (
            {"gravity": False, "contacts": False},
            {"contacts": False},
            {},
        )
    )
    monkeypatch.setattr(world, "bear", None)
    assert operations(held, damage=hit) < alone < weighed < full
