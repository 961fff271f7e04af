"""Meshes of chunks, and an asset together with them. Host data, float64."""

import dataclasses

import numpy as np

from blastjax.core import Asset


@dataclasses.dataclass(frozen=True)
class Mesh:
    """A closed triangle mesh in the asset's rest frame."""

    vertices: np.ndarray
    """(V, 3) float64, m."""
    faces: np.ndarray
    """(F, 3) int32 vertices, counter-clockwise seen from outside."""
    interior: np.ndarray | None = None
    """(F,) bool, faces that a cut made; None where nothing is known of them."""


@dataclasses.dataclass(frozen=True)
class Destructible:
    """An asset and the mesh of each of its chunks."""

    asset: Asset
    """The asset."""
    meshes: tuple[Mesh, ...]
    """One for each of the asset's C chunks, parents included, in the asset's order."""
