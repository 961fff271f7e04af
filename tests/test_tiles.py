"""Batches in tiles: the same as vmap, for any size, and less is done."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from blastjax import graph, tiles


def one(thing, key):
    # Whole numbers: their sums are exact, however they are compiled.
    noise = jax.random.randint(key, thing["x"].shape, -9, 10)
    return {"sum": jnp.sum(thing["x"] * noise.astype(jnp.float32)), "same": thing}


def batch(size):
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.integers(-9, 10, (size, 5)), jnp.float32)
    # A model without controls has arrays without entries.
    things = {"x": x, "none": jnp.zeros((size, 0)), "flag": x[:, 0] > 0}
    return things, jax.random.split(jax.random.key(1), size)


@pytest.mark.parametrize(
    ("size", "width"), [(1, 4), (4, 4), (5, 4), (8, 4), (9, 4), (130, None), (3, 1)]
)
def test_results_are_those_of_vmap(size, width):
    args = batch(size)
    expected = jax.vmap(one)(*args)
    found = jax.jit(tiles.vmap(one, width))(*args)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_derivatives_are_those_of_vmap():
    things, keys = batch(9)

    def loss(x, vmap):
        return jnp.sum(vmap(one)({**things, "x": x}, keys)["sum"] ** 2)

    expected = jax.grad(loss)(things["x"], jax.vmap)
    found = jax.grad(loss)(things["x"], lambda f: tiles.vmap(f, 4))
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_a_tile_leaves_out_what_none_in_it_needs():
    ran = []

    def heavy(flag):
        def work():
            jax.debug.callback(lambda: ran.append(1))
            return 1.0

        needed = graph.anywhere(flag)
        return jax.lax.cond(needed, work, lambda: 0.0)

    flags = jnp.zeros(12, bool).at[9].set(True)
    jax.block_until_ready(jax.jit(tiles.vmap(heavy, 4))(flags))
    jax.effects_barrier()
    assert len(ran) == 1


def test_what_cannot_be_a_batch_is_named():
    with pytest.raises(ValueError, match="width is 0; use 1 or more"):
        tiles.vmap(one, 0)
    with pytest.raises(ValueError, match=r"argument\[1\] has no batch axis"):
        tiles.vmap(lambda x, y: x + y)(jnp.zeros(3), 1.0)
    with pytest.raises(ValueError, match=r"3 in argument\[0\], 4 in argument\[1\]"):
        tiles.vmap(lambda x, y: x + y)(jnp.zeros(3), jnp.zeros(4))
    with pytest.raises(ValueError, match="no array"):
        tiles.vmap(lambda x: x)({})
