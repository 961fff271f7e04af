"""Collisions of convex hulls that differ, by one program for all pairs.

All shapes stand in one padded table, and a pair is two rows of it: what is compiled
does not grow with the number of shapes. Two hulls are parted by the axis of least
overlap among all face normals and all crossings of edges that can touch (separating
axes, pruned by Gauss maps: Gregorius, GDC 2013). Two faces then give an outline of the
region in which they meet, two edges one point. The choice of features is piecewise
constant; depth, place and normal are differentiable in the poses between its jumps.

Everything is relative to the first shape of a pair, so nothing is lost far from the
world's origin. Sizes: H hulls, V vertices, F faces, P corners of a face, E edges.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from blastjax import pytree, spatial
from blastjax.rigid import engine

POINTS = 8
"""Contacts of a pair that has a plane or two hulls: an outline and the deepest."""
FAR = 1.0
"""Distance of contacts that are not there, m."""
FACE_BIAS = 0.95
"""A crossing of edges must be this much shallower than a face to be preferred: faces
give a whole outline, and two answers of equal depth must not take turns."""
FACE_SLOP = 0.01
"""They must also be this much shallower, of the first hull's size, or shallower than
all points in which the faces meet: a whole outline must not vanish for a hair."""
_ANGLE = 0.3 + np.arange(POINTS - 1) * 2 * np.pi / (POINTS - 1)
"""Directions of the outline, rad: crooked, so that a face's corners do not tie."""


@pytree.dataclass
class Table(pytree.Node):
    """Convex hulls, each about the frame of its geom. Padding repeats: see `author`."""

    vertices: jax.Array
    """(H, V, 3) m."""
    normal: jax.Array
    """(H, F, 3) outward unit normals."""
    offset: jax.Array
    """(H, F) distance of each face from the frame's origin, m."""
    corners: jax.Array
    """(H, F, P) int32 vertices of each face, counter-clockwise seen from outside."""
    size: jax.Array
    """(H, F) int32 how many of them there are."""
    edges: jax.Array
    """(H, E, 2) int32 vertices of each edge."""
    sides: jax.Array
    """(H, E, 2) int32 faces on the left and the right of it."""
    row: jax.Array
    """(G,) int32 hull of each geom, 0 for those that have none."""


@pytree.dataclass
class _Solid(pytree.Node):
    """One hull in the common frame of its pair."""

    vertices: jax.Array
    normal: jax.Array
    offset: jax.Array
    corners: jax.Array
    size: jax.Array
    edges: jax.Array
    sides: jax.Array


Find = Callable[[mjx.Model, mjx.Data, jax.Array], engine.Points]


def colliders(table: Table) -> dict[int, tuple[Find, int]]:
    """Return how geoms of each MJX type collide with a hull, and contacts of a pair."""
    types = mujoco.mjtGeom
    polytopes = functools.partial(hull_hull, table), POINTS
    return {
        int(types.mjGEOM_PLANE): (functools.partial(plane_hull, table), POINTS),
        int(types.mjGEOM_SPHERE): (functools.partial(sphere_hull, table), 1),
        int(types.mjGEOM_CAPSULE): (functools.partial(capsule_hull, table), 3),
        int(types.mjGEOM_BOX): polytopes,
        int(types.mjGEOM_MESH): polytopes,
    }


def plane_hull(
    table: Table, model: mjx.Model, data: mjx.Data, pair: jax.Array
) -> engine.Points:
    """Collide planes with hulls: the deepest vertex and an outline of those below."""

    def one(plane: jax.Array, geom: jax.Array) -> engine.Points:
        turn = data.geom_xmat[plane].T
        corners = table.vertices[table.row[geom]] @ data.geom_xmat[geom].T
        point = (corners + (data.geom_xpos[geom] - data.geom_xpos[plane])) @ turn.T
        height = point[:, 2]
        kept, on = _outline(point[:, :2], height, jnp.ones_like(height, bool))
        distance = jnp.where(on, height[kept], FAR)
        middle = point[kept].at[:, 2].multiply(0.5)
        normal = jnp.zeros(3, point.dtype).at[2].set(1.0)
        return _placed(distance, middle, normal, data, plane)

    return _flat(jax.vmap(one)(pair[:, 0], pair[:, 1]))


def sphere_hull(
    table: Table, model: mjx.Model, data: mjx.Data, pair: jax.Array
) -> engine.Points:
    """Collide spheres with hulls: one contact."""

    def one(ball: jax.Array, geom: jax.Array) -> engine.Points:
        center = _seen_from(data, geom, data.geom_xpos[ball])
        solid = _solid(table, geom)
        return _ball(solid, center, model.geom_size[ball, 0], data, geom)

    first, second = pair[:, 0], pair[:, 1]
    distance, point, frame = jax.vmap(one)(first, second)
    return distance, point, frame


def capsule_hull(
    table: Table, model: mjx.Model, data: mjx.Data, pair: jax.Array
) -> engine.Points:
    """Collide capsules with hulls: as balls at both ends and where it is closest."""

    def one(capsule: jax.Array, geom: jax.Array) -> engine.Points:
        half = data.geom_xmat[capsule][:, 2] * model.geom_size[capsule, 1]
        center = data.geom_xpos[capsule]
        ends = jax.vmap(functools.partial(_seen_from, data, geom))(
            jnp.stack([center - half, center + half])
        )
        solid = _solid(table, geom)
        between = _closest_on_segment(*jax.lax.stop_gradient((solid, ends)))
        along = ends[0] + between[:, None] * (ends[1] - ends[0])
        balls = jnp.concatenate([ends, along])
        radius = model.geom_size[capsule, 0]
        distance, point, frame = jax.vmap(
            lambda at: _ball(solid, at, radius, data, geom)
        )(balls)
        # At an end it would be the same contact twice.
        inner = (between > 1e-3) & (between < 1 - 1e-3)
        distance = distance.at[2:].set(jnp.where(inner, distance[2:], FAR))
        third = 2 + jnp.argmin(jax.lax.stop_gradient(distance[2:]))
        kept = jnp.stack([jnp.zeros_like(third), jnp.ones_like(third), third])
        distance, point, frame = (x[kept] for x in (distance, point, frame))
        return distance, point, frame

    return _flat(jax.vmap(one)(pair[:, 0], pair[:, 1]))


def hull_hull(
    table: Table, model: mjx.Model, data: mjx.Data, pair: jax.Array
) -> engine.Points:
    """Collide hulls with hulls: an outline between faces, one point between edges."""

    def one(first: jax.Array, second: jax.Array) -> engine.Points:
        a, b = _solid(table, first), _solid(table, second)
        shift = _seen_from(data, first, data.geom_xpos[second])
        b = _moved(b, data.geom_xmat[first].T @ data.geom_xmat[second], shift)
        distance, point, normal = meet(a, b)
        return _placed(distance, point, normal, data, first)

    return _flat(jax.vmap(one)(pair[:, 0], pair[:, 1]))


def meet(a: _Solid, b: _Solid) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return distances (8,), points (8, 3) and the normal (3,) from a to b."""
    still_a, still_b = jax.lax.stop_gradient((a, b))
    gap_a = _face_gaps(still_a, still_b.vertices)
    gap_b = _face_gaps(still_b, still_a.vertices)
    face_a, face_b = jnp.argmax(gap_a), jnp.argmax(gap_b)
    best_a, best_b = gap_a[face_a], gap_b[face_b]
    # Between equal faces the first hull's is taken, whatever the rounding.
    slack = 1e-5 * (jnp.abs(best_a) + jnp.max(jnp.abs(still_a.offset)))
    swap = best_b > best_a + slack
    best_face = jnp.where(swap, best_b, best_a)

    def pick(x: jax.Array, y: jax.Array) -> jax.Array:
        return jnp.where(swap, y, x)

    own = jax.tree.map(pick, _face(a, face_a), _face(b, face_b))
    (other_a, low_a), (other_b, low_b) = _facing(a, own[1]), _facing(b, own[1])
    other = jax.tree.map(pick, _face(b, other_b), _face(a, other_a))
    distance, point = _face_contacts(own, other, pick(low_b, low_a))
    normal = jnp.where(swap, -own[1], own[1])
    edge_a, edge_b, best_edge = _edge_gap(still_a, still_b)
    crossing = best_edge * jnp.where(best_edge < 0, 1 / FACE_BIAS, FACE_BIAS)
    by_edges = crossing > best_face + slack
    # Where the faces meet they may be no deeper than the edges: a vertex elsewhere is.
    deepest = jnp.min(jax.lax.stop_gradient(distance))
    slop = FACE_SLOP * jnp.max(jnp.abs(still_a.offset))
    by_edges &= (crossing > deepest + slack) | (best_edge > best_face + slop)
    gap, place, across = _edge_contact(a, b, edge_a, edge_b)
    single = jnp.full_like(distance, FAR).at[0].set(gap)
    distance = jnp.where(by_edges, single, distance)
    point = jnp.where(by_edges, place[None], point)
    return distance, point, jnp.where(by_edges, across, normal)


def _solid(table: Table, geom: jax.Array) -> _Solid:
    row = table.row[geom]
    return _Solid(
        vertices=table.vertices[row],
        normal=table.normal[row],
        offset=table.offset[row],
        corners=table.corners[row],
        size=table.size[row],
        edges=table.edges[row],
        sides=table.sides[row],
    )


def _moved(solid: _Solid, turn: jax.Array, shift: jax.Array) -> _Solid:
    normal = solid.normal @ turn.T
    return solid.replace(
        vertices=solid.vertices @ turn.T + shift,
        normal=normal,
        offset=solid.offset + normal @ shift,
    )


def _seen_from(data: mjx.Data, geom: jax.Array, point: jax.Array) -> jax.Array:
    return (point - data.geom_xpos[geom]) @ data.geom_xmat[geom]


def _placed(
    distance: jax.Array,
    point: jax.Array,
    normal: jax.Array,
    data: mjx.Data,
    geom: jax.Array,
) -> engine.Points:
    """Bring contacts from a geom's frame into the world."""
    turn = data.geom_xmat[geom]
    frame = engine.contact_frame(turn @ normal)
    count = distance.shape[0]
    return (
        distance,
        point @ turn.T + data.geom_xpos[geom],
        jnp.broadcast_to(frame, (count, 3, 3)),
    )


def _flat(points: engine.Points) -> engine.Points:
    distance, point, frame = points
    return distance.reshape(-1), point.reshape(-1, 3), frame.reshape(-1, 3, 3)


def _face_gaps(solid: _Solid, points: jax.Array) -> jax.Array:
    """Return how far all points (n, 3) are outside of each face, (F,)."""
    return jnp.min(solid.normal @ points.T, axis=1) - solid.offset


def _edge_gap(a: _Solid, b: _Solid) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the edges whose crossing parts two hulls most, and the gap there."""
    end_a, end_b = a.vertices[a.edges], b.vertices[b.edges]
    along_a, along_b = end_a[:, 1] - end_a[:, 0], end_b[:, 1] - end_b[:, 0]
    side_a, side_b = a.normal[a.sides], -b.normal[b.sides]

    # The arcs of two edges on the unit sphere cross where the edges can touch.
    on_a = [side_b[:, k] @ along_a.T for k in range(2)]
    on_b = [(side_a[:, k] @ along_b.T).T for k in range(2)]
    crosses = (on_a[0] * on_a[1] < 0) & (on_b[0] * on_b[1] < 0)
    hemisphere = on_a[0] * on_b[1] > 0
    # (along_a x along_b) . (b0 - a0) in Pluecker's form: no (E, E, 3) in memory.
    moment_a = jnp.cross(end_a[:, 0], along_a)
    moment_b = jnp.cross(end_b[:, 0], along_b)
    volume = -(along_b @ moment_a.T + moment_b @ along_a.T)
    length_a = jnp.sum(along_a * along_a, axis=1)[None, :]
    length_b = jnp.sum(along_b * along_b, axis=1)[:, None]
    cosine = along_b @ along_a.T
    square = length_a * length_b - cosine * cosine
    # Parallel edges make no axis of their own.
    able = crosses & hemisphere & (square > 1e-4 * length_a * length_b)
    outward = jnp.where(on_a[0] > 0, -1.0, 1.0).astype(volume.dtype)
    gap = volume * outward * jax.lax.rsqrt(jnp.where(able, square, 1.0))
    gap = jnp.where(able, gap, -jnp.inf)
    rows = jnp.max(gap, axis=1)
    edge_b = jnp.argmax(rows)
    edge_a = jnp.argmax(gap[edge_b])
    return edge_a, edge_b, rows[edge_b]


Face = tuple[jax.Array, jax.Array, jax.Array]
"""Corners (P, 3), outward normal (3,), and number of corners ()."""


def _face(solid: _Solid, face: jax.Array) -> Face:
    corners = solid.vertices[solid.corners[face]]
    return corners, solid.normal[face], solid.size[face]


def _facing(solid: _Solid, normal: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the face that meets one with a normal, and the vertex lowest over that.

    It is the one that looks most against the normal, of those at the lowest edge: a
    face elsewhere can look more against it and not meet it at all.
    """
    toward = jax.lax.stop_gradient(normal)
    height = solid.vertices @ toward
    lowest = jnp.argmin(height)
    # Padding repeats vertices.
    again = jnp.all(solid.vertices == solid.vertices[lowest], axis=1)
    next_lowest = jnp.argmin(jnp.where(again, jnp.inf, height))
    at_lowest = jnp.any(solid.corners == lowest, axis=1)
    at_both = at_lowest & jnp.any(solid.corners == next_lowest, axis=1)
    ahead = at_lowest.astype(height.dtype) + at_both
    return jnp.argmin(solid.normal @ toward - 3.0 * ahead), solid.vertices[lowest]


def _ring(face: Face) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return start and end of a face's edges (P, 3), and which there are (P,)."""
    corners, _, size = face
    count = jnp.arange(corners.shape[0])
    following = jnp.where(count + 1 < size, count + 1, 0)
    return corners, corners[following], count < size


def _face_contacts(
    own: Face, other: Face, lowest: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return distances (8,) and points (8, 3) between two faces.

    Candidates are the other face's edges cut off at the sides of the own one, and the
    own corners within the other; if none of them touches, the other's lowest vertex.
    """
    normal = own[1]
    start, end, real = _ring(own)
    other_start, other_end, other_real = _ring(other)
    outward = jnp.cross(end - start, normal)
    other_outward = jnp.cross(other_end - other_start, -normal)

    # Both ends of each other edge (rows) before each own side (columns).
    begin = other_start @ outward.T - jnp.sum(start * outward, axis=1)
    finish = other_end @ outward.T - jnp.sum(start * outward, axis=1)
    change = begin - finish
    crossing = begin / jnp.where(change == 0, 1.0, change)
    enters, leaves = (begin > 0) & (finish < 0), (begin < 0) & (finish > 0)
    beyond = (begin > 0) & (finish >= 0) & real
    low = jnp.max(jnp.where(enters & real, crossing, 0.0), axis=1)
    high = jnp.min(jnp.where(leaves & real, crossing, 1.0), axis=1)
    inside = other_real & ~jnp.any(beyond, axis=1) & (low <= high)
    along = other_end - other_start
    first, last = (other_start + t[:, None] * along for t in (low, high))

    height = start @ other_outward.T - jnp.sum(other_start * other_outward, axis=1)
    within = real & jnp.all((height <= 0) | ~other_real, axis=1)
    facing = jnp.minimum(jnp.sum(other[1] * normal), -1e-3)
    lift = (other[0][0] - start) @ other[1] / facing
    corner = start + lift[:, None] * normal

    # An edge's end that is a corner is the next edge's beginning.
    candidates = jnp.concatenate([first, last, corner])
    valid = jnp.concatenate([inside, inside & (high < 1.0), within])
    distance = (candidates - own[0][0]) @ normal
    reach = (lowest - own[0][0]) @ normal
    none = ~jnp.any(valid & (distance < 0))
    candidates = jnp.concatenate([candidates, lowest[None]])
    distance = jnp.append(distance, reach)
    valid = jnp.append(valid & ~none, none)

    across = jax.lax.stop_gradient(_tangents(normal))
    kept, on = _outline(candidates @ across.T, distance, valid)
    distance, point = distance[kept], candidates[kept]
    point = point - 0.5 * distance[:, None] * normal
    return jnp.where(on, distance, FAR), point


def _tangents(normal: jax.Array) -> jax.Array:
    """Return two directions across a normal, (2, 3)."""
    return engine.contact_frame(normal)[1:]


def _outline(
    place: jax.Array, distance: jax.Array, valid: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Choose the deepest of n points and the farthest ones across, 8 in all.

    Returns:
      Which (8,) int, and which of them count (8,) bool: none stands there twice.
    """
    place, distance = jax.lax.stop_gradient((place, distance))
    direction = np.stack([np.cos(_ANGLE), np.sin(_ANGLE)]).astype(place.dtype)
    along = place @ direction
    # Whatever touches comes before whatever does not.
    low = jnp.min(jnp.where(valid[:, None], along, jnp.inf), axis=0)
    along = along - jnp.where(jnp.isfinite(low), low, 0.0)
    touching = valid & (distance < 0)
    score = jnp.where(touching[:, None], along + 1.0, -distance[:, None])
    score = jnp.concatenate([-distance[:, None], score], axis=1)
    score = jnp.where(valid[:, None], score, -jnp.inf)
    kept = jnp.argmax(score, axis=0)
    before = np.tri(POINTS, k=-1, dtype=bool)
    twice = jnp.any((kept[:, None] == kept[None, :]) & before, axis=1)
    return kept, valid[kept] & ~twice


def _edge_contact(
    a: _Solid, b: _Solid, edge_a: jax.Array, edge_b: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return gap, middle and normal (from a to b) where two edges cross."""
    start_a, end_a = a.vertices[a.edges[edge_a]]
    start_b, end_b = b.vertices[b.edges[edge_b]]
    along_a, along_b = end_a - start_a, end_b - start_b
    offset = start_b - start_a
    across = jnp.cross(along_a, along_b)
    square = jnp.sum(across * across)
    scale = jnp.sum(along_a * along_a) * jnp.sum(along_b * along_b)
    safe = jnp.where(square > 1e-6 * scale, square, 1.0)
    # Outwards is where a's own faces look; they look away from each other's edge.
    looks = jnp.sum(a.normal[a.sides[edge_a]], axis=0)
    sign = jnp.where(jnp.sum(across * looks) < 0, -1.0, 1.0).astype(square.dtype)
    normal = sign * across * jax.lax.rsqrt(safe)
    gap = jnp.sum(normal * offset)
    on_a = jnp.sum(jnp.cross(offset, along_b) * across) / safe
    on_b = jnp.sum(jnp.cross(offset, along_a) * across) / safe
    near_a = start_a + jnp.clip(on_a, 0.0, 1.0) * along_a
    near_b = start_b + jnp.clip(on_b, 0.0, 1.0) * along_b
    return gap, 0.5 * (near_a + near_b), normal


def _ball(
    solid: _Solid, center: jax.Array, radius: jax.Array, data: mjx.Data, geom: jax.Array
) -> engine.Points:
    """Collide a ball, seen from the hull's frame, with the hull; normal to the hull."""
    gaps = solid.normal @ center - solid.offset
    face = jnp.argmax(jax.lax.stop_gradient(gaps))
    gap = gaps[face]
    nearest, beside = _nearest_on_surface(solid, center, face)
    offset = nearest - center
    length = spatial.norm(offset)
    # Over a face, and inside, its normal; beside it, away from the closest edge.
    to_edge = beside & (length > 1e-9)
    normal = jnp.where(to_edge, spatial.unit(offset), -solid.normal[face])
    distance = jnp.where(to_edge, length, gap) - radius
    point = center + normal * (radius + 0.5 * distance)
    turn = data.geom_xmat[geom]
    frame = engine.contact_frame(turn @ normal)
    return distance, turn @ point + data.geom_xpos[geom], frame


def _nearest_on_surface(
    solid: _Solid, center: jax.Array, face: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the closest point of all edges (3,), and whether no face is closer ()."""
    start, end = (solid.vertices[solid.edges[:, k]] for k in range(2))
    along = end - start
    square = jnp.sum(along * along, axis=1)
    t = jnp.sum((center - start) * along, axis=1) / jnp.where(square > 0, square, 1.0)
    points = start + jnp.clip(t, 0.0, 1.0)[:, None] * along
    far = jnp.sum((points - center) ** 2, axis=1)
    nearest = points[jnp.argmin(jax.lax.stop_gradient(far))]
    # The face that is farthest below the point is the closest if the point is over it.
    ring_start, ring_end, real = _ring(_face(solid, face))
    normal = solid.normal[face]
    outward = jnp.cross(ring_end - ring_start, normal)
    over = jnp.sum((center - ring_start) * outward, axis=1)
    outside = solid.normal[face] @ center - solid.offset[face] > 0
    return nearest, outside & jnp.any((over > 0) & real)


def _closest_on_segment(solid: _Solid, ends: jax.Array) -> jax.Array:
    """Return where, 0 to 1, a segment (2, 3) is closest to faces and to edges, (2,).

    The greatest distance over a hull's faces is convex along the segment, so halving by
    the sign of its slope finds the least: the closest point to a face, and the deepest.
    """
    gap = ends @ solid.normal.T - solid.offset
    rise = gap[1] - gap[0]

    def halve(_: int, bracket: tuple[jax.Array, jax.Array]) -> tuple:
        low, high = bracket
        middle = 0.5 * (low + high)
        falls = rise[jnp.argmax(gap[0] + middle * rise)] < 0
        return jnp.where(falls, middle, low), jnp.where(falls, high, middle)

    zero = jnp.zeros((), gap.dtype)
    low, high = jax.lax.fori_loop(0, 30, halve, (zero, zero + 1.0))

    start, finish = (solid.vertices[solid.edges[:, k]] for k in range(2))
    edge, line, offset = finish - start, ends[1] - ends[0], ends[0] - start
    lines, edges, both = line @ line, jnp.sum(edge * edge, axis=1), edge @ line
    on_line, on_edge = offset @ line, jnp.sum(offset * edge, axis=1)
    square = lines * edges - both * both
    safe = square > 1e-9 * lines * edges
    t = (both * on_edge - edges * on_line) / jnp.where(safe, square, 1.0)
    t = jnp.clip(jnp.where(safe, t, 0.5), 0.0, 1.0)
    s = (both * t + on_edge) / jnp.where(edges > 0, edges, 1.0)
    s = jnp.clip(s, 0.0, 1.0)
    t = (both * s - on_line) / jnp.where(lines > 0, lines, 1.0)
    t = jnp.clip(t, 0.0, 1.0)
    apart = offset + t[:, None] * line - s[:, None] * edge
    nearest = jnp.argmin(jnp.sum(apart * apart, axis=1))
    return jnp.stack([0.5 * (low + high), t[nearest]])
