"""Bonds of pieces that come from anywhere, found from their surfaces.

Two pieces are bonded where their faces look at each other within a gap: every pair of
facing triangles is projected onto the plane midway between them, and what both cover
there is bonded area. Of flat faces that touch this is the exact shared face; of rough
ones, or of pieces with a joint between them, their averaged mid-plane.

The gap must be smaller than half the thinnest piece, or its far side counts too.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from blastjax.author import clip
from blastjax.author.descriptions import Bonds, integers, reals, refuse
from blastjax.author.mesh import Mesh
from blastjax.author.overlap import box_pairs, ranges
from blastjax.core import WORLD

FACING = np.cos(np.radians(20.0))
"""Least cosine between one face's normal and the other's reversed, over a gap."""
FLAT = np.cos(1e-3)
"""The same for faces that touch."""
_AT_A_TIME = 200_000


def between(
    meshes: Sequence[Mesh],
    *,
    gap: float | None = None,
    facing: float | None = None,
    min_area: float | None = None,
    parts: Any = None,
) -> Bonds:
    """Find the bonds between pieces.

    Args:
      meshes: one a piece, closed; the bonds name pieces by their place here.
      gap: widest joint that is still bonded, m; as deep may pieces overlap. None takes
        1e-6 of the whole's extent: faces that touch.
      facing: least cosine of the angle between faces that look at each other. None
        takes FACING; without a gap, FLAT, so that pieces which meet in an edge between
        slanting faces are not bonded there.
      min_area: bonds with less are left out, m^2; None takes 1e-9 of the squared
        extent of the whole, below which faces touch in an edge or by rounding.
      parts: (n,) int, the part that each piece belongs to: only bonds between different
        parts are wanted. None wants all.

    Returns:
      One bond a pair of pieces, the lower first: total area, area-weighted centroid and
      unit normal from the first to the second.

    Raises:
      ValueError: an option is out of range.
    """
    corners = [np.asarray(m.vertices, float)[np.asarray(m.faces)] for m in meshes]
    corners = [c if len(c) else np.zeros((0, 3, 3)) for c in corners]
    if not meshes:
        return Bonds.none()
    low, high = _bounds(corners)
    extent = float((high.max(axis=0) - low.min(axis=0)).max())
    if facing is None:
        facing = FLAT if gap is None else FACING
    gap = 1e-6 * extent if gap is None else _not_negative("gap", gap)
    least = 1e-9 * extent**2 if min_area is None else _not_negative("area", min_area)
    pairs = box_pairs(low, high, gap)
    if parts is not None:
        part = integers("parts", parts)
        if part.shape != (len(meshes),):
            raise ValueError(f"parts has shape {part.shape}; give one for each mesh")
        pairs = pairs[part[pairs[:, 0]] != part[pairs[:, 1]]]
    soup = _Soup(corners, low, high)
    rows = [
        (owner, *clip.shared(soup.corners[i], soup.corners[j], normal, gap), normal)
        for owner, i, j, normal in _facing(soup, pairs, gap, facing)
    ]
    if not rows:
        return Bonds.none()
    owner, area, centroid, normal = (np.concatenate(x) for x in zip(*rows, strict=True))
    return _summed(pairs, owner, area, centroid, normal, least)


def to_plane(
    meshes: Sequence[Mesh],
    point: Any,
    normal: Any,
    *,
    gap: float | None = None,
    facing: float = FACING,
) -> Bonds:
    """Bind to the world the pieces that have faces on a plane.

    Args:
      meshes: one a piece.
      point: (3,) on the plane, m.
      normal: (3,) out of the pieces, into the world; of any length.
      gap: how far off the plane a face may be, m; None takes 1e-6 of the whole's
        extent.
      facing: least cosine of the angle between a face's normal and the plane's.
    """
    point, normal = reals("point", point, (3,)), _unit("normal", normal)
    extent = _extent(meshes)
    gap = 1e-6 * extent if gap is None else _not_negative("gap", gap)

    def on_plane(corners: np.ndarray) -> np.ndarray:
        away = np.abs((corners - point) @ normal) <= gap
        return corners[away.all(axis=1) & (_normals(corners) @ normal >= facing)]

    return _to_world(meshes, on_plane, normal)


def to_volume(meshes: Sequence[Mesh], low: Any, high: Any) -> Bonds:
    """Bind to the world the pieces whose surface reaches into a box.

    Area and normal are those of the sum of the surface inside, as a vector: of a piece
    that stands in the box, its cross-section where it leaves it. A piece that lies all
    within has none; it is bonded downwards by its area seen from there.

    Args:
      meshes: one a piece.
      low: (3,) low corner of the box, m.
      high: (3,) high corner, m.

    Raises:
      ValueError: the box has no extent.
    """
    low, high = reals("low", low, (3,)), reals("high", high, (3,))
    refuse(high <= low, high, "the box's high corner [{i}] is {v}, not above the low")

    def inside(corners: np.ndarray) -> np.ndarray:
        polygon = corners
        for axis in range(3):
            polygon = clip.by_plane(polygon, low[axis] - polygon[..., axis])
            polygon = clip.by_plane(polygon, polygon[..., axis] - high[axis])
        return polygon

    return _to_world(meshes, inside, np.array([0.0, 0.0, -1.0]))


def to_world(meshes: Sequence[Mesh], pieces: Any, normal: Any = (0, 0, -1)) -> Bonds:
    """Bind listed pieces to the world by their faces that look along a direction.

    Args:
      meshes: one a piece.
      pieces: (k,) int, which of them.
      normal: (3,) into the world, of any length; the bonded area is what one sees of
        the piece from there if it is convex.

    Raises:
      ValueError: a piece does not exist.
    """
    listed = integers("pieces", pieces)
    bad = (listed < 0) | (listed >= len(meshes))
    refuse(bad, listed, f"piece {{i}} is {{v}}; there are {len(meshes)}")
    direction = _unit("normal", normal)

    def seen(corners: np.ndarray) -> np.ndarray:
        return corners[_normals(corners) @ direction > 1e-9]

    found = _to_world([meshes[i] for i in listed], seen, direction, project=True)
    pairs = np.stack([listed[found.chunks[:, 0]], found.chunks[:, 1]], axis=1)
    return Bonds(pairs, found.normal, found.area, found.centroid)


def together(*bonds: Bonds) -> Bonds:
    """Return all these bonds as one description."""
    if not bonds:
        return Bonds.none()
    fields = ("chunks", "normal", "area", "centroid")
    return Bonds(*(np.concatenate([getattr(b, f) for b in bonds]) for f in fields))


class _Soup:
    """All triangles of all pieces, those of one piece together. T in all."""

    def __init__(self, corners: list[np.ndarray], low: np.ndarray, high: np.ndarray):
        self.corners = np.concatenate(corners)
        """(T, 3, 3) m."""
        self.normal = _normals(self.corners)
        """(T, 3) unit."""
        self.low, self.high = self.corners.min(axis=1), self.corners.max(axis=1)
        """(T, 3) bounds, m."""
        self.count = np.array([len(c) for c in corners])
        """(pieces,) triangles of each."""
        self.start = np.cumsum(self.count) - self.count
        """(pieces,) the first of them."""
        self.piece_low, self.piece_high = low, high
        """(pieces, 3) bounds, m."""

    def near(
        self, piece: np.ndarray, other: np.ndarray, gap: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the triangles of pieces (P,) near others (P,), and whose they are."""
        row = np.repeat(np.arange(len(piece)), self.count[piece])
        triangle = ranges(self.start[piece], self.count[piece])
        meets = self.low[triangle] <= self.piece_high[other][row] + gap
        meets &= self.high[triangle] >= self.piece_low[other][row] - gap
        meets = meets.all(axis=1)
        return triangle[meets], row[meets]


def _facing(
    soup: _Soup, pairs: np.ndarray, gap: float, facing: float
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield pair, triangle, triangle and mean normal of what look at each other."""
    for some in _portions(soup.count[pairs].sum(axis=1)):
        one, row = soup.near(pairs[some, 0], pairs[some, 1], gap)
        others, other_row = soup.near(pairs[some, 1], pairs[some, 0], gap)
        many = np.bincount(other_row, minlength=some.stop - some.start)
        first = np.cumsum(many) - many
        for part in _portions(many[row]):
            times = many[row[part]]
            i = np.repeat(one[part], times)
            j = others[ranges(first[row[part]], times)]
            owner = np.repeat(row[part], times) + some.start
            keep, normal = _look(soup, i, j, gap, facing)
            yield owner[keep], i[keep], j[keep], normal


def _portions(load: np.ndarray) -> Iterator[slice]:
    """Yield slices of rows whose loads sum up to about what fits in memory."""
    total, start = np.cumsum(load), 0
    while start < len(load):
        before = total[start - 1] if start else 0
        stop = int(np.searchsorted(total, before + _AT_A_TIME, "right"))
        stop = max(stop, start + 1)
        yield slice(start, stop)
        start = stop


def _look(
    soup: _Soup, i: np.ndarray, j: np.ndarray, gap: float, facing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return which triangles look at each other within the gap, and mean normals."""
    apart = np.maximum(soup.low[i] - soup.high[j], soup.low[j] - soup.high[i])
    keep = np.flatnonzero((apart <= gap).all(axis=1))
    cosine = -np.einsum("ki,ki->k", soup.normal[i[keep]], soup.normal[j[keep]])
    keep = keep[cosine >= facing]
    normal = soup.normal[i[keep]] - soup.normal[j[keep]]
    return keep, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _summed(
    pairs: np.ndarray,
    owner: np.ndarray,
    area: np.ndarray,
    centroid: np.ndarray,
    normal: np.ndarray,
    least: float,
) -> Bonds:
    total = np.bincount(owner, area, len(pairs))
    vector, place = np.zeros((len(pairs), 3)), np.zeros((len(pairs), 3))
    np.add.at(vector, owner, area[:, None] * normal)
    np.add.at(place, owner, area[:, None] * centroid)
    length = np.linalg.norm(vector, axis=1)
    keep = (total > least) & (length > 0)
    return Bonds(
        pairs[keep],
        vector[keep] / length[keep, None],
        total[keep],
        place[keep] / total[keep, None],
    )


def _to_world(
    meshes: Sequence[Mesh], select: Any, direction: np.ndarray, project: bool = False
) -> Bonds:
    """Bind each piece by the polygons that `select` leaves of its triangles."""
    rows = []
    for piece, mesh in enumerate(meshes):
        corners = np.asarray(mesh.vertices, float)[np.asarray(mesh.faces)]
        if not len(corners):
            continue
        vector, place = clip.vector_area(select(corners))
        area, mean = np.linalg.norm(vector, axis=1), vector.sum(axis=0)
        length = float(np.linalg.norm(mean))
        if (
            area.sum()
            <= 1e-12 * np.linalg.norm(np.cross(*_edges(corners)), axis=1).sum()
        ):
            continue
        if project or length <= 1e-6 * area.sum():
            area = np.maximum(vector @ direction, 0)
            mean, length = direction, area.sum()
        if not length > 0:
            continue
        normal = mean / np.linalg.norm(mean)
        rows.append((piece, normal, length, area @ place / area.sum()))
    if not rows:
        return Bonds.none()
    pieces, normals, areas, places = zip(*rows, strict=True)
    pairs = np.stack([pieces, np.full(len(pieces), WORLD)], axis=1)
    return Bonds(pairs, np.array(normals), np.array(areas), np.array(places))


def _edges(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]


def _normals(corners: np.ndarray) -> np.ndarray:
    """Return unit normals, zero where a triangle has no area."""
    cross = np.cross(*_edges(corners))
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    return cross / np.where(length > 0, length, 1.0)


def _bounds(corners: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    points = [c.reshape(-1, 3) for c in corners]
    for i, rows in enumerate(points):
        if not len(rows):
            raise ValueError(f"mesh {i} has no faces; a piece needs a surface")
    return (
        np.stack([p.min(axis=0) for p in points]),
        np.stack([p.max(axis=0) for p in points]),
    )


def _extent(meshes: Sequence[Mesh]) -> float:
    points = [np.asarray(m.vertices, float) for m in meshes if len(m.vertices)]
    return float(np.ptp(np.concatenate(points), axis=0).max()) if points else 0.0


def _unit(name: str, vector: Any) -> np.ndarray:
    vector = reals(name, vector, (3,))
    length = np.linalg.norm(vector)
    if length == 0:
        raise ValueError(f"{name} is {vector.tolist()}; it needs a direction")
    return vector / length


def _not_negative(name: str, value: float) -> float:
    if not (np.isfinite(value) and value >= 0):
        raise ValueError(f"{name} is {value}; it must be finite and zero or more")
    return float(value)
