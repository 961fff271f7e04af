"""Blast's own stress solver, to reproduce its figures; for engineering use `solve`.

Blast replaces all masses by their geometric mean, runs a few conjugate gradient steps
on the normal equations, starts from what the last call left, and may lump nodes into
*aggregates* first. What it solves is a graph of its own: *solver nodes* (aggregates, or
the nodes themselves at level 0) joined by *solver bonds*, each the group of all bonds
between two aggregates. Breaking edits that graph in place, in an order that decides
which impulse the next call starts from, so the order is part of the state here too.

A call of Blast's `update` is `settle` (host), `update` (traced: jit, vmap), `prune`
(host); a split is followed by `notify` (host). Host functions take and return numpy
arrays; nothing is kept between calls but what they return. Sizes: N nodes, B bonds;
solver nodes fit into N rows and solver bonds into B, and the rest is padding.

Not reproduced: the third component of the torque arm of excess forces, which Blast
reads from the wrong place, and an entry past the end of the node list of actors that
hold the world, which it also visits.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from blastjax import chunks, graph, pytree, spatial
from blastjax.core import NO_WORLD, NONE, UNBREAKABLE, Asset, Damage, State
from blastjax.stress import limits as material
from blastjax.stress.limits import BondStress, Limits

TOLERANCE = 1e-3
"""Blast stops when the gradient is this part of the load; it cannot be set there."""


@pytree.dataclass
class Bodies(pytree.Node):
    """What the solver knows of each node."""

    mass: jax.Array
    """(N,) kg; 0 holds the node in place."""
    volume: jax.Array
    """(N,) m^3; 0 keeps the node from turning."""
    position: jax.Array
    """(N, 3) m; the world's is the origin."""


@pytree.dataclass
class Network(pytree.Node):
    """The graph that Blast solves, and the order in which it keeps it. Host arrays."""

    node_group: Any
    """(N,) int32 solver node of each node, NONE for padding."""
    group_source: Any
    """(N,) int32 the node whose acceleration a solver node takes: its last member."""
    group_size: Any
    """(N,) int32 nodes in each solver node, 0 for padding."""
    moves: Any
    """(N,) bool, solver nodes that forces move: those with mass."""
    turns: Any
    """(N,) bool, solver nodes that torques turn: those with mass and volume."""
    bond_group: Any
    """(B,) int32 solver bond of each bond, NONE inside an aggregate or when removed."""
    bond_rank: Any
    """(B,) int32 place of each bond in its group, NONE if it has none."""
    bond_list: Any
    """(B,) int32 the bonds that the solver knows in its order, then NONE."""
    solver_nodes: Any
    """(B, 2) int32 solver nodes that each solver bond joins, 0 for padding."""
    arm: Any
    """(B, 2, 3) from each of the two to where the bond acts, m."""
    num_nodes: Any
    """() int32 solver nodes."""
    num_bonds: Any
    """() int32 solver bonds."""
    num_impulses: Any
    """() int32 impulses kept: Blast leaves stale ones behind the last solver bond."""
    length_scale: Any
    """() mean arm, m."""
    mass_scale: Any
    """() geometric mean of the masses, kg; every mass counts as this one."""
    neighbours: Any
    """(N,) int32 chunks of the actor that each node was last announced in."""
    level: Any
    """() int32 rounds of aggregation; 0 for none."""
    check: Any
    """() bool, whether bonds may have broken since the last `settle`."""
    rebuild: Any
    """() bool, whether the next `settle` makes everything anew."""


@pytree.dataclass
class Impulses(pytree.Node):
    """What each solver bond transmits to its first node, in Blast's order."""

    linear: Any
    """(B, 3) N."""
    angular: Any
    """(B, 3) N m."""


@pytree.dataclass
class Result(pytree.Node):
    """What one `update` found."""

    impulses: Impulses
    """Of the solver bonds; where the next update starts."""
    stress: BondStress
    """Of each bond, Pa; 0 for those not in the solver and in unbreakable groups."""
    force: jax.Array
    """(B, 3) impulse of the solver bond of each bond, N; 0 if it has none."""
    health: jax.Array
    """(B,) of the bonds at the time: the area that bore the load."""
    damage: Damage
    """Health that the stress takes: Blast's fracture commands."""
    overstressed: jax.Array
    """() int32 bonds beyond an elastic limit."""
    iterations: jax.Array
    """() int32 steps taken; negative if the limit stopped them."""
    converged: jax.Array
    """() bool."""
    error_linear: jax.Array
    """() norm of the forces' part of the last gradient, in the solver's units."""
    error_angular: jax.Array
    """() norm of the torques' part."""


def bodies(asset: Asset, density: float | jax.Array) -> Bodies:
    """Return the nodes as Blast takes them from an asset: the world at the origin.

    Args:
      asset: the asset.
      density: kg/m^3, one for all or (C,).

    Differentiable, exactly.
    """
    count = asset.span_node.shape[0]
    volume = asset.chunk_volume
    density = jnp.broadcast_to(jnp.asarray(density, volume.dtype), volume.shape)
    return Bodies(
        mass=chunks.element_values(asset, density * volume)[:count],
        volume=chunks.element_values(asset, volume)[:count],
        position=chunks.element_values(asset, asset.chunk_centroid)[:count],
    )


def network(asset: Asset, state: State, bodies: Bodies, *, level: int = 0) -> Network:
    """Build the solver's graph of a state. Host side.

    Args:
      asset: the asset.
      state: its state; bonds without health are left out for good.
      bodies: mass, volume and position of the nodes.
      level: rounds of aggregation; each at most doubles the size of the aggregates.

    Raises:
      ValueError: the level is negative.
    """
    if level < 0:
        raise ValueError(f"level is {level}; give 0 or more rounds of aggregation")
    host: Any = _host(asset)
    real = host.bond_nodes[:, 0] != host.bond_nodes[:, 1]
    known = np.flatnonzero(real & (np.asarray(state.bond_health) > 0))
    owner = np.asarray(state.actor)[: len(host.span_node)]
    neighbours = np.zeros(len(host.span_node), np.int32)
    for nodes in _members(host, owner, np.unique(owner[owner != NONE])):
        neighbours[nodes] = _num_chunks(host, nodes)
    return _build(host, bodies, known.tolist(), neighbours, level)


def no_impulses(asset: Asset) -> Impulses:
    """Return impulses for a first update, all zero. Host side."""
    rows = np.zeros(asset.bond_centroid.shape, asset.bond_centroid.dtype)
    return Impulses(linear=rows, angular=rows.copy())


def notify(asset: Asset, state: State, network: Network, actors: np.ndarray) -> Network:
    """Tell the network of the actors that a split made or changed. Host side.

    Broken bonds will be removed, and if some aggregate has become too large for its
    actor, everything is built anew. At level 0 that is a single chunk with the world.

    Args:
      asset: the asset.
      state: after the split.
      network: the network.
      actors: (A,) bool by label, those that the split returned: all its pieces, the
        one that kept its label too.
    """
    host: Any = _host(asset)
    owner = np.asarray(state.actor)[: len(host.span_node)]
    labels = np.flatnonzero(np.asarray(actors))
    neighbours = np.array(network.neighbours)
    rebuild = bool(network.rebuild)
    for nodes in _members(host, owner, labels):
        if len(nodes) < 2:
            continue
        count = _num_chunks(host, nodes)
        neighbours[nodes] = count
        sizes = np.asarray(network.group_size)[np.asarray(network.node_group)[nodes]]
        rebuild = rebuild or bool((sizes > count // 2).any())
    check = bool(network.check) or len(labels) > 0
    return network.replace(
        neighbours=neighbours, check=np.bool_(check), rebuild=np.bool_(rebuild)
    )


def settle(
    asset: Asset, state: State, bodies: Bodies, network: Network, impulses: Impulses
) -> tuple[Network, Impulses]:
    """Do what is pending before an update: remove bonds, build anew. Host side."""
    if bool(network.check):
        broken = ~(np.asarray(state.bond_health) > 0)
        known = np.asarray(network.bond_list)
        known = np.sort(known[known != NONE])
        network, impulses = _remove(network, impulses, known[broken[known]])
        network = network.replace(check=np.bool_(False))
    if bool(network.rebuild):
        known = np.asarray(network.bond_list)
        known = known[known != NONE].tolist()
        level, neighbours = int(network.level), np.asarray(network.neighbours)
        network = _build(_host(asset), bodies, known, neighbours, level)
        impulses = no_impulses(asset)
    return network, impulses


def prune(
    state: State, network: Network, impulses: Impulses
) -> tuple[Network, Impulses]:
    """Remove the broken bonds that an update came across. Host side.

    These are bonds that broke without a split; they bore load once more. Bonds inside
    aggregates are not seen.
    """
    broken = ~(np.asarray(state.bond_health) > 0)
    group, rank = np.asarray(network.bond_group), np.asarray(network.bond_rank)
    dead = np.flatnonzero(broken & (group != NONE))
    order = np.lexsort((rank[dead], group[dead]))
    return _remove(network, impulses, dead[order])


def update(
    asset: Asset,
    state: State,
    bodies: Bodies,
    network: Network,
    impulses: Impulses,
    acceleration: jax.Array,
    limits: Limits,
    *,
    max_iterations: int | jax.Array = 25,
    cold: bool | jax.Array = False,
    bond_material: jax.Array | None = None,
    tolerance: float | jax.Array = TOLERANCE,
) -> Result:
    """Solve for the impulses that balance accelerations, and compare with limits.

    Args:
      asset: the asset.
      state: its state.
      bodies: the nodes.
      network: of `settle`.
      impulses: where to start, of `settle`.
      acceleration: (N, 3) of the nodes, m/s^2; that of nodes without mass is ignored.
      limits: of the material.
      max_iterations: 0 stands for six a solver node or bond.
      cold: whether to start from zero, as after Blast's `reset`.
      bond_material: (B,) int32, which of M materials; None if there is one.
      tolerance: Blast's own by default; 0 goes on to the last iteration.

    Returns:
      What it found. The loop has forward derivatives only.
    """
    dtype = asset.bond_centroid.dtype
    network = jax.tree.map(jnp.asarray, network)
    system = _system(network, dtype)
    rows = jnp.arange(asset.bond_nodes.shape[0], dtype=jnp.int32)
    used = (rows < network.num_bonds)[:, None]
    by_length = system.mass * system.length
    before = jnp.concatenate(
        [impulses.angular / (by_length * system.length), impulses.linear / by_length],
        axis=1,
    )
    start = jnp.where(used & ~jnp.asarray(cold), before, 0)
    pull = acceleration[network.group_source] / system.length
    load = jnp.where(network.moves[:, None], -pull, 0)
    load = jnp.concatenate([jnp.zeros_like(load), load], axis=1)
    most = 6 * jnp.maximum(network.num_nodes, network.num_bonds)
    given = jnp.asarray(max_iterations, jnp.int32)
    limit = jnp.where(given > 0, given, most)
    found = _solve(system, load, start, limit, tolerance)

    x = found.x
    new = Impulses(
        linear=jnp.where(used, x[:, 3:] * by_length, impulses.linear),
        angular=jnp.where(
            used, x[:, :3] * (by_length * system.length), impulses.angular
        ),
    )
    stress, force = _stress(asset, state, bodies, network, new)
    in_solver = (network.bond_group >= 0) & (state.bond_health > 0)
    over = material.overstressed(limits, stress, bond_material) & in_solver
    amount = material.damage(limits, stress, state.bond_health, bond_material)
    steps = jnp.where(found.done, found.step, -found.step)
    return Result(
        impulses=new,
        stress=stress,
        force=force,
        health=state.bond_health,
        damage=Damage(bond=jnp.where(in_solver, amount, 0)),
        overstressed=jnp.sum(over, dtype=jnp.int32),
        iterations=steps,
        converged=found.done & jnp.all(jnp.isfinite(x)),
        error_linear=found.error_linear,
        error_angular=found.error_angular,
    )


def excess(
    asset: Asset,
    state: State,
    bodies: Bodies,
    result: Result,
    limits: Limits,
    center: jax.Array,
    *,
    bond_material: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Return what broken bonds bore beyond their fatal limits, and pieces keep.

    Args:
      asset: the asset.
      state: after the damage of the update and a split.
      bodies: the nodes.
      result: of the update.
      limits: of the material.
      center: (A, 3) by label, the point about which torques are taken, m.
      bond_material: (B,) int32, which of M materials; None if there is one.

    Returns:
      Force (A, 3) N and torque (A, 3) N m on each actor, by label. A bond counts if it
      broke since the update and leads to another actor or to the world. Differentiable;
      which bonds count is constant.
    """
    count = state.actor.shape[0]
    own = material.effective(limits)
    own = jax.tree.map(
        lambda x: x[bond_material] if bond_material is not None and x.ndim else x, own
    )
    normal, shear = result.stress.normal, result.stress.shear
    pulled = jnp.where(normal > own.tension_fatal, normal - own.tension_fatal, 0)
    pressed = -normal > own.compression_fatal
    pressure = jnp.where(pressed, normal + own.compression_fatal, pulled)
    across = jnp.where(shear > own.shear_fatal, shear - own.shear_fatal, 0)
    direction, _ = _direction(asset, bodies)
    along = spatial.dot(result.force, direction)[:, None]
    tangent = spatial.unit(result.force - along * direction)
    force = pressure[:, None] * direction + across[:, None] * tangent
    force = force * result.health[:, None]

    first, second = asset.bond_nodes[:, 0], asset.bond_nodes[:, 1]
    parted = state.actor[first] != state.actor[second]
    to_world = jnp.zeros_like(parted)
    if asset.has_world:
        to_world = second == 0
    broke = (result.health > 0) & ~(state.bond_health > 0) & (parted | to_world)
    force = jnp.where(broke[:, None], force, 0)
    total = turn = jnp.zeros((count, 3), force.dtype)
    for node, push in (
        (first, force),
        (second, jnp.where(to_world[:, None], 0, -force)),
    ):
        label = state.actor[node]
        arm = asset.bond_centroid - center[jnp.maximum(label, 0)]
        total = total + graph.group_sum(push, label, count)
        turn = turn + graph.group_sum(jnp.cross(arm, push), label, count)
    return total, turn


@pytree.dataclass
class _System(pytree.Node):
    """The matrix, in the solver's units: no mass, lengths by the mean arm."""

    nodes: jax.Array
    arm: jax.Array
    moves: jax.Array
    turns: jax.Array
    length: jax.Array
    mass: jax.Array


def _system(network: Network, dtype: Any) -> _System:
    length = jnp.asarray(network.length_scale, dtype)
    return _System(
        nodes=network.solver_nodes,
        arm=jnp.asarray(network.arm, dtype) / length,
        moves=network.moves[:, None].astype(dtype),
        turns=network.turns[:, None].astype(dtype),
        length=length,
        mass=jnp.asarray(network.mass_scale, dtype),
    )


def _on_nodes(system: _System, x: jax.Array) -> jax.Array:
    """Sum impulses (B, 6), angular first, over their ends into (N, 6)."""
    torque, force = x[:, :3], x[:, 3:]
    near = torque - jnp.cross(system.arm[:, 0], force)
    far = torque - jnp.cross(system.arm[:, 1], force)
    ends = jnp.stack(
        [
            jnp.concatenate([near, force], axis=1),
            jnp.concatenate([-far, -force], axis=1),
        ],
        axis=1,
    )
    total = graph.group_sum(
        ends.reshape(-1, 6), system.nodes.reshape(-1), system.moves.shape[0]
    )
    return total * _weights(system)


def _on_bonds(system: _System, y: jax.Array) -> jax.Array:
    """Apply the transpose: (N, 6) to (B, 6)."""
    y = y * _weights(system)
    near, far = y[system.nodes[:, 0]], y[system.nodes[:, 1]]
    pull = jnp.cross(system.arm[:, 0], near[:, :3])
    push = jnp.cross(system.arm[:, 1], far[:, :3])
    force = (near[:, 3:] + pull) - (far[:, 3:] + push)
    return jnp.concatenate([near[:, :3] - far[:, :3], force], axis=1)


def _weights(system: _System) -> jax.Array:
    shape = (system.moves.shape[0], 3)
    return jnp.concatenate(
        [jnp.broadcast_to(w, shape) for w in (system.turns, system.moves)], axis=1
    )


@pytree.dataclass
class _Search(pytree.Node):
    x: jax.Array
    residual: jax.Array
    direction: jax.Array
    square: jax.Array
    step: jax.Array
    done: jax.Array
    error_linear: jax.Array
    error_angular: jax.Array


def _solve(
    system: _System,
    load: jax.Array,
    start: jax.Array,
    limit: jax.Array,
    tolerance: float | jax.Array,
) -> _Search:
    """Take conjugate gradient steps on the normal equations of `_on_nodes(x) = load`.

    The gradient is tested before each step, so the last one goes untested, and its
    norms are those before it, as in Blast.
    """
    zero = jnp.zeros((), start.dtype)
    enough = tolerance**2 * jnp.sum(load * load)

    def more(s: _Search) -> jax.Array:
        return ~s.done & (s.step < limit)

    def step(s: _Search) -> _Search:
        gradient = _on_bonds(system, s.residual)
        angular = jnp.sum(gradient[:, :3] * gradient[:, :3])
        linear = jnp.sum(gradient[:, 3:] * gradient[:, 3:])
        square = angular + linear
        done = square <= enough
        beta = spatial.ratio(square, s.square)
        direction = gradient + beta * s.direction
        image = _on_nodes(system, direction)
        size = jnp.where(done, 0, spatial.ratio(square, jnp.sum(image * image)))
        return _Search(
            x=s.x + size * direction,
            residual=s.residual - size * image,
            direction=direction,
            square=square,
            step=s.step + (~done).astype(jnp.int32),
            done=done,
            error_linear=_root(linear),
            error_angular=_root(angular),
        )

    first = _Search(
        x=start,
        residual=load - _on_nodes(system, start),
        direction=jnp.zeros_like(start),
        square=zero,
        step=jnp.zeros((), jnp.int32),
        done=jnp.zeros((), bool),
        error_linear=zero,
        error_angular=zero,
    )
    return jax.lax.while_loop(more, step, first)


def _root(square: jax.Array) -> jax.Array:
    """Return the root, without the slope of it at zero."""
    some = square > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, square, 1)), 0)


def _direction(asset: Asset, bodies: Bodies) -> tuple[jax.Array, jax.Array]:
    """Return bond normals turned towards the second node, and the way there, (B, 3).

    The way to the world leads to the origin.
    """
    first, second = asset.bond_nodes[:, 0], asset.bond_nodes[:, 1]
    way = bodies.position[second] - bodies.position[first]
    against = spatial.dot(asset.bond_normal, way) < 0
    return jnp.where(against[:, None], -asset.bond_normal, asset.bond_normal), way


def _stress(
    asset: Asset, state: State, bodies: Bodies, network: Network, impulses: Impulses
) -> tuple[BondStress, jax.Array]:
    """Return the stress of each bond and the force of its solver bond, (B, 3)."""
    group, count = network.bond_group, asset.bond_nodes.shape[0]
    alive = (group >= 0) & (state.bond_health > 0)
    lasting = state.bond_health >= UNBREAKABLE
    if state.bond_unbreakable is not None:
        lasting = state.bond_unbreakable
    held = graph.group_any(lasting & alive, group, count)
    health = jnp.where(alive & ~lasting, state.bond_health, 0)
    normal, way = _direction(asset, bodies)
    sums = graph.group_sum(
        health[:, None]
        * jnp.concatenate([jnp.ones_like(health)[:, None], normal, way], axis=1),
        group,
        count,
    )
    area = jnp.where(held, 0, sums[:, 0])
    distance = spatial.norm(spatial.ratio(sums[:, 4:], sums[:, :1]))
    of_group = material.bond_stress(
        impulses.linear, impulses.angular, spatial.unit(sums[:, 1:4]), area, distance
    )
    mine = jnp.maximum(group, 0)
    stress = jax.tree.map(lambda s: jnp.where(alive, s[mine], 0), of_group)
    return stress, jnp.where(alive[:, None], impulses.linear[mine], 0)


def _host(asset: Asset) -> Any:
    return jax.tree.map(np.asarray, asset)


def _blast_order(host: Any) -> np.ndarray:
    """Return the real nodes in Blast's numbering: the world last, no padding."""
    chunk = host.element_chunk[: len(host.span_node)]
    nodes = np.flatnonzero(chunk >= 0)
    world = host.has_world and chunk[0] != NO_WORLD
    return np.append(nodes, 0) if world else nodes


def _members(host: Any, owner: np.ndarray, labels: np.ndarray) -> list[np.ndarray]:
    return [np.flatnonzero(owner == label) for label in labels]


def _num_chunks(host: Any, nodes: np.ndarray) -> int:
    return int((host.element_chunk[nodes] >= 0).sum())


def _build(
    host: Any, bodies: Bodies, known: list[int], neighbours: np.ndarray, level: int
) -> Network:
    """Make a network of the known bonds, in their order."""
    capacity, num_bonds = len(host.span_node), len(host.bond_nodes)
    dtype = host.bond_centroid.dtype
    order = _blast_order(host)
    pairs = host.bond_nodes[known].tolist()
    node_group, size = _aggregate(order, pairs, neighbours, level, capacity)

    count = len(size)
    group = node_group[order]
    source = np.zeros(capacity, np.int32)
    source[group] = order
    mass, volume, place = (
        _sums(np.asarray(x, dtype)[order], group, capacity)
        for x in (np.maximum(bodies.mass, 0), bodies.volume, bodies.position)
    )
    sizes = np.zeros(capacity, np.int32)
    sizes[:count] = size
    place = place / np.maximum(sizes, 1).astype(dtype)[:, None]

    bond_group = np.full(num_bonds, NONE, np.int32)
    bond_rank = bond_group.copy()
    ends: list[tuple[int, int]] = []
    first: list[int] = []
    seen: dict[tuple[int, int], int] = {}
    members: list[int] = []
    for bond, (a, b) in zip(known, pairs, strict=True):
        pair = (int(node_group[a]), int(node_group[b]))
        if pair[0] == pair[1]:
            continue
        if pair not in seen:
            seen[pair] = len(ends)
            ends.append(pair)
            first.append(bond)
            members.append(0)
        bond_group[bond] = seen[pair]
        bond_rank[bond] = members[seen[pair]]
        members[seen[pair]] += 1

    solver_nodes = np.zeros((num_bonds, 2), np.int32)
    solver_nodes[: len(ends)] = np.asarray(ends, np.int32).reshape(-1, 2)
    arm = np.zeros((num_bonds, 2, 3), dtype)
    moves = mass > 0
    arm[: len(ends)] = _arms(
        place, moves, solver_nodes[: len(ends)], host.bond_centroid[first]
    )
    bond_list = np.full(num_bonds, NONE, np.int32)
    bond_list[: len(known)] = known
    turns = moves & (volume > 0)
    free = moves[solver_nodes[: len(ends)]]
    return Network(
        node_group=node_group,
        group_source=source,
        group_size=sizes,
        moves=moves,
        turns=turns,
        bond_group=bond_group,
        bond_rank=bond_rank,
        bond_list=bond_list,
        solver_nodes=solver_nodes,
        arm=arm,
        num_nodes=np.int32(count),
        num_bonds=np.int32(len(ends)),
        num_impulses=np.int32(len(ends)),
        length_scale=_mean(np.sqrt(_square(arm[: len(ends)]))[free], dtype),
        mass_scale=_geometric_mean(mass[moves], dtype),
        neighbours=np.asarray(neighbours, np.int32),
        level=np.int32(level),
        check=np.bool_(False),
        rebuild=np.bool_(False),
    )


def _aggregate(
    order: np.ndarray,
    pairs: list[list[int]],
    neighbours: np.ndarray,
    level: int,
    capacity: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Lump nodes; return the solver node of each (capacity,), and their sizes."""
    blast = np.full(capacity, NONE, np.int32)
    blast[order] = np.arange(len(order), dtype=np.int32)
    of = list(range(len(order)))
    size = [1] * len(order)
    for round_ in range(level):
        for first, second in pairs:
            a, b = int(blast[first]), int(blast[second])
            into, other = of[a], of[b]
            most = min(2 ** (round_ + 1), int(neighbours[first]) // 2)
            if into == other or size[into] >= most or size[other] >= most:
                continue
            # One node moves, not its whole aggregate: that may fall apart.
            mover = b
            if size[into] < size[other]:
                into, other, mover = other, into, a
            of[mover] = into
            size[into] += 1
            size[other] -= 1
    left = np.asarray(size) > 0
    number = np.cumsum(left) - 1
    group = np.full(capacity, NONE, np.int32)
    group[order] = number[np.asarray(of, np.int64)]
    return group, np.asarray(size, np.int32)[left]


def _arms(
    place: np.ndarray, moves: np.ndarray, ends: np.ndarray, centroid: np.ndarray
) -> np.ndarray:
    """Return the arms (bonds, 2, 3): half way between free nodes, else to the face."""
    first, second = place[ends[:, 0]], place[ends[:, 1]]
    free = moves[ends]
    near = np.where(free[:, :1], centroid - first, second - centroid)
    half = (second - first) * place.dtype.type(0.5)
    near = np.where(free.all(axis=1)[:, None], half, near)
    return np.stack([near, -near], axis=1)


def _sums(values: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    total = np.zeros((count, *values.shape[1:]), values.dtype)
    np.add.at(total, group, values)
    return total


def _square(v: np.ndarray) -> np.ndarray:
    return v[..., 0] * v[..., 0] + v[..., 1] * v[..., 1] + v[..., 2] * v[..., 2]


def _mean(values: np.ndarray, dtype: Any) -> Any:
    # Summed one by one, as Blast does: the scale is part of its float32 results.
    if not len(values):
        return dtype.type(1)
    return np.add.accumulate(values)[-1] / dtype.type(len(values))


def _geometric_mean(values: np.ndarray, dtype: Any) -> Any:
    logs = np.log(values.astype(np.float64)).astype(dtype)
    if not len(values):
        return dtype.type(1)
    return dtype.type(np.exp(np.float64(_mean(logs, dtype))))


@dataclasses.dataclass
class _Edit:
    """The lists that removal edits, as Python lists."""

    known: list[int]
    place: dict[int, int]
    members: list[list[int]]
    of: np.ndarray
    ends: list[Any]
    arm: list[Any]
    linear: list[Any]
    angular: list[Any]
    rebuild: bool

    def remove(self, bond: int) -> None:
        """Take one bond out; the last of each list takes the free place."""
        at, last = self.place.pop(bond), self.known.pop()
        if last != bond:
            self.known[at], self.place[last] = last, at
        group = int(self.of[bond])
        self.of[bond] = NONE
        if group == NONE:
            self.rebuild = True
            return
        mates = self.members[group]
        at, last = mates.index(bond), mates.pop()
        if last != bond:
            mates[at] = last
        if not mates:
            self.drop(group)

    def drop(self, group: int) -> None:
        """Take an empty solver bond out."""
        for rows in (self.members, self.ends, self.arm):
            last = rows.pop()
            if group < len(rows):
                rows[group] = last
        if group < len(self.members):
            self.of[self.members[group]] = group
        # Blast's test: near the end of the list the impulses stay as they are.
        if group + 2 < len(self.linear):
            self.linear[group] = self.linear.pop()
            self.angular[group] = self.angular.pop()


def _remove(
    network: Network, impulses: Impulses, bonds: np.ndarray
) -> tuple[Network, Impulses]:
    """Take bonds out in this order."""
    if not len(bonds):
        return network, impulses
    count, kept = int(network.num_bonds), int(network.num_impulses)
    known = [b for b in np.asarray(network.bond_list).tolist() if b != NONE]
    of, rank = np.array(network.bond_group), np.asarray(network.bond_rank)
    members: list[list[int]] = [[] for _ in range(count)]
    for bond in np.argsort(rank, kind="stable").tolist():
        if of[bond] != NONE:
            members[of[bond]].append(bond)
    edit = _Edit(
        known=known,
        place={bond: i for i, bond in enumerate(known)},
        members=members,
        of=of,
        ends=list(np.asarray(network.solver_nodes)[:count]),
        arm=list(np.asarray(network.arm)[:count]),
        linear=list(np.asarray(impulses.linear)[:kept]),
        angular=list(np.asarray(impulses.angular)[:kept]),
        rebuild=bool(network.rebuild),
    )
    for bond in bonds.tolist():
        edit.remove(bond)

    ranks = np.full_like(rank, NONE)
    for mates in edit.members:
        ranks[mates] = np.arange(len(mates), dtype=np.int32)
    network = network.replace(
        bond_group=edit.of,
        bond_rank=ranks,
        bond_list=_filled(edit.known, network.bond_list, NONE),
        solver_nodes=_filled(edit.ends, network.solver_nodes),
        arm=_filled(edit.arm, network.arm),
        num_bonds=np.int32(len(edit.members)),
        num_impulses=np.int32(len(edit.linear)),
        rebuild=np.bool_(edit.rebuild),
    )
    return network, Impulses(
        linear=_filled(edit.linear, impulses.linear),
        angular=_filled(edit.angular, impulses.angular),
    )


def _filled(rows: list[Any], like: Any, fill: float = 0) -> np.ndarray:
    like = np.asarray(like)
    full = np.full_like(like, fill)
    if rows:
        full[: len(rows)] = np.asarray(rows, like.dtype)
    return full
