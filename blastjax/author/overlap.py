"""Which boxes of many meet: the broad phase of everything that looks for neighbours.

Plain numpy. Boxes are axis-aligned, given by their low and high corners.
"""

import itertools

import numpy as np

_MOST_CELLS = 2.0**20


def box_pairs(low: np.ndarray, high: np.ndarray, gap: float = 0.0) -> np.ndarray:
    """Return the pairs (P, 2) of boxes that are no farther apart than the gap.

    A hash of cells: the time grows with the number of boxes and of pairs where boxes
    are of like size. Each pair comes once, the lower first, in ascending order.

    Args:
      low: (n, 3) low corners.
      high: (n, 3) high corners, not below them.
      gap: in the same unit; along each axis.
    """
    count = len(low)
    if count < 2:
        return np.zeros((0, 2), np.int64)
    middle, extent = (low + high) / 2, (high - low).max(axis=0) + gap
    origin = middle.min(axis=0)
    span = (middle - origin).max(axis=0)
    cell = np.maximum(extent, span / _MOST_CELLS)
    cell = np.where(cell > 0, cell, 1.0)
    place = np.floor((middle - origin) / cell).astype(np.int64)
    stride = np.array([1, 1 << 21, 1 << 42])
    key = place @ stride
    order = np.argsort(key, kind="stable")
    ranked = key[order]
    found = []
    # Two that meet have middles less than one cell apart, in neighbouring cells.
    for step in itertools.product((-1, 0, 1), repeat=3):
        near = key + np.array(step) @ stride
        first = np.searchsorted(ranked, near, "left")
        many = np.searchsorted(ranked, near, "right") - first
        a = np.repeat(np.arange(count), many)
        b = order[ranges(first, many)]
        meet = (a < b) & ((low[a] <= high[b] + gap) & (low[b] <= high[a] + gap)).all(
            axis=1
        )
        found.append(np.stack([a[meet], b[meet]], axis=1))
    pairs = np.concatenate(found)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def ranges(first: np.ndarray, many: np.ndarray) -> np.ndarray:
    """Return first[i], ..., first[i] + many[i] - 1 for each i, in one row."""
    ends = np.cumsum(many)
    return np.arange(ends[-1] if len(ends) else 0) + np.repeat(
        first - (ends - many), many
    )
