"""What an asset is as a structure: masses, stiffnesses, who neighbours whom.

All of this is made on the host, once. The two-level method also gets its groups of
nodes here, joined across the stiffest connections: small clusters, which its smoother
solves for together, and larger aggregates, which its coarse space moves as rigid
bodies.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from blastjax import pytree
from blastjax.core import WORLD, Asset
from blastjax.stress.loads import node_mass

TWO_LEVEL, FORCE = "two-level", "force"
MOST_CYCLES = 24
"""Independent cycles up to which the force method is the faster choice."""
MOST_AGGREGATES = 64
"""A dense coarse matrix of six times as many rows still factors well in float32."""
LEAST_AGGREGATE = 6
"""Nodes of an aggregate at least."""
CLUSTER = 8
"""Most nodes that the smoother solves for together."""


@pytree.dataclass
class Structure(pytree.Node):
    """How an asset bears load, made by `structure`; K is the degree bound."""

    mass: jax.Array
    """(N,) kg; 0 for the world and padding."""
    inertia: jax.Array
    """(N, 3, 3) about each node's centroid, kg m^2."""
    stiffness: jax.Array
    """(B,) against relative displacement, N/m."""
    bending: jax.Array
    """(B,) against relative rotation, N m/rad."""
    node_bonds: jax.Array
    """(N, K) bonds of each node, B where there are fewer."""
    node_sign: jax.Array
    """(N, K) 1 where the node is the bond's first, -1 where its second, else 0."""
    cluster: jax.Array
    """(clusters, S) nodes that the smoother takes together, N in empty places."""
    aggregate: jax.Array
    """(N,) aggregate of each node, NONE for the world and padding."""
    num_aggregates: int = pytree.static()
    """Aggregates of the two-level method."""
    num_cycles: int = pytree.static()
    """Most independent cycles that the support graph can have."""
    method: str = pytree.static()
    """"two-level" or "force"."""


def structure(
    asset: Asset,
    *,
    density: Any = 1000.0,
    modulus: Any = 1e9,
    stiffness: Any = None,
    bending: Any = None,
    method: str | None = None,
) -> Structure:
    """Prepare an asset for `solve`, on the host.

    Args:
      asset: concrete, not traced.
      density: kg/m^3, one for all or (C,).
      modulus: Young's modulus of the bonds, Pa, one for all or (B,).
      stiffness: (B,) N/m; by default modulus x area / distance of the two centroids (of
        centroid and bond, twice, for bonds to the world).
      bending: (B,) N m/rad, 0 for hinges; by default that of a square section of the
        bond's area: stiffness x area / 12.
      method: "two-level" or "force"; by default the latter for graphs of few cycles, of
        any size, without hinges.

    Raises:
      ValueError: a shape, sign or method is wrong.
    """
    host: Any = jax.tree.map(np.asarray, asset)
    pairs, num_nodes = host.bond_nodes, len(host.span_node)
    num_bonds = len(pairs)
    real = pairs[:, 0] != pairs[:, 1]
    place = np.where(
        (host.element_chunk >= 0)[:, None], host.chunk_centroid[host.element_chunk], 0.0
    )[:num_nodes]
    to_world = _is_world(asset) & (pairs[:, 1] == 0) & real
    reach = np.linalg.norm(place[pairs[:, 1]] - place[pairs[:, 0]], axis=1)
    outward = 2 * np.linalg.norm(host.bond_centroid - place[pairs[:, 0]], axis=1)
    reach = np.where(to_world, outward, reach)
    if stiffness is None:
        modulus = _column("modulus", modulus, num_bonds)
        stiffness = modulus * host.bond_area / np.where(reach > 0, reach, 1.0)
    stiffness = _column("stiffness", stiffness, num_bonds)
    if bending is None:
        bending = stiffness * host.bond_area / 12
    bending = _column("bending", bending, num_bonds)

    free = host.element_chunk[:num_nodes] >= 0
    cycles = _cycles(pairs[real], num_nodes)
    if method is None:
        # A hinge in the forest could not pass on what hangs on it.
        stiff = bool((bending[real & (stiffness > 0)] > 0).all())
        method = FORCE if cycles <= MOST_CYCLES and stiff else TWO_LEVEL
    if method not in (TWO_LEVEL, FORCE):
        raise ValueError(f"method is {method!r}; use {TWO_LEVEL!r} or {FORCE!r}")
    aggregate, cluster = np.full(num_nodes, -1), np.zeros((0, 1), int)
    if method == TWO_LEVEL:
        inner = real & ~to_world
        links = pairs[inner], stiffness[inner], free
        size = max(LEAST_AGGREGATE, -(-int(free.sum()) // MOST_AGGREGATES))
        aggregate = _grouped(*links, size)
        cluster = _members(_grouped(*links, CLUSTER), num_nodes)
    node_bonds, node_sign = _incidence(pairs, real, free, num_nodes)

    dtype = asset.chunk_centroid.dtype
    mass = node_mass(asset, density)
    weight = jnp.broadcast_to(jnp.asarray(density, dtype), asset.chunk_volume.shape)
    chunk = jnp.maximum(asset.element_chunk[:num_nodes], 0)
    inertia = (weight[:, None, None] * asset.chunk_inertia)[chunk]
    return Structure(
        mass=mass,
        inertia=jnp.where(jnp.asarray(free)[:, None, None], inertia, 0),
        stiffness=jnp.asarray(stiffness, dtype),
        bending=jnp.asarray(bending, dtype),
        node_bonds=jnp.asarray(node_bonds, jnp.int32),
        node_sign=jnp.asarray(node_sign, dtype),
        cluster=jnp.asarray(cluster, jnp.int32),
        aggregate=jnp.asarray(aggregate, jnp.int32),
        num_aggregates=int(aggregate.max(initial=-1)) + 1,
        num_cycles=cycles,
        method=method,
    )


def _is_world(asset: Asset) -> bool:
    return asset.has_world and int(asset.element_chunk[0]) == WORLD


def _column(name: str, value: Any, count: int) -> np.ndarray:
    column = np.asarray(value, float)
    if column.shape not in ((), (count,)):
        raise ValueError(f"{name} has shape {column.shape}; give one or ({count},)")
    column = np.broadcast_to(column, (count,))
    bad = np.flatnonzero(~(np.isfinite(column) & (column >= 0)))
    if bad.size:
        raise ValueError(
            f"{name} of bond {bad[0]} is {column[bad[0]]}; it must be finite, 0 or more"
        )
    return column


def _cycles(pairs: np.ndarray, num_nodes: int) -> int:
    """Return the number of independent cycles of a graph."""
    root = np.arange(num_nodes)

    def find(i: int) -> int:
        while root[i] != i:
            root[i] = root[root[i]]
            i = root[i]
        return i

    cycles = 0
    for a, b in pairs:
        x, y = find(a), find(b)
        cycles += x == y
        root[max(x, y)] = min(x, y)
    return int(cycles)


def _incidence(
    pairs: np.ndarray, real: np.ndarray, free: np.ndarray, num_nodes: int
) -> tuple[np.ndarray, np.ndarray]:
    bond = np.tile(np.flatnonzero(real), 2)
    node = np.concatenate([pairs[real, 0], pairs[real, 1]])
    sign = np.repeat([1.0, -1.0], int(real.sum()))
    # The world has no equation, and may have more bonds than any node.
    keep = free[node]
    bond, node, sign = bond[keep], node[keep], sign[keep]
    degree = np.bincount(node, minlength=num_nodes)
    order = np.argsort(node, kind="stable")
    column = np.arange(len(node)) - np.repeat(np.cumsum(degree) - degree, degree)
    bonds = np.full((num_nodes, max(int(degree.max(initial=0)), 1)), len(pairs))
    signs = np.zeros(bonds.shape)
    bonds[node[order], column], signs[node[order], column] = bond[order], sign[order]
    return bonds, signs


def _grouped(
    pairs: np.ndarray, stiffness: np.ndarray, free: np.ndarray, most: int
) -> np.ndarray:
    """Return groups of up to so many nodes, (N,), -1 for nodes that are not free.

    Pairs of nodes, then of pairs, and so on, each time across the stiffest connections.
    """
    group = np.where(free, np.cumsum(free) - 1, -1)
    count = int(free.sum())
    while True:
        ends = np.sort(group[pairs], axis=1)
        across = ends[:, 0] != ends[:, 1]
        key, place = np.unique(
            ends[across, 0] * count + ends[across, 1], return_inverse=True
        )
        total = np.bincount(place, stiffness[across], minlength=len(key))
        a, b = key // max(count, 1), key % max(count, 1)
        size = np.bincount(group[free], minlength=count)
        fits = size[a] + size[b] <= most
        # Small ones first among equals, so that groups stay even.
        order = np.argsort(-total / np.sqrt(size[a] * size[b]), kind="stable")
        partner, matched = np.arange(count), np.zeros(count, bool)
        for i in order[fits[order]]:
            if not (matched[a[i]] or matched[b[i]]):
                matched[a[i]] = matched[b[i]] = True
                partner[b[i]] = a[i]
        if not matched.any():
            return group
        _, renamed = np.unique(partner, return_inverse=True)
        group = np.where(group < 0, -1, renamed[group])
        count = int(renamed.max()) + 1


def _members(group: np.ndarray, num_nodes: int) -> np.ndarray:
    """Return the nodes of each group, (groups, most), num_nodes in empty places."""
    node = np.flatnonzero(group >= 0)
    node = node[np.argsort(group[node], kind="stable")]
    size = np.bincount(group[node])
    table = np.full((len(size), max(int(size.max(initial=0)), 1)), num_nodes)
    column = np.arange(len(node)) - np.repeat(np.cumsum(size) - size, size)
    table[group[node], column] = node
    return table
