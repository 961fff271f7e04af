"""Building an asset from descriptions."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from blastjax import lanes
from blastjax.author.descriptions import (
    Bonds,
    Chunks,
    checked_bonds,
    checked_chunks,
    depths,
    refuse_invalid_bonds,
)
from blastjax.author.hierarchy import (
    below_support,
    ensure_coverage,
    refuse_inexact,
    refuse_invalid_order,
    reorder,
    reorder_map,
)
from blastjax.core import NONE, WORLD, Asset


@dataclasses.dataclass(frozen=True)
class Built:
    """An asset and how its parts correspond to the descriptions. Host arrays."""

    asset: Asset
    chunk_map: np.ndarray
    """(described chunks,) the asset's chunk made of each: meshes need it."""
    bond_map: np.ndarray
    """(described bonds,) the asset's bond made of each, NONE if it was dropped."""
    support: np.ndarray
    """(described chunks,) bool, the support flags after repair."""
    coverage_exact: bool
    """Whether the support flags needed no repair."""
    dropped: dict[str, np.ndarray]
    """Indices of dropped bond descriptions: "invalid" (an end that does not exist, or
    both ends the same), "non-support" (an end that is no support chunk), "duplicate"
    (the pair has a bond already)."""


def build(
    chunks: Chunks,
    bonds: Bonds | None = None,
    *,
    strict: bool = False,
    drop_invalid_bonds: bool = False,
    orient_normals: bool = True,
    dtype: Any = None,
) -> Built:
    """Build an asset from descriptions in any order.

    Support flags are repaired to exact coverage and chunks put in order. Bonds keep the
    order of their nodes; a bond to a chunk that is no support chunk, and the second
    bond of a pair, are dropped and reported. The first bond to the world adds the world
    as node 0.

    Args:
      chunks: the chunks.
      bonds: the bonds between them and to the world.
      strict: refuse inexact coverage and invalid order instead of mending them, as
        Blast's asset creation does.
      drop_invalid_bonds: drop and report bonds whose ends do not exist or are the same,
        as Blast does, instead of refusing them.
      orient_normals: take normals to point from the first described chunk to the second
        and turn them to point from the asset's first node to its second; if False, they
        are copied as they are.
      dtype: of the asset's real arrays; None follows JAX's default (float32, or float64
        where x64 is enabled).

    Raises:
      ValueError: something described is invalid; it names the element and the remedy.
    """
    chunks = checked_chunks(chunks)
    bonds = checked_bonds(Bonds.none() if bonds is None else bonds)
    if not drop_invalid_bonds:
        refuse_invalid_bonds(bonds.chunks, len(chunks.parent))
    if strict:
        refuse_inexact(chunks.parent, chunks.support)
        refuse_invalid_order(chunks.parent, chunks.support)
        exact, chunk_map = True, np.arange(len(chunks.parent))
    else:
        support, exact = ensure_coverage(chunks.parent, chunks.support)
        chunks = dataclasses.replace(chunks, support=support)
        chunk_map, _ = reorder_map(chunks.parent, support)
    described_support = chunks.support
    chunks, bonds = reorder(chunks, bonds, chunk_map)

    node_chunk, has_world = _nodes(chunks, bonds)
    chunk_node = np.full(len(chunks.parent), NONE)
    chunk_node[node_chunk[has_world:]] = np.arange(has_world, len(node_chunk))
    kept, nodes, turned, dropped = _keep_bonds(bonds.chunks, chunk_node)
    bond_map = np.full(len(bonds.chunks), NONE)
    bond_map[kept] = np.arange(len(kept))
    normal = bonds.normal[kept]
    if orient_normals:
        normal = np.where(turned[:, None], -normal, normal)

    below = below_support(chunks.parent, chunks.support)
    element_chunk = np.concatenate([node_chunk, np.flatnonzero(below)])
    chunk_element = np.full(len(chunks.parent), NONE)
    real = element_chunk >= 0
    chunk_element[element_chunk[real]] = np.flatnonzero(real)
    parent_chunk = np.where(real, chunks.parent[element_chunk], NONE)
    is_sub = np.arange(len(element_chunk)) >= len(node_chunk)
    element_parent = np.where(is_sub, chunk_element[parent_chunk], NONE)

    depth = depths(chunks.parent)
    support_depth = depth[chunks.support]
    sub_depth = depth - _support_depth(chunks.parent, chunks.support, depth)
    span_node, chunk_span = _spans(chunks.parent, chunk_node, has_world)
    children = np.bincount(
        chunks.parent[chunks.parent >= 0], minlength=len(chunks.parent)
    )

    dtype = jnp.zeros(0, dtype).dtype if dtype else jnp.result_type(float)

    def real_array(x: np.ndarray) -> jax.Array:
        return jnp.asarray(np.asarray(x, dtype))

    def index_array(x: np.ndarray) -> jax.Array:
        return jnp.asarray(np.asarray(x, np.int32))

    asset = Asset(
        chunk_parent=index_array(chunks.parent),
        chunk_children=index_array(children),
        chunk_centroid=real_array(chunks.centroid),
        chunk_volume=real_array(chunks.volume),
        chunk_inertia=real_array(chunks.inertia),
        chunk_size=real_array(chunks.size),
        chunk_element=index_array(chunk_element),
        chunk_span=index_array(chunk_span),
        span_node=index_array(span_node),
        element_chunk=index_array(element_chunk),
        element_parent=index_array(element_parent),
        bond_nodes=index_array(nodes),
        bond_normal=real_array(normal),
        bond_centroid=real_array(bonds.centroid[kept]),
        bond_area=real_array(bonds.area[kept]),
        has_world=bool(has_world),
        depth=int(sub_depth[below].max(initial=0)),
        height=int(support_depth.max(initial=0)),
        sweep=_sweep(nodes, node_chunk, np.asarray(chunks.centroid, dtype)),
    )
    return Built(
        asset=asset,
        chunk_map=chunk_map,
        bond_map=bond_map,
        support=described_support,
        coverage_exact=exact,
        dropped=dropped,
    )


def with_sweep(asset: Asset) -> Asset:
    """Return the asset with the sweep of its support graph, found anew."""
    host: Any = jax.tree.map(np.asarray, asset)
    chunk = host.element_chunk[: len(host.span_node)]
    return asset.replace(sweep=_sweep(host.bond_nodes, chunk, host.chunk_centroid))


def _sweep(
    bonds: np.ndarray, node_chunk: np.ndarray, centroid: np.ndarray
) -> jax.Array | None:
    """Return the order of sweeps: along x, as the chunks of the nodes lie."""
    across = np.where(node_chunk >= 0, centroid[node_chunk, 0], 0)
    return lanes.order(bonds, len(node_chunk), across)


def _nodes(chunks: Chunks, bonds: Bonds) -> tuple[np.ndarray, int]:
    """Return the chunk of each node, and 1 if the first is the world, else 0."""
    valid = _valid(bonds.chunks, len(chunks.parent))
    # A world bond makes the world a node even if it is dropped for its other end.
    has_world = int((valid & (bonds.chunks == WORLD).any(axis=1)).any())
    support = np.flatnonzero(chunks.support)
    return np.concatenate([np.full(has_world, WORLD), support]), has_world


def _valid(pairs: np.ndarray, count: int) -> np.ndarray:
    known = ((pairs >= 0) & (pairs < count)) | (pairs == WORLD)
    return known.all(axis=1) & (pairs[:, 0] != pairs[:, 1])


def _keep_bonds(
    pairs: np.ndarray, chunk_node: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Return the kept bonds in order, their nodes, whether they turned, the dropped."""
    valid = _valid(pairs, len(chunk_node))
    index = np.flatnonzero(valid)
    world = pairs[index] == WORLD
    node = np.where(world, 0, chunk_node[np.where(world, 0, pairs[index])])
    on_support = (world | (node != NONE)).all(axis=1)
    index, world, node = index[on_support], world[on_support], node[on_support]

    # The world sorts, and stands in its pair, as the highest node.
    rank = np.where(world, len(chunk_node) + 1, node)
    turned = rank[:, 0] > rank[:, 1]
    rank, node = (np.where(turned[:, None], x[:, ::-1], x) for x in (rank, node))
    order = np.lexsort((index, rank[:, 1], rank[:, 0]))
    rank, node, index, turned = rank[order], node[order], index[order], turned[order]
    same = (rank[1:] == rank[:-1]).all(axis=1)
    duplicate = np.concatenate([np.zeros(min(len(rank), 1), bool), same])
    dropped = {
        "invalid": np.flatnonzero(~valid),
        "non-support": np.flatnonzero(valid)[~on_support],
        "duplicate": np.sort(index[duplicate]),
    }
    keep = ~duplicate
    return index[keep], node[keep], turned[keep], dropped


def _levels(depth: np.ndarray) -> list[np.ndarray]:
    """Return the chunks of each depth, roots first, each in ascending order."""
    order = np.argsort(depth, kind="stable")
    return np.split(order, np.cumsum(np.bincount(depth))[:-1])


def _support_depth(
    parent: np.ndarray, support: np.ndarray, depth: np.ndarray
) -> np.ndarray:
    """Return the depth of the support chunk at or above each chunk, 0 if none is."""
    level = np.where(support, depth, 0)
    for chunk in _levels(depth)[1:]:
        level[chunk] = np.where(support[chunk], depth[chunk], level[parent[chunk]])
    return level


def _spans(
    parent: np.ndarray, chunk_node: np.ndarray, has_world: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes in depth-first order, the world last, and each chunk's range."""
    count = np.where(chunk_node >= 0, 1, 0)
    levels = _levels(depths(parent))
    for chunk in levels[:0:-1]:
        np.add.at(count, parent[chunk], count[chunk])
    start = np.zeros(len(parent), np.int64)
    for number, chunk in enumerate(levels):
        chunk = chunk[np.argsort(parent[chunk], kind="stable")]
        above = parent[chunk]
        before = np.cumsum(count[chunk]) - count[chunk]
        # Siblings stand together: their ranges begin where the first one's does.
        first = np.searchsorted(above, above)
        start[chunk] = before - before[first]
        if number:
            start[chunk] += start[above]
    span = np.stack([start, start + count], axis=1)
    span[(chunk_node < 0) & (count == 0)] = 0
    order = np.zeros(int((chunk_node >= 0).sum()), np.int64)
    carries = chunk_node >= 0
    order[start[carries]] = chunk_node[carries]
    return np.concatenate([order, np.zeros(has_world, np.int64)]), span
