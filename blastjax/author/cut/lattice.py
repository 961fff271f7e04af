"""Cells that are boxes of a rectilinear grid, such as bricks in courses."""

import numpy as np

from blastjax.author.cut.complexes import Complex
from blastjax.core import NONE


def courses(
    origin: np.ndarray,
    size: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    shift: float,
) -> Complex:
    """Return bricks that fill a box, every other course moved along x.

    Args:
      origin: (3,) corner of a brick of an even course, m.
      size: (3,) of a brick, m.
      low: (3,) corner of the box to fill.
      high: (3,) the other corner.
      shift: of the odd courses, in bricks.
    """
    margin = np.linalg.norm(high - low)
    first = np.floor((low - origin) / size).astype(int)
    last = np.ceil((high - origin) / size).astype(int)
    shift = shift % 1.0

    def cuts(axis: int, moved: float = 0.0) -> np.ndarray:
        at = np.arange(first[axis] - 1, last[axis] + 2) + moved
        at = origin[axis] + at * size[axis]
        slack = 1e-9 * margin
        return at[(at > low[axis] + slack) & (at < high[axis] - slack)]

    inner = [np.unique(np.concatenate([cuts(0), cuts(0, shift)])), cuts(1), cuts(2)]
    axes = [
        np.concatenate([[low[k] - margin], inner[k], [high[k] + margin]])
        for k in range(3)
    ]
    # The middle of each box, the outermost seen without their margin.
    edges = [np.clip(axes[k], low[k], high[k]) for k in range(3)]
    middle = [
        ((x[1:] + x[:-1]) / 2 - o) / s
        for x, o, s in zip(edges, origin, size, strict=True)
    ]
    row = np.floor(middle[2]).astype(int)
    column = np.floor(middle[0][:, None] - shift * (row % 2)).astype(int)
    place = np.stack(
        np.broadcast_arrays(
            column[:, None, :],
            np.floor(middle[1]).astype(int)[None, :, None],
            row[None, None, :],
        ),
        axis=-1,
    )
    _, label = np.unique(place.reshape(-1, 3), axis=0, return_inverse=True)
    return grid(axes, label.reshape(place.shape[:3]))


def grid(axes: list[np.ndarray], label: np.ndarray) -> Complex:
    """Return the cells that boxes of a grid with one label make together.

    Args:
      axes: where the grid's planes are: rising arrays (X + 1,), (Y + 1,), (Z + 1,).
      label: (X, Y, Z) cell of each box.
    """
    shape = np.array([len(axis) for axis in axes])
    vertices = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    stride = np.array([shape[1] * shape[2], shape[2], 1])
    padded = np.pad(label, 1, constant_values=NONE)
    quads, cells = [], []
    for axis in range(3):
        along, up = np.roll(np.arange(3), -axis)[1:]
        behind = np.delete(padded, -1, axis=axis)
        before = np.delete(padded, 0, axis=axis)
        for other in (along, up):
            behind = np.delete(behind, (0, -1), axis=other)
            before = np.delete(before, (0, -1), axis=other)
        where = np.argwhere(behind != before)
        corner = where @ stride
        ring = np.array([0, stride[along], stride[along] + stride[up], stride[up]])
        quads.append(corner[:, None] + ring)
        pick = tuple(where.T)
        cells.append(np.stack([behind[pick], before[pick]], axis=1))
    rings = np.concatenate(quads)
    return Complex(
        vertices,
        rings[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3),
        np.repeat(np.concatenate(cells), 2, axis=0),
        np.repeat(np.arange(len(rings)), 2),
    )
