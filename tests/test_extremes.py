"""What is stiff, huge, tiny, degenerate or no number: finite and bounded, or flagged.

A matrix of named extremes for damage, fracture and the stress methods; the world step
has its own.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from blastjax import damage, fracture, stress
from blastjax.author import shapes
from blastjax.core import Damage
from blastjax.stress import parity

pytestmark = pytest.mark.usefixtures("strict")

BALANCE = 1e-3
"""Of the largest bond force or load, what a converged solve may leave at a node."""


@pytest.fixture(scope="module")
def block():
    return shapes.grid((3, 2, 2), (0.5, 0.5, 0.5), anchor=("z-",), dtype=np.float32)


def alternating(asset, low, high):
    """Return a value for each bond, one of two."""
    odd = np.arange(len(asset.bond_area)) % 3 == 0
    return np.where(odd, high, low)


def scaled(asset, factor):
    """Return the asset at another size."""
    return asset.replace(
        chunk_centroid=asset.chunk_centroid * factor,
        bond_centroid=asset.bond_centroid * factor,
        chunk_volume=asset.chunk_volume * factor**3,
        chunk_inertia=asset.chunk_inertia * factor**5,
        bond_area=asset.bond_area * factor**2,
    )


STRUCTURES = {
    "stiff": lambda a: (a, {"stiffness": np.full(len(a.bond_area), 1e12)}),
    "soft": lambda a: (a, {"stiffness": np.full(len(a.bond_area), 1e-12)}),
    "stiffness ratio 1e12": lambda a: (a, {"stiffness": alternating(a, 1e-3, 1e9)}),
    "no stiffness": lambda a: (a, {"stiffness": np.zeros(len(a.bond_area))}),
    "hinges only": lambda a: (a, {"bending": np.zeros(len(a.bond_area))}),
    "massless": lambda a: (a, {"density": 0.0}),
    "mass ratio 1e12": lambda a: (
        a,
        {"density": 10.0 ** (12 * (np.arange(len(a.chunk_volume)) % 2) - 6)},
    ),
    "a kilometre": lambda a: (scaled(a, 1e3), {}),
    "a micrometre": lambda a: (scaled(a, 1e-6), {}),
    "all in one place": lambda a: (
        a.replace(
            chunk_centroid=jnp.zeros_like(a.chunk_centroid),
            bond_centroid=jnp.zeros_like(a.bond_centroid),
        ),
        {},
    ),
    "all on a line": lambda a: (
        a.replace(
            chunk_centroid=a.chunk_centroid * jnp.array([[1.0, 0, 0]]),
            bond_centroid=a.bond_centroid * jnp.array([[1.0, 0, 0]]),
        ),
        {},
    ),
    "no area": lambda a: (a.replace(bond_area=jnp.zeros_like(a.bond_area)), {}),
}
LOADS = {
    "huge": lambda x: x * 1e30,
    "tiny": lambda x: x * 1e-30,
    "beyond float32": lambda x: x * jnp.inf,
    "one NaN": lambda x: x.at[3, 1].set(jnp.nan),
    "one infinity": lambda x: x.at[3, 1].set(-jnp.inf),
}
BREAKS = {
    "all broken": lambda n: np.zeros(n, bool),
    "one bond left": lambda n: np.arange(n) == 7,
    "every second": lambda n: np.arange(n) % 2 == 0,
}


def unbalanced(asset, state, load, found):
    """Return what is left at nodes that the world holds, of the largest force."""
    count = len(load.force)
    total = np.zeros((count, 3))
    for side, sign in ((0, 1.0), (1, -1.0)):
        ends = np.asarray(asset.bond_nodes)[:, side]
        np.add.at(total, ends, sign * np.asarray(found.force, float))
    total += np.asarray(load.force, float)
    carried = np.asarray(found.carries)
    held = np.zeros(count, bool)
    held[np.asarray(asset.bond_nodes)[carried].reshape(-1)] = True
    held &= np.asarray(fracture.split(asset, state)[0].actor)[:count] == 0
    held[0] = False
    most = max(np.abs(found.force).max(), np.abs(load.force).max(), 1e-37)
    return np.abs(total[held]).max(initial=0) / most


def check(asset, state, load, found):
    """Finite and balanced, or said not to be."""
    assert np.isfinite(found.force).all() and np.isfinite(found.torque).all()
    assert found.residual >= 0
    if bool(found.converged) and np.isfinite(load.force).all():
        assert unbalanced(asset, state, load, found) < BALANCE


@jax.jit
def solve(frame, asset, state, load):
    return stress.solve(frame, asset, state, load, iterations=100)


@pytest.mark.parametrize(
    "method", [pytest.param("two-level", marks=pytest.mark.slow), "force"]
)
def test_stress_survives_extreme_structures_loads_and_breaks(block, method):
    whole = fracture.init(block)
    plain = stress.structure(block, method=method)
    weight = stress.gravity(plain.mass, jnp.array([1.0, 2.0, -9.81]))
    for name, make in STRUCTURES.items():
        asset, options = make(block)
        frame = stress.structure(asset, method=method, **options)
        # The programs are those of the plain block, so one compilation serves all.
        frame = plain.replace(
            mass=frame.mass,
            inertia=frame.inertia,
            stiffness=frame.stiffness,
            bending=frame.bending,
        )
        load = stress.gravity(frame.mass, jnp.array([1.0, 2.0, -9.81]))
        try:
            check(asset, whole, load, solve(frame, asset, whole, load))
        except AssertionError as error:
            raise AssertionError(f"{name}, {method}") from error
    for name, change in LOADS.items():
        load = weight.replace(force=change(weight.force))
        found = solve(plain, block, whole, load)
        check(block, whole, load, found)
        if not np.isfinite(load.force).all():
            assert not bool(found.converged), name
    for keep in BREAKS.values():
        alive = jnp.asarray(keep(len(block.bond_area)))
        state = whole.replace(bond_intact=whole.bond_intact & alive)
        check(block, state, weight, solve(plain, block, state, weight))


@pytest.mark.parametrize("method", ["two-level", "force"])
def test_stress_of_one_chunk_and_of_none_bonded(method):
    for anchor in ((), ("z-",)):
        asset = shapes.grid((1, 1, 1), anchor=anchor, dtype=np.float32)
        frame = stress.structure(asset, method=method)
        load = stress.gravity(frame.mass, jnp.array([0.0, 0.0, -9.81]))
        state = fracture.init(asset)
        found = jax.jit(stress.solve)(frame, asset, state, load)
        assert bool(found.converged)
        np.testing.assert_allclose(
            found.force, np.abs(load.force[1:]) if anchor else np.zeros((0, 3)),
            rtol=1e-5,
        )  # fmt: skip


def test_blasts_scheme_survives_extreme_loads(block):
    state, bodies = fracture.init(block), parity.bodies(block, 1000.0)
    network = parity.network(block, state, bodies)
    update = jax.jit(
        lambda pull: parity.update(
            block,
            state,
            bodies,
            network,
            parity.no_impulses(block),
            pull,
            stress.Limits(1.0, 2.0),
            max_iterations=50,
        )
    )
    pull = jnp.zeros((len(block.span_node), 3)).at[1:, 2].set(-9.81)
    for name, change in LOADS.items():
        found = update(change(pull))
        finite = (
            np.isfinite(found.force).all() and np.isfinite(found.stress.shear).all()
        )
        assert finite or not bool(found.converged), name


@pytest.mark.parametrize("health", [1e-38, 1.0, 1e30, 3e38, 0.0, -1.0, np.nan, np.inf])
def test_fracture_survives_every_health_and_amount(block, health):
    bonds, elements = len(block.bond_area), len(block.element_chunk)
    state = fracture.init(block, bond_health=np.float32(health))
    for amount in (1e-38, 1.0, 3e38, np.inf, np.nan, -1.0, 0.0):
        dealt = Damage(
            bond=jnp.full(bonds, amount, jnp.float32),
            chunk=jnp.full(elements, amount, jnp.float32),
        )
        after, (events, _) = STEP(block, state, dealt)
        actor = np.asarray(after.actor)
        assert ((actor >= -1) & (actor < elements)).all()
        # No health is made no number that was one, and no broken bond holds.
        was = np.isfinite(np.asarray(state.bond_health))
        assert np.isfinite(np.asarray(after.bond_health)[was]).all()
        assert not np.isnan(events.bond_damage).any()
        assert not np.isnan(after.chunk_health).any()
        whole = np.asarray(state.bond_intact)
        if not amount > 0:
            np.testing.assert_array_equal(after.bond_intact, whole)


STEP = jax.jit(fracture.step)
PLACES = {
    "far away": np.full(3, 1e20),
    "beyond float32": np.full(3, np.inf),
    "nowhere": np.full(3, np.nan),
    "on a centroid": np.array([0.25, 0.25, 0.25]),
}
RADII = {
    "no size": (0.0, 0.0),
    "inside out": (1.0, 0.5),
    "unbounded": (0.1, np.inf),
    "no number": (np.nan, np.nan),
}


@pytest.mark.parametrize(
    "program", ["falloff", "cutter", "capsule", "shear", "triangle", "impact_spread"]
)
def test_damage_programs_survive_every_place_and_radius(block, program):
    state, one = fracture.init(block), np.array([0.0, 0.0, 1.0])

    @jax.jit
    def deal(place, low, high):
        if program == "triangle":
            corners = jnp.stack([place, place, place + low])
            return damage.triangle(block, state, corners, 1.0)
        extra = {"capsule": [place], "shear": [jnp.asarray(one, place.dtype)]}
        return getattr(damage, program)(
            block, state, place, *extra.get(program, []), 1.0, low, high
        )

    for where, place in PLACES.items():
        for size, (low, high) in RADII.items():
            got = deal(
                jnp.asarray(place, jnp.float32), jnp.float32(low), jnp.float32(high)
            )
            after, _ = STEP(block, state, got)
            for health in (after.bond_health, after.chunk_health):
                assert np.isfinite(health).all(), (where, size)
            assert (np.asarray(after.bond_health) <= state.bond_health).all()
