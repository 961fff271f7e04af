"""Fracture in continuous time: bonds wear down and break at a moment of their own.

A step that breaks bonds at its end moves no moment of fracture when a parameter moves,
so its derivative misses it. Here the moment at which a health reaches zero is found
inside the step, the motion goes on from there without the bond, and the moment is
differentiated implicitly: dt/dp = -(dh/dp) / (dh/dt). What follows inherits it, which
the literature on hybrid systems calls saltation (Kong et al. 2023).
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from blastjax import pytree

Motion = Callable[[jax.Array, Any, jax.Array], tuple[Any, jax.Array]]
"""Of time, y and bonds intact (B,): dy/dt as y, and damage rates (B,), health/s."""


@pytree.dataclass
class Evolution(pytree.Node):
    """Where a motion with fracture ended."""

    time: jax.Array
    """() s."""
    y: Any
    """What moves, as the user gave it."""
    health: jax.Array
    """(B,) health of bonds, 0 once broken."""
    intact: jax.Array
    """(B,) bool, bonds that hold."""
    break_time: jax.Array
    """(B,) moment at which the bond broke, s; infinite if it did not."""
    late: jax.Array
    """() int32 bonds that broke at the end of their step, not at their moment, since
    the step had no crossings left. Their derivative misses the moment: raise
    `crossings` or `steps` if not 0."""


def evolve(
    motion: Motion,
    y: Any,
    health: jax.Array,
    intact: jax.Array | None = None,
    *,
    duration: float | jax.Array,
    steps: int,
    crossings: int = 2,
    start: float | jax.Array = 0.0,
) -> Evolution:
    """Integrate a motion whose damage breaks bonds at their moment.

    Args:
      motion: time, y and intact bonds to dy/dt and damage rates. Smooth while no bond
        breaks. Rates below zero count as none, and broken bonds take no damage.
      y: any pytree of real arrays.
      health: (B,) health at the start. Infinite ones never break.
      intact: (B,) bool, bonds that hold at the start; by default all with health.
      duration: time to integrate, s.
      steps: Runge-Kutta steps (fourth order) of equal length.
      crossings: moments of fracture that a step can have. Bonds that break at the same
        moment share one.
      start: time at the start, s.

    Returns:
      An Evolution. Forward and reverse derivatives of y, healths and moments, exact for
      the discretised motion: moments move with what decides them. Misses: changes of
      the order in which bonds break, and of whether a bond breaks at all.

    Raises:
      ValueError: `steps` or `crossings` is below 1.
    """
    for name, count in (("steps", steps), ("crossings", crossings)):
        if count < 1:
            raise ValueError(f"{name} is {count}; give 1 or more")
    dtype = health.dtype
    intact = health > 0 if intact is None else intact
    begin = Evolution(
        time=jnp.asarray(start, dtype),
        y=y,
        health=health,
        intact=intact,
        break_time=jnp.full(health.shape, jnp.inf, dtype),
        late=jnp.zeros((), jnp.int32),
    )
    length = jnp.asarray(duration, dtype) / steps

    def step(now: Evolution, _: None) -> tuple[Evolution, None]:
        left = length
        for _crossing in range(crossings):
            now, left = _to_crossing(motion, now, left)
        return _to_end(motion, now, left), None

    return jax.lax.scan(step, begin, None, length=steps)[0]


def _advance(
    motion: Motion, now: Evolution, length: jax.Array
) -> tuple[Any, jax.Array]:
    """Return y and health (B,) one Runge-Kutta step later, bonds unchanged."""

    def slope(time: jax.Array, y: Any) -> tuple[Any, jax.Array]:
        speed, rate = motion(time, y, now.intact)
        return speed, -jnp.where(now.intact, jnp.maximum(rate, 0), 0)

    def moved(rate: Any, dt: jax.Array) -> Any:
        return jax.tree.map(lambda a, b: a + dt * b, now.y, rate)

    half = 0.5 * length
    one = slope(now.time, now.y)
    two = slope(now.time + half, moved(one[0], half))
    three = slope(now.time + half, moved(two[0], half))
    four = slope(now.time + length, moved(three[0], length))
    total = jax.tree.map(
        lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, one, two, three, four
    )
    finite = jnp.isfinite(now.health)
    lost = jnp.where(finite, length * total[1], 0)
    return moved(total[0], length), now.health + lost


def _to_crossing(
    motion: Motion, now: Evolution, left: jax.Array
) -> tuple[Evolution, jax.Array]:
    """Advance to the first crossing within the time left, or not at all."""
    fixed = jax.lax.stop_gradient(now)
    span = jax.lax.stop_gradient(left)
    after = _advance(motion, fixed, span)[1]
    crosses = jnp.any(fixed.intact & (after <= 0))

    def halve(_: int, bracket: tuple[jax.Array, jax.Array]) -> Any:
        low, high = bracket
        middle = 0.5 * (low + high)
        broken = jnp.any(fixed.intact & (_advance(motion, fixed, middle)[1] <= 0))
        return jnp.where(broken, low, middle), jnp.where(broken, middle, high)

    digits = 1 + jnp.finfo(now.health.dtype).nmant
    bracket = jnp.zeros_like(span), span
    high = jax.lax.fori_loop(0, digits, halve, bracket)[1]
    reached = _advance(motion, fixed, high)[1]
    broken = fixed.intact & (reached <= 0) & crosses
    first = jnp.argmin(jnp.where(fixed.intact, reached, jnp.inf))

    # One Newton step from a constant: its value stays put, its derivative is that of
    # the implicit function.
    def health(length: jax.Array) -> jax.Array:
        return _advance(motion, now, length)[1][first]

    value, speed = jax.jvp(health, (high,), (jnp.ones_like(high),))
    speed = jax.lax.stop_gradient(speed)
    falling = crosses & (speed < 0)
    shift = jnp.where(falling, value / jnp.where(falling, speed, -1), 0)
    moment = high - (shift - jax.lax.stop_gradient(shift))
    length = jnp.where(crosses, moment, 0)

    y, healths = _advance(motion, now, length)
    time = now.time + length
    now = now.replace(
        time=time,
        y=y,
        health=jnp.where(broken, 0, healths),
        intact=now.intact & ~broken,
        break_time=jnp.where(broken, time, now.break_time),
    )
    return now, left - length


def _to_end(motion: Motion, now: Evolution, left: jax.Array) -> Evolution:
    """Advance over the time left, and break what has no health at its end."""
    y, health = _advance(motion, now, left)
    time = now.time + left
    broken = now.intact & (health <= 0)
    return Evolution(
        time=time,
        y=y,
        health=jnp.where(broken, 0, health),
        intact=now.intact & ~broken,
        break_time=jnp.where(broken, jax.lax.stop_gradient(time), now.break_time),
        late=now.late + jnp.sum(broken, dtype=jnp.int32),
    )
