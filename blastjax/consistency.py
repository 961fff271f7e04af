"""Whether an asset, a state and meshes can be what they say, checked on the host.

For data that did not come from `author.build` in this process: a file, mostly. JAX
clamps an index out of range where numpy would raise, so whatever passes here must hold
together completely. Sizes as in `core`.
"""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from blastjax import lanes
from blastjax.author.descriptions import (
    Bonds,
    Chunks,
    checked_bonds,
    checked_chunks,
    refuse,
)
from blastjax.author.descriptions import depths as chunk_depths
from blastjax.author.mesh import Mesh
from blastjax.core import NO_WORLD, NONE, WORLD, Asset, State

_ASSET_SHAPES: dict[str, tuple[str | int, ...]] = {
    "chunk_parent": ("C",),
    "chunk_children": ("C",),
    "chunk_centroid": ("C", 3),
    "chunk_volume": ("C",),
    "chunk_inertia": ("C", 3, 3),
    "chunk_size": ("C", 3),
    "chunk_element": ("C",),
    "chunk_span": ("C", 2),
    "span_node": ("N",),
    "element_chunk": ("A",),
    "element_parent": ("A",),
    "bond_nodes": ("B", 2),
    "bond_normal": ("B", 3),
    "bond_centroid": ("B", 3),
    "bond_area": ("B",),
}
_STATE_SHAPES: dict[str, tuple[str | int, ...]] = {
    "bond_health": ("B",),
    "bond_intact": ("B",),
    "chunk_health": ("A",),
    "actor": ("A",),
    "dirty": ("N",),
    "bond_unbreakable": ("B",),
    "chunk_unbreakable": ("A",),
}
_INTEGERS = (
    *("chunk_parent", "chunk_children", "chunk_element", "chunk_span", "span_node"),
    *("element_chunk", "element_parent", "bond_nodes", "actor"),
)
_FLAGS = ("bond_intact", "dirty", "bond_unbreakable", "chunk_unbreakable")


def refuse_asset(asset: Asset) -> None:
    """Raise ValueError unless the asset, padding included, holds together.

    Raises:
      ValueError: naming the first offender, its value and what it should be.
    """
    host, sizes = _shaped(asset, _ASSET_SHAPES)
    if sizes["C"] < 1 or not 1 <= sizes["N"] <= sizes["A"]:
        raise ValueError(
            f"an asset of {sizes['C']} chunks, {sizes['N']} nodes and {sizes['A']} "
            "elements: it needs a chunk, a node, and an element for each node"
        )
    for name in ("depth", "height"):
        value = getattr(asset, name)
        if not 0 <= value <= sizes["C"]:
            raise ValueError(
                f"the asset's {name} is {value}; it has {sizes['C']} chunks"
            )
    _refuse_elements(asset, host, sizes)
    on_node = host["chunk_element"]
    on_node = (on_node != NONE) & (on_node < sizes["N"])
    checked_chunks(
        Chunks(
            host["chunk_parent"],
            host["chunk_centroid"],
            host["chunk_volume"],
            on_node,
            host["chunk_size"],
            host["chunk_inertia"],
        )
    )
    children = np.zeros(sizes["C"], int)
    parent = host["chunk_parent"]
    np.add.at(children, parent[parent >= 0], 1)
    _refuse_other("chunk_children", host["chunk_children"], children)
    _refuse_hierarchy(asset, host, sizes)
    _refuse_spans(host, sizes)
    _refuse_bonds(host, sizes)
    _refuse_stale(asset)


def _refuse_stale(asset: Asset) -> None:
    """The sweep, if there is one, leads through these bonds, in whatever order."""
    if asset.sweep is None:
        return
    found, nodes = np.asarray(asset.sweep), len(asset.span_node)
    wanted = lanes.order(np.asarray(asset.bond_nodes), nodes)
    if wanted is not None and found.shape == wanted.shape:
        # An order by the turns of a way is that way again.
        turn = np.asarray(lanes.unpack(asset.sweep, nodes, len(asset.bond_nodes)).turn)
        wanted = lanes.order(np.asarray(asset.bond_nodes), nodes, turn)
    if wanted is None or not np.array_equal(found, wanted):
        raise ValueError(
            "the asset's sweep is of other bonds; put None in its place where bonds or "
            "nodes are changed"
        )


def refuse_state(state: State, asset: Asset | None = None) -> None:
    """Raise ValueError unless the state holds together, and belongs to the asset.

    Args:
      state: the state.
      asset: its asset, consistent itself; None leaves out what needs it.

    Raises:
      ValueError: naming the first offender, its value and what it should be.
    """
    wanted = None
    if asset is not None:
        wanted = {
            "B": len(asset.bond_nodes),
            "A": len(asset.element_chunk),
            "N": len(asset.span_node),
        }
    host, sizes = _shaped(state, _STATE_SHAPES, wanted)
    if sizes["N"] > sizes["A"]:
        raise ValueError(f"a state of {sizes['N']} nodes in {sizes['A']} elements")
    for name in ("bond_health", "chunk_health"):
        nan = np.isnan(host[name])
        refuse(nan, host[name], name + "[{i}] is {v}; a health is a number")
    actor = host["actor"]
    _refuse_range("actor", actor, NONE, sizes["A"])
    owned = actor != NONE
    label = np.where(owned, actor, np.arange(len(actor)))
    wrong = owned & ((label > np.arange(len(actor))) | (actor[label] != actor))
    refuse(wrong, actor, "actor[{i}] is {v}, which is not the smallest element of one")
    if asset is not None:
        chunk = np.asarray(asset.element_chunk)
        matter = (chunk >= 0) | ((chunk == WORLD) & (np.arange(len(chunk)) == 0))
        matter[0] &= chunk[0] >= 0 or asset.has_world
        refuse(owned & ~matter, actor, "actor[{i}] is {v}, but no chunk is there")
        nodes = np.asarray(asset.bond_nodes)
        padding = nodes[:, 0] == nodes[:, 1]
        joined = padding & host["bond_intact"]
        refuse(joined, nodes, "bond_intact[{i}] is True, but that bond {v} is padding")


def refuse_meshes(meshes: Sequence[Mesh], chunks: int | None = None) -> None:
    """Raise ValueError unless these are the meshes of so many chunks.

    Raises:
      ValueError: naming the first offender, its value and what it should be.
    """
    if chunks is not None and len(meshes) != chunks:
        raise ValueError(f"there are {len(meshes)} meshes for {chunks} chunks")
    for i, mesh in enumerate(meshes):
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
        for name, array, kinds in (("vertices", vertices, "f"), ("faces", faces, "iu")):
            if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in kinds:
                raise ValueError(
                    f"mesh {i} has {name} of shape {array.shape} and type "
                    f"{array.dtype}; they have three columns"
                )
        bad = ~np.isfinite(vertices).all(axis=1)
        refuse(bad, vertices, f"mesh {i}: vertex {{i}} is {{v}}; it must be finite")
        bad = np.any((faces < 0) | (faces >= len(vertices)), axis=1)
        refuse(
            bad,
            faces,
            f"mesh {i}: face {{i}} is {{v}}; there are {len(vertices)} vertices",
        )
        if mesh.interior is not None:
            inner = np.asarray(mesh.interior)
            if inner.shape != (len(faces),) or inner.dtype != bool:
                raise ValueError(
                    f"mesh {i} has interior of shape {inner.shape} and type "
                    f"{inner.dtype}; give a flag for each of {len(faces)} faces"
                )


def _shaped(
    part: Any,
    shapes: dict[str, tuple[str | int, ...]],
    sizes: dict[str, int] | None = None,
) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Return the arrays of an asset or a state and its sizes, if they fit together."""
    sizes = dict(sizes or {})
    host: dict[str, np.ndarray] = {}
    kind = type(part).__name__.lower()
    for name, letters in shapes.items():
        value = getattr(part, name)
        if value is None:
            continue
        if isinstance(value, jax.core.Tracer):
            raise ValueError(f"{kind}.{name} is traced; do this outside of jit")
        array = host[name] = np.asarray(value)
        if array.ndim != len(letters):
            raise ValueError(
                f"{kind}.{name} has shape {array.shape}; it has {len(letters)} axes: "
                "of a batch, take one"
            )
        for letter, length in zip(letters, array.shape, strict=True):
            if isinstance(letter, int):
                size = letter
            else:
                size = sizes.setdefault(letter, length)
            if length != size:
                raise ValueError(
                    f"{kind}.{name} has shape {array.shape}; its axis {letter} must "
                    f"have length {size}"
                )
        wanted = "iu" if name in _INTEGERS else "f"
        wanted = "b" if name in _FLAGS else wanted
        if array.dtype.kind not in wanted:
            raise ValueError(f"{kind}.{name} has type {array.dtype}")
    return host, sizes


def _refuse_range(name: str, values: np.ndarray, least: int, end: int) -> None:
    out = (values < least) | (values >= end)
    bad = np.any(out.reshape(len(out), -1), axis=1)
    refuse(bad, values, f"{name}[{{i}}] is {{v}}; it must lie in {least}..{end - 1}")


def _refuse_other(name: str, values: np.ndarray, wanted: np.ndarray) -> None:
    bad = values != wanted
    if bad.any():
        i = int(np.argmax(bad))
        raise ValueError(f"{name}[{i}] is {values[i]}; it must be {wanted[i]}")


def _refuse_elements(
    asset: Asset, host: dict[str, np.ndarray], sizes: dict[str, int]
) -> None:
    """Chunks and elements name each other, and node 0 alone may be the world."""
    chunk, element = host["element_chunk"], host["chunk_element"]
    _refuse_range("chunk_parent", host["chunk_parent"], NONE, sizes["C"])
    _refuse_range("element_chunk", chunk, NO_WORLD, sizes["C"])
    _refuse_range("chunk_element", element, NONE, sizes["A"])
    if asset.has_world and chunk[0] not in (WORLD, NO_WORLD):
        raise ValueError(f"element_chunk[0] is {chunk[0]}; it must be the world")
    none = chunk == NO_WORLD
    none[0] &= not asset.has_world
    refuse(none, chunk, "element_chunk[{i}] is {v}; only node 0 can be the world")
    real = np.flatnonzero(chunk >= 0)
    mutual = np.full(sizes["C"], NONE)
    mutual[chunk[real]] = real
    _refuse_other("chunk_element", element, mutual)
    twice = np.zeros(sizes["A"], bool)
    twice[real] = element[chunk[real]] != real
    refuse(twice, chunk, "element_chunk[{i}] is {v}, as is another's")


def _refuse_hierarchy(
    asset: Asset, host: dict[str, np.ndarray], sizes: dict[str, int]
) -> None:
    """One support chunk on every way to a root; sub-support chunks name theirs."""
    parent, element = host["chunk_parent"], host["chunk_element"]
    nodes, dead = sizes["N"], _dead_chunks(host)
    parent_element = np.where(parent >= 0, element[parent], NONE)
    below = element >= nodes
    bad = below & (parent_element == NONE)
    refuse(bad, parent, "chunk {i} is below support, but its parent {v} is above it")
    bad = ~below & (parent_element != NONE)
    refuse(bad, parent, "chunk {i} is below the support level, but is no such element")
    leaf = (host["chunk_children"] == 0) & (element == NONE) & ~dead
    refuse(leaf, parent, "chunk {i} (parent {v}) has no support chunk over or under it")
    chunk = host["element_chunk"]
    sub = (np.arange(sizes["A"]) >= nodes) & (chunk >= 0)
    wanted = np.where(sub, parent_element[np.maximum(chunk, 0)], NONE)
    _refuse_other("element_parent", host["element_parent"], wanted)

    depth = chunk_depths(parent)
    on_node = (element != NONE) & (element < nodes)
    height = int(depth[on_node].max(initial=0))
    steps, above = np.where(below, 1, 0), parent_element
    while (above >= nodes).any():
        steps += above >= nodes
        above = np.where(above >= nodes, host["element_parent"][above], above)
    for name, least in (("height", height), ("depth", int(steps.max(initial=0)))):
        if getattr(asset, name) < least:
            raise ValueError(f"the asset's {name} is below {least}, that of its chunks")


def _dead_chunks(host: dict[str, np.ndarray]) -> np.ndarray:
    """Return the chunks of padding, (C,) bool: roots that own and weigh nothing."""
    weightless = (host["chunk_volume"] == 0) & (host["chunk_element"] == NONE)
    alone = (host["chunk_parent"] == NONE) & (host["chunk_children"] == 0)
    return weightless & alone


def _refuse_spans(host: dict[str, np.ndarray], sizes: dict[str, int]) -> None:
    """The span of a chunk at or above the support level is its support chunks."""
    order, span = host["span_node"], host["chunk_span"]
    if not (np.sort(order) == np.arange(sizes["N"])).all():
        raise ValueError("span_node does not hold each node once")
    _refuse_range("chunk_span", span, 0, sizes["N"] + 1)
    refuse(span[:, 0] > span[:, 1], span, "chunk_span[{i}] is {v}; it ends before it")
    place = np.zeros(sizes["N"], int)
    place[order] = np.arange(sizes["N"])
    nodes = np.flatnonzero(host["element_chunk"][: sizes["N"]] >= 0)
    at, spot = host["element_chunk"][nodes], place[nodes]
    inside = np.zeros(sizes["C"], int)
    while len(at):
        out = (spot < span[at, 0]) | (spot >= span[at, 1])
        refuse(out, at, "chunk_span of chunk {v} misses a support chunk of its own")
        np.add.at(inside, at, 1)
        at = host["chunk_parent"][at]
        at, spot = at[at >= 0], spot[at >= 0]
    size = span[:, 1] - span[:, 0]
    refuse(size != inside, span, "chunk_span[{i}] is {v}; it holds foreign chunks")


def _refuse_bonds(host: dict[str, np.ndarray], sizes: dict[str, int]) -> None:
    """Bonds join two different nodes in order, or are padding and join one to itself.

    The world is the last of a pair.
    """
    nodes = host["bond_nodes"]
    _refuse_range("bond_nodes", nodes, 0, sizes["N"])
    checked_bonds(
        Bonds(nodes, host["bond_normal"], host["bond_area"], host["bond_centroid"])
    )
    chunk = host["element_chunk"]
    real = nodes[:, 0] != nodes[:, 1]
    world = chunk[nodes] == WORLD
    matter = (chunk[nodes] >= 0) | (world & (nodes == 0))
    refuse(real & ~matter.all(axis=1), nodes, "bond {i} joins {v}: no chunk is there")
    ordered = np.where(world[:, 1], True, nodes[:, 0] < nodes[:, 1]) & ~world[:, 0]
    refuse(
        real & ~ordered, nodes, "bond {i} joins {v}; the lower is first, the world last"
    )
