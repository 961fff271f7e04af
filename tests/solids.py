"""Solids to cut, some generated and some that packages ship, and what must hold."""

import functools
import pathlib

import numpy as np
import scipy.sparse

from blastjax.author import cut
from blastjax.author.cut import geometry


def box():
    return _trimesh().creation.box((1.0, 0.6, 0.4))


def ball():
    return _trimesh().creation.icosphere(3, 0.5)


def torus():
    """Return one of 10,000 triangles."""
    return _trimesh().creation.torus(1.0, 0.3, major_sections=100, minor_sections=50)


def tube():
    return _trimesh().creation.annulus(0.3, 0.5, 1.0, sections=32)


def capsule():
    return _trimesh().creation.capsule(1.0, 0.3, count=(16, 16))


def vase():
    profile = [(0, 0), (0.22, 0), (0.3, 0.2), (0.32, 0.4), (0.2, 0.65), (0.16, 0.8)]
    profile += [(0.21, 0.9), (0.18, 0.9), (0.13, 0.8), (0.17, 0.65), (0.29, 0.4)]
    profile += [(0.27, 0.2), (0.2, 0.04), (0, 0.04)]
    return _trimesh().creation.revolve(np.array(profile), sections=48)


def drilled():
    """Return a block with three crossing holes."""
    solid = _manifold()
    block = solid.cube((1, 1, 1), True)
    hole = solid.cylinder(2, 0.2, circular_segments=32, center=True)
    turns = ((0, 0, 0), (90, 0, 0), (0, 90, 0))
    for turn in turns:
        block -= hole.rotate(turn)
    return _mesh(block)


def hollow():
    """Return a block around a closed cavity."""
    solid = _manifold()
    return _mesh(solid.cube((1, 1, 1), True) - solid.sphere(0.35, 32))


def star():
    """Return a prism over a star, twisted."""
    section = geometry.need("manifold3d").CrossSection
    turn = np.arange(10) * np.pi / 5
    reach = np.where(np.arange(10) % 2, 0.3, 0.8)[:, None]
    points = reach * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return _mesh(section([points]).extrude(1.0, 8, 60.0))


def comb():
    """Return a base with five teeth: a cut across them leaves islands."""
    solid = _manifold()
    body = solid.cube((1, 0.2, 0.2))
    for k in range(5):
        body += solid.cube((0.1, 0.2, 0.8)).translate((0.05 + 0.2 * k, 0, 0.15))
    return _mesh(body)


def gyroid():
    """Return a block of a gyroid's two intertwined mazes' wall."""

    def level(x, y, z):
        wave = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)
        return 0.6 - abs(wave)

    span = 2 * np.pi
    return _mesh(_manifold().level_set(level, (0, 0, 0, span, span, span), 0.6))


def shipped(name):
    """Return the path of a mesh that mujoco-mjx ships for its tests."""
    from mujoco import mjx

    return pathlib.Path(mjx.__file__).parent / "test_data" / name


MADE = {
    f.__name__: f
    for f in (box, ball, torus, tube, capsule, vase, drilled, hollow, star, comb)
} | {"gyroid": gyroid}
HAND = "shadow_hand/assets/"
SHIPPED = {
    name.split("/")[-1]: functools.partial(shipped, name)
    for name in (
        "barkour_v0/assets/foot.stl",
        "meshes/dodecahedron.stl",
        HAND + "f_knuckle.obj",
        HAND + "lf_metacarpal.obj",
        HAND + "mounting_plate.obj",
        HAND + "th_distal_pst.obj",
        HAND + "wrist.obj",
    )
}
"""Of the Barkour and Shadow robots, in m and mm."""
ALL = MADE | SHIPPED


def figures(tree, result):
    """Return what must be small, or equal, of a cut solid."""
    leaves = tree.leaves
    bodies = {int(i): tree.bodies[i] for i in leaves}
    volume = tree.volume
    contacts = result.contacts
    span = float(np.subtract(*tree.bounds()[::-1]).max())
    gap = max(
        (bodies[a].min_gap(bodies[b], span) for a, b in contacts.pieces.tolist()),
        default=0.0,
    )
    return {
        "volume": abs(volume[leaves].sum() / volume[0] - 1),
        "overlap": overlap(list(bodies.values())) / volume[0],
        "sides": np.max(
            np.abs(contacts.sides[:, 0] - contacts.sides[:, 1]) / contacts.area,
            initial=0.0,
        ),
        "unbonded": abs(2 * contacts.area.sum() / max(inner_area(tree), 1e-300) - 1)
        if len(leaves) > 1
        else 0.0,
        "gap": gap / span,
        "parts": islands(leaves, contacts.pieces),
        "solid parts": sum(s.volume() > 0 for s in tree.bodies[0].decompose()),
    }


def overlap(bodies):
    """Return the volume that bodies have in common, pair by pair."""
    low, high = np.array([geometry.bounds(b) for b in bodies]).swapaxes(0, 1)
    total = 0.0
    for i, body in enumerate(bodies):
        near = (low[i] < high[i + 1 :]) & (low[i + 1 :] < high[i])
        for j in i + 1 + np.flatnonzero(near.all(axis=1)):
            total += (body ^ bodies[j]).volume()
    return total


def inner_area(tree):
    """Return the area of all faces of leaves that cuts made, m^2."""
    total = 0.0
    for i in tree.leaves:
        mesh = tree.mesh(i)
        a, b, c = np.moveaxis(mesh.vertices[mesh.faces[mesh.interior]], 1, 0)
        total += np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    return total


def islands(leaves, pairs):
    """Return how many parts the graph of bonds has."""
    place = np.searchsorted(leaves, pairs)
    graph = scipy.sparse.coo_array(
        (np.ones(len(place)), place.T), shape=(len(leaves),) * 2
    )
    return scipy.sparse.csgraph.connected_components(graph, directed=False)[0]


def same(first, second):
    """Return whether two results are equal bit for bit."""
    import jax

    return all(
        np.array_equal(a, b)
        for a, b in zip(
            jax.tree.leaves(first.destructible.asset),
            jax.tree.leaves(second.destructible.asset),
            strict=True,
        )
    ) and all(
        a.vertices.tobytes() == b.vertices.tobytes()
        and a.faces.tobytes() == b.faces.tobytes()
        for a, b in zip(
            first.destructible.meshes, second.destructible.meshes, strict=True
        )
    )


def voronoi(mesh, count, seed=0):
    """Return the tree and the result of a cut by random sites."""
    solid = cut.solid(mesh)
    tree = cut.voronoi(solid, cut.uniform(solid, count, seed=seed))
    return tree, cut.destructible(tree)


def _trimesh():
    return geometry.need("trimesh")


def _manifold():
    return geometry.need("manifold3d").Manifold


def _mesh(body):
    return geometry.mesh(body, 0)[0]
