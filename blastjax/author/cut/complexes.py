"""Partitions of space: closed cells that share their facets.

Two cells have the same triangles in common, seen from both sides. So what they cut out
of a solid fits together exactly, also after every vertex was moved by noise.
"""

import dataclasses
import itertools
from typing import Any

import numpy as np

from blastjax.author.cut import geometry
from blastjax.author.cut.noise import Noise
from blastjax.core import NONE

REACH = 12.0
"""Distance of the points that bound outer cells, in radii of what is cut."""


@dataclasses.dataclass(frozen=True)
class Complex:
    """Cells and the triangles between them."""

    vertices: np.ndarray
    """(V, 3) m."""
    triangles: np.ndarray
    """(T, 3) vertices."""
    cells: np.ndarray
    """(T, 2) the cell behind each triangle and the one before it; NONE: no cell."""
    facet: np.ndarray
    """(T,) triangles in one plane, between the same cells, have one number."""

    @property
    def count(self) -> int:
        """How many cells there are."""
        return int(self.cells.max(initial=NONE)) + 1


def voronoi(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> Complex:
    """Return the Voronoi cells of points, complete within a box.

    Args:
      points: (P, 3) different sites.
      low: (3,) corner of the box.
      high: (3,) the other corner.
    """
    spatial = geometry.need("scipy.spatial")
    low = np.minimum(low, points.min(axis=0))
    high = np.maximum(high, points.max(axis=0))
    center, radius = (low + high) / 2, np.linalg.norm(high - low) / 2
    local = (points - center) / radius
    found = spatial.Voronoi(np.concatenate([local, REACH * _icosahedron()]))
    triangles: list[tuple[int, int, int]] = []
    cells: list[np.ndarray] = []
    facet: list[int] = []
    for pair, ring in zip(found.ridge_points, found.ridge_vertices, strict=True):
        if pair.min() >= len(points):
            continue
        fan = [(ring[0], a, b) for a, b in itertools.pairwise(ring[1:])]
        corners = found.vertices[ring]
        normal = np.cross(
            corners - corners[0], np.roll(corners, -1, axis=0) - corners[0]
        ).sum(axis=0)
        across = found.points[pair[1]] - found.points[pair[0]]
        order = pair if normal @ across > 0 else pair[::-1]
        triangles += fan
        cells += [np.where(order < len(points), order, NONE)] * len(fan)
        facet += [facet[-1] + 1 if facet else 0] * len(fan)
    return Complex(
        found.vertices * radius + center,
        np.array(triangles, np.int64),
        np.array(cells, np.int64),
        np.array(facet, np.int64),
    )


def halves(
    point: np.ndarray, normal: np.ndarray, low: np.ndarray, high: np.ndarray
) -> Complex:
    """Return the two sides of a plane as cells that hold a box together.

    Args:
      point: (3,) on the plane.
      normal: (3,) of any length; cell 0 is behind the plane, cell 1 before it.
      low: (3,) corner of the box.
      high: (3,) the other corner.
    """
    up = normal / np.linalg.norm(normal)
    across = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    across /= np.linalg.norm(across)
    center = (low + high) / 2
    reach = 1.5 * np.linalg.norm(high - low)
    middle = center + up * ((point - center) @ up)
    depth = reach + abs((point - center) @ up)
    along = np.cross(up, across)
    square = np.array([across + along, along - across, -across - along, across - along])
    levels = middle + reach * square
    vertices = np.concatenate([levels + h * depth * up for h in (-1, 0, 1)])
    quads, cells = [], []
    for level, pair in enumerate([(NONE, 0), (0, 1), (1, NONE)]):
        quads.append([4 * level + k for k in range(4)])
        cells.append(pair)
    for level in range(2):
        for k in range(4):
            a, b = 4 * level + k, 4 * level + (k + 1) % 4
            quads.append([a, b, b + 4, a + 4])
            cells.append((level, NONE))
    return from_polygons(vertices, quads, cells)


def from_polygons(
    vertices: np.ndarray, polygons: list[list[int]], cells: list[tuple[int, int]]
) -> Complex:
    """Return the complex whose facets are these convex polygons."""
    triangles = [
        (ring[0], a, b) for ring in polygons for a, b in itertools.pairwise(ring[1:])
    ]
    facet = np.repeat(np.arange(len(polygons)), [len(ring) - 2 for ring in polygons])
    return Complex(
        vertices, np.array(triangles, np.int64), np.array(cells)[facet], facet
    )


def moved(complex_: Complex, matrix: np.ndarray) -> Complex:
    """Return the complex under a linear map (3, 3) of positive determinant."""
    return dataclasses.replace(complex_, vertices=complex_.vertices @ matrix.T)


def roughen(
    complex_: Complex, noise: Noise, low: np.ndarray, high: np.ndarray
) -> Complex:
    """Return the complex with every vertex moved by noise, refined within a box.

    Args:
      complex_: flat cells.
      noise: what moves the vertices; its wavelength sets how fine triangles become.
      low: (3,) corner of the box beyond which nothing needs to be fine.
      high: (3,) the other corner.
    """
    margin = noise.amplitude + noise.step
    complex_ = _refine(complex_, noise.step, low - margin, high + margin)
    return dataclasses.replace(
        complex_,
        vertices=complex_.vertices + noise(complex_.vertices),
        facet=np.arange(len(complex_.triangles)),
    )


def bodies(complex_: Complex, first_facet: int) -> list[Any]:
    """Return the cells as `manifold3d.Manifold`; facets count from the first given.

    Raises:
      ValueError: a cell is not closed.
    """
    original = geometry.need("manifold3d").Manifold.reserve_ids(1)
    found = []
    for cell in range(complex_.count):
        behind, before = (complex_.cells == cell).T
        faces = np.concatenate(
            [complex_.triangles[behind], complex_.triangles[before][:, ::-1]]
        )
        facet = np.concatenate([complex_.facet[behind], complex_.facet[before]])
        used, faces = np.unique(faces, return_inverse=True)
        faces = faces.reshape(-1, 3)
        solid = geometry.body(
            complex_.vertices[used], faces, first_facet + facet, original
        )
        if solid.status().name != "NoError":
            raise ValueError(
                f"cell {cell} of the cut is not closed ({solid.status().name}); "
                "move its site a little"
            )
        found.append(solid)
    return found


def _refine(complex_: Complex, step: float, low: Any, high: Any) -> Complex:
    """Halve edges longer than the step that reach into a box, until none is left."""
    while True:
        corners = complex_.vertices[complex_.triangles]
        inside = (corners.max(axis=1) > low) & (corners.min(axis=1) < high)
        near = inside.all(axis=1)
        edges = np.sort(complex_.triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
        edges, place = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
        ends = complex_.vertices[edges]
        long = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > step
        wanted = np.zeros(len(edges), bool)
        place = place.reshape(-1, 3)
        wanted[place[near].ravel()] = True
        split = long & wanted
        if not split.any():
            return complex_
        middle = np.full(len(edges), NONE)
        middle[split] = len(complex_.vertices) + np.arange(split.sum())
        vertices = np.concatenate([complex_.vertices, ends[split].mean(axis=1)])
        complex_ = _halve(complex_, vertices, middle[place])


def _halve(complex_: Complex, vertices: np.ndarray, middle: np.ndarray) -> Complex:
    """Return the triangles with one to three of their edges halved at `middle`."""
    count = (middle != NONE).sum(axis=1)
    # Turn each triangle so that its pattern of halved edges is one of four.
    first = np.where(
        count == 1,
        np.argmax(middle != NONE, axis=1),
        (np.argmin(middle != NONE, axis=1) + 1) % 3,
    )
    turn = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(complex_.triangles, turn, axis=1).T
    ab, bc, ca = np.take_along_axis(middle, turn, axis=1).T
    patterns = [
        [(a, b, c)],
        [(a, ab, c), (ab, b, c)],
        [(ab, b, bc), (a, ab, bc), (a, bc, c)],
        [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)],
    ]
    triangles, source = [], []
    for number, pattern in enumerate(patterns):
        rows = np.flatnonzero(count == number)
        for corners in pattern:
            triangles.append(np.stack(corners, axis=1)[rows])
            source.append(rows)
    rows = np.concatenate(source)
    return Complex(
        vertices, np.concatenate(triangles), complex_.cells[rows], complex_.facet[rows]
    )


def _icosahedron() -> np.ndarray:
    """Return its corners, turned so that they line up with nothing, (12, 3)."""
    golden = (1 + 5**0.5) / 2
    ring = np.array([(0, s, t * golden) for s in (-1, 1) for t in (-1, 1)])
    corners = np.concatenate([np.roll(ring, k, axis=1) for k in range(3)])
    corners /= np.linalg.norm(corners[0])
    turn = np.linalg.qr(np.array([[3.0, 1, 2], [1, -5, 1], [-2, 1, 7]]))[0]
    return corners @ turn
