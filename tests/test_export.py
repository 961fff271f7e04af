"""Export: what other programs read is what was there."""

import mujoco
import numpy as np
import pytest

from blastjax import author, chunks, damage, export, fracture
from blastjax.author import affine, shapes
from blastjax.author.mesh import moments

trimesh = pytest.importorskip("trimesh")


@pytest.fixture(scope="module")
def broken():
    """An arch in several pieces, one of them held, and coarser chunks above."""
    whole = author.unite(shapes.arch(voussoirs=8), 2, levels=1).whole
    state = fracture.init(whole.asset)
    blow = damage.falloff(whole.asset, state, np.array([0.9, 0, 2.0]), 2.0, 1.2, 1.3)
    state, _ = fracture.apply(whole.asset, state, blow)
    state, _ = fracture.split(whole.asset, state)
    return whole, state, np.flatnonzero(np.asarray(chunks.active(whole.asset, state)))


def test_pieces_are_the_visible_chunks_of_actors(broken):
    whole, state, labels = broken
    found = export.pieces(whole, state)
    assert list(found) == labels.tolist() and len(labels) > 2
    weight = chunks.moments(whole.asset, state, 1.0)
    for label, mesh in found.items():
        volume, centroid, _ = moments(mesh)
        np.testing.assert_allclose(volume, weight.mass[label], rtol=1e-5)
        np.testing.assert_allclose(centroid, weight.center[label], atol=1e-5)
    assert list(export.pieces(whole)) == [0]


@pytest.mark.parametrize("kind", [".glb", ".gltf"])
def test_gltf_has_a_node_for_each_actor_and_y_up(broken, kind, tmp_path):
    whole, state, labels = broken
    (path,) = export.save_pieces(tmp_path / f"a{kind}", whole, state)
    scene = trimesh.load_scene(path)
    assert set(scene.geometry) == {f"actor{n}" for n in labels}
    for label, mesh in export.pieces(whole, state).items():
        matrix, name = scene.graph[f"actor{label}"]
        seen = scene.geometry[name].copy().apply_transform(matrix).bounds
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        np.testing.assert_allclose(seen[0], [low[0], low[2], -high[1]], atol=1e-6)
        np.testing.assert_allclose(seen[1], [high[0], high[2], -low[1]], atol=1e-6)


def test_obj_has_an_object_for_each_actor(broken, tmp_path):
    whole, state, labels = broken
    (path,) = export.save_pieces(tmp_path / "a.obj", whole, state)
    lines = path.read_text().splitlines()
    named = {line[2:] for line in lines if line.startswith(("o ", "g "))}
    assert named == {f"actor{n}" for n in labels}
    volume = trimesh.load_mesh(path, process=False).volume
    np.testing.assert_allclose(volume, whole.asset.chunk_volume[-8:].sum(), rtol=1e-5)


def test_stl_has_a_file_for_each_actor_at_its_pose(broken, tmp_path):
    whole, state, labels = broken
    count = len(whole.asset.element_chunk)
    turn = np.tile([1.0, 0, 0, 1], (count, 1))
    rest = np.asarray(chunks.element_values(whole.asset, whole.asset.chunk_centroid))
    matrix = affine.placed((0, 0, 5), turn[0])
    poses = rest @ matrix[:3, :3].T + matrix[:3, 3], turn
    paths = export.save_pieces(tmp_path / "a.stl", whole, state, poses=poses)
    assert [p.name for p in paths] == [f"a_actor{n}.stl" for n in labels]
    for path, mesh in zip(paths, export.pieces(whole, state).values(), strict=True):
        moved = mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]
        seen = trimesh.load_mesh(path).bounds
        np.testing.assert_allclose(seen[0], moved.min(axis=0), atol=1e-5)
        np.testing.assert_allclose(seen[1], moved.max(axis=0), atol=1e-5)


@pytest.mark.parametrize("boxes", [False, True])
def test_mjcf_compiles_and_weighs_the_same(broken, boxes, tmp_path):
    whole, state, labels = broken
    asset = whole.asset
    path = export.save_mjcf(
        tmp_path / "scene", asset if boxes else whole, state, density=2000.0
    )
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    weight = chunks.moments(asset, state, 2000.0)
    held = np.asarray(chunks.held(asset, state))
    assert model.nbody == 1 + len(labels)
    assert model.njnt == int((~held[labels]).sum())
    for label in labels:
        body = model.body(f"actor{label}")
        np.testing.assert_allclose(body.mass, weight.mass[label], rtol=1e-6)
        np.testing.assert_allclose(data.xipos[body.id], weight.center[label], atol=1e-6)
        turn = data.ximat[body.id].reshape(3, 3)
        tensor = turn @ np.diag(body.inertia) @ turn.T
        np.testing.assert_allclose(tensor, weight.inertia[label], rtol=1e-5, atol=1e-3)
    support = np.asarray(asset.element_chunk)
    for chunk in support[support >= 0]:
        geom = model.geom(f"chunk{chunk}")
        center = asset.chunk_centroid[chunk]
        np.testing.assert_allclose(data.geom_xpos[geom.id], center, atol=1e-5)


def test_bad_arguments_are_refused(broken, tmp_path):
    whole, state, _ = broken
    with pytest.raises(ValueError, match="must end in one of"):
        export.save_pieces(tmp_path / "a.fbx", whole, state)
    with pytest.raises(ValueError, match="poses have shapes"):
        export.save_mjcf(
            tmp_path, whole, state, poses=(np.zeros((1, 3)), np.zeros((1, 4)))
        )


def test_missing_trimesh_names_the_extra(broken, monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "trimesh", None)
    with pytest.raises(ImportError, match=r"blastjax\[geometry\]"):
        export.save_pieces(tmp_path / "a.glb", broken[0])
