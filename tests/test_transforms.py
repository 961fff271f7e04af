"""One table of all public array functions, each under jit, vmap, padding and grad."""

import functools
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from blastjax import author, chunks, damage, fracture, graph, soft, spatial
from blastjax.core import NONE, UNBREAKABLE, Asset, Damage, State
from blastjax.soft import chance, crossing, margins, relaxation

pytestmark = pytest.mark.usefixtures("strict")

CLOSE = {"rtol": 2e-5, "atol": 2e-6}
"""Float32 sums in another order."""
SPARE = author.Capacity(
    chunks=41, nodes=13, sub_chunks=24, bonds=29, has_world=True, depth=2, height=2
)
"""Every size is larger than what is needed, and different, to be told by."""


def small():
    """Eight boxes under a root, held at the bottom, each with two pieces."""
    return author.shapes.grid(
        (2, 2, 2), anchor=("z-",), root=True, pieces=(2, 1, 1), dtype=np.float32
    )


def worn(asset):
    """Return a state with several actors of every kind."""
    state = fracture.init(asset, 1.0, jnp.float32(0.8))
    corner = jnp.array([0.5, 0.5, 1.5], jnp.float32)
    opposite = jnp.array([-0.5, -0.5, 1.5], jnp.float32)
    for place, amount in ((corner, 1.5), (corner, 1.0), (opposite, 1.5)):
        hit = damage.falloff(asset, state, place, amount, 0.6, 0.7)
        state, _ = fracture.step(asset, state, hit)
    hit = damage.falloff(asset, state, corner, 0.4, 0.0, 2.5)
    return fracture.step(asset, state, hit)[0]


def worn_amounts(asset, state):
    """Return damage to everything, the same for padded and unpadded."""
    bond = 0.3 + 0.5 * jnp.abs(jnp.sin(7 * asset.bond_centroid.sum(1)))
    place = chunks.element_values(asset, asset.chunk_centroid)
    chunk = 1.5 * jnp.abs(jnp.sin(3 * place.sum(1)))
    return Damage(bond=bond, chunk=jnp.where(chunks.is_chunk(asset), chunk, 0))


AT = jnp.array([0.3, -0.2, 0.9], jnp.float32)
TO = jnp.array([-0.5, 0.4, 1.6], jnp.float32)
UP = jnp.array([0.0, 0.6, 0.8], jnp.float32)
CORNERS = jnp.array([[-9, -8, 0.8], [9, -7, 1.1], [0.5, 9, 1.3]], jnp.float32)


def one_event(asset, state, event):
    return damage.falloff(asset, state, event["at"], event["amount"], 0.2, 1.5)


def full_buffer(x):
    events = damage.buffer({"at": AT, "amount": jnp.float32(0)}, 2)
    for i in range(3):
        events = damage.push(events, {"at": AT + i, "amount": 0.4 * x})
    return events


KEY = jax.random.key(0)


def nodes(asset):
    return jnp.arange(asset.span_node.shape[0])


def blow(asset, state, x):
    return damage.falloff(asset, state, AT * x, x, 0.2, 1.5 * x)


def act(asset, state):
    """Return what a parameter does, and a loss of what is left, for `soft.expect`."""

    def hit(x):
        return state, blow(asset, state, x)

    def loss(state, x):
        loose = state.actor[: asset.span_node.shape[0]] > 0
        return x * jnp.sum(loose, dtype=jnp.float32) + jnp.sum(
            jnp.minimum(state.bond_health, 9)
        )

    return hit, loss


def wear(time, y, intact):
    return 0.1 * y, jnp.where(intact, y, 0)


# name: f(asset, state, x), where x is a scalar that real arguments scale with.
TABLE = {
    "chunks.active": lambda a, s, x: chunks.active(a, s),
    "chunks.alone": lambda a, s, x: chunks.alone(a, s),
    "chunks.can_fracture": lambda a, s, x: chunks.can_fracture(a, s),
    "chunks.element_values": lambda a, s, x: chunks.element_values(
        a, x * a.chunk_volume
    ),
    "chunks.has_children": lambda a, s, x: chunks.has_children(a),
    "chunks.held": lambda a, s, x: chunks.held(a, s),
    "chunks.is_chunk": lambda a, s, x: chunks.is_chunk(a),
    "chunks.moments": lambda a, s, x: chunks.moments(a, s, 2.0 * x),
    "chunks.node_count": lambda a, s, x: chunks.node_count(a, s),
    "chunks.owner": lambda a, s, x: chunks.owner(a, s),
    "chunks.split_required": lambda a, s, x: chunks.split_required(a, s),
    "chunks.visible": lambda a, s, x: chunks.visible(a, s),
    "damage.buffer": lambda a, s, x: damage.buffer({"at": AT * x}, 3),
    "damage.capsule": lambda a, s, x: damage.capsule(a, s, AT * x, TO, x, 0.2, 1.5),
    "damage.cutter": lambda a, s, x: damage.cutter(a, s, AT * x, x, 0.2, 1.5),
    "damage.falloff": lambda a, s, x: damage.falloff(a, s, AT * x, x, 0.2, 1.5 * x),
    "damage.impact_spread": lambda a, s, x: damage.impact_spread(
        a, s, AT * x, x, 0.2 * x, 3.0
    ),
    "damage.normalize": lambda a, s, x: damage.normalize(
        damage.Material(health=2.0, min_threshold=0.1, max_threshold=0.9), x
    ),
    "damage.push": lambda a, s, x: full_buffer(x),
    "damage.restrict": lambda a, s, x: damage.restrict(
        a,
        s,
        jax.tree.map(lambda y: x * y, worn_amounts(a, s)),
        jnp.arange(s.actor.shape[0]) < 3,
    ),
    "damage.shear": lambda a, s, x: damage.shear(a, s, AT * x, UP, x, 0.2, 3.0),
    "damage.triangle": lambda a, s, x: damage.triangle(a, s, CORNERS, x),
    "fracture.apply": lambda a, s, x: fracture.apply(
        a, s, jax.tree.map(lambda y: x * y, worn_amounts(a, s))
    ),
    "fracture.apply_buffer": lambda a, s, x: fracture.apply_buffer(
        a, s, one_event, full_buffer(x)
    ),
    "fracture.deactivate": lambda a, s, x: fracture.deactivate(
        a, s, jnp.arange(s.actor.shape[0]) == 2
    ),
    "fracture.init": lambda a, s, x: fracture.init(a, x, 0.5 * x),
    "fracture.split": lambda a, s, x: fracture.split(
        a, s.replace(bond_intact=s.bond_intact & (a.bond_centroid[:, 0] > -0.1))
    ),
    "fracture.step": lambda a, s, x: fracture.step(
        a, s, jax.tree.map(lambda y: x * y, worn_amounts(a, s))
    ),
    "graph.bottleneck": lambda a, s, x: graph.bottleneck(
        a.bond_nodes,
        jnp.where(s.bond_intact, x * a.bond_area - 0.3, -jnp.inf),
        jnp.arange(a.span_node.shape[0]) == 0,
        a.span_node.shape[0],
    )[0],
    "graph.group_any": lambda a, s, x: graph.group_any(
        s.bond_intact, a.bond_nodes[:, 0], a.span_node.shape[0]
    ),
    "graph.group_sum": lambda a, s, x: graph.group_sum(
        x * a.bond_area, a.bond_nodes[:, 0], a.span_node.shape[0]
    ),
    "graph.islands": lambda a, s, x: graph.islands(
        a.bond_nodes, s.bond_intact, a.span_node.shape[0]
    ),
    "graph.shortest_ways": lambda a, s, x: graph.shortest_ways(
        a.bond_nodes,
        jnp.where(s.bond_intact, 1 + a.bond_area, jnp.inf),
        jnp.int32(0),
        jnp.float32(9.0),
        a.span_node.shape[0],
    ),
    "chance.expect": lambda a, s, x: soft.expect(
        a, *act(a, s), x, KEY, 2, strength=soft.weibull(3 + x)
    ),
    "chance.expect_by_flips": lambda a, s, x: soft.expect_by_flips(
        a, *act(a, s), x, KEY, 2
    ),
    "chance.logistic": lambda a, s, x: soft.logistic(0.3)(
        x * s.bond_health, a.bond_area
    ),
    "chance.weibull": lambda a, s, x: soft.weibull(3 + x)(s.bond_health, a.bond_area),
    "crossing.evolve": lambda a, s, x: soft.evolve(
        wear, x * a.bond_area, s.bond_health, s.bond_intact, duration=1.0, steps=2
    ),
    "margins.bond_margin": lambda a, s, x: soft.bond_margin(a, s, blow(a, s, x)),
    "margins.hold_loss": lambda a, s, x: soft.hold_loss(
        a, soft.margin(a, s, blow(a, s, x)), nodes(a) < 4, temperature=0.1 + x
    ),
    "margins.margin": lambda a, s, x: soft.margin(
        a, s, blow(a, s, x), to=nodes(a) == 3
    ),
    "margins.perturbed_margin": lambda a, s, x: soft.perturbed_margin(
        a, s, blow(a, s, x), key=KEY, samples=2, scale=0.1 * x
    ),
    "margins.release_loss": lambda a, s, x: soft.release_loss(
        a, soft.margin(a, s, blow(a, s, x)), nodes(a) < 4
    ),
    "margins.sources": lambda a, s, x: margins.sources(a, None),
    "relaxation.loosen": lambda a, s, x: soft.loosen(a, s, blow(a, s, x)),
    "relaxation.share_velocity": lambda a, s, x: soft.share_velocity(
        a,
        jnp.minimum(s.bond_health, 1),
        jnp.ones((a.span_node.shape[0], 3), jnp.float32) * x,
        jnp.zeros((a.span_node.shape[0], 3), jnp.float32),
        stiffness=10.0,
    ),
    "spatial.conjugate": lambda a, s, x: spatial.conjugate(
        spatial.unit(jnp.array([1, 2, 3], jnp.float32) * x)[jnp.array([0, 1, 2, 0])]
    ),
    "spatial.dot": lambda a, s, x: spatial.dot(AT * x, TO),
    "spatial.matrix": lambda a, s, x: spatial.matrix(
        spatial.unit(jnp.array([1, 2, 3], jnp.float32) * x)[jnp.array([0, 1, 2, 0])]
    ),
    "spatial.norm": lambda a, s, x: spatial.norm(AT * x - AT),
    "spatial.point_to_segment": lambda a, s, x: spatial.point_to_segment(
        AT * x, TO, UP
    ),
    "spatial.ratio": lambda a, s, x: spatial.ratio(x, x - 1),
    "spatial.rotate": lambda a, s, x: spatial.rotate(
        AT * x, jnp.array([0.5, -0.5, 0.5, 0.5], jnp.float32)
    ),
    "spatial.segment_hits_triangle": lambda a, s, x: spatial.segment_hits_triangle(
        AT[None], TO[None] * x, CORNERS
    ),
    "spatial.unit": lambda a, s, x: spatial.unit(AT * x - AT),
}
MODULES = (
    *(chunks, damage, fracture, graph, spatial),
    *(chance, crossing, margins, relaxation),
)
RANDOM = {"chance.expect", "chance.expect_by_flips", "margins.perturbed_margin"}
"""Draw for every bond, padding too: other numbers for the others."""


def test_table_is_complete():
    public = {
        f"{module.__name__.split('.')[-1]}.{name}"
        for module in MODULES
        for name, f in inspect.getmembers(module, inspect.isfunction)
        if not name.startswith("_") and f.__module__ == module.__name__
    }
    assert public == set(TABLE)


@functools.cache
def compiled(name):
    """Return a function of the table, compiled once for all tests."""
    return jax.jit(TABLE[name])


worn_once = jax.jit(worn)


@pytest.fixture(scope="module")
def sample():
    asset = small()
    return asset, worn_once(asset)


@pytest.fixture(scope="module")
def padded(sample):
    asset = author.pad(sample[0], SPARE)
    return asset, worn_once(asset)


HEAVY = {
    *("chance.expect", "chance.expect_by_flips", "crossing.evolve"),
    *("margins.perturbed_margin", "margins.hold_loss", "margins.release_loss"),
}
"""Dear to compile and made of others of the table; their gradients and padding are
always checked, the rest by `-m slow`."""
LOOPS = HEAVY | {
    *("fracture.apply_buffer", "fracture.split", "fracture.step"),
    *("graph.bottleneck", "graph.shortest_ways", "margins.margin"),
}
"""Without jit these compile piece by piece, which takes longer than with it."""


def names(slow):
    return [
        pytest.param(name, marks=pytest.mark.slow) if name in slow else name
        for name in TABLE
    ]


def same(ours, theirs):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, **CLOSE), ours, theirs)


ONE = jnp.float32(1.0)


def test_sample_has_actors_of_every_kind(sample):
    asset, state = sample
    nodes = asset.span_node.shape[0]
    active = np.asarray(chunks.active(asset, state))
    alone = np.asarray(chunks.alone(asset, state))
    assert active[0]
    assert not alone[0]
    assert alone[:nodes].any()
    assert active[nodes:].any()


@pytest.mark.parametrize("name", names(LOOPS))
def test_jit_is_eager(name, sample):
    same(compiled(name)(*sample, ONE), TABLE[name](*sample, ONE))


@pytest.mark.parametrize("name", names(HEAVY))
def test_vmap_is_a_loop(name, sample):
    """Over different assets and states."""
    check_vmap(name, sample, 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", TABLE)
def test_vmap_over_states_is_a_loop(name, sample):
    check_vmap(name, sample, None)


def check_vmap(name, sample, axis):
    asset, state = sample
    other = jax.tree.map(lambda x: x, asset).replace(
        bond_nodes=jnp.where(asset.bond_nodes == 2, 3, asset.bond_nodes)
    )
    fresh = fracture.init(asset, jnp.ones(asset.bond_area.shape), jnp.float32(0.8))
    fresh = jax.tree.map(
        lambda x, y: jnp.asarray(y, x.dtype),
        state,
        fresh.replace(bond_unbreakable=state.bond_unbreakable),
    )
    assets = jax.tree.map(lambda *x: jnp.stack(x), asset, other)
    states = jax.tree.map(lambda *x: jnp.stack(x), state, fresh)
    xs = jnp.array([1.0, 0.8], jnp.float32)
    which = asset if axis is None else assets
    many = jax.jit(jax.vmap(TABLE[name], (axis, 0, 0)))(which, states, xs)
    for i, (a, s) in enumerate([(asset, state), (other, fresh)]):
        one = compiled(name)(asset if axis is None else a, s, xs[i])
        same(jax.tree.map(lambda x, i=i: np.asarray(x)[i], many), one)


def cut_back(tree, asset: Asset):
    """Take padding out of a result, telling by the sizes what has which."""
    own = author.capacity(asset)
    nodes, subs = own.nodes, own.sub_chunks
    elements = np.r_[np.arange(nodes), np.arange(subs) + SPARE.nodes]
    rows = {
        SPARE.nodes + SPARE.sub_chunks: elements,
        SPARE.chunks: np.arange(own.chunks),
        SPARE.nodes: np.arange(nodes),
        SPARE.bonds: np.arange(own.bonds),
    }
    assert len(rows) == 4

    def cut(x):
        x = np.asarray(x)
        x = x[rows[len(x)]] if x.ndim and len(x) in rows else x
        if x.dtype.kind == "i":
            x = np.where(x >= SPARE.nodes, x - SPARE.nodes + nodes, x)
        return x

    return jax.tree.map(cut, tree)


@pytest.mark.parametrize("name", [name for name in TABLE if name not in RANDOM])
def test_padding_changes_nothing(name, sample, padded):
    asset, state = sample
    same(cut_back(padded[1], asset), state)
    found = compiled(name)(*padded, ONE)
    same(cut_back(found, asset), compiled(name)(*sample, ONE))


def extremes(asset, state):
    """Return name -> (asset, state, x): where a careless derivative is not finite."""
    bonds = state.bond_intact.shape[0]
    state = state.replace(
        bond_unbreakable=jnp.zeros_like(state.bond_intact),
        chunk_unbreakable=jnp.zeros(state.actor.shape, bool),
    )
    fresh = fracture.init(asset, jnp.ones(bonds, jnp.float32), jnp.float32(1.0))
    rock = fracture.init(asset, jnp.full(bonds, UNBREAKABLE), jnp.float32(UNBREAKABLE))
    onto_chunk = AT - asset.chunk_centroid[3]
    onto_bond = AT - asset.bond_centroid[2]

    def moved(by):
        return asset.replace(
            chunk_centroid=asset.chunk_centroid + by[None],
            bond_centroid=asset.bond_centroid + by[None],
        )

    none = jnp.zeros_like(asset.bond_area)
    gone = jnp.zeros_like(state.bond_intact)
    return {
        "several actors": (asset, state, 1.0),
        "ties in health": (asset, fresh, 1.0),
        "on a chunk's centroid": (moved(onto_chunk), fresh, 1.0),
        "on a bond's centroid": (moved(onto_bond), state, 1.0),
        "zero radius and load": (asset, fresh, 0.0),
        "zero area": (asset.replace(bond_area=none), state, 1.0),
        "all broken": (asset, state.replace(bond_health=none, bond_intact=gone), 1.0),
        "no health left": (asset, fresh.replace(bond_health=none), 1.0),
        "no actors": (
            asset,
            state.replace(actor=jnp.full_like(state.actor, NONE)),
            1.0,
        ),
        "unbreakable": (asset, rock, 1.0),
    }


@pytest.mark.parametrize("name", TABLE)
def test_gradients_are_finite(name, sample):
    """With respect to everything real that goes in, at all kinds of extremes."""

    def total(asset: Asset, state: State, x):
        out = TABLE[name](asset, state, x)
        reals = [
            y for y in jax.tree.leaves(out) if jnp.issubdtype(y.dtype, jnp.floating)
        ]
        # Unreached is infinitely far; that is no number to sum.
        return sum(jnp.sum(jnp.where(jnp.isfinite(y), y, 0)) for y in reals) + 0 * x

    slope_of = jax.jit(jax.grad(total, (0, 1, 2), allow_int=True))
    for case, (asset, state, x) in extremes(*sample).items():
        slopes = slope_of(asset, state, jnp.float32(x))
        for path, slope in jax.tree_util.tree_leaves_with_path(slopes):
            if slope.dtype != jax.dtypes.float0:
                where = f"{case}: {jax.tree_util.keystr(path)}"
                assert np.isfinite(slope).all(), where


WORDS = ("deriv", "ifferentiab", "iecewise constant", "onstant under", "nteger")


@pytest.mark.parametrize("name", TABLE)
def test_docstrings_speak_of_derivatives(name):
    room, function = name.split(".")
    text = getattr(next(m for m in MODULES if m.__name__.endswith(room)), function)
    assert any(word in text.__doc__ for word in WORDS), name
