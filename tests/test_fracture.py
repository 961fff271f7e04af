"""What fracture, damage and the graph kernels mean, beyond agreeing with Blast."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from scipy.sparse import csgraph

from blastjax import author, chunks, damage, fracture, graph
from blastjax.core import NONE, UNBREAKABLE, Damage
from tests.operations import trace

pytestmark = pytest.mark.usefixtures("strict")

FINITE_DIFFERENCE = 1e-7
"""Relative error of central differences in float64 with a step of 1e-5."""


# Without jit these compile piece by piece, which takes longer than with it.
step, apply, split = map(jax.jit, (fracture.step, fracture.apply, fracture.split))


def cut(asset, where):
    """Return damage that breaks the bonds where a mask over bonds says so."""
    return Damage(bond=jnp.where(jnp.asarray(where), 10.0, 0.0))


def test_islands_are_scipys():
    rng = np.random.default_rng(0)
    islands = jax.jit(graph.islands, static_argnums=2)
    for _ in range(200):
        n, alive_part = 60, rng.random()
        edges = rng.integers(0, n, (90, 2))
        alive = rng.random(90) < alive_part
        kept = edges[alive]
        matrix = scipy.sparse.coo_matrix((np.ones(len(kept)), kept.T), (n, n))
        _, group = csgraph.connected_components(matrix, directed=False)
        smallest = np.full(group.max() + 1, n)
        np.minimum.at(smallest, group, np.arange(n))
        found = islands(jnp.asarray(edges, jnp.int32), jnp.asarray(alive), n)
        np.testing.assert_array_equal(found, smallest[group])


def test_islands_of_a_shuffled_chain():
    """The longest way for labels to go, in the worst order."""
    n = 2000
    order = np.random.default_rng(1).permutation(n)
    edges = jnp.asarray(np.stack([order[:-1], order[1:]], 1), jnp.int32)
    found = graph.islands(edges, jnp.ones(n - 1, bool), n)
    assert (np.asarray(found) == 0).all()


def test_shortest_ways_are_dijkstras():
    rng = np.random.default_rng(2)
    ways = jax.jit(graph.shortest_ways, static_argnums=4)
    for limit in (np.inf, 1.5):
        for _ in range(50):
            n = 40
            pairs = np.stack(np.triu_indices(n, 1), 1)
            edges = pairs[rng.permutation(len(pairs))[:70]]
            length = rng.uniform(0.1, 1, 70).astype(np.float32)
            source = int(rng.integers(n))
            matrix = scipy.sparse.coo_matrix((length, edges.T), (n, n)).tocsr()
            expected = csgraph.dijkstra(matrix, directed=False, indices=source)
            expected[expected >= limit] = np.inf
            found = ways(
                jnp.asarray(edges, jnp.int32), length, source, np.float32(limit), n
            )
            np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_bar_breaks_in_two():
    asset = author.shapes.beam(4, anchor=("x-",))
    state = fracture.init(asset)
    middle = np.isclose(np.asarray(asset.bond_centroid)[:, 0], 0.0)
    state, (fractured, parted) = step(asset, state, cut(asset, middle))
    assert np.asarray(fractured.bond_broken).tolist() == middle.tolist()
    assert state.actor.tolist() == [0, 0, 0, 3, 3]
    assert parted.parent.tolist() == [0, NONE, NONE, 0, NONE]
    # The held half lost elements, so it is as new as the other.
    assert parted.created.tolist() == [True, False, False, True, False]
    assert chunks.held(asset, state).tolist() == [True, *[False] * 4]
    mass = chunks.moments(asset, state, 2.0)
    assert mass.mass.tolist() == [4.0, 0.0, 0.0, 4.0, 0.0]
    np.testing.assert_allclose(mass.center[3], [1.0, 0.0, 0.5])

    again, parted = split(asset, state)
    assert not parted.created.any()
    assert again.actor.tolist() == state.actor.tolist()


def test_whole_until_split():
    asset = author.shapes.boxes(
        np.array([[0.0, 0, 0], [5, 0, 0]]), np.full((2, 3), 0.5)
    )
    state = fracture.init(asset)
    assert state.actor.tolist() == [0, 0]
    assert not chunks.split_required(asset, state).any()
    state, parted = split(asset, state)
    assert state.actor.tolist() == [0, 1]
    assert parted.created.tolist() == [True, True]


def test_visible_is_the_coarsest():
    asset = author.shapes.grid((2, 1, 1), root=True, pieces=(2, 1, 1))
    state = fracture.init(asset)
    assert np.flatnonzero(chunks.visible(asset, state)).tolist() == [0]
    state, _ = step(asset, state, cut(asset, [True]))
    assert np.flatnonzero(chunks.visible(asset, state)).tolist() == [1, 2]
    crush = Damage(chunk=jnp.array([1.0, 0.0, 0, 0, 0, 0]))
    state, (_, parted) = step(asset, state, crush)
    assert np.flatnonzero(chunks.visible(asset, state)).tolist() == [2, 3, 4]
    assert parted.released.tolist() == [True, *[False] * 5]
    assert parted.parent.tolist() == [NONE, 1, 0, 0, NONE, NONE]
    assert chunks.owner(asset, state).tolist() == [NONE, NONE, 1, 2, 3, NONE, NONE]


def test_excess_goes_to_children_and_theirs():
    parent = [-1, 0, 0, 1, 1]
    described = author.Chunks(parent, np.zeros((5, 3)), np.ones(5), np.arange(5) == 0)
    asset = author.build(described).asset
    state = fracture.init(asset, chunk_health=jnp.array([1.0, 0.5, 9.0, 0.1, 9.0]))
    state, events = apply(
        asset, state, Damage(chunk=jnp.array([3.0, 0.0, 0.0, 0.0, 0.0]))
    )
    # 2 over; 1 each to two children; 0.5 over in the first; 0.25 each to its children.
    np.testing.assert_allclose(state.chunk_health, [-2.0, -0.5, 8.0, -0.15, 8.75])
    np.testing.assert_allclose(events.excess, [2.0, 0.5, 0, 0.15, 0])
    np.testing.assert_allclose(events.chunk_damage, [3.0, 1.0, 1.0, 0.25, 0.25])


def test_any_damage_to_a_chunk_cuts_it_out():
    asset = author.shapes.grid((3, 1, 1))
    state = fracture.init(asset, UNBREAKABLE * 2)
    assert state.bond_unbreakable.all()
    state, events = apply(asset, state, cut(asset, [True, True]))
    assert not events.bond_broken.any()
    state, (events, _) = step(asset, state, Damage(chunk=jnp.array([0.0, 1e-3, 0.0])))
    assert events.bond_broken.tolist() == [True, True]
    assert state.actor.tolist() == [0, 1, 2]


def test_unbreakable_is_a_static_fact_when_it_can_be():
    asset = author.shapes.grid((3, 1, 1))
    assert fracture.init(asset, 1.0, 2).bond_unbreakable is None
    mask = fracture.init(asset, jnp.array([1.0, jnp.inf])).bond_unbreakable
    assert mask.tolist() == [False, True]


@pytest.mark.parametrize("nothing", [0.0, -1.0, np.nan])
def test_no_damage_is_none(nothing):
    asset = author.shapes.grid((2, 1, 1), pieces=(1, 1, 2))
    state = fracture.init(asset)
    nil = Damage(
        bond=jnp.full_like(state.bond_health, nothing),
        chunk=jnp.full_like(state.chunk_health, nothing),
    )
    after, (fractured, parted) = step(asset, state, nil)
    jax.tree.map(np.testing.assert_array_equal, after, state)
    assert not any(np.asarray(x).any() for x in jax.tree.leaves(fractured))
    assert not parted.created.any()


def test_infinite_damage_leaves_no_nan():
    asset = author.shapes.grid((2, 1, 1), pieces=(1, 1, 2))
    state = fracture.init(asset)
    everything = Damage(
        bond=jnp.full_like(state.bond_health, jnp.inf),
        chunk=jnp.full_like(state.chunk_health, jnp.inf),
    )
    state, (events, _) = step(asset, state, everything)
    for leaf in jax.tree.leaves((state, events)):
        assert not np.isnan(np.asarray(leaf)).any()
    assert state.bond_health.tolist() == [0.0]


def test_actors_chosen_and_left_alone():
    asset = author.shapes.grid((4, 1, 1))
    state, _ = step(asset, fracture.init(asset), cut(asset, [False, True, False]))
    assert state.actor.tolist() == [0, 0, 2, 2]
    only = jnp.arange(4) == 2
    hit = damage.falloff(asset, state, jnp.zeros(3), 0.4, 9.0, 9.5, actors=only)
    np.testing.assert_allclose(hit.bond, [0.0, 0.0, 0.4])
    both = Damage(bond=jnp.ones(3), chunk=jnp.ones(4))
    kept = damage.restrict(asset, state, both, only)
    assert kept.bond.tolist() == [0.0, 0.0, 1.0]
    assert kept.chunk.tolist() == [0.0, 0.0, 1.0, 1.0]
    broken, _ = apply(asset, state, cut(asset, [True, True, True]))
    part, _ = split(asset, broken, actors=only)
    assert part.actor.tolist() == [0, 0, 2, 3]
    assert chunks.split_required(asset, part).tolist() == [True, False, False, False]


def test_deactivated_actors_are_gone():
    asset = author.shapes.grid((4, 1, 1))
    state, _ = step(asset, fracture.init(asset), cut(asset, [False, True, False]))
    state = fracture.deactivate(asset, state, jnp.arange(4) == 2)
    assert state.actor.tolist() == [0, 0, NONE, NONE]
    assert chunks.active(asset, state).tolist() == [True, False, False, False]
    assert not chunks.visible(asset, state)[2:].any()
    assert damage.falloff(asset, state, jnp.zeros(3), 1.0, 9.0, 9.5).bond[2] == 0
    state, _ = split(asset, state)
    assert state.actor.tolist() == [0, 0, NONE, NONE]
    assert float(chunks.moments(asset, state, 1.0).mass.sum()) == 2.0


def test_buffered_events_come_in_order():
    asset = author.shapes.grid((4, 1, 1), pieces=(2, 1, 1))
    state = fracture.init(asset)

    def strike(asset, state, event):
        return damage.shear(
            asset, state, event["at"], jnp.array([1.0, 0, 0]), event["amount"], 0.5, 4.0
        )

    buffer = damage.buffer({"at": jnp.zeros(3), "amount": 0.0}, 3)
    one_by_one = state
    for x in (-1.4, 0.2, 1.4):
        event = {"at": jnp.array([x, 0.1, 0.5]), "amount": 0.7}
        buffer = damage.push(buffer, event)
        one_by_one, _ = apply(asset, one_by_one, strike(asset, one_by_one, event))
    together, events = jax.jit(fracture.apply_buffer, static_argnums=2)(
        asset, state, strike, buffer
    )
    jax.tree.map(np.testing.assert_allclose, together, one_by_one)
    assert events.chunk_damage.sum() > 0
    assert (int(buffer.count), int(buffer.dropped)) == (3, 0)
    buffer = damage.push(buffer, event)
    assert (int(buffer.count), int(buffer.dropped)) == (3, 1)


def test_half_full_buffer_applies_what_waits():
    asset = author.shapes.grid((2, 1, 1))
    buffer = damage.push(damage.buffer(0.0, 4), 0.25)

    def all_over(asset, state, amount):
        return Damage(bond=jnp.full_like(state.bond_health, 0.1) + amount)

    state, _ = fracture.apply_buffer(asset, fracture.init(asset), all_over, buffer)
    np.testing.assert_allclose(state.bond_health, [0.65])


@pytest.mark.parametrize(
    "deal",
    [
        lambda a, s, p: damage.falloff(a, s, p[:3], p[3], p[4], p[5]),
        lambda a, s, p: damage.capsule(a, s, p[:3], p[6:9], p[3], p[4], p[5]),
        lambda a, s, p: damage.shear(a, s, p[:3], p[6:9], p[3], p[4], p[5]),
        lambda a, s, p: damage.impact_spread(a, s, p[:3] * 0, p[3], p[4], p[5]),
        lambda a, s, p: damage.cutter(a, s, p[:3] * 0, p[3], 0.1, 5.0),
    ],
    ids=["falloff", "capsule", "shear", "impact_spread", "cutter"],
)
def test_gradients_of_healths_are_finite_differences(deal):
    with jax.enable_x64(True):
        asset = author.shapes.grid((3, 2, 2), dtype=np.float64)
        state = fracture.init(asset)
        point = jnp.array([0.31, 0.12, 0.83, 0.7, 0.4, 2.9, 0.5, 0.6, 0.7])
        weight = jnp.cos(jnp.linspace(1.0, 20.0, asset.bond_area.shape[0]))

        @jax.jit
        def loss(p):
            after, _ = fracture.step(asset, state, deal(asset, state, p))
            return weight @ after.bond_health + after.chunk_health.sum()

        slope = jax.jit(jax.grad(loss))(point)
        step = 1e-5 * jnp.eye(len(point))
        central = jnp.array([(loss(point + h) - loss(point - h)) / 2e-5 for h in step])
        np.testing.assert_allclose(slope, central, atol=FINITE_DIFFERENCE)
        assert jnp.abs(slope).sum() > 0.1


def test_a_scene_pays_only_for_what_it_has():
    def operations(asset, hit):
        state = fracture.init(asset)
        return trace(fracture.step, asset, state, hit).operations

    plain = author.shapes.grid((2, 2, 2))
    both = Damage(bond=jnp.zeros(12), chunk=jnp.zeros(8))
    pieces = author.shapes.grid((2, 2, 2), pieces=(2, 1, 1))
    bonds_only = operations(plain, both.replace(chunk=None))
    with_chunks = operations(plain, both)
    with_pieces = operations(pieces, both.replace(chunk=jnp.zeros(24)))
    assert bonds_only < with_chunks < with_pieces

    def visible_operations(asset):
        state = fracture.init(asset)
        return trace(chunks.visible, asset, state).operations

    assert visible_operations(plain) < visible_operations(
        author.shapes.grid((2, 2, 2), root=True)
    )


def test_float64_stays_float64():
    with jax.enable_x64(True):
        asset = author.shapes.grid((2, 1, 1), dtype=np.float64)
        state = fracture.init(asset)
        hit = damage.falloff(asset, state, jnp.zeros(3), 1.0, 1.0, 2.0)
        state, _ = step(asset, state, hit)
        assert state.bond_health.dtype == state.chunk_health.dtype == jnp.float64
        assert chunks.moments(asset, state, 1.0).inertia.dtype == jnp.float64
        assert state.actor.dtype == jnp.int32


def test_different_walls_share_a_batch():
    walls = [author.shapes.wall(2, 3), author.shapes.tower(2, 2), author.shapes.beam(3)]
    batch = author.stack(walls)

    def shoot(asset, position):
        state = fracture.init(asset)
        hit = damage.falloff(asset, state, position, 2.0, 0.3, 0.6)
        return fracture.step(asset, state, hit)[0]

    where = jnp.stack([w.chunk_centroid[0] for w in walls])
    together = jax.jit(jax.vmap(shoot))(batch, where)
    one = jax.jit(shoot)
    for i, wall in enumerate(walls):
        alone = one(wall, where[i])
        n = wall.span_node.shape[0]
        np.testing.assert_array_equal(together.actor[i, :n], alone.actor)
