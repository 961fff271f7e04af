"""Ready-made assets of axis-aligned boxes: grid, wall, tower, beam.

Bonds lie where two boxes share part of a face. Lengths in metres, z up, the origin
under the middle of the shape.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from blastjax.author.asset import build
from blastjax.author.descriptions import Bonds, Chunks, reals, refuse
from blastjax.author.overlap import box_pairs
from blastjax.core import NO_PARENT, WORLD, Asset

SIDES = ("x-", "x+", "y-", "y+", "z-", "z+")


def boxes(
    center: Any,
    size: Any,
    *,
    anchor: Sequence[str] = (),
    root: bool = False,
    pieces: Sequence[int] = (1, 1, 1),
    dtype: Any = None,
) -> Asset:
    """Build an asset of boxes that are bonded where they touch.

    Args:
      center: (n, 3) centres, m.
      size: (n, 3) half extents, m.
      anchor: sides of the whole, out of "x-", "x+", "y-", "y+", "z-", "z+", whose faces
        are bonded to the world.
      root: put one chunk above all boxes, visible as long as they hold together.
      pieces: number of children along x, y, z that each box gives way to.
      dtype: see `author.build`.

    Raises:
      ValueError: a box has no extent, or an option is invalid.
    """
    if np.ndim(center) != 2:
        raise ValueError(f"center has shape {np.shape(center)}; it must be (n, 3)")
    count = len(center)
    center = reals("box center", center, (count, 3))
    size = reals("box size", size, (count, 3))
    refuse(
        (size <= 0).any(axis=1), size, "box {i} has size {v}; half extents are positive"
    )
    unknown = [side for side in anchor if side not in SIDES]
    if unknown:
        raise ValueError(f"anchor {unknown[0]!r} is no side; give any of {SIDES}")
    pieces = counts("pieces", pieces, 3)

    bonds = [_touching(center, size), *(_anchored(center, size, s) for s in anchor)]
    offset = 1 if root else 0
    pairs = np.concatenate([b.chunks for b in bonds])
    chunks = [(np.full(count, offset - 1), center, size, np.ones(count, bool))]
    if root:
        chunks.insert(0, _whole(center, size))
    if np.prod(pieces) > 1:
        chunks.append(_pieces(center, size, pieces, offset))
    parent, centers, sizes, support = (
        np.concatenate(x) for x in zip(*chunks, strict=True)
    )
    volume = 8 * np.prod(sizes, axis=1)
    if root:
        volume[0] = 8 * np.prod(size, axis=1).sum()
    return build(
        Chunks(parent, centers, volume, support, sizes),
        Bonds(
            np.where(pairs == WORLD, WORLD, pairs + offset),
            *(
                np.concatenate([getattr(b, f) for b in bonds])
                for f in ("normal", "area", "centroid")
            ),
        ),
        dtype=dtype,
    ).asset


def grid(
    shape: Sequence[int] = (3, 3, 3),
    brick: Sequence[float] = (1.0, 1.0, 1.0),
    **options: Any,
) -> Asset:
    """Build a block of equal boxes.

    Args:
      shape: number of boxes along x, y, z.
      brick: extent of one box, m.
      **options: of `boxes`.
    """
    number = counts("shape", shape, 3)
    return boxes(*_lattice(number, extent_of(brick)), **options)


def beam(
    length: int = 8,
    brick: Sequence[float] = (1.0, 1.0, 1.0),
    *,
    anchor: Sequence[str] = ("x-",),
    **options: Any,
) -> Asset:
    """Build a row of boxes along x, by default held at its lower end.

    Args:
      length: number of boxes.
      brick: extent of one box, m.
      anchor: see `boxes`.
      **options: of `boxes`.
    """
    return grid((length, 1, 1), brick, anchor=anchor, **options)


def tower(
    levels: int = 8,
    side: int = 3,
    brick: Sequence[float] = (1.0, 1.0, 1.0),
    *,
    anchor: Sequence[str] = ("z-",),
    **options: Any,
) -> Asset:
    """Build a hollow square tower that stands on the world.

    Args:
      levels: number of boxes along z.
      side: number of boxes along x and y; from 3 up the inside is hollow.
      brick: extent of one box, m.
      anchor: see `boxes`.
      **options: of `boxes`.
    """
    levels, side = counts("levels and side", (levels, side), 2)
    center, size = _lattice((side, side, levels), extent_of(brick))
    edge = (side - 1) / 2 * np.asarray(brick[:2], float)
    outer = (np.abs(center[:, :2]) > edge - 1e-9 * np.asarray(brick[:2])).any(axis=1)
    return boxes(center[outer], size[outer], anchor=anchor, **options)


def wall(
    bricks: int = 6,
    courses: int = 6,
    brick: Sequence[float] = (0.4, 0.2, 0.2),
    *,
    anchor: Sequence[str] = ("z-",),
    **options: Any,
) -> Asset:
    """Build a wall in running bond along x that stands on the world.

    Every other course is shifted by half a brick and begins and ends with a half.

    Args:
      bricks: whole bricks in a course.
      courses: number of courses.
      brick: extent of a whole brick along x, y, z, m.
      anchor: see `boxes`.
      **options: of `boxes`.
    """
    bricks, courses = counts("bricks and courses", (bricks, courses), 2)
    extent = extent_of(brick)
    center, size = [], []
    for course in range(courses):
        cuts = np.arange(bricks + 1.0)
        if course % 2:
            cuts = np.concatenate([[0.0], cuts[:-1] + 0.5, [bricks]])
        length = np.diff(cuts)
        rows = np.zeros((len(length), 3))
        rows[:, 0] = (cuts[:-1] + length / 2 - bricks / 2) * extent[0]
        rows[:, 2] = (course + 0.5) * extent[2]
        half = np.tile(extent / 2, (len(length), 1))
        half[:, 0] *= length
        center.append(rows)
        size.append(half)
    return boxes(np.concatenate(center), np.concatenate(size), anchor=anchor, **options)


def counts(name: str, values: Sequence[int], number: int) -> tuple[int, ...]:
    """Return whole numbers from 1, or raise ValueError."""
    if len(values) != number:
        raise ValueError(f"{name} has {len(values)} numbers; give {number}")
    for i, value in enumerate(values):
        if int(value) != value or value < 1:
            raise ValueError(
                f"{name}[{i}] is {value}; it must be a whole number from 1"
            )
    return tuple(int(value) for value in values)


def extent_of(brick: Sequence[float]) -> np.ndarray:
    """Return the extents of a brick, or raise ValueError."""
    extent = reals("brick", np.asarray(brick), (3,))
    refuse(extent <= 0, extent, "brick[{i}] is {v}; an extent is positive, in m")
    return extent


def _lattice(shape: Sequence[int], extent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    center = (index.reshape(-1, 3) - (np.asarray(shape) - 1) / 2) * extent
    center[:, 2] += shape[2] * extent[2] / 2
    return center, np.tile(extent / 2, (len(center), 1))


Rows = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _whole(center: np.ndarray, size: np.ndarray) -> Rows:
    low, high = (center - size).min(axis=0), (center + size).max(axis=0)
    weight = np.prod(size, axis=1, keepdims=True)
    middle = (weight * center).sum(axis=0) / weight.sum()
    half = (high - low) / 2
    return np.array([NO_PARENT]), middle[None], half[None], np.zeros(1, bool)


def _pieces(
    center: np.ndarray, size: np.ndarray, pieces: Sequence[int], offset: int
) -> Rows:
    cell, _ = _lattice(pieces, np.ones(3))
    cell[:, 2] -= pieces[2] / 2
    part = size / np.asarray(pieces)
    children = center[:, None] + 2 * cell[None] * part[:, None]
    number = len(cell)
    parent = np.repeat(np.arange(len(center)) + offset, number)
    half = np.repeat(part, number, axis=0)
    return parent, children.reshape(-1, 3), half, np.zeros(len(parent), bool)


def _touching(center: np.ndarray, size: np.ndarray) -> Bonds:
    """Return the bonds of boxes that share part of a face."""
    tolerance = 1e-6 * size.min()
    low, high = center - size, center + size
    met = box_pairs(low, high, tolerance)
    pairs, normals, areas, centroids = [], [], [], []
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        for a, b in (met.T, met[:, ::-1].T):
            touch = np.abs(high[a, axis] - low[b, axis]) <= tolerance
            a, b = a[touch], b[touch]
            from_, to = np.maximum(low[a], low[b]), np.minimum(high[a], high[b])
            share = ((to - from_)[:, others] > tolerance).all(axis=1)
            a, b, from_, to = a[share], b[share], from_[share], to[share]
            middle = (from_ + to) / 2
            middle[:, axis] = high[a, axis]
            pairs.append(np.stack([a, b], axis=1))
            normals.append(np.tile(np.eye(3)[axis], (len(a), 1)))
            areas.append(np.prod((to - from_)[:, others], axis=1))
            centroids.append(middle)
    return Bonds(*(np.concatenate(x) for x in (pairs, normals, areas, centroids)))


def _anchored(center: np.ndarray, size: np.ndarray, side: str) -> Bonds:
    """Return bonds to the world from the boxes whose face is on this side of all."""
    axis, sign = "xyz".index(side[0]), 1.0 if side[1] == "+" else -1.0
    face = sign * center[:, axis] + size[:, axis]
    there = np.flatnonzero(face > face.max() - 1e-6 * size.min())
    normal = sign * np.eye(3)[axis]
    area = 4 * np.delete(size[there], axis, axis=1).prod(axis=1)
    pairs = np.stack([there, np.full(len(there), WORLD)], axis=1)
    middle = center[there] + normal * size[there]
    return Bonds(pairs, np.tile(normal, (len(there), 1)), area, middle)
