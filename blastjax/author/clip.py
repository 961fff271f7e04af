"""Areas that triangles share, many pairs at a time. Plain numpy.

Polygons are convex rows of corners (K, M, D); a row with fewer corners repeats its
last, which adds no area. Clipping keeps what lies on one side of a plane.
"""

import numpy as np

ROUNDING = 1e-9
"""Height over a plane, relative to the greatest of a polygon's, that counts as none."""


def by_plane(polygon: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Return the part of each polygon where the height is not above zero.

    Args:
      polygon: (K, M, D) corners.
      height: (K, M) of each corner above its plane.

    Returns:
      (K, M + 1, D): a cut through a convex polygon adds one corner at most. Where
      nothing is left, all corners are one point.
    """
    count, corners, _ = polygon.shape
    # Corners on the plane to within rounding are inside: if some of them were not, an
    # edge along the plane could cross it more than once.
    inside = height <= ROUNDING * np.abs(height).max(axis=1, keepdims=True)
    following, beyond = np.roll(polygon, -1, axis=1), np.roll(height, -1, axis=1)
    crosses = inside != np.roll(inside, -1, axis=1)
    rise = np.where(crosses, beyond - height, 1.0)
    share = np.where(crosses, np.clip(-height / rise, 0, 1), 0.0)[..., None]
    crossing = polygon + share * (following - polygon)
    points = np.stack([polygon, crossing], axis=2).reshape(count, 2 * corners, -1)
    real = np.stack([inside, crosses], axis=2).reshape(count, 2 * corners)
    order = np.argsort(~real, axis=1, kind="stable")[:, : corners + 1]
    last = np.maximum(real.sum(axis=1) - 1, 0)
    order = np.take_along_axis(
        order, np.minimum(np.arange(corners + 1), last[:, None]), axis=1
    )
    return np.take_along_axis(points, order[..., None], axis=1)


def vector_area(polygon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return area times normal (K, 3), and centroid (K, 3), of flat polygons (K, M, 3).

    The centroid of a polygon without area is its first corner.
    """
    first = polygon[:, :1]
    arms = polygon - first
    fan = np.cross(arms[:, 1:-1], arms[:, 2:]) / 2
    total = fan.sum(axis=1)
    length = np.linalg.norm(total, axis=1)
    unit = total / np.where(length > 0, length, 1.0)[:, None]
    weight = np.einsum("kmi,ki->km", fan, unit)
    middle = (arms[:, 1:-1] + arms[:, 2:]) / 3
    moment = np.einsum("km,kmi->ki", weight, middle)
    safe = np.where(length > 0, length, 1.0)[:, None]
    return total, first[:, 0] + moment / safe


def shared(
    one: np.ndarray, other: np.ndarray, normal: np.ndarray, gap: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return area (K,) and centroid (K, 3) of what triangles share, seen along normals.

    Args:
      one: (K, 3, 3) corners.
      other: (K, 3, 3) corners.
      normal: (K, 3) unit; both triangles are projected along it onto the plane through
        the mean of their middles, where the centroid lies.
      gap: only where their planes are no farther apart along the normal, m.
    """
    middle = (one.mean(axis=1) + other.mean(axis=1))[:, None] / 2

    def flat(triangle: np.ndarray) -> np.ndarray:
        arm = triangle - middle
        return arm - np.einsum("kmi,ki->km", arm, normal)[..., None] * normal[:, None]

    polygon, frame = flat(one), flat(other)
    turn = np.einsum("ki,ki->k", vector_area(frame)[0], normal)
    frame = np.where((turn < 0)[:, None, None], frame[:, ::-1], frame)
    for i in range(3):
        start, end = frame[:, i], frame[:, (i + 1) % 3]
        outward = np.cross(end - start, normal)
        height = np.einsum("kmi,ki->km", polygon - start[:, None], outward)
        polygon = by_plane(polygon, height)
    for sign in (1, -1):
        apart = _height(other - middle, polygon, normal) - _height(
            one - middle, polygon, normal
        )
        polygon = by_plane(polygon, sign * apart - gap)
    total, centroid = vector_area(polygon)
    return np.linalg.norm(total, axis=1), centroid + middle[:, 0]


def _height(triangle: np.ndarray, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return how far above points (K, M, 3) the triangle's plane is, (K, M)."""
    own = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
    rise = np.einsum("ki,ki->k", own, normal)[:, None]
    arm = np.einsum("kmi,ki->km", triangle[:, :1] - point, own)
    return arm / np.where(rise == 0, 1.0, rise)
