"""Sites of Voronoi cells inside pieces."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from blastjax.author.cut import geometry
from blastjax.author.cut.tree import Tree, chosen
from blastjax.author.descriptions import reals

TRIES = 200
"""Batches of random points in a piece before it counts as too thin."""


@dataclasses.dataclass(frozen=True)
class Sites:
    """Sites and the piece that each is to cut."""

    points: np.ndarray
    """(S, 3) m."""
    piece: np.ndarray
    """(S,) piece of the tree."""


def uniform(
    tree: Tree, count: int, *, pieces: Sequence[int] | None = None, seed: int = 0
) -> Sites:
    """Return sites spread evenly at random inside each piece.

    Args:
      tree: the pieces.
      count: sites in each.
      pieces: leaves; None takes all.
      seed: of the random numbers.
    """
    _refuse_count("count", count)

    def draw(rng: np.random.Generator, tree: Tree, piece: int) -> np.ndarray:
        return _inside(tree, piece, count, _evenly(rng, *tree.bounds(piece)))

    return _for_each(tree, pieces, seed, draw)


def clustered(
    tree: Tree,
    clusters: int,
    count: int,
    *,
    spread: float = 0.1,
    pieces: Sequence[int] | None = None,
    seed: int = 0,
) -> Sites:
    """Return sites gathered around random centres inside each piece.

    Args:
      tree: the pieces.
      clusters: centres in each piece.
      count: sites around each centre.
      spread: their standard deviation from it, in diagonals of the piece.
      pieces: leaves; None takes all.
      seed: of the random numbers.
    """
    _refuse_count("clusters", clusters)
    _refuse_count("count", count)
    if not spread > 0:
        raise ValueError(f"spread is {spread}; it must be above 0")

    def draw(rng: np.random.Generator, tree: Tree, piece: int) -> np.ndarray:
        low, high = tree.bounds(piece)
        reach = spread * float(np.linalg.norm(high - low))
        centers = _inside(tree, piece, clusters, _evenly(rng, low, high))
        return np.concatenate(
            [
                _inside(tree, piece, count, _around(rng, center, reach))
                for center in centers
            ]
        )

    return _for_each(tree, pieces, seed, draw)


def radial(
    center: Any,
    normal: Any,
    *,
    radius: float,
    rings: int = 4,
    spokes: int = 8,
    growth: float = 1.6,
    jitter: float = 0.2,
    seed: int = 0,
) -> np.ndarray:
    """Return sites on rings around a point, as a pane breaks around a hit, (S, 3).

    Args:
      center: (3,) the hit, m.
      normal: (3,) axis of the rings.
      radius: of the outermost ring, m.
      rings: how many.
      spokes: sites on a ring.
      growth: how much wider each ring is spaced than the one within it.
      jitter: random part of the spacing that sites are moved by, in [0, 1).
      seed: of the random numbers.
    """
    _refuse_count("rings", rings)
    _refuse_count("spokes", spokes)
    if not (radius > 0 and growth > 0 and 0 <= jitter < 1):
        raise ValueError(
            f"radius {radius} and growth {growth} must be above 0, jitter {jitter} in "
            "[0, 1)"
        )
    center, normal = reals("center", center, (3,)), reals("normal", normal, (3,))
    if not np.linalg.norm(normal) > 0:
        raise ValueError("the normal of the rings is zero; give a direction")
    up = normal / np.linalg.norm(normal)
    across = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    across /= np.linalg.norm(across)
    along = np.cross(up, across)
    rng = np.random.default_rng(seed)
    steps = growth ** np.arange(rings)
    reach = radius * np.cumsum(steps) / steps.sum()
    width = radius * steps / steps.sum()
    ring, spoke = (x.ravel() for x in np.mgrid[:rings, :spokes])
    wobble = jitter * rng.uniform(-0.5, 0.5, (2, rings * spokes))
    far = reach[ring] + width[ring] * wobble[0]
    turn = 2 * np.pi * (spoke + ring % 2 / 2 + wobble[1]) / spokes
    arms = np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * along
    return np.concatenate([center[None], center + far[:, None] * arms])


def _inside(
    tree: Tree, piece: int, count: int, draw: Callable[[int], np.ndarray]
) -> np.ndarray:
    """Return the first points of a stream that lie in a piece."""
    mesh, found = tree.mesh(piece), np.zeros((0, 3))
    for _ in range(TRIES):
        points = draw(2 * count)
        found = np.concatenate([found, points[geometry.contains(mesh, points)]])
        if len(found) >= count:
            return found[:count]
    raise ValueError(
        f"piece {piece} is too thin to find {count} points inside at random; "
        "give sites of your own"
    )


def _evenly(
    rng: np.random.Generator, low: np.ndarray, high: np.ndarray
) -> Callable[[int], np.ndarray]:
    return lambda count: rng.uniform(low, high, (count, 3))


def _around(
    rng: np.random.Generator, center: np.ndarray, reach: float
) -> Callable[[int], np.ndarray]:
    return lambda count: rng.normal(center, reach, (count, 3))


def _for_each(
    tree: Tree,
    pieces: Sequence[int] | None,
    seed: int,
    draw: Callable[[np.random.Generator, Tree, int], np.ndarray],
) -> Sites:
    wanted = chosen(tree, pieces)
    # One stream a piece: what one piece gets does not hang on the others.
    parts = [draw(np.random.default_rng((seed, int(p))), tree, int(p)) for p in wanted]
    return Sites(
        np.concatenate([np.zeros((0, 3)), *parts]),
        np.repeat(wanted, [len(part) for part in parts]),
    )


def _refuse_count(name: str, count: int) -> None:
    if count < 1:
        raise ValueError(f"{name} is {count}; give a whole number from 1")
