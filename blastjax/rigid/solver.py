"""The contact problem, by Newton's method, with a derivative at any iteration count.

Constrained acceleration minimises a strictly convex function,

    1/2 (a - a0)' M (a - a0) + sum_i s_i(J_i a - r_i),  s_i'(x) = clip(D_i x, l_i, u_i),

the one that MuJoCo's own solvers minimise (Todorov 2014) with pyramidal friction: the
bounds (-inf, inf) make an equality, (-f, f) dry friction, (-inf, 0) a contact or limit.
The derivative of the minimiser comes from the implicit function theorem, so forward and
reverse mode work however many iterations the solution took.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from blastjax import pytree


@pytree.dataclass
class Problem(pytree.Node):
    """A contact problem of V unknowns and R rows."""

    inertia: jax.Array
    """(V, V) M, joint-space inertia."""
    free: jax.Array
    """(V,) a0, the acceleration without constraints."""
    jacobian: jax.Array
    """(R, V) J."""
    stiffness: jax.Array
    """(R,) D, inverse of each row's regularisation."""
    reference: jax.Array
    """(R,) r, the acceleration each row asks for."""
    lower: jax.Array
    """(R,) least derivative of the row's cost, N or N m."""
    upper: jax.Array
    """(R,) greatest derivative of the row's cost, N or N m."""


@pytree.dataclass
class Report(pytree.Node):
    """How a solution went: trouble is data."""

    residual: jax.Array
    """() norm of the gradient over the trace of the inertia, m/s^2."""
    iterations: jax.Array
    """() int32, Newton steps taken."""


def row_force(problem: Problem, slack: jax.Array) -> jax.Array:
    """Return the derivative of each row's cost at slack J a - r, (R,)."""
    return jnp.clip(problem.stiffness * slack, problem.lower, problem.upper)


def _row_cost(problem: Problem, slack: jax.Array) -> jax.Array:
    force = row_force(problem, slack)
    return jnp.sum(force * slack - 0.5 * force * force / problem.stiffness)


def _curvature(problem: Problem, slack: jax.Array) -> jax.Array:
    stretched = problem.stiffness * slack
    inside = (stretched > problem.lower) & (stretched < problem.upper)
    return jnp.where(inside, problem.stiffness, 0.0)


def _hessian(problem: Problem, weight: jax.Array) -> jax.Array:
    return problem.inertia + (problem.jacobian.T * weight) @ problem.jacobian


def _search(
    problem: Problem,
    slack: jax.Array,
    slope: jax.Array,
    along: jax.Array,
    curve: jax.Array,
    steps: int,
) -> jax.Array:
    """Return the step length that minimises along a direction.

    The derivative is piecewise linear and rising, so Newton's method finds its zero
    exactly once it is on the right piece; a bracket keeps it from cycling.
    """

    def derivative(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        moved = slack + t * along
        first = slope + t * curve + jnp.sum(row_force(problem, moved) * along)
        return first, curve + jnp.sum(_curvature(problem, moved) * along * along)

    def body(_: int, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        t, low, high, best, least = carry
        first, second = derivative(t)
        # Rounding may push the last guess off the right piece: keep the best one.
        closer = jnp.abs(first) < least
        best, least = jnp.where(closer, t, best), jnp.minimum(jnp.abs(first), least)
        low = jnp.where(first < 0, t, low)
        high = jnp.where(first >= 0, jnp.minimum(t, high), high)
        guess = t - first / second
        bisect = jnp.where(jnp.isinf(high), 2 * t + 1, 0.5 * (low + high))
        guess = jnp.where((guess >= low) & (guess <= high), guess, bisect)
        return guess, low, high, best, least

    one, zero = jnp.ones_like(slope), jnp.zeros_like(slope)
    endless = jnp.full_like(slope, jnp.inf)
    start = (one, zero, endless, one, endless)
    return jax.lax.fori_loop(0, steps, body, start)[3]


def _newton(
    problem: Problem,
    guess: jax.Array,
    tolerance: jax.Array,
    iterations: int,
    search_steps: int,
) -> tuple[jax.Array, jax.Array]:
    def cost(a: jax.Array, slack: jax.Array) -> jax.Array:
        off = a - problem.free
        return 0.5 * off @ (problem.inertia @ off) + _row_cost(problem, slack)

    def slack_at(a: jax.Array) -> jax.Array:
        return problem.jacobian @ a - problem.reference

    def gradient(a: jax.Array, slack: jax.Array) -> jax.Array:
        pull = problem.jacobian.T @ row_force(problem, slack)
        return problem.inertia @ (a - problem.free) + pull

    scale = 1.0 / jnp.trace(problem.inertia)

    def running(carry: Any) -> jax.Array:
        return (carry[-2] < iterations) & ~carry[-1]

    def body(carry: Any) -> Any:
        a, slack, value, grad, count, _ = carry
        factor = jax.scipy.linalg.cho_factor(
            _hessian(problem, _curvature(problem, slack))
        )
        step = -jax.scipy.linalg.cho_solve(factor, grad)
        along = problem.jacobian @ step
        pushed = problem.inertia @ step
        t = _search(
            problem,
            slack,
            (a - problem.free) @ pushed,
            along,
            step @ pushed,
            search_steps,
        )
        moved, moved_slack = a + t * step, slack + t * along
        moved_value = cost(moved, moved_slack)
        moved_grad = gradient(moved, moved_slack)
        gain, left = value - moved_value, jnp.linalg.norm(moved_grad)
        # Close to the minimum the cost is all rounding; the gradient still tells.
        better = (gain > 0) | (left < jnp.linalg.norm(grad))
        done = ~better | (gain * scale < tolerance) | (left * scale < tolerance)
        keep = functools.partial(jnp.where, better)
        return (
            keep(moved, a),
            keep(moved_slack, slack),
            keep(moved_value, value),
            keep(moved_grad, grad),
            count + 1,
            done,
        )

    warm_slack, free_slack = slack_at(guess), slack_at(problem.free)
    warm = cost(guess, warm_slack) < cost(problem.free, free_slack)
    a = jnp.where(warm, guess, problem.free)
    slack = jnp.where(warm, warm_slack, free_slack)
    grad = gradient(a, slack)
    done = jnp.linalg.norm(grad) * scale < tolerance
    start = (a, slack, cost(a, slack), grad, jnp.zeros((), jnp.int32), done)
    found = jax.lax.while_loop(running, body, start)
    return found[0], found[4]


@functools.partial(jax.custom_jvp, nondiff_argnums=(3, 4))
def minimize(
    problem: Problem,
    guess: jax.Array,
    tolerance: jax.Array,
    iterations: int,
    search_steps: int,
) -> tuple[jax.Array, jax.Array]:
    """Solve a contact problem.

    Args:
      problem: the problem.
      guess: (V,) where to start, if that is better than the free acceleration.
      tolerance: () stop once the gain or the gradient over the trace of M is below.
      iterations: at most this many Newton steps.
      search_steps: steps of each line search.

    Returns:
      The acceleration (V,) and the number of Newton steps taken. Differentiable,
      forward and reverse, in the problem; not in guess and tolerance.
    """
    return _newton(problem, guess, tolerance, iterations, search_steps)


@minimize.defjvp
def _minimize_jvp(
    iterations: int, search_steps: int, primals: Any, tangents: Any
) -> Any:
    problem, guess, tolerance = primals
    a, count = minimize(problem, guess, tolerance, iterations, search_steps)

    def stationarity(problem: Problem) -> jax.Array:
        slack = problem.jacobian @ a - problem.reference
        pull = problem.jacobian.T @ row_force(problem, slack)
        return problem.inertia @ (a - problem.free) + pull

    weight = _curvature(problem, problem.jacobian @ a - problem.reference)

    def hessian_times(v: jax.Array) -> jax.Array:
        return problem.inertia @ v + problem.jacobian.T @ (
            weight * (problem.jacobian @ v)
        )

    factor = jax.scipy.linalg.cho_factor(_hessian(problem, weight))
    _, change = jax.jvp(stationarity, (problem,), (tangents[0],))
    tangent = jax.lax.custom_linear_solve(
        hessian_times,
        -change,
        solve=lambda _, right: jax.scipy.linalg.cho_solve(factor, right),
        symmetric=True,
    )
    return (a, count), (tangent, np.zeros((), jax.dtypes.float0))


def solve(
    problem: Problem,
    guess: jax.Array,
    tolerance: jax.Array,
    *,
    iterations: int,
    search_steps: int,
) -> tuple[jax.Array, jax.Array, Report]:
    """Solve a contact problem: see `minimize`.

    Returns:
      The acceleration (V,), the force of each row (R,) and a Report.
    """
    guess, tolerance = jax.lax.stop_gradient((guess, tolerance))
    a, count = minimize(problem, guess, tolerance, iterations, search_steps)
    force = row_force(problem, problem.jacobian @ a - problem.reference)
    rest = problem.inertia @ (a - problem.free) + problem.jacobian.T @ force
    residual = jnp.linalg.norm(jax.lax.stop_gradient(rest))
    scale = jnp.trace(jax.lax.stop_gradient(problem.inertia))
    return a, -force, Report(residual=residual / scale, iterations=count)
