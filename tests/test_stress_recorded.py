"""The parity stress solver against recordings of the C++ library; its limits."""

import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from blastjax import author, fracture
from blastjax.stress import limits, parity
from tests import conformance_stress, golden, recorded, replay_stress

pytestmark = pytest.mark.usefixtures("strict")
DATA = pathlib.Path(__file__).parent / "data" / "stress.npz"


def test_recording_replays(capsys):
    assert golden.main(["stress", str(DATA)]) == 0
    assert ", 0 mismatches" in capsys.readouterr().out


def changed(value):
    """Return another value of the same type."""
    if value.dtype.kind == "f":
        return np.float32(value * np.float32(1.01) if value else 0.01)
    return value ^ value.dtype.type(1)


def content(case):
    return repr(
        [(k, np.asarray(v).tobytes()) for k, v in case.items() if k != "frames"]
        + [[np.asarray(v).tobytes() for v in f.values()] for f in case["frames"]]
    )


@pytest.mark.parametrize(
    "column",
    [
        "bond_init_health",
        "case_limits_effective",
        "cmd_health",
        "excess_force",
        "excess_torque",
        "frame_bond_in_solver",
        "frame_converged",
        "frame_length_scale",
        "frame_limit_margin",
        "frame_mass_scale",
        "frame_node_island",
        "frame_node_vel",
        "frame_overstressed",
        "frame_sbond_lin",
        "frame_sbond_nodes",
        "frame_solver_node",
        "frame_stress_shear",
        "load_params",
        "node_pos",
    ],
)
def test_changed_number_is_noticed(column, tmp_path):
    with np.load(DATA) as file:
        data = {name: file[name] for name in file.files}
    flat = data[column].reshape(-1)
    # In a late case, so that not only the first is read.
    at = int(0.7 * len(flat))
    flat[at] = changed(flat[at])
    np.savez(tmp_path / "changed.npz", **data)
    found = []
    try:
        pairs = zip(
            recorded.stress_cases(DATA),
            recorded.stress_cases(tmp_path / "changed.npz"),
            strict=True,
        )
        for case, other in pairs:
            if content(case) != content(other):
                found += replay_stress.verify_stress(other)
                found += [] if found else conformance_stress.check_stress(other)[0]
    except ValueError as error:
        found.append(str(error))
    assert found


STEEL = limits.Limits(2.0, 4.0, -1.0, -1.0, 1.0, 3.0)


def stress(normal, shear):
    return limits.BondStress(normal=jnp.array([normal]), shear=jnp.array([shear]))


def test_negative_limits_are_inherited_one_by_one():
    full = limits.effective(limits.Limits(2.0, 4.0, 3.0, -1.0, -1.0, 9.0))
    assert (full.tension_elastic, full.tension_fatal) == (3.0, 4.0)
    assert (full.shear_elastic, full.shear_fatal) == (2.0, 9.0)


@pytest.mark.parametrize(
    ("normal", "shear", "share", "used"),
    [
        (1.0, 0.5, 0.0, 0.5),
        (-3.0, 0.0, 0.5, 1.5),
        (3.0, 2.0, 1.0, 2.0),
        (-5.0, 0.0, 1.5, 2.5),
        (0.0, 0.0, 0.0, 0.0),
    ],
)
def test_damage_is_the_part_of_the_way_between_limits(normal, shear, share, used):
    loads, health = stress(normal, shear), jnp.array([0.5])
    np.testing.assert_allclose(limits.damage(STEEL, loads, health), [share * 0.5])
    np.testing.assert_allclose(limits.utilisation(STEEL, loads), [used])
    over = limits.overstressed(STEEL, loads)
    assert bool(over[0]) == (used > 1)
    assert limits.damage(STEEL, loads, jnp.zeros(1)) == 0


def test_limits_are_looked_up_by_material():
    two = jax.tree.map(lambda a: jnp.array([a, 10 * a]), STEEL)
    loads = limits.BondStress(normal=jnp.full(2, -3.0), shear=jnp.zeros(2))
    which = jnp.array([1, 0], jnp.int32)
    got = limits.damage(two, loads, jnp.ones(2), which)
    np.testing.assert_allclose(got, [0.0, 0.5])
    np.testing.assert_allclose(limits.utilisation(two, loads, which), [0.15, 1.5])


def test_bond_stress_is_accurate_and_has_finite_derivatives():
    normal = jnp.array([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    force = jnp.array([[1e-3, 6e3, 8e3], [0.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    torque = jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [3.0, 4.0, 0.0]])
    area, apart = jnp.array([2.0, 1.0, 0.0]), jnp.array([1.0, 0.5, 1.0])

    def both(force, torque):
        got = limits.bond_stress(force, torque, normal, area, apart)
        return got.normal, got.shear

    pressure, shear = both(force, torque)
    np.testing.assert_allclose(pressure, [5e3, 0, 0], rtol=1e-6)
    # The shear is eight digits below the pressure: what float32 rounds off the force
    # must not drown in its square.
    assert abs(float(shear[0]) - 5e-4) < 1e-3
    for slope in jax.tree.leaves(jax.jacobian(both, argnums=(0, 1))(force, torque)):
        assert jnp.isfinite(slope).all()


def beam():
    """Return a beam of 6 chunks held at one end, and its solver."""
    count = 6
    place = np.stack([np.arange(count) + 0.5, np.zeros(count), np.zeros(count)], axis=1)
    described = author.Chunks(
        np.full(count, -1), place, np.ones(count), np.ones(count, bool)
    )
    ends = np.stack([np.arange(-1, count - 1), np.arange(count)], axis=1)
    normal = np.tile([1.0, 0.0, 0.0], (count, 1))
    face = place - [0.5, 0.0, 0.0]
    bonds = author.Bonds(ends, normal, np.ones(count), face)
    asset = author.build(described, bonds).asset
    state = fracture.init(asset)
    return asset, state, parity.bodies(asset, 1.0)


def test_update_finds_the_forces_of_a_hanging_chain():
    asset, state, bodies = beam()
    network = parity.network(asset, state, bodies)
    pull = jnp.zeros((7, 3)).at[:, 0].set(2.0)

    def update(pull):
        start = parity.no_impulses(asset)
        return parity.update(
            asset, state, bodies, network, start, pull, STEEL, max_iterations=200
        )

    result = jax.jit(update)(pull)
    assert bool(result.converged)
    # The bond to the world carries all six chunks, the last one a single one.
    carried = np.sort(np.abs(result.force[:, 0]))
    np.testing.assert_allclose(carried, [2, 4, 6, 8, 10, 12], rtol=1e-3)
    np.testing.assert_array_equal(
        result.damage.bond > 0, np.abs(result.force[:, 0]) > 2.001
    )

    several = jnp.stack([pull, -pull, 3 * pull])
    together = jax.jit(jax.vmap(update))(several)
    for i in range(3):
        alone = jax.jit(update)(several[i])
        np.testing.assert_allclose(together.force[i], alone.force, rtol=1e-5, atol=1e-5)


def test_network_follows_breaking():
    asset, state, bodies = beam()
    network = parity.network(asset, state, bodies)
    start = parity.no_impulses(asset)
    amount = jnp.zeros(6).at[2].set(2.0)
    state, _ = fracture.step(asset, state, fracture.Damage(bond=amount))
    pieces = np.zeros(7, bool)
    pieces[np.unique(state.actor)] = True
    network = parity.notify(asset, state, network, pieces)
    network, start = parity.settle(asset, state, bodies, network, start)
    assert int(network.num_bonds) == 5
    assert network.bond_group[2] == -1
    assert 2 not in network.bond_list
    assert not network.check
