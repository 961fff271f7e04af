"""Cuts: what the pieces fill and share, bad meshes, hierarchies, seeds."""

import numpy as np
import pytest
import trimesh

from blastjax.author import bonds, cut
from blastjax.author.cut import contacts, crossings, geometry
from blastjax.author.mesh import Mesh, moments
from tests import solids

# Sums of many areas and volumes in float64; the bars are 1e-6 and 1e-9.
EXACT = 1e-12


@pytest.fixture(scope="module")
def box():
    return cut.solid(solids.box())


@pytest.fixture(scope="module")
def nested(box):
    tree = cut.voronoi(box, cut.uniform(box, 5, seed=1))
    return cut.voronoi(tree, cut.uniform(tree, 3, seed=2))


def holds(tree, result=None):
    """Return the figures of a cut after checking what must hold of any."""
    result = cut.destructible(tree) if result is None else result
    found = solids.figures(tree, result)
    for name in ("volume", "overlap", "sides", "gap"):
        assert found[name] < EXACT, (name, found[name])
    assert found["unbonded"] < 1e-9
    assert found["parts"] == found["solid parts"]
    asset = result.destructible.asset
    np.testing.assert_allclose(
        np.linalg.norm(asset.bond_normal, axis=1), 1.0, rtol=1e-5
    )
    return found


@pytest.mark.parametrize("name", ["tube", "vase", "hollow", "comb", "f_knuckle.obj"])
def test_voronoi_fills_the_solid(name):
    tree, result = solids.voronoi(solids.ALL[name](), 12)
    holds(tree, result)
    assert solids.same(result, solids.voronoi(solids.ALL[name](), 12)[1])


def test_chunks_have_the_moments_of_their_meshes(nested):
    result = cut.destructible(nested, dtype="float32")
    asset, meshes = result.destructible.asset, result.destructible.meshes
    for i, mesh in enumerate(meshes):
        volume, center, inertia = moments(mesh)
        np.testing.assert_allclose(asset.chunk_volume[i], volume, rtol=1e-6)
        np.testing.assert_allclose(asset.chunk_centroid[i], center, atol=1e-6)
        np.testing.assert_allclose(asset.chunk_inertia[i], inertia, atol=1e-6)
    volume = np.asarray(asset.chunk_volume, float)
    for parent in np.flatnonzero(asset.chunk_children):
        own = np.asarray(asset.chunk_parent) == parent
        np.testing.assert_allclose(volume[own].sum(), volume[parent], rtol=1e-6)


PATTERNS = {
    "plane": lambda s: cut.plane(s, (0.1, 0, 0), (1, 1, 0)),
    "slices": lambda s: cut.slices(s, (3, 2, 2), offset=0.6, angle=0.2, seed=4),
    "bricks": lambda s: cut.bricks(s, (0.3, 0.3, 0.13)),
    "radial": lambda s: cut.voronoi(
        s, cut.radial((0, 0, 0), (0, 0, 1), radius=0.5, rings=2, spokes=5)
    ),
    "clustered": lambda s: cut.voronoi(s, cut.clustered(s, 2, 4, seed=1)),
    "stretched": lambda s: cut.voronoi(s, cut.uniform(s, 6), stretch=(1, 1, 4)),
    "lattice": lambda s: cut.voronoi(
        s, np.stack(np.mgrid[-1:2, -1:2, -1:1], axis=-1).reshape(-1, 3) * 0.2
    ),
    "outlines": lambda s: cut.cutout(
        s,
        [
            [(0.1, 0.1), (0.9, 0.1), (0.9, 0.3), (0.1, 0.3), (0.1, 0.1)],
            [(0.4, 0.15), (0.6, 0.15), (0.5, 0.25), (0.4, 0.15)],
            [(0.0, 0.2), (0.1, 0.2)],
        ],
    ),
    "bitmap": lambda s: cut.cutout(
        s, np.add.outer(np.arange(8) ** 2, np.arange(9) ** 2) < 50, smooth=1.0
    ),
    "rough plane": lambda s: cut.plane(
        s, (0, 0, 0), (1, 0, 0), noise=cut.Noise(0.02, 0.3, 2)
    ),
    "rough cells": lambda s: cut.voronoi(
        s, cut.uniform(s, 5, seed=2), noise=cut.Noise(0.02, 0.4)
    ),
}


@pytest.mark.parametrize("name", PATTERNS)
def test_every_pattern_fills_the_solid(box, name):
    tree = PATTERNS[name](box)
    assert len(tree.leaves) > 1
    found = holds(tree)
    assert found["parts"] == 1
    again = cut.destructible(PATTERNS[name](box))
    assert solids.same(cut.destructible(tree), again)


def test_bond_of_a_plane_is_the_section(box):
    found = cut.destructible(cut.plane(box, (0.1, 0, 0), (-2, 0, 0))).contacts
    np.testing.assert_allclose(found.area, [0.6 * 0.4], rtol=EXACT)
    np.testing.assert_allclose(found.centroid, [[0.1, 0, 0]], atol=EXACT)
    # Piece 1 lies behind the plane, seen along its normal.
    np.testing.assert_allclose(found.normal, [[-1, 0, 0]], atol=EXACT)


def test_bonds_across_an_older_cut_are_clipped(box):
    halves = cut.plane(box, (0, 0, 0), (1, 0, 0))
    first = cut.plane(halves, (0, 0.1, 0), (0, 1, 0), pieces=[1])
    both = cut.plane(first, (0, -0.1, 0), (0, 1, 0), pieces=[2])
    found = cut.destructible(both).contacts
    across = np.abs(found.normal[:, 0]) > 0.5
    areas = np.sort(found.area[across])
    np.testing.assert_allclose(areas, [0.08, 0.08, 0.08], rtol=EXACT)
    holds(both)


def test_bricks_lie_in_a_running_bond(box):
    tree = cut.bricks(box, (0.25, 0.6, 0.2))
    assert len(tree.leaves) == 4 + 5
    below = cut.destructible(tree).contacts
    level = np.abs(below.normal[:, 2]) > 0.5
    np.testing.assert_allclose(below.area[level], 0.125 * 0.6, rtol=EXACT)


def test_support_level_is_the_users_choice(nested):
    for level, count in ((0, 1), (1, 5), (2, 15), (9, 15), (None, 15)):
        result = cut.destructible(nested, support_level=level)
        assert result.built.support.sum() == count and result.built.coverage_exact
    coarse = cut.destructible(nested, support_level=1)
    assert coarse.destructible.asset.depth == 1
    fine = cut.destructible(nested)
    assert fine.destructible.asset.height == 2
    # The same faces bound the parents: their shared area is that of their children.
    parent = np.array(nested.parent)[fine.contacts.pieces]
    outer = parent[:, 0] != parent[:, 1]
    np.testing.assert_allclose(
        fine.contacts.area[outer].sum(), coarse.contacts.area.sum(), rtol=1e-9
    )
    with pytest.raises(ValueError, match="support_level is -1"):
        cut.destructible(nested, support_level=-1)


def test_chosen_leaves_are_cut(box):
    tree = cut.plane(box, (0, 0, 0), (1, 0, 0))
    deeper = cut.slices(tree, (1, 3, 1), pieces=[2])
    assert deeper.parent == (-1, 0, 0, 2, 2, 2)
    assert deeper.leaves.tolist() == [1, 3, 4, 5]
    with pytest.raises(ValueError, match="piece 2 was cut already"):
        cut.plane(deeper, (0, 0, 0), (0, 0, 1), pieces=[2])
    with pytest.raises(ValueError, match="there is no piece 9"):
        cut.plane(deeper, (0, 0, 0), (0, 0, 1), pieces=[9])


def test_islands_become_chunks():
    tree = cut.plane(cut.solid(solids.comb()), (0, 0, 0.5), (0, 0, 1))
    assert len(tree.leaves) == 1 + 5
    assert len(cut.destructible(tree).contacts.area) == 5


def test_cavity_stays_in_its_piece():
    solid = cut.solid(solids.hollow())
    corner = cut.plane(solid, (0.4, 0, 0), (1, 0, 0))
    assert len(corner.leaves) == 2
    holds(corner)


def test_world_bonds_are_taken_up(box):
    tree = cut.voronoi(box, cut.uniform(box, 6))
    held = bonds.to_plane(tree.meshes, tree.bounds()[0], (0, 0, -1))
    asset = cut.destructible(tree, world=[held]).destructible.asset
    world = np.asarray(asset.bond_nodes[:, 1]) == 0
    np.testing.assert_allclose(asset.bond_area[world].sum(), 0.6, rtol=1e-6)


def test_noise_is_bounded_and_refuses_to_fold():
    noise = cut.Noise(0.02, 0.3, octaves=3, seed=1)
    points = np.random.default_rng(0).uniform(-1, 1, (1000, 3))
    moved = np.linalg.norm(noise(points), axis=1)
    assert 0.001 < moved.mean() and moved.max() <= 0.02
    with pytest.raises(ValueError, match="is safe"):
        cut.Noise(0.2, 0.3)
    with pytest.raises(ValueError, match="above 0"):
        cut.Noise(0.0, 0.3)


def test_sites_lie_inside_and_follow_the_seed():
    solid = cut.solid(solids.tube())
    for sites in (cut.uniform(solid, 30, seed=5), cut.clustered(solid, 3, 9, seed=5)):
        reach = np.linalg.norm(sites.points[:, :2], axis=1)
        assert (0.3 * np.cos(np.pi / 32) < reach).all() and (reach < 0.5).all()
    a, b, c = (cut.uniform(solid, 30, seed=seed).points for seed in (5, 5, 6))
    assert (a == b).all() and (a != c).any()


def test_bad_sites_and_options_are_refused(box):
    same = np.array([(0, 0, 0), (0.1, 0, 0), (0, 0, 0)], float)
    with pytest.raises(ValueError, match="sites 0 and 2"):
        cut.voronoi(box, same)
    with pytest.raises(ValueError, match="finite"):
        cut.voronoi(box, np.array([(0, 0, 0), (np.nan, 0, 0)]))
    with pytest.raises(ValueError, match="shape"):
        cut.voronoi(box, np.zeros((4, 2)))
    with pytest.raises(ValueError, match="count is 0"):
        cut.uniform(box, 0)
    with pytest.raises(ValueError, match="normal is zero"):
        cut.plane(box, (0, 0, 0), (0, 0, 0))
    with pytest.raises(ValueError, match="slices"):
        cut.slices(box, (0, 1, 1))
    with pytest.raises(ValueError, match="larger size"):
        cut.bricks(box, (1e-4, 1e-4, 1e-4))
    with pytest.raises(ValueError, match="enclose no region"):
        cut.cutout(box, [[(0.2, 0.2), (0.4, 0.2)]])
    with pytest.raises(ValueError, match="parallel"):
        cut.cutout(box, np.eye(4, dtype=int), up=(1, 0, 0))
    with pytest.raises(ValueError, match="positive determinant"):
        cut.voronoi(box, cut.uniform(box, 3), stretch=(1, 0, 1))


def arrays(mesh=None):
    mesh = solids.box() if mesh is None else mesh
    return np.array(mesh.vertices), np.array(mesh.faces)


def test_bad_meshes_are_refused():
    vertices, faces = arrays()
    bad = vertices.copy()
    bad[3, 1] = np.nan
    ball = trimesh.creation.icosphere(2, 0.5)
    opened = np.array(ball.faces)[30:]
    cases = [
        (Mesh(np.zeros((0, 3)), np.zeros((0, 3), int)), "empty"),
        (Mesh(vertices[:3], np.array([[0, 1, 2]])), "1 faces"),
        (Mesh(bad, faces), "vertex 3 is"),
        (Mesh(np.array(ball.vertices), opened), "not watertight"),
        (Mesh(vertices, np.where(faces == 2, 99, faces)), "names vertices"),
        (Mesh(vertices * [1, 1, 0], faces), "no area|no volume|watertight"),
        (Mesh(vertices * 1e9, faces), "give `scale`"),
        (Mesh(vertices * 1e-9, faces), "give `scale`"),
        (object(), "is no mesh"),
        ("no/such/file.stl", "no file"),
    ]
    for mesh, message in cases:
        with pytest.raises(ValueError, match=message):
            cut.solid(mesh)


def test_damaged_files_are_refused(tmp_path):
    path = tmp_path / "a.stl"
    path.write_bytes(b"solid nothing\nfacet normal")
    with pytest.raises(ValueError):
        cut.solid(path)


def test_repairs_are_stated():
    vertices, faces = arrays()
    inside_out = cut.solid(Mesh(vertices, faces[:, ::-1]))
    assert "inside out" in inside_out.warnings[0] and inside_out.volume[0] > 0
    hole = cut.solid(Mesh(vertices, faces[1:]))
    assert "closed holes" in hole.warnings[0]
    np.testing.assert_allclose(hole.volume, 0.24)
    doubled = cut.solid(Mesh(vertices, np.concatenate([faces, faces[:2]])))
    assert "doubled" in doubled.warnings[0]
    turned = np.where(np.arange(len(faces))[:, None] < 3, faces[:, ::-1], faces)
    assert "one side" in cut.solid(Mesh(vertices, turned)).warnings[0]
    with pytest.raises(ValueError, match="needs repair"):
        cut.solid(Mesh(vertices, faces[1:]), repair=False)
    assert "not in metres" in cut.solid(Mesh(vertices * 1e5, faces)).warnings[0]
    np.testing.assert_allclose(
        cut.solid(Mesh(vertices * 1e9, faces), scale=1e-9).volume, 0.24
    )


@pytest.mark.parametrize("size", [2e-5, 9e5])
def test_extreme_units_cut_as_others_do(size):
    vertices, faces = arrays()
    tree = cut.solid(Mesh(vertices * size, faces))
    assert tree.warnings
    tree = cut.voronoi(tree, cut.uniform(tree, 6))
    result = cut.destructible(tree)
    holds(tree, result)
    asset = result.destructible.asset
    assert np.isfinite(asset.chunk_inertia).all()
    assert (np.asarray(asset.chunk_volume) > 0).all()


def test_overlapping_parts_are_united():
    vertices, faces = arrays()
    both = Mesh(
        np.concatenate([vertices, vertices + np.array([0.5, 0.1, 0.05])]),
        np.concatenate([faces, faces + len(vertices)]),
    )
    assert len(crossings.find(both)) > 0
    united = cut.solid(both)
    assert "united 2 overlapping parts" in united.warnings[0]
    np.testing.assert_allclose(united.volume, 0.48 - 0.5 * 0.5 * 0.35, rtol=1e-9)
    with pytest.raises(ValueError, match="intersects itself"):
        cut.solid(both, repair=False)


def test_a_surface_through_itself_is_refused():
    vertices, faces = arrays(trimesh.creation.capsule(1.0, 0.3, count=(8, 8)))
    top = vertices[:, 2] > vertices[:, 2].mean()
    # The upper end is pushed through the side of the lower.
    vertices[top] -= [0.25, 0, 1.2]
    with pytest.raises(ValueError, match="intersects itself"):
        cut.solid(Mesh(vertices, faces))


def test_touching_faces_do_not_cross():
    assert len(crossings.find(solids.comb())) == 0


def test_contacts_of_nothing():
    found = contacts.find(
        np.zeros((0, 3, 3)), np.zeros(0, int), np.zeros(0, int), scale=1.0
    )
    assert found.pieces.shape == (0, 2) and found.sides.shape == (0, 2)


def test_missing_library_names_the_extra(monkeypatch):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(geometry.importlib, "import_module", missing)
    with pytest.raises(ImportError, match=r"blastjax\[geometry\]"):
        geometry.need("manifold3d")


@pytest.mark.slow
def test_a_million_triangles():
    ball = trimesh.creation.icosphere(8, 0.5)
    assert len(ball.faces) > 1_000_000
    tree = cut.solid(ball)
    assert "not searched for crossing faces" in tree.warnings[0]
    tree = cut.voronoi(tree, cut.uniform(tree, 8))
    assert abs(tree.volume[tree.leaves].sum() / tree.volume[0] - 1) < EXACT
    assert len(cut.destructible(tree).contacts.area) > 8


@pytest.mark.slow
@pytest.mark.parametrize("name", solids.ALL)
def test_all_solids(name):
    holds(*solids.voronoi(solids.ALL[name](), 64))
