"""How strong is each brick? From which bricks came loose under a few known shots.

64 unknown strengths, fitted by the gradient of connectivity margins until the wall
breaks exactly as observed, then tested on shots that the fit has not seen.
`python examples/how_strong.py strength.png` also draws the strengths.
"""

import os
import sys

import jax
import jax.numpy as jnp
import numpy as np

from blastjax import damage, fracture, soft
from blastjax.author import shapes
from blastjax.core import Damage, State

SIDE = 8
WALL = shapes.grid((SIDE, 1, SIDE), anchor=("z-",))


def wall(log_strength: jax.Array) -> State:
    """Return the whole wall of bricks with these strengths, (64,)."""
    first, second = WALL.bond_nodes[:, 0] - 1, WALL.bond_nodes[:, 1] - 1
    strength = jnp.exp(log_strength)
    other = jnp.where(second < 0, first, second)
    return fracture.init(WALL, 0.5 * (strength[first] + strength[other]))


def shots(rng: np.random.Generator, count: int) -> jax.Array:
    """Return the damage to bonds of random shots, (count, B)."""
    whole = fracture.init(WALL)
    x, z = rng.uniform(-0.4, 0.4, count), rng.uniform(0.2, 0.9, count)
    place = np.stack([x * SIDE, 0 * x, z * SIDE], axis=1)
    amount = rng.uniform(1.5, 3.0, count)

    def one(place: jax.Array, amount: jax.Array) -> jax.Array:
        return damage.falloff(WALL, whole, place, amount, 0.5, 4.0).bond

    return jax.vmap(one)(jnp.asarray(place), jnp.asarray(amount))


@jax.jit
def loose(log_strength: jax.Array, hits: jax.Array) -> jax.Array:
    """Return which nodes come loose under each shot, (count, N)."""
    state = wall(log_strength)

    def one(hit: jax.Array) -> jax.Array:
        after, _ = fracture.step(WALL, state, Damage(bond=hit))
        return after.actor[: WALL.span_node.shape[0]] != 0

    return jax.vmap(one)(hits)


def loss(log_strength: jax.Array, hits: jax.Array, seen: jax.Array) -> jax.Array:
    """Return how far the wall is from breaking as it was seen to."""
    state = wall(log_strength)

    def one(hit: jax.Array, seen: jax.Array) -> jax.Array:
        margin = soft.margin(WALL, state, Damage(bond=hit))
        return soft.release_loss(WALL, margin, seen)

    # Of all walls that would do, one that is not far from plain.
    return jnp.sum(jax.vmap(one)(hits, seen)) + 0.05 * jnp.sum(log_strength**2)


def main(
    picture: str | os.PathLike[str] | None = None, count: int = 24, steps: int = 600
) -> tuple[float, float, float]:
    """Return shares of bricks predicted: observed shots, new ones, and by a guess."""
    rng = np.random.default_rng(1)
    smooth = np.add.outer(np.sin(np.arange(SIDE)), np.cos(0.8 * np.arange(SIDE)))
    truth = jnp.asarray(0.35 * smooth.reshape(-1) + 0.1 * rng.normal(size=SIDE**2))
    hits, new = shots(rng, count), shots(rng, 100)
    seen = loose(truth, hits)

    def step(carry, _):
        fit, mean, square = carry
        slope = jax.grad(loss)(fit, hits, seen)
        mean, square = 0.9 * mean + 0.1 * slope, 0.99 * square + 0.01 * slope**2
        fit = fit - 0.03 * mean / (jnp.sqrt(square) + 1e-9)
        return (fit, mean, square), None

    plain = jnp.zeros(SIDE**2)
    fit = jax.jit(lambda x: jax.lax.scan(step, x, None, length=steps)[0][0])(
        (plain, plain, plain)
    )

    def right(guess: jax.Array, hits: jax.Array) -> float:
        either = loose(guess, hits) | loose(truth, hits)
        both = loose(guess, hits) & loose(truth, hits)
        return float(both.sum() / either.sum())

    scores = right(fit, hits), right(fit, new), right(plain, new)
    print(f"overlap of loose bricks, seen and fitted: {scores[0]:.3f} on {count} shots")
    print(f"  on 100 new shots {scores[1]:.3f}; all bricks alike gives {scores[2]:.3f}")
    if picture:
        draw(np.asarray(truth), np.asarray(fit), picture)
    return scores


def draw(truth: np.ndarray, fit: np.ndarray, picture) -> None:
    """Draw true and recovered strengths."""
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 3, figsize=(11, 3.8))
    grid = np.round(np.asarray(WALL.chunk_centroid), 3)
    extent = (grid[:, 0].min() - 0.5, grid[:, 0].max() + 0.5, 0, SIDE)
    order = np.lexsort((grid[:, 0], grid[:, 2]))
    for panel, values, name in zip(
        panels, (truth, fit), ("true", "found"), strict=False
    ):
        image = np.exp(values)[order].reshape(SIDE, SIDE)
        shown = panel.imshow(image, origin="lower", extent=extent, vmin=0.4, vmax=2.2)
        panel.set(title=f"{name} strength", xlabel="x, m", ylabel="z, m")
        figure.colorbar(shown, ax=panel, shrink=0.8)
    panels[2].plot(np.exp(truth), np.exp(fit), "o", ms=4)
    panels[2].plot([0.4, 2.2], [0.4, 2.2], color="0.6", lw=1)
    panels[2].set(xlabel="true", ylabel="found", title="brick by brick")
    figure.tight_layout()
    figure.savefig(picture, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    main(*sys.argv[1:2])
