"""Descriptions of chunks and bonds, in any order, and the checks on what they say.

Plain numpy; every check names the first offender, its value and the remedy.
"""

import dataclasses
from typing import Any

import numpy as np

from blastjax.core import NO_PARENT, WORLD


@dataclasses.dataclass(frozen=True)
class Chunks:
    """Chunk descriptions, one row a chunk; sizes as in `core`."""

    parent: Any
    """(C,) index of the parent description, NO_PARENT for roots."""
    centroid: Any
    """(C, 3) centre of mass, m."""
    volume: Any
    """(C,) volume, m^3."""
    support: Any = None
    """(C,) bool, whether to be a node of the support graph; None marks the leaves."""
    size: Any = None
    """(C, 3) half extents of its box, m; None takes a cube of the chunk's volume."""
    inertia: Any = None
    """(C, 3, 3) inertia about the centroid at unit density, m^5; None: the box's."""


@dataclasses.dataclass(frozen=True)
class Bonds:
    """Bond descriptions, one row a bond."""

    chunks: Any
    """(B, 2) indices of chunk descriptions; WORLD for one binds to the world."""
    normal: Any
    """(B, 3) unit normal, from the first chunk to the second."""
    area: Any
    """(B,) bonded area, m^2."""
    centroid: Any
    """(B, 3) centroid of the bonded face, m."""

    @classmethod
    def none(cls) -> "Bonds":
        """Return no bonds."""
        return cls(
            np.zeros((0, 2), int), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3))
        )


def checked_chunks(chunks: Chunks) -> Chunks:
    """Return the chunk descriptions as complete arrays.

    Raises:
      ValueError: a field has a wrong type, shape or value.
    """
    parent = integers("chunk parent", chunks.parent)
    count = len(parent)
    if count == 0:
        raise ValueError("there are no chunks; describe at least one")
    shaped("chunk parent", parent, (count,))
    bad = (parent < NO_PARENT) | (parent >= count)
    refuse(
        bad,
        parent,
        "chunk {i} has parent {v}, which is no chunk; "
        f"give an index below {count}, or NO_PARENT ({NO_PARENT}) for a root",
    )
    depth = _depths(parent)
    refuse(
        depth < 0,
        parent,
        "chunk {i} (parent {v}) is its own ancestor; "
        "parents must lead to a root without a loop",
    )
    centroid = reals("chunk centroid", chunks.centroid, (count, 3))
    volume = reals("chunk volume", chunks.volume, (count,))
    refuse(
        volume < 0, volume, "chunk {i} has volume {v}; a volume is zero or more, in m^3"
    )
    if chunks.support is None:
        support = np.ones(count, bool)
        support[parent[parent >= 0]] = False
    else:
        support = flags("chunk support", chunks.support, count)
    if chunks.size is None:
        size = np.repeat(np.cbrt(volume)[:, None] / 2, 3, axis=1)
    else:
        size = reals("chunk size", chunks.size, (count, 3))
        refuse(
            np.any(size < 0, axis=1),
            size,
            "chunk {i} has size {v}; half extents are zero or more, in m",
        )
    if chunks.inertia is None:
        square = size**2
        spread = square.sum(axis=1, keepdims=True) - square
        inertia = (volume[:, None] * spread / 3)[:, :, None] * np.eye(3)
    else:
        inertia = reals("chunk inertia", chunks.inertia, (count, 3, 3))
        scale = np.abs(inertia).max(axis=(1, 2), initial=0.0)
        lopsided = np.abs(inertia - inertia.transpose(0, 2, 1)).max(axis=(1, 2))
        refuse(
            lopsided > 1e-5 * scale,
            inertia,
            "chunk {i} has inertia {v}, which is not symmetric; give the full tensor",
        )
        lowest = np.linalg.eigvalsh((inertia + inertia.transpose(0, 2, 1)) / 2)[:, 0]
        refuse(
            lowest < -1e-5 * scale,
            inertia,
            "chunk {i} has inertia {v}, which has a negative moment; "
            "give it about the centroid, at unit density",
        )
    return Chunks(parent, centroid, volume, support, size, inertia)


def checked_bonds(bonds: Bonds) -> Bonds:
    """Return the bond descriptions as complete arrays; chunk indices stay unchecked.

    Raises:
      ValueError: a field has a wrong type, shape or value.
    """
    pairs = integers("bond chunks", bonds.chunks)
    count = len(pairs)
    shaped("bond chunks", pairs, (count, 2))
    normal = reals("bond normal", bonds.normal, (count, 3))
    area = reals("bond area", bonds.area, (count,))
    refuse(area < 0, area, "bond {i} has area {v}; an area is zero or more, in m^2")
    centroid = reals("bond centroid", bonds.centroid, (count, 3))
    return Bonds(pairs, normal, area, centroid)


def refuse_invalid_bonds(pairs: np.ndarray, count: int) -> None:
    """Raise for the first bond that joins nothing, or a chunk to itself."""
    known = ((pairs >= 0) & (pairs < count)) | (pairs == WORLD)
    refuse(
        ~known.all(axis=1),
        pairs,
        "bond {i} joins chunks {v}, of which one does not exist; "
        f"give indices below {count}, or WORLD ({WORLD})",
    )
    refuse(
        pairs[:, 0] == pairs[:, 1],
        pairs[:, 0],
        "bond {i} joins chunk {v} to itself; "
        "a bond needs two different support chunks, or one and WORLD",
    )


def refuse(bad: np.ndarray, values: np.ndarray, message: str) -> None:
    """Raise ValueError for the first bad element, {i} its index and {v} its value."""
    if bad.any():
        i = int(np.argmax(bad))
        raise ValueError(message.format(i=i, v=np.asarray(values[i]).tolist()))


def shaped(name: str, values: np.ndarray, shape: tuple[int, ...]) -> None:
    """Raise ValueError unless the array has this shape."""
    if values.shape != shape:
        raise ValueError(f"{name} has shape {values.shape}; it must be {shape}")


def integers(name: str, values: Any) -> np.ndarray:
    """Return an int64 array, or raise ValueError."""
    array = _array(name, values)
    if array.size == 0:
        return array.astype(np.int64)
    if array.dtype.kind not in "iu":
        raise ValueError(f"{name} has dtype {array.dtype}; it must hold integers")
    return array.astype(np.int64)


def flags(name: str, values: Any, count: int) -> np.ndarray:
    """Return a bool array of this length, or raise ValueError."""
    array = _array(name, values)
    shaped(name, array, (count,))
    if array.dtype.kind not in "biu" or not np.isin(array, (0, 1)).all():
        raise ValueError(
            f"{name} must hold truth values, not {array.dtype} {array[:4]}"
        )
    return array.astype(bool)


def reals(name: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return a finite float64 array of this shape, or raise ValueError."""
    array = _array(name, values)
    if array.dtype.kind not in "fiu" and array.size:
        raise ValueError(f"{name} has dtype {array.dtype}; it must hold real numbers")
    shaped(name, array, shape)
    array = array.astype(np.float64)
    finite = np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    refuse(~finite, array, name + " {i} is {v}; it must be finite")
    return array


def _array(name: str, values: Any) -> np.ndarray:
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise ValueError(f"{name} is ragged; give rows of equal length") from error
    if array.ndim == 0:
        raise ValueError(
            f"{name} is {array!r}; it must be an array, one row an element"
        )
    return array


def _depths(parent: np.ndarray) -> np.ndarray:
    """Return each chunk's distance to its root, -1 where a loop keeps it from one."""
    # Each round doubles how far `above` looks: log2 of the depth, not the depth.
    above, depth = parent, np.where(parent < 0, 0, 1)
    for _ in range(len(parent).bit_length()):
        if (above < 0).all():
            break
        depth = depth + np.where(above < 0, 0, depth[above])
        above = np.where(above < 0, above, above[above])
    return np.where(above < 0, depth, -1)


def depths(parent: np.ndarray) -> np.ndarray:
    """Return each chunk's distance to its root, (C,) int; parents must be acyclic."""
    return _depths(parent)
