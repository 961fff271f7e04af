"""Cells that are prisms over the regions of a flat pattern."""

from typing import Any

import numpy as np

from blastjax.author.cut import geometry
from blastjax.author.cut.complexes import Complex
from blastjax.author.descriptions import reals
from blastjax.core import NONE

SNAP = 1e-9
"""Points of a pattern nearer than this part of its extent are one point."""


def frame(across: Any, up: Any) -> np.ndarray:
    """Return the pattern's axes as columns, (3, 3), the third along the cut.

    Raises:
      ValueError: the two directions are parallel, or one is zero.
    """
    across, up = (
        reals(name, value, (3,))
        for name, value in (("cutout across", across), ("cutout up", up))
    )
    depth = np.cross(across, up)
    lengths = np.linalg.norm(across) * np.linalg.norm(up)
    if not np.linalg.norm(depth) > 1e-9 * lengths:
        raise ValueError(
            f"the pattern's axes {across.tolist()} and {up.tolist()} are parallel or "
            "zero; give two directions"
        )
    x, z = across / np.linalg.norm(across), depth / np.linalg.norm(depth)
    return np.stack([x, np.cross(z, x), z], axis=1)


def lines(
    pattern: Any, size: np.ndarray | None, extent: np.ndarray, smooth: float
) -> list[np.ndarray]:
    """Return the lines of a pattern in m, each (K, 2).

    Args:
      pattern: a bitmap (H, W), or a list of outlines (K, 2).
      size: (2,) m to stretch it to, or None.
      extent: (2,) m that a bitmap without size fills.
      smooth: how much a bitmap's outlines are straightened, pixels.
    """
    if isinstance(pattern, np.ndarray) and pattern.ndim == 2 and pattern.shape[1] != 2:
        found = _outlines(pattern, smooth)
        scale = (extent if size is None else size) / pattern.shape[::-1]
        return [line * scale for line in found]
    found = [np.asarray(line, np.float64) for line in pattern]
    if not found:
        raise ValueError("the pattern has no lines; give at least one outline")
    for i, line in enumerate(found):
        if line.ndim != 2 or line.shape[1] != 2 or len(line) < 2:
            raise ValueError(
                f"outline {i} of the pattern has shape {line.shape}; it must be "
                "(points, 2)"
            )
        if not np.isfinite(line).all():
            raise ValueError(f"outline {i} of the pattern is not finite")
    if size is None:
        return found
    points = np.concatenate(found)
    span = np.ptp(points, axis=0)
    return [
        (line - points.min(axis=0)) * (size / np.where(span > 0, span, 1))
        for line in found
    ]


def prisms(
    pattern: list[np.ndarray], axes: np.ndarray, origin: np.ndarray, box: np.ndarray
) -> Complex:
    """Return prisms over all regions between the pattern's lines.

    Args:
      pattern: lines (K, 2) in the pattern's own coordinates, m.
      axes: (3, 3) from `frame`.
      origin: (2,) where the pattern's zero lies along the first two axes, m.
      box: (2, 3) least and greatest corner of what is cut, along the axes.

    Raises:
      ValueError: the lines enclose nothing.
    """
    shapely = geometry.need("shapely")
    margin = float(np.linalg.norm(box[1] - box[0]))
    rim = shapely.box(*(box[0] - margin)[:2], *(box[1] + margin)[:2]).exterior
    drawn = [shapely.LineString(line + origin) for line in pattern]
    noded = shapely.union_all([rim, *drawn], grid_size=SNAP * margin)
    faces = shapely.get_parts(shapely.polygonize([noded]))
    faces = shapely.orient_polygons(shapely.normalize(faces))
    if len(faces) < 2:
        raise ValueError(
            "the pattern's lines enclose no region; close them, or let them end at "
            "other lines"
        )
    rings = [
        [np.asarray(ring.coords)[:-1] for ring in (face.exterior, *face.interiors)]
        for face in faces
    ]
    points, place = np.unique(
        np.concatenate([ring for face in rings for ring in face]),
        axis=0,
        return_inverse=True,
    )
    return _extrude(points, place.ravel(), rings, axes, box[:, 2], margin)


def _extrude(
    points: np.ndarray,
    place: np.ndarray,
    rings: list[list[np.ndarray]],
    axes: np.ndarray,
    depth: np.ndarray,
    margin: float,
) -> Complex:
    """Return prisms over polygons, whose rings have their points at `place`."""
    triangulate = geometry.need("manifold3d").triangulate
    count, at = len(points), 0
    caps, cap_cells = [], []
    sides: dict[tuple[int, int], int] = {}
    for cell, polygon in enumerate(rings):
        start = at
        for ring in polygon:
            here = place[at : at + len(ring)]
            at += len(ring)
            sides |= {edge: cell for edge in zip(here, np.roll(here, -1), strict=True)}
        flat = place[start:at][np.asarray(triangulate(polygon), np.int64)]
        caps += [flat[:, ::-1], flat + count]
        cap_cells += [cell] * (2 * len(flat))
    walls, wall_cells = [], []
    for (a, b), cell in sides.items():
        other = sides.get((b, a), NONE)
        if other == NONE or a < b:
            walls += [(a, b, b + count), (a, b + count, a + count)]
            wall_cells += [(cell, other)] * 2
    flat_points = np.concatenate([points, points])
    heights = np.repeat([depth[0] - margin, depth[1] + margin], count)
    cells = np.concatenate(
        [np.array([(cell, NONE) for cell in cap_cells]), np.array(wall_cells)]
    )
    facet = np.concatenate(
        [np.arange(len(cap_cells)), len(cap_cells) + np.arange(len(walls)) // 2]
    )
    return Complex(
        np.column_stack([flat_points, heights]) @ axes.T,
        np.concatenate([*caps, np.array(walls)]),
        cells,
        facet,
    )


def _outlines(bitmap: np.ndarray, smooth: float) -> list[np.ndarray]:
    """Return the outlines of a bitmap's regions in pixels, y upward."""
    shapely, ndimage = geometry.need("shapely"), geometry.need("scipy.ndimage")
    if bitmap.dtype.kind not in "biu" or not bitmap.size:
        raise ValueError(
            f"the bitmap has dtype {bitmap.dtype} and shape {bitmap.shape}; give whole "
            "numbers or flags, at least one pixel"
        )
    # What lies beyond the bitmap goes on as its rim: no cut along the rim itself.
    wide = np.pad(bitmap[::-1], 1, mode="edge")
    regions, found = np.zeros(wide.shape, np.int64), 0
    for value in np.unique(wide):
        label, number = ndimage.label(wide == value)
        regions += np.where(label > 0, label + found, 0)
        found += number
    row, column = np.nonzero(regions[1:] != regions[:-1])
    level = np.stack([column, row + 1, column + 1, row + 1], axis=1)
    row, column = np.nonzero(regions[:, 1:] != regions[:, :-1])
    upright = np.stack([column + 1, row, column + 1, row + 1], axis=1)
    rows, columns = wide.shape
    rim = shapely.box(0, 0, columns, rows).exterior
    edges = np.concatenate([level, upright]).reshape(-1, 2, 2).astype(float)
    if not len(edges):
        raise ValueError("the bitmap has one value all over; it needs two regions")
    noded = shapely.union_all([rim, *shapely.linestrings(edges)])
    faces = shapely.get_parts(shapely.polygonize([noded]))
    faces = shapely.coverage_simplify(faces, max(smooth, SNAP), simplify_boundary=False)
    borders = shapely.union_all(shapely.boundary(faces))
    borders = shapely.get_parts(shapely.line_merge(borders))
    return [shapely.get_coordinates(line) - 1.0 for line in borders]
