"""Assembly: moved, merged, bonded, coarsened and cut assets by first principles."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy import sparse

from blastjax import author, stress
from blastjax.author import bonds, materials, solids
from blastjax.author.mesh import moments
from blastjax.consistency import refuse_asset
from blastjax.core import NONE, WORLD

shapes = author.shapes
TURN = author.placed((1.0, 2, 3), (0.5, 0.1, -0.6, 0.3), 1.5)
SHEAR = np.array([[1.0, 0.4, 0], [0, 0.7, 0.2], [0.1, 0, 1.3]])


def total(asset):
    """Mass, centre and inertia of the whole at unit density, from its nodes."""
    node = np.asarray(asset.element_chunk[: len(asset.span_node)])
    node = node[node >= 0]
    volume = np.asarray(asset.chunk_volume, float)[node]
    place = np.asarray(asset.chunk_centroid, float)[node]
    center = volume @ place / volume.sum()
    arm = place - center
    spin = np.asarray(asset.chunk_inertia, float)[node].sum(axis=0)
    spin += np.einsum("c,ci,ci->", volume, arm, arm) * np.eye(3)
    return volume.sum(), center, spin - np.einsum("c,ci,cj->ij", volume, arm, arm)


def pieces(asset):
    """How many pieces the bonds leave."""
    nodes, count = np.asarray(asset.bond_nodes), len(asset.span_node)
    graph = sparse.coo_matrix((np.ones(len(nodes)), nodes.T), (count, count))
    return sparse.csgraph.connected_components(graph)[0]


def same(one, other, tolerance=1e-5):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)


def test_describe_and_build_are_inverse():
    asset = shapes.wall(2, 2, root=True, pieces=(2, 1, 1))
    same(author.build(*author.describe(asset)).asset, asset, 0)
    padded = author.pad(asset, author.Capacity(30, 20, 20, 30, True, 1, 1))
    with pytest.raises(ValueError, match="padded"):
        author.describe(padded)
    with pytest.raises(ValueError, match="a batch"):
        author.describe(author.stack([asset, asset]))


@pytest.mark.parametrize(
    "matrix",
    [TURN, SHEAR, author.mirrored((1, 2, 0.5), (0, 0, 1)), np.diag([2.0, 1, -1])],
    ids=["turn", "shear", "mirror", "axes"],
)
def test_transform_moves_meshes_and_moments_alike(matrix):
    arch = shapes.arch(voussoirs=5)
    found = author.transform(arch, matrix).whole
    refuse_asset(found.asset)
    for chunk, mesh in enumerate(found.meshes):
        volume, centroid, inertia = moments(mesh)
        np.testing.assert_allclose(found.asset.chunk_volume[chunk], volume, rtol=1e-5)
        np.testing.assert_allclose(found.asset.chunk_centroid[chunk], centroid, 0, 1e-5)
        np.testing.assert_allclose(
            found.asset.chunk_inertia[chunk], inertia, atol=1e-5 * np.abs(inertia).max()
        )
    again = bonds.between(found.meshes)
    _, moved = author.describe(found.asset)
    inner = (moved.chunks != WORLD).all(axis=1)
    np.testing.assert_array_equal(moved.chunks[inner], again.chunks)
    np.testing.assert_allclose(moved.area[inner], again.area, rtol=1e-5)
    np.testing.assert_allclose(moved.normal[inner], again.normal, atol=1e-5)
    np.testing.assert_allclose(moved.centroid[inner], again.centroid, atol=1e-4)
    back = author.transform(found, np.linalg.inv(matrix)).whole
    same(back.asset.replace(chunk_size=arch.asset.chunk_size), arch.asset, 3e-5)


def test_boxes_stay_boxes_along_the_axes():
    beam = shapes.beam(2, (1.0, 2.0, 3.0))
    quarter = author.placed(quaternion=(1, 0, 0, 1))
    found = author.transform(beam, quarter).whole
    np.testing.assert_allclose(found.chunk_size, [[1, 0.5, 1.5]] * 2, rtol=1e-6)
    tilted = author.transform(beam, author.placed(quaternion=(1, 0.2, 0, 0.1))).whole
    box = 8 * np.prod(tilted.chunk_size, axis=1)
    np.testing.assert_allclose(box, tilted.chunk_volume, rtol=1e-5)


def test_merge_keeps_all_and_bonds_what_touches():
    tower = shapes.tower(2, 2, anchor=("z-",))
    slab = shapes.grid((2, 2, 1), root=True)
    lift = author.placed((0, 0, 2.0))
    result = author.merge([tower, slab], [np.eye(4), lift], touching=True, gap=1e-4)
    whole = result.whole
    refuse_asset(whole)
    assert whole.has_world and whole.height == 1
    assert len(whole.chunk_volume) == 8 + 5
    assert len(whole.bond_area) == len(tower.bond_area) + len(slab.bond_area) + 4
    assert (result.bond_map >= 0).all()
    place = np.concatenate(
        [tower.chunk_centroid, slab.chunk_centroid + np.array([[0, 0, 2]])]
    )
    np.testing.assert_allclose(whole.chunk_centroid[result.chunk_map], place)
    old = np.asarray(tower.bond_area)
    np.testing.assert_allclose(whole.bond_area[result.bond_map[: len(old)]], old)
    assert pieces(whole) == 1
    assert pieces(author.merge([tower, slab], [np.eye(4), lift]).whole) == 2


def test_merge_takes_new_bonds_by_numbers_counted_through():
    beam = shapes.beam(2, anchor=())
    new = author.Bonds(
        [[1, 2], [3, WORLD]], [[1.0, 0, 0]] * 2, [0.5, 2], np.zeros((2, 3))
    )
    result = author.merge([beam, beam], [np.eye(3), TURN], bonds=new)
    pair = result.whole.bond_nodes[result.bond_map[2]]
    ends = np.asarray(result.whole.element_chunk)[np.asarray(pair)]
    assert sorted(ends) == sorted(result.chunk_map[[1, 2]])
    np.testing.assert_allclose(result.whole.bond_area[result.bond_map[2]], 0.5)
    mass, _, _ = total(result.whole)
    np.testing.assert_allclose(mass, 2 * (1 + 1.5**3), rtol=1e-5)


def test_merge_of_meshes_keeps_them_in_order():
    arch, drum = shapes.arch(voussoirs=3), shapes.column(drums=2)
    result = author.merge([arch, drum], [np.eye(4), TURN])
    whole = result.whole
    for chunk, mesh in enumerate(whole.meshes):
        np.testing.assert_allclose(
            whole.asset.chunk_volume[chunk], moments(mesh)[0], rtol=1e-5
        )
    bare = author.merge([arch, drum.asset]).whole
    assert not isinstance(bare, author.Destructible)


def test_unite_makes_connected_clusters_of_the_wanted_size():
    arch = shapes.arch(voussoirs=16)
    result = author.unite(arch, 4, levels=1)
    asset = result.whole.asset
    refuse_asset(asset)
    assert asset.height == 1
    parents = np.flatnonzero(np.asarray(asset.chunk_children))
    assert len(parents) == 4
    for parent in parents:
        members = np.flatnonzero(np.asarray(asset.chunk_parent) == parent)
        assert 2 <= len(members) <= 6
        # In an arch, connected means consecutive.
        assert np.ptp(np.sort(np.flatnonzero(np.isin(result.chunk_map, members)))) == (
            len(members) - 1
        )
        volume, centroid, inertia = moments(result.whole.meshes[parent])
        np.testing.assert_allclose(asset.chunk_volume[parent], volume, rtol=1e-5)
        np.testing.assert_allclose(asset.chunk_centroid[parent], centroid, atol=1e-5)
        np.testing.assert_allclose(asset.chunk_inertia[parent], inertia, atol=1e-6)
    for a, b in zip(total(asset), total(arch.asset), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


def test_unite_goes_on_to_one_root_but_never_over_a_gap():
    asset = author.unite(shapes.grid((4, 4, 2)), 4).whole
    assert int((np.asarray(asset.chunk_parent) < 0).sum()) == 1
    # 32 chunks, 8 clusters, 2, 1.
    assert asset.height == 3 and len(asset.chunk_volume) == 32 + 8 + 2 + 1
    two = author.merge(
        [shapes.beam(3, anchor=()), shapes.beam(3, anchor=())],
        [np.eye(4), author.placed((0, 9, 0))],
    ).whole
    apart = author.unite(two, 8).whole
    assert int((np.asarray(apart.chunk_parent) < 0).sum()) == 2


def test_delete_below_makes_a_leaf_with_the_bonds_of_its_support():
    asset = author.unite(shapes.grid((4, 1, 1), anchor=("z-",)), 2, levels=1).whole
    roots = np.flatnonzero(np.asarray(asset.chunk_parent) < 0)
    result = author.delete(asset, roots[:1])
    found = result.whole
    refuse_asset(found)
    assert len(found.chunk_volume) == len(asset.chunk_volume) - 2
    kept = result.chunk_map[roots[0]]
    assert found.chunk_element[kept] >= 0 and found.chunk_children[kept] == 0
    # Two bonds to the world became one of both areas; one to the other half stays.
    np.testing.assert_allclose(np.sort(found.bond_area), [1, 1, 1, 1, 2])
    for a, b in zip(total(found), total(asset), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
    assert (result.bond_map == NONE).sum() == 2


def test_delete_itself_takes_the_matter_away():
    wall = shapes.wall(2, 2, (1.0, 1, 1), root=True, pieces=(2, 1, 1))
    result = author.delete(wall, [1], itself=True)
    found = result.whole
    refuse_asset(found)
    assert result.chunk_map[1] == NONE
    assert len(found.chunk_volume) == len(wall.chunk_volume) - 3
    np.testing.assert_allclose(found.chunk_volume[0], 3.0)
    gone = np.asarray(wall.bond_nodes == wall.chunk_element[1]).any(axis=1)
    np.testing.assert_array_equal(result.bond_map == NONE, gone)
    piece = int(np.argmax(np.asarray(wall.chunk_parent) == 2))
    part = author.delete(wall, [piece], itself=True).whole
    np.testing.assert_allclose(part.chunk_volume[0], 4 - 0.5)
    with pytest.raises(ValueError, match="nothing would be left"):
        author.delete(wall, [0], itself=True)
    with pytest.raises(ValueError, match=r"chunk \[0\] is 99"):
        author.delete(wall, [99])


def test_delete_with_meshes():
    arch = author.unite(shapes.arch(voussoirs=8), 4, levels=1).whole
    leaf = int(np.argmax(np.asarray(arch.asset.chunk_parent) >= 0))
    for whole in (
        author.delete(arch, [leaf], itself=True).whole,
        author.delete(arch, [0]).whole,
    ):
        for chunk, mesh in enumerate(whole.meshes):
            np.testing.assert_allclose(
                whole.asset.chunk_volume[chunk], moments(mesh)[0], rtol=1e-5
            )


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda a: author.merge([]), "no parts"),
        (lambda a: author.merge([a], []), "0 matrices for 1 parts"),
        (lambda a: author.transform(a, np.ones((3, 3))), "singular"),
        (lambda a: author.transform(a, np.ones((2, 3))), r"shape \(2, 3\)"),
        (lambda a: author.transform(a, np.ones((4, 4))), "row 3 is"),
        (lambda a: author.placed(quaternion=(0, 0, 0, 0)), "no rotation"),
        (lambda a: author.mirrored((0, 0, 0)), "needs a direction"),
        (lambda a: author.unite(a, 1), "at least 2 and 1"),
    ],
)
def test_bad_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(shapes.beam(2))


def test_pieces_from_elsewhere_become_a_destructible():
    meshes = [solids.box(np.array([2.02 * i, 0, 1]), np.ones(3)) for i in range(3)]
    found = solids.assemble(
        meshes,
        bonds.between(meshes, gap=0.05),
        world=[bonds.to_plane(meshes, (0, 0, 0), (0, 0, -1))],
    )
    assert found.asset.has_world and len(found.asset.bond_area) == 5
    np.testing.assert_allclose(found.asset.chunk_inertia[0], np.eye(3) * 16 / 3, 1e-5)


@pytest.mark.parametrize("name", sorted(materials.PRESETS))
def test_materials_fit_limits_and_healths(name):
    material = materials.PRESETS[name]
    found = stress.Limits(**materials.limits(material, elastic=0.5))
    assert found.tension_fatal == material.tension == 2 * found.tension_elastic
    assert material.source and material.tension <= material.compression
    beam = shapes.beam(2, (1.0, 0.5, 0.5))
    np.testing.assert_allclose(materials.area_health(beam), beam.bond_area)
    force = materials.force_health(beam, material, mode="shear")
    np.testing.assert_allclose(force, 0.25 * material.shear, rtol=1e-6)


def test_bad_materials_are_refused():
    with pytest.raises(ValueError, match=r"density is -1"):
        dataclasses.replace(materials.ICE, density=-1)
    with pytest.raises(ValueError, match="mode is 'bend'"):
        materials.force_health(shapes.beam(2), materials.ICE, mode="bend")
    with pytest.raises(ValueError, match="elastic is 2"):
        materials.limits(materials.ICE, elastic=2)
