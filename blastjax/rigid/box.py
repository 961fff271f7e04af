"""Collisions of boxes, all pairs side by side.

Two boxes are parted by the axis of least overlap among 15: the normals of either, and
the crossings of their edges (separating axes). Two faces give an outline of the region
in which they meet, four points of it; two edges give one point. The choice of features
is piecewise constant; depth, place and normal are differentiable in poses and sizes
between its jumps.

Every number is an array of pairs, (P,) or (n, P), and vectors are tuples: only so a
compiler for CPUs runs along the pairs with all its lanes, ten times faster than with
rows of three numbers. What depends on a choice among three axes turns its tuples until
the chosen one is the first. Everything is relative to one box of a pair, so nothing is
lost far from the world's origin. Sizes: P pairs.
"""

import functools
import itertools
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

Vector = tuple[jax.Array, ...]
"""Its components, (P,) each."""


class _Box(NamedTuple):
    """The first, or the second, box of each pair."""

    place: Vector
    """Its centre, m."""
    axes: tuple[Vector, ...]
    """Its three axes, of unit length."""
    half: Vector
    """Half extents along them, m."""


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
    single = jnp.full_like(distance, FAR).at[0].set(gap)
    by_edges = _prefers_edges(a, b, chosen, jax.lax.stop_gradient(distance))
    distance = jnp.where(by_edges, single, distance)
    point = jnp.where(by_edges, place[:, None], point)
    normal = jnp.where(by_edges, across, jnp.where(chosen.swap, -outward, outward))
    axes = [x for axis in _frame(tuple(normal)) for x in axis]
    # From pairs last to pairs first, in one go.
    rows = _once((*distance, *point.reshape(-1, len(pair)), *axes))
    found = jnp.stack(rows).T
    points = found[:, POINTS:-9].reshape(-1, 3, POINTS).transpose(0, 2, 1)
    frame = jnp.repeat(found[:, -9:].reshape(-1, 3, 3), POINTS, axis=0)
    return found[:, :POINTS].reshape(-1), points.reshape(-1, 3), frame


def _box(model: mjx.Model, data: mjx.Data, geom: jax.Array) -> _Box:
    axes = data.geom_xmat[geom].transpose(2, 1, 0)
    return _Box(
        place=tuple(data.geom_xpos[geom].T),
        axes=tuple(tuple(axis) for axis in axes),
        half=tuple(model.geom_size[geom].T),
    )


_once = jax.lax.optimization_barrier
"""Compute this once, and not again for each of its uses."""


def _where(condition: jax.Array, yes: Any, no: Any) -> Any:
    """Select between two trees of arrays (P,)."""
    return jax.tree.map(functools.partial(jnp.where, condition), yes, no)


def _first(three: Any, chosen: jax.Array) -> Any:
    """Turn a tuple of three until the chosen (P,) entry is the first."""
    x, y, z = three
    later = _where(chosen == 1, (y, z, x), (z, x, y))
    return _where(chosen == 0, (x, y, z), later)


def _best(scores: Any) -> tuple[jax.Array, jax.Array]:
    """Return the greatest of scores (P,), and which it is; the first of equal ones."""
    stack = jnp.stack(_once(scores))
    return jnp.max(stack, axis=0), jnp.argmax(stack, axis=0)


def _dot(a: Vector, b: Vector) -> jax.Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _add(a: Vector, b: Vector, times: jax.Array | float = 1.0) -> Vector:
    """Return a + times b."""
    return tuple(x + times * y for x, y in zip(a, b, strict=True))


def _sign(x: jax.Array) -> jax.Array:
    return jnp.where(jax.lax.stop_gradient(x) < 0, -1.0, 1.0).astype(x.dtype)


def _longest(box: _Box) -> jax.Array:
    return jnp.maximum(jnp.maximum(box.half[0], box.half[1]), box.half[2])


def _seen(own: _Box, other: _Box) -> tuple[Any, Vector]:
    """Return the cosines of own axes (rows) with another's, and its centre, as seen."""
    turn = tuple(tuple(_dot(x, y) for y in other.axes) for x in own.axes)
    offset = _add(other.place, own.place, -1.0)
    return turn, tuple(_dot(x, offset) for x in own.axes)


def _choose(first: _Box, second: _Box) -> _Choice:
    """Find the axes of least overlap, of faces and of edges."""
    turn, shift = _once(_seen(first, second))
    a, b = first.half, second.half
    lean = tuple(tuple(map(jnp.abs, row)) for row in turn)
    size = _longest(first) + _longest(second)
    gaps = [abs(shift[i]) - a[i] - _dot(lean[i], b) for i in range(3)]
    for j, (cosine, leans) in enumerate(
        zip(zip(*turn, strict=True), zip(*lean, strict=True), strict=True)
    ):
        gap = abs(_dot(cosine, shift)) - b[j] - _dot(leans, a)
        # Between equal faces the first box's is taken, whatever the rounding.
        gaps.append(gap - _ROUNDING * size)
    face_gap, face = _best(gaps)

    # Close to parallel, rounding is most of what is left of a gap.
    rounding = 4 * jnp.finfo(size.dtype).eps * size
    gaps = []
    for i, j in itertools.product(range(3), repeat=2):
        i1, i2, j1, j2 = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
        # The normal is (0, -y, x): e_i x the second's axis, seen from the first.
        x, y = turn[i1][j], turn[i2][j]
        reach = a[i1] * abs(y) + a[i2] * abs(x) + b[j1] * lean[i][j2]
        reach = reach + b[j2] * lean[i][j1] + rounding
        square = x * x + y * y
        able = square > _PARALLEL
        scale = jax.lax.rsqrt(jnp.where(able, square, 1.0))
        gap = (abs(shift[i2] * x - shift[i1] * y) - reach) * scale
        gaps.append(jnp.where(able, gap, -jnp.inf))
    edge_gap, edge = _best(gaps)
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
    long_a, long_b = jax.lax.stop_gradient((_longest(a), _longest(b)))
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
    turn, shift, half = (_first(x, axis) for x in (turn, shift, own.half))
    frame = _first(own.axes, axis)
    turn, shift, half, frame = _once((turn, shift, half, frame))
    side = _sign(shift[0])
    heights = [jax.lax.stop_gradient(abs(x)) for x in turn[0]]
    _, facing = _best(heights)
    # From the other's centre to its lowest corner.
    arms = []
    for cosine, length in zip(zip(*turn, strict=True), other.half, strict=True):
        down = -_sign(side * cosine[0]) * length
        arms.append((down * side * cosine[0], down * cosine[1], down * cosine[2]))
    down, p, q = _first(tuple(arms), facing)
    center = _add((side * shift[0] - half[0], *shift[1:]), down)
    center, p, q = _once((center, p, q))
    lowest = _add(_add(center, p), q)
    corners, real = _meeting(center, p, q, half)
    kept = _outline(corners, real & (corners[0] < margin))
    none = ~kept[0][0]
    kept[0] = _where(none, (~none | none, lowest), kept[0])

    real = jnp.stack([x for x, _ in kept])
    height, x, y = (jnp.stack(z) for z in zip(*(z for _, z in kept), strict=True))
    middle = side * (half[0] + 0.5 * height)
    point = jnp.stack(
        [
            c + middle * u + x * v + y * w
            for c, u, v, w in zip(own.place, *frame, strict=True)
        ]
    )
    outward = jnp.stack([side * u for u in frame[0]])
    return jnp.where(real, height, FAR), point, outward


def _meeting(
    center: Vector, p: Vector, q: Vector, half: Vector
) -> tuple[Vector, jax.Array]:
    """Return the corners of where two faces meet.

    Args:
      center: of one face: its height over the other one, and where it is across, m.
      p: from there to the middle of a side, m.
      q: from there to the middle of the next side, m.
      half: (_, x, y) half extents of the other face across, m.

    Returns:
      Twelve points, (12, P) a component, and which of them are there, (12, P).
    """
    along = [jnp.stack([x, x, y, y]) for x, y in zip(p, q, strict=True)]
    middle = [
        jnp.stack([z + y, z - y, z + x, z - x])
        for x, y, z in zip(p, q, center, strict=True)
    ]
    low, high = -jnp.ones_like(middle[0]), jnp.ones_like(middle[0])
    real = jnp.ones_like(low, bool)
    for limit, place, way in zip(half[1:], middle[1:], along[1:], strict=True):
        # What hardly moves across two sides is between them or not.
        crosses = abs(way) > 1e-9 * limit
        slope = 1 / jnp.where(crosses, way, 1.0)
        reach = jnp.where(crosses, limit * abs(slope), 2.0)
        between = jnp.where(crosses, -place * slope, 0.0)
        real &= crosses | (abs(place) <= limit)
        low = jnp.maximum(low, between - reach)
        high = jnp.minimum(high, between + reach)
    real &= low <= high
    low, high = jnp.clip(low, -1.0, 1.0), jnp.clip(high, -1.0, 1.0)

    corner = [
        jnp.stack([x, x, -x, -x]) if k else jnp.stack([x, -x, x, -x])
        for k, x in enumerate(half[1:])
    ]
    x, y = corner[0] - center[1], corner[1] - center[2]
    area = 1 / (p[1] * q[2] - p[2] * q[1])
    s, t = (x * q[2] - y * q[1]) * area, (p[1] * y - p[2] * x) * area
    # A corner on a corner is within at least one of the two faces.
    within = jnp.maximum(abs(s), abs(t)) <= 1 + _ROUNDING
    corner = [center[0] + s * p[0] + t * q[0], *corner]
    points = tuple(
        jnp.concatenate([m + low * w, m + high * w, c])
        for m, w, c in zip(middle, along, corner, strict=True)
    )
    return points, jnp.concatenate([real, real, within])


def _outline(points: Vector, real: jax.Array) -> list[tuple[jax.Array, Vector]]:
    """Choose the deepest point of n that are real, and three that span most with it.

    Returns:
      Each, and whether it counts, (P,): what coincides with another one, or lies
      between two, does not.
    """
    still = jax.lax.stop_gradient(points)
    number = jnp.arange(real.shape[0])[:, None]

    def best(score: jax.Array) -> tuple[jax.Array, Vector]:
        score = jnp.where(real, score, -jnp.inf)
        mask = number == jnp.argmax(score, axis=0)
        # A sum of one is a gather that runs along the pairs.
        point = tuple(jnp.sum(jnp.where(mask, x, 0.0), axis=0) for x in points)
        return jnp.max(score, axis=0), point

    def area(start: Vector, end: Vector, x: Vector) -> jax.Array:
        along, away = _add(end, start, -1.0), _add(x, start, -1.0)
        return along[1] * away[2] - along[2] * away[1]

    deepest, one = best(_SLOPE[0] * still[1] + _SLOPE[1] * still[2] - still[0])
    a = jax.lax.stop_gradient(one)
    square, two = best((still[1] - a[1]) ** 2 + (still[2] - a[2]) ** 2)
    b = jax.lax.stop_gradient(two)
    width, three = best(abs(area(a, b, still)))
    c = jax.lax.stop_gradient(three)
    around = _sign(area(a, b, c))
    sides = area(b, a, still), area(c, b, still), area(a, c, still)
    more, four = best(functools.reduce(jnp.maximum, [around * x for x in sides]))
    least = _ROUNDING * square
    counts = deepest > -jnp.inf, square > 0, width > least, more > least
    return list(zip(counts, (one, two, three, four), strict=True))


def _edge_contact(
    first: _Box, second: _Box, edges: tuple[jax.Array, jax.Array]
) -> engine.Points:
    """Return gap (P,), middle (3, P) and normal (3, P) of where edges cross."""
    turn, shift = _seen(first, second)
    turn, shift, a = (_first(x, edges[0]) for x in (turn, shift, first.half))
    columns = _first(tuple(zip(*turn, strict=True)), edges[1])
    columns, shift, a = _once((columns, shift, a))
    b, frame = _first(second.half, edges[1]), _first(first.axes, edges[0])
    # The first box's edge runs along x, the second's along r; (0, y, z) is normal.
    r = columns[0]
    square = r[1] * r[1] + r[2] * r[2]
    able = jax.lax.stop_gradient(square) > _PARALLEL
    square = jnp.where(able, square, 1.0)
    scale = jax.lax.rsqrt(square) * _sign(shift[2] * r[1] - shift[1] * r[2])
    y, z = -r[2] * scale, r[1] * scale
    # Both edges are where their boxes reach furthest towards each other.
    end = shift
    for k in (1, 2):
        reach = _sign(y * columns[k][1] + z * columns[k][2]) * b[k]
        end = _add(end, columns[k], -reach)
    start = jnp.zeros_like(y), _sign(y) * a[1], _sign(z) * a[2]
    offset = _add(end, start, -1.0)
    gap = offset[1] * y + offset[2] * z
    on_second = -(offset[1] * r[1] + offset[2] * r[2]) / square
    on_second = jnp.clip(on_second, -b[0], b[0])
    on_first = jnp.clip(offset[0] + on_second * r[0], -a[0], a[0])
    middle = _add(_add(end, r, on_second), (on_first, *start[1:]))
    middle, y, z = _once((middle, y, z))
    point = first.place
    for axis, part in zip(frame, middle, strict=True):
        point = _add(point, axis, 0.5 * part)
    normal = [y * u + z * v for u, v in zip(*frame[1:], strict=True)]
    return gap, jnp.stack(point), jnp.stack(normal)


def _frame(normal: Vector) -> tuple[Vector, Vector, Vector]:
    """Return the axes of contacts, as MuJoCo completes a normal (3,) to them."""
    upright = abs(jax.lax.stop_gradient(normal[1])) >= 0.5
    one, zero = jnp.ones_like(normal[0]), jnp.zeros_like(normal[0])
    away = _where(upright, (zero, zero, one), (zero, one, zero))
    first = _add(away, normal, -_dot(away, normal))
    scale = jax.lax.rsqrt(_dot(first, first))
    first = tuple(x * scale for x in first)
    (x, y, z), (u, v, w) = normal, first
    return normal, first, (y * w - z * v, z * u - x * w, x * v - y * u)
