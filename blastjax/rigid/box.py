"""Collisions of boxes, all pairs side by side.

Two boxes are parted by the axis of least overlap among 15: the normals of either, and
the crossings of their edges (separating axes). Two faces give an outline of the region
in which they meet, four points of it; two edges give one point. The choice of features
is piecewise constant; depth, place and normal are differentiable in poses and sizes
between its jumps.

Every number is an array with the pairs last, (P,) or (n, P), and vectors are (3, P):
only so a compiler for CPUs runs along the pairs with all its lanes, ten times faster
than with rows of three numbers. What depends on a choice among three axes turns them
until the chosen one is the first. Everything is relative to one box of a pair, so
nothing is lost far from the world's origin. Sizes: P pairs.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from mujoco import mjx

from blastjax.rigid import engine
from blastjax.rigid.hull import FACE_BIAS, FACE_SLOP, FAR

POINTS = 4
"""Contacts of a pair."""
_ROUNDING = 1e-5
"""Of a pair's size, what is taken for equal, in float32 too."""
_SLOPE = (0.9e-4, 0.4e-4)
"""Settles which point of faces that lie flat on each other is the deepest."""
_PARALLEL = 1e-6
"""Edges whose crossing has a smaller squared sine have no normal of their own."""


class _Box(NamedTuple):
    """The first, or the second, box of each pair."""

    place: jax.Array
    """(3, P) its centre, m."""
    axes: jax.Array
    """(3, 3, P) its three axes, of unit length, one after the other."""
    half: jax.Array
    """(3, P) half extents along them, m."""


class _Choice(NamedTuple):
    """The axes along which pairs overlap least, (P,) each; constant."""

    swap: jax.Array
    """Whether the best face is the second box's."""
    axis: jax.Array
    """Which of its axes is normal to it."""
    face_gap: jax.Array
    """Along it, negative where boxes overlap, m."""
    edges: tuple[jax.Array, jax.Array]
    """The axes of the first and the second box along which the best edges run."""
    edge_gap: jax.Array
    """Along their common normal, m; minus infinity where all edges are parallel."""


def box_box(model: mjx.Model, data: mjx.Data, pair: jax.Array) -> engine.Points:
    """Collide boxes with boxes: four points between faces, one between edges."""
    a, b = (_box(model, data, pair[:, side]) for side in (0, 1))
    margin = model.geom_margin[pair[:, 0]] + model.geom_margin[pair[:, 1]]
    chosen = _once(_choose(*jax.lax.stop_gradient((a, b))))

    own, other = _once(_where(chosen.swap, (b, a), (a, b)))
    distance, point, outward = _face_contacts(own, other, chosen.axis, margin)
    gap, place, across = _edge_contact(a, b, chosen.edges)
    single = jnp.where(_number(POINTS) == 0, gap, FAR)
    by_edges = _prefers_edges(a, b, chosen, jax.lax.stop_gradient(distance))
    distance = jnp.where(by_edges, single, distance)
    point = jnp.where(by_edges, place[:, None], point)
    normal = jnp.where(by_edges, across, jnp.where(chosen.swap, -outward, outward))
    # From pairs last to pairs first, in one go.
    parts = distance, point.reshape(3 * POINTS, -1), _frame(normal)
    found = jnp.concatenate(_once(parts)).T
    points = found[:, POINTS:-9].reshape(-1, 3, POINTS).transpose(0, 2, 1)
    frame = jnp.repeat(found[:, -9:].reshape(-1, 3, 3), POINTS, axis=0)
    return found[:, :POINTS].reshape(-1), points.reshape(-1, 3), frame


def _box(model: mjx.Model, data: mjx.Data, geom: jax.Array) -> _Box:
    axes = data.geom_xmat[geom].transpose(2, 1, 0)
    return _Box(data.geom_xpos[geom].T, axes, model.geom_size[geom].T)


_once = jax.lax.optimization_barrier
"""Compute this once, and not again for each of its uses."""


def _where(condition: jax.Array, yes: Any, no: Any) -> Any:
    """Select between two trees of arrays by a condition (P,)."""
    return jax.tree.map(functools.partial(jnp.where, condition), yes, no)


def _turns(x: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return x (3, ...) with its first, its second and its third entry in front."""
    # Slices of one array: a loop over them has no branches.
    around = _once(jnp.concatenate([x, x[:2]]))
    return around[0:3], around[1:4], around[2:5]


def _first(x: jax.Array, chosen: jax.Array) -> jax.Array:
    """Turn x (3, ..., P) until the chosen (P,) entry is the first."""
    zero, one, two = _turns(x)
    return jnp.where(chosen == 0, zero, jnp.where(chosen == 1, one, two))


def _number(count: int) -> jax.Array:
    """Number rows of pairs from 0, (count, 1)."""
    return jnp.arange(count)[:, None]


def _best(scores: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the greatest of scores (n, P), and which; the first of equal ones."""
    scores = _once(scores)
    return jnp.max(scores, axis=0), jnp.argmax(scores, axis=0)


def _dot(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the products of vectors (3, ...)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _sign(x: jax.Array) -> jax.Array:
    return jnp.where(jax.lax.stop_gradient(x) < 0, -1.0, 1.0).astype(x.dtype)


def _seen(own: _Box, other: _Box) -> tuple[jax.Array, jax.Array]:
    """Return how a box sees another: its axes (3 own, 3 of the other, P) and place."""
    u, v = own.axes.swapaxes(0, 1), other.axes.swapaxes(0, 1)
    turn = _dot(u[:, :, None], v[:, None])
    return turn, _dot(u, (other.place - own.place)[:, None])


def _choose(first: _Box, second: _Box) -> _Choice:
    """Find the axes of least overlap, of faces and of edges."""
    turn, shift = _once(_seen(first, second))
    a, b = first.half, second.half
    lean = abs(turn)
    size = jnp.max(a, axis=0) + jnp.max(b, axis=0)
    ours = abs(shift) - a - _dot(lean.swapaxes(0, 1), b[:, None])
    theirs = abs(_dot(turn, shift[:, None])) - b - _dot(lean, a[:, None])
    # Between equal faces the first box's is taken, whatever the rounding.
    face_gap, face = _best(jnp.concatenate([ours, theirs - _ROUNDING * size]))

    # Edge i of the first box and j of the second: (3, 3, P). Their normal is
    # (0, -y, x), e_i x the second's axis, seen from the first.
    _, x, y = _turns(turn)
    (_, a1, a2), (_, s1, s2) = _turns(a[:, None]), _turns(shift[:, None])
    _, b1, b2 = _turns(b[:, None])
    _, lean1, lean2 = _turns(lean.swapaxes(0, 1))
    reach = a1 * abs(y) + a2 * abs(x) + (b1 * lean2 + b2 * lean1).swapaxes(0, 1)
    # Close to parallel, rounding is most of what is left of a gap.
    reach = reach + 4 * jnp.finfo(size.dtype).eps * size
    square = x * x + y * y
    able = square > _PARALLEL
    scale = jax.lax.rsqrt(jnp.where(able, square, 1.0))
    gap = jnp.where(able, (abs(s2 * x - s1 * y) - reach) * scale, -jnp.inf)
    edge_gap, edge = _best(gap.reshape(9, -1))
    return _Choice(
        swap=face > 2,
        axis=jnp.where(face > 2, face - 3, face),
        face_gap=face_gap,
        edges=(edge // 3, edge % 3),
        edge_gap=edge_gap,
    )


def _prefers_edges(a: _Box, b: _Box, chosen: _Choice, distance: jax.Array) -> jax.Array:
    """Return where (P,) edges are clearly shallower than faces, by the rule of hulls.

    Than the axis of the face, and than all points in which the faces meet: these may be
    no deeper than the edges where a corner elsewhere is.
    """
    sizes = jax.lax.stop_gradient((a.half, b.half))
    long_a, long_b = (jnp.max(x, axis=0) for x in sizes)
    slack, slop = _ROUNDING * (long_a + long_b), FACE_SLOP * jnp.minimum(long_a, long_b)
    edge, face = chosen.edge_gap, chosen.face_gap
    crossing = edge * jnp.where(edge < 0, 1 / FACE_BIAS, FACE_BIAS)
    deepest = jnp.min(distance, axis=0)
    clearly = (crossing > deepest + slack) | (edge > face + slop)
    return (crossing > face + slack) & clearly


def _face_contacts(
    own: _Box, other: _Box, axis: jax.Array, margin: jax.Array
) -> engine.Points:
    """Collide the face of a box across one of its axes (P,) with another box.

    Candidates are the edges of the face that looks most against it, cut off at its
    sides, and its own corners within that face; if none of them is closer than the
    margin (P,), the other box's lowest corner.

    Returns:
      Distances (4, P), points (3, 4, P) and the outward normal (3, P).
    """
    turn, shift = _seen(own, other)
    # The normal first, then two directions across.
    turn, shift, half, frame = _once(
        tuple(_first(x, axis) for x in (turn, shift, own.half, own.axes))
    )
    side = _sign(shift[0])
    _, facing = _best(jax.lax.stop_gradient(abs(turn[0])))
    # Heights are outward, whichever of the two faces it is.
    outward = jnp.where(_number(3) == 0, side, 1.0)
    turn = turn * outward[:, None]
    # From the other's centre to its lowest corner, an axis at a time.
    arms = (-_sign(turn[0]) * other.half)[:, None] * turn.swapaxes(0, 1)
    down, p, q = _first(arms, facing)
    center = shift * outward + down - jnp.where(_number(3) == 0, half, 0.0)
    center, p, q = _once((center, p, q))
    corners, real = _meeting(center, p, q, half)
    counts, kept = _outline(corners, real & (corners[0] < margin))
    alone = ~counts[0] & (_number(POINTS) == 0)
    counts, kept = counts | alone, jnp.where(alone, (center + p + q)[:, None], kept)
    height, normal = kept[0], side * frame[0]
    point = normal[:, None] * (half[0] + 0.5 * height)
    point = point + frame[1][:, None] * kept[1] + frame[2][:, None] * kept[2]
    return jnp.where(counts, height, FAR), own.place[:, None] + point, normal


def _meeting(
    center: jax.Array, p: jax.Array, q: jax.Array, half: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the corners of where two faces meet.

    Args:
      center: (3, P) of one face: its height over the other one, and where across, m.
      p: (3, P) from there to the middle of a side, m.
      q: (3, P) from there to the middle of the next side, m.
      half: (3, P) half extents of the other face; the first is not read, m.

    Returns:
      Twelve points, (3, 12, P), and which of them are there, (12, P).
    """
    along = jnp.stack([p, p, q, q], axis=1)
    middle = center[:, None] + jnp.stack([q, -q, p, -p], axis=1)
    # What hardly moves across two sides is between them or not. (2, 4, P)
    limit, way, place = half[1:, None], along[1:], middle[1:]
    crosses = abs(way) > 1e-9 * limit
    slope = 1 / jnp.where(crosses, way, 1.0)
    reach = jnp.where(crosses, limit * abs(slope), 2.0)
    between = jnp.where(crosses, -place * slope, 0.0)
    low, high = _once((between - reach, between + reach))
    low = jnp.maximum(jnp.maximum(low[0], low[1]), -1.0)
    high = jnp.minimum(jnp.minimum(high[0], high[1]), 1.0)
    inside = crosses | (abs(place) <= limit)
    real = inside[0] & inside[1] & (low <= high)
    low, high = jnp.clip(low, -1.0, 1.0), jnp.clip(high, -1.0, 1.0)

    x, y = half[1], half[2]
    corner = jnp.stack([jnp.stack([x, x, -x, -x]), jnp.stack([y, -y, y, -y])])
    x, y = corner - center[1:, None]
    area = 1 / (p[1] * q[2] - p[2] * q[1])
    s, t = (x * q[2] - y * q[1]) * area, (p[1] * y - p[2] * x) * area
    # A corner on a corner is within at least one of the two faces.
    within = jnp.maximum(abs(s), abs(t)) <= 1 + _ROUNDING
    height = center[0] + s * p[0] + t * q[0]
    corner = jnp.concatenate([height[None], corner])
    points = [middle + low * along, middle + high * along, corner]
    return jnp.concatenate(points, axis=1), jnp.concatenate([real, real, within])


def _outline(points: jax.Array, real: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Choose the deepest point of n (3, n, P) that are real, and three that span most.

    Returns:
      Which of them count, (4, P): what coincides with another one, or lies between two,
      does not; and the points, (3, 4, P).
    """
    points, real = _once((points, real))
    still = jax.lax.stop_gradient(points)
    number = _number(real.shape[0])

    def best(score: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        score, chosen = _best(jnp.where(real, score, -jnp.inf))
        # A sum of one is a gather that runs along the pairs.
        point = jnp.sum(jnp.where(number == chosen, points, 0.0), axis=1)
        return score, point, jax.lax.stop_gradient(point)[:, None]

    def area(start: jax.Array, end: jax.Array, x: jax.Array) -> jax.Array:
        along, away = end - start, x - start
        return along[1] * away[2] - along[2] * away[1]

    deepest, one, a = best(_SLOPE[0] * still[1] + _SLOPE[1] * still[2] - still[0])
    square, two, b = best((still[1] - a[1]) ** 2 + (still[2] - a[2]) ** 2)
    width, three, c = best(abs(area(a, b, still)))
    around = _sign(area(a, b, c))
    sides = area(b, a, still), area(c, b, still), area(a, c, still)
    more, four = best(functools.reduce(jnp.maximum, [around * x for x in sides]))[:2]
    least = _ROUNDING * square
    counts = deepest > -jnp.inf, square > 0, width > least, more > least
    return jnp.stack(counts), jnp.stack([one, two, three, four], axis=1)


def _edge_contact(
    first: _Box, second: _Box, edges: tuple[jax.Array, jax.Array]
) -> engine.Points:
    """Return gap (P,), middle (3, P) and normal (3, P) of where edges cross."""
    turn, shift = _seen(first, second)
    turn, shift, a, frame = _once(
        tuple(_first(x, edges[0]) for x in (turn, shift, first.half, first.axes))
    )
    columns, b = (_first(x, edges[1]) for x in (turn.swapaxes(0, 1), second.half))
    columns, b = _once((columns, b))
    # The first box's edge runs along x, the second's along r; (0, y, z) is normal.
    r = columns[0]
    square = r[1] * r[1] + r[2] * r[2]
    able = jax.lax.stop_gradient(square) > _PARALLEL
    square = jnp.where(able, square, 1.0)
    scale = jax.lax.rsqrt(square) * _sign(shift[2] * r[1] - shift[1] * r[2])
    y, z = -r[2] * scale, r[1] * scale
    # Both edges are where their boxes reach furthest towards each other.
    reach = _sign(y * columns[1:, 1] + z * columns[1:, 2]) * b[1:]
    end = shift - columns[1] * reach[0] - columns[2] * reach[1]
    normal = jnp.stack([jnp.zeros_like(y), y, z])
    start = jnp.where(_number(3) == 0, 0.0, _sign(normal) * a)
    offset = end - start
    gap = offset[1] * y + offset[2] * z
    on_second = -(offset[1] * r[1] + offset[2] * r[2]) / square
    on_second = jnp.clip(on_second, -b[0], b[0])
    on_first = jnp.clip(offset[0] + on_second * r[0], -a[0], a[0])
    start = start + jnp.where(_number(3) == 0, on_first, 0.0)
    middle = 0.5 * (end + start + on_second * r)
    middle, y, z = _once((middle, y, z))
    point = first.place + _dot(frame, middle[:, None])
    return gap, point, y * frame[1] + z * frame[2]


def _frame(normal: jax.Array) -> jax.Array:
    """Return the axes of contacts, (9, P), as MuJoCo completes a normal (3, P)."""
    x, y, z = normal
    upright = abs(jax.lax.stop_gradient(y)) >= 0.5
    # What is left of e_z or e_y beside the normal.
    away = jnp.where(upright, z, y)
    first = jnp.where(_number(3) == jnp.where(upright, 2, 1), 1.0, 0.0) - away * normal
    first = first * jax.lax.rsqrt(_dot(first, first))
    u, v, w = first
    second = jnp.stack([y * w - z * v, z * u - x * w, x * v - y * u])
    return jnp.concatenate([normal, first, second])
