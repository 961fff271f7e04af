"""Connectivity margins: how far a node is from coming loose.

The margin of a bond is the health that damage would leave it, below zero if damage
takes more than there is. A way is as strong as its weakest bond, and the margin of a
node is that of the strongest way to a source: the world, a node, a set of nodes.

A node is connected to a source exactly if its margin is above zero, so a loss on
margins that reaches its optimum has the hard outcome that it asks for.
"""

import jax
import jax.numpy as jnp

from blastjax import chunks, fracture, graph
from blastjax.core import Asset, Damage, State


def bond_margin(asset: Asset, state: State, damage: Damage | None = None) -> jax.Array:
    """Return the health that damage would leave each bond, below zero if it breaks.

    Args:
      asset: the asset.
      state: its state before the damage.
      damage: what is about to hit; None for the state as it is.

    Returns:
      (B,) health. Minus infinity for bonds that are broken already or that damage to
      their chunks would cut, infinity for those that damage to bonds cannot break.
      Differentiable in healths and damage to bonds, exactly; constant in damage to
      chunks, which cuts all bonds of a chunk at once, however small it is.
    """
    if damage is not None and damage.chunk is not None:
        state, _ = fracture.apply(asset, state, Damage(chunk=damage.chunk))
    left = state.bond_health
    breakable = left > 0
    if state.bond_unbreakable is not None:
        breakable = breakable & ~state.bond_unbreakable
    if damage is not None and damage.bond is not None:
        left = left - jnp.where(damage.bond > 0, damage.bond, 0)
    # Two steps: a difference of huge healths must not reach a derivative.
    left = jnp.where(breakable, left, jnp.inf)
    return jnp.where(state.bond_intact, left, -jnp.inf)


def sources(asset: Asset, to: jax.Array | int | None) -> jax.Array:
    """Return the nodes that count as a source, (N,) bool.

    Args:
      asset: the asset.
      to: () a node, (N,) bool a set of nodes, or None for the world.

    Piecewise constant: no derivative passes.

    Raises:
      ValueError: the world is meant and the asset has none, or `to` has another shape.
    """
    num_nodes = asset.span_node.shape[0]
    nodes = jnp.arange(num_nodes, dtype=jnp.int32)
    if to is None:
        if not asset.has_world:
            raise ValueError(
                "no bond leads to the world; give `to`, a node or a set of nodes"
            )
        return nodes == 0
    to = jnp.asarray(to)
    if to.dtype == bool and to.shape == (num_nodes,):
        return to
    if to.shape == () and jnp.issubdtype(to.dtype, jnp.integer):
        return nodes == to.astype(jnp.int32)
    raise ValueError(
        f"`to` has shape {to.shape} and type {to.dtype}; "
        f"give a node () of integer type or a set of nodes ({num_nodes},) of bool"
    )


def margin(
    asset: Asset,
    state: State,
    damage: Damage | None = None,
    *,
    to: jax.Array | int | None = None,
) -> jax.Array:
    """Return by how much health each node stays connected, or fails to.

    Args:
      asset: the asset.
      state: its state before the damage.
      damage: what is about to hit; None for the state as it is.
      to: () a node, (N,) bool a set of nodes, or None for the world.

    Returns:
      (N,) health: the greatest, over all ways to a source, of the least `bond_margin`
      on the way. Above zero if and only if the node is connected to a source once the
      damage is done and split. Infinity at sources and where unbreakable bonds lead,
      minus infinity where no way is left.

      Continuous in healths and damage to bonds. The derivative is that of the weakest
      bond of the strongest way, exact unless two margins tie (then it is that of one
      of them). It sees one bond a node, and nothing of how many others are as close:
      `perturbed_margin` does.

    Raises:
      ValueError: see `sources`.
    """
    weight = bond_margin(asset, state, damage)
    return _margin(asset, weight, sources(asset, to))


def _margin(asset: Asset, weight: jax.Array, source: jax.Array) -> jax.Array:
    num_nodes = asset.span_node.shape[0]
    edges, sweep = asset.bond_nodes, asset.sweep
    least, _ = graph.bottleneck(edges, weight, source, num_nodes, sweep=sweep)
    return least


def perturbed_margin(
    asset: Asset,
    state: State,
    damage: Damage | None = None,
    *,
    key: jax.Array,
    samples: int,
    scale: float | jax.Array = 0.1,
    to: jax.Array | int | None = None,
) -> jax.Array:
    """Return the mean margin when all bond margins are off by a random amount.

    Args:
      asset: the asset.
      state: its state before the damage.
      damage: what is about to hit; None for the state as it is.
      key: a random key.
      samples: draws to average.
      scale: standard deviation of the normal noise, health.
      to: () a node, (N,) bool a set of nodes, or None for the world.

    Returns:
      (N,) health. The mean over all noise is differentiable everywhere; this is its
      estimate, and the derivative is the estimate's own, spread over the bonds that
      were weakest in some draw: unbiased (Berthet et al. 2020). The sign is not that
      of connectivity: noise lowers the margin of a single way and raises that of many.

    Raises:
      ValueError: `samples` is below 1, or see `sources`.
    """
    if samples < 1:
        raise ValueError(f"samples is {samples}; at least one draw is needed")
    weight, source = bond_margin(asset, state, damage), sources(asset, to)

    def draw(noise: jax.Array) -> jax.Array:
        return _margin(asset, weight + jnp.asarray(scale, weight.dtype) * noise, source)

    noise = jax.random.normal(key, (samples, *weight.shape), weight.dtype)
    return jnp.mean(jax.vmap(draw)(noise), axis=0)


def release_loss(
    asset: Asset,
    margin: jax.Array,
    target: jax.Array,
    *,
    temperature: float | jax.Array = 0.1,
) -> jax.Array:
    """Return how far it is from exactly a target set coming loose.

    Args:
      asset: the asset.
      margin: (N,) of `margin` or `perturbed_margin`, health.
      target: (N,) bool, the nodes that shall come loose. All others shall stay.
      temperature: margin, in health, beyond which a node that is on its right side
        hardly counts.

    Returns:
      () health: the sum over chunks of t softplus(+-margin / t). Below t log 2 only if
      every chunk is on its right side. Infinite if no damage to bonds can do it: a
      target behind unbreakable bonds, or others that are loose already. The
      derivative is exact for finite margins, and zero for infinite ones.
    """
    real = chunks.is_chunk(asset)[: margin.shape[0]]
    excess = jnp.where(target, margin, -margin)
    cost = _soft_excess(jnp.where(real, excess, -jnp.inf), temperature)
    return jnp.sum(cost)


def hold_loss(
    asset: Asset,
    margin: jax.Array,
    region: jax.Array,
    *,
    temperature: float | jax.Array = 0.1,
) -> jax.Array:
    """Return how far it is from a region staying, whatever happens to the rest.

    Args:
      asset: the asset.
      margin: (N,) of `margin` or `perturbed_margin`, health.
      region: (N,) bool, the nodes that shall stay connected.
      temperature: see `release_loss`.

    Returns:
      () health, with the derivative of `release_loss`.
    """
    kept = region & chunks.is_chunk(asset)[: margin.shape[0]]
    return jnp.sum(_soft_excess(jnp.where(kept, -margin, -jnp.inf), temperature))


def _soft_excess(excess: jax.Array, temperature: float | jax.Array) -> jax.Array:
    """Return t softplus(excess / t), with its limits at infinity and no slope there."""
    temperature = jnp.asarray(temperature, excess.dtype)
    finite = jnp.isfinite(excess)
    cost = temperature * jax.nn.softplus(jnp.where(finite, excess, 0) / temperature)
    limit = jax.lax.stop_gradient(jnp.maximum(excess, 0))
    return jnp.where(finite, cost, limit)
