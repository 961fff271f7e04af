"""Affine maps of chunks, bonds and meshes, exact for their moments. Host data."""

import dataclasses
from typing import Any

import numpy as np

from blastjax.author import solids
from blastjax.author.descriptions import Bonds, Chunks, reals
from blastjax.author.mesh import Mesh


def placed(
    position: Any = (0.0, 0.0, 0.0),
    quaternion: Any = (1.0, 0.0, 0.0, 0.0),
    scale: float = 1.0,
) -> np.ndarray:
    """Return the (4, 4) matrix that scales, then turns, then moves.

    Args:
      position: (3,) m.
      quaternion: (4,) w first, of any length but zero.
      scale: one number.

    Raises:
      ValueError: the quaternion has no length.
    """
    turn = reals("quaternion", quaternion, (4,))
    length = np.linalg.norm(turn)
    if length == 0:
        raise ValueError(f"quaternion is {turn.tolist()}; (1, 0, 0, 0) is no rotation")
    w, x, y, z = turn / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] = scale * (np.eye(3) + 2 * w * cross + 2 * cross @ cross)
    matrix[:3, 3] = reals("position", position, (3,))
    return matrix


def mirrored(normal: Any, point: Any = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the (4, 4) matrix that mirrors at the plane through a point.

    Args:
      normal: (3,) of the plane, of any length but zero.
      point: (3,) on it, m.

    Raises:
      ValueError: the normal has no length.
    """
    normal, point = reals("normal", normal, (3,)), reals("point", point, (3,))
    square = normal @ normal
    if square == 0:
        raise ValueError(f"normal is {normal.tolist()}; it needs a direction")
    matrix = np.eye(4)
    matrix[:3, :3] -= 2 * np.outer(normal, normal) / square
    matrix[:3, 3] = 2 * normal * (normal @ point) / square
    return matrix


def parts(matrix: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the linear part (3, 3) and the shift (3,) of a (4, 4) or (3, 3) matrix.

    Raises:
      ValueError: the matrix is of another shape, not affine, or singular.
    """
    shape = np.shape(matrix)
    if shape not in ((3, 3), (4, 4)):
        raise ValueError(f"the matrix has shape {shape}; it must be (4, 4) or (3, 3)")
    rows = reals("matrix row", matrix, shape)
    if shape == (4, 4) and not np.array_equal(rows[3], [0, 0, 0, 1]):
        raise ValueError(f"matrix row 3 is {rows[3].tolist()}; it must be 0, 0, 0, 1")
    linear = rows[:3, :3]
    least, most = np.linalg.svd(linear, compute_uv=False)[[2, 0]]
    if not least > 1e-9 * most:
        raise ValueError("the matrix is singular: it would flatten the asset")
    return linear, rows[:3, 3] if shape == (4, 4) else np.zeros(3)


def move_chunks(chunks: Chunks, linear: np.ndarray, shift: np.ndarray) -> Chunks:
    """Return complete chunk descriptions under the map."""
    grows = abs(np.linalg.det(linear))
    trace = np.trace(chunks.inertia, axis1=1, axis2=2)[:, None, None]
    # Second moments map as a form does; the inertia is their trace less them.
    second = grows * linear @ (trace / 2 * np.eye(3) - chunks.inertia) @ linear.T
    trace = np.trace(second, axis1=1, axis2=2)[:, None, None]
    inertia, volume = trace * np.eye(3) - second, grows * chunks.volume
    small = np.abs(linear) < 1e-12 * np.abs(linear).max()
    if (small.sum(axis=1) == 2).all():
        size = chunks.size @ np.where(small, 0, np.abs(linear)).T
    else:
        size = solids.equal_box(volume, inertia)
    return dataclasses.replace(
        chunks,
        centroid=chunks.centroid @ linear.T + shift,
        volume=volume,
        inertia=inertia,
        size=size,
    )


def move_bonds(bonds: Bonds, linear: np.ndarray, shift: np.ndarray) -> Bonds:
    """Return bond descriptions under the map; areas map by the cofactors."""
    cofactor = abs(np.linalg.det(linear)) * np.linalg.inv(linear).T
    vector = bonds.normal @ cofactor.T
    length = np.linalg.norm(vector, axis=1)
    return Bonds(
        bonds.chunks,
        vector / np.where(length > 0, length, 1)[:, None],
        bonds.area * length,
        bonds.centroid @ linear.T + shift,
    )


def move_mesh(mesh: Mesh, linear: np.ndarray, shift: np.ndarray) -> Mesh:
    """Return the mesh under the map, its faces still seen from outside."""
    faces = mesh.faces if np.linalg.det(linear) > 0 else mesh.faces[:, ::-1].copy()
    return Mesh(mesh.vertices @ linear.T + shift, faces, mesh.interior)
