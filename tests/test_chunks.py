"""Mass, centre and inertia of actors: batches, accuracy, derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from blastjax import author, chunks, damage, fracture
from blastjax.core import NONE, Damage

pytestmark = pytest.mark.usefixtures("strict")

DIGITS = {np.float32: 1e-6, np.float64: 1e-13}
"""Of an actor's mass, its distance and the trace of its inertia: a few roundings."""
LONG_SUM = 2e-5
"""32,768 numbers added in a row in float32, where one body alone is scattered."""


def wall(dtype=np.float32, away=0.0):
    """Return boxes on a foundation, each of two pieces, and room to spare: 143 rows."""
    asset = author.shapes.grid(
        (4, 4, 2), anchor=("z-",), root=True, pieces=(2, 1, 1), dtype=dtype
    )
    spare = author.Capacity(
        chunks=150, nodes=45, sub_chunks=70, bonds=90, has_world=True, depth=2, height=2
    )
    asset = author.pad(asset, spare)
    return asset.replace(chunk_centroid=asset.chunk_centroid + dtype(away))


def labels(asset, count, rng):
    """Return actors (count, A), of few pieces to very many; some chunks are nobody's.

    Whether bonds would hold them together does not matter to sums.
    """
    here = np.flatnonzero(np.asarray(asset.element_chunk) >= -1)
    actor = np.full((count, asset.element_chunk.shape[0]), NONE, np.int32)
    for row in actor:
        several = rng.choice([0, 1, 2, 5, 12, 30])
        single = rng.random(here.size) < rng.choice([0.0, 0.5, 1.0])
        group = np.where(single, here, -1 - rng.integers(0, several + 1, here.size))
        for g in np.unique(group):
            row[here[group == g]] = here[group == g].min()
        for dead in rng.choice(here, 3):
            row[row == dead] = NONE
    return jnp.asarray(actor)


def exact(asset, actor, density):
    """Return mass, centre and inertia in float64, element by element."""
    size = actor.shape[0]
    mass, center, inertia = np.zeros(size), np.zeros((size, 3)), np.zeros((size, 3, 3))
    chunk = np.asarray(asset.element_chunk)
    weight = np.asarray(asset.chunk_volume, float) * density
    place = np.asarray(asset.chunk_centroid, float)
    spin = np.asarray(asset.chunk_inertia, float) * density
    for label in set(np.asarray(actor)) - {NONE}:
        own = chunk[(actor == label) & (chunk >= 0)]
        if own.size:
            mass[label] = weight[own].sum()
            center[label] = weight[own] @ place[own] / mass[label]
            arm = place[own] - center[label]
            second = np.einsum("i,ij,ik", weight[own], arm, arm)
            inertia[label] = spin[own].sum(0) + np.trace(second) * np.eye(3) - second
    return mass, center, inertia


@jax.jit
def of_batch(asset, state, actor, density):
    return jax.vmap(lambda x: chunks.moments(asset, state.replace(actor=x), density))(
        actor
    )


def assert_exact(asset, actor, found, tolerance):
    """Compare a batch with float64, each actor relative to itself."""
    reach = np.abs(np.asarray(asset.chunk_centroid)).max()
    for i, row in enumerate(np.asarray(actor)):
        mass, center, inertia = exact(asset, row, 700.0)
        trace = np.trace(inertia, axis1=1, axis2=2)[:, None, None]
        assert np.all(np.abs(found.mass[i] - mass) <= tolerance * mass)
        assert np.all(np.abs(found.center[i] - center) <= tolerance * reach)
        assert np.all(np.abs(found.inertia[i] - inertia) <= tolerance * trace)


@pytest.mark.parametrize("away", [0.0, 3000.0])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_moments_of_a_batch_are_exact(dtype, away):
    with jax.enable_x64(dtype is np.float64):
        asset = wall(dtype, away)
        state = fracture.init(asset)
        actor = labels(asset, 131, np.random.default_rng(3))
        found = of_batch(asset, state, actor, 700.0)
        assert found.inertia.dtype == dtype
        assert_exact(asset, actor, found, DIGITS[dtype])
        one = jax.jit(chunks.moments)
        for i in range(3):
            alone = one(asset, state.replace(actor=actor[i]), 700.0)
            alone = jax.tree.map(lambda x: x[None], alone)
            assert_exact(asset, actor[i : i + 1], alone, DIGITS[dtype])


@pytest.mark.slow
@pytest.mark.parametrize("away", [0.0, 1000.0])
def test_moments_of_many_chunks_are_exact(away):
    grid = author.shapes.grid((32, 32, 32), (1 / 32,) * 3)
    state = fracture.init(grid)

    def blast(x):
        hit = damage.falloff(grid, state, x, 2.0, 0.4, 0.4)
        return fracture.step(grid, state, hit)[0].actor

    place = np.random.default_rng(0).uniform(-0.5, 1.0, (8, 3)).astype(np.float32)
    actor = jax.jit(jax.vmap(blast))(place)
    asset = grid.replace(chunk_centroid=grid.chunk_centroid + np.float32(away))
    found = of_batch(asset, state, actor, 700.0)
    assert_exact(asset, actor, found, DIGITS[np.float32])
    alone = jax.jit(chunks.moments)(asset, state.replace(actor=actor[0]), 700.0)
    alone = jax.tree.map(lambda x: x[None], alone)
    assert_exact(asset, actor[:1], alone, LONG_SUM)


def energy(asset, state, density, actor):
    """Return one number that depends on everything."""
    found = chunks.moments(asset, state.replace(actor=actor), density)
    turn = jnp.asarray(np.arange(9).reshape(1, 3, 3) / 9, found.inertia.dtype)
    return (
        jnp.sum(jnp.sin(found.mass))
        + jnp.sum(found.mass[:, None] * jnp.cos(found.center))
        + jnp.sum(turn * found.inertia)
    )


def test_derivatives_of_a_batch_are_finite_differences():
    with jax.enable_x64(True):
        asset = wall(np.float64)
        state = fracture.init(asset)
        rng = np.random.default_rng(5)
        actor = labels(asset, 12, rng)
        density = jnp.asarray(rng.uniform(1, 2, asset.chunk_volume.shape))
        point = density, asset.chunk_volume, asset.chunk_centroid, asset.chunk_inertia
        way = [rng.normal(size=x.shape) * np.asarray(x != 0) for x in point]

        def at(density, volume, centroid, inertia):
            changed = asset.replace(
                chunk_volume=volume, chunk_centroid=centroid, chunk_inertia=inertia
            )
            return jax.vmap(functools.partial(energy, changed, state, density))(actor)

        @jax.jit
        def along(t):
            return at(*(x + t * y for x, y in zip(point, way, strict=True)))

        step = 1e-5
        slope = (along(step) - along(-step)) / (2 * step)
        _, forward = jax.jvp(along, (0.0,), (1.0,))
        np.testing.assert_allclose(forward, slope, rtol=1e-7, atol=1e-7)
        gradient = jax.grad(lambda *x: at(*x).sum(), argnums=(0, 1, 2, 3))
        gradient = jax.jit(gradient)(*point)
        reverse = sum(jnp.vdot(x, y) for x, y in zip(gradient, way, strict=True))
        np.testing.assert_allclose(reverse, forward.sum(), rtol=1e-12)


def test_moments_of_batches_of_batches():
    asset = wall()
    state = fracture.init(asset)
    actor = labels(asset, 132, np.random.default_rng(7))
    density = jnp.asarray([1.0, 3.0], jnp.float32)
    plain = of_batch(asset, state, actor, 1.0)

    def one(actor, density):
        return chunks.moments(asset, state.replace(actor=actor), density)

    over = functools.partial(jax.vmap, in_axes=(0, None))
    nested = jax.jit(over(over(one)))(actor.reshape(3, 44, -1), 1.0)
    scaled = jax.jit(jax.vmap(over(one), in_axes=(None, 0)))(actor, density)
    by_scan = jax.lax.scan(lambda _, x: (0, over(one)(x, 1.0)), 0, actor[None])[1]
    for name in ("mass", "center", "inertia"):
        flat = getattr(plain, name)
        again = getattr(nested, name).reshape(flat.shape)
        np.testing.assert_allclose(again, flat, 1e-5, 1e-5)
        np.testing.assert_allclose(getattr(by_scan, name)[0], flat, 1e-5, 1e-5)
        heavy = flat if name == "center" else 3 * flat
        np.testing.assert_allclose(getattr(scaled, name)[1], heavy, 1e-5, 1e-5)


def test_owners_of_a_batch_are_those_one_by_one():
    asset = wall()
    rng = np.random.default_rng(4)
    whole = fracture.init(asset)
    bond = rng.random((9, asset.bond_nodes.shape[0])) * 1.5
    chunk = 1.5 * (rng.random((9, whole.actor.size)) < 0.05)
    hurt = Damage(jnp.asarray(bond, jnp.float32), jnp.asarray(chunk, jnp.float32))

    def seen(asset, damage):
        state = fracture.step(asset, whole, damage)[0]
        count = chunks.node_count(asset, state) > 1
        queries = chunks.owner, chunks.visible, chunks.several, chunks.alone
        return *(query(asset, state) for query in queries), count

    together = jax.jit(jax.vmap(seen, (None, 0)))(asset, hurt)
    one = jax.jit(seen)
    apart = [one(asset, jax.tree.map(lambda x, i=i: x[i], hurt)) for i in range(9)]
    for many, *each in zip(together, *apart, strict=True):
        np.testing.assert_array_equal(many, np.stack(each))
    owner, visible, several, alone, count = map(np.asarray, together)
    np.testing.assert_array_equal(several, count)
    assert visible.any() and alone.any() and several.any() and (owner == NONE).any()
