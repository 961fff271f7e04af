"""Assets moved, put together, and bonded.

Every function takes an `Asset`, or a `Destructible` with its meshes, and returns the
same kind in a `Result`, with maps from the old chunks and bonds to the new ones. All go
through `author.build`, so what it refuses is refused here, and what it repairs is
reported. Padded assets are refused: pad last.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from blastjax.author import affine, solids
from blastjax.author import bonds as find
from blastjax.author.asset import Built, build
from blastjax.author.descriptions import Bonds, Chunks
from blastjax.author.mesh import Destructible, Mesh
from blastjax.core import WORLD, Asset

Whole = Asset | Destructible


@dataclasses.dataclass(frozen=True)
class Result:
    """What was made, and what became of the old. Host arrays."""

    whole: Any
    """The Asset, or the Destructible if meshes were given."""
    chunk_map: np.ndarray
    """(old chunks,) the new chunk of each, NONE if it is gone."""
    bond_map: np.ndarray
    """(old bonds,) the new bond of each, NONE if it is gone; added bonds come last."""


def describe(asset: Asset) -> tuple[Chunks, Bonds]:
    """Return the descriptions that `author.build` makes this asset of.

    Raises:
      ValueError: the asset is padded or batched.
    """
    if np.ndim(asset.chunk_parent) != 1:
        raise ValueError("the asset is a batch; take one of it")
    element = np.asarray(asset.chunk_element)
    element_chunk = np.asarray(asset.element_chunk)
    nodes = len(asset.span_node)
    matter = element_chunk >= 0
    if not matter[int(asset.has_world) :].all() or (
        asset.has_world and element_chunk[0] != WORLD
    ):
        raise ValueError("the asset is padded; assemble first, then pad")
    support = (element >= 0) & (element < nodes)
    chunks = Chunks(
        np.asarray(asset.chunk_parent),
        np.asarray(asset.chunk_centroid, float),
        np.asarray(asset.chunk_volume, float),
        support,
        np.asarray(asset.chunk_size, float),
        np.asarray(asset.chunk_inertia, float),
    )
    bonds = Bonds(
        element_chunk[np.asarray(asset.bond_nodes)],
        np.asarray(asset.bond_normal, float),
        np.asarray(asset.bond_area, float),
        np.asarray(asset.bond_centroid, float),
    )
    return chunks, bonds


def meshes_of(whole: Whole) -> tuple[Mesh, ...]:
    """Return the mesh of each chunk: its own, or the box that stands for it."""
    if isinstance(whole, Destructible):
        return whole.meshes
    center = np.asarray(whole.chunk_centroid, float)
    size = np.asarray(whole.chunk_size, float)
    return tuple(solids.box(c, s) for c, s in zip(center, size, strict=True))


def transform(whole: Whole, matrix: Any) -> Result:
    """Move, turn, scale, shear or mirror.

    Volumes, areas, normals, centres and inertias are exact for every affine map. Boxes
    that stand for chunks stay along the axes: exact where the map keeps axes on axes,
    else of the chunk's volume and the proportions of its new second moments.

    Args:
      whole: an asset, with or without meshes.
      matrix: (4, 4) affine, or (3, 3) linear; see `affine.placed`, `affine.mirrored`.

    Raises:
      ValueError: the matrix is of another shape, not affine, or singular.
    """
    chunks, bonds, meshes = _moved(whole, own_meshes(whole), matrix)
    return rebuilt(whole, chunks, bonds, meshes)


def merge(
    parts: Sequence[Whole],
    matrices: Sequence[Any] | None = None,
    *,
    bonds: Bonds | None = None,
    touching: bool = False,
    gap: float | None = None,
) -> Result:
    """Make one asset of several.

    Args:
      parts: assets, or destructibles; with meshes if all have them.
      matrices: one of `transform` for each part; None leaves them where they are.
      bonds: new ones, by the numbers that chunks have when the parts' are counted
        through, in their order: the offsets are the sums of the counts before.
      touching: add bonds between support chunks of different parts that touch.
      gap: see `bonds.between`, for `touching`.

    Returns:
      Maps over the chunks and bonds of all parts, counted through.

    Raises:
      ValueError: there are no parts, or as many matrices.
    """
    if not parts:
        raise ValueError("there are no parts to merge; give one at least")
    if matrices is not None:
        if len(matrices) != len(parts):
            raise ValueError(f"{len(matrices)} matrices for {len(parts)} parts")
    wanted = matrices or [np.eye(4)] * len(parts)
    moved = [_moved(p, meshes_of(p), m) for p, m in zip(parts, wanted, strict=True)]
    sizes = [len(chunks.parent) for chunks, _, _ in moved]
    starts = np.cumsum([0, *sizes[:-1]]).tolist()
    chunks = together(
        *(
            dataclasses.replace(c, parent=_shifted(c.parent, s))
            for (c, _, _), s in zip(moved, starts, strict=True)
        )
    )
    all_bonds = [
        dataclasses.replace(b, chunks=_shifted(b.chunks, s))
        for (_, b, _), s in zip(moved, starts, strict=True)
    ]
    meshes = [m for _, _, some in moved for m in some]
    if touching:
        node = np.flatnonzero(chunks.support)
        part = np.repeat(np.arange(len(parts)), sizes)[node]
        found = find.between([meshes[i] for i in node], gap=gap, parts=part)
        all_bonds.append(dataclasses.replace(found, chunks=node[found.chunks]))
    if bonds is not None:
        all_bonds.append(bonds)
    with_meshes = all(isinstance(p, Destructible) for p in parts)
    like = parts[0] if with_meshes else asset_of(parts[0])
    return rebuilt(like, chunks, find.together(*all_bonds), meshes)


def add_bonds(whole: Whole, *bonds: Bonds) -> Result:
    """Add bonds, between support chunks or to the world.

    Where a pair is bonded already, the bond that is there stays.

    Args:
      whole: an asset, with or without meshes.
      *bonds: by the asset's chunks; of `bonds.to_plane(meshes_of(whole), ...)`, say,
        which may name chunks other than support chunks: those are dropped.
    """
    chunks, old = describe(asset_of(whole))
    return rebuilt(whole, chunks, find.together(old, *bonds), own_meshes(whole))


def asset_of(whole: Whole) -> Asset:
    """Return the asset, whichever was given."""
    return whole.asset if isinstance(whole, Destructible) else whole


def own_meshes(whole: Whole) -> Sequence[Mesh]:
    """Return the meshes if there are any."""
    return whole.meshes if isinstance(whole, Destructible) else ()


def rebuilt(
    whole: Whole, chunks: Chunks, bonds: Bonds, meshes: Sequence[Mesh]
) -> Result:
    """Build in the kind and the floating-point type of what was given."""
    built: Built = build(chunks, bonds, dtype=asset_of(whole).chunk_volume.dtype)
    made: Whole = built.asset
    if isinstance(whole, Destructible):
        made = Destructible(built.asset, solids.in_order(built, meshes))
    return Result(made, built.chunk_map, built.bond_map)


def together(*chunks: Chunks) -> Chunks:
    """Return complete chunk descriptions, one after the other."""
    fields = [f.name for f in dataclasses.fields(Chunks)]
    return Chunks(*(np.concatenate([getattr(c, f) for c in chunks]) for f in fields))


def _moved(
    whole: Whole, meshes: Sequence[Mesh], matrix: Any
) -> tuple[Chunks, Bonds, list[Mesh]]:
    linear, shift = affine.parts(matrix)
    chunks, bonds = describe(asset_of(whole))
    return (
        affine.move_chunks(chunks, linear, shift),
        affine.move_bonds(bonds, linear, shift),
        [affine.move_mesh(m, linear, shift) for m in meshes],
    )


def _shifted(index: np.ndarray, by: int) -> np.ndarray:
    return np.where(index < 0, index, index + by)
