"""Which hull every geom has, and the meshes that are drawn. Host only."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import mujoco
import numpy as np

from blastjax.author import hulls as author
from blastjax.author.hulls import Hulls
from blastjax.author.mesh import Mesh
from blastjax.core import Asset
from blastjax.rigid import engine
from blastjax.rigid.hull import Table

_USER_VERTICES = 32
"""Most vertices of the hull of a mesh in the user's model."""


def of_geoms(
    model: mujoco.MjModel, geom_element: np.ndarray, asset: Asset, hulls: Hulls
) -> tuple[Table, np.ndarray]:
    """Return the hulls of all geoms that meet chunks, and each geom's reach (G,) m.

    A box and a mesh of the user's model become hulls too.

    Raises:
      ValueError: a height field can meet chunks; there is no collider for it.
    """
    solids = [_row(hulls, i) for i in range(len(hulls.chunk))]
    row, reach = np.zeros(model.ngeom, np.int32), model.geom_rbound.copy()
    chunk = np.asarray(asset.element_chunk)
    taken: dict[int, int] = {}
    for geom, element in enumerate(geom_element):
        if element < 0:
            continue
        c = int(chunk[element])
        row[geom] = np.flatnonzero(hulls.chunk == c)[taken.get(element, 0)]
        taken[element] = taken.get(element, 0) + 1
        reach[geom] = np.linalg.norm(hulls.vertices[row[geom]], axis=1).max()
    pairs = engine.geom_pairs(model)
    met = pairs[(geom_element[pairs] >= 0).any(axis=1)]
    for geom in np.unique(met[geom_element[met] < 0]):
        kind = model.geom_type[geom]
        if kind == mujoco.mjtGeom.mjGEOM_HFIELD:
            raise ValueError(
                f"geom {geom} is a height field, which hulls cannot meet; use "
                "collision='box' or take chunks out of its conaffinity"
            )
        if kind in (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_MESH):
            row[geom] = len(solids)
            solids.append(author.hull(_points(model, geom), _USER_VERTICES))
    padded = author.pad(solids, [0] * len(solids))
    fields = {
        name: getattr(padded, name)
        for name in (f.name for f in dataclasses.fields(Table))
        if name != "row"
    }
    return Table(**fields, row=jnp.asarray(row)), reach


def solids(
    asset: Asset,
    elements: np.ndarray,
    meshes: Sequence[Mesh] | None,
    hulls: Hulls | None,
) -> dict[str, Mesh]:
    """Return what is drawn for each chunk geom, by its name, about its centroid.

    A chunk's own mesh where one geom stands for it, else the hulls.
    """
    chunk = np.asarray(asset.element_chunk)
    center = np.asarray(asset.chunk_centroid, dtype=float)
    found = {}
    for element in elements:
        c = int(chunk[element])
        own = np.zeros(0, int) if hulls is None else hulls.chunk
        rows = np.flatnonzero(own == c)
        if meshes is not None and len(rows) < 2:
            mesh = meshes[c]
            moved = dataclasses.replace(mesh, vertices=mesh.vertices - center[c])
            found[f"chunk{element}"] = moved
            continue
        for i, row in enumerate(rows):
            assert hulls is not None
            name = f"chunk{element}" + (f".{i}" if i else "")
            found[name] = author.unpad(hulls, int(row))
    return found


def with_meshes(spec: mujoco.MjSpec, solids: dict[str, Mesh]) -> mujoco.MjModel:
    """Compile a copy of the model in which the named geoms are meshes."""
    spec = spec.copy()
    for geom in list(spec.geoms):
        if geom.name in solids:
            mesh = solids[geom.name]
            made = spec.add_mesh(
                name=f"mesh of {geom.name}",
                uservert=np.asarray(mesh.vertices, dtype=float).reshape(-1),
                userface=np.asarray(mesh.faces, dtype=np.int32).reshape(-1),
            )
            # Nothing is weighed by it, so thin and tiny pieces may pass.
            made.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            geom.type = mujoco.mjtGeom.mjGEOM_MESH
            geom.meshname = made.name
    return spec.compile()


def _row(hulls: Hulls, row: int) -> author.Hull:
    """Return one hull of a table."""
    loops = [
        [int(i) for i in loop[:size]]
        for loop, size in zip(hulls.corners[row], hulls.size[row], strict=True)
    ]
    return author.Hull(
        hulls.vertices[row],
        hulls.normal[row],
        hulls.offset[row],
        loops,
        hulls.edges[row],
        hulls.sides[row],
        float(hulls.volume[row]),
    )


def _points(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return points (n, 3) that span a box or a mesh, in the geom's frame."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        return signs * model.geom_size[geom]
    mesh = model.geom_dataid[geom]
    start = model.mesh_vertadr[mesh]
    return model.mesh_vert[start : start + model.mesh_vertnum[mesh]].astype(float)
