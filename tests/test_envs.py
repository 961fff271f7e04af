"""Breach: rules, rewards, Brax's wrappers, and what auto-reset must rebuild."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from brax.envs.wrappers import training

from blastjax import envs
from blastjax.author import bonds, cut
from blastjax.envs import breach

SMALL = {
    "bricks": 2,
    "courses": 2,
    "slots": 3,
    "frames": 4,
    "shots": 2,
    "cooldown": 2,
    "settle": 3,
    "distance": 1.0,
    "max_contacts": 32,
    "iterations": 4,
}
BATCH = 3
FIRE = jnp.array([0.0, 0.0, 1.0, 1.0])
WAIT = jnp.array([0.0, 0.0, 1.0, -1.0])


@pytest.fixture(scope="module")
def env():
    return envs.Breach(**SMALL)


@pytest.fixture(scope="module")
def run(env):
    return jax.jit(env.reset), jax.jit(env.step)


def test_shot_frees_bricks_for_its_price(env, run):
    reset, step = run
    state = reset(jax.random.PRNGKey(0))
    assert state.obs.shape == (env.observation_size,)
    assert float(state.metrics["actors"]) == 1
    before, rewards = state, []
    for _ in range(5):
        state = step(state, FIRE)
        rewards.append(float(state.reward))
    assert float(state.metrics["broken_bonds"]) > 0
    assert float(state.metrics["freed_volume"]) > 0
    assert np.isfinite(np.asarray(state.obs)).all()
    low, high = env.observation_limits
    assert ((state.obs >= low) & (state.obs <= high)).all()

    freed = np.asarray(state.obs[: env.bricks])
    marked = np.asarray(before.obs[env.bricks : 2 * env.bricks])
    volume = np.asarray(env.scene.asset.chunk_volume)
    target = (freed * marked * volume).sum() / (marked * volume).sum()
    other = (1 - marked) * volume
    side = (freed * other).sum() / max(other.sum(), 1e-9)
    config = env.config
    fired = config.shots - int(state.pipeline_state.shots)
    want = target - config.side_weight * side - config.shot_cost * fired
    assert sum(rewards) == pytest.approx(want, abs=1e-5)


def test_cannon_waits_and_runs_out(env, run):
    reset, step = run
    state = reset(jax.random.PRNGKey(0))
    fired, done = [], []
    for _ in range(8):
        state = step(state, FIRE)
        fired.append(int(state.metrics["shots_fired"]))
        done.append(bool(state.done))
    assert fired == [1, 0, 1, 0, 0, 0, 0, 0]
    assert done[-1]
    state = step(reset(jax.random.PRNGKey(0)), WAIT)
    assert float(state.metrics["shots_fired"]) == 0 and not bool(state.done)


def test_structure_and_dtypes_stay_the_same(env, run):
    reset, step = run
    state = reset(jax.random.PRNGKey(0))

    def kinds(tree):
        return jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), tree)

    after = step(state, FIRE)
    assert kinds(state) == kinds(after)
    assert after.done.dtype == after.reward.dtype == jnp.float32


def test_target_is_random_by_key_or_given(env):
    mark = jax.jit(jax.vmap(env._mark))
    keys = jax.random.split(jax.random.PRNGKey(0), 16)
    marked = np.asarray(mark(keys))
    assert marked.any(axis=1).all()
    assert len(np.unique(marked, axis=0)) > 1
    fixed = envs.Breach(**SMALL, target=(0, 3))
    np.testing.assert_array_equal(
        np.flatnonzero(fixed._mark(jax.random.PRNGKey(0))), [0, 3]
    )


@pytest.mark.parametrize(
    "wrapper",
    [
        training.VmapWrapper,
        pytest.param(
            functools.partial(envs.VmapWrapper, width=2), marks=pytest.mark.slow
        ),
    ],
    ids=["Brax's", "in tiles"],
)
def test_auto_reset_rebuilds_everything_under_scan(env, wrapper):
    # As Brax's training wraps it.
    wrapped = training.EpisodeWrapper(wrapper(env), 5, action_repeat=1)
    wrapped = training.AutoResetWrapper(wrapped)
    first = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(1), BATCH))
    leaves = jax.tree.leaves(first.pipeline_state)
    assert all(leaf.shape[:1] == (BATCH,) for leaf in leaves)

    @jax.jit
    def roll(state):
        def one(state, _):
            state = wrapped.step(state, jnp.tile(FIRE, (BATCH, 1)))
            return state, state

        return jax.lax.scan(one, state, None, length=6)[1]

    states = roll(first)
    assert np.isfinite(np.asarray(states.obs)).all()
    assert np.isfinite(np.asarray(states.reward)).all()
    # What is reported of the last moment stays, what the next begins with is rebuilt.
    broken = np.asarray(states.metrics["broken_bonds"])
    ended = np.argwhere(np.asarray(states.done))
    assert sum(broken[t, i] > 0 for t, i in ended) >= BATCH
    for t, i in ended:
        for name in ("pipeline_state", "obs"):
            jax.tree.map(
                lambda now, then, t=t, i=i: np.testing.assert_array_equal(
                    now[t, i], then[i]
                ),
                getattr(states, name),
                getattr(first, name),
            )


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("shots", 0),
        ("frames", 1.5),
        ("density", -1.0),
        ("threshold", float("nan")),
        ("speed", (5.0, 2.0)),
        ("target", ()),
        ("target", (99,)),
        ("distance", 0.1),
        ("min_radius", 9.0),
        ("side_weight", float("inf")),
        ("bricks", 0),
        ("cooldown", -1),
    ],
)
def test_config_is_checked(field, value):
    with pytest.raises(ValueError, match=field.split("_")[0]):
        envs.Breach(**{**SMALL, field: value})


@pytest.mark.slow
def test_default_wall_breaks_and_falls():
    env = envs.Breach()
    state, step = jax.jit(env.reset)(jax.random.PRNGKey(0)), jax.jit(env.step)
    for _ in range(40):
        state = step(state, jnp.array([0.1, 0.1, 0.5, 1.0]))
    assert float(state.metrics["broken_bonds"]) > 15
    assert float(state.metrics["fallen_volume"]) > 0.04
    # m/s: nothing leaves faster than the ball came.
    velocity = state.pipeline_state.world.data.qvel[env.scene.host.slot_dof][:, :3]
    assert float(jnp.abs(velocity).max()) < env.config.speed[1]


@pytest.fixture(scope="module")
def block():
    """Return the tree of a block twice the wall's length, off the origin."""
    tree = cut.solid(trimesh.creation.box((4.0, 0.8, 2.0)))
    return cut.voronoi(tree, cut.uniform(tree, 6, seed=1))


def test_another_asset_stands_in_the_walls_place(block):
    held = bonds.to_plane(block.meshes, (0, 0, -1), (0, 0, -1))
    what = cut.destructible(block, world=[held]).destructible
    env = envs.Breach(asset=what, slots=3)
    assert env.bricks == 6 and env.scene.hulls is not None
    np.testing.assert_allclose(env.scene.position, (0, 0, 1), atol=1e-6)
    np.testing.assert_allclose(env._extent(), [(-2, 0), (2, 2)], atol=1e-6)
    # Twice as long as the wall; as heavy for it as the wall's ball is for the wall.
    config, usual = env.config, breach.Config()
    np.testing.assert_allclose(config.ball_radius, 2 * usual.ball_radius, rtol=1e-6)
    share = usual.ball_mass / (2.0 * 0.2 * 1.0 * usual.density)
    np.testing.assert_allclose(
        config.ball_mass, share * 4.0 * 0.8 * 2.0 * usual.density, rtol=1e-5
    )
    low, high = env.observation_limits
    assert low.shape == high.shape == (3 * 6 + 8,)
    boxes = envs.Breach(asset=what.asset, slots=3)
    assert boxes.scene.hulls is None


def test_an_asset_that_nothing_holds_is_refused(block):
    with pytest.raises(ValueError, match="not bonded to the world"):
        envs.Breach(asset=cut.destructible(block).destructible)
