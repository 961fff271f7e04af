"""Small geometry on arrays: safe norms, distances, rotations.

Vectors are rows, (..., 3). Quaternions are (..., 4), w first, of unit length, as in
MuJoCo. Every function has a finite derivative everywhere: the input of a root or a
quotient is guarded, never its result.
"""

import jax
import jax.numpy as jnp


def dot(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the inner product of (..., 3) vectors, summed x, y, z.

    Differentiable, exactly.
    """
    # Written out because the order of summation is part of Blast's float32 results.
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def norm(vector: jax.Array) -> jax.Array:
    """Return the length of (..., 3) vectors; its derivative at zero is zero."""
    square = dot(vector, vector)
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def unit(vector: jax.Array) -> jax.Array:
    """Return (..., 3) vectors at length 1, or zero where they have no length.

    Differentiable; the derivative at zero is one over a length of one.
    """
    length = norm(vector)[..., None]
    return vector / jnp.where(length > 0, length, 1.0)


def ratio(numerator: jax.Array, denominator: jax.Array) -> jax.Array:
    """Return the quotient, or zero where the denominator is zero.

    Differentiable where the denominator is not zero; zero there.
    """
    safe = denominator != 0
    return jnp.where(safe, numerator / jnp.where(safe, denominator, 1.0), 0.0)


def point_to_segment(point: jax.Array, start: jax.Array, end: jax.Array) -> jax.Array:
    """Return the distance of (..., 3) points to the segment from start to end, m.

    Differentiable; the derivative at distance zero is zero.
    """
    along = end - start
    offset = point - start
    projected = dot(offset, along)
    square = dot(along, along)
    nearest = start + along * ratio(projected, square)[..., None]
    nearest = jnp.where((projected <= 0)[..., None], start, nearest)
    beyond = (projected > 0) & (square < projected)
    nearest = jnp.where(beyond[..., None], end, nearest)
    return norm(point - nearest)


def segment_hits_triangle(
    start: jax.Array, end: jax.Array, triangle: jax.Array
) -> jax.Array:
    """Return whether segments (..., 3) to (..., 3) cross a triangle (3, 3), bool.

    The edges of the triangle and a degenerate triangle are never hit; the ends of the
    segment reach 1e-4 of its length further, as in Blast.

    Piecewise constant: no derivative passes.
    """
    a, b, c = (jnp.broadcast_to(corner, start.shape) for corner in triangle)
    doubled = jnp.cross(b - a, c - a)
    normal = unit(doubled)
    denominator = dot(end - start, normal)
    t = ratio(dot(a, normal) - dot(start, normal), denominator)
    inside = (denominator != 0) & (t > -1e-4) & (t < 1 + 1e-4)
    point = start + (end - start) * t[..., None]
    area = dot(normal, doubled)
    v = ratio(dot(normal, jnp.cross(b - point, c - point)), area)
    w = ratio(dot(normal, jnp.cross(c - point, a - point)), area)
    return inside & (v > 0) & (w > 0) & (1 - v - w > 0)


def rotate(vector: jax.Array, quaternion: jax.Array) -> jax.Array:
    """Return (..., 3) vectors rotated by (..., 4) unit quaternions.

    Differentiable, exactly.
    """
    w, axis = quaternion[..., :1], quaternion[..., 1:]
    turn = 2.0 * jnp.cross(axis, vector)
    return vector + w * turn + jnp.cross(axis, turn)


def unit_quaternion(quaternion: jax.Array) -> jax.Array:
    """Return (..., 4) quaternions at length 1, or zero where they have no length.

    Differentiable; the derivative at zero is one over a length of one.
    """
    square = jnp.sum(quaternion * quaternion, axis=-1, keepdims=True)
    return quaternion * jax.lax.rsqrt(jnp.where(square > 0, square, 1.0))


def conjugate(quaternion: jax.Array) -> jax.Array:
    """Return the inverse rotation of (..., 4) unit quaternions.

    Differentiable, exactly.
    """
    return jnp.concatenate([quaternion[..., :1], -quaternion[..., 1:]], axis=-1)


def multiply(first: jax.Array, second: jax.Array) -> jax.Array:
    """Return the rotations by second, then by first, of (..., 4) unit quaternions.

    Differentiable, exactly.
    """
    a, b = first[..., :1], second[..., :1]
    u, v = first[..., 1:], second[..., 1:]
    axis = a * v + b * u + jnp.cross(u, v)
    return jnp.concatenate([a * b - dot(u, v)[..., None], axis], axis=-1)


def matrix(quaternion: jax.Array) -> jax.Array:
    """Return (..., 4) unit quaternions as rotation matrices (..., 3, 3).

    Differentiable, exactly.
    """
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
