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


def moments(mesh: Mesh) -> tuple[float, np.ndarray, np.ndarray]:
    """Return volume (m^3), centroid (3,) and inertia (3, 3) of a closed mesh.

    The inertia is about the centroid at unit density, m^5: exact sums over the
    tetrahedra between the faces and one point of the mesh.
    """
    origin = mesh.vertices.mean(axis=0)
    # Relative to the mesh itself: far from the rest frame's origin digits would go.
    corners = (mesh.vertices - origin)[mesh.faces]
    signed = np.einsum(
        "fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])
    )
    signed = signed / 6
    volume = float(signed.sum())
    total = corners.sum(axis=1)
    if volume == 0:
        return 0.0, origin, np.zeros((3, 3))
    center = signed @ total / 4 / volume
    # Second moments of a tetrahedron with one corner at the origin.
    square = np.einsum("fki,fkj->fij", corners, corners) + np.einsum(
        "fi,fj->fij", total, total
    )
    second = np.einsum("f,fij->ij", signed, square) / 20
    second = second - volume * np.outer(center, center)
    inertia = np.trace(second) * np.eye(3) - second
    return volume, origin + center, inertia
