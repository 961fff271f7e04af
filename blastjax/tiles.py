"""Large batches of worlds on a CPU, some at a time."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

Out = TypeVar("Out")

WIDTH = 64
"""Worlds in a tile: enough to fill vectors, few enough to stay in a core's cache."""


def vmap(function: Callable[..., Out], width: int | None = None) -> Callable[..., Out]:
    """Return `jax.vmap(function)` that takes the batch in tiles, one after the other.

    What a tile of worlds needs stays in a core's cache, and what none of its worlds
    needs in a step is left out for it (see `graph.anywhere`). Put it around all that
    worlds do apart from each other: around a rollout rather than around each step.

    Args:
      function: of arrays or pytrees for one world. What all worlds share, such as a
        scene, it closes over.
      width: how many worlds make a tile; None stands for 64 where JAX's default is a
        CPU, and for the whole batch elsewhere.

    Returns:
      The function of all worlds: every leaf of every argument is (T, ...), and so is
      every leaf of the result. Results and derivatives are those of `jax.vmap`.

    Raises:
      ValueError: the width is below 1; or, when called, there is no batch axis or
        leaves differ in it.
    """
    if width is not None and width < 1:
        raise ValueError(f"width is {width}; use 1 or more, or None")

    def of_all(*args: Any) -> Out:
        size = _batch_size(args)
        widest = width or (WIDTH if jax.default_backend() == "cpu" else size)
        if size <= widest:
            return jax.vmap(function)(*args)
        count = -(-size // widest)
        # As even as can be; the last tile is filled up with some of its worlds again.
        even = -(-size // count)
        spare = count * even - size

        def part(x: jax.Array) -> jax.Array:
            x = jnp.asarray(x)
            x = jnp.concatenate([x, x[size - spare :]]) if spare else x
            return x.reshape(count, even, *x.shape[1:])

        def join(x: jax.Array) -> jax.Array:
            return x.reshape(count * even, *x.shape[2:])[:size]

        parts = jax.tree.map(part, args)
        found = jax.lax.map(lambda x: jax.vmap(function)(*x), parts)
        return jax.tree.map(join, found)

    return of_all


def _batch_size(args: Any) -> int:
    """Return T, the first size of every leaf; refuse what has none, or several."""
    sizes: dict[int, str] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(args):
        if not jnp.shape(leaf):
            where = jax.tree_util.keystr(path)
            raise ValueError(f"argument{where} has no batch axis; give it one")
        sizes.setdefault(jnp.shape(leaf)[0], jax.tree_util.keystr(path))
    if not sizes:
        raise ValueError("there is no array in the arguments; give a batch of some")
    if len(sizes) > 1:
        told = ", ".join(f"{n} in argument{where}" for n, where in sizes.items())
        raise ValueError(f"batch sizes differ: {told}; make them equal")
    return next(iter(sizes))
