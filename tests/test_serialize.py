"""Files: round trips, damage, foreign files, and content that cannot be."""

import dataclasses
import io
import json
import pathlib
import pickle
import random
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from blastjax import author, consistency, fracture, serialize
from blastjax.author.mesh import Destructible, Mesh
from blastjax.consistency import refuse_asset, refuse_meshes, refuse_state
from blastjax.core import Asset, State

CUBE = Mesh(
    np.array([[x, y, z] for x in (0, 1.0) for y in (0, 1.0) for z in (0, 1.0)]),
    np.array(
        [
            *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
            *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
        ],
        np.int32,
    ),
)


def hierarchy():
    return author.shapes.wall(2, 2, root=True, pieces=(2, 1, 1))


def padded():
    asset = author.shapes.grid((2, 1, 1), pieces=(2, 1, 1))
    return author.pad(asset, author.Capacity(9, 5, 6, 4, True, 1, 1))


def broken(asset):
    """A state with healths of all kinds, and its last node an actor of its own."""
    state = fracture.init(asset, jnp.arange(1.0, 1 + len(asset.bond_area)))
    chunk = np.asarray(asset.element_chunk[: len(state.dirty)])
    last = int(np.flatnonzero(chunk >= 0)[-1])
    cut = jnp.any(asset.bond_nodes == last, axis=1)
    return state.replace(
        actor=state.actor.at[last].set(last), bond_intact=state.bond_intact & ~cut
    )


def same(one, other):
    leaves, others = jax.tree.leaves(one), jax.tree.leaves(other)
    return jax.tree.structure(one) == jax.tree.structure(other) and all(
        a.dtype == b.dtype and a.shape == b.shape and bool(jnp.all(a == b))
        for a, b in zip(leaves, others, strict=True)
    )


@pytest.mark.parametrize("make", [hierarchy, padded])
def test_asset_and_state_come_back_bit_for_bit(make, tmp_path):
    asset = make()
    state = broken(asset)
    path = serialize.save(tmp_path / "a.npz", asset, state)
    found = serialize.load(path)
    assert same(found.asset, asset) and same(found.state, state)
    assert found.meshes is None
    with pytest.raises(ValueError, match="no meshes"):
        _ = found.destructible
    again = serialize.save(tmp_path / "b.npz", asset, state)
    assert path.read_bytes() == again.read_bytes()
    alone = serialize.load(serialize.save(tmp_path / "s.npz", state))
    assert alone.asset is None and same(alone.state, state)


def test_meshes_come_back(tmp_path):
    asset = author.shapes.grid((2, 1, 1))
    inner = Mesh(CUBE.vertices + 1, CUBE.faces, np.arange(12) < 2)
    path = serialize.save(tmp_path / "d.npz", Destructible(asset, (CUBE, inner)))
    found = serialize.load(path).destructible
    for mesh, old in zip(found.meshes, (CUBE, inner), strict=True):
        np.testing.assert_array_equal(mesh.vertices, old.vertices)
        np.testing.assert_array_equal(mesh.faces, old.faces)
        assert mesh.faces.dtype == old.faces.dtype
    assert found.meshes[0].interior is None
    np.testing.assert_array_equal(found.meshes[1].interior, inner.interior)


def test_a_shape_with_meshes_and_levels_comes_back(tmp_path):
    arch = author.unite(author.shapes.arch(voussoirs=6), 3).whole
    path = serialize.save(tmp_path / "a.npz", arch)
    found = serialize.load(path).destructible
    assert same(found.asset, arch.asset)
    for mesh, old in zip(found.meshes, arch.meshes, strict=True):
        np.testing.assert_array_equal(mesh.vertices, old.vertices)
        np.testing.assert_array_equal(mesh.faces, old.faces)


def test_damaged_files_are_refused_or_load_the_same(tmp_path):
    asset = hierarchy()
    state = broken(asset)
    good = serialize.save(tmp_path / "a.npz", asset, state).read_bytes()
    rng = random.Random(0)
    outcomes = {"refused": 0, "same": 0}
    for case in range(200):
        data = bytearray(good)
        if case % 4 == 0:
            del data[rng.randrange(len(data)) :]
        else:
            for _ in range(rng.choice([1, 1, 2, 8])):
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        bad = tmp_path / "bad.npz"
        bad.write_bytes(data)
        try:
            found = serialize.load(bad)
        except ValueError as error:
            assert "bad.npz" in str(error)
            outcomes["refused"] += 1
        else:
            assert same(found.asset, asset) and same(found.state, state)
            outcomes["same"] += 1
    assert sum(outcomes.values()) == 200 and outcomes["refused"] > 150


class Bomb:
    def __reduce__(self):
        return pathlib.Path.touch, (pathlib.Path("/tmp/blastjax-was-here"),)


def foreign(tmp_path, name):
    path = tmp_path / name
    if name == "pickle.npz":
        path.write_bytes(pickle.dumps(Bomb()))
    elif name == "objects.npz":
        np.savez(path, header=np.array([Bomb()], object))
    elif name == "other.npz":
        np.savez(path, a=np.zeros(3))
    elif name == "squeezed.npz":
        np.savez_compressed(path, a=np.zeros(300000))
    elif name == "mesh.obj":
        path.write_text("v 0 0 0\n")
    else:
        path.write_bytes(b"")
    return path


FOREIGN = [
    ("pickle.npz", "no readable file"),
    ("objects.npz", "not of ours"),
    ("other.npz", "no header"),
    ("squeezed.npz", "compressed"),
    ("mesh.obj", "no readable file"),
    ("empty.npz", "no readable file"),
]


@pytest.mark.parametrize("name, message", FOREIGN)
def test_foreign_files_are_refused_and_not_run(name, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        serialize.load(foreign(tmp_path, name))
    assert not pathlib.Path("/tmp/blastjax-was-here").exists()


def forged(path, out, **changes):
    """Write the file again with other members and a checksum that fits them."""
    with zipfile.ZipFile(path) as archive:
        members = {n.removesuffix(".npy"): archive.read(n) for n in archive.namelist()}
    header = json.loads(np.load(io.BytesIO(members.pop("header"))).item())
    for name, value in changes.items():
        name = name.replace("__", ".")
        if name.startswith("header."):
            header[name.removeprefix("header.")] = value
        elif value is None:
            del members[name]
        else:
            members[name] = serialize._npy(np.asarray(value))
    header["sha256"] = serialize._checksum(members)
    members["header"] = serialize._npy(np.array(json.dumps(header).encode()))
    out.write_bytes(serialize._zip(members))
    return out


FORGED = [
    ({"header__version": 2}, "version 2 of the format"),
    ({"header__format": "blender"}, "another format"),
    ({"asset__chunk_volume": None}, "lacks asset.chunk_volume"),
    ({"asset__colour": np.zeros(3)}, "does not know"),
    ({"asset__depth": np.array(True)}, "must be one int"),
    ({"asset__has_world": np.array(1)}, "must be one bool"),
    ({"asset__chunk_parent": np.full(16, 99, np.int32)}, r"chunk_parent\[0\] is 99"),
    ({"asset__bond_area": np.zeros(2, np.float32)}, "axis B must have length"),
]


@pytest.mark.parametrize("changes, message", FORGED)
def test_forged_files_are_refused(changes, message, tmp_path):
    path = serialize.save(tmp_path / "a.npz", hierarchy())
    with pytest.raises(ValueError, match=message):
        serialize.load(forged(path, tmp_path / "f.npz", **changes))


def test_too_large_a_file_is_not_read(tmp_path):
    path = serialize.save(tmp_path / "a.npz", hierarchy())
    with pytest.raises(ValueError, match="raise max_bytes, now 100"):
        serialize.load(path, max_bytes=100)


def test_what_is_wrong_is_not_saved(tmp_path):
    asset = hierarchy()
    batch = author.stack([asset, asset])
    with pytest.raises(ValueError, match="of a batch, take one"):
        serialize.save(tmp_path / "a.npz", batch)
    with pytest.raises(ValueError, match="is traced"):
        jax.jit(lambda a: serialize.save(tmp_path / "a.npz", a) and 1)(asset)
    other = fracture.init(author.shapes.grid((2, 1, 1)))
    with pytest.raises(ValueError, match="must have length"):
        serialize.save(tmp_path / "a.npz", asset, other)
    with pytest.raises(ValueError, match="there are 1 meshes"):
        serialize.save(tmp_path / "a.npz", Destructible(asset, (CUBE,)))
    assert not list(tmp_path.iterdir())


# A field of an asset, an index in it, and a value that cannot be there.
WRONG = [
    ("chunk_parent", 1, 1, "own ancestor"),
    ("chunk_parent", 2, 3, "chunk_children"),
    ("chunk_children", 0, 3, "chunk_children"),
    ("chunk_centroid", (1, 0), np.nan, "centroid 1"),
    ("chunk_volume", 2, -1, "chunk 2 has volume"),
    ("chunk_size", (1, 1), -1, "chunk 1 has size"),
    ("chunk_inertia", (1, 0, 1), 5, "not symmetric"),
    ("chunk_element", 0, 3, "chunk_element"),
    ("chunk_span", (1, 1), 4, "chunk_span"),
    ("span_node", 0, 2, "span_node"),
    ("element_chunk", 0, 3, "must be the world"),
    ("element_chunk", 2, -2, "only node 0 can be the world"),
    ("element_parent", -1, 1, "element_parent"),
    ("bond_nodes", 1, [4, 1], "lower is first"),
    ("bond_nodes", (0, 1), 77, "bond_nodes"),
    ("bond_area", 1, -1, "bond 1 has area"),
    ("bond_normal", (1, 1), np.inf, "bond normal 1"),
]


@pytest.mark.parametrize("field, index, value, message", WRONG)
def test_inconsistent_assets_are_refused(field, index, value, message):
    asset = hierarchy()
    refuse_asset(asset)
    array = np.array(getattr(asset, field))
    assert np.any(array[index] != value)
    array[index] = value
    with pytest.raises(ValueError, match=message):
        refuse_asset(asset.replace(**{field: array}))


@pytest.mark.parametrize("field, value", [("depth", 0), ("height", 0), ("depth", -1)])
def test_static_facts_must_not_understate(field, value):
    with pytest.raises(ValueError, match=field):
        refuse_asset(hierarchy().replace(**{field: value}))


def test_the_sweep_must_be_that_of_the_bonds(tmp_path):
    asset = hierarchy()
    away = jnp.asarray(asset.chunk_centroid)[::-1]
    refuse_asset(asset.replace(sweep=None))
    # Where its chunks are changes the best way, not whether this is one.
    refuse_asset(asset.replace(chunk_centroid=away))
    for stale in (asset.sweep.at[0].add(1), asset.sweep[1:], asset.sweep.at[-1].add(1)):
        with pytest.raises(ValueError, match="sweep"):
            refuse_asset(asset.replace(sweep=stale))
    path = serialize.save(tmp_path / "asset.npz", asset.replace(sweep=None))
    np.testing.assert_array_equal(serialize.load(path).asset.sweep, asset.sweep)


def test_inconsistent_states_are_refused():
    asset = padded()
    state = fracture.init(asset)
    refuse_state(state, asset)
    for changes, message in [
        ({"actor": state.actor.at[2].set(99)}, r"actor\[2\] is 99"),
        ({"actor": state.actor.at[1].set(2)}, "not the smallest"),
        ({"actor": state.actor.at[4].set(4)}, "no chunk is there"),
        ({"bond_health": state.bond_health.at[0].set(jnp.nan)}, "bond_health"),
        ({"bond_intact": jnp.ones_like(state.bond_intact)}, "is padding"),
        ({"dirty": state.dirty.astype(jnp.int32)}, "dirty has type int32"),
    ]:
        with pytest.raises(ValueError, match=message):
            refuse_state(state.replace(**changes), asset)


def test_inconsistent_meshes_are_refused():
    refuse_meshes([CUBE], 1)
    for mesh, message in [
        (Mesh(CUBE.vertices * np.nan, CUBE.faces), "vertex 0"),
        (Mesh(CUBE.vertices, CUBE.faces + 1), "face 2"),
        (Mesh(CUBE.vertices, CUBE.faces.astype(float)), "faces of shape"),
        (Mesh(CUBE.vertices, CUBE.faces, np.zeros(3, bool)), "interior"),
    ]:
        with pytest.raises(ValueError, match=message):
            refuse_meshes([mesh])


def test_every_field_has_a_shape():
    for kind, shapes in (
        (Asset, consistency._ASSET_SHAPES),
        (State, consistency._STATE_SHAPES),
    ):
        fields = dataclasses.fields(kind)
        names = {f.name for f in fields if not f.metadata.get("static")}
        assert set(shapes) == names - set(serialize._DERIVED)
