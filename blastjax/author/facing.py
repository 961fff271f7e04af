"""Triangles of different pieces that look at each other. Plain numpy."""

from collections.abc import Iterator

import numpy as np

from blastjax.author.overlap import ranges

_AT_A_TIME = 200_000


class Soup:
    """All triangles of all pieces, those of one piece together. T in all."""

    def __init__(self, corners: list[np.ndarray], low: np.ndarray, high: np.ndarray):
        self.corners = np.concatenate(corners)
        """(T, 3, 3) m."""
        self.normal = normals(self.corners)
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


def pairs_of(
    soup: Soup, pairs: np.ndarray, gap: float, facing: float
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield pair, triangle, triangle and mean normal of what look at each other."""
    for some in _portions(soup.count[pairs].sum(axis=1)):
        a, b = pairs[some].T
        one, row = soup.near(a, b, gap)
        others, other_row = soup.near(b, a, gap)
        others, first, many = _windows(soup, a, b, one, row, others, other_row, gap)
        for part in _portions(many):
            times = many[part]
            i, j = np.repeat(one[part], times), others[ranges(first[part], times)]
            owner = np.repeat(row[part], times) + some.start
            keep, normal = _look(soup, i, j, gap, facing)
            yield owner[keep], i[keep], j[keep], normal


def _windows(
    soup: Soup,
    a: np.ndarray,
    b: np.ndarray,
    one: np.ndarray,
    row: np.ndarray,
    others: np.ndarray,
    other_row: np.ndarray,
    gap: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the others in a new order, and for each triangle a range of them.

    Those of a pair are sorted along the longest axis of what its pieces' boxes share,
    and the range holds all that may meet the triangle along that axis.
    """
    shared = np.minimum(soup.piece_high[a], soup.piece_high[b])
    shared = shared - np.maximum(soup.piece_low[a], soup.piece_low[b])
    axis = np.argmax(shared, axis=1)
    lowest = soup.low.min()
    reach = float(soup.high.max() - lowest) + gap
    slack = gap + 1e-9 * reach
    # One key for pair and place: pairs lie so far apart that no range meets two.
    step = 8 * reach
    low = soup.low[others, axis[other_row]] - lowest
    wide = np.zeros(len(a))
    np.maximum.at(wide, other_row, soup.high[others, axis[other_row]] - lowest - low)
    key = other_row * step + low
    order = np.argsort(key, kind="stable")
    key = key[order]
    start = soup.low[one, axis[row]] - lowest - wide[row] - slack
    end = soup.high[one, axis[row]] - lowest + slack
    first = np.searchsorted(key, row * step + start, "left")
    many = np.searchsorted(key, row * step + end, "right") - first
    return others[order], first, many


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
    soup: Soup, i: np.ndarray, j: np.ndarray, gap: float, facing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return which triangles look at each other within the gap, and mean normals."""
    apart = np.maximum(soup.low[i] - soup.high[j], soup.low[j] - soup.high[i])
    keep = np.flatnonzero((apart <= gap).all(axis=1))
    cosine = -np.einsum("ki,ki->k", soup.normal[i[keep]], soup.normal[j[keep]])
    keep = keep[cosine >= facing]
    normal = soup.normal[i[keep]] - soup.normal[j[keep]]
    return keep, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def edges(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two edges of each triangle, from its first corner."""
    return corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]


def normals(corners: np.ndarray) -> np.ndarray:
    """Return unit normals, zero where a triangle has no area."""
    cross = np.cross(*edges(corners))
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    return cross / np.where(length > 0, length, 1.0)
