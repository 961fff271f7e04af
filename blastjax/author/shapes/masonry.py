"""A brick wall with doors and windows."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from blastjax.author.descriptions import reals
from blastjax.author.shapes.boxes import boxes, counts, extent_of
from blastjax.core import Asset


def masonry(
    bricks: int = 12,
    courses: int = 14,
    brick: Sequence[float] = (0.4, 0.2, 0.2),
    *,
    openings: Sequence[Sequence[float]] = ((-0.5, 0.6, 0.5, 1.8),),
    anchor: Sequence[str] = ("z-",),
    **options: Any,
) -> Asset:
    """Build a wall in running bond along x with openings, a lintel over each.

    An opening begins and ends where it is told along x; along z it is rounded to whole
    courses. A lintel is one course high and rests on half a brick at either side; an
    opening that reaches the top of the wall has none. Bricks beside an opening are cut
    to it, and none shorter than a quarter is left.

    Args:
      bricks: whole bricks in a course.
      courses: number of courses.
      brick: extent of a whole brick along x, y, z, m.
      openings: (x low, z low, x high, z high) of each, m; x = 0 is the wall's middle.
      anchor: see `boxes`.
      **options: of `boxes`.

    Raises:
      ValueError: openings are empty, leave the wall, or are too close to each other.
    """
    bricks, courses = counts("bricks and courses", (bricks, courses), 2)
    extent = extent_of(brick)
    holes = _holes(openings, bricks, courses, extent)
    center, size = [], []
    for course in range(courses):
        voids = [(a, b) for a, low, b, high in holes if low <= course < high]
        lintels = [
            (max(a - 0.5, 0.0), min(b + 0.5, float(bricks)))
            for a, _, b, high in holes
            if course == high
        ]
        for a, b in _row(bricks, course, voids, lintels):
            middle = (a + b - bricks) / 2
            center.append([middle * extent[0], 0.0, (course + 0.5) * extent[2]])
            size.append([(b - a) * extent[0] / 2, extent[1] / 2, extent[2] / 2])
    return boxes(np.array(center), np.array(size), anchor=anchor, **options)


def _holes(
    openings: Sequence[Sequence[float]], bricks: int, courses: int, extent: np.ndarray
) -> list[tuple[float, int, float, int]]:
    """Return the openings, x in bricks from the left end and z in courses."""
    rows = reals("openings", np.reshape(openings, (-1, 4)), (len(openings), 4))
    holes: list[tuple[float, int, float, int]] = []
    for i, (x0, z0, x1, z1) in enumerate(rows.tolist()):
        a, b = (float(x / extent[0] + bricks / 2) for x in (x0, x1))
        low, high = (round(float(z / extent[2])) for z in (z0, z1))
        if not (0 <= a < b <= bricks and 0 <= low < high <= courses):
            raise ValueError(
                f"opening {i} is {(x0, z0, x1, z1)}; it must be within the wall, "
                f"{bricks * extent[0]:g} m long about x = 0 and "
                f"{courses * extent[2]:g} m high, and a course high at least"
            )
        for j, (c, other_low, d, other_high) in enumerate(holes):
            if min(b, d) + 1 > max(a, c) and min(high, other_high) + 1 > max(
                low, other_low
            ):
                raise ValueError(
                    f"opening {i} is less than a brick from opening {j}; "
                    "their lintels need room"
                )
        holes.append((a, low, b, high))
    return holes


def _row(
    bricks: int,
    course: int,
    voids: list[tuple[float, float]],
    lintels: list[tuple[float, float]],
) -> list[tuple[float, float]]:
    """Return where the bricks of a course begin and end, in bricks."""
    cuts = np.arange(bricks + 1.0)
    if course % 2:
        cuts = np.concatenate([[0.0], cuts[:-1] + 0.5, [bricks]])
    fixed = np.unique(np.array([0.0, bricks, *sum(voids + lintels, ())]))
    apart = np.abs(cuts[:, None] - fixed).min(axis=1)
    cuts = np.concatenate([cuts[apart >= 0.25 - 1e-9], fixed])
    for a, b in voids + lintels:
        cuts = cuts[(cuts <= a) | (cuts >= b)]
    cuts = np.sort(cuts)
    pairs = list(zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True))
    return [p for p in pairs if not any(a <= sum(p) / 2 <= b for a, b in voids)]
