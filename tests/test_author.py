"""Authoring: shapes, order, padding, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from blastjax import author, chunks, damage, fracture
from blastjax.core import NO_PARENT, WORLD

pytestmark = pytest.mark.usefixtures("strict")
shapes = author.shapes


def described(**changes):
    """Two chunks bonded to each other, one to the world; changes override fields."""
    fields = {
        "parent": [NO_PARENT, NO_PARENT],
        "centroid": [[0.0, 0, 0], [1, 0, 0]],
        "volume": [1.0, 1],
        "support": None,
        "size": None,
        "inertia": None,
        "chunks": [[0, 1], [0, WORLD]],
        "normal": [[1.0, 0, 0], [-1, 0, 0]],
        "area": [1.0, 1],
        "bond_centroid": [[0.5, 0, 0], [-0.5, 0, 0]],
    }
    fields.update(changes)
    chunk = {k: fields[k] for k in ("parent", "centroid", "volume")}
    extra = {k: fields[k] for k in ("support", "size", "inertia")}
    bond = {k: fields[k] for k in ("chunks", "normal", "area")}
    return author.Chunks(**chunk, **extra), author.Bonds(
        **bond, centroid=fields["bond_centroid"]
    )


NAN, INF = np.nan, np.inf
EYE = np.eye(3)

# What is wrong, and what the message must name: the element and its value.
REFUSED = [
    ({"centroid": [[0.0, 0, 0], [NAN, 0, 0]]}, r"chunk centroid 1 is \[nan"),
    ({"centroid": [[INF, 0, 0], [0, 0, 0.0]]}, r"chunk centroid 0 is \[inf"),
    ({"centroid": [[0.0, 0], [1, 0]]}, r"chunk centroid has shape \(2, 2\)"),
    ({"centroid": [["a", 0, 0], [1, 0, 0]]}, "chunk centroid has dtype"),
    ({"centroid": [[0.0, 0, 0], [1, 0]]}, "chunk centroid is ragged"),
    ({"volume": [1.0, NAN]}, "chunk volume 1 is nan"),
    ({"volume": [INF, 1.0]}, "chunk volume 0 is inf"),
    ({"volume": [1.0, -2.0]}, r"chunk 1 has volume -2\.0"),
    ({"volume": [1.0]}, r"chunk volume has shape \(1,\)"),
    ({"volume": 1.0}, "chunk volume is .* must be an array"),
    ({"volume": [1j, 1.0]}, "chunk volume has dtype complex"),
    ({"parent": [NO_PARENT, 2]}, "chunk 1 has parent 2"),
    ({"parent": [-5, NO_PARENT]}, "chunk 0 has parent -5"),
    ({"parent": [1, 0]}, r"chunk 0 \(parent 1\) is its own ancestor"),
    ({"parent": [NO_PARENT, 1]}, r"chunk 1 \(parent 1\) is its own ancestor"),
    ({"parent": [0.0, 1.0]}, "chunk parent has dtype float64"),
    ({"parent": [[NO_PARENT, NO_PARENT]]}, r"chunk parent has shape \(1, 2\)"),
    ({"support": [1, 2]}, "chunk support must hold truth values"),
    ({"support": [True]}, r"chunk support has shape \(1,\)"),
    ({"size": [[1.0, 1, 1], [1, -1, 1]]}, r"chunk 1 has size \[1\.0, -1\.0"),
    ({"size": [[1.0, 1, 1], [1, NAN, 1]]}, r"chunk size 1 is \[1\.0, nan"),
    ({"inertia": [EYE, EYE + np.eye(3, k=1)]}, "chunk 1 has inertia .* symmetric"),
    ({"inertia": [-EYE, EYE]}, "chunk 0 has inertia .* negative moment"),
    ({"chunks": [[0, 1], [0, 7]]}, r"bond 1 joins chunks \[0, 7\]"),
    ({"chunks": [[0, -3], [0, 1]]}, r"bond 0 joins chunks \[0, -3\]"),
    ({"chunks": [[0, 1], [1, 1]]}, "bond 1 joins chunk 1 to itself"),
    ({"chunks": [[WORLD, WORLD], [0, 1]]}, "bond 0 joins chunk -1 to itself"),
    ({"chunks": [[0.0, 1], [0, 1]]}, "bond chunks has dtype float64"),
    ({"chunks": [[0, 1, 1], [0, 1, 1]]}, r"bond chunks has shape \(2, 3\)"),
    ({"area": [1.0, -0.5]}, r"bond 1 has area -0\.5"),
    ({"area": [NAN, 1.0]}, "bond area 0 is nan"),
    ({"normal": [[1.0, 0, 0], [INF, 0, 0]]}, r"bond normal 1 is \[inf"),
    ({"bond_centroid": [[0.5, NAN, 0], [0, 0, 0]]}, r"bond centroid 0 is \[0\.5, nan"),
    ({"bond_centroid": [[0.5, 0, 0]]}, r"bond centroid has shape \(1, 3\)"),
]


@pytest.mark.parametrize("changes, message", REFUSED)
def test_bad_descriptions_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        author.build(*described(**changes))


OTHERS = [
    (lambda: author.build(author.Chunks([], np.zeros((0, 3)), [])), "no chunks"),
    (lambda: shapes.grid((2, 0, 2)), r"shape\[1\] is 0"),
    (lambda: shapes.grid((2, 2)), "shape has 2 numbers"),
    (lambda: shapes.grid((2, 2, 2), (1, 0, 1)), r"brick\[1\] is 0"),
    (lambda: shapes.grid((2, 2, 2), (1, NAN, 1)), "brick 1 is nan"),
    (lambda: shapes.grid(anchor=("down",)), "anchor 'down' is no side"),
    (lambda: shapes.grid(pieces=(2, 2, 0)), r"pieces\[2\] is 0"),
    (lambda: shapes.wall(0, 3), r"bricks and courses\[0\] is 0"),
    (lambda: shapes.boxes([[0, 0, 0]], [[1, 1, -1]]), r"box 0 has size"),
    (lambda: author.capacity(), "no assets"),
    (
        lambda: author.pad(shapes.grid((2, 1, 1)), author.Capacity(0, 2, 0, 1)),
        "chunks=2, the capacity has 0",
    ),
    (
        lambda: author.pad(shapes.grid((2, 1, 1)), author.Capacity(2, 2, 0, 0)),
        "bonds=1, the capacity has 0",
    ),
    (
        lambda: author.pad(
            shapes.grid((2, 1, 1)), author.Capacity(2, 2, 0, 1, has_world=True)
        ),
        "nodes=3, the capacity has 2",
    ),
    (
        lambda: author.pad(
            shapes.wall(2, 2), author.Capacity(9, 9, 9, 30, has_world=False)
        ),
        "has_world",
    ),
    (lambda: damage.buffer({"at": jnp.zeros(3)}, 0), "capacity is 0"),
    (
        lambda: fracture.init(shapes.grid((2, 1, 1)), jnp.ones(3)),
        r"bond_health has shape \(3,\)",
    ),
    (
        lambda: fracture.init(shapes.grid((2, 1, 1)), 1.0, jnp.ones((2, 2))),
        r"chunk_health has shape \(2, 2\)",
    ),
    (
        lambda: author.reorder(*described(), [0, 0]),
        "chunk map is no permutation",
    ),
]


@pytest.mark.parametrize("call, message", OTHERS)
def test_bad_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_strict_build_refuses_what_it_would_mend():
    inexact = described(parent=[NO_PARENT, 0], support=[True, True])
    with pytest.raises(ValueError, match=r"chunk 1 \(parent 0\) is a support chunk"):
        author.build(*inexact, strict=True)
    unordered = author.Chunks([1, NO_PARENT], np.zeros((2, 3)), np.ones(2))
    with pytest.raises(ValueError, match="chunk 1 is a root behind a child"):
        author.build(unordered, strict=True)
    built = author.build(unordered)
    assert built.chunk_map.tolist() == [1, 0]


def test_dropped_bonds_are_reported():
    parent = [NO_PARENT, 0, 0]
    bonds = author.Bonds(
        [[0, 1], [1, 2], [2, 1], [1, WORLD]],
        np.tile([[1.0, 0, 0]], (4, 1)),
        np.arange(4.0),
        np.zeros((4, 3)),
    )
    built = author.build(author.Chunks(parent, np.zeros((3, 3)), np.ones(3)), bonds)
    assert built.dropped["non-support"].tolist() == [0]
    assert built.dropped["duplicate"].tolist() == [2]
    assert built.dropped["invalid"].tolist() == []
    assert built.bond_map.tolist() == [-1, 0, -1, 1]
    assert built.asset.bond_area.tolist() == [1.0, 3.0]


def test_normals_point_from_the_first_node_to_the_second():
    bonds = author.Bonds([[1, 0]], [[-1.0, 0, 0]], [1.0], [[0.5, 0, 0]])
    chunk, _ = described()
    built = author.build(chunk, bonds)
    assert built.asset.bond_nodes.tolist() == [[0, 1]]
    assert built.asset.bond_normal.tolist() == [[1.0, 0, 0]]
    kept = author.build(chunk, bonds, orient_normals=False)
    assert kept.asset.bond_normal.tolist() == [[-1.0, 0, 0]]


def test_grid_counts():
    asset = shapes.grid((3, 4, 5), (1.0, 2.0, 3.0))
    assert len(asset.bond_area) == 2 * 4 * 5 + 3 * 3 * 5 + 3 * 4 * 4
    np.testing.assert_allclose(asset.chunk_volume, 6.0)
    x = np.abs(np.asarray(asset.bond_normal)[:, 0]) == 1
    np.testing.assert_allclose(np.asarray(asset.bond_area)[x], 6.0)
    np.testing.assert_allclose(asset.chunk_centroid.mean(0), [0, 0, 7.5], atol=1e-5)


@pytest.mark.parametrize("bricks, courses", [(1, 2), (3, 1), (4, 5)])
def test_wall_is_full_and_bonded_half_over_half(bricks, courses):
    asset = shapes.wall(bricks, courses, (0.4, 0.2, 0.2))
    volume = float(asset.chunk_volume.sum())
    np.testing.assert_allclose(volume, bricks * courses * 0.016, rtol=1e-5)
    normal = np.asarray(asset.bond_normal)
    to_world = np.asarray(asset.bond_nodes)[:, 1] == 0
    np.testing.assert_allclose(normal[to_world], np.tile([0, 0, -1], (bricks, 1)))
    flat = (np.abs(normal[:, 2]) == 1) & ~to_world
    # Course upon course, every bed joint is bonded over its whole length.
    area = float(np.asarray(asset.bond_area)[flat].sum())
    np.testing.assert_allclose(area, (courses - 1) * bricks * 0.08, rtol=1e-5)
    assert asset.has_world


def test_tower_is_hollow_and_beam_is_a_chain():
    tower = shapes.tower(4, 3)
    assert len(tower.chunk_volume) == 4 * 8
    assert int((np.asarray(tower.bond_nodes)[:, 1] == 0).sum()) == 8
    beam = shapes.beam(5)
    assert len(beam.bond_area) == 5
    assert int((np.asarray(beam.bond_nodes)[:, 1] == 0).sum()) == 1


def test_hierarchy_of_shapes():
    asset = shapes.grid((2, 2, 1), root=True, pieces=(2, 1, 3))
    assert (asset.depth, asset.height) == (1, 1)
    assert len(asset.chunk_volume) == 1 + 4 + 24
    children = asset.chunk_volume[5:].reshape(4, 6).sum(1)
    np.testing.assert_allclose(children, asset.chunk_volume[1:5], rtol=1e-6)
    centers = np.asarray(asset.chunk_centroid[5:]).reshape(4, 6, 3).mean(1)
    np.testing.assert_allclose(centers, asset.chunk_centroid[1:5], atol=1e-6)
    np.testing.assert_allclose(asset.chunk_volume[0], 4.0)


def test_box_inertia():
    asset = shapes.grid((1, 1, 1), (1.0, 2.0, 3.0))
    expected = np.diag([4 + 9, 1 + 9, 1 + 4]) * 6 / 12
    np.testing.assert_allclose(asset.chunk_inertia[0], expected, rtol=1e-6)


def test_moments_of_a_grid_are_those_of_the_box():
    asset = shapes.grid((2, 3, 4), (1.0, 1.0, 1.0))
    asset = asset.replace(chunk_centroid=asset.chunk_centroid + 100.0)
    found = chunks.moments(asset, fracture.init(asset), 2.0)
    expected = 2.0 * 24 / 12 * np.diag([9 + 16, 4 + 16, 4 + 9])
    np.testing.assert_allclose(found.mass[0], 48.0)
    np.testing.assert_allclose(found.center[0], [100.0, 100.0, 102.0], rtol=1e-6)
    # A hundred metres from the origin: the error of a one-pass sum would be 5e-2.
    np.testing.assert_allclose(found.inertia[0], expected, atol=2e-3)


def test_stack_keeps_every_asset():
    assets = [shapes.wall(2, 2), shapes.grid((2, 2, 1), root=True, pieces=(2, 1, 1))]
    batch = author.stack(assets)
    assert batch.has_world
    assert (batch.depth, batch.height) == (1, 1)
    state = jax.vmap(fracture.init)(batch)
    held = jax.vmap(chunks.held)(batch, state)
    assert held.any(axis=1).tolist() == [True, False]
    mass = jax.vmap(chunks.moments, (0, 0, None))(batch, state, 1.0).mass
    # The root and the pieces weigh nothing: the nodes stand for the matter.
    np.testing.assert_allclose(mass.sum(1), [4 * 0.016, 4.0], rtol=1e-5)


def test_an_asset_can_be_built_while_something_is_traced():
    def volume(scale):
        return scale * shapes.wall(2, 2).chunk_volume.sum()

    np.testing.assert_allclose(jax.jit(volume)(2.0), volume(2.0))
