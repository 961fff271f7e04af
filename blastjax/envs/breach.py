"""Breach: break the marked bricks out of a wall with a cannon, and spare the rest.

A brick wall in running bond, or another asset, stands on the world, along x. A cannon
in front of it has a few shots; the ball is one free body, brought back to the muzzle
for each. Bricks are numbered course by course from below, each course along x. Of
another asset the support chunks are the bricks, in its order.
"""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State

from blastjax import chunks, graph, pytree, world
from blastjax.author import shapes
from blastjax.author.mesh import Destructible
from blastjax.core import NONE, WORLD, Asset
from blastjax.rigid import bodies, scene

ACTION_SIZE = 4
"""Aim along the wall, aim up, speed, trigger."""
FAR = 100.0
"""Where observations of the ball are cut off."""


@dataclasses.dataclass(frozen=True)
class Config:
    """What the wall is made of, how the cannon shoots, and what counts."""

    bricks: int = 5
    """Whole bricks in a course."""
    courses: int = 5
    """Courses, one above the other."""
    brick: tuple[float, float, float] = (0.4, 0.2, 0.2)
    """Extent of a whole brick along x, y, z, m."""
    density: float = 1800.0
    """Of the bricks, kg/m^3."""
    friction: float = 0.6
    """Sliding friction of bricks and ball."""
    slots: int = 12
    """Most pieces that move at a time; beyond them the lightest become debris."""

    target: tuple[int, ...] | None = None
    """The marked bricks; None marks those around a random point at each reset."""
    target_radius: float = 0.3
    """How far from that point a marked brick's centre may be, m."""

    threshold: float = 20000.0
    """Normal force that does a brick no harm, N."""
    hardness: float = 60.0
    """Impulse that takes the health of a bond, N s."""
    min_radius: float = 0.2
    """Distance from a hit up to which bonds take all of it, m."""
    max_radius: float = 0.7
    """Distance from which they take none of it, m."""

    ball_radius: float = 0.15
    """Of the cannonball, m."""
    ball_mass: float = 100.0
    """Of the cannonball, kg."""
    softness: float = 0.03
    """Time constant of its contacts, s: a soft hit spreads over several steps."""
    distance: float = 2.5
    """From the muzzle to the middle of the wall, m."""
    muzzle_height: float = 0.5
    """Of the muzzle above the floor, m."""
    speed: tuple[float, float] = (6.0, 20.0)
    """Slowest and fastest shot, m/s."""

    shots: int = 3
    """Shots in an episode."""
    cooldown: int = 10
    """Environment steps from one shot to the next."""
    settle: int = 25
    """Environment steps that the last shot has to take effect."""

    side_weight: float = 0.5
    """What freeing all other bricks costs; freeing all marked ones pays 1."""
    shot_cost: float = 0.02
    """What a shot costs."""

    frames: int = 8
    """Physics steps in an environment step."""
    timestep: float = 0.005
    """Of physics, s."""
    iterations: int = 8
    """Most Newton steps of the contact solver."""
    max_contacts: int = 96
    """Most contacts that enter the solver."""


@pytree.dataclass
class Round(pytree.Node):
    """Everything that an episode changes."""

    world: world.World
    """Physics and fracture."""
    marked: jax.Array
    """(bricks,) bool."""
    shots: jax.Array
    """() int32 shots left."""
    waited: jax.Array
    """() int32 environment steps since the last shot; before the first, enough."""


class Breach(Env):
    """The environment.

    Action (4,) in [-1, 1]: where to aim along the wall (its ends at -1 and 1), how high
    (its foot and top), how fast, and the trigger: above 0 it fires, if the cannon has
    cooled down and has a shot left. The shot meets the aimed point but for what stands
    in its way.

    Observation (3 bricks + 8,): for each brick whether it is free of the world, whether
    it is marked, and what is left of its bonds' health, all in [0, 1]; the ball's
    position, m, and velocity over the greatest speed, both cut off at FAR; shots left
    and cooldown left, in [0, 1].

    Reward: the part of the marked volume that came free, minus `side_weight` times the
    part of the other volume that did, minus `shot_cost` if the cannon fired.

    The episode ends when no marked brick is held, or the last shot has had its time.
    """

    def __init__(
        self,
        config: Config | None = None,
        *,
        asset: Asset | Destructible | None = None,
        collision: str | None = None,
        **changes: Any,
    ) -> None:
        """Build the scene.

        Args:
          config: the settings; by default those of `Config`, or `fitted` to the asset.
          asset: stands there instead of the wall, moved so that the middle of its foot
            is the origin. It must be bonded to the world.
          collision: how chunks collide, see `rigid.scene.build`; None takes hulls of an
            asset with meshes, else boxes.
          **changes: fields of the config to change.

        Raises:
          ValueError: naming the field that is out of range, its value and the remedy.
        """
        if config is None:
            config = Config() if asset is None else fitted(asset)
        config = dataclasses.replace(config, **changes)
        position = np.zeros(3)
        if asset is None:
            asset = shapes.wall(config.bricks, config.courses, config.brick)
            half = np.array([config.bricks, 1, 0]) * config.brick / 2
            top = config.courses * config.brick[2]
            self._low, self._high = -half, half + np.array([0, 0, top])
        else:
            low, high = _bounds(_bare(asset))
            position = -np.array([low[0] + high[0], low[1] + high[1], 2 * low[2]]) / 2
            self._low, self._high = low + position, high + position
        if collision is None:
            collision = "hull" if isinstance(asset, Destructible) else "box"
        what, asset = asset, _bare(asset)
        _check(config, self._high[1])
        self.config = config
        self.scene = scene.build(
            what,
            slots=config.slots,
            position=position,
            collision=collision,
            density=config.density,
            friction=config.friction,
            model=_model(config, self._high[2]),
            timestep=config.timestep,
            iterations=config.iterations,
            max_contacts=config.max_contacts,
        )
        self.impact = world.Impact(
            config.threshold, config.hardness, config.min_radius, config.max_radius
        )
        ball = self.scene.host.model.joint("ball")
        self._ball_qpos = int(ball.qposadr[0]) + np.arange(7)
        self._ball_dof = int(ball.dofadr[0]) + np.arange(6)
        nodes = np.arange(1, len(asset.span_node))
        self._element = nodes[np.asarray(asset.element_chunk)[nodes] != NONE]
        brick = np.asarray(asset.element_chunk)[self._element]
        self._center = np.asarray(asset.chunk_centroid + position, np.float32)[brick]
        self._volume = np.asarray(asset.chunk_volume, np.float32)[brick]
        self._half_height = np.asarray(asset.chunk_size, np.float32)[brick, 2]
        self._fixed_target = self._given_target()
        bonds = np.asarray(asset.bond_nodes)
        count = np.bincount(bonds.ravel(), minlength=len(asset.span_node))
        # A piece that touches nothing has no bonds.
        self._bonds = np.maximum(count, 1)

    @property
    def bricks(self) -> int:
        """How many bricks the wall has, the half ones included."""
        return len(self._volume)

    @property
    def observation_size(self) -> int:
        """Length of the observation."""
        return 3 * self.bricks + 8

    @property
    def observation_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest observation, both (observation_size,)."""
        high = np.ones(self.observation_size, np.float32)
        high[-8:-2] = FAR
        low = np.zeros(self.observation_size, np.float32)
        low[-8:-2] = -FAR
        return low, high

    @property
    def action_size(self) -> int:
        """Length of the action."""
        return ACTION_SIZE

    @property
    def backend(self) -> str:
        """The physics behind it."""
        return "mjx"

    @property
    def dt(self) -> float:
        """Duration of an environment step, s."""
        return self.config.frames * self.config.timestep

    def world(self, round_: Round) -> world.World:
        """Return the World in a pipeline state."""
        return round_.world

    def highlight(self, round_: Round) -> jax.Array:
        """Return the elements that a picture should stress, (A,) bool: the target."""
        capacity = self.scene.asset.element_chunk.shape[0]
        return jnp.zeros(capacity, bool).at[self._element].set(round_.marked)

    def reset(self, rng: jax.Array) -> State:
        """Start an episode: a whole wall, with bricks marked by the key."""
        config = self.config
        now = Round(
            world=world.init(self.scene),
            marked=self._mark(rng),
            shots=jnp.asarray(config.shots, jnp.int32),
            waited=jnp.asarray(config.cooldown, jnp.int32),
        )
        zero = jnp.zeros((), jnp.float32)
        return State(
            pipeline_state=now,
            obs=self._observe(now),
            reward=zero,
            done=zero,
            metrics=self._metrics(now, zero),
            info={},
        )

    def step(self, state: State, action: jax.Array) -> State:
        """Fire if told to and able to, and let physics run for `frames` steps."""
        before: Round = state.pipeline_state
        action = jnp.clip(jnp.asarray(action, jnp.float32), -1.0, 1.0)
        now, fired = self._fire(before, action)

        def frame(moment: world.World, _: None) -> tuple[world.World, None]:
            return world.step(self.scene, moment, impact=self.impact)[0], None

        moment, _ = jax.lax.scan(frame, now.world, None, length=self.config.frames)
        now = now.replace(world=moment, waited=now.waited + 1)
        return state.replace(
            pipeline_state=now,
            obs=self._observe(now),
            reward=self._reward(before, now, fired),
            done=self._done(now).astype(jnp.float32),
            metrics={**state.metrics, **self._metrics(now, fired)},
        )

    def _given_target(self) -> np.ndarray | None:
        if self.config.target is None:
            return None
        wrong = [b for b in self.config.target if not 0 <= b < self.bricks]
        if wrong:
            raise ValueError(
                f"target names brick {wrong[0]}; the wall has bricks 0 to "
                f"{self.bricks - 1}"
            )
        marked = np.zeros(self.bricks, bool)
        marked[list(self.config.target)] = True
        return marked

    def _mark(self, key: jax.Array) -> jax.Array:
        if self._fixed_target is not None:
            return jnp.asarray(self._fixed_target)
        low, high = self._extent()
        place = jax.random.uniform(key, (2,), jnp.float32, low, high)
        away = jnp.sum((self._center[:, [0, 2]] - place[None]) ** 2, axis=1)
        near = away <= self.config.target_radius**2
        return near | (jnp.arange(self.bricks) == jnp.argmin(away))

    def _extent(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the wall's lower and upper corner, (x, z) in m."""
        low, high = (x[[0, 2]].astype(np.float32) for x in (self._low, self._high))
        return low, high

    def _fire(self, now: Round, action: jax.Array) -> tuple[Round, jax.Array]:
        """Return the round after a shot, if there is one, and whether there is."""
        config = self.config
        ready = (now.shots > 0) & (now.waited >= config.cooldown)
        fires = ready & (action[3] > 0.0)
        low, high = self._extent()
        aim = low + (action[:2] + 1.0) / 2.0 * (high - low)
        front = jnp.asarray(self._low[1], aim.dtype)
        aim = jnp.stack([aim[0], front, aim[1]])
        slowest, fastest = config.speed
        speed = slowest + (action[2] + 1.0) / 2.0 * (fastest - slowest)

        muzzle = jnp.array([0.0, -config.distance, config.muzzle_height], jnp.float32)
        way = aim - muzzle
        time = jnp.linalg.norm(way) / speed
        # Aimed above the point by what the ball falls on its way.
        velocity = way / time - self.scene.model.opt.gravity * time / 2.0
        upright = jnp.array([1.0, 0.0, 0.0, 0.0], jnp.float32)
        data = now.world.data
        dtype = data.qpos.dtype
        pose = jnp.concatenate([muzzle, upright]).astype(dtype)
        motion = jnp.concatenate([velocity, jnp.zeros(3)]).astype(dtype)
        at, dof = self._ball_qpos, self._ball_dof
        fresh = data.replace(
            qpos=data.qpos.at[at].set(pose),
            qvel=data.qvel.at[dof].set(motion),
            qacc_warmstart=data.qacc_warmstart.at[dof].set(0.0),
        )
        data = jax.tree.map(lambda new, old: jnp.where(fires, new, old), fresh, data)
        after = now.replace(
            world=now.world.replace(data=data),
            shots=now.shots - fires.astype(jnp.int32),
            waited=jnp.where(fires, 0, now.waited),
        )
        return after, fires.astype(jnp.float32)

    def _freed(self, now: Round) -> jax.Array:
        """Return which bricks the world no longer holds, (bricks,) bool."""
        return now.world.state.actor[self._element] != 0

    def _parts(self, now: Round) -> tuple[jax.Array, jax.Array]:
        """Return which part of the marked and of the other volume is free."""
        freed = self._freed(now) * self._volume
        marked, other = now.marked * self._volume, ~now.marked * self._volume
        # A wall that is marked all over has no other volume.
        return (
            jnp.sum(freed * now.marked) / jnp.sum(marked),
            jnp.sum(freed * ~now.marked) / jnp.maximum(jnp.sum(other), 1e-12),
        )

    def _reward(self, before: Round, now: Round, fired: jax.Array) -> jax.Array:
        target, side = self._parts(now)
        target_before, side_before = self._parts(before)
        config = self.config
        gain = target - target_before
        loss = config.side_weight * (side - side_before) + config.shot_cost * fired
        return (gain - loss).astype(jnp.float32)

    def _done(self, now: Round) -> jax.Array:
        free = jnp.all(self._freed(now) | ~now.marked)
        spent = (now.shots == 0) & (now.waited >= self.config.settle)
        return free | spent

    def _observe(self, now: Round) -> jax.Array:
        config, asset, data = self.config, self.scene.asset, now.world.data
        state = now.world.state
        left = state.bond_health * state.bond_intact
        nodes = asset.bond_nodes
        both = jnp.concatenate([left, left])
        owner = jnp.concatenate([nodes[:, 0], nodes[:, 1]])
        health = graph.group_sum(both, owner, len(self._bonds)) / self._bonds
        waiting = jnp.maximum(config.cooldown - now.waited, 0) / max(config.cooldown, 1)
        parts = [
            self._freed(now),
            now.marked,
            health[self._element],
            data.qpos[self._ball_qpos[:3]],
            data.qvel[self._ball_dof[:3]] / config.speed[1],
            now.shots[None] / config.shots,
            waiting[None],
        ]
        seen = jnp.concatenate([part.astype(jnp.float32) for part in parts])
        return jnp.clip(seen, *self.observation_limits)

    def _metrics(self, now: Round, fired: jax.Array) -> dict[str, jax.Array]:
        """Return what there is to say about the moment; volumes in m^3.

        `largest_piece` is the largest that moves, `fallen_volume` what is debris or
        lies half a brick below its place, `dropped` what the scene's caps left out.
        """
        scene_, moment = self.scene, now.world
        asset, state = scene_.asset, moment.state
        freed = self._freed(now)
        volume = chunks.element_values(asset, asset.chunk_volume)
        pieces = graph.group_sum(volume, state.actor, volume.shape[0])
        place, _ = bodies.chunk_poses(scene_, moment.bodies, moment.data)
        sunk = self._center[:, 2] - place[self._element, 2]
        fallen = (state.actor[self._element] == NONE) | (sunk > self._half_height)
        metrics = {
            "actors": jnp.sum(chunks.active(asset, state)),
            "broken_bonds": jnp.sum(~state.bond_intact),
            "freed_volume": jnp.sum(freed * self._volume),
            "fallen_volume": jnp.sum(fallen * self._volume),
            "largest_piece": jnp.max(pieces[1:]),
            "target_freed": self._parts(now)[0],
            "debris": moment.debris.count,
            "dropped": moment.dropped.pairs + moment.dropped.contacts,
            "shots_fired": fired,
        }
        return {name: x.astype(jnp.float32) for name, x in metrics.items()}


def fitted(asset: Asset | Destructible) -> Config:
    """Return settings for an asset that are to it as the defaults are to the wall.

    Lengths go with its largest extent; masses, forces and impulses with its mass; speed
    with the root of its size, as falls do. The timestep stays.
    """
    base, asset = Config(), _bare(asset)
    low, high = _bounds(asset)
    wall = np.prod(base.brick) * base.bricks * base.courses
    nodes = np.asarray(asset.element_chunk)[: len(asset.span_node)]
    volume = np.asarray(asset.chunk_volume, float)[nodes[nodes >= 0]].sum()
    length = float((high - low).max() / (base.bricks * base.brick[0]))
    mass = float(volume / wall)
    lengths = (
        *("target_radius", "min_radius", "max_radius", "ball_radius"),
        *("distance", "muzzle_height"),
    )
    changes = {name: getattr(base, name) * length for name in lengths}
    weights = ("threshold", "hardness", "ball_mass")
    changes |= {name: getattr(base, name) * mass for name in weights}
    slowest, fastest = (speed * length**0.5 for speed in base.speed)
    changes["distance"] = max(
        changes["distance"], changes["ball_radius"] * 2 + float(high[1] - low[1])
    )
    return dataclasses.replace(base, speed=(slowest, fastest), **changes)


def _bare(asset: Asset | Destructible) -> Asset:
    return asset.asset if isinstance(asset, Destructible) else asset


def _bounds(asset: Asset) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and greatest corner of an asset's support chunks.

    Raises:
      ValueError: it is not bonded to the world.
    """
    nodes = np.asarray(asset.element_chunk)[: len(asset.span_node)]
    if not asset.has_world or nodes[0] != WORLD:
        raise ValueError(
            "the asset is not bonded to the world, so all of it is free from the "
            "start; add bonds to the world"
        )
    brick = nodes[nodes >= 0]
    center, size = (
        np.asarray(x, float)[brick] for x in (asset.chunk_centroid, asset.chunk_size)
    )
    return (center - size).min(axis=0), (center + size).max(axis=0)


def _check(config: Config, half_depth: float) -> None:
    """Refuse a config that makes no environment.

    The wall and the scene check their own part.
    """
    whole = ("slots", "shots", "frames", "iterations", "max_contacts")
    for name in (*whole, "cooldown", "settle"):
        value, least = getattr(config, name), int(name in whole)
        if int(value) != value or value < least:
            raise ValueError(f"{name} is {value}; use a whole number from {least}")
    positive = (
        *("density", "target_radius", "hardness", "max_radius", "ball_radius"),
        *("ball_mass", "softness", "distance", "muzzle_height", "timestep"),
    )
    for name in (*positive, "friction", "threshold", "min_radius"):
        value, strict = getattr(config, name), name in positive
        if not (math.isfinite(value) and (value > 0 if strict else value >= 0)):
            bound = "above 0" if strict else "0 or more"
            raise ValueError(f"{name} is {value}; it must be finite and {bound}")
    for name in ("side_weight", "shot_cost"):
        if not math.isfinite(getattr(config, name)):
            raise ValueError(f"{name} is {getattr(config, name)}; it must be finite")
    if config.min_radius > config.max_radius:
        raise ValueError(
            f"min_radius {config.min_radius} is more than max_radius "
            f"{config.max_radius}; harm falls off from the first to the second"
        )
    if not 0 < config.speed[0] <= config.speed[1] < math.inf:
        raise ValueError(
            f"speed is {config.speed}; give the slowest and the fastest, above 0"
        )
    if config.target is not None and not config.target:
        raise ValueError("target is empty; name a brick, or use None for a random one")
    room = config.ball_radius + half_depth
    if config.distance <= room:
        raise ValueError(
            f"distance is {config.distance}; the ball needs more than {room} m"
        )


def _model(config: Config, height: float) -> str:
    """Return the MJCF of the surroundings: floor, light, cannon and ball."""
    back, up, r = -config.distance, config.muzzle_height, config.ball_radius
    return f"""
<mujoco>
  <statistic center="0 0 {height / 2}"/>
  <visual>
    <headlight ambient=".35 .35 .35" diffuse=".25 .25 .25" specular="0 0 0"/>
    <quality shadowsize="2048"/>
    <global offwidth="1920" offheight="1440"/>
  </visual>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1=".75 .85 .95" rgb2=".95 .95 .95"
             width="64" height="64"/>
    <texture name="floor" type="2d" builtin="checker" rgb1=".62 .63 .6"
             rgb2=".68 .69 .66" width="128" height="128"/>
    <material name="floor" texture="floor" texrepeat="1 1" texuniform="true"/>
  </asset>
  <worldbody>
    <light pos="-2 -4 6" dir=".3 .55 -.8" directional="true" diffuse=".7 .7 .7"
           specular=".1 .1 .1"/>
    <geom name="floor" type="plane" size="0 0 .05" material="floor"
          friction="{config.friction}"/>
    <geom name="barrel" type="cylinder" size="{1.3 * r}"
          fromto="0 {back - 6 * r} {up} 0 {back - r} {up}"
          rgba=".25 .25 .28 1" contype="0" conaffinity="0"/>
    <geom name="stand" type="box" size="{r} {2 * r} {up / 2}"
          pos="0 {back - 4 * r} {up / 2}"
          rgba=".4 .3 .2 1" contype="0" conaffinity="0"/>
    <body name="ball" pos="0 {back} {r}">
      <freejoint name="ball"/>
      <geom name="ball" type="sphere" size="{r}" mass="{config.ball_mass}"
            friction="{config.friction}" rgba=".12 .12 .14 1" priority="1"
            solref="{config.softness} 1"/>
    </body>
  </worldbody>
</mujoco>
"""
