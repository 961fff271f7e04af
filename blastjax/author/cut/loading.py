"""Meshes from files and libraries, checked and repaired, as solids to cut."""

import os
from typing import Any

import numpy as np

from blastjax.author.cut import crossings, geometry
from blastjax.author.cut.tree import Tree
from blastjax.author.mesh import Mesh, moments
from blastjax.core import NO_PARENT

SMALLEST, LARGEST = 1e-5, 1e6
"""Extents, m, that the asset's float32 inertias (m^5) can hold."""
UNUSUAL = (1e-3, 1e4)
"""Extents, m, beyond which the unit is probably wrong."""
MAX_CHECKED = 300_000
"""Faces up to which a mesh is searched for faces that cross."""


def solid(
    mesh: str | os.PathLike[str] | Mesh | Any,
    *,
    scale: float = 1.0,
    repair: bool = True,
    crossing: bool = True,
) -> Tree:
    """Return a closed mesh as a tree of one piece, ready to be cut.

    Small repairs are made and stated in the tree's `warnings`: doubled vertices and
    faces, faces of no area, holes of three or four edges, faces turned inside out,
    parts that overlap.

    Args:
      mesh: a file that trimesh reads (STL, OBJ, PLY, glTF, OFF, ...), a `Mesh`, a
        trimesh object or scene, or anything with `vertices` and `faces`.
      scale: factor to metres, 0.001 for a file in millimetres.
      repair: whether to repair; if False, what would be repaired is refused.
      crossing: whether to search for faces that cross each other; meshes of more than
        MAX_CHECKED faces are not searched, which is stated.

    Raises:
      ValueError: it is no closed surface around a volume, or not in metres.
      ImportError: the geometry extra is missing.
    """
    if not np.isfinite(scale) or not scale > 0:
        raise ValueError(f"scale is {scale}; it must be a factor above 0")
    vertices, faces = _arrays(mesh)
    _refuse_malformed(vertices, faces)
    vertices = vertices * scale
    warnings: list[str] = []
    _check_size(vertices[np.unique(faces)], warnings)
    vertices, faces = _closed(vertices, faces, repair, warnings)
    body, skin = _body(vertices, faces)
    if crossing:
        body, skin = _uncrossed(body, skin, repair, warnings)
    return Tree((body,), (NO_PARENT,), skin, warnings=tuple(warnings))


def _arrays(mesh: Any) -> tuple[np.ndarray, np.ndarray]:
    if isinstance(mesh, str | os.PathLike):
        path = os.fspath(mesh)
        if not os.path.isfile(path):
            raise ValueError(f"there is no file {path}")
        trimesh = geometry.need("trimesh")
        try:
            mesh = trimesh.load(path)
        except Exception as error:
            # Each format has its own reader, and each its own errors.
            raise ValueError(f"{path} cannot be read as a mesh: {error}") from error
    if hasattr(mesh, "to_mesh"):
        mesh = mesh.to_mesh()
    if not hasattr(mesh, "vertices") or not hasattr(mesh, "faces"):
        raise ValueError(
            f"{type(mesh).__name__} is no mesh; give a file, a Mesh, or an object with "
            "vertices and faces"
        )
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)


def _refuse_malformed(vertices: np.ndarray, faces: np.ndarray) -> None:
    if not len(faces):
        raise ValueError("the mesh is empty: it has no faces")
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"vertices have shape {vertices.shape}; it must be (V, 3)")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise ValueError(
            f"faces have shape {faces.shape} and dtype {faces.dtype}; they must be "
            "triangles, (F, 3) whole numbers"
        )
    wrong = ((faces < 0) | (faces >= len(vertices))).any(axis=1)
    if wrong.any():
        i = int(np.argmax(wrong))
        raise ValueError(
            f"face {i} names vertices {faces[i].tolist()}; there are {len(vertices)}"
        )
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        i = int(np.argmax(bad))
        raise ValueError(f"vertex {i} is {vertices[i].tolist()}; it must be finite")
    if len(faces) < 4:
        raise ValueError(
            f"the mesh has {len(faces)} faces; a closed surface has at least 4"
        )


def _check_size(vertices: np.ndarray, warnings: list[str]) -> None:
    extent = geometry.extent(vertices)
    size = f"the mesh is {' x '.join(f'{x:.3g}' for x in extent)} m"
    remedy = "give `scale` if the file is not in metres"
    if not SMALLEST <= extent.max() <= LARGEST:
        raise ValueError(
            f"{size}; its longest side must lie between {SMALLEST} and {LARGEST} m: "
            + remedy
        )
    if not UNUSUAL[0] <= extent.max() <= UNUSUAL[1]:
        warnings.append(f"{size}: {remedy}")
    middle = np.abs(vertices.mean(axis=0)).max()
    if middle > 1e4 * extent.max():
        warnings.append(
            f"{size} but {middle:.3g} m from the origin: move it there, or single "
            "precision will not resolve it"
        )


def _closed(
    vertices: np.ndarray, faces: np.ndarray, repair: bool, warnings: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return a closed surface whose faces look outward."""
    trimesh = geometry.need("trimesh")
    found = trimesh.Trimesh(vertices, faces, process=False)
    found.merge_vertices(merge_tex=True, merge_norm=True)
    said: list[str] = []
    count = len(found.faces)
    found.update_faces(found.unique_faces() & found.nondegenerate_faces(height=0))
    if len(found.faces) < count:
        said.append(f"dropped {count - len(found.faces)} doubled or empty faces")
    if not len(found.faces):
        raise ValueError("all faces of the mesh are doubled or have no area")
    if not found.is_watertight:
        missing = _open_edges(found.faces)
        found.fill_holes()
        if not found.is_watertight:
            raise ValueError(
                f"the mesh is not watertight: {missing}; close it, for example with "
                "a hole-filling or remeshing tool"
            )
        said.append(f"closed holes: {missing}")
    if not found.is_winding_consistent:
        trimesh.repair.fix_normals(found, multibody=True)
        said.append("turned faces to one side")
        if not found.is_winding_consistent:
            raise ValueError("the mesh has no inside: it is a one-sided surface")
    # Shells count together: a cavity's own faces look inward.
    volume = moments(Mesh(found.vertices, found.faces))[0]
    if volume < 0:
        found.invert()
        said.append("turned the mesh inside out")
    size = geometry.extent(found.vertices)
    if abs(volume) <= 1e-12 * size.max() ** 3:
        raise ValueError(
            f"the mesh encloses no volume ({volume:.3g} m^3); it must be a solid"
        )
    if said and not repair:
        raise ValueError(
            f"the mesh needs repair ({'; '.join(said)}); mend it or allow `repair`"
        )
    warnings += [f"repaired: {each}" for each in said]
    return np.asarray(found.vertices, np.float64), np.asarray(found.faces, np.int64)


def _open_edges(faces: np.ndarray) -> str:
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, count = np.unique(edges, axis=0, return_counts=True)
    wrong = count != 2
    i = int(np.argmax(wrong))
    return (
        f"{wrong.sum()} edges have not two faces, the first between vertices "
        f"{edges[i].tolist()} has {count[i]}"
    )


def _body(vertices: np.ndarray, faces: np.ndarray) -> tuple[Any, int]:
    skin = geometry.need("manifold3d").Manifold.reserve_ids(1)
    body = geometry.body(vertices, faces, original=skin)
    if body.status().name != "NoError" or body.is_empty():
        raise ValueError(
            f"the mesh is no oriented 2-manifold ({body.status().name}): edges with "
            "more than two faces or faces turned against each other; remesh it"
        )
    return body, skin


def _uncrossed(
    body: Any, skin: int, repair: bool, warnings: list[str]
) -> tuple[Any, int]:
    """Return the body, its overlapping parts united."""
    mesh, _ = geometry.mesh(body, skin)
    if len(mesh.faces) > MAX_CHECKED:
        warnings.append(
            f"not searched for crossing faces: it has {len(mesh.faces)} faces"
        )
        return body, skin
    pairs = crossings.find(mesh)
    if not len(pairs):
        return body, skin
    said = (
        f"{len(pairs)} pairs of faces cross, the first {pairs[0].tolist()} near "
        f"{mesh.vertices[mesh.faces[pairs[0, 0]]].mean(axis=0).round(6).tolist()}"
    )
    parts = body.decompose()
    if len(parts) > 1 and min(part.volume() for part in parts) > 0 and repair:
        manifold3d = geometry.need("manifold3d")
        body = manifold3d.Manifold.batch_boolean(parts, manifold3d.OpType.Add)
        united = geometry.mesh(body, skin)[0]
        if not len(crossings.find(united)):
            warnings.append(f"repaired: united {len(parts)} overlapping parts")
            return _body(united.vertices, united.faces)
    raise ValueError(f"the mesh intersects itself: {said}; remesh it as one solid")
