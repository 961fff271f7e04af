"""Bonds found from surfaces: against boxes, against sampling, and to the world."""

import numpy as np
import pytest

from blastjax import author
from blastjax.author import bonds, clip, solids
from blastjax.author.overlap import box_pairs
from blastjax.core import WORLD

shapes = author.shapes


def sorted_bonds(found):
    order = np.lexsort(found.chunks.T[::-1])
    return [getattr(found, f)[order] for f in ("chunks", "normal", "area", "centroid")]


def test_flat_touching_faces_are_found_exactly():
    asset = shapes.wall(4, 4, anchor=())
    _, wanted = author.describe(asset)
    found = bonds.between(author.meshes_of(asset), gap=1e-5)
    for a, b in zip(sorted_bonds(found), sorted_bonds(wanted), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_a_turn_changes_no_bond():
    asset = shapes.wall(3, 3, anchor=())
    meshes = author.meshes_of(asset)
    matrix = author.placed((30.0, -20, 5), (0.3, 0.5, -0.7, 0.2))
    moved = [
        author.Mesh(m.vertices @ matrix[:3, :3].T + matrix[:3, 3], m.faces)
        for m in meshes
    ]
    one, other = bonds.between(meshes, gap=1e-5), bonds.between(moved, gap=1e-5)
    np.testing.assert_array_equal(one.chunks, other.chunks)
    np.testing.assert_allclose(one.area, other.area, rtol=1e-6)
    np.testing.assert_allclose(one.normal @ matrix[:3, :3].T, other.normal, atol=1e-9)


def test_joint_is_bonded_midway_within_the_gap():
    one = solids.box(np.zeros(3), np.ones(3))
    other = solids.box(np.array([2.1, 0.5, 0]), np.ones(3))
    assert not len(bonds.between([one, other], gap=0.09).area)
    found = bonds.between([one, other], gap=0.11)
    np.testing.assert_allclose(found.area, [3.0])
    np.testing.assert_allclose(found.normal, [[1, 0, 0]])
    np.testing.assert_allclose(found.centroid, [[1.05, 0.25, 0]], atol=1e-12)
    # As deep may they overlap.
    deep = solids.box(np.array([1.95, 0, 0]), np.ones(3))
    np.testing.assert_allclose(bonds.between([one, deep], gap=0.1).area, [4.0])


def rough(rng, flip, number=8):
    """A slab whose face at z = 0 is a rough height field; flipped, what fits on it."""
    side = np.linspace(0, 1, number + 1)
    x, y = (a.reshape(-1) for a in np.meshgrid(side, side, indexing="ij"))
    height = 0.02 * rng.random(len(x))
    far = np.full(len(x), 1.0 if flip else -1.0)
    points = np.stack([np.tile(x, 2), np.tile(y, 2), np.concatenate([height, far])], 1)
    n, size, faces = number + 1, len(x), []
    for i in range(number):
        for j in range(number):
            a, b, c, d = i * n + j, (i + 1) * n + j, (i + 1) * n + j + 1, i * n + j + 1
            up = [[a, b, c], [a, c, d]]
            down = [[k + size for k in t[::-1]] for t in up]
            faces += up + down
    rim = [i * n for i in range(n)] + [number * n + j for j in range(1, n)]
    rim += [i * n + number for i in range(number - 1, -1, -1)]
    rim += list(range(number - 1, 0, -1))
    for a, b in zip(rim, [*rim[1:], rim[0]], strict=True):
        faces += [[a, a + size, b + size], [a, b + size, b]]
    faces = np.array(faces, np.int32)
    return author.Mesh(points, faces[:, ::-1] if flip else faces)


def test_rough_faces_are_bonded_over_their_own_area():
    lower = rough(np.random.default_rng(0), False)
    upper = rough(np.random.default_rng(0), True)
    found = bonds.between([lower, upper], gap=0.05, facing=0.5)
    height = lower.vertices[:, 2] > -0.5
    inner = height[lower.faces].all(axis=1)
    vector, _ = clip.vector_area(lower.vertices[lower.faces[inner]])
    # Neighbours across a ridge see each other a little too: within three per cent.
    surface = np.linalg.norm(vector, axis=1).sum()
    np.testing.assert_allclose(found.area, [surface], rtol=0.03)
    assert found.normal[0, 2] > 0.999
    np.testing.assert_allclose(found.centroid[0], [0.5, 0.5, 0.01], atol=5e-3)


def test_shared_area_of_triangles_against_sampling():
    rng = np.random.default_rng(1)
    one, other = rng.random((2, 40, 3, 3))
    one[..., 2] = other[..., 2] = 0
    up = np.tile([0.0, 0, 1], (40, 1))
    area, centroid = clip.shared(one, other, up, 0.1)
    grid = (np.stack(np.meshgrid(*[np.arange(400)] * 2), -1).reshape(-1, 2) + 0.5) / 400

    def covers(triangle):
        edge = np.roll(triangle, -1, axis=0) - triangle
        side = [
            e[0] * (grid[:, 1] - p[1]) - e[1] * (grid[:, 0] - p[0])
            for e, p in zip(edge[:, :2], triangle[:, :2], strict=True)
        ]
        return np.all(np.array(side) > 0, 0) | np.all(np.array(side) < 0, 0)

    for k in range(40):
        both = covers(one[k]) & covers(other[k])
        np.testing.assert_allclose(area[k], both.mean(), atol=2e-3)
        if both.mean() > 0.01:
            np.testing.assert_allclose(centroid[k, :2], grid[both].mean(0), atol=5e-3)
    assert (area > 0.01).sum() > 8


def test_bonds_to_the_world():
    meshes = author.meshes_of(shapes.wall(2, 2, (1.0, 0.5, 0.5)))
    plane = bonds.to_plane(meshes, (0, 0, 0), (0, 0, -2.0))
    assert plane.chunks.tolist() == [[0, WORLD], [1, WORLD]]
    np.testing.assert_allclose(plane.area, [0.5, 0.5])
    np.testing.assert_allclose(plane.normal, [[0, 0, -1], [0, 0, -1]])
    # A box in which the wall stands 10 cm deep: the cross-section where it leaves.
    volume = bonds.to_volume(meshes, (-9, -9, -1), (9, 9, 0.1))
    np.testing.assert_allclose(volume.area, [0.5, 0.5], rtol=1e-6)
    np.testing.assert_allclose(volume.normal[0], [0, 0, -1], atol=1e-9)
    whole = bonds.to_volume(meshes, (-9, -9, -9), (9, 9, 9))
    assert len(whole.area) == 5
    np.testing.assert_allclose(whole.area[:2], [0.5, 0.5], rtol=1e-6)
    listed = bonds.to_world(meshes, [4], (1, 0, 0))
    assert listed.chunks.tolist() == [[4, WORLD]]
    np.testing.assert_allclose(listed.area, [0.25], rtol=1e-6)
    asset = author.add_bonds(shapes.wall(2, 2, anchor=()), plane).whole
    assert asset.has_world


def test_bad_arguments_are_refused():
    mesh = solids.box(np.zeros(3), np.ones(3))
    empty = author.Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    for call, message in [
        (lambda: bonds.between([mesh], gap=-1.0), "gap is -1.0"),
        (lambda: bonds.between([mesh, empty]), "mesh 1 has no faces"),
        (lambda: bonds.between([mesh], parts=[0, 1]), "parts has shape"),
        (lambda: bonds.to_plane([mesh], (0, 0, 0), (0, 0, 0)), "needs a direction"),
        (lambda: bonds.to_volume([mesh], (0, 0, 0), (1, 0, 1)), r"corner \[1\] is 0"),
        (lambda: bonds.to_world([mesh], [1]), "piece 0 is 1; there are 1"),
        (
            lambda: solids.describe([author.Mesh(mesh.vertices, mesh.faces[:, ::-1])]),
            "mesh 0 has volume -8",
        ),
    ]:
        with pytest.raises(ValueError, match=message):
            call()


@pytest.mark.parametrize("seed", range(4))
def test_box_pairs_are_all_that_meet(seed):
    rng = np.random.default_rng(seed)
    middle, half = rng.normal(size=(60, 3)), rng.random((60, 3)) * 10.0**-seed
    low, high = middle - half, middle + half
    meet = (low[:, None] <= high + 0.1) & (low <= high[:, None] + 0.1)
    wanted = np.argwhere(np.triu(meet.all(-1), 1))
    np.testing.assert_array_equal(box_pairs(low, high, 0.1), wanted)
