"""Islands of many copies of a graph: the same as one by one, whatever the batch is."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from jax import lax
from scipy.sparse import csgraph

from blastjax import graph, lanes

pytestmark = pytest.mark.usefixtures("strict")


def scipys(edges, alive, n):
    """Label by scipy, one row a copy: copies are blocks of one matrix."""
    size = len(alive)
    copy, edge = np.nonzero(alive)
    ends = edges[edge] + (copy * n)[:, None]
    matrix = scipy.sparse.coo_matrix((np.ones(len(ends)), ends.T), (size * n,) * 2)
    _, group = csgraph.connected_components(matrix, directed=False)
    smallest = np.full(group.max() + 1, size * n)
    np.minimum.at(smallest, group, np.arange(size * n))
    return smallest[group].reshape(size, n) - (np.arange(size) * n)[:, None]


def random_graph(kind, n, rng):
    if kind == "chain":  # The longest way, in the worst order.
        x = rng.permutation(n)
        return np.stack([x[:-1], x[1:]], 1).astype(np.int32)
    if kind == "hub":
        star = np.stack([np.full(n - 1, n // 2), rng.permutation(n - 1)], 1)
        return np.concatenate([star, rng.integers(0, n, (n, 2))]).astype(np.int32)
    if kind == "lattice":
        index = np.arange(n).reshape((round(n ** (1 / 3)),) * 3)
        along = [np.moveaxis(index, axis, 0) for axis in range(3)]
        pairs = [np.stack([x[:-1].ravel(), x[1:].ravel()], 1) for x in along]
        return rng.permutation(np.concatenate(pairs)).astype(np.int32)
    return rng.integers(0, n, (3 * n // 2, 2)).astype(np.int32)


@functools.cache
def batched(n):
    def run(edges, alive, sweep):
        return jax.vmap(lambda x: graph.islands(edges, x, n, sweep=sweep))(alive)

    return jax.jit(run)


@pytest.mark.parametrize("placed", [False, True])
@pytest.mark.parametrize(
    ("kind", "n"),
    [("any", 60), ("hub", 61), ("chain", 300), ("lattice", 125), ("lattice", 343)],
)
def test_a_batch_is_scipys(kind, n, placed):
    rng = np.random.default_rng(n)
    for _ in range(10):
        edges = random_graph(kind, n, rng)
        alive = rng.random((150, len(edges))) < rng.random((150, 1)) ** 0.3
        sweep = lanes.order(edges, n, rng.random(n) if placed else None)
        found = batched(n)(jnp.asarray(edges), jnp.asarray(alive), sweep)
        np.testing.assert_array_equal(found, scipys(edges, alive, n))


@pytest.mark.parametrize(("kind", "roomy"), [("lattice", True), ("any", False)])
def test_both_ways_to_pack_have_their_graphs(kind, roomy):
    """Where no node has more neighbours than half of K, and where one has."""
    edges = random_graph(kind, 343, np.random.default_rng(343))
    way = lanes.unpack(lanes.order(edges, 343), 343, len(edges))
    assert (2 * int(way.degree.max()) <= way.near.shape[2]) == roomy


@pytest.mark.parametrize(("kind", "n"), [("any", 60), ("hub", 61)])
def test_touched_nodes_are_numpys(kind, n):
    rng = np.random.default_rng(n)
    edges = random_graph(kind, n, rng)
    edges[3] = 2, 2  # A node is no neighbour of its own.
    sweep = lanes.order(edges, n)
    flags = rng.random((150, len(edges))) < rng.random((150, 1)) ** 3
    flags[:, 3] = True
    expected = np.zeros((150, n), bool)
    for copy, edge in zip(*np.nonzero(flags), strict=True):
        expected[copy, edges[edge]] |= edge != 3
    edges = jnp.asarray(edges)

    def touched(x):
        return graph.touched(edges, x, n, sweep=sweep)

    many, none = jnp.asarray(flags), jnp.zeros(flags.shape, bool)
    of_all = jax.jit(jax.vmap(touched))
    np.testing.assert_array_equal(of_all(many), expected)
    assert not of_all(none).any()
    np.testing.assert_array_equal(jax.jit(touched)(many[7]), expected[7])


def test_padding_is_not_on_the_way():
    """An edge of a node with itself makes no hub of it."""
    edges = np.array([[0, 1], [1, 2], *[[0, 0]] * 40], np.int32)
    way = lanes.unpack(lanes.order(edges, 3), 3, len(edges))
    assert np.asarray(way.degree).sum() == 2 * 2
    assert lanes.order(edges[:0], 3) is None


def test_a_sweep_is_found_where_the_edges_are_known():
    rng = np.random.default_rng(5)
    edges = random_graph("hub", 61, rng)
    alive = rng.random((16, len(edges))) < 0.5
    known = jnp.asarray(edges)
    many = jax.vmap(lambda x: graph.islands(known, x, 61))
    # Sweeps are for one platform only.
    assert "platform_index" in str(jax.make_jaxpr(many)(alive))
    np.testing.assert_array_equal(jax.jit(many)(alive), scipys(edges, alive, 61))
    either = jax.vmap(lambda e, x: graph.islands(e, x, 61), (None, 0))
    assert "platform_index" not in str(jax.make_jaxpr(either)(known, alive))


def two_walls():
    rng = np.random.default_rng(3)
    edges = rng.integers(0, 40, (2, 60, 2)).astype(np.int32)
    alive = rng.random((2, 16, 60)) < 0.5
    expected = np.stack([scipys(e, a, 40) for e, a in zip(edges, alive, strict=True)])
    sweeps = jnp.stack([lanes.order(e, 40) for e in edges])
    return (jnp.asarray(edges), sweeps), jnp.asarray(alive), expected


def test_batches_of_batches():
    walls, alive, expected = two_walls()
    first = jax.tree.map(lambda x: x[0], walls)

    def islands(wall, a):
        return graph.islands(wall[0], a, 40, sweep=wall[1])

    states = jax.vmap(islands, (None, 0))
    both = jax.jit(jax.vmap(states))(walls, alive)
    np.testing.assert_array_equal(both, expected)
    # The assets on the inner axis, the states on the outer one.
    outer = jax.jit(jax.vmap(jax.vmap(islands), (None, 1), 1))(walls, alive)
    np.testing.assert_array_equal(outer, expected)
    shared = jax.jit(jax.vmap(states, (None, 0)))(first, alive)
    np.testing.assert_array_equal(shared[0], expected[0])
    looped = jax.lax.scan(lambda c, a: (c, states(first, a)), 0, alive)[1]
    np.testing.assert_array_equal(looped, shared)


def test_derivatives_pass_around():
    walls, _, _ = two_walls()
    edges, sweep = jax.tree.map(lambda x: x[0], walls)
    strength = jnp.linspace(-1, 1, 16 * 60).reshape(16, 60).astype(jnp.float32)

    def total(x):
        label = graph.islands(edges, x > 0, 40, sweep=sweep)
        return jnp.sum(x) * jnp.sum(label).astype(x.dtype)

    of_sum = jax.jit(jax.grad(lambda x: jax.vmap(total)(x).sum()))(strength)
    one_by_one = jax.jit(jax.vmap(jax.grad(total)))(strength)
    forward = jax.jit(jax.vmap(jax.jacfwd(total)))(strength)
    np.testing.assert_allclose(of_sum, one_by_one)
    np.testing.assert_allclose(of_sum, forward)


@pytest.mark.parametrize("odd", ["none", "ties", "infinite"])
def test_bottlenecks_of_a_batch_are_those_one_by_one(odd):
    n, size = 40, 40
    rng = np.random.default_rng(4)
    edges = random_graph("hub", n, rng)
    weight = rng.normal(0.2, 1.0, (size, len(edges))).astype(np.float32)
    if odd == "ties":
        weight = np.round(weight)
    if odd == "infinite":
        kind = rng.integers(0, 8, weight.shape)
        for i, x in enumerate((-np.inf, np.inf, np.nan)):
            weight[kind == i] = x
    source = rng.random((size, n)) < 0.06
    source[0] = False
    sweep = lanes.order(edges, n)
    edges, weight, source = map(jnp.asarray, (edges, weight, source))

    def search(w, s):
        return graph.bottleneck(edges, w, s, n, sweep=sweep)

    def total(w, s):
        least, edge = search(w, s)
        return jnp.where(edge >= 0, jnp.arange(1.0, n + 1) * least, 0).sum()

    value, edge = jax.jit(jax.vmap(search))(weight, source)
    alone, other = jax.jit(lambda *x: jax.lax.map(lambda y: search(*y), x))(
        weight, source
    )
    np.testing.assert_array_equal(value, alone)
    np.testing.assert_array_equal(edge >= 0, jnp.isfinite(value))
    taken = jnp.take_along_axis(weight, jnp.maximum(edge, 0), axis=1)
    np.testing.assert_array_equal(taken[edge >= 0], value[edge >= 0])
    if odd != "ties":
        np.testing.assert_array_equal(edge, other)
    slope = jax.jit(jax.grad(lambda w: jax.vmap(total)(w, source).sum()))(weight)
    nested = jax.jit(jax.vmap(jax.grad(total)))(weight, source)
    np.testing.assert_allclose(slope, nested)
    if odd != "ties":
        loop = jax.lax.map(lambda x: jax.grad(total)(*x), (weight, source))
        np.testing.assert_allclose(slope, loop, rtol=1e-6)


def test_bottlenecks_without_edges():
    source = jnp.eye(9, 3, dtype=bool)
    none, weight = jnp.zeros((0, 2), jnp.int32), jnp.zeros((9, 0), jnp.float32)
    value, edge = jax.vmap(lambda w, s: graph.bottleneck(none, w, s, 3))(weight, source)
    np.testing.assert_array_equal(value, np.where(source, np.inf, -np.inf))
    assert (edge == -1).all()


def test_a_condition_anywhere_in_a_batch_stays_a_condition():
    def doubled(x):
        return lax.cond(
            graph.anywhere(x > 0), lambda x: jnp.maximum(x, 0) * x, jnp.zeros_like, x
        )

    x = jnp.array([[1.0, -2.0, 3.0], [-1.0, -2.0, -3.0]])
    batch = jax.vmap(jax.vmap(doubled))
    wanted = jnp.where(x > 0, x * x, 0)
    np.testing.assert_array_equal(jax.jit(batch)(x), wanted)
    np.testing.assert_array_equal(jax.grad(lambda x: batch(x).sum())(x), 2 * wanted / x)
    # One flag for all, at every level: a batch of them would turn it into a select.
    conditions = re.findall(r"cond\[|platform_index", str(jax.make_jaxpr(batch)(x)))
    assert conditions == ["cond["]
    flag = jax.vmap(jax.vmap(graph.anywhere))(x > 0)
    np.testing.assert_array_equal(flag, np.ones((2, 3), bool))
    assert not jax.vmap(graph.anywhere)(x[1] > 0).any()


def test_tiles_of_large_graphs_are_half_as_wide(monkeypatch):
    monkeypatch.setattr(lanes, "CACHE", 2**10)
    assert lanes.tile_width(5) == lanes.LANES // 2
    rng = np.random.default_rng(7)
    edges = random_graph("random", 40, rng)
    alive = rng.random((200, len(edges))) < 0.5
    found = jax.jit(jax.vmap(lambda x: graph.islands(jnp.asarray(edges), x, 40)))(alive)
    np.testing.assert_array_equal(found, scipys(edges, alive, 40))
