"""Aim a shot so that exactly a marked set of bricks comes loose.

The loss is on connectivity margins: each brick's margin is how much health the weakest
bond of its strongest way to the ground has left, so its sign is the hard outcome and
its gradient leads there. Random search sees only how many bricks are wrong.
`python examples/aim_a_shot.py aim.png` also draws both, and the wall.
"""

import os
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

from blastjax import chunks, damage, fracture, soft
from blastjax.author import shapes
from blastjax.core import Damage

SIDE = 16
WALL = shapes.grid((SIDE, 1, SIDE), anchor=("z-",))
HIDDEN = jnp.array([2.3, 10.2, 1.2, 1.4])
"""The shot that made the marked set: x and z, m, log of amount and of radius, m."""


def blow(shot: jax.Array) -> Damage:
    """Return what a shot (4,) does to a whole wall."""
    point = jnp.array([1.0, 0.0, 0.0]) * shot[0] + jnp.array([0.0, 0.0, 1.0]) * shot[1]
    amount, radius = jnp.exp(shot[2]), jnp.exp(shot[3])
    whole = fracture.init(WALL)
    return damage.falloff(WALL, whole, point, amount, 0.0, radius)


def loose(shot: jax.Array) -> jax.Array:
    """Return which nodes come loose, (N,) bool."""
    state, _ = fracture.step(WALL, fracture.init(WALL), blow(shot))
    return state.actor[: WALL.span_node.shape[0]] != 0


def loss(shot: jax.Array, target: jax.Array) -> jax.Array:
    """Return how far a shot is from freeing exactly the target."""
    margin = soft.margin(WALL, fracture.init(WALL), blow(shot))
    return soft.release_loss(WALL, margin, target)


def descend(shot: jax.Array, target: jax.Array, steps: int) -> list[tuple[float, int]]:
    """Return seconds and bricks wrong after each step of normalised descent."""

    @jax.jit
    def step(shot: jax.Array, mean: jax.Array, square: jax.Array, count: jax.Array):
        slope = jax.grad(loss)(shot, target)
        mean, square = 0.9 * mean + 0.1 * slope, 0.99 * square + 0.01 * slope**2
        fair = mean / (1 - 0.9**count), square / (1 - 0.99**count)
        shot = shot - 0.1 * fair[0] / (jnp.sqrt(fair[1]) + 1e-9)
        return shot, mean, square, jnp.sum(loose(shot) != target)

    mean = square = jnp.zeros_like(shot)
    jax.block_until_ready(step(shot, mean, square, 1.0))
    began, seen = time.perf_counter(), []
    for count in range(1, steps + 1):
        shot, mean, square, wrong = step(shot, mean, square, float(count))
        seen.append((time.perf_counter() - began, int(wrong)))
        if seen[-1][1] == 0:
            break
    return seen


def search(shot: jax.Array, target: jax.Array, rounds: int) -> list[tuple[float, int]]:
    """Return seconds and bricks wrong of the best of random shots, 32 at a time."""
    many = jax.jit(jax.vmap(lambda s: jnp.sum(loose(s) != target)))
    rng = np.random.default_rng(0)
    spread = np.array([2.0, 2.0, 0.5, 0.5])
    jax.block_until_ready(many(jnp.tile(shot, (32, 1))))
    began, seen, best = time.perf_counter(), [], SIDE * SIDE
    for _ in range(rounds):
        guesses = np.asarray(shot) + spread * rng.normal(size=(32, 4))
        best = min(best, int(many(guesses).min()))
        seen.append((time.perf_counter() - began, best))
        if best == 0:
            break
    return seen


def main(
    picture: str | os.PathLike[str] | None = None, steps: int = 400, rounds: int = 400
) -> tuple[int, int]:
    """Return how many bricks are wrong after descent, and after random search."""
    target = jax.jit(loose)(HIDDEN)
    place = chunks.element_values(WALL, WALL.chunk_centroid)
    middle = jnp.sum(jnp.where(target[:, None], place, 0), axis=0) / target.sum()
    start = jnp.array([middle[0], middle[2], 1.0, 1.0])
    paths = {
        "margin gradient": descend(start, target, steps),
        "random search": search(start, target, rounds),
    }
    print(f"free exactly {int(target.sum())} of {SIDE * SIDE} bricks")
    for name, seen in paths.items():
        print(f"{name:16s} {seen[-1][1]:3d} wrong after {seen[-1][0]:.3f} s")
    if picture:
        draw(np.asarray(place), np.asarray(target), paths, picture)
    return paths["margin gradient"][-1][1], paths["random search"][-1][1]


def draw(place, target, paths, picture) -> None:
    """Draw the marked bricks, and bricks wrong against time."""
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 4.2))
    colors = np.where(target[1:], "tab:red", "0.8")
    left.scatter(place[1:, 0], place[1:, 2], c=colors, marker="s", s=95)
    left.plot(*HIDDEN[:2], "k+", ms=12)
    left.set(title="to be freed: red", xlabel="x, m", ylabel="z, m", aspect="equal")
    for name, seen in paths.items():
        seconds, wrong = np.array(seen).T
        right.semilogx(seconds, wrong, ".-", ms=4, label=name)
    right.set(title="aiming", xlabel="time, s", ylabel="bricks on the wrong side")
    right.set_yscale("symlog", linthresh=1)
    right.legend()
    figure.tight_layout()
    figure.savefig(picture, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    main(*sys.argv[1:2])
