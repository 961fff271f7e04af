"""Gymnasium: its own checker, seeds, auto-reset modes, time limits, long runs."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from blastjax import envs, render, wrappers
from tests.test_envs import SMALL

ENVS = 3
FIRE = np.tile(np.array([0, 0, 1, 1], np.float32), (ENVS, 1))
WAIT = np.tile(np.array([0, 0, 1, -1], np.float32), (ENVS, 1))


def batch(mode=AutoresetMode.NEXT_STEP, **options):
    return gymnasium.make_vec(
        "blastjax/Breach-v0", ENVS, autoreset_mode=mode, **options, **SMALL
    )


def test_gymnasium_finds_no_fault():
    env = gymnasium.make("blastjax.wrappers:blastjax/Breach-v0", **SMALL)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_env(env.unwrapped, skip_render_check=True)
    # Other packages may have warnings of their own.
    ours = [str(each.message) for each in said if "WARN" in str(each.message)]
    assert not ours


def test_registered_with_time_limit_and_render_modes():
    env = gymnasium.make("blastjax/Breach-v0", max_episode_steps=2, **SMALL)
    env.reset(seed=0)
    assert env.step(WAIT[0])[2:4] == (False, False)
    assert env.step(WAIT[0])[2:4] == (False, True)
    assert env.metadata["render_modes"] == ["rgb_array"]
    with pytest.raises(ValueError, match="human"):
        wrappers.breach(render_mode="human", **SMALL)
    with pytest.raises(gymnasium.error.ResetNeeded):
        wrappers.breach(**SMALL).step(WAIT[0])


def test_same_seed_same_rollout_and_batch_starts_as_singles():
    def roll():
        envs_ = batch()
        envs_.action_space.seed(3)
        rows = [envs_.reset(seed=7)[0]]
        rows += [envs_.step(envs_.action_space.sample())[0] for _ in range(10)]
        return np.stack(rows)

    first = roll()
    np.testing.assert_array_equal(first, roll())
    single = gymnasium.make("blastjax/Breach-v0", **SMALL)
    for i in range(ENVS):
        np.testing.assert_array_equal(single.reset(seed=7 + i)[0], first[0, i])


def to_the_end(envs_):
    """Step until a sub-environment ends, and return that step's result."""
    for _ in range(20):
        result = envs_.step(FIRE)
        if (result[2] | result[3]).any():
            return result
    raise AssertionError("no episode ended")


def test_next_step_autoreset():
    envs_ = batch()
    assert envs_.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    envs_.reset(seed=0)
    obs, _, terminated, truncated, _ = to_the_end(envs_)
    ended = terminated | truncated
    assert (obs[ended, -2] < 1).all()
    obs, reward, terminated, truncated, infos = envs_.step(FIRE)
    # Full of shots again, whatever the action said.
    assert (obs[ended, -2] == 1).all() and (reward[ended] == 0).all()
    assert not (terminated | truncated)[ended].any()
    assert (infos["actors"][ended] == 1).all() and infos["_actors"].all()


def test_same_step_autoreset():
    envs_ = batch(AutoresetMode.SAME_STEP)
    envs_.reset(seed=0)
    obs, _, terminated, truncated, infos = to_the_end(envs_)
    ended = terminated | truncated
    assert (obs[ended, -2] == 1).all()
    np.testing.assert_array_equal(infos["_final_obs"], ended)
    for i in range(ENVS):
        if ended[i]:
            assert infos["final_obs"][i][-2] < 1
            assert infos["final_info"]["broken_bonds"][i] > 0
        else:
            assert infos["final_obs"][i] is None
    np.testing.assert_array_equal(infos["final_info"]["_actors"], ended)
    assert (infos["actors"][ended] == 1).all()


def test_disabled_autoreset():
    envs_ = batch(AutoresetMode.DISABLED)
    envs_.reset(seed=0)
    obs, _, terminated, truncated, _ = to_the_end(envs_)
    ended = terminated | truncated
    with pytest.raises(ValueError, match="reset_mask"):
        envs_.step(FIRE)
    fresh, infos = envs_.reset(options={"reset_mask": ended})
    assert (fresh[ended, -2] == 1).all()
    np.testing.assert_array_equal(fresh[~ended], obs[~ended])
    np.testing.assert_array_equal(infos["_actors"], ended)
    envs_.step(FIRE)
    for wrong, error in (
        ([True] * ENVS, TypeError),
        (np.ones(ENVS + 1, bool), ValueError),
        (np.zeros(ENVS, bool), ValueError),
    ):
        with pytest.raises(error, match="reset_mask"):
            envs_.reset(options={"reset_mask": wrong})


def test_time_limit_of_the_batch():
    envs_ = batch(max_episode_steps=3)
    envs_.reset(seed=0)
    cut = [envs_.step(WAIT)[3].all() for _ in range(7)]
    # The step after the third starts anew and does not count.
    assert cut == [False, False, True, False, False, False, True]


@pytest.mark.slow
def test_thousand_random_steps_stay_finite():
    envs_ = batch()
    envs_.action_space.seed(0)
    envs_.reset(seed=0)
    ended = 0
    for _ in range(1000):
        obs, reward, terminated, truncated, infos = envs_.step(
            envs_.action_space.sample()
        )
        assert np.isfinite(obs).all() and np.isfinite(reward).all()
        assert all(np.isfinite(value).all() for value in infos.values())
        assert obs in envs_.observation_space
        ended += int((terminated | truncated).sum())
    assert ended > 50


def test_batch_options_are_checked():
    env = wrappers._breach(envs.Config(**SMALL))
    with pytest.raises(ValueError, match="num_envs"):
        wrappers.GymVectorEnv(env, 0)
    with pytest.raises(ValueError, match="max_episode_steps"):
        wrappers.GymVectorEnv(env, 1, max_episode_steps=0)
    with pytest.raises(ValueError, match="seeds"):
        wrappers.GymVectorEnv(env, 2).reset(seed=[1])


@pytest.mark.skipif(render.find_gl() is None, reason="no OpenGL")
def test_pictures():
    env = wrappers.breach(render_mode="rgb_array", width=64, height=48, **SMALL)
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (48, 64, 3) and picture.dtype == np.uint8
    env.close()
    assert wrappers.breach(**SMALL).render() is None
