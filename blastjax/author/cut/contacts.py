"""Faces that pieces share: where a cut left one on each of its sides."""

import dataclasses

import numpy as np

from blastjax.author.cut import geometry

SAME = 1e-9
"""Relative difference of two sides' areas up to which they are one face."""
LEAST = 1e-12
"""Shared areas below this part of the largest extent squared are rounding."""


@dataclasses.dataclass(frozen=True)
class Contacts:
    """Pairs of pieces with a face in common, in ascending order."""

    pieces: np.ndarray
    """(K, 2) the two pieces, the lower first."""
    area: np.ndarray
    """(K,) of what they share, m^2."""
    centroid: np.ndarray
    """(K, 3) of what they share, m."""
    normal: np.ndarray
    """(K, 3) unit normal, from the first to the second, weighted by area."""
    sides: np.ndarray
    """(K, 2) the area as the first and as the second piece's own faces give it, m^2."""


def find(
    corners: np.ndarray, piece: np.ndarray, facet: np.ndarray, scale: float
) -> Contacts:
    """Return the contacts between pieces.

    Args:
      corners: (T, 3, 3) triangles that cuts made, corner by corner.
      piece: (T,) the piece of each.
      facet: (T,) the planar facet of each; its two sides carry the same number.
      scale: extent of the solid, m.
    """
    vector = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    size = np.linalg.norm(vector, axis=1)
    sound = size > 0
    corners, piece, facet = corners[sound], piece[sound], facet[sound]
    vector, size = vector[sound], size[sound]
    order = np.lexsort((piece, facet))
    corners, piece, facet = corners[order], piece[order], facet[order]
    vector, size = vector[order], size[order]
    starts = np.flatnonzero(np.r_[True, facet[1:] != facet[:-1]])[: len(facet)]
    # The largest triangle says best where a facet's plane is.
    largest = _first_largest(size, starts)
    group = np.repeat(np.arange(len(starts)), np.diff(np.r_[starts, len(facet)]))
    before = np.einsum("ti,ti->t", vector, vector[largest][group]) > 0
    patches = _patches(corners, piece, group, before, vector, size)
    rows = [*_simple(patches), *_clipped(patches, corners, piece, group, before)]
    return _gather(rows, LEAST * scale**2)


@dataclasses.dataclass(frozen=True)
class _Patches:
    """What each piece has of each side of a facet."""

    group: np.ndarray
    before: np.ndarray
    piece: np.ndarray
    area: np.ndarray
    centroid: np.ndarray
    vector: np.ndarray
    simple: np.ndarray
    """(G,) facets of one piece on each side, of one area."""


def _first_largest(size: np.ndarray, starts: np.ndarray) -> np.ndarray:
    group = np.repeat(np.arange(len(starts)), np.diff(np.r_[starts, len(size)]))
    order = np.lexsort((np.arange(len(size)), -size, group))
    return order[starts]


def _patches(
    corners: np.ndarray,
    piece: np.ndarray,
    group: np.ndarray,
    before: np.ndarray,
    vector: np.ndarray,
    size: np.ndarray,
) -> _Patches:
    order = np.lexsort((piece, before, group))
    keys = np.stack([group, before, piece], axis=1)[order]
    starts = np.flatnonzero(np.r_[True, (keys[1:] != keys[:-1]).any(axis=1)])
    starts = starts[: len(keys)]
    group, side, piece = keys[starts].T

    def total(values: np.ndarray) -> np.ndarray:
        if not len(starts):
            return np.zeros((0, *values.shape[1:]))
        return np.add.reduceat(values[order], starts, axis=0)

    area = total(size)
    centroid = total(size[:, None] * corners.mean(axis=1)) / area[:, None]
    groups = int(group.max(initial=-1)) + 1
    behind_area = np.bincount(group, np.where(side == 0, area, 0), groups)
    before_area = np.bincount(group, np.where(side == 1, area, 0), groups)
    one_each = (np.bincount(group[side == 0], minlength=groups) == 1) & (
        np.bincount(group[side == 1], minlength=groups) == 1
    )
    same = np.abs(behind_area - before_area) <= SAME * (behind_area + before_area)
    return _Patches(
        group, side == 1, piece, area, centroid, total(vector), one_each & same
    )


def _simple(patches: _Patches) -> list[np.ndarray]:
    """Return rows of contacts for facets with one piece on each side."""
    picked = patches.simple[patches.group]
    behind = np.flatnonzero(picked & ~patches.before)
    before = np.flatnonzero(picked & patches.before)
    # A triangle whose normal points to the front belongs to the piece at the back.
    first, second = before, behind
    vector = (patches.vector[first] - patches.vector[second]) / 2
    area = (patches.area[first] + patches.area[second]) / 2
    centroid = (patches.centroid[first] + patches.centroid[second]) / 2
    return [
        np.column_stack(
            [
                patches.piece[first],
                patches.piece[second],
                area,
                centroid,
                vector,
                patches.area[first],
                patches.area[second],
            ]
        )
    ]


def _clipped(
    patches: _Patches,
    corners: np.ndarray,
    piece: np.ndarray,
    group: np.ndarray,
    before: np.ndarray,
) -> list[np.ndarray]:
    """Return rows of contacts for facets whose two sides are divided differently."""
    shapely = geometry.need("shapely")
    rows = []
    two_sided = np.zeros(len(patches.simple), np.int64)
    np.bitwise_or.at(two_sided, patches.group, 1 + patches.before.astype(np.int64))
    wanted = (two_sided == 3) & ~patches.simple
    starts = np.searchsorted(group, np.arange(len(wanted) + 1))
    for number in np.flatnonzero(wanted):
        here = slice(starts[number], starts[number + 1])
        triangle, owner, side = corners[here], piece[here], before[here]
        axes, middle, length = _plane(triangle, side)
        flat = shapely.polygons((triangle - middle) @ axes[:, :2] / length)
        behind, ahead = np.flatnonzero(side), np.flatnonzero(~side)
        a, b = shapely.STRtree(flat[ahead]).query(flat[behind], "intersects")
        a, b = behind[a], ahead[b]
        shared = shapely.intersection(flat[a], flat[b])
        area = shapely.area(shared)
        kept = area > 0
        a, b, shared, area = a[kept], b[kept], shared[kept], area[kept]
        spot = shapely.get_coordinates(shapely.centroid(shared)) * length
        area = area * length**2
        rows.append(
            np.column_stack(
                [
                    owner[a],
                    owner[b],
                    area,
                    middle + spot @ axes[:, :2].T,
                    area[:, None] * axes[:, 2],
                    area,
                    area,
                ]
            )
        )
    return rows


def _plane(
    triangle: np.ndarray, side: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return axes (3, 3) with the normal third, a point, and the extent of a facet."""
    vector = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
    normal = np.where(side[:, None], vector, -vector).sum(axis=0)
    normal /= np.linalg.norm(normal)
    x = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    x /= np.linalg.norm(x)
    points = triangle.reshape(-1, 3)
    middle = points.mean(axis=0)
    length = float(geometry.extent(points).max())
    return np.stack([x, np.cross(normal, x), normal], axis=1), middle, length


def _gather(rows: list[np.ndarray], least: float) -> Contacts:
    """Return one contact for each pair, of all that they share."""
    table = np.concatenate([np.zeros((0, 11)), *rows])
    pair = table[:, :2].astype(np.int64)
    turned = pair[:, 0] > pair[:, 1]
    pair = np.where(turned[:, None], pair[:, ::-1], pair)
    vector = np.where(turned[:, None], -table[:, 6:9], table[:, 6:9])
    sides = np.where(turned[:, None], table[:, :8:-1], table[:, 9:])
    pairs, place = np.unique(pair, axis=0, return_inverse=True)
    place = place.ravel()

    def total(values: np.ndarray) -> np.ndarray:
        out = np.zeros((len(pairs), *values.shape[1:]))
        np.add.at(out, place, values)
        return out

    area = total(table[:, 2])
    centroid = total(table[:, 2:3] * table[:, 3:6])
    normal, sides = total(vector), total(sides)
    length = np.linalg.norm(normal, axis=1)
    kept = (area > least) & (pairs[:, 0] != pairs[:, 1])
    # Around a piece that another encloses the normals cancel: any will do.
    normal = np.where(
        (length > 1e-6 * area)[:, None],
        normal / np.where(length > 0, length, 1)[:, None],
        [0.0, 0.0, 1.0],
    )
    return Contacts(
        pairs[kept],
        area[kept],
        centroid[kept] / area[kept, None],
        normal[kept],
        sides[kept],
    )
