"""One table of all public array functions, each under jit, vmap, padding and grad."""

import dataclasses
import functools
import importlib
import inspect
import pathlib
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import blastjax
from blastjax import (
    author,
    chunks,
    damage,
    fracture,
    graph,
    rigid,
    soft,
    spatial,
    stress,
    world,
)
from blastjax.core import NONE, UNBREAKABLE, Asset, Damage, State
from blastjax.soft import chance, crossing, margins, relaxation
from blastjax.stress import equilibrium, failure, limits, loads, parity

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


LIMITS = stress.Limits(2.0, 30.0, 1.0, 20.0)


def weigh(asset, x):
    mass = stress.node_mass(asset, 3.0 * x)
    return stress.gravity(mass, jnp.array([1.0, 2.0, -9.0], jnp.float32))


def borne(asset, x):
    """Return forces and torques as bonds may bear them."""
    return 9 * x * asset.bond_centroid, x * asset.bond_centroid[:, ::-1]


def bond_stress(asset, x):
    return stress.bond_stress(
        *borne(asset, x),
        asset.bond_normal,
        asset.bond_area,
        spatial.norm(asset.bond_centroid - AT[None]),
        both_faces=True,
    )


def verdict(asset, state, x):
    force, torque = borne(asset, x)
    some = {f.name: None for f in dataclasses.fields(stress.Solution)}
    return stress.Verdict(
        solution=stress.Solution(**{**some, "force": force, "torque": torque}),
        stress=bond_stress(asset, x),
        utilisation=None,
        actor_utilisation=None,
        safety=None,
    )


def found(asset, state, x):
    """Return what Blast's own stress scheme may find."""
    some = {f.name: None for f in dataclasses.fields(parity.Result)}
    some |= {"stress": bond_stress(asset, x), "force": borne(asset, x)[0]}
    return parity.Result(**{**some, "health": 2 + 0 * state.bond_health})


def as_areas(structure, asset):
    """Return the structure, as stiff as its bonds have area."""
    stiffness = 1e6 * asset.bond_area
    return structure.replace(
        stiffness=stiffness, bending=stiffness * asset.bond_area / 12
    )


def center(asset, state, x):
    return chunks.moments(asset, state, 2.0 * x).center


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
    "chunks.several": lambda a, s, x: chunks.several(a, s),
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
        sweep=a.sweep,
    )[0],
    "graph.count_changes": lambda a, s, x: graph.count_changes(s.actor[:, None])[:, 0],
    "graph.group_any": lambda a, s, x: graph.group_any(
        s.bond_intact, a.bond_nodes[:, 0], a.span_node.shape[0]
    ),
    "graph.group_count": lambda a, s, x: graph.group_count(
        jnp.where(s.bond_intact, a.bond_nodes[:, 0], -1), a.span_node.shape[0]
    ),
    "graph.group_sum": lambda a, s, x: graph.group_sum(
        x * a.bond_area, a.bond_nodes[:, 0], a.span_node.shape[0]
    ),
    "graph.islands": lambda a, s, x: graph.islands(
        a.bond_nodes, s.bond_intact, a.span_node.shape[0], sweep=a.sweep
    ),
    "graph.shortest_ways": lambda a, s, x: graph.shortest_ways(
        a.bond_nodes,
        jnp.where(s.bond_intact, 1 + a.bond_area, jnp.inf),
        jnp.int32(0),
        jnp.float32(9.0),
        a.span_node.shape[0],
    ),
    "graph.touched": lambda a, s, x: graph.touched(
        a.bond_nodes, s.bond_intact, a.span_node.shape[0], sweep=a.sweep
    ),
    "failure.excess": lambda a, s, x: stress.excess(
        a, s, verdict(a, s, x), s.bond_intact, LIMITS, center(a, s, x)
    ),
    "failure.stress_damage": lambda a, s, x: stress.stress_damage(
        s, verdict(a, s, x), LIMITS
    ),
    "limits.bond_stress": lambda a, s, x: bond_stress(a, x),
    "limits.damage": lambda a, s, x: stress.damage(
        stress.Limits(2 * x, 9 * x), bond_stress(a, x), s.bond_health
    ),
    "limits.effective": lambda a, s, x: stress.effective(stress.Limits(x, 2 * x)),
    "limits.overstressed": lambda a, s, x: stress.overstressed(
        LIMITS, bond_stress(a, x)
    ),
    "limits.utilisation": lambda a, s, x: stress.utilisation(
        stress.Limits(2 * x, 9 * x), bond_stress(a, 2 - x)
    ),
    "loads.add": lambda a, s, x: stress.add(weigh(a, x), weigh(a, 2 * x)),
    "loads.at_node": lambda a, s, x: stress.at_node(a, 3, AT * x),
    "loads.at_position": lambda a, s, x: stress.at_position(a, s, AT * x, TO * x),
    "loads.centrifugal": lambda a, s, x: stress.centrifugal(
        a, stress.node_mass(a, 3.0), AT, UP * x
    ),
    "loads.gravity": lambda a, s, x: weigh(a, x),
    "loads.node_mass": lambda a, s, x: stress.node_mass(a, 2 * x),
    "loads.node_place": lambda a, s, x: stress.node_place(a),
    "parity.bodies": lambda a, s, x: parity.bodies(a, 2 * x),
    "parity.excess": lambda a, s, x: parity.excess(
        a, s, parity.bodies(a, 2 * x), found(a, s, x), LIMITS, center(a, s, x)
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
    "spatial.multiply": lambda a, s, x: spatial.multiply(
        jnp.array([1, 2, 3, 4], jnp.float32) * x, jnp.array([4, 2, 1, 3], jnp.float32)
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
    "spatial.unit_quaternion": lambda a, s, x: spatial.unit_quaternion(
        jnp.array([1, 2, 3, 4], jnp.float32) * x - jnp.array([1, 2, 3, 4], jnp.float32)
    ),
}


class Made(NamedTuple):
    """What is made of the sample on the host."""

    structure: dict[str, stress.Structure]
    """By method."""
    network: parity.Network
    scene: rigid.Scene


# name: f(asset, state, x, made). What solves is checked against loops, padding and
# finite differences in tests of its own.
SOLVERS = {
    "equilibrium.solve": lambda a, s, x, made: stress.solve(
        as_areas(made.structure["force"], a), a, s, weigh(a, x)
    ),
    "failure.judge": lambda a, s, x, made: stress.judge(
        as_areas(made.structure["two-level"], a),
        a,
        s,
        weigh(a, x),
        LIMITS,
        iterations=20,
    ),
    "failure.collapse": lambda a, s, x, made: stress.collapse(
        as_areas(made.structure["force"], a), a, s, weigh(a, x), LIMITS, rounds=2
    ),
    "parity.update": lambda a, s, x, made: parity.update(
        a,
        s,
        parity.bodies(a, 2 * x),
        made.network,
        parity.no_impulses(a),
        stress.node_place(a) * x,
        LIMITS,
        max_iterations=9,
    ),
    "world.step": lambda a, s, x, made: thrown(a, s, x, made),
    "world.bear": lambda a, s, x, made: thrown(a, s, x, made, bears=True),
}
FORWARD = {"failure.collapse", "parity.update", "world.step"}
"""Forward mode: the first two have no other; in reverse the last is slow to compile,
and is checked with `world.bear`."""
DEAR = {"equilibrium.solve", "failure.collapse", "world.bear"}
"""Only with `-m slow`: long to compile, and made of the others or in them."""
MODULES = (
    *(chunks, damage, fracture, graph, spatial),
    *(chance, crossing, margins, relaxation),
    *(equilibrium, failure, limits, loads, parity, world),
)
NO_DERIVATIVE = {
    "graph.any_of_many": "of a whole batch; fracture calls it",
    "graph.anywhere": "means one thing alone and another in a batch: test_lanes",
    "graph.one_of_many": "makes functions; fracture and chunks call them",
    "graph.side_by_side": "makes functions; fracture and chunks call them",
    "parity.network": "host",
    "parity.no_impulses": "host",
    "parity.notify": "host",
    "parity.prune": "host",
    "parity.settle": "host",
    "world.contact_load": "world.bear",
    "world.held_weight": "world.bear",
    "world.impact_damage": "world.step",
    "world.init": "world.step",
    "world.rollout": "a scan of world.step; tests/test_world.py",
}
"""Of a function that is not in the tables: where it runs, or what there runs it."""
NO_DERIVATIVES = {
    "__init__": "names",
    "__main__": "commands",
    "author": "host",
    "bottlenecks": "graph.bottleneck",
    "commands": "commands",
    "consistency": "host",
    "core": "data",
    "envs": "whole numbers: who came loose",
    "export": "host",
    "lanes": "graph.islands",
    "pictures": "host",
    "pytree": "data",
    "render": "host",
    "rigid": "world.step",
    "serialize": "host",
    "stress.force_method": "equilibrium.solve",
    "stress.frames": "equilibrium.solve",
    "stress.structures": "host",
    "stress.two_level_method": "equilibrium.solve",
    "sums": "chunks.moments",
    "tiles": "those of jax.vmap: test_tiles",
    "wrappers": "host",
}
"""The same for whole rooms and modules."""
RANDOM = {"chance.expect", "chance.expect_by_flips", "margins.perturbed_margin"}
"""Draw for every bond, padding too: other numbers for the others."""


def functions(module):
    """Return the public functions that a module defines."""
    return {
        f"{module.__name__.split('.')[-1]}.{name}"
        for name, f in inspect.getmembers(module, callable)
        if not name.startswith("_") and not inspect.isclass(f)
        if getattr(f, "__module__", "") == module.__name__
    }


def test_table_is_complete():
    public = set().union(*map(functions, MODULES))
    tables = set(TABLE) | set(SOLVERS)
    assert public == tables | set(NO_DERIVATIVE)
    assert not tables & set(NO_DERIVATIVE)
    root = pathlib.Path(blastjax.__file__).parent
    for path in root.rglob("*.py"):
        parts = path.relative_to(root).with_suffix("").parts
        if {parts[0], ".".join(parts)} & NO_DERIVATIVES.keys():
            continue
        module = importlib.import_module(".".join(["blastjax", *parts]))
        assert module in MODULES or not functions(module), path


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
    *("failure.excess", "failure.stress_damage", "parity.excess", "limits.damage"),
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
    onto_chunk = AT - asset.chunk_centroid[-1]
    onto_bond = AT - asset.bond_centroid[-1]

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


def thrown(asset, state, x, made, bears=False):
    """Return what two boxes do that hit the floor, hurt, and may bear their loads."""
    scene = made.scene.replace(asset=asset)
    impact = world.Impact(
        threshold=x, hardness=1.0 + x, min_radius=0.5 * x, max_radius=0.9 * x
    )
    start = world.init(scene, state, velocity=DOWN * x, spin=UP * x)
    load = world.Stress(made.structure["force"], LIMITS) if bears else None
    moment, events = world.step(scene, start, impact=impact, stress=load)
    seen = moment.data.qpos, moment.data.qvel, moment.state, events.impulse
    return seen, events.damage, events.verdict


DOWN = jnp.array([0.5, 0.0, -3.0], jnp.float32)


@pytest.fixture(scope="module")
def made(sample):
    asset, _ = sample
    state = fracture.init(asset)
    methods = "two-level", "force"
    return Made(
        structure={m: stress.structure(asset, method=m) for m in methods},
        network=parity.network(asset, state, parity.bodies(asset, 2.0)),
        scene=None,
    )


@pytest.fixture(scope="module")
def boxes():
    """Two boxes of a scene that touch the floor, and what else `thrown` needs."""
    asset = author.shapes.grid((2, 1, 1), (0.5, 0.5, 0.5), dtype=np.float32)
    scene = rigid.build(
        asset,
        slots=2,
        position=(0, 0, -0.01),
        chunk_contacts=False,
        iterations=3,
        line_search=3,
    )
    state = fracture.init(asset, jnp.ones(1, jnp.float32), jnp.float32(1.0))
    structure = {"force": stress.structure(asset, method="force")}
    return asset, state, Made(structure=structure, network=None, scene=scene)


ALL = {name: (lambda a, s, x, _, f=f: f(a, s, x)) for name, f in TABLE.items()}
ALL |= SOLVERS


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow) if n in DEAR else n for n in ALL],
)
def test_gradients_are_finite(name, sample, made, boxes):
    """With respect to everything real that goes in, at all kinds of extremes."""
    asset, state = sample
    types, ranks = "strict", "raise"
    if name.startswith("world."):
        asset, state, made = boxes
        types, ranks = "standard", "allow"  # MJX relies on promotion.

    def total(asset: Asset, state: State, x):
        out = ALL[name](asset, state, x, made)
        reals = [
            y for y in jax.tree.leaves(out) if jnp.issubdtype(y.dtype, jnp.floating)
        ]
        # Unreached is infinitely far; that is no number to sum.
        return sum(jnp.sum(jnp.where(jnp.isfinite(y), y, 0)) for y in reals) + 0 * x

    slopes_of = (along if name in FORWARD else against)(total)
    for case, (a, s, x) in extremes(asset, state).items():
        with jax.numpy_dtype_promotion(types), jax.numpy_rank_promotion(ranks):
            slopes = slopes_of(a, s, jnp.float32(x))
        for path, slope in jax.tree_util.tree_leaves_with_path(slopes):
            if slope.dtype != jax.dtypes.float0:
                where = f"{case}: {jax.tree_util.keystr(path)}"
                assert np.isfinite(slope).all(), where


def against(total):
    """Return the derivative in reverse mode."""
    return jax.jit(jax.grad(total, (0, 1, 2), allow_int=True))


def along(total):
    """Return the derivative in forward mode, along all that is real at once."""

    def tangent(x):
        real = jnp.issubdtype(jnp.result_type(x), jnp.floating)
        return jnp.ones_like(x) if real else np.zeros(jnp.shape(x), jax.dtypes.float0)

    def slope(*args):
        return jax.jvp(total, args, jax.tree.map(tangent, args))[1]

    return jax.jit(slope)


WORDS = ("deriv", "ifferentiab", "iecewise constant", "onstant under", "nteger")


@pytest.mark.parametrize("name", [*TABLE, *SOLVERS])
def test_docstrings_speak_of_derivatives(name):
    room, function = name.split(".")
    text = getattr(next(m for m in MODULES if m.__name__.endswith(room)), function)
    assert any(word in text.__doc__ for word in WORDS), name
