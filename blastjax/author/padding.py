"""Bringing different assets to one capacity, so that one batch can hold them all.

Padding is dead matter: chunks without volume that nothing owns, nodes without a chunk,
bonds that join node 0 to itself.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from blastjax.author.asset import with_sweep
from blastjax.core import NO_PARENT, NO_WORLD, NONE, Asset


@dataclasses.dataclass(frozen=True)
class Capacity:
    """How much of everything an asset has room for, and which code it needs."""

    chunks: int
    nodes: int
    """The world included."""
    sub_chunks: int
    """Chunks below the support level."""
    bonds: int
    has_world: bool = False
    depth: int = 0
    height: int = 0


def capacity(*assets: Asset) -> Capacity:
    """Return the least capacity that holds every one of the assets.

    Raises:
      ValueError: there are no assets.
    """
    if not assets:
        raise ValueError("there are no assets; give at least one")
    has_world = any(a.has_world for a in assets)
    # An asset that the world does not hold gets a world of its own, bonded to nothing.
    nodes = [a.span_node.shape[0] + (has_world - a.has_world) for a in assets]
    subs = [a.element_chunk.shape[0] - a.span_node.shape[0] for a in assets]
    return Capacity(
        chunks=max(a.chunk_parent.shape[0] for a in assets),
        nodes=max(nodes),
        sub_chunks=max(subs),
        bonds=max(a.bond_nodes.shape[0] for a in assets),
        has_world=has_world,
        depth=max(a.depth for a in assets),
        height=max(a.height for a in assets),
    )


def pad(asset: Asset, to: Capacity) -> Asset:
    """Return the asset with room to this capacity.

    Nodes keep their numbers, except that all move up by one if the asset gains a world;
    sub-support chunks keep their order behind the last node.

    Raises:
      ValueError: the asset does not fit.
    """
    own = capacity(asset)
    for field in dataclasses.fields(Capacity):
        name = field.name
        need, room = getattr(own, name), getattr(to, name)
        need += name == "nodes" and to.has_world and not asset.has_world
        if need > room:
            raise ValueError(
                f"the asset needs {name}={need}, the capacity has {room}; enlarge it"
            )
        if room < 1 and name in ("chunks", "nodes"):
            raise ValueError(f"the capacity has {name}={room}; it must be 1 or more")

    host: Any = jax.tree.map(np.asarray, asset)
    shift = int(to.has_world and not host.has_world)
    old_nodes, old_elements = len(host.span_node), len(host.element_chunk)
    # Where each old element goes.
    place = np.concatenate(
        [
            np.arange(old_nodes) + shift,
            np.arange(old_elements - old_nodes) + to.nodes,
        ]
    ).astype(np.int32)
    elements = to.nodes + to.sub_chunks

    def renamed(x: np.ndarray) -> np.ndarray:
        return np.where(x < 0, x, place[x]) if len(place) else x

    def grown(x: np.ndarray, size: int, fill: float = 0) -> jax.Array:
        rest = np.full((size - len(x), *x.shape[1:]), fill, x.dtype)
        return jnp.asarray(np.concatenate([x, rest]))

    def moved(x: np.ndarray, first: int = NONE) -> jax.Array:
        rows = np.full(elements, NONE, x.dtype)
        rows[0] = first
        rows[place] = x
        return jnp.asarray(rows)

    in_spans = host.span_node[: old_nodes - host.has_world] + shift
    others = np.setdiff1d(np.arange(to.nodes), in_spans)
    span_node = np.concatenate([in_spans, others]).astype(np.int32)
    padded = Asset(
        chunk_parent=grown(host.chunk_parent, to.chunks, NO_PARENT),
        chunk_children=grown(host.chunk_children, to.chunks),
        chunk_centroid=grown(host.chunk_centroid, to.chunks),
        chunk_volume=grown(host.chunk_volume, to.chunks),
        chunk_inertia=grown(host.chunk_inertia, to.chunks),
        chunk_size=grown(host.chunk_size, to.chunks),
        chunk_element=grown(renamed(host.chunk_element), to.chunks, NONE),
        chunk_span=grown(host.chunk_span, to.chunks),
        span_node=jnp.asarray(span_node),
        element_chunk=moved(host.element_chunk, NO_WORLD if shift else NONE),
        element_parent=moved(renamed(host.element_parent)),
        bond_nodes=grown(host.bond_nodes + np.int32(shift), to.bonds),
        bond_normal=grown(host.bond_normal, to.bonds),
        bond_centroid=grown(host.bond_centroid, to.bonds),
        bond_area=grown(host.bond_area, to.bonds),
        has_world=to.has_world,
        depth=to.depth,
        height=to.height,
    )
    return with_sweep(padded)


def stack(assets: Sequence[Asset], to: Capacity | None = None) -> Asset:
    """Return one asset with a leading batch axis, each padded to a common capacity.

    Args:
      assets: the assets.
      to: the capacity; None takes the least that holds them all.

    Raises:
      ValueError: there are no assets, or one does not fit.
    """
    to = to or capacity(*assets)
    return jax.tree.map(lambda *x: jnp.stack(x), *[pad(a, to) for a in assets])
