"""Levels of an asset's hierarchy: coarser ones added above, finer ones cut away."""

import dataclasses
from typing import Any

import numpy as np

from blastjax.author import cluster
from blastjax.author.assembly import (
    Result,
    Whole,
    asset_of,
    describe,
    own_meshes,
    rebuilt,
    together,
)
from blastjax.author.descriptions import Bonds, Chunks, depths, integers, refuse
from blastjax.author.hierarchy import below_support, subtree_any
from blastjax.author.mesh import Mesh
from blastjax.core import NO_PARENT, NONE, WORLD


def unite(whole: Whole, size: int = 8, *, levels: int | None = None) -> Result:
    """Unite chunks into coarser ones, level upon level.

    The roots are grouped into connected clusters of about equal number, which prefer
    neighbours with much shared area; each becomes the child of a new chunk, and so on.
    What no bond connects is never united. The support level stays.

    Args:
      whole: an asset, with or without meshes. The mesh of a new chunk is those of its
        children together.
      size: chunks in a cluster, 2 or more.
      levels: how many to add; None goes on until nothing is left to unite.

    Raises:
      ValueError: the size is below 2, or levels below 1.
    """
    if size < 2 or (levels is not None and levels < 1):
        raise ValueError(f"size {size}, levels {levels}; at least 2 and 1")
    chunks, bonds = describe(asset_of(whole))
    meshes = list(own_meshes(whole))
    count = len(chunks.parent)
    while levels is None or levels > 0:
        roots = np.flatnonzero(chunks.parent < 0)
        group = cluster.grow(
            chunks.centroid[roots], *_links(chunks, bonds, roots), size
        )
        number = int(group.max()) + 1
        if number == len(roots):
            break
        start = len(chunks.parent)
        # A cluster of one stays a root: a chunk of one child would say nothing.
        several = np.bincount(group)[group] > 1
        names = np.full(number, NONE)
        used = np.unique(group[several])
        names[used] = start + np.arange(len(used))
        parent = chunks.parent.copy()
        parent[roots[several]] = names[group[several]]
        chunks = dataclasses.replace(chunks, parent=parent)
        for name in names[used]:
            members = np.flatnonzero(parent == name)
            chunks = together(chunks, _sum(chunks, members))
            if meshes:
                meshes.append(join([meshes[i] for i in members]))
        levels = None if levels is None else levels - 1
    result = rebuilt(whole, chunks, bonds, meshes)
    return dataclasses.replace(result, chunk_map=result.chunk_map[:count])


def delete(whole: Whole, chunks: Any, *, itself: bool = False) -> Result:
    """Delete what is below chunks, or the chunks with all that is below them.

    Without the descendants a chunk is a leaf; if support chunks were among them it
    becomes one, with all their bonds to others: those of a pair are summed up, and the
    first of them stands for them in the map. With the chunk itself its matter goes; the
    chunks above are what their other children make up, or go with it.

    Args:
      whole: an asset, with or without meshes.
      chunks: (k,) int.
      itself: delete the chunks too.

    Raises:
      ValueError: a chunk does not exist, or nothing would be left.
    """
    old, bonds = describe(asset_of(whole))
    listed = integers("chunks", chunks)
    count = len(old.parent)
    bad = (listed < 0) | (listed >= count)
    refuse(bad, listed, f"chunk [{{i}}] is {{v}}; there are {count}")
    flag = np.zeros(count, bool)
    flag[listed] = True
    under = below_support(old.parent, flag)
    gone = under | flag if itself else under
    support = old.support.copy()
    meshes = list(own_meshes(whole))
    if itself:
        old, meshes, gone = _without(old, meshes, gone)
    else:
        support |= flag & ~under & subtree_any(old.parent, support & gone)
        bonds = _lifted(old.parent, bonds, gone)
    if gone.all():
        raise ValueError("nothing would be left of the asset")
    name = np.full(count, NONE)
    name[~gone] = np.arange((~gone).sum())
    kept = Chunks(
        **{
            f.name: getattr(old, f.name)[~gone]
            for f in dataclasses.fields(Chunks)
            if f.name not in ("parent", "support")
        },
        parent=np.where(old.parent < 0, NO_PARENT, name[old.parent])[~gone],
        support=support[~gone],
    )
    ends = np.where(bonds.chunks == WORLD, WORLD, name[bonds.chunks])
    stay = ((ends != NONE) | (bonds.chunks == WORLD)).all(axis=1)
    stay &= ends[:, 0] != ends[:, 1]
    rows, first = cluster.merge_pairs(_rows(bonds, stay, ends))
    result = rebuilt(
        whole, kept, rows, [m for m, g in zip(meshes, gone, strict=False) if not g]
    )
    bond_map = np.full(len(bonds.chunks), NONE)
    bond_map[np.flatnonzero(stay)[first]] = result.bond_map
    chunk_map = np.where(gone, NONE, result.chunk_map[name])
    return dataclasses.replace(result, chunk_map=chunk_map, bond_map=bond_map)


def _links(
    chunks: Chunks, bonds: Bonds, roots: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return which roots are bonded, by their place in the row, and over what area."""
    top = np.arange(len(chunks.parent))
    while (chunks.parent[top] >= 0).any():
        top = np.where(chunks.parent[top] >= 0, chunks.parent[top], top)
    place = np.full(len(chunks.parent), NONE)
    place[roots] = np.arange(len(roots))
    inner = (bonds.chunks != WORLD).all(axis=1)
    ends = np.sort(place[top[bonds.chunks[inner]]], axis=1)
    apart = ends[:, 0] != ends[:, 1]
    pairs, row = np.unique(ends[apart], axis=0, return_inverse=True)
    area = np.bincount(row.reshape(-1), bonds.area[inner][apart], len(pairs))
    return pairs, area


def _sum(chunks: Chunks, members: np.ndarray) -> Chunks:
    """Describe what chunks make up together, one row."""
    volume, place = chunks.volume[members], chunks.centroid[members]
    weight = volume if volume.any() else np.ones(len(members))
    center = weight @ place / weight.sum()
    arm = place - center
    square = (arm**2).sum(axis=1)[:, None, None] * np.eye(3)
    steiner = square - arm[:, :, None] * arm[:, None, :]
    inertia = (chunks.inertia[members] + volume[:, None, None] * steiner).sum(axis=0)
    size = chunks.size[members]
    low, high = (place - size).min(axis=0), (place + size).max(axis=0)
    return Chunks(
        np.array([NO_PARENT]),
        center[None],
        np.array([volume.sum()]),
        np.zeros(1, bool),
        (high - low)[None] / 2,
        inertia[None],
    )


def join(meshes: list[Mesh]) -> Mesh:
    """Return closed meshes as one."""
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    known = all(m.interior is not None for m in meshes)
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=True)]),
        np.concatenate([m.interior for m in meshes]) if known else None,
    )


def _without(
    chunks: Chunks, meshes: list[Mesh], gone: np.ndarray
) -> tuple[Chunks, list[Mesh], np.ndarray]:
    """Return chunks and meshes less the matter of those gone, and all that are gone."""
    chunks = dataclasses.replace(
        chunks,
        **{
            f: getattr(chunks, f).copy()
            for f in ("centroid", "volume", "size", "inertia")
        },
    )
    gone, meshes, depth = gone.copy(), list(meshes), depths(chunks.parent)
    touched = np.flatnonzero(subtree_any(chunks.parent, gone) & ~gone)
    for i in touched[np.argsort(-depth[touched], kind="stable")]:
        members = np.flatnonzero((chunks.parent == i) & ~gone)
        if not len(members):
            gone[i] = True
            continue
        rest = _sum(chunks, members)
        for name in ("centroid", "volume", "size", "inertia"):
            getattr(chunks, name)[i] = getattr(rest, name)[0]
        if meshes:
            meshes[i] = join([meshes[m] for m in members])
    return chunks, meshes, gone


def _lifted(parent: np.ndarray, bonds: Bonds, gone: np.ndarray) -> Bonds:
    """Return bonds whose ends are the chunks that stand for those gone."""
    stands = np.arange(len(parent))
    while gone[stands].any():
        stands = np.where(gone[stands], parent[stands], stands)
    ends = np.where(bonds.chunks == WORLD, WORLD, stands[bonds.chunks])
    return dataclasses.replace(bonds, chunks=ends)


def _rows(bonds: Bonds, stay: np.ndarray, ends: np.ndarray) -> Bonds:
    return Bonds(ends[stay], bonds.normal[stay], bonds.area[stay], bonds.centroid[stay])
