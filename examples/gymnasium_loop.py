"""Run the Breach environment in a gymnasium loop, as any learning library would.

The batch is one compiled program; the first step takes a while to compile.
"""

import gymnasium
import numpy as np


def main(num_envs: int = 8, steps: int = 60, **config: object) -> np.ndarray:
    """Let random gunners play, and return their summed rewards."""
    # The part before the colon is imported, which registers the environment.
    name = "blastjax.wrappers:blastjax/Breach-v0"
    envs = gymnasium.make_vec(name, num_envs=num_envs, **config)
    envs.action_space.seed(0)
    envs.reset(seed=0)

    # Four numbers in [-1, 1]: aim along the wall, aim up, speed, and the trigger.
    total = np.zeros(num_envs)
    episodes = 0
    for _ in range(steps):
        actions = envs.action_space.sample()
        _, rewards, terminated, truncated, infos = envs.step(actions)
        total += rewards
        # An episode that ended starts anew at the next step, by itself.
        episodes += int((terminated | truncated).sum())

    print(f"{num_envs} environments, {steps} steps, {episodes} episodes ended")
    print(f"reward of each: {np.round(total, 2)}")
    print(f"pieces now:     {infos['actors'].astype(int)}")
    print(f"fallen, m^3:    {np.round(infos['fallen_volume'], 2)}")
    envs.close()
    return total


if __name__ == "__main__":
    main()
