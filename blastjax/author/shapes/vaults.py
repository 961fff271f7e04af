"""Things of cut stone: arch, dome, column, bridge. Their pieces are convex solids."""

import itertools
from typing import Any

import numpy as np

from blastjax.author import bonds, solids
from blastjax.author.mesh import Destructible, Mesh
from blastjax.author.shapes.boxes import counts

DOWN = (0.0, 0.0, -1.0)


def arch(
    span: float = 4.0,
    rise: float = 2.0,
    thickness: float = 0.4,
    width: float = 0.6,
    voussoirs: int = 11,
    *,
    anchor: bool = True,
    dtype: Any = None,
) -> Destructible:
    """Build an arch of wedges along x, a half circle or less.

    Args:
      span: between the springings at the inner side, m.
      rise: of the inner side over the springings, at most half the span, m.
      thickness: of the ring, m.
      width: along y, m.
      voussoirs: number of wedges.
      anchor: bind both springings to the world.
      dtype: see `author.build`.

    Raises:
      ValueError: a length is not above zero, or the rise is above half the span.
    """
    positive(span=span, rise=rise, thickness=thickness, width=width)
    (number,) = counts("voussoirs", (voussoirs,), 1)
    inner, outer = _ring(span, rise, thickness, number)
    meshes = _wedges(inner, outer, width)
    held = []
    for end, other in ((0, 1), (-1, -2)) if anchor else ():
        along = outer[end] - inner[end]
        normal = np.array([-along[1], 0.0, along[0]])
        ahead = inner[other] - inner[end]
        if normal[[0, 2]] @ ahead > 0:
            normal = -normal
        point = (inner[end][0], 0.0, inner[end][1])
        held.append(bonds.to_plane(meshes, point, normal, facing=1 - 1e-9))
    return solids.assemble(meshes, world=held, dtype=dtype)


def dome(
    radius: float = 3.0,
    thickness: float = 0.3,
    rings: int = 5,
    segments: int = 16,
    *,
    oculus: bool = False,
    anchor: bool = True,
    dtype: Any = None,
) -> Destructible:
    """Build a half sphere of stones in rings, closed by one stone at the crown.

    Args:
      radius: of the corners at the inner side, m.
      thickness: of the shell, m.
      rings: rings of stones.
      segments: stones in a ring, 3 or more.
      oculus: leave the crown open.
      anchor: bind the lowest ring to the world.
      dtype: see `author.build`.

    Raises:
      ValueError: a length is not above zero, or there are too few stones.
    """
    positive(radius=radius, thickness=thickness)
    rings, segments = counts("rings and segments", (rings, segments), 2)
    if segments < 3:
        raise ValueError(f"segments is {segments}; a ring needs 3 or more")
    # The crown takes half a ring.
    tilt = np.pi / 2 * (1 - np.arange(rings + 1) / (rings + 0.5))
    turn = 2 * np.pi * np.arange(segments + 1) / segments
    level = np.where(np.arange(rings + 1) == 0, 0.0, np.cos(tilt))
    unit = np.stack(
        [
            np.sin(tilt)[:, None] * np.cos(turn),
            np.sin(tilt)[:, None] * np.sin(turn),
            np.broadcast_to(level[:, None], (rings + 1, segments + 1)),
        ],
        axis=2,
    )
    unit[:, -1] = unit[:, 0]
    within, beyond = radius * unit, (radius + thickness) * unit
    meshes = []
    for i in range(rings):
        for j in range(segments):
            corner = ([i, i, i + 1, i + 1], [j, j + 1, j + 1, j])
            meshes.append(solids.prism(within[corner], beyond[corner]))
    if not oculus:
        meshes.append(solids.prism(within[-1, :-1], beyond[-1, :-1]))
    held = [bonds.to_plane(meshes, (0, 0, 0), DOWN)] if anchor else []
    return solids.assemble(meshes, world=held, dtype=dtype)


def column(
    height: float = 3.0,
    radius: float = 0.35,
    drums: int = 6,
    *,
    sectors: int = 1,
    sides: int = 16,
    taper: float = 0.85,
    anchor: bool = True,
    dtype: Any = None,
) -> Destructible:
    """Build a column of drums, each whole or of sectors.

    Args:
      height: m.
      radius: of its foot, to the corners, m.
      drums: number of drums.
      sectors: pieces that a drum is made of.
      sides: corners of its cross-section; a multiple of the sectors.
      taper: radius at the head relative to the foot.
      anchor: bind the lowest drum to the world.
      dtype: see `author.build`.

    Raises:
      ValueError: a length is not above zero, or the sides do not fit the sectors.
    """
    positive(height=height, radius=radius, taper=taper)
    drums, sectors, sides = counts("drums, sectors, sides", (drums, sectors, sides), 3)
    if sides < 3 or sides % sectors or sectors == 2 == sides:
        raise ValueError(
            f"sides is {sides}; it must be 3 or more and a multiple of sectors, "
            f"{sectors}"
        )
    turn = 2 * np.pi * np.arange(sides + 1) / sides
    circle = np.stack([np.cos(turn), np.sin(turn), np.zeros(sides + 1)], axis=1)
    circle[-1] = circle[0]
    step = sides // sectors
    meshes = []
    for drum in range(drums):
        ends = []
        for part in (drum / drums, (drum + 1) / drums):
            wide = radius * (1 + (taper - 1) * part)
            ends.append(circle * wide + np.array([0, 0, height * part]))
        if sectors == 1:
            meshes.append(solids.prism(ends[0][:-1], ends[1][:-1]))
            continue
        for first in range(0, sides, step):
            rim = [end[first : first + step + 1] for end in ends]
            axis = [np.array([[0.0, 0.0, end[0, 2]]]) for end in ends]
            low, high = (np.concatenate(x) for x in zip(axis, rim, strict=True))
            meshes.append(solids.prism(low, high))
    held = [bonds.to_plane(meshes, (0, 0, 0), DOWN)] if anchor else []
    return solids.assemble(meshes, world=held, dtype=dtype)


def bridge(
    spans: int = 2,
    span: float = 4.0,
    rise: float = 1.2,
    thickness: float = 0.4,
    width: float = 1.5,
    *,
    voussoirs: int = 9,
    pier: float = 1.0,
    height: float = 1.5,
    courses: int = 3,
    fill: float = 0.3,
    deck: float = 0.25,
    anchor: bool = True,
    dtype: Any = None,
) -> Destructible:
    """Build a stone bridge along x: piers, arches, spandrels upon them, and a deck.

    Args:
      spans: number of arches.
      span: of each, m.
      rise: of each, at most half the span, m.
      thickness: of the rings, m.
      width: along y, m.
      voussoirs: wedges of each arch.
      pier: length of a pier along x, m; wide enough for the springings on it.
      height: of the piers up to the springings, m.
      courses: stones that a pier is made of.
      fill: masonry over the crown, m.
      deck: thickness of the deck, m.
      anchor: bind the feet of the piers to the world.
      dtype: see `author.build`.

    Raises:
      ValueError: a length is not above zero, the rise is above half the span, or the
        piers are too short for the springings.
    """
    positive(span=span, rise=rise, thickness=thickness, width=width, pier=pier)
    positive(height=height, fill=fill, deck=deck)
    spans, number, courses = counts(
        "spans, voussoirs, courses", (spans, voussoirs, courses), 3
    )
    inner, outer = _ring(span, rise, thickness, number)
    inward = float(inner[0, 0] - outer[0, 0])
    if pier < 2 * inward + 1e-6 * span:
        raise ValueError(
            f"pier is {pier} m; two springings on it need more than {2 * inward:g} m"
        )
    road = height + float(outer[:, 1].max()) + fill
    start = -(spans * span + (spans + 1) * pier) / 2
    meshes = []
    for i in range(spans + 1):
        left = start + i * (span + pier)
        skew = (inward * (i > 0), inward * (i < spans))
        spring = height + float(outer[0, 1])
        meshes += _pier(left, pier, skew, height, spring, road, deck, courses, width)
    for i in range(spans):
        shift = np.array([start + pier + span / 2 + i * (span + pier), height])
        meshes += _wedges(inner + shift, outer + shift, width)
        for a, b in zip(outer[:-1] + shift, outer[1:] + shift, strict=True):
            top = [(b[0], road), (a[0], road)]
            meshes.append(_slab([tuple(a), tuple(b), *top], width))
            meshes.append(_box(a[0], b[0], road, road + deck, width))
    held = [bonds.to_plane(meshes, (0, 0, 0), DOWN)] if anchor else []
    return solids.assemble(meshes, world=held, dtype=dtype)


def _pier(
    left: float,
    pier: float,
    skew: tuple[float, float],
    height: float,
    spring: float,
    road: float,
    deck: float,
    courses: int,
    width: float,
) -> list[Mesh]:
    """Return a pier's stones, the one that arches spring from, and those above."""
    right = left + pier
    levels = np.linspace(0, height, courses + 1)
    meshes = [
        _box(left, right, low, high, width) for low, high in itertools.pairwise(levels)
    ]
    in_left, in_right = left + skew[0], right - skew[1]
    # Where arches are half circles they spring from a level bed.
    if spring > height * (1 + 1e-9):
        foot = [(left, height), (right, height)]
        head = [(in_right, spring), (in_left, spring)]
        meshes.append(_slab(foot + head, width))
    meshes.append(_box(in_left, in_right, spring, road, width))
    meshes.append(_box(in_left, in_right, road, road + deck, width))
    return meshes


def _ring(
    span: float, rise: float, thickness: float, number: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (number + 1, 2) of a ring in x and z, left to right."""
    if rise > span / 2 * (1 + 1e-9):
        raise ValueError(f"rise is {rise} m; at most half the span, {span / 2:g} m")
    radius = (span**2 / 4 + rise**2) / (2 * rise)
    half = np.arcsin(min(span / 2 / radius, 1.0))
    turn = np.linspace(-half, half, number + 1)
    unit = np.stack([np.sin(turn), np.cos(turn)], axis=1)
    # The springings are level, and a half circle's lie in one plane, to the last digit.
    base = unit[0, 1] if radius > rise * (1 + 1e-12) else 0.0
    unit[[0, -1], 1] = base
    drop = np.array([0.0, radius * base])
    return radius * unit - drop, (radius + thickness) * unit - drop


def _wedges(inner: np.ndarray, outer: np.ndarray, width: float) -> list[Mesh]:
    return [
        _slab([inner[i], inner[i + 1], outer[i + 1], outer[i]], width)
        for i in range(len(inner) - 1)
    ]


def _slab(outline: Any, width: float) -> Mesh:
    """Return the solid between an outline in x and z and itself across the width.

    The outline runs counter-clockwise seen from the front, -y.
    """
    flat = np.asarray(outline, float)
    front = np.insert(flat, 1, -width / 2, axis=1)
    back = np.insert(flat, 1, width / 2, axis=1)
    return solids.prism(back, front)


def _box(left: float, right: float, low: float, high: float, width: float) -> Mesh:
    return _slab([(left, low), (right, low), (right, high), (left, high)], width)


def positive(**lengths: float) -> None:
    """Raise ValueError unless all are above zero."""
    for name, value in lengths.items():
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} is {value}; it must be finite and above 0")
