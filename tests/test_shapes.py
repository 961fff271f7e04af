"""Ready-made shapes: volumes from formulas, bonds, and that they are in one piece."""

import numpy as np
import pytest
from scipy import sparse, spatial

from blastjax import author
from blastjax.author import bonds, shapes
from blastjax.author.mesh import moments
from blastjax.consistency import refuse_asset, refuse_meshes
from blastjax.core import WORLD

# A shape, its pieces, bonds between them, bonds to the world.
SOLIDS = {
    "arch": (lambda: shapes.arch(), 11, 10, 2),
    "flat arch": (lambda: shapes.arch(rise=0.5, voussoirs=7), 7, 6, 2),
    "free arch": (lambda: shapes.arch(voussoirs=4, anchor=False), 4, 3, 0),
    "dome": (lambda: shapes.dome(rings=3, segments=8), 25, 24 + 16 + 8, 8),
    "oculus": (lambda: shapes.dome(rings=2, segments=6, oculus=True), 12, 12 + 6, 6),
    "column": (lambda: shapes.column(drums=4), 4, 3, 1),
    "sectors": (lambda: shapes.column(drums=2, sectors=4), 8, 8 + 4, 4),
    "bridge": (lambda: shapes.bridge(1, voussoirs=5), 12 + 15, 38, 2),
    "half circles": (lambda: shapes.bridge(2, rise=2.0, voussoirs=5), 45, 68, 3),
}


@pytest.fixture(scope="module", params=list(SOLIDS))
def built(request):
    make, *counts = SOLIDS[request.param]
    return make(), counts


def one_piece(asset):
    nodes = np.asarray(asset.bond_nodes)
    count = len(asset.span_node)
    graph = sparse.coo_matrix((np.ones(len(nodes)), nodes.T), (count, count))
    return sparse.csgraph.connected_components(graph)[0] == 1


def test_solids_are_exact_and_in_one_piece(built):
    whole, (pieces, inner, world) = built
    asset = whole.asset
    refuse_asset(asset)
    refuse_meshes(whole.meshes, pieces)
    _, found = author.describe(asset)
    to_world = (found.chunks == WORLD).any(axis=1)
    assert (int((~to_world).sum()), int(to_world.sum())) == (inner, world)
    assert one_piece(asset)
    for chunk, mesh in enumerate(whole.meshes):
        volume, centroid, inertia = moments(mesh)
        np.testing.assert_allclose(asset.chunk_volume[chunk], volume, rtol=1e-6)
        np.testing.assert_allclose(asset.chunk_centroid[chunk], centroid, atol=1e-5)
        np.testing.assert_allclose(asset.chunk_inertia[chunk], inertia, atol=1e-6)
        hull = spatial.ConvexHull(mesh.vertices)
        np.testing.assert_allclose(hull.volume, volume, rtol=1e-9)
    box = 8 * np.prod(asset.chunk_size, axis=1)
    np.testing.assert_allclose(box, asset.chunk_volume, rtol=1e-5)


def test_pieces_are_closed_by_bonds_and_skin(built):
    """Each piece's faces are bonded or free, and none is both or twice."""
    whole, _ = built
    found = bonds.between(whole.meshes)
    normal = {}
    for (a, b), n, area in zip(found.chunks, found.normal, found.area, strict=True):
        normal.setdefault(a, []).append((n, area))
        normal.setdefault(b, []).append((-n, area))
    for chunk, mesh in enumerate(whole.meshes):
        corners = mesh.vertices[mesh.faces]
        vector = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        for n, area in normal.get(chunk, []):
            length = np.linalg.norm(vector, axis=1)
            side = vector @ n > (1 - 1e-9) * length
            assert area <= length[side].sum() / 2 * (1 + 1e-9)


def area_of(outline):
    x, y = np.asarray(outline).T
    return abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def test_volume_of_an_arch():
    whole = shapes.arch(3.0, 1.5, 0.5, 2.0, 9)
    wedge = np.sin(np.pi / 9) / 2 * (2.0**2 - 1.5**2) * 2.0
    np.testing.assert_allclose(whole.asset.chunk_volume, wedge, rtol=1e-6)


def test_volume_of_a_dome():
    whole = shapes.dome(2.0, 0.5, 4, 12)
    points = np.concatenate([m.vertices for m in whole.meshes])
    radius = np.linalg.norm(points, axis=1)
    outer, inner = (
        spatial.ConvexHull(points[np.abs(radius - r) < 1e-9]).volume for r in (2.5, 2.0)
    )
    volume = sum(moments(m)[0] for m in whole.meshes)
    np.testing.assert_allclose(volume, outer - inner, rtol=1e-12)


@pytest.mark.parametrize("sectors", [1, 2, 8])
def test_volume_of_a_column(sectors):
    whole = shapes.column(4.0, 0.5, 5, sectors=sectors, sides=8, taper=0.5)
    foot = 8 * np.sin(np.pi / 4) / 2 * 0.5**2
    volume = sum(moments(m)[0] for m in whole.meshes)
    np.testing.assert_allclose(volume, 4 / 3 * foot * (1 + 0.5 + 0.25), rtol=1e-12)


@pytest.mark.parametrize("rise", [0.7, 2.0])
def test_volume_of_a_bridge(rise):
    whole = shapes.bridge(2, 4.0, rise, 0.4, 1.5, voussoirs=7, pier=1.0, height=2.0)
    volume = sum(moments(m)[0] for m in whole.meshes)
    points = np.concatenate([m.vertices for m in whole.meshes])
    block = np.prod(np.ptp(points, axis=0))
    np.testing.assert_allclose(np.ptp(points[:, 0]), 2 * 4 + 3)
    radius = (4 + rise**2) / (2 * rise)
    half = np.arcsin(2 / radius)
    turn = np.linspace(-half, half, 8)
    under = np.stack([np.sin(turn), np.cos(turn) - np.cos(half)], axis=1) * radius
    hole = 4.0 * 2.0 + area_of(under)
    np.testing.assert_allclose(volume, block - 2 * 1.5 * hole, rtol=1e-9)


def test_masonry_leaves_its_openings_free():
    openings = [(-1.5, 0.0, -0.6, 1.2), (0.3, 0.61, 1.33, 1.2)]
    asset = shapes.masonry(12, 9, openings=openings)
    low = np.asarray(asset.chunk_centroid - asset.chunk_size)
    high = np.asarray(asset.chunk_centroid + asset.chunk_size)
    for x0, z0, x1, z1 in openings:
        z0, z1 = 0.2 * round(z0 / 0.2), 0.2 * round(z1 / 0.2)
        inside = (low[:, 0] < x1 - 1e-5) & (high[:, 0] > x0 + 1e-5)
        inside &= (low[:, 2] < z1 - 1e-5) & (high[:, 2] > z0 + 1e-5)
        assert not inside.any()
        # The lintel: one brick that spans the opening and half a brick beyond.
        lintel = (np.abs(low[:, 0] - (x0 - 0.2)) < 1e-5) & (
            np.abs(low[:, 2] - z1) < 1e-5
        )
        np.testing.assert_allclose(high[lintel, 0], [x1 + 0.2], atol=1e-5)
    free = 0.9 * 1.2 + 1.03 * 0.6
    volume = float(asset.chunk_volume.sum())
    np.testing.assert_allclose(volume, 0.2 * (4.8 * 1.8 - free), rtol=1e-5)
    assert float(asset.chunk_size[:, 0].min()) >= 0.05 - 1e-6
    assert one_piece(asset) and asset.has_world


def test_pane_and_vase():
    pytest.importorskip("manifold3d")
    pane = shapes.pane(1.0, 0.8, 0.01, 20, impact=(0.2, 0.3), seed=1)
    leaf = np.asarray(pane.asset.chunk_children) == 0
    assert leaf.sum() == 20 and one_piece(pane.asset)
    volume = np.asarray(pane.asset.chunk_volume)[leaf]
    np.testing.assert_allclose(volume.sum(), 0.008, rtol=1e-6)
    # Shards near the impact are the small ones.
    away = np.asarray(pane.asset.chunk_centroid)[leaf][:, [0, 2]] - [0.2, 0.3]
    near = np.argsort(np.linalg.norm(away, axis=1))
    assert volume[near[:7]].mean() < 0.5 * volume[near[-7:]].mean()
    _, found = author.describe(pane.asset)
    edge = found.area[(found.chunks == WORLD).any(axis=1)]
    # Shards in a corner have one bond for both edges.
    np.testing.assert_allclose(edge.sum(), 2 * (1.0 + 0.8) * 0.01, rtol=1e-5)

    vase = shapes.vase(pieces=12, sides=12, anchor=True)
    refuse_meshes(vase.meshes, len(vase.asset.chunk_parent))
    assert one_piece(vase.asset) and vase.asset.has_world
    # Bonds of its cuts, made exactly there, against those found from its meshes.
    _, cut = author.describe(vase.asset)
    inner = (cut.chunks != WORLD).all(axis=1)
    again = bonds.between(vase.meshes)
    order, other = np.lexsort(again.chunks.T), np.lexsort(cut.chunks[inner].T)
    np.testing.assert_array_equal(again.chunks[order], cut.chunks[inner][other])
    np.testing.assert_allclose(again.area[order], cut.area[inner][other], rtol=1e-6)
    np.testing.assert_allclose(again.normal[order], cut.normal[inner][other], atol=1e-6)
    np.testing.assert_allclose(
        again.centroid[order], cut.centroid[inner][other], atol=1e-6
    )


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: shapes.arch(rise=3.0), "rise is 3.0 m; at most half the span, 2 m"),
        (lambda: shapes.arch(span=-1.0), "span is -1.0"),
        (lambda: shapes.arch(voussoirs=0), r"voussoirs\[0\] is 0"),
        (lambda: shapes.dome(segments=2), "segments is 2"),
        (lambda: shapes.column(sides=16, sectors=3), "sides is 16"),
        (lambda: shapes.bridge(pier=0.1), "two springings on it need more than"),
        (lambda: shapes.bridge(deck=0.0), "deck is 0.0"),
        (lambda: shapes.masonry(openings=[(0, 0, 9, 1)]), "opening 0 is .* within"),
        (
            lambda: shapes.masonry(openings=[(-1, 0, 0, 1), (0.1, 0, 1, 1)]),
            "opening 1 is less than a brick from opening 0",
        ),
        (lambda: shapes.pane(anchor=("up",)), "anchor 'up' is no side"),
        (lambda: shapes.pane(thickness=0.0), "thickness is 0.0"),
        (lambda: shapes.vase([(1, 0), (1, 0)]), "must go upwards"),
        (lambda: shapes.vase([(0.005, 0), (1, 1)]), "thinner than its wall"),
    ],
)
def test_bad_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
