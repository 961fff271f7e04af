"""Collisions of boxes, all pairs side by side.

Two boxes are parted by the axis of least overlap among 15: the normals of either, and
the crossings of their edges (separating axes). Two faces give an outline of the region
in which they meet, four points of it; two edges give one point. The choice of features
is piecewise constant; depth, place and normal are differentiable in poses and sizes
between its jumps.

Components come first and pairs last, (3, P) or (3, 3, P), so that every operation runs
along the pairs. Whatever depends on a choice among three axes turns its arrays until
the chosen one is the first: what follows is the same for all pairs. Everything is
relative to one box of a pair, so nothing is lost far from the world's origin. Sizes:
P pairs.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from blastjax import pytree
from blastjax.rigid import engine
from blastjax.rigid.hull import FACE_BIAS, FACE_SLOP, FAR

POINTS = 4
"""Contacts of a pair."""
_ROUNDING = 1e-5
"""Of a pair's size, what is taken for equal, in float32 too."""
_SLOPE = (0.9e-4, 0.4e-4)
"""Settles which point of faces that lie flat on each other is the deepest."""


@pytree.dataclass
class _Box(pytree.Node):
    """The first or second box of each pair."""

    place: jax.Array
    """(3, P) m."""
    turn: jax.Array
    """(3, 3, P) its axes, as columns."""
    half: jax.Array
    """(3, P) half extents, m."""


@pytree.dataclass
class _Choice(pytree.Node):
    """The axes along which pairs overlap least; constant."""

    swap: jax.Array
    """(P,) whether the best face is the second box's."""
    axis: jax.Array
    """(P,) which of its axes."""
    face_gap: jax.Array
    """(P,) along it, negative where they overlap, m."""
    edges: jax.Array
    """(2, P) axes of the best edges of either box."""
    edge_gap: jax.Array
    """(P,) along their common normal, m; minus infinity if all are parallel."""
    size: jax.Array
    """(2, P) longest half extent of either box, m."""


def box_box(model: mjx.Model, data: mjx.Data, pair: jax.Array) -> engine.Points:
    """Collide boxes with boxes: four points between faces, one between edges."""
    a, b = (_box(model, data, pair[:, side]) for side in (0, 1))
    margin = model.geom_margin[pair].sum(axis=1)
    chosen = _choose(*jax.lax.stop_gradient((a, b)))

    swapped = functools.partial(jnp.where, chosen.swap)
    own, other = jax.tree.map(swapped, b, a), jax.tree.map(swapped, a, b)
    distance, point, outward = _face_contacts(own, other, chosen.axis, margin)
    normal = jnp.where(chosen.swap, -outward, outward)
    by_edges = _prefers_edges(chosen, jax.lax.stop_gradient(distance))
    gap, place, across = _edge_contact(a, b, chosen.edges)
    single = jnp.full_like(distance, FAR).at[0].set(gap)
    distance = jnp.where(by_edges, single, distance)
    point = jnp.where(by_edges, place[:, None], point)
    normal = jnp.where(by_edges, across, normal)

    # Behind a barrier, or XLA computes all of it in the order of the result.
    distance, point, normal = jax.lax.optimization_barrier((distance, point, normal))
    frame = jax.vmap(engine.contact_frame)(normal.T)
    return (
        distance.T.reshape(-1),
        point.transpose(2, 1, 0).reshape(-1, 3),
        jnp.repeat(frame, POINTS, axis=0),
    )


def _box(model: mjx.Model, data: mjx.Data, geom: jax.Array) -> _Box:
    return _Box(
        place=data.geom_xpos[geom].T,
        turn=data.geom_xmat[geom].transpose(1, 2, 0),
        half=model.geom_size[geom].T,
    )


def _seen(own: _Box, other: _Box) -> tuple[jax.Array, jax.Array]:
    """Return another box's axes, (3, 3, P) as columns, and centre in the own frame."""
    turn = jnp.sum(own.turn[:, :, None] * other.turn[:, None, :], axis=0)
    return turn, _into(own.turn, other.place - own.place)


def _into(turn: jax.Array, vector: jax.Array) -> jax.Array:
    """Return R' v of matrices (3, 3, P) and vectors (3, P)."""
    return jnp.sum(turn * vector[:, None], axis=0)


def _first(x: jax.Array, chosen: jax.Array, axis: int = 0) -> jax.Array:
    """Turn an axis of three until the chosen (P,) entry comes first."""
    once, twice = jnp.roll(x, -1, axis), jnp.roll(x, -2, axis)
    return jnp.where(chosen == 0, x, jnp.where(chosen == 1, once, twice))


def _sign(x: jax.Array) -> jax.Array:
    return jnp.where(jax.lax.stop_gradient(x) < 0, -1.0, 1.0).astype(x.dtype)


def _choose(first: _Box, second: _Box) -> _Choice:
    """Find the axes of least overlap, of faces and of edges."""
    turn, shift = _seen(first, second)
    a, b, leans = first.half, second.half, jnp.abs(turn)
    size = jnp.stack([jnp.max(a, axis=0), jnp.max(b, axis=0)])
    total = jnp.sum(size, axis=0)
    gap_a = jnp.abs(shift) - a - jnp.sum(leans * b[None], axis=1)
    gap_b = jnp.abs(_into(turn, shift)) - b - jnp.sum(leans * a[:, None], axis=0)
    # Between equal faces the first box's is taken, whatever the rounding.
    gaps = jnp.concatenate([gap_a, gap_b - _ROUNDING * total])
    face = jnp.argmax(gaps, axis=0)

    def one(x: jax.Array) -> jax.Array:
        return jnp.roll(x, -1, axis=0)

    def two(x: jax.Array) -> jax.Array:
        return jnp.roll(x, -2, axis=0)

    # Of edges along e_i and r_j, the j-th column, the normal is e_i x r_j.
    apart = jnp.abs(two(shift)[:, None] * one(turn) - one(shift)[:, None] * two(turn))
    reach_a = one(a)[:, None] * two(leans) + two(a)[:, None] * one(leans)
    across = leans.swapaxes(0, 1)
    reach_b = one(b)[:, None] * two(across) + two(b)[:, None] * one(across)
    square = one(turn) ** 2 + two(turn) ** 2
    able = square > 1e-6
    # Close to parallel, rounding is most of what is left of a gap.
    rounding = 4 * jnp.finfo(turn.dtype).eps * total
    gap = apart - reach_a - reach_b.swapaxes(0, 1) - rounding
    gap = gap * jax.lax.rsqrt(jnp.where(able, square, 1.0))
    gap = jnp.where(able, gap, -jnp.inf).reshape(9, -1)
    crossing = jnp.argmax(gap, axis=0)
    return _Choice(
        swap=face >= 3,
        axis=face % 3,
        face_gap=jnp.max(gaps, axis=0),
        edges=jnp.stack([crossing // 3, crossing % 3]),
        edge_gap=jnp.max(gap, axis=0),
        size=size,
    )


def _prefers_edges(chosen: _Choice, distance: jax.Array) -> jax.Array:
    """Return where (P,) edges are clearly shallower than faces, by the rule of hulls.

    Than the axis of the face, and than all points (4, P) in which the faces meet: these
    may be no deeper than the edges where a corner elsewhere is.
    """
    edge, slack = chosen.edge_gap, _ROUNDING * jnp.sum(chosen.size, axis=0)
    crossing = edge * jnp.where(edge < 0, 1 / FACE_BIAS, FACE_BIAS)
    deepest = jnp.min(distance, axis=0)
    slop = FACE_SLOP * jnp.min(chosen.size, axis=0)
    clearly = (crossing > deepest + slack) | (edge > chosen.face_gap + slop)
    return (crossing > chosen.face_gap + slack) & clearly


def _face_contacts(
    own: _Box, other: _Box, axis: jax.Array, margin: jax.Array
) -> engine.Points:
    """Collide the face of a box across one of its axes (P,) with another box.

    Candidates are the edges of the face that looks most against it, cut off at its
    sides, and its own corners within that face; if none of them is closer than the
    margin (P,), the other box's lowest corner.

    Returns:
      Distances (4, P), points (3, 4, P) and outward normals (3, P).
    """
    turn, shift = _seen(own, other)
    # The normal first, then two directions across.
    turn, shift, half = (_first(x, axis) for x in (turn, shift, own.half))
    side = _sign(shift[0])
    downward = -_sign(side * turn[0])
    facing = jnp.argmax(jnp.abs(jax.lax.stop_gradient(turn[0])), axis=0)
    arms = _first(turn * (downward * other.half), facing, axis=1)
    lowest = shift + jnp.sum(arms, axis=1)
    center, p, q = shift + arms[:, 0], arms[:, 1], arms[:, 2]

    middle = jnp.stack([center + q, center + p, center - q, center - p], axis=1)
    along = jnp.stack([p, q, p, q], axis=1)
    low, high, inside = _cut(middle[1:], along[1:], half[1:, None])
    corner, within = _corners(center, p, q, half)
    candidates = jnp.concatenate(
        [middle + low * along, middle + high * along, corner], axis=1
    )
    valid = jnp.concatenate([inside, inside, within])
    distance = side * candidates[0] - half[0]
    valid &= distance < margin
    chosen, on = _outline(*jax.lax.stop_gradient((candidates[1:], distance)), valid)
    # A sum of one is a gather that runs along the pairs.
    kept = jnp.sum(jnp.where(chosen, candidates[:, None], 0.0), axis=2)
    none = ~on[0]
    kept = kept.at[:, 0].set(jnp.where(none, lowest, kept[:, 0]))
    on = on.at[0].set(True)

    distance = side * kept[0] - half[0]
    middle = kept.at[0].set(side * (half[0] + 0.5 * distance))
    frame = _first(own.turn, axis, axis=1)
    point = own.place[:, None] + jnp.sum(frame[:, :, None] * middle[None], axis=1)
    return jnp.where(on, distance, FAR), point, side * frame[:, 0]


def _cut(
    middle: jax.Array, along: jax.Array, limit: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Cut edges off at the sides of a rectangle.

    Args:
      middle: (2, 4, P) of each edge, m.
      along: (2, 4, P) from there to its end, m.
      limit: (2, 1, P) half extents of the rectangle, m.

    Returns:
      From where to where, from -1 to 1, edges are within, and which are, (4, P).
    """
    # What hardly moves across a side is before it or beyond it.
    crosses = jnp.abs(along) > 1e-9 * limit
    safe = jnp.where(crosses, along, 1.0)
    between = jnp.abs(middle) <= limit
    center = jnp.where(crosses, -middle / safe, 0.0)
    reach = jnp.where(crosses, limit / jnp.abs(safe), jnp.where(between, 2.0, -2.0))
    low = jnp.max(center - reach, axis=0)
    high = jnp.min(center + reach, axis=0)
    inside = (low <= high) & (low <= 1) & (high >= -1)
    return jnp.clip(low, -1.0, 1.0), jnp.clip(high, -1.0, 1.0), inside


def _corners(
    center: jax.Array, p: jax.Array, q: jax.Array, half: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return a face's corners on another face (3, 4, P), and which are within (4, P).

    The other face is center + s p + t q for s and t from -1 to 1.
    """
    signs = np.array([[1, 1, -1, -1], [1, -1, -1, 1]])[..., None]
    place = signs.astype(half.dtype) * half[1:, None]
    x, y = place - center[1:, None]
    area = p[1] * q[2] - p[2] * q[1]
    s, t = (x * q[2] - y * q[1]) / area, (p[1] * y - p[2] * x) / area
    height = center[0] + s * p[0] + t * q[0]
    # Corners on corners are within at least one of the two faces.
    within = jnp.maximum(jnp.abs(s), jnp.abs(t)) <= 1 + _ROUNDING
    return jnp.concatenate([height[None], place]), within


def _outline(
    place: jax.Array, distance: jax.Array, valid: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Choose the deepest of n points, and three more that span most area with it.

    Args:
      place: (2, n, P) across the normal, m.
      distance: (n, P) m.
      valid: (n, P) which may be chosen.

    Returns:
      Which they are (4, n, P) bool, and which of them count (4, P) bool: those that
      neither coincide nor lie between the others.
    """
    count = jnp.arange(place.shape[1])[:, None]

    def best(score: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        score = jnp.where(valid, score, -jnp.inf)
        mask = count == jnp.argmax(score, axis=0)
        point = jnp.sum(jnp.where(mask, place, 0.0), axis=1)
        return mask, point[:, None], jnp.max(score, axis=0)

    def area(start: jax.Array, end: jax.Array) -> jax.Array:
        (x, y), (u, v) = end - start, place - start
        return x * v - y * u

    one, a, deepest = best(_SLOPE[0] * place[0] + _SLOPE[1] * place[1] - distance)
    two, b, square = best(jnp.sum((place - a) ** 2, axis=0))
    three, c, width = best(jnp.abs(area(a, b)))
    around = jnp.sum(jnp.where(three, area(a, b), 0.0), axis=0)
    outside = [area(b, a), area(c, b), area(a, c)]
    four, _, more = best(jnp.max(jnp.stack(outside) * _sign(around), axis=0))
    least = _ROUNDING * square
    on = deepest > -jnp.inf, square > 0, width > least, more > least
    return jnp.stack([one, two, three, four]), jnp.stack(on)


def _edge_contact(
    first: _Box, second: _Box, edges: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return gap (P,), middle (3, P) and normal (3, P) where edges (2, P) cross."""
    turn, shift = _seen(first, second)
    turn = _first(_first(turn, edges[0]), edges[1], axis=1)
    shift, a = _first(shift, edges[0]), _first(first.half, edges[0])
    b = _first(second.half, edges[1])
    # The first box's edge runs along x, the second's along r.
    r = turn[:, 0]
    square = r[1] ** 2 + r[2] ** 2
    able = jax.lax.stop_gradient(square) > 1e-6
    scale = jax.lax.rsqrt(jnp.where(able, square, 1.0))
    scale = scale * _sign(shift[2] * r[1] - shift[1] * r[2])
    y, z = -r[2] * scale, r[1] * scale
    # Their places across: where the boxes reach furthest to each other.
    from_y, from_z = _sign(y) * a[1], _sign(z) * a[2]
    arm = [-_sign(y * turn[1, k] + z * turn[2, k]) * b[k] for k in (1, 2)]
    start = shift + arm[0] * turn[:, 1] + arm[1] * turn[:, 2]
    across = start[1] - from_y, start[2] - from_z
    gap = across[0] * y + across[1] * z
    on_second = -(across[0] * r[1] + across[1] * r[2]) / jnp.where(able, square, 1.0)
    on_second = jnp.clip(on_second, -b[0], b[0])
    on_first = jnp.clip(start[0] + on_second * r[0], -a[0], a[0])
    middle = 0.5 * (start + on_second * r + jnp.stack([on_first, from_y, from_z]))
    frame = _first(first.turn, edges[0], axis=1)
    point = first.place + jnp.sum(frame * middle[None], axis=1)
    return gap, point, frame[:, 1] * y + frame[:, 2] * z
