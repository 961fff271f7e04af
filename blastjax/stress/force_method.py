"""The force method: a forest spans the structure, cycles are what it leaves over.

Exact for trees of any length, dense in the number of cycles. The forest is searched
anew in each state: forces run down it, from leaves to roots, and displacements up.
"""

from typing import Any

import jax
import jax.numpy as jnp

from blastjax import pytree
from blastjax.stress import frames
from blastjax.stress.structures import Structure


def solve(
    frame: frames.Frame,
    structure: Structure,
    target: frames.Target,
    start: jax.Array,
    tolerance: float,
    iterations: int,
) -> tuple[frames.Target, tuple[jax.Array, jax.Array]]:
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
    push = jax.vmap(lambda y: frames.gather(frame, frame.root * y), 2, 2)(columns)
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
    residual = frames.unbalanced(frame, load, strain)
    return (strain, shift), (residual, jnp.zeros((), jnp.int32))


@pytree.dataclass
class _Forest(pytree.Node):
    """A tree for each piece, rooted at its smallest node: the world, if it holds it."""

    order: jax.Array  # (N,) nodes, roots first
    bond: jax.Array  # (N,) bond to the parent, B for roots
    parent: jax.Array  # (N,) node, itself for roots
    sign: jax.Array  # (N,) 1 where the node is the bond's first, -1 its second, else 0
    carries: jax.Array  # (B,) bool, bonds of the forest


def _spanning_forest(frame: frames.Frame) -> _Forest:
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
    first = frames.rows(frame.first, bond)
    second = frames.rows(frame.second, bond)
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


def _lever(frame: frames.Frame, forest: _Forest) -> tuple[jax.Array, jax.Array]:
    """Return the arms (N, 3) of each node and of its parent to the bond between."""
    arm = frames.rows(frame.arm, forest.bond)
    own = jnp.where((forest.sign > 0)[:, None], arm[:, 0], arm[:, 1])
    other = jnp.where((forest.sign > 0)[:, None], arm[:, 1], arm[:, 0])
    return own, other


def _down_the_forest(
    frame: frames.Frame, forest: _Forest, wrench: jax.Array
) -> jax.Array:
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


def _up_the_forest(
    frame: frames.Frame, forest: _Forest, stretch: jax.Array
) -> jax.Array:
    """Return displacements (N, 6) that stretch the forest's bonds so, roots first."""
    own, other = _lever(frame, forest)
    each = forest.sign[:, None] * frames.rows(stretch, forest.bond)

    def visit(i: jax.Array, shift: jax.Array) -> jax.Array:
        x = forest.order[i]
        base = shift[forest.parent[x]]
        turn = base[3:] + each[x, 3:]
        move = base[:3] + jnp.cross(base[3:], other[x]) + each[x, :3]
        mine = jnp.concatenate([move - jnp.cross(turn, own[x]), turn])
        return shift.at[x].set(jnp.where(forest.sign[x] != 0, mine, 0))

    start = jnp.zeros((forest.order.shape[0], 6), stretch.dtype)
    return jax.lax.fori_loop(0, forest.order.shape[0], visit, start)
