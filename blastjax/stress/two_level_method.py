"""The two-level method: conjugate gradients, preconditioned on two levels.

The smoother solves within clusters of a few nodes, which rids a residual of what varies
from node to node. The coarse space solves for the rigid motions of aggregates, which
rids it of what reaches across the structure. Both are dense, and inverted before the
iteration begins. It ends at the tolerance, after the given number of steps, or where
the numbers have no more digits to give.
"""

from typing import Any

import jax
import jax.numpy as jnp

from blastjax import graph, spatial
from blastjax.core import NONE
from blastjax.stress import frames
from blastjax.stress.structures import LEAST_AGGREGATE, Structure

COARSE_SHIFT = 8.0
"""Roundings added to the unit diagonal of the coarse matrix."""
NULL_PIVOT = 4.0
"""Roundings of a unit diagonal, up to which what elimination left of it is nothing."""
DAMPING = 2 / 3
"""Of the smoother, which overshoots by a factor of 2 at most."""
STALE_STEPS = 20
"""Steps without a better residual after which the iteration gives up."""


def solve(
    frame: frames.Frame,
    structure: Structure,
    target: frames.Target,
    start: jax.Array,
    tolerance: float,
    iterations: int,
) -> tuple[frames.Target, tuple[jax.Array, jax.Array]]:
    """Solve by conjugate gradients, adding up bond strains, not displacements.

    Strains formed from displacements at the end would lose as many digits as the
    structure is slender.
    """
    given, right = target
    right = jnp.where(frame.bears[:, None], right, 0)
    right = -right - frames.gather(frame, frame.root * given)
    precondition = _preconditioner(frame, structure)
    goal = frames.size(right)
    limit = tolerance * goal

    pushed = frames.gather(frame, frame.root * start)
    fit = spatial.ratio(jnp.sum(right * pushed), jnp.sum(pushed * pushed))
    strain = fit * start
    residual = right - fit * pushed
    ahead = precondition(residual)
    inner = jnp.sum(residual * ahead)
    size = frames.size(residual)
    zero = jnp.zeros_like(right)
    none = jnp.zeros((), jnp.int32)
    best = (inner, size, strain, zero)
    carry = (strain, zero, residual, ahead, inner, best, none, none, size <= limit)

    def running(carry: Any) -> jax.Array:
        return (carry[-3] < iterations) & ~carry[-1]

    def body(carry: Any) -> Any:
        strain, shift, residual, ahead, inner, best, count, stale, _ = carry
        stretch = frame.root * frames.stretch(frame, ahead)
        energy = jnp.sum(stretch * stretch)
        step = spatial.ratio(inner, energy)
        strain, shift = strain + step * stretch, shift + step * ahead
        residual = residual - step * frames.gather(frame, frame.root * stretch)
        size = frames.size(residual)
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
    report = frames.unbalanced(frame, right, strain), found[6]
    return (given + strain, shift), report


def _preconditioner(frame: frames.Frame, structure: Structure) -> Any:
    within, coarse = _smoother(frame, structure), _coarse(frame, structure)

    def stiff(shift: jax.Array) -> jax.Array:
        return frames.gather(frame, frame.root**2 * frames.stretch(frame, shift))

    def smooth(residual: jax.Array) -> jax.Array:
        return DAMPING * within(residual)

    def both(residual: jax.Array) -> jax.Array:
        shift = smooth(residual)
        shift = shift + coarse(residual - stiff(shift))
        shift = shift + smooth(residual - stiff(shift))
        return jnp.where(frame.bears[:, None], shift, 0)

    return both


def _smoother(frame: frames.Frame, structure: Structure) -> Any:
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
        mine = frames.rows(residual, nodes).reshape(clusters, -1)
        answer = jnp.einsum("cij,cj->ci", inverse, mine).reshape(clusters, size, 6)
        return jnp.zeros_like(residual).at[nodes].set(answer, mode="drop")

    return smooth


def _coarse(frame: frames.Frame, structure: Structure) -> Any:
    """Return the solve in the space of rigid motions of aggregates."""
    groups = structure.num_aggregates
    group, pinned, center = _current_aggregates(frame, structure)
    member = jnp.where(frame.bears, group, groups)
    arm = frame.place - frames.rows(center, member)

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
        motion = frames.rows(answer.reshape(groups, 6), member)
        move = motion[:, :3] + jnp.cross(motion[:, 3:], arm)
        return jnp.concatenate([move, motion[:, 3:]], axis=1)

    return correct


def _current_aggregates(
    frame: frames.Frame, structure: Structure
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
    part = graph.islands(edges, inside, num_nodes, sweep=frame.sweep)
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
    floats = frames.rows(frame.floats, jnp.where(label < num_nodes, label, num_nodes))
    first = jnp.full(num_nodes + 1, groups, jnp.int32).at[label].min(index)
    pinned = (label >= num_nodes) | (floats & (first[label] == index))
    count = graph.group_sum(jnp.ones_like(frame.place[:, 0]), group, groups)
    center = graph.group_sum(frame.place, group, groups)
    return group, pinned, spatial.ratio(center, count[:, None])


def _bond_blocks(frame: frames.Frame, lever: jax.Array, moves: jax.Array) -> jax.Array:
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
