"""Gymnasium environments around the Brax-style ones.

`GymEnv` is one environment, `GymVectorEnv` a batch of them in one compiled program.
Importing this registers `blastjax/Breach-v0` for `gymnasium.make` and `make_vec`.
Environments with the same settings share their compiled programs.
"""

import functools
from collections.abc import Sequence
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from blastjax import envs, graph, tiles

_SEEDS = 2**31 - 1


class _Programs:
    """The compiled functions of one environment, for one or for many."""

    def __init__(self, env: Env) -> None:
        self.reset = jax.jit(env.reset)
        self.step = jax.jit(env.step)
        self.reset_all = jax.jit(tiles.vmap(env.reset))
        self.step_all = jax.jit(tiles.vmap(env.step))
        self.refresh = jax.jit(functools.partial(_refresh, env))


@functools.lru_cache(maxsize=16)
def _programs(env: Env) -> _Programs:
    return _Programs(env)


def _refresh(env: Env, state: State, keys: jax.Array, mask: jax.Array) -> State:
    """Start the masked environments of a batch anew."""

    def one(state: State, key: jax.Array, starts: jax.Array) -> State:
        def choose(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(starts, new, old)

        # A tile where none starts is left as it is.
        return jax.lax.cond(
            graph.anywhere(starts),
            lambda: jax.tree.map(choose, env.reset(key), state),
            lambda: state,
        )

    return tiles.vmap(one)(state, keys, mask)


class GymEnv(gymnasium.Env):
    """One Brax-style environment as a gymnasium environment.

    Episodes are cut off by the time limit that `gymnasium.make` puts around it, or by a
    Brax wrapper that writes `truncation` into the info. The info is the metrics.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012

    def __init__(
        self,
        env: Env,
        *,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 360,
    ) -> None:
        """Wrap an environment.

        Args:
          env: the environment; to be rendered it needs a `scene` and a method `world`.
          render_mode: "rgb_array" or None.
          width: of a rendered frame, pixels.
          height: of a rendered frame, pixels.

        Raises:
          ValueError: the render mode is unknown.
        """
        _check_mode(render_mode)
        self.env, self.render_mode = env, render_mode
        self.metadata = {**self.metadata, "render_fps": _fps(env)}
        self.observation_space, self.action_space = _spaces(env)
        self._run = _programs(env)
        self._state: State | None = None
        self._view = _View(env, width, height)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; the key of the environment comes from `np_random`."""
        super().reset(seed=seed)
        self._state = self._run.reset(_key(self.np_random))
        return _obs(self._state), _info(self._state)

    def step(
        self, action: np.ndarray
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take a step."""
        before = _begun(self._state)
        state = self._run.step(before, jnp.asarray(action, jnp.float32))
        self._state = state
        terminated, truncated = _ends(state)
        return (
            _obs(state),
            float(state.reward),
            bool(terminated),
            bool(truncated),
            _info(state),
        )

    def render(self) -> np.ndarray | None:
        """Return a picture, (height, width, 3) uint8, or None without a render mode."""
        if self.render_mode is None:
            return None
        return self._view.draw(_begun(self._state).pipeline_state)

    def close(self) -> None:
        """Give back what rendering took."""
        self._view.close()


class GymVectorEnv(gymnasium.vector.VectorEnv):
    """A batch of one Brax-style environment as a gymnasium vector environment.

    Sub-environment i of a batch seeded with s starts as a `GymEnv` seeded with s + i.
    """

    metadata = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": 25,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        env: Env,
        num_envs: int,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 360,
    ) -> None:
        """Wrap an environment.

        Args:
          env: the environment, for one; to be rendered it needs a `scene` and a method
            `world`.
          num_envs: size of the batch.
          autoreset_mode: what happens to an episode that ended. NEXT_STEP: the next
            `step` ignores its action and starts anew. SAME_STEP: it starts anew at
            once, and the info has its last observation and info. DISABLED: call `reset`
            with `options={"reset_mask": mask}`.
          max_episode_steps: steps after which an episode is truncated.
          render_mode: "rgb_array" or None.
          width: of a rendered frame, pixels.
          height: of a rendered frame, pixels.

        Raises:
          ValueError: an option is out of range.
        """
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}; use at least 1")
        if max_episode_steps is not None and max_episode_steps < 1:
            raise ValueError(
                f"max_episode_steps is {max_episode_steps}; use at least 1, or None"
            )
        _check_mode(render_mode)
        self.env, self.num_envs, self.render_mode = env, num_envs, render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.max_episode_steps = max_episode_steps
        self.metadata = {
            **self.metadata,
            "render_fps": _fps(env),
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space, self.single_action_space = _spaces(env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._run = _programs(env)
        self._state: State | None = None
        self._random: list[np.random.Generator] = []
        self._steps = np.zeros(num_envs, int)
        self._ended = np.zeros(num_envs, bool)
        self._view = _View(env, width, height)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start episodes: all, or those of the mask (num_envs,) bool in the options.

        Args:
          seed: one for the batch, one for each sub-environment, or None to go on.
          options: may have a "reset_mask".

        Raises:
          TypeError, ValueError: the mask is no array of num_envs bools with one set, or
            there are more or fewer seeds than sub-environments.
        """
        mask = self._mask(options)
        self._seed(seed, mask)
        if self._state is None:
            # There is nothing yet to leave as it is.
            mask = np.ones(self.num_envs, bool)
            self._state = self._run.reset_all(self._keys(mask))
        else:
            self._start(mask)
        self._steps[mask], self._ended[mask] = 0, False
        return _obs(self._state), self._infos(self._state, mask)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take a step in every sub-environment."""
        before = _begun(self._state)
        waiting = self._ended.copy()
        if self.autoreset_mode == AutoresetMode.DISABLED and waiting.any():
            raise ValueError(
                f"sub-environment {waiting.argmax()} has ended and autoreset is "
                "disabled; call reset(options={'reset_mask': mask}) first"
            )
        state = self._run.step_all(before, jnp.asarray(actions, jnp.float32))
        self._state = state
        reward = np.array(state.reward, np.float64)
        terminated, truncated = (np.array(x) for x in _ends(state))
        self._steps += 1
        if self.max_episode_steps is not None:
            truncated |= self._steps >= self.max_episode_steps
        if waiting.any():
            # Stepping what had ended was idle work; here the next begins.
            self._start(waiting)
            self._steps[waiting], reward[waiting] = 0, 0.0
            terminated[waiting], truncated[waiting] = False, False
        ended = terminated | truncated
        infos = {}
        if self.autoreset_mode == AutoresetMode.SAME_STEP and ended.any():
            infos = self._final(state, ended)
            self._start(ended)
            self._steps[ended] = 0
            ended = np.zeros_like(ended)
        self._ended = ended
        everyone = np.ones(self.num_envs, bool)
        infos.update(self._infos(self._state, everyone))
        return _obs(self._state), reward, terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return a picture of each sub-environment, or None without a render mode."""
        if self.render_mode is None:
            return None
        now = _begun(self._state).pipeline_state
        return tuple(
            self._view.draw(jax.tree.map(lambda x, i=i: x[i], now))
            for i in range(self.num_envs)
        )

    def close_extras(self, **kwargs: Any) -> None:
        """Give back what rendering took."""
        self._view.close()

    def _mask(self, options: dict[str, Any] | None) -> np.ndarray:
        mask = (options or {}).get("reset_mask")
        if mask is None:
            return np.ones(self.num_envs, bool)
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(f"reset_mask is {mask!r}; give a numpy array of bools")
        if mask.shape != (self.num_envs,):
            raise ValueError(
                f"reset_mask has shape {mask.shape}; it needs ({self.num_envs},)"
            )
        if not mask.any():
            raise ValueError("reset_mask is False throughout; nothing is to be reset")
        return mask.copy()

    def _seed(self, seed: int | Sequence[int | None] | None, mask: np.ndarray) -> None:
        if isinstance(seed, int | np.integer):
            super().reset(seed=int(seed))
            seed = [int(seed) + i for i in range(self.num_envs)]
        seeds = [None] * self.num_envs if seed is None else list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(
                f"there are {len(seeds)} seeds for {self.num_envs} sub-environments"
            )
        if not self._random:
            self._random = [seeding.np_random(each)[0] for each in seeds]
            return
        for i in np.flatnonzero(mask):
            if seeds[i] is not None:
                self._random[i] = seeding.np_random(seeds[i])[0]

    def _keys(self, mask: np.ndarray) -> jax.Array:
        """Draw a key for each masked sub-environment; the others have none."""
        nothing = jnp.zeros(2, jnp.uint32)
        pairs = zip(self._random, mask, strict=True)
        return jnp.stack([_key(random) if do else nothing for random, do in pairs])

    def _start(self, mask: np.ndarray) -> None:
        self._state = self._run.refresh(self._state, self._keys(mask), mask)

    def _infos(self, state: State, mask: np.ndarray) -> dict[str, Any]:
        infos: dict[str, Any] = {}
        for name, value in state.metrics.items():
            infos[name] = np.where(mask, np.array(value), 0).astype(np.float64)
            infos[f"_{name}"] = mask.copy()
        return infos

    def _final(self, state: State, ended: np.ndarray) -> dict[str, Any]:
        last, obs = np.full(self.num_envs, None, dtype=object), _obs(state)
        for i in np.flatnonzero(ended):
            last[i] = obs[i].copy()
        return {
            "final_obs": last,
            "_final_obs": ended.copy(),
            "final_info": self._infos(state, ended),
            "_final_info": ended.copy(),
        }


class _View:
    """Draws the pipeline states of an environment; made ready at the first picture."""

    def __init__(self, env: Env, width: int, height: int) -> None:
        self._env, self._size = env.unwrapped, (width, height)
        self._renderer: Any = None
        self._pose: Any = None

    def draw(self, pipeline_state: Any) -> np.ndarray:
        if self._renderer is None:
            self._prepare()
        return self._renderer.draw(self._pose(pipeline_state))

    def _prepare(self) -> None:
        from blastjax import render

        env, (width, height) = self._env, self._size
        if not hasattr(env, "scene") or not hasattr(env, "world"):
            raise NotImplementedError(
                f"{type(env).__name__} has no scene and world to be rendered"
            )
        self._renderer = render.Renderer(env.scene, width=width, height=height)

        def pose(pipeline_state: Any) -> render.Pose:
            marked = getattr(env, "highlight", lambda _: None)(pipeline_state)
            return render.pose(env.scene, env.world(pipeline_state), marked)

        self._pose = jax.jit(pose)

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def _key(random: np.random.Generator) -> jax.Array:
    return jax.random.PRNGKey(int(random.integers(_SEEDS)))


def _spaces(env: Env) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    size = env.observation_size
    endless = np.full(size, np.inf, np.float32)
    low, high = getattr(env, "observation_limits", (-endless, endless))
    sees = gymnasium.spaces.Box(low, high, (size,), np.float32)
    return sees, gymnasium.spaces.Box(-1.0, 1.0, (env.action_size,), np.float32)


def _fps(env: Env) -> int:
    return max(1, round(1.0 / float(env.dt))) if hasattr(env, "dt") else 25


def _check_mode(render_mode: str | None) -> None:
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode is {render_mode!r}; use 'rgb_array' or None")


def _begun(state: State | None) -> State:
    if state is None:
        raise gymnasium.error.ResetNeeded("call reset before step and render")
    return state


def _obs(state: State) -> np.ndarray:
    return np.array(state.obs, np.float32)


def _info(state: State) -> dict[str, Any]:
    return {name: float(value) for name, value in state.metrics.items()}


def _ends(state: State) -> tuple[np.ndarray, np.ndarray]:
    """Return whether the episode terminated and whether it was truncated."""
    done = np.asarray(state.done) > 0
    cut = np.asarray(state.info.get("truncation", np.zeros_like(state.done))) > 0
    return done & ~cut, done & cut


@functools.lru_cache(maxsize=16)
def _breach(config: envs.Config) -> envs.Breach:
    return envs.Breach(config)


def breach(
    render_mode: str | None = None, width: int = 480, height: int = 360, **config: Any
) -> GymEnv:
    """Return `envs.Breach` for gymnasium.

    Args:
      render_mode: "rgb_array" or None.
      width: of a rendered frame, pixels.
      height: of a rendered frame, pixels.
      **config: fields of `envs.Config`.
    """
    env = _breach(_config(config))
    return GymEnv(env, render_mode=render_mode, width=width, height=height)


def breach_batch(
    num_envs: int = 1,
    max_episode_steps: int | None = None,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    render_mode: str | None = None,
    width: int = 480,
    height: int = 360,
    **config: Any,
) -> GymVectorEnv:
    """Return a batch of `envs.Breach` for gymnasium.

    Args:
      num_envs: size of the batch.
      max_episode_steps: steps after which an episode is truncated.
      autoreset_mode: see `GymVectorEnv`.
      render_mode: "rgb_array" or None.
      width: of a rendered frame, pixels.
      height: of a rendered frame, pixels.
      **config: fields of `envs.Config`.
    """
    return GymVectorEnv(
        _breach(_config(config)),
        num_envs,
        autoreset_mode=autoreset_mode,
        max_episode_steps=max_episode_steps,
        render_mode=render_mode,
        width=width,
        height=height,
    )


def _config(fields: dict[str, Any]) -> envs.Config:
    # Lists, as from a file of settings, would not hash.
    given: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in fields.items()
    }
    return envs.Config(**given)


# What `gymnasium.make` asks an entry point about.
breach.metadata = GymEnv.metadata  # type: ignore[attr-defined]

gymnasium.register(
    id="blastjax/Breach-v0",
    entry_point="blastjax.wrappers:breach",
    vector_entry_point="blastjax.wrappers:breach_batch",
    max_episode_steps=100,
)
