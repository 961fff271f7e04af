"""Batches of an environment for Brax's training."""

import jax
from brax.envs.base import Env, State
from brax.envs.wrappers import training

from blastjax import tiles


class VmapWrapper(training.VmapWrapper):
    """Brax's VmapWrapper that takes large batches in tiles: see `tiles.vmap`."""

    def __init__(
        self, env: Env, batch_size: int | None = None, width: int | None = None
    ) -> None:
        """Wrap an environment.

        Args:
          env: the environment, for one.
          batch_size: keys that `reset` makes out of one; None if it is given many.
          width: environments in a tile; see `tiles.vmap`, which refuses one below 1.
        """
        super().__init__(env, batch_size)
        self.width = width

    def reset(self, rng: jax.Array) -> State:
        """Start an episode in each environment, by one key for all or (T, 2)."""
        if self.batch_size is not None:
            rng = jax.random.split(rng, self.batch_size)
        return tiles.vmap(self.env.reset, self.width)(rng)

    def step(self, state: State, action: jax.Array) -> State:
        """Take a step in each environment, actions (T, n)."""
        return tiles.vmap(self.env.step, self.width)(state, action)
