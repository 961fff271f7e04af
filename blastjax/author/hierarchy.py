"""The hierarchy of chunks: which are support chunks, and in what order chunks stand.

Exactly one support chunk must lie on every way from a leaf to its root (exact
coverage). An asset's chunks stand in this order: those at or above the support level
before those below it, every parent before its children, and the children of one parent
together.
"""

import dataclasses

import numpy as np

from blastjax.author.descriptions import (
    Bonds,
    Chunks,
    checked_bonds,
    checked_chunks,
    flags,
    integers,
    refuse,
    shaped,
)
from blastjax.core import WORLD


def ensure_coverage(parent: np.ndarray, support: np.ndarray) -> tuple[np.ndarray, bool]:
    """Repair support flags to exact coverage.

    Of several flags on one way to the root the highest stays; where there is none, the
    topmost chunk without a support chunk below it gets it.

    Args:
      parent: (C,) parent of each chunk, NO_PARENT for roots, without loops.
      support: (C,) bool.

    Returns:
      The repaired flags (C,) and whether they were exact already.
    """
    parent = integers("chunk parent", parent)
    support = flags("chunk support", support, len(parent))
    covered = _covered(parent, support)
    kept = support & ~covered
    has_support = subtree_any(parent, kept)
    root = parent < 0
    # Not below support, nothing below itself, and the chunk above cannot take the flag.
    missing = ~has_support & ~covered & (root | has_support[parent])
    fixed = kept | missing
    return fixed, bool((fixed == support).all())


def reorder_map(parent: np.ndarray, support: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return where each chunk goes so that the order is valid.

    Args:
      parent: (C,) parent of each chunk, NO_PARENT for roots, without loops.
      support: (C,) bool, of exact coverage.

    Returns:
      (C,) the new index of each chunk, and whether that is the old one for all of them.

    Raises:
      ValueError: the coverage is not exact.
    """
    parent = integers("chunk parent", parent)
    support = flags("chunk support", support, len(parent))
    refuse_inexact(parent, support)
    below = _covered(parent, support)
    count = len(parent)
    # Sorting by the parent's place moves the parents' children too: once a level.
    order = np.arange(count)
    while True:
        place = np.empty(count, np.int64)
        place[order] = np.arange(count)
        parent_place = np.where(parent < 0, -1, place[parent])
        ranks = np.lexsort((place, parent_place, below))
        if (ranks == order).all():
            return place, bool((order == np.arange(count)).all())
        order = ranks


def reorder(
    chunks: Chunks,
    bonds: Bonds,
    chunk_map: np.ndarray,
    *,
    keep_normal_order: bool = False,
) -> tuple[Chunks, Bonds]:
    """Move every chunk to its place in the map.

    Args:
      chunks: the descriptions.
      bonds: theirs, whose chunk indices are renamed. The world and indices that name no
        chunk stay as they are.
      chunk_map: (C,) new index of each chunk, as from `reorder_map`.
      keep_normal_order: turn a bond's normal round when the move changes which of its
        chunks has the lower index (the world counting as highest), for those whose
        normals point from lower to higher index.
    """
    chunks, bonds = checked_chunks(chunks), checked_bonds(bonds)
    count = len(chunks.parent)
    chunk_map = integers("chunk map", chunk_map)
    shaped("chunk map", chunk_map, (count,))
    if not (np.sort(chunk_map) == np.arange(count)).all():
        raise ValueError(f"chunk map is no permutation of 0..{count - 1}")
    old = np.argsort(chunk_map)
    moved = {f.name: getattr(chunks, f.name)[old] for f in dataclasses.fields(Chunks)}
    moved["parent"] = np.where(
        moved["parent"] < 0, moved["parent"], chunk_map[moved["parent"]]
    )
    known = (bonds.chunks >= 0) & (bonds.chunks < count)
    pairs = np.where(known, chunk_map[np.where(known, bonds.chunks, 0)], bonds.chunks)
    normal = bonds.normal
    if keep_normal_order:
        turned = _ascending(bonds.chunks) != _ascending(pairs)
        normal = np.where(turned[:, None], -normal, normal)
    return Chunks(**moved), dataclasses.replace(bonds, chunks=pairs, normal=normal)


def refuse_inexact(parent: np.ndarray, support: np.ndarray) -> None:
    """Raise ValueError unless the coverage is exact."""
    fixed, _ = ensure_coverage(parent, support)
    refuse(
        support & ~fixed,
        parent,
        "chunk {i} (parent {v}) is a support chunk below another; "
        "keep one flag on each way to a root, or let `ensure_coverage` choose",
    )
    refuse(
        fixed & ~support,
        parent,
        "no support chunk covers the leaves of chunk {i} (parent {v}); "
        "flag one on each way to a root, or let `ensure_coverage` choose",
    )


def refuse_invalid_order(parent: np.ndarray, support: np.ndarray) -> None:
    """Raise ValueError unless chunks stand in a valid order."""
    index = np.arange(len(parent))
    remedy = "; put them in order with `reorder_map`"
    child = parent >= 0
    late_root = ~child & (np.cumsum(child) > 0)
    refuse(late_root, parent, "chunk {i} is a root behind a child" + remedy)
    refuse(
        child & (parent >= index),
        parent,
        "chunk {i} stands before its parent {v}" + remedy,
    )
    starts = np.concatenate([[True], parent[1:] != parent[:-1]]) & child
    _, first = np.unique(parent[starts], return_index=True)
    again = starts.copy()
    again[np.flatnonzero(starts)[first]] = False
    refuse(
        again, parent, "chunk {i} stands apart from its siblings (parent {v})" + remedy
    )
    below = _covered(parent, support)
    refuse(
        ~below & (np.cumsum(below) > 0),
        parent,
        "chunk {i} (parent {v}) is at or above the support level, but stands behind "
        "one that is below" + remedy,
    )


def below_support(parent: np.ndarray, support: np.ndarray) -> np.ndarray:
    """Return which chunks have a support chunk above them, (C,) bool."""
    return _covered(parent, support)


def _covered(parent: np.ndarray, support: np.ndarray) -> np.ndarray:
    """Return which chunks have a flagged chunk above them."""
    # As for depths: each round doubles how far `above` looks.
    above = parent
    found = np.where(parent < 0, False, support[parent])
    while (above >= 0).any():
        found = found | np.where(above < 0, False, found[above])
        above = np.where(above < 0, above, above[above])
    return found


def subtree_any(parent: np.ndarray, flag: np.ndarray) -> np.ndarray:
    """Return which chunks have a flagged chunk at or below them."""
    above, found = parent, flag
    while (above >= 0).any():
        marked = above[(above >= 0) & found]
        # Whoever is marked at this distance marks all between by the halves before.
        found = found.copy()
        found[marked] = True
        above = np.where(above < 0, above, above[above])
    return found


def _ascending(pairs: np.ndarray) -> np.ndarray:
    # The world, a negative number here, is the highest in Blast's order.
    highest = np.iinfo(np.int64).max
    first, second = np.where(pairs == WORLD, highest, pairs).T
    return first < second
