"""Forces in the bonds of a structure at rest, or moving as rigid pieces.

Every node has a displacement and a rotation; a bond resists, at its centroid, the
relative displacement of its two nodes with a stiffness and their relative rotation with
another. Equilibrium asks that the bond forces J balance the load at every node, and J
is, of all that do, the one of least elastic energy:

    C J + load = 0,   J = W C^T u,   W the stiffnesses.

Pieces that the world does not hold are balanced by their rigid acceleration first.
Masses enter through loads only, never into the operator.

Methods: "two-level" conjugate gradients with a coarse space of rigid aggregates, and
"force", which spans the structure with a tree and solves for the forces that go round
in cycles: exact for trees of any length, dense in the number of cycles.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from blastjax import graph, pytree, spatial
from blastjax.core import NONE, WORLD, Asset, State
from blastjax.stress.loads import Load, node_mass, node_place

TWO_LEVEL, FORCE = "two-level", "force"
MOST_CYCLES = 24
"""Independent cycles up to which the force method is the faster choice."""
MOST_AGGREGATES = 64
"""A dense coarse matrix of six times as many rows still factors well in float32."""
LEAST_AGGREGATE = 6
"""Nodes of an aggregate at least."""
CLUSTER = 8
"""Most nodes that the smoother solves for together."""
COARSE_SHIFT = 8.0
"""Roundings added to the unit diagonal of the coarse matrix."""
NULL_PIVOT = 4.0
"""Roundings of a unit diagonal, up to which what elimination left of it is nothing."""
DAMPING = 2 / 3
"""Of the smoother, which overshoots by a factor of 2 at most."""
NOISE = 30
"""Roundings of its load up to which a piece counts as unloaded."""
STALE_STEPS = 20
"""Steps without a better residual after which the iteration gives up."""


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


@pytree.dataclass
class Solution(pytree.Node):
    """Bond forces, and how far to trust them."""

    force: jax.Array
    """(B, 3) that the bond exerts on its first node, N: along the normal, tension."""
    torque: jax.Array
    """(B, 3) that the bond exerts on its first node about its own centroid, N m."""
    residual: jax.Array
    """() norm of what stays unbalanced, over that of the load or of all bond forces."""
    iterations: jax.Array
    """() int32, steps taken."""
    converged: jax.Array
    """() bool, whether the residual is within the tolerance."""
    strain: jax.Array
    """(B, 6) for a warm start: forces over the roots of the stiffnesses, scaled."""
    carries: jax.Array
    """(B,) bool, the bonds that could carry."""


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


def solve(
    structure: Structure,
    asset: Asset,
    state: State,
    load: Load,
    *,
    tolerance: float | None = None,
    iterations: int = 200,
    warm_start: Solution | None = None,
) -> Solution:
    """Return the forces in the bonds that balance a load.

    All actors are solved at once; bonds that do not connect carry nothing.

    Args:
      structure: of this asset; its leaves may be traced.
      asset: the asset.
      state: says which bonds connect.
      load: on the nodes; what acts on the world and on padding is ignored.
      tolerance: residual to stop at; by default 1e-6 in float32 and 1e-10 in float64.
      iterations: most steps of the two-level method.
      warm_start: where that method starts, say from the last step. It helps as long as
        the same bonds connect, and is not used otherwise.

    Returns:
      A Solution. Where the iteration ends short of the tolerance, it is the best that
      was found, and says so. Differentiable, forward and reverse, by the implicit
      function theorem, in the load, the masses and stiffnesses of the structure and the
      geometry of the asset; which bonds connect is constant.
    """
    dtype = asset.chunk_centroid.dtype
    if tolerance is None:
        tolerance = 1e-10 if dtype == jnp.float64 else 1e-6
    if not asset.bond_area.shape[0]:
        return _nothing(dtype)
    frame = _frame(structure, asset, state)
    load, peak = _unit_load(load, frame)
    right = _balanced(frame, structure, load)
    scale = jax.lax.stop_gradient(_size(right))
    scale = jnp.where(scale > 0, scale, 1.0)
    start = jnp.zeros_like(frame.root)
    if warm_start is not None:
        same = jnp.all(warm_start.carries == frame.alive)
        start = jnp.where(same, jax.lax.stop_gradient(warm_start.strain), 0.0)
    fixed, plain = jax.lax.stop_gradient((frame, structure))
    method = _force_method if structure.method == FORCE else _two_level

    def equations(unknowns: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        # In the square roots of the stiffnesses the system is symmetric, and harmless
        # where a bond has none.
        strain, shift = unknowns
        return (
            strain - frame.root * _stretch(frame, shift),
            -_gather(frame, frame.root * strain),
        )

    def run(_: Any, target: tuple[jax.Array, jax.Array]) -> Any:
        return method(fixed, plain, target, start, tolerance, iterations)

    right = right / scale
    # Nothing, but as differentiable as the rest: where only the load varies, JAX takes
    # no symbolic zero here.
    nothing = jnp.zeros_like(frame.root) + 0 * jnp.sum(right)
    (strain, _), (residual, count) = jax.lax.custom_linear_solve(
        equations,
        (nothing, right),
        solve=run,
        symmetric=True,
        has_aux=True,
    )
    bond = frame.root * strain * scale * jnp.where(jnp.isfinite(peak), peak, 0)
    # A load that is no number, or too large for one, bears no answer.
    fits = jnp.isfinite(peak) & jnp.isfinite(jnp.max(jnp.abs(bond)))
    bond = jnp.where(fits, bond, 0)
    return Solution(
        force=bond[:, :3],
        torque=bond[:, 3:] * frame.length,
        residual=jnp.where(fits, residual, jnp.inf),
        iterations=count,
        converged=fits & (residual <= tolerance),
        strain=strain,
        carries=frame.alive,
    )


def _nothing(dtype: Any) -> Solution:
    """Return the solution of an asset without bonds."""
    return Solution(
        force=jnp.zeros((0, 3), dtype),
        torque=jnp.zeros((0, 3), dtype),
        residual=jnp.zeros((), dtype),
        iterations=jnp.zeros((), jnp.int32),
        converged=jnp.ones((), bool),
        strain=jnp.zeros((0, 6), dtype),
        carries=jnp.zeros(0, bool),
    )


@pytree.dataclass
class _Frame(pytree.Node):
    """The connected structure in units of its own: lengths over `length`."""

    first: jax.Array  # (B,) nodes
    second: jax.Array
    arm: jax.Array  # (B, 2, 3) from the nodes to the bond
    root: jax.Array  # (B, 6) square roots of the stiffnesses, 0 for dead bonds
    alive: jax.Array  # (B,) bool
    node_bonds: jax.Array  # (N, K)
    node_sign: jax.Array  # (N, K), 0 for dead bonds
    node_arm: jax.Array  # (N, K, 3)
    bears: jax.Array  # (N,) bool, nodes with an equation
    place: jax.Array  # (N, 3)
    label: jax.Array  # (N,) smallest node of the piece
    floats: jax.Array  # (N,) bool, nodes of pieces that nothing holds
    length: jax.Array  # () m
    way: jax.Array | None  # see `graph.islands`


def _frame(structure: Structure, asset: Asset, state: State) -> _Frame:
    first, second = asset.bond_nodes[:, 0], asset.bond_nodes[:, 1]
    place = node_place(asset)
    num_nodes = place.shape[0]
    alive = state.bond_intact & (first != second) & (structure.stiffness > 0)
    is_chunk = asset.element_chunk[:num_nodes] >= 0
    arm = asset.bond_centroid[:, None] - place[asset.bond_nodes]
    to_world = jnp.stack([jnp.zeros_like(alive), ~is_chunk[second]], axis=1)
    arm = jnp.where(to_world[..., None], 0, arm)
    reach = jax.lax.stop_gradient(spatial.norm(arm[:, 0]))
    count = jnp.maximum(jnp.sum(alive), 1).astype(reach.dtype)
    length = jnp.sum(jnp.where(alive, reach, 0)) / count
    length = jnp.where(length > 0, length, 1.0)
    arm, place = arm / length, place / length

    mean = jnp.sum(jnp.where(alive, structure.stiffness, 0)) / count
    mean = jax.lax.stop_gradient(jnp.where(mean > 0, mean, 1.0))
    weight = jnp.stack([structure.stiffness, structure.bending / length**2]) / mean
    weight = jnp.where(alive[None] & (weight > 0), weight, 0)
    # The root has no derivative where there is no stiffness: it never sees that.
    root = jnp.where(weight > 0, jnp.sqrt(jnp.where(weight > 0, weight, 1)), 0)
    root = jnp.repeat(root.T, 3, axis=1)

    label = graph.islands(asset.bond_nodes, alive, num_nodes, way=asset.sweep)
    held = (label == 0) & asset.has_world
    sign = _rows(alive.astype(place.dtype), structure.node_bonds) * structure.node_sign
    side = (structure.node_sign < 0).astype(jnp.int32)
    both = _rows(arm, structure.node_bonds)
    node_arm = jnp.where((side == 0)[..., None], both[:, :, 0], both[:, :, 1])
    return _Frame(
        first=first,
        second=second,
        arm=arm,
        root=root,
        alive=alive,
        node_bonds=structure.node_bonds,
        node_sign=sign,
        node_arm=node_arm,
        bears=is_chunk & jnp.any(sign != 0, axis=1),
        place=place,
        label=label,
        floats=is_chunk & ~held,
        length=length,
        way=asset.sweep,
    )


def _unit_load(load: Load, frame: _Frame) -> tuple[Load, jax.Array]:
    """Return a load of largest entry 1, whose square is a number, and what it was."""
    both = jnp.stack([load.force, load.torque / frame.length])
    both = jnp.where(frame.bears[None, :, None], both, 0)
    peak = jax.lax.stop_gradient(jnp.max(jnp.abs(both)))
    scale = jnp.where(jnp.isfinite(peak) & (peak > 0), peak, 1)

    def unit(x: jax.Array) -> jax.Array:
        x = jnp.where(frame.bears[:, None] & jnp.isfinite(x), x, 0)
        return x / scale

    return Load(force=unit(load.force), torque=unit(load.torque)), peak


def _rows(values: jax.Array, index: jax.Array) -> jax.Array:
    """Return values[index], zero where the index is one past the end."""
    if values.shape[0] == 0:
        return jnp.zeros((*index.shape, *values.shape[1:]), values.dtype)
    return values.at[index].get(mode="fill", fill_value=0)


def _size(vector: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(vector * vector))


def _stretch(frame: _Frame, shift: jax.Array) -> jax.Array:
    """C^T: displacements (N, 6) to what bonds feel of them, (B, 6)."""
    shift = jnp.where(frame.bears[:, None], shift, 0)
    a, b = shift[frame.first], shift[frame.second]
    turn = jnp.cross(a[:, 3:], frame.arm[:, 0]) - jnp.cross(b[:, 3:], frame.arm[:, 1])
    return jnp.concatenate([a[:, :3] - b[:, :3] + turn, a[:, 3:] - b[:, 3:]], axis=1)


def _gather(frame: _Frame, bond: jax.Array) -> jax.Array:
    """C: bond forces (B, 6) to what they add up to at the nodes, (N, 6)."""
    each = _rows(bond, frame.node_bonds) * frame.node_sign[..., None]
    force = each[..., :3]
    torque = each[..., 3:] + jnp.cross(frame.node_arm, force)
    total = jnp.concatenate([force.sum(axis=1), torque.sum(axis=1)], axis=1)
    return jnp.where(frame.bears[:, None], total, 0)


def _balanced(frame: _Frame, structure: Structure, load: Load) -> jax.Array:
    """Return the load less what moves floating pieces as a whole, (N, 6)."""
    force, torque = load.force, load.torque / frame.length
    num_nodes = force.shape[0]
    label = jnp.where(frame.floats, frame.label, num_nodes)
    mass = jnp.where(frame.floats, structure.mass, 0)

    def total(x: jax.Array) -> jax.Array:
        return graph.group_sum(x, label, num_nodes)

    def back(x: jax.Array) -> jax.Array:
        return _rows(x, label)

    whole = total(mass)
    center = spatial.ratio(total(mass[:, None] * frame.place), whole[:, None])
    arm = frame.place - back(center)
    eye = jnp.eye(3, dtype=arm.dtype)[None]
    steiner = spatial.dot(arm, arm)[:, None, None] * eye
    steiner = steiner - arm[:, :, None] * arm[:, None, :]
    own = jnp.where(frame.floats[:, None, None], structure.inertia / frame.length**2, 0)
    inertia = total(mass[:, None, None] * steiner + own)
    # Twice, since what the first time leaves in float32 no bond forces can balance.
    for _ in range(2):
        pull = total(force)
        twist = total(torque + jnp.cross(arm, force))
        linear = back(spatial.ratio(pull, whole[:, None]))
        angular = back(_solve_3x3(inertia, twist))
        force = force - mass[:, None] * (linear + jnp.cross(angular, arm))
        torque = torque - jnp.einsum("nij,nj->ni", own, angular)
    both = jnp.concatenate([force, torque], axis=1)
    both = jnp.where(frame.bears[:, None], both, 0)

    # A piece that falls freely bears nothing: what is left of its load is rounding.
    def strength(x: jax.Array) -> jax.Array:
        return graph.group_sum(jnp.sum(x * x, axis=1), frame.label, num_nodes)

    whole_load = jnp.concatenate([load.force, load.torque / frame.length], axis=1)
    noise = (NOISE * jnp.finfo(mass.dtype).eps) ** 2 * strength(whole_load)
    bears = strength(both) > noise
    return jnp.where(bears[frame.label][:, None], both, 0)


def _solve_3x3(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Solve (n, 3, 3) x = (n, 3); 0 where the matrix is singular."""
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(matrix), axis=(1, 2)))
    scale = jnp.where(scale > 0, scale, 1)
    inverse = _inverse_3x3(matrix / scale[:, None, None])
    return jnp.einsum("nij,nj->ni", inverse, right / scale[:, None])


def _inverse_3x3(matrix: jax.Array) -> jax.Array:
    """Invert matrices (n, 3, 3) by cofactors; 0 where they are singular."""
    a, b, c = matrix[:, 0], matrix[:, 1], matrix[:, 2]
    cofactors = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=-1)
    determinant = spatial.dot(a, jnp.cross(b, c))
    return spatial.ratio(cofactors, determinant[:, None, None])


Target = tuple[jax.Array, jax.Array]


def _two_level(
    frame: _Frame,
    structure: Structure,
    target: Target,
    start: jax.Array,
    tolerance: float,
    iterations: int,
) -> tuple[Target, tuple[jax.Array, jax.Array]]:
    """Solve by conjugate gradients, adding up bond strains, not displacements.

    Strains formed from displacements at the end would lose as many digits as the
    structure is slender.
    """
    given, right = target
    right = jnp.where(frame.bears[:, None], right, 0)
    right = -right - _gather(frame, frame.root * given)
    precondition = _preconditioner(frame, structure)
    goal = _size(right)
    limit = tolerance * goal

    pushed = _gather(frame, frame.root * start)
    fit = spatial.ratio(jnp.sum(right * pushed), jnp.sum(pushed * pushed))
    strain = fit * start
    residual = right - fit * pushed
    ahead = precondition(residual)
    inner = jnp.sum(residual * ahead)
    size = _size(residual)
    zero = jnp.zeros_like(right)
    none = jnp.zeros((), jnp.int32)
    best = (inner, size, strain, zero)
    carry = (strain, zero, residual, ahead, inner, best, none, none, size <= limit)

    def running(carry: Any) -> jax.Array:
        return (carry[-3] < iterations) & ~carry[-1]

    def body(carry: Any) -> Any:
        strain, shift, residual, ahead, inner, best, count, stale, _ = carry
        stretch = frame.root * _stretch(frame, ahead)
        energy = jnp.sum(stretch * stretch)
        step = spatial.ratio(inner, energy)
        strain, shift = strain + step * stretch, shift + step * ahead
        residual = residual - step * _gather(frame, frame.root * stretch)
        size = _size(residual)
        raised = precondition(residual)
        following = jnp.sum(residual * raised)
        # The plain residual may well rise on the way; in this norm it should not.
        better = (following < best[0]) | (size <= limit)
        now = (following, size, strain, shift)
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), now, best)
        stale = jnp.where(better, 0, stale + 1)
        ahead = raised + spatial.ratio(following, inner) * ahead
        # Past the precision of the numbers nothing improves any more, or blows up.
        stuck = (energy <= 0) | (following <= 0) | (stale >= STALE_STEPS)
        done = (size <= limit) | stuck | ~jnp.isfinite(size)
        return strain, shift, residual, ahead, following, best, count + 1, stale, done

    found = jax.lax.while_loop(running, body, carry)
    _, _, strain, shift = found[5]
    report = _unbalanced(frame, right, strain), found[6]
    return (given + strain, shift), report


def _preconditioner(frame: _Frame, structure: Structure) -> Any:
    within, coarse = _smoother(frame, structure), _coarse(frame, structure)

    def stiff(shift: jax.Array) -> jax.Array:
        return _gather(frame, frame.root**2 * _stretch(frame, shift))

    def smooth(residual: jax.Array) -> jax.Array:
        return DAMPING * within(residual)

    def both(residual: jax.Array) -> jax.Array:
        shift = smooth(residual)
        shift = shift + coarse(residual - stiff(shift))
        shift = shift + smooth(residual - stiff(shift))
        return jnp.where(frame.bears[:, None], shift, 0)

    return both


def _smoother(frame: _Frame, structure: Structure) -> Any:
    """Return the solve within clusters of nodes, their surroundings held still."""
    nodes = structure.cluster
    clusters, size = nodes.shape
    num_nodes = frame.place.shape[0]
    own = jnp.full(num_nodes + 1, clusters, jnp.int32)
    own = own.at[nodes].set(jnp.arange(clusters, dtype=jnp.int32)[:, None])
    seat = jnp.zeros(num_nodes + 1, jnp.int32)
    seat = seat.at[nodes].set(jnp.arange(size, dtype=jnp.int32)[None])

    ends = jnp.stack([frame.first, frame.second], axis=1)
    at = jnp.where(frame.bears[ends], own[ends], clusters)
    same = (at[:, :, None] == at[:, None, :]) & (at[:, :, None] < clusters)
    row = at[:, :, None] * size + seat[ends][:, :, None]
    where = row * size + seat[ends][:, None, :]
    room = clusters * size * size
    blocks = _bond_blocks(frame, frame.arm, jnp.ones_like(at, bool))
    matrix = graph.group_sum(
        blocks.reshape(-1, 6, 6), jnp.where(same, where, room).reshape(-1), room
    )
    matrix = matrix.reshape(clusters, size, size, 6, 6).transpose(0, 1, 3, 2, 4)
    matrix = matrix.reshape(clusters, 6 * size, 6 * size)
    diagonal = jnp.diagonal(matrix, axis1=1, axis2=2)
    used = diagonal > 0
    unit = jnp.where(used, jax.lax.rsqrt(jnp.where(used, diagonal, 1)), 0)
    matrix = unit[:, :, None] * matrix * unit[:, None, :]
    inverse = _inverse(matrix)
    inverse = unit[:, :, None] * inverse * unit[:, None, :]

    def smooth(residual: jax.Array) -> jax.Array:
        mine = _rows(residual, nodes).reshape(clusters, -1)
        answer = jnp.einsum("cij,cj->ci", inverse, mine).reshape(clusters, size, 6)
        return jnp.zeros_like(residual).at[nodes].set(answer, mode="drop")

    return smooth


def _inverse(matrix: jax.Array) -> jax.Array:
    """Invert semidefinite matrices (m, 6 n, 6 n) of unit diagonal, six rows at a time.

    Rows that depend on those before, but for rounding, are left out: zero in the
    inverse, which is thus never indefinite.

    Not by LAPACK: on a CPU, JAX's calls of it hand parts of large batches to the thread
    pool that they occupy themselves. As many calls side by side as there are threads
    wait for ever.
    """
    rows = jnp.arange(matrix.shape[-1], dtype=jnp.int32) // 6

    def sweep(k: jax.Array, matrix: jax.Array) -> jax.Array:
        mine = rows == k
        row = jax.lax.dynamic_slice_in_dim(matrix, 6 * k, 6, 1)
        column = jax.lax.dynamic_slice_in_dim(matrix, 6 * k, 6, 2)
        pivot = _inverse_6x6(jax.lax.dynamic_slice_in_dim(row, 6 * k, 6, 2))
        row = pivot @ jnp.where(mine[None, None], 0, row)
        column = jnp.where(mine[None, :, None], 0, column)
        matrix = matrix - column @ row
        matrix = jax.lax.dynamic_update_slice_in_dim(matrix, row, 6 * k, 1)
        pivots = jnp.tile(pivot, (1, rows.shape[0] // 6, 1))
        column = jnp.where(mine[None, :, None], pivots, -(column @ pivot))
        return jax.lax.dynamic_update_slice_in_dim(matrix, column, 6 * k, 2)

    return jax.lax.fori_loop(0, rows.shape[0] // 6, sweep, matrix)


def _inverse_6x6(matrix: jax.Array) -> jax.Array:
    """Invert semidefinite matrices (m, 6, 6), dependent rows left out."""
    least = NULL_PIVOT * jnp.finfo(matrix.dtype).eps
    for k in range(6):
        mine = jnp.arange(6, dtype=jnp.int32) == k
        pivot = matrix[:, k, k]
        pivot = jnp.where(pivot > least, 1 / jnp.where(pivot > least, pivot, 1), 0)
        row = jnp.where(mine[None], 1, pivot[:, None] * matrix[:, k])
        column = jnp.where(mine[None], -1, matrix[:, :, k])
        row = jnp.where(mine[None], pivot[:, None], row)
        rest = jnp.where(mine[None, :, None] | mine[None, None], 0, matrix)
        matrix = rest - column[:, :, None] * row[:, None]
    return matrix


def _bond_blocks(frame: _Frame, lever: jax.Array, moves: jax.Array) -> jax.Array:
    """Return the stiffness (B, 2, 2, 6, 6) of bonds to what moves at their two ends.

    Args:
      frame: the structure.
      lever: (B, 2, 3) from the points whose rigid motion counts to the bond.
      moves: (B, 2) bool, ends that can move.
    """
    sign = jnp.array([1, -1], lever.dtype)[None, :, None, None]
    motion = _rigid(lever) * sign * frame.root[:, None, :, None]
    motion = jnp.where(moves[..., None, None], motion, 0)
    return jnp.einsum("bpki,bqkj->bpqij", motion, motion)


def _coarse(frame: _Frame, structure: Structure) -> Any:
    """Return the solve in the space of rigid motions of aggregates."""
    groups = structure.num_aggregates
    group, pinned, center = _current_aggregates(frame, structure)
    member = jnp.where(frame.bears, group, groups)
    arm = frame.place - _rows(center, member)

    # What a bond feels of a unit motion of the aggregates at its ends.
    ends = jnp.stack([frame.first, frame.second], axis=1)
    at = member[ends]
    lever = frame.arm + jnp.where(
        frame.bears[ends][..., None], arm[ends], jnp.zeros_like(frame.arm)
    )
    moves = (at < groups) & (at[:, :1] != at[:, 1:])
    blocks = _bond_blocks(frame, lever, moves)
    where = at[:, :, None] * groups + at[:, None, :]
    outside = (at[:, :, None] >= groups) | (at[:, None, :] >= groups)
    where = jnp.where(outside, groups * groups, where)
    matrix = graph.group_sum(
        blocks.reshape(-1, 6, 6), where.reshape(-1), groups * groups
    )
    matrix = matrix.reshape(groups, groups, 6, 6).transpose(0, 2, 1, 3)
    matrix = matrix.reshape(6 * groups, 6 * groups)

    free = jnp.repeat(~pinned, 6)
    matrix = jnp.where(free[:, None] & free[None, :], matrix, 0)
    diagonal = jnp.diagonal(matrix)
    usable = diagonal > 0
    unit = jnp.where(usable, jax.lax.rsqrt(jnp.where(usable, diagonal, 1)), 0)
    matrix = unit[:, None] * matrix * unit[None, :]
    shift = COARSE_SHIFT * jnp.finfo(matrix.dtype).eps
    matrix = matrix + jnp.diag(jnp.where(usable, shift, 0).astype(matrix.dtype))
    inverse = _inverse(matrix[None])[0]

    def correct(residual: jax.Array) -> jax.Array:
        force, torque = (
            residual[:, :3],
            residual[:, 3:] + jnp.cross(arm, residual[:, :3]),
        )
        total = jnp.concatenate([force, torque], axis=1)
        total = graph.group_sum(total, member, groups).reshape(-1)
        total = unit * total
        answer = inverse @ total
        # Slender structures ask for more digits than an inverse has.
        answer = unit * (answer + inverse @ (total - matrix @ answer))
        motion = _rows(answer.reshape(groups, 6), member)
        move = motion[:, :3] + jnp.cross(motion[:, 3:], arm)
        return jnp.concatenate([move, motion[:, 3:]], axis=1)

    return correct


def _rigid(lever: jax.Array) -> jax.Array:
    """Return rigid motions (..., 6, 6) at the end of levers (..., 3)."""
    x, y, z = lever[..., 0], lever[..., 1], lever[..., 2]
    o = jnp.zeros_like(x)
    cross = jnp.stack(
        [
            jnp.stack([o, z, -y], axis=-1),
            jnp.stack([-z, o, x], axis=-1),
            jnp.stack([y, -x, o], axis=-1),
        ],
        axis=-2,
    )
    eye = jnp.broadcast_to(jnp.eye(3, dtype=x.dtype), cross.shape)
    top = jnp.concatenate([eye, cross], axis=-1)
    return jnp.concatenate(
        [top, jnp.concatenate([jnp.zeros_like(eye), eye], axis=-1)], axis=-2
    )


def _current_aggregates(
    frame: _Frame, structure: Structure
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the aggregate of each node, which of them are pinned, and their centres.

    Breaking cuts aggregates up. The largest part keeps the name, and parts cut off join
    a neighbour that they still touch. One aggregate of each floating piece stands
    still: the rigid motion of the whole piece strains nothing.
    """
    groups, num_nodes = structure.num_aggregates, frame.place.shape[0]
    planned = structure.aggregate
    inside = frame.alive & (planned[frame.first] == planned[frame.second])
    edges = jnp.stack([frame.first, frame.second], axis=1)
    part = graph.islands(edges, inside, num_nodes, way=frame.way)
    ones = jnp.ones(num_nodes, jnp.int32)
    size = graph.group_sum(ones, part, num_nodes)[part]
    # Largest part first, smallest name among equals.
    rank = size * num_nodes + (num_nodes - 1 - part)
    member = jnp.where(frame.bears, planned, groups)
    highest = jnp.zeros(groups + 1, rank.dtype).at[member].max(rank)
    core = frame.bears & (rank == highest[member])
    group = jnp.where(core, planned, NONE)

    ends = jnp.where(structure.node_sign > 0, 1, 0)
    other = jnp.stack([frame.first, frame.second], axis=1)
    pair = other.at[frame.node_bonds].get(mode="fill", fill_value=0)
    neighbour = jnp.where(ends == 1, pair[..., 1], pair[..., 0])
    touches = frame.node_sign != 0

    def adopt(_: int, group: jax.Array) -> jax.Array:
        near = jnp.where(touches & frame.bears[neighbour], group[neighbour], NONE)
        return jnp.where(frame.bears & (group == NONE), near.max(axis=1), group)

    group = jax.lax.fori_loop(0, LEAST_AGGREGATE, adopt, group)
    group = jnp.where(group == NONE, groups, group)

    index = jnp.arange(groups, dtype=jnp.int32)
    label = jnp.full(groups + 1, num_nodes, jnp.int32).at[group].min(frame.label)
    label = label[:groups]
    floats = _rows(frame.floats, jnp.where(label < num_nodes, label, num_nodes))
    first = jnp.full(num_nodes + 1, groups, jnp.int32).at[label].min(index)
    pinned = (label >= num_nodes) | (floats & (first[label] == index))
    count = graph.group_sum(jnp.ones_like(frame.place[:, 0]), group, groups)
    center = graph.group_sum(frame.place, group, groups)
    return group, pinned, spatial.ratio(center, count[:, None])


def _force_method(
    frame: _Frame,
    structure: Structure,
    target: Target,
    start: jax.Array,
    tolerance: float,
    iterations: int,
) -> tuple[Target, tuple[jax.Array, jax.Array]]:
    """Solve for the forces round the cycles that a spanning forest leaves over.

    Any choice of them balances the load; the forest carries the rest. The one of least
    energy is a least-squares problem that is never singular, however slender the
    structure. Nothing is iterated.
    """
    del start, tolerance, iterations
    given, right = target
    forest = _spanning_forest(frame)
    over = frame.alive & ~forest.carries
    cycles = structure.num_cycles
    (chosen,) = jnp.nonzero(over, size=cycles, fill_value=over.shape[0])

    # One column for the load, six for a unit strain in each bond left over.
    dtype = right.dtype
    unit = jnp.eye(6 * cycles, dtype=dtype).reshape(cycles, 6, 6 * cycles)
    columns = jnp.zeros((*frame.root.shape, 6 * cycles + 1), dtype)
    columns = columns.at[chosen, :, 1:].set(unit, mode="drop")
    push = jax.vmap(lambda y: _gather(frame, frame.root * y), 2, 2)(columns)
    load = jnp.where(frame.bears[:, None], -right, 0)
    wrench = jnp.concatenate([load[..., None], jnp.zeros_like(push[..., 1:])], axis=2)
    carried = _down_the_forest(frame, forest, wrench - push)
    soft = jnp.where(frame.root > 0, 1 / jnp.where(frame.root > 0, frame.root, 1), 0)
    columns = columns + soft[..., None] * carried

    strain = columns[..., 0]
    if cycles:
        basis = columns[..., 1:].reshape(-1, 6 * cycles)
        wanted = (given - strain).reshape(-1)
        # Places for cycles that breaking has opened must not make it singular.
        empty = jnp.where(jnp.repeat(chosen < over.shape[0], 6), 0, 1)
        basis = jnp.concatenate([basis, jnp.diag(empty.astype(dtype))])
        wanted = jnp.concatenate([wanted, jnp.zeros(6 * cycles, dtype)])
        q, r = jnp.linalg.qr(basis)
        round_ = jax.scipy.linalg.solve_triangular(r, q.T @ wanted)
        strain = strain + columns[..., 1:] @ round_
    strain = jnp.where(frame.alive[:, None], strain, given)
    shift = _up_the_forest(frame, forest, soft * (strain - given))
    residual = _unbalanced(frame, load, strain)
    return (strain, shift), (residual, jnp.zeros((), jnp.int32))


def _unbalanced(frame: _Frame, load: jax.Array, strain: jax.Array) -> jax.Array:
    """Return the residual; the forces of a long lever dwarf its load."""
    bond = frame.root * strain
    left = _size(load - _gather(frame, bond))
    return spatial.ratio(left, jnp.maximum(_size(load), _size(bond)))


@pytree.dataclass
class _Forest(pytree.Node):
    """A tree for each piece, rooted at its smallest node: the world, if it holds it."""

    order: jax.Array  # (N,) nodes, roots first
    bond: jax.Array  # (N,) bond to the parent, B for roots
    parent: jax.Array  # (N,) node, itself for roots
    sign: jax.Array  # (N,) 1 where the node is the bond's first, -1 its second, else 0
    carries: jax.Array  # (B,) bool, bonds of the forest


def _spanning_forest(frame: _Frame) -> _Forest:
    num_nodes, num_bonds = frame.label.shape[0], frame.first.shape[0]
    index = jnp.arange(num_nodes, dtype=jnp.int32)
    far = num_nodes + 1
    depth = jnp.where(frame.label == index, 0, far)
    ends = jnp.concatenate([frame.first, frame.second])
    others = jnp.concatenate([frame.second, frame.first])
    alive = jnp.tile(frame.alive, 2)

    def grow(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        depth, _ = carry
        new = depth.at[others].min(jnp.where(alive, depth[ends] + 1, far))
        return new, jnp.any(new != depth)

    depth, _ = jax.lax.while_loop(lambda c: c[1], grow, (depth, jnp.array(True)))
    up = alive & (depth[others] == depth[ends] + 1)
    number = jnp.tile(jnp.arange(num_bonds, dtype=jnp.int32), 2)
    bond = jnp.full(num_nodes, num_bonds, jnp.int32)
    bond = bond.at[others].min(jnp.where(up, number, num_bonds))
    first = _rows(frame.first, bond)
    second = _rows(frame.second, bond)
    has_parent = bond < num_bonds
    is_first = first == index
    carries = jnp.zeros(num_bonds, bool).at[bond].set(True, mode="drop")
    sign = jnp.where(has_parent, jnp.where(is_first, 1, -1), 0)
    return _Forest(
        order=jnp.argsort(depth, stable=True).astype(jnp.int32),
        bond=bond,
        parent=jnp.where(has_parent, jnp.where(is_first, second, first), index),
        sign=sign.astype(frame.place.dtype),
        carries=carries,
    )


def _lever(frame: _Frame, forest: _Forest) -> tuple[jax.Array, jax.Array]:
    """Return the arms (N, 3) of each node and of its parent to the bond between."""
    arm = _rows(frame.arm, forest.bond)
    own = jnp.where((forest.sign > 0)[:, None], arm[:, 0], arm[:, 1])
    other = jnp.where((forest.sign > 0)[:, None], arm[:, 1], arm[:, 0])
    return own, other


def _down_the_forest(frame: _Frame, forest: _Forest, wrench: jax.Array) -> jax.Array:
    """Return bond forces (B, 6, R) that balance wrenches (N, 6, R), leaves first."""
    own, other = _lever(frame, forest)
    num_nodes = wrench.shape[0]
    bonds = jnp.zeros((frame.first.shape[0], *wrench.shape[1:]), wrench.dtype)

    def cross(arm: jax.Array, force: jax.Array) -> jax.Array:
        return jnp.cross(arm[:, None], force, axis=0)

    def visit(i: jax.Array, carry: tuple[jax.Array, jax.Array]) -> Any:
        wrench, bonds = carry
        x = forest.order[num_nodes - 1 - i]
        sign, parent = forest.sign[x], forest.parent[x]
        force = sign * wrench[x, :3]
        torque = sign * wrench[x, 3:] - cross(own[x], force)
        passed = jnp.concatenate([force, torque + cross(other[x], force)])
        wrench = wrench.at[parent].add(sign * passed)
        bond = jnp.concatenate([force, torque])
        return wrench, bonds.at[forest.bond[x]].set(bond, mode="drop")

    return jax.lax.fori_loop(0, num_nodes, visit, (wrench, bonds))[1]


def _up_the_forest(frame: _Frame, forest: _Forest, stretch: jax.Array) -> jax.Array:
    """Return displacements (N, 6) that stretch the forest's bonds so, roots first."""
    own, other = _lever(frame, forest)
    each = forest.sign[:, None] * _rows(stretch, forest.bond)

    def visit(i: jax.Array, shift: jax.Array) -> jax.Array:
        x = forest.order[i]
        base = shift[forest.parent[x]]
        turn = base[3:] + each[x, 3:]
        move = base[:3] + jnp.cross(base[3:], other[x]) + each[x, :3]
        mine = jnp.concatenate([move - jnp.cross(turn, own[x]), turn])
        return shift.at[x].set(jnp.where(forest.sign[x] != 0, mine, 0))

    start = jnp.zeros((forest.order.shape[0], 6), stretch.dtype)
    return jax.lax.fori_loop(0, forest.order.shape[0], visit, start)
