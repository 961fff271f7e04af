"""Expected outcomes when the strength of bonds is random.

No two bricks are equally strong. If the strength of each bond is a random variable, the
mean of any loss of what is left is a smooth function of healths and damage, although
every single outcome is a jump. Two estimators of its derivative, both unbiased:

- the score function with a leave-one-out baseline (`expect`), the better one per run
  of the loss; its relative error falls as 1 / sqrt(samples). The baseline is a linear
  fit of the loss to which bonds survived, whose own share of the derivative is known
  without noise. Below 16 samples, and where the derivative nearly vanishes, it is
  mostly noise: look at its error;
- flips of one bond at a time (`expect_by_flips`), a check by other means, which runs
  the loss once more for every bond.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from blastjax import fracture, pytree
from blastjax.core import Asset, Damage, State

Strength = Callable[[jax.Array, jax.Array], jax.Array]
"""Of health and damage (B,) each: log odds that the bond survives, (B,)."""
Act = Callable[[Any], tuple[State, Damage]]
"""Of parameters: the state before, and the damage to it."""
Loss = Callable[[State, Any], jax.Array]
"""Of the state after and parameters: a scalar."""


@pytree.dataclass
class Expectation(pytree.Node):
    """An estimated mean and its derivative, with their standard errors."""

    value: jax.Array
    """() mean loss."""
    value_error: jax.Array
    """() standard error of `value`."""
    gradient: Any
    """As the parameters: derivative of the mean loss."""
    gradient_error: Any
    """As the parameters: standard error of each entry of `gradient`."""


def logistic(temperature: float | jax.Array = 0.1) -> Strength:
    """Return bonds whose health is off by a logistic random amount.

    A bond survives with probability sigmoid((health - damage) / temperature), whether
    it was hit or not. The temperature is the scale of the distribution, health.
    Log odds are differentiable in health, damage and temperature.
    """

    def log_odds(health: jax.Array, damage: jax.Array) -> jax.Array:
        return (health - damage) / jnp.asarray(temperature, health.dtype)

    return log_odds


def weibull(shape: float | jax.Array = 5.0) -> Strength:
    """Return bonds whose strength is Weibull distributed with mean `health`.

    A bond survives with probability exp(-(damage gamma(1 + 1 / shape) / health)^shape);
    what was not hit survives. A high shape is a reliable material (ceramics 5 to 20).
    Each event draws anew: that a bond withstood an earlier one is not remembered. Log
    odds are differentiable in health, damage and shape, where there is damage.
    """

    def log_odds(health: jax.Array, damage: jax.Array) -> jax.Array:
        power = jnp.asarray(shape, health.dtype)
        hit = (damage > 0) & (health > 0)
        # No quotient: of a huge health it would be zero, and its logarithm infinite.
        scaled = jnp.log(jnp.where(hit, damage, 1)) - jnp.log(jnp.where(hit, health, 1))
        scaled = scaled + jax.scipy.special.gammaln(1 + 1 / power)
        # Beyond these the outcome is certain to more digits than any float has.
        log_hazard = jnp.clip(power * scaled, -60.0, 4.0)
        hazard = jnp.exp(jnp.maximum(log_hazard, -10.0))
        odds = -jnp.log(jnp.expm1(hazard))
        odds = jnp.where(log_hazard < -10.0, -log_hazard, odds)
        return jnp.where(hit, odds, jnp.inf)

    return log_odds


def expect(
    asset: Asset,
    act: Act,
    loss: Loss,
    parameters: Any,
    key: jax.Array,
    samples: int,
    *,
    strength: Strength | None = None,
) -> Expectation:
    """Estimate the mean loss after damage to bonds of random strength.

    Args:
      asset: the asset.
      act: parameters to the state before and the damage to it. Differentiated.
      loss: the state after, split, and parameters, to a scalar. Bonds that survive
        keep the health that damage leaves them on average, zero at least.
      parameters: any pytree of real arrays: what to differentiate by.
      key: a random key.
      samples: runs of the loss, 2 or more.
      strength: how strong bonds are; by default `logistic()`.

    Returns:
      An Expectation. Its gradient is unbiased: the leave-one-out score function (Kool
      et al. 2019, here with a ridge regression instead of the mean) for which bonds
      survive, plus the loss's own derivative at given survivors. Misses: damage to
      chunks, which is not random.

    Raises:
      ValueError: `samples` is below 2.
    """
    if samples < 2:
        raise ValueError(f"samples is {samples}; a baseline needs two or more")
    odds, pull, uncertain = _odds(asset, act, parameters, strength or logistic())
    p = jax.nn.sigmoid(odds)
    alive = jax.random.uniform(key, (samples, *p.shape), p.dtype) < p[None]

    def run(alive: jax.Array, parameters: Any) -> jax.Array:
        return _run(asset, act, loss, alive, parameters)

    value, pathwise = jax.vmap(jax.value_and_grad(run, argnums=1), (0, None))(
        alive, parameters
    )
    off = jnp.where(uncertain[None], alive.astype(p.dtype) - p[None], 0)
    variance = jnp.where(uncertain, p * (1 - p), 0)
    advantage, slope = _leave_one_out(off, value.astype(p.dtype), variance)
    # What the fit explains has a derivative of its own, which needs no draw.
    score = advantage[:, None] * off + slope * variance[None]
    return _summary(value, _add(jax.vmap(pull)(score.astype(odds.dtype)), pathwise))


def _leave_one_out(
    off: jax.Array, value: jax.Array, variance: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Fit values linearly, each sample by all others: independent of it, so no bias.

    Args:
      off: (K, B) survival of bonds less its probability.
      value: (K,) what to fit.
      variance: (B,) of `off`. The ridge is half of its sum, and one: shrinking all
        gains alike makes few samples of many bonds no worse than their mean alone, and
        without the one, what a sample of rare breaks leaves unexplained would be a
        difference of equal numbers.

    Returns:
      (K,) values less their fit, and (K, B) the slopes of each sample's fit.
    """
    samples, bonds = off.shape
    # With the means taken off, the constant of the fit is left out of the ridge.
    off = off - jnp.mean(off, axis=0, keepdims=True)
    value = value - jnp.mean(value)
    ridge = jnp.sum(variance) / 2 + 1
    # off (off' off + ridge)^-1 by the smaller of its two equal forms.
    if bonds <= samples:
        gram = off.T @ off + ridge * jnp.eye(bonds, dtype=off.dtype)
        lever = jax.scipy.linalg.solve(gram, off.T, assume_a="pos").T
    else:
        gram = off @ off.T + ridge * jnp.eye(samples, dtype=off.dtype)
        lever = jax.scipy.linalg.solve(gram, off, assume_a="pos")
    slope = value @ lever
    own = 1 / samples + jnp.sum(lever * off, axis=1)
    left = (value - off @ slope) / (1 - own)
    return left, slope[None] - left[:, None] * lever


def expect_by_flips(
    asset: Asset,
    act: Act,
    loss: Loss,
    parameters: Any,
    key: jax.Array,
    samples: int,
    *,
    strength: Strength | None = None,
) -> Expectation:
    """Estimate what `expect` does, by flipping each bond of every sample.

    Runs the loss samples (B + 1) times. The derivative by the log odds of a bond is
    p (1 - p) E[loss with it - loss without it]: unbiased, and independent of `expect`.

    Args:
      asset: the asset.
      act: see `expect`.
      loss: see `expect`.
      parameters: see `expect`.
      key: a random key.
      samples: draws, 2 or more.
      strength: see `expect`.

    Returns:
      An Expectation; the gradient is unbiased, with the gaps of `expect`.

    Raises:
      ValueError: `samples` is below 2.
    """
    if samples < 2:
        raise ValueError(f"samples is {samples}; an error needs two or more")
    odds, pull, uncertain = _odds(asset, act, parameters, strength or logistic())
    p = jax.nn.sigmoid(odds)
    alive = jax.random.uniform(key, (samples, *p.shape), p.dtype) < p[None]
    bonds = jnp.arange(p.shape[0], dtype=jnp.int32)

    def run(alive: jax.Array, parameters: Any) -> jax.Array:
        return _run(asset, act, loss, alive, parameters)

    def one(alive: jax.Array) -> tuple[jax.Array, Any]:
        value, pathwise = jax.value_and_grad(run, argnums=1)(alive, parameters)
        other = jax.vmap(lambda bond: run(alive ^ (bonds == bond), parameters))(bonds)
        gain = jnp.where(alive, value - other, other - value)
        slope = jnp.where(uncertain, p * (1 - p) * gain, 0).astype(odds.dtype)
        return value, _add(pull(slope), pathwise)

    return _summary(*jax.lax.map(one, alive))


def _odds(
    asset: Asset, act: Act, parameters: Any, strength: Strength
) -> tuple[jax.Array, Callable[[jax.Array], Any], jax.Array]:
    """Return log odds of survival (B,), their pullback, and which bonds are random."""

    def log_odds(parameters: Any) -> tuple[jax.Array, jax.Array]:
        state, taken = _struck(asset, *act(parameters))
        uncertain = _breakable(state)
        health = jnp.where(uncertain, state.bond_health, 1)
        odds = strength(health, jnp.where(uncertain, taken, 0))
        fixed = jnp.where(state.bond_intact, jnp.inf, -jnp.inf).astype(odds.dtype)
        return jnp.where(uncertain, odds, fixed), uncertain

    odds, pullback, uncertain = jax.vjp(log_odds, parameters, has_aux=True)
    return odds, lambda slope: pullback(slope)[0], uncertain


def _struck(asset: Asset, state: State, damage: Damage) -> tuple[State, jax.Array]:
    """Return the state after damage to chunks, and the damage to bonds (B,)."""
    if damage.chunk is not None:
        state, _ = fracture.apply(asset, state, Damage(chunk=damage.chunk))
    if damage.bond is None:
        return state, jnp.zeros_like(state.bond_health)
    return state, jnp.where(damage.bond > 0, damage.bond, 0)


def _breakable(state: State) -> jax.Array:
    breakable = state.bond_intact & (state.bond_health > 0)
    if state.bond_unbreakable is None:
        return breakable
    return breakable & ~state.bond_unbreakable


def _run(
    asset: Asset, act: Act, loss: Loss, alive: jax.Array, parameters: Any
) -> jax.Array:
    """Return the loss if just these bonds survive, (B,) bool."""
    state, taken = _struck(asset, *act(parameters))
    uncertain = _breakable(state)
    alive = jnp.where(uncertain, alive, state.bond_intact)
    # Where nothing is taken from an unbreakable bond, no huge numbers meet.
    taken = jnp.where(uncertain, taken, 0)
    left = jnp.where(uncertain, jnp.maximum(state.bond_health - taken, 0), 0)
    health = jnp.where(uncertain, left, state.bond_health)
    broken = state.bond_intact & ~alive
    first, second = asset.bond_nodes[:, 0], asset.bond_nodes[:, 1]
    state = state.replace(
        bond_health=jnp.where(alive, health, 0),
        bond_intact=alive,
        dirty=state.dirty.at[first].max(broken).at[second].max(broken),
    )
    state, _ = fracture.split(asset, state)
    return loss(state, parameters)


def _add(first: Any, second: Any) -> Any:
    return jax.tree.map(jnp.add, first, second)


def _summary(value: jax.Array, gradient: Any) -> Expectation:
    """Average samples (K, ...) and say how sure the averages are."""

    def error(x: jax.Array) -> jax.Array:
        square = jnp.var(x, axis=0, ddof=1)
        # Equal samples: the root of zero has no derivative to pass on.
        varies = square > 0
        root = jnp.where(varies, jnp.sqrt(jnp.where(varies, square, 1)), 0)
        return root / math.sqrt(x.shape[0])

    return Expectation(
        value=jnp.mean(value),
        value_error=error(value),
        gradient=jax.tree.map(lambda x: jnp.mean(x, axis=0), gradient),
        gradient_error=jax.tree.map(error, gradient),
    )
