"""The contact problem, by Newton's method, with a derivative at any iteration count.

Constrained acceleration minimises a strictly convex function,

    1/2 (a - a0)' M (a - a0) + sum_i s_i(J_i a - r_i),  s_i'(x) = clip(D_i x, l_i, u_i),

the one that MuJoCo's own solvers minimise (Todorov 2014) with pyramidal friction: the
bounds (-inf, inf) make an equality, (-f, f) dry friction, (-inf, 0) a contact or limit.
The derivative of the minimiser comes from the implicit function theorem, so forward and
reverse mode work however many iterations the solution took.

A contact acts on two bodies, so its part of J'DJ is a few blocks of 6 x 6, made from
the 3 x 3 matrix of its pyramid. Where nothing couples the slots, J'DJ + M falls apart
into one such block for each. Sizes: K slots, U other degrees of freedom, R rows that
are no contacts, C contacts of D dimensions.
"""

import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from blastjax import graph, pytree


@pytree.dataclass
class Motion(pytree.Node):
    """Velocities, accelerations or forces of everything that moves."""

    user: jax.Array
    """(U,) of the user's joints."""
    slots: jax.Array
    """(6, K) of the slots; contacts lie along the last axis everywhere, as lanes."""


@pytree.dataclass
class Rows(pytree.Node):
    """Constraints on the user's joints alone."""

    jacobian: jax.Array
    """(R, U) J."""
    stiffness: jax.Array
    """(R,) D, inverse of each row's regularisation."""
    reference: jax.Array
    """(R,) r, the acceleration that each row asks for."""
    lower: jax.Array
    """(R,) least derivative of the row's cost, N or N m."""
    upper: jax.Array
    """(R,) greatest derivative of the row's cost, N or N m."""


@pytree.dataclass
class Contacts(pytree.Node):
    """Contacts of one dimension D: 1 is the normal, each other one adds friction.

    The pyramid has an edge in each direction of friction, x0 + xi and x0 - xi, that
    only pushes. Coefficients of friction are in the Jacobian.
    """

    sides: tuple[tuple[jax.Array, jax.Array], ...]
    """For each side on which a slot can be: its number (C,) int32, K for none, and
    (D, 6, C) the motion of the contact by the slot's. The same slot is on both sides
    only where that is zero."""
    user: jax.Array | None
    """(D, C, U) the motion of the contact by the user's joints."""
    stiffness: jax.Array
    """(C,) D, the same for all edges of a pyramid."""
    reference: jax.Array
    """(D, C) r."""


@pytree.dataclass
class Problem(pytree.Node):
    """A contact problem."""

    user_inertia: jax.Array
    """(U, U) M of the user's joints."""
    slot_inertia: jax.Array
    """(6, 6, K) M of the slots."""
    free: Motion
    """a0, the acceleration without constraints."""
    rows: Rows | None
    """Constraints that are no contacts."""
    contacts: tuple[Contacts, ...]
    """By dimension."""


@pytree.dataclass
class Forces(pytree.Node):
    """Derivative of each row's cost: minus the force with which it acts."""

    rows: jax.Array | None
    """(R,)."""
    edges: tuple[jax.Array, ...]
    """(E, C) for each of the problem's contacts, E = 2 (D - 1) edges, 1 if D is 1."""


@pytree.dataclass
class Report(pytree.Node):
    """How a solution went: trouble is data."""

    residual: jax.Array
    """() norm of the gradient over the trace of the inertia, m/s^2; NaN where the
    world is no longer finite."""
    iterations: jax.Array
    """() int32, Newton steps taken."""


Slack = tuple[Any, tuple[jax.Array, ...]]
"""J a of the rows, (R,) or None, and of each kind of contacts, (D, C)."""


def _dot(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def _membership(slot: jax.Array, slots: jax.Array) -> jax.Array:
    """Return which contact (C,) acts on which of slots (..., K), (K, C) of 0 and 1."""
    index = jnp.arange(slots.shape[-1], dtype=slot.dtype)
    return (slot[None] == index[:, None]).astype(slots.dtype)


def apply_inertia(problem: Problem, motion: Motion) -> Motion:
    """Return M a."""
    inertia = problem.slot_inertia
    slots = jnp.zeros_like(motion.slots)
    for j in range(6):
        slots = slots + inertia[:, j] * motion.slots[j]
    return Motion(user=_dot(problem.user_inertia, motion.user), slots=slots)


def contact_motion(contacts: Contacts, motion: Motion) -> jax.Array:
    """Return J a of contacts, (D, C)."""
    total = jnp.zeros_like(contacts.reference)
    for slot, jacobian in contacts.sides:
        moving = _dot(motion.slots, _membership(slot, motion.slots))
        for j in range(6):
            total = total + jacobian[:, j] * moving[j]
    if contacts.user is not None:
        total = total + _dot(contacts.user, motion.user)
    return total


def apply_jacobian(problem: Problem, motion: Motion) -> Slack:
    """Return J a."""
    rows = None if problem.rows is None else _dot(problem.rows.jacobian, motion.user)
    return rows, tuple(contact_motion(c, motion) for c in problem.contacts)


def apply_transpose(problem: Problem, forces: Forces) -> Motion:
    """Return J' f."""
    user = jnp.zeros_like(problem.free.user)
    slots = jnp.zeros_like(problem.free.slots)
    if problem.rows is not None and forces.rows is not None:
        user = user + _dot(forces.rows, problem.rows.jacobian)
    for contacts, edges in zip(problem.contacts, forces.edges, strict=True):
        axes = _axes(edges)
        for slot, jacobian in contacts.sides:
            # Written out: a sum over a leading axis is slow on the CPU.
            wrench = jacobian[0] * axes[0]
            for d in range(1, len(axes)):
                wrench = wrench + jacobian[d] * axes[d]
            slots = slots + _dot(wrench, _membership(slot, slots).T)
        if contacts.user is not None:
            user = user + jnp.tensordot(
                axes, contacts.user, 2, precision=jax.lax.Precision.HIGHEST
            )
    return Motion(user=user, slots=slots)


def _edges(slack: jax.Array) -> jax.Array:
    """Return the edges (E, C) of pyramids with axes (D, C)."""
    if slack.shape[0] == 1:
        return slack
    normal, along = slack[:1], slack[1:]
    return jnp.concatenate([normal + along, normal - along])


def _axes(edges: jax.Array) -> jax.Array:
    """Return what forces on the edges (E, C) do along the axes, (D, C)."""
    if edges.shape[0] == 1:
        return edges
    plus, minus = jnp.split(edges, 2)
    normal = plus[:1] + minus[:1]
    for i in range(1, plus.shape[0]):
        normal = normal + plus[i : i + 1] + minus[i : i + 1]
    return jnp.concatenate([normal, plus - minus])


def _add(a: Any, b: Any, times: jax.Array | float = 1.0) -> Any:
    return jax.tree.map(lambda x, y: x + times * y, a, b)


def _total(terms: Any) -> jax.Array:
    leaves = [_sum(leaf) for leaf in jax.tree.leaves(terms) if leaf.size]
    return sum(leaves[1:], leaves[0])


def _sum(x: jax.Array) -> jax.Array:
    # Row by row, and behind a barrier, it is all vectors until the last sum.
    row = sum(x[1:], x[0]) if x.ndim > 1 else x
    return jnp.sum(jax.lax.optimization_barrier(row))


def _inner(a: Any, b: Any) -> jax.Array:
    return _total(jax.tree.map(jnp.multiply, a, b))


def _slack(problem: Problem, motion: Motion) -> Slack:
    """Return J a - r."""
    reference = (
        None if problem.rows is None else problem.rows.reference,
        tuple(c.reference for c in problem.contacts),
    )
    return _add(apply_jacobian(problem, motion), reference, -1.0)


def _clipped(rows: Rows, slack: jax.Array) -> jax.Array:
    return jnp.clip(rows.stiffness * slack, rows.lower, rows.upper)


def _bending(rows: Rows, slack: jax.Array) -> jax.Array:
    stretched = rows.stiffness * slack
    inside = (stretched > rows.lower) & (stretched < rows.upper)
    return jnp.where(inside, rows.stiffness, 0.0)


def row_forces(problem: Problem, slack: Slack) -> Forces:
    """Return the derivative of each row's cost at slack J a - r."""
    rows = problem.rows
    return Forces(
        rows=None if rows is None else _clipped(rows, slack[0]),
        edges=tuple(
            contacts.stiffness * jnp.minimum(_edges(x), 0.0)
            for contacts, x in zip(problem.contacts, slack[1], strict=True)
        ),
    )


def _row_cost(problem: Problem, slack: Slack, forces: Forces) -> jax.Array:
    """Return the cost of all rows."""
    total = []
    if problem.rows is not None and forces.rows is not None:
        own = forces.rows
        total.append(own * slack[0] - 0.5 * own * own / problem.rows.stiffness)
    for push, x in zip(forces.edges, slack[1], strict=True):
        # A contact's edge pushes by D x where x < 0: its cost is half of that times x.
        total.append(0.5 * push * _edges(x))
    return _total(total)


def _curvature(problem: Problem, slack: Slack) -> Forces:
    """Return the second derivative of each row's cost."""
    rows = problem.rows
    return Forces(
        rows=None if rows is None else _bending(rows, slack[0]),
        edges=tuple(
            jnp.where(_edges(x) < 0, contacts.stiffness, 0.0)
            for contacts, x in zip(problem.contacts, slack[1], strict=True)
        ),
    )


def _weigh(edges: jax.Array, parts: list[jax.Array]) -> list[jax.Array]:
    """Return W g: the edges' curvatures (E, C) as D x D matrices, times D parts."""
    if edges.shape[0] == 1:
        return [edges[0] * parts[0]]
    plus, minus = jnp.split(edges, 2)
    own, cross = plus + minus, plus - minus
    normal, found = jnp.zeros_like(parts[0]), []
    for i, part in enumerate(parts[1:]):
        normal = normal + own[i] * parts[0] + cross[i] * part
        found.append(cross[i] * parts[0] + own[i] * part)
    return [normal, *found]


def _outer(first: list[jax.Array], second: list[jax.Array]) -> jax.Array:
    """Return the sum over D of all products of (m, C) and (n, C), (m, n, C)."""
    terms = [a[:, None] * b[None] for a, b in zip(first, second, strict=True)]
    return sum(terms[1:], terms[0])


def _slot_blocks(problem: Problem, weight: Forces) -> jax.Array:
    """Return the part of J'DJ + M in which a slot meets itself, (6, 6, K)."""
    total = problem.slot_inertia
    for contacts, edges in zip(problem.contacts, weight.edges, strict=True):
        for slot, jacobian in contacts.sides:
            block = _outer(list(jacobian), _weigh(edges, list(jacobian)))
            total = total + _dot(block, _membership(slot, problem.slot_inertia).T)
    return total


def _user_block(problem: Problem, weight: Forces) -> jax.Array:
    """Return the part of J'DJ + M among the user's joints, (U, U)."""
    total = problem.user_inertia
    if problem.rows is not None and weight.rows is not None:
        jacobian = problem.rows.jacobian
        total = total + _dot(jacobian.T * weight.rows, jacobian)
    for contacts, edges in zip(problem.contacts, weight.edges, strict=True):
        if contacts.user is not None:
            own = [part.T for part in contacts.user]
            for a, b in zip(own, _weigh(edges, own), strict=True):
                total = total + _dot(a, b.T)
    return total


def _coupled(problem: Problem) -> bool:
    """Return whether there are contacts that could act on two of what moves."""
    return any(len(c.sides) + (c.user is not None) > 1 for c in problem.contacts)


def _hessian(problem: Problem, weight: Forces) -> jax.Array:
    """Return J'DJ + M, (V, V), the lower half: the user's joints, then the slots."""
    count, users = problem.slot_inertia.shape[-1], problem.free.user.shape[0]
    diagonal = jnp.moveaxis(_slot_blocks(problem, weight), -1, 0)
    # In the matrix's own layout: turning it would cost as much as factoring it.
    side = jnp.zeros((count, 6, count, 6), diagonal.dtype)
    mixed = jnp.zeros((users, 6, count), diagonal.dtype)
    index = jnp.arange(count)
    side = side.at[index, :, index].set(diagonal)
    for contacts, edges in zip(problem.contacts, weight.edges, strict=True):
        if len(contacts.sides) == 2:
            (a, first), (b, second) = contacts.sides
            later = a > b
            row, column = jnp.maximum(a, b), jnp.minimum(a, b)
            lower = jnp.where(later, first, second)
            upper = jnp.where(later, second, first)
            block = _outer(list(lower), _weigh(edges, list(upper)))
            # What acts on one slot only is out of range, and dropped.
            block = jnp.moveaxis(block, -1, 0)
            side = side.at[row, :, column].add(block, mode="drop")
        if contacts.user is not None:
            own = [part.T for part in contacts.user]
            for slot, jacobian in contacts.sides:
                block = _outer(own, _weigh(edges, list(jacobian)))
                mixed = mixed + _dot(block, _membership(slot, problem.slot_inertia).T)
    side = side.reshape(6 * count, 6 * count)
    if not users:
        return side
    cross = mixed.transpose(0, 2, 1).reshape(users, 6 * count)
    return jnp.block(
        [[_user_block(problem, weight), jnp.zeros_like(cross)], [cross.T, side]]
    )


def _flat(motion: Motion) -> jax.Array:
    return jnp.concatenate([motion.user, motion.slots.T.reshape(-1)])


def _divide(problem: Problem, weight: Forces, right: Motion) -> Motion:
    """Divide by the Hessian J'DJ + M."""
    if not _coupled(problem):
        return _divide_apart(problem, weight, right)
    # What could couple the slots does not in most steps: nothing of it pushes.
    couples = graph.anywhere(_couples(problem, weight))
    return jax.lax.cond(
        couples, _divide_together, _divide_apart, problem, weight, right
    )


def _couples(problem: Problem, weight: Forces) -> jax.Array:
    """Return whether a contact with weight acts on two of what moves, () bool."""
    count, found = problem.slot_inertia.shape[-1], []
    for contacts, edges in zip(problem.contacts, weight.edges, strict=True):
        acts = [slot < count for slot, _ in contacts.sides]
        if contacts.user is not None:
            acts.append(jnp.any(contacts.user != 0, axis=(0, 2)))
        for a, b in itertools.combinations(acts, 2):
            found.append(jnp.any(a & b & jnp.any(edges > 0, axis=0)))
    return functools.reduce(jnp.logical_or, found)


def _divide_together(problem: Problem, weight: Forces, right: Motion) -> Motion:
    users, count = right.user.shape[0], right.slots.shape[1]
    factor = _lower(_hessian(problem, weight))
    flat = jax.scipy.linalg.cho_solve((factor, True), _flat(right))
    return Motion(user=flat[:users], slots=flat[users:].reshape(count, 6).T)


def _divide_apart(problem: Problem, weight: Forces, right: Motion) -> Motion:
    user = right.user
    if user.shape[0]:
        factor = _lower(_user_block(problem, weight))
        user = jax.scipy.linalg.cho_solve((factor, True), user)
    blocks = _slot_blocks(problem, weight)
    return Motion(user=user, slots=divide_blocks(blocks, right.slots))


def _lower(matrix: jax.Array) -> jax.Array:
    # As the routine has it: the upper one would be turned twice.
    return jax.scipy.linalg.cho_factor(matrix, lower=True)[0]


def divide_blocks(blocks: jax.Array, right: jax.Array) -> jax.Array:
    """Solve K systems at once: (6, 6, K) and (6, K)."""
    return _substitute(_cholesky(blocks), right)


def _cholesky(blocks: jax.Array) -> list[jax.Array]:
    """Factor (6, 6, K): columns of L, each (6, K), with its diagonal's inverse."""
    columns = []
    for j in range(6):
        scale = jax.lax.rsqrt(blocks[j, j])
        column = blocks[:, j] * scale
        blocks = blocks - column[:, None] * column[None]
        columns.append(jnp.concatenate([column, scale[None]]))
    return columns


def _substitute(columns: list[jax.Array], right: jax.Array) -> jax.Array:
    """Solve L L' x = right (6, K)."""
    forward, back = [], [jnp.zeros_like(right[0])] * 6
    for j in range(6):
        y = right[j] * columns[j][6]
        right = right - columns[j][:6] * y
        forward.append(y)
    for j in reversed(range(6)):
        rest = forward[j]
        for i in range(j + 1, 6):
            rest = rest - columns[j][i] * back[i]
        back[j] = rest * columns[j][6]
    return jnp.stack(back)


def _search(
    problem: Problem,
    slack: Slack,
    slope: jax.Array,
    along: Slack,
    curve: jax.Array,
    enough: jax.Array,
    steps: int,
) -> jax.Array:
    """Return the step length that minimises along a direction.

    The derivative is piecewise linear and rising, so Newton's method finds its zero
    exactly once it is on the right piece; a bracket keeps it from cycling. It ends once
    the derivative is no larger than `enough`.
    """

    def derivative(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        moved = _add(slack, along, t)
        first, second = [], []
        if problem.rows is not None:
            x, ahead = moved[0], along[0]
            first.append(_clipped(problem.rows, x) * ahead)
            second.append(_bending(problem.rows, x) * ahead * ahead)
        for contacts, x, step in zip(problem.contacts, moved[1], along[1], strict=True):
            edge, ahead = _edges(x), _edges(step)
            pushed = jnp.where(edge < 0, contacts.stiffness * ahead, 0.0)
            first.append(pushed * edge)
            second.append(pushed * ahead)
        return slope + t * curve + _total(first), curve + _total(second)

    def running(carry: tuple[Any, ...]) -> jax.Array:
        return (carry[0] < steps) & (carry[5] > enough)

    def body(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        count, t, low, high, best, least = carry
        first, second = derivative(t)
        # Rounding may push the last guess off the right piece: keep the best one.
        closer = jnp.abs(first) < least
        best, least = jnp.where(closer, t, best), jnp.minimum(jnp.abs(first), least)
        low = jnp.where(first < 0, t, low)
        high = jnp.where(first >= 0, jnp.minimum(t, high), high)
        guess = t - first / second
        bisect = jnp.where(jnp.isinf(high), 2 * t + 1, 0.5 * (low + high))
        guess = jnp.where((guess >= low) & (guess <= high), guess, bisect)
        return count + 1, guess, low, high, best, least

    one, zero = jnp.ones_like(slope), jnp.zeros_like(slope)
    endless = jnp.full_like(slope, jnp.inf)
    carry = (jnp.zeros((), jnp.int32), one, zero, endless, one, endless)
    return jax.lax.while_loop(running, body, carry)[4]


_SEARCHED = 1e-3
"""A line search ends once the derivative has fallen to this part of what it was."""
_STUCK = 0.25
"""A gradient that a whole step on one piece leaves at this part of it is rounding."""


def _newton(
    problem: Problem,
    guess: Motion,
    tolerance: jax.Array,
    iterations: int,
    search_steps: int,
) -> tuple[Motion, jax.Array]:
    def measure(a: Motion, slack: Slack) -> tuple[jax.Array, Motion]:
        """Return cost and gradient."""
        off, forces = _add(a, problem.free, -1.0), row_forces(problem, slack)
        held = apply_inertia(problem, off)
        cost = 0.5 * _inner(off, held) + _row_cost(problem, slack, forces)
        return cost, _add(held, apply_transpose(problem, forces))

    scale = 1.0 / _trace(problem)

    def running(carry: Any) -> jax.Array:
        return (carry[-2] < iterations) & ~carry[-1]

    def body(carry: Any) -> Any:
        a, slack, value, grad, count, _ = carry
        weight = _curvature(problem, slack)
        step = _divide(problem, weight, grad)
        step = jax.tree.map(jnp.negative, step)
        along = apply_jacobian(problem, step)
        pushed = apply_inertia(problem, step)
        t = _search(
            problem,
            slack,
            _inner(_add(a, problem.free, -1.0), pushed),
            along,
            _inner(step, pushed),
            # The derivative at the start of the line, without looking at the rows.
            _SEARCHED * jnp.abs(_inner(step, grad)),
            search_steps,
        )
        moved, moved_slack = _add(a, step, t), _add(slack, along, t)
        moved_value, moved_grad = measure(moved, moved_slack)
        gain = value - moved_value
        left, before = _norm(moved_grad), _norm(grad)
        # Close to the minimum the cost is all rounding; the gradient still tells.
        better = (gain > 0) | (left < before)
        same = _same(weight, _curvature(problem, moved_slack))
        done = ~better | (gain * scale < tolerance) | (left * scale < tolerance)
        done = done | (same & (left > _STUCK * before))
        kept = jax.tree.map(
            functools.partial(jnp.where, better),
            (moved, moved_slack, moved_value, moved_grad),
            (a, slack, value, grad),
        )
        return *kept, count + 1, done

    def begin(a: Motion) -> Any:
        slack = _slack(problem, a)
        return a, slack, *measure(a, slack)

    # A loop of two: as fast as one after the other, and compiled once.
    starts = jax.tree.map(lambda *x: jnp.stack(x), guess, problem.free)
    both = jax.lax.map(begin, starts)
    start = jax.tree.map(lambda x: jnp.where(both[2][0] < both[2][1], x[0], x[1]), both)
    done = _norm(start[3]) * scale < tolerance
    carry = (*start, jnp.zeros((), jnp.int32), done)
    found = jax.lax.while_loop(running, body, carry)
    return found[0], found[4]


def _norm(motion: Motion) -> jax.Array:
    return jnp.sqrt(_inner(motion, motion))


def _trace(problem: Problem) -> jax.Array:
    slots = sum(jnp.sum(problem.slot_inertia[j, j]) for j in range(6))
    return slots + jnp.trace(problem.user_inertia)


def _same(a: Forces, b: Forces) -> jax.Array:
    """Return whether two curvatures are equal, () bool."""
    equal = [
        jnp.all(x == y) for x, y in zip(*map(jax.tree.leaves, (a, b)), strict=True)
    ]
    return functools.reduce(jnp.logical_and, equal)


@functools.partial(jax.custom_jvp, nondiff_argnums=(3, 4))
def minimize(
    problem: Problem,
    guess: Motion,
    tolerance: jax.Array,
    iterations: int,
    search_steps: int,
) -> tuple[Motion, jax.Array]:
    """Solve a contact problem.

    Args:
      problem: the problem; it has rows or contacts.
      guess: where to start, if that is better than the free acceleration.
      tolerance: () stop once the gain or the gradient over the trace of M is below.
      iterations: at most this many Newton steps.
      search_steps: steps of each line search.

    Returns:
      The acceleration and the number of Newton steps taken. Differentiable, forward
      and reverse, in the problem; not in guess and tolerance.
    """
    return _newton(problem, guess, tolerance, iterations, search_steps)


@minimize.defjvp
def _minimize_jvp(
    iterations: int, search_steps: int, primals: Any, tangents: Any
) -> Any:
    problem, guess, tolerance = primals
    a, count = minimize(problem, guess, tolerance, iterations, search_steps)

    def stationarity(problem: Problem) -> Motion:
        forces = row_forces(problem, _slack(problem, a))
        held = apply_inertia(problem, _add(a, problem.free, -1.0))
        return _add(held, apply_transpose(problem, forces))

    weight = _curvature(problem, _slack(problem, a))

    def hessian_times(v: Motion) -> Motion:
        rows, contacts = apply_jacobian(problem, v)
        bent = Forces(
            rows=None if weight.rows is None else weight.rows * rows,
            edges=tuple(
                w * _edges(x) for w, x in zip(weight.edges, contacts, strict=True)
            ),
        )
        return _add(apply_inertia(problem, v), apply_transpose(problem, bent))

    _, change = jax.jvp(stationarity, (problem,), (tangents[0],))
    tangent = jax.lax.custom_linear_solve(
        hessian_times,
        jax.tree.map(jnp.negative, change),
        solve=lambda _, right: _divide(problem, weight, right),
        symmetric=True,
    )
    return (a, count), (tangent, np.zeros((), jax.dtypes.float0))


def solve(
    problem: Problem,
    guess: Motion,
    tolerance: jax.Array,
    *,
    iterations: int,
    search_steps: int,
) -> tuple[Motion, Forces, Motion, Report]:
    """Solve a contact problem: see `minimize`.

    Returns:
      The acceleration, the force of each row, their sum J' f and a Report.
    """
    guess, tolerance = jax.lax.stop_gradient((guess, tolerance))
    a, count = minimize(problem, guess, tolerance, iterations, search_steps)
    forces = row_forces(problem, _slack(problem, a))
    forces = jax.tree.map(jnp.negative, forces)
    pull = apply_transpose(problem, forces)
    held = apply_inertia(problem, _add(a, problem.free, -1.0))
    rest = jax.lax.stop_gradient(_add(held, pull, -1.0))
    residual = _norm(rest) / jax.lax.stop_gradient(_trace(problem))
    return a, forces, pull, Report(residual=residual, iterations=count)
