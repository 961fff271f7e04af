"""Ways to cut: each takes leaves of a tree of pieces and returns the deeper tree."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from blastjax.author.cut import complexes, lattice, planar
from blastjax.author.cut.complexes import Complex
from blastjax.author.cut.noise import Noise
from blastjax.author.cut.sites import Sites
from blastjax.author.cut.tree import Tree, chosen, cut
from blastjax.author.descriptions import reals

MAX_BRICKS = 1e6
"""More bricks are refused: a size in the wrong unit."""


def voronoi(
    tree: Tree,
    sites: Sites | Any,
    *,
    pieces: Sequence[int] | None = None,
    stretch: Any = None,
    noise: Noise | None = None,
) -> Tree:
    """Cut leaves into the Voronoi cells of sites.

    Args:
      tree: the pieces.
      sites: (S, 3) points, m, which cut every chosen leaf, or `Sites`, each of which
        cuts only the leaf that it was made for.
      pieces: the leaves to cut; None takes all, or all that the sites were made for.
      stretch: (3,) or (3, 3) makes cells longer: distances are measured in space
        divided by these factors along x, y, z, or by this matrix.
      noise: roughens the cut faces.

    Raises:
      ValueError: sites coincide or are not finite, the stretch has no inverse, or a
        piece cannot be cut.
    """
    matrix = _stretch(stretch)
    if isinstance(sites, Sites):
        own = np.unique(sites.piece) if pieces is None else chosen(tree, pieces)
        groups = {
            int(p): sites.points[sites.piece == p] for p in chosen(tree, own.tolist())
        }
        groups = {p: points for p, points in groups.items() if len(points) > 1}
        boxes = {p: tree.bounds(p) for p in groups}
        cutters = {
            p: [_cells(points, *boxes[p], matrix, noise)]
            for p, points in groups.items()
        }
        return cut(tree, cutters)
    points = _points(sites)
    wanted = chosen(tree, pieces)
    if len(points) < 2 or not len(wanted):
        return tree
    cells = [_cells(points, *_around(tree, wanted), matrix, noise)]
    return cut(tree, {int(p): cells for p in wanted})


def plane(
    tree: Tree,
    point: Any,
    normal: Any,
    *,
    pieces: Sequence[int] | None = None,
    noise: Noise | None = None,
) -> Tree:
    """Cut leaves along a plane.

    Args:
      tree: the pieces.
      point: (3,) on the plane, m.
      normal: (3,) of any length.
      pieces: the leaves to cut; None takes all.
      noise: roughens the cut.
    """
    point, normal = (
        reals(name, value, (3,))
        for name, value in (("plane point", point), ("plane normal", normal))
    )
    if not np.linalg.norm(normal) > 0:
        raise ValueError("the plane's normal is zero; give a direction")
    wanted = chosen(tree, pieces)
    box = _around(tree, wanted)
    halves = [_rough(complexes.halves(point, normal, *box), noise, box)]
    return cut(tree, {int(p): halves for p in wanted})


def slices(
    tree: Tree,
    count: tuple[int, int, int],
    *,
    offset: float = 0.0,
    angle: float = 0.0,
    pieces: Sequence[int] | None = None,
    noise: Noise | None = None,
    seed: int = 0,
) -> Tree:
    """Cut each leaf by evenly spaced planes across x, y and z.

    Args:
      tree: the pieces.
      count: slices along x, y and z; 1 leaves an axis uncut.
      offset: planes move by up to this part of half their spacing, in [0, 1].
      angle: planes tilt by up to this angle, radians.
      pieces: the leaves to cut; None takes all.
      noise: roughens the cuts.
      seed: of the variation.
    """
    if len(count) != 3 or min(count) < 1:
        raise ValueError(
            f"slices {count} must be three numbers from 1, along x, y and z"
        )
    if not 0 <= offset <= 1 or not 0 <= angle < np.pi / 2:
        raise ValueError(
            f"slices vary by offset {offset} and angle {angle}; they must lie in "
            "[0, 1] and [0, pi / 2)"
        )
    rng = np.random.default_rng(seed)
    cutters = {}
    for piece in chosen(tree, pieces):
        box = low, high = tree.bounds(piece)
        planes = []
        for axis, number in enumerate(count):
            for k in range(1, number):
                shift = rng.uniform(-1, 1) * offset / 2
                point = low + (high - low) * (k + shift) / number
                normal = np.eye(3)[axis] + np.tan(angle) * _disk(rng, axis)
                flat = complexes.halves(
                    np.where(np.arange(3) == axis, point, (low + high) / 2),
                    normal,
                    low,
                    high,
                )
                planes.append(_rough(flat, noise, box))
        cutters[int(piece)] = planes
    return cut(tree, cutters)


def bricks(
    tree: Tree,
    size: Any,
    *,
    shift: float = 0.5,
    origin: Any = None,
    pieces: Sequence[int] | None = None,
    noise: Noise | None = None,
) -> Tree:
    """Cut leaves into bricks laid in courses along z.

    Args:
      tree: the pieces.
      size: (3,) extent of a brick along x, y, z, m.
      shift: how far every other course is moved along x, in bricks: 0.5 is a running
        bond.
      origin: (3,) corner of a brick of the first course; None takes the least corner
        of what is cut.
      pieces: the leaves to cut; None takes all.
      noise: roughens the cuts.
    """
    size = reals("brick size", size, (3,))
    if not (size > 0).all():
        raise ValueError(f"brick size {size.tolist()} must be above 0, in m")
    wanted = chosen(tree, pieces)
    box = low, high = _around(tree, wanted)
    origin = low if origin is None else reals("brick origin", origin, (3,))
    counts = np.ceil((high - low) / size)
    if np.prod(counts) > MAX_BRICKS:
        raise ValueError(
            f"bricks of {size.tolist()} m would make {counts.tolist()} of them along "
            "x, y, z; give a larger size"
        )
    cells = lattice.courses(origin, size, low, high, shift)
    rough = [_rough(cells, noise, box)]
    return cut(tree, {int(p): rough for p in wanted})


def cutout(
    tree: Tree,
    pattern: Any,
    *,
    origin: Any = None,
    across: Any = (1.0, 0.0, 0.0),
    up: Any = (0.0, 0.0, 1.0),
    size: Any = None,
    smooth: float = 0.0,
    pieces: Sequence[int] | None = None,
    noise: Noise | None = None,
) -> Tree:
    """Cut leaves straight through along the lines of a flat pattern.

    The pattern lies in a plane through `origin`, and each of its regions, and what lies
    outside of all, is cut out like a cookie.

    Args:
      tree: the pieces.
      pattern: closed outlines as a list of (K, 2) points, open lines included if they
        end at others; or a bitmap (H, W) of whole numbers or flags, whose regions are
        connected pixels of one value, its first row on top.
      origin: (3,) where the pattern's point (0, 0) goes, m; None takes the least corner
        of what is cut, seen along the pattern's axes.
      across: (3,) direction of the pattern's x.
      up: (3,) direction of the pattern's y.
      size: (2,) extent that the pattern is stretched to, m; None takes that of what is
        cut for a bitmap, and outlines in m as they are.
      smooth: straightens the steps of a bitmap's outlines by up to this many pixels.
      pieces: the leaves to cut; None takes all.
      noise: roughens the cuts.
    """
    wanted = chosen(tree, pieces)
    box = _around(tree, wanted)
    axes = planar.frame(across, up)
    corners = _corners(*box) @ axes
    seen = np.stack([corners.min(axis=0), corners.max(axis=0)])
    start = seen[0] if origin is None else reals("cutout origin", origin, (3,)) @ axes
    size = None if size is None else reals("cutout size", size, (2,))
    lines = planar.lines(pattern, size, (seen[1] - seen[0])[:2], smooth)
    cells = planar.prisms(lines, axes, start[:2], seen)
    rough = [_rough(cells, noise, box)]
    return cut(tree, {int(p): rough for p in wanted})


def _cells(
    points: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    matrix: np.ndarray | None,
    noise: Noise | None,
) -> Complex:
    span = float(np.linalg.norm(high - low))
    _refuse_same(points, 1e-9 * span)
    if matrix is None:
        return _rough(complexes.voronoi(points, low, high), noise, (low, high))
    inverse = np.linalg.inv(matrix)
    corners = _corners(low, high) @ inverse.T
    cells = complexes.voronoi(
        points @ inverse.T, corners.min(axis=0), corners.max(axis=0)
    )
    return _rough(complexes.moved(cells, matrix), noise, (low, high))


def _rough(
    cells: Complex, noise: Noise | None, box: tuple[np.ndarray, np.ndarray]
) -> Complex:
    return cells if noise is None else complexes.roughen(cells, noise, *box)


def _around(tree: Tree, pieces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    boxes = np.array([tree.bounds(int(p)) for p in pieces]).reshape(-1, 2, 3)
    if not len(boxes):
        return tree.bounds()
    return boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)


def _corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(3, -1).T


def _points(sites: Any) -> np.ndarray:
    points = np.asarray(sites)
    return reals("site", points, (len(points) if points.ndim else 0, 3))


def _refuse_same(points: np.ndarray, distance: float) -> None:
    spatial = complexes.geometry.need("scipy.spatial")
    pairs = spatial.cKDTree(points).query_pairs(distance, output_type="ndarray")
    if len(pairs):
        first, second = pairs[np.lexsort(pairs.T[::-1])[0]].tolist()
        raise ValueError(
            f"sites {first} and {second} are both at {points[first].tolist()}; "
            "give different points"
        )


def _stretch(stretch: Any) -> np.ndarray | None:
    if stretch is None:
        return None
    matrix = np.asarray(stretch, np.float64)
    if matrix.shape == (3,):
        matrix = np.diag(matrix)
    matrix = reals("stretch", matrix, (3, 3))
    if not np.linalg.det(matrix) > 0:
        raise ValueError(
            f"stretch {np.asarray(stretch).tolist()} must be three factors above 0, or "
            "a matrix of positive determinant"
        )
    return matrix


def _disk(rng: np.random.Generator, axis: int) -> np.ndarray:
    """Return a random vector of length up to 1 across an axis."""
    turn, reach = rng.uniform(0, 2 * np.pi), np.sqrt(rng.uniform())
    return np.insert(reach * np.array([np.cos(turn), np.sin(turn)]), axis, 0.0)
