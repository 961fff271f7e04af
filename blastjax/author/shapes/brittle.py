"""Things that shatter: a glass pane and a vase. They need the geometry extra."""

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from blastjax.author import bonds, cut, solids
from blastjax.author.descriptions import reals
from blastjax.author.mesh import Destructible
from blastjax.author.shapes.boxes import SIDES, counts
from blastjax.author.shapes.vaults import positive

VASE = (
    *((0.05, 0.0), (0.09, 0.08), (0.1, 0.16)),
    *((0.06, 0.26), (0.04, 0.31), (0.06, 0.36)),
)
"""Radius and height along the outside of a vase, m."""


def pane(
    width: float = 1.0,
    height: float = 1.0,
    thickness: float = 0.008,
    pieces: int = 60,
    *,
    impact: Sequence[float] | None = None,
    seed: int = 0,
    anchor: Sequence[str] = ("x-", "x+", "z-", "z+"),
    dtype: Any = None,
) -> Destructible:
    """Build an upright pane of glass across y, in Voronoi shards.

    Args:
      width: along x, m.
      height: along z, m.
      thickness: along y, m.
      pieces: number of shards.
      impact: (x, z) around which shards are small, m; None makes all alike.
      seed: of the pattern.
      anchor: edges bound to the world, as by a frame; see `boxes`.
      dtype: see `author.build`.

    Raises:
      ValueError: an extent is not above zero, or an option is invalid.
      ImportError: the geometry extra is missing.
    """
    positive(width=width, height=height, thickness=thickness)
    (number,) = counts("pieces", (pieces,), 1)
    unknown = [side for side in anchor if side not in SIDES]
    if unknown:
        raise ValueError(f"anchor {unknown[0]!r} is no side; give any of {SIDES}")
    half = np.array([width, thickness, height]) / 2
    middle = np.array([0.0, 0.0, height / 2])
    tree = cut.solid(solids.box(middle, half))
    rng = np.random.default_rng(seed)
    place = rng.random((number, 2)) - 0.5
    if impact is None:
        flat = place * [width, height] + [0, height / 2]
    else:
        flat = _around(reals("impact", impact, (2,)), number, width, height, rng)
    sites = np.stack([flat[:, 0], np.zeros(number), flat[:, 1]], axis=1)
    tree = cut.voronoi(tree, sites)
    world = []
    for side in anchor:
        normal = (1.0 if side[1] == "+" else -1.0) * np.eye(3)["xyz".index(side[0])]
        world.append(bonds.to_plane(tree.meshes, middle + normal * half, normal))
    found = cut.destructible(tree, world=world, dtype=dtype)
    return found.destructible


def vase(
    profile: Sequence[Sequence[float]] = VASE,
    thickness: float = 0.01,
    pieces: int = 40,
    *,
    sides: int = 32,
    seed: int = 0,
    anchor: bool = False,
    dtype: Any = None,
) -> Destructible:
    """Turn a profile into a hollow vessel, in Voronoi shards.

    Args:
      profile: (radius, height) points along the outside, upwards from the foot, m.
      thickness: of wall and floor, m; measured across for the wall.
      pieces: number of cells; one that holds parts that do not touch gives several.
      sides: corners of its cross-section.
      seed: of the pattern.
      anchor: bind the foot to the world; a vase that just stands is not bound.
      dtype: see `author.build`.

    Raises:
      ValueError: the profile does not go upwards, or is thinner than its wall.
      ImportError: the geometry extra is missing.
    """
    positive(thickness=thickness)
    number, sides = counts("pieces and sides", (pieces, sides), 2)
    if sides < 3:
        raise ValueError(f"sides is {sides}; a cross-section has 3 or more")
    points = reals("profile", np.asarray(profile), (len(profile), 2))
    if len(points) < 2 or not (np.diff(points[:, 1]) > 0).all():
        raise ValueError("the profile must go upwards, through two points or more")
    foot, top = points[0, 1], points[-1, 1]
    if points[:, 0].min() <= thickness or top - foot <= thickness:
        raise ValueError(f"the profile is thinner than its wall of {thickness} m")
    floor = foot + thickness
    inner = points[points[:, 1] > floor] - [thickness, 0]
    at_floor = np.interp(floor, points[:, 1], points[:, 0]) - thickness
    outline = np.concatenate(
        [[[0, foot]], points, inner[::-1], [[at_floor, floor], [0, floor]]]
    )
    trimesh = importlib.import_module("trimesh")
    tree = cut.solid(trimesh.creation.revolve(outline, sections=sides))
    tree = cut.voronoi(tree, cut.uniform(tree, number, seed=seed))
    world = [bonds.to_plane(tree.meshes, (0, 0, foot), (0, 0, -1))] if anchor else ()
    found = cut.destructible(tree, world=world, dtype=dtype)
    return found.destructible


def _around(
    impact: np.ndarray,
    number: int,
    width: float,
    height: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return points (number, 2) in a rectangle, denser towards the impact."""
    reach = np.hypot(width, height)
    found = np.zeros((0, 2))
    while len(found) < number:
        # Uniform in the distance: as many in each ring, however small it is.
        radius, turn = reach * rng.random(number), 2 * np.pi * rng.random(number)
        step = radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        point = impact + step
        inside = (np.abs(point[:, 0]) <= width / 2) & (
            np.abs(point[:, 1] - height / 2) <= height / 2
        )
        if not inside.any() and not len(found):
            raise ValueError(f"impact {impact.tolist()} is too far from the pane")
        found = np.concatenate([found, point[inside]])
    return found[:number]
