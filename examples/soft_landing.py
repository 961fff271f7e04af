"""Throw a fragile bar so that it survives its landing, by gradient through contact.

The bar must come to rest at x = 1.5 m on a soft mat. Its throw (speed along x and z,
spin) is improved by the derivative of the health that its bonds lose, through flight,
impact and friction. Then hard fracture judges, among random throws as well.
`python examples/soft_landing.py landing.png` also draws the throws.
"""

import os
import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax

from blastjax import rigid, world
from blastjax.author import shapes

BAR = shapes.grid((3, 1, 1), (0.4, 0.2, 0.2))
GOAL, STEPS, RADIUS = 1.5, 440, 0.1
LOW, HIGH = (1.0, 0.0, -2.0), (4.0, 3.0, 2.0)
"""What an arm can do, m/s and rad/s. The highest throw lands long before the end."""
TOUGH = 1e6
"""Health of the bar that is thrown to learn: it loses health but does not break."""
IMPACT = world.Impact(threshold=600.0, hardness=10.0, min_radius=0.2, max_radius=0.8)
# Where a hard contact begins within its step decides how hard it hits: its derivative
# follows that saw, not the mean. Here the force rises from zero, over many steps.
MAT = """
<mujoco>
  <option timestep="0.0025" iterations="20"/>
  <worldbody>
    <geom type="plane" size="9 9 0.1" solref="0.08 1" solimp="0.0001 0.9 0.3"
      friction="0.8" priority="1"/>
  </worldbody>
</mujoco>
"""


def build() -> rigid.Scene:
    """Return the bar, level, 1 m above the mat."""
    return rigid.build(
        BAR,
        model=MAT,
        slots=3,
        position=(0.0, 0.0, 1.0),
        density=300.0,
        chunk_contacts=False,
        collision="sphere",
    )


def throw(scene: rigid.Scene, start: world.World, way: jax.Array) -> tuple:
    """Return the world after a throw (3,); health lost (2,) and poses (STEPS, 7)."""
    push = jnp.zeros(6).at[jnp.array([0, 2, 4])].set(way)
    qvel = start.data.qvel.at[:6].set(push.astype(start.data.qvel.dtype))
    end, (hurt, poses) = world.rollout(
        scene,
        start.replace(data=start.data.replace(qvel=qvel)),
        STEPS,
        impact=IMPACT,
        record=lambda w, e: (e.damage.bond, w.data.qpos[scene.host.slot_qpos[0]]),
    )
    return end, jnp.sum(hurt, axis=0), poses


def main(path: str | os.PathLike[str] | None = None, rounds: int = 30) -> dict:
    """Return pieces of the first, the best and random throws, and how they ended."""
    scene = build()
    tough = world.init(scene, bond_health=TOUGH)

    def cost(way: jax.Array) -> tuple[jax.Array, jax.Array]:
        _, lost, poses = throw(scene, tough, way)
        missed = poses[-1, 0] - GOAL
        # Who is still in the air when the clock ends has not landed softly.
        aloft = jnp.maximum(poses[-1, 2] - RADIUS, 0.0)
        return jnp.sum(lost**2) + missed**2 + 10 * aloft, jnp.max(lost)

    @jax.jit
    def slopes(way: jax.Array) -> tuple:
        # Three inputs: forward mode costs no memory, whatever the number of steps.
        def along(tangent: jax.Array) -> tuple:
            return jax.jvp(cost, (way,), (tangent,), has_aux=True)

        return jax.vmap(along, out_axes=(None, 0, None))(jnp.eye(3))

    way, values, worst, ways = jnp.array([2.0, 2.75, 1.0]), [], [], []
    optimizer = optax.adam(optax.exponential_decay(0.2, 1, 0.95), b2=0.95)
    memory = optimizer.init(way)
    for _ in range(rounds):
        value, slope, lost = slopes(way)
        values.append(float(value)), worst.append(float(lost)), ways.append(way)
        change, memory = optimizer.update(slope, memory)
        way = jnp.clip(optax.apply_updates(way, change), *map(jnp.array, (LOW, HIGH)))
    best = int(np.argmin(values))

    # Now it can break: the first and the best throw, and 62 random ones.
    fragile = world.init(scene, bond_health=1.0)
    others = np.random.default_rng(0).uniform(LOW, HIGH, (62, 3)).astype(np.float32)
    tried = jnp.concatenate([jnp.stack([ways[0], ways[best]]), others])
    end, _, poses = jax.jit(jax.vmap(lambda w: throw(scene, fragile, w)))(tried)
    pieces = np.asarray(end.bodies.label >= 0).sum(axis=1)
    found = {
        "pieces": pieces[:2].tolist(),
        "lost": (worst[0], worst[best]),
        "rest": np.asarray(poses[1, -1, [0, 2]]).tolist(),
        "speed": float(jnp.abs(end.data.qvel[1, :6]).max()),
        "random": float(np.mean(pieces[2:] > 1)),
    }
    for name, k, n in (("first", 0, pieces[0]), ("best", best, pieces[1])):
        vx, vz, spin = (float(x) for x in ways[k])
        print(f"{name} throw: {vx:.2f} m/s ahead, {vz:.2f} m/s up, {spin:.2f} rad/s")
        print(f"  {worst[k]:.2f} of its health lost in the worst bond: {n} pieces")
    print(f"it rests at x = {found['rest'][0]:.2f} m, z = {found['rest'][1]:.2f} m")
    print(f"of 62 random throws {found['random']:.0%} break the bar")
    if path:
        draw(np.asarray(poses[:2]), worst, path)
    return found


def draw(throws: np.ndarray, worst: list[float], path) -> None:
    """Draw the bar's way through the first and the best throw, and the health lost."""
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10.5, 3.8), width_ratios=(2, 1))
    for poses, color, name in zip(
        throws, ("tab:red", "tab:blue"), ("first throw", "best throw"), strict=True
    ):
        for pose in poses[::6]:
            w, _, y, _ = pose[3:]
            angle = 2 * np.arctan2(y, w)
            reach = 0.6 * np.array([np.cos(angle), -np.sin(angle)])
            ends = np.stack([pose[[0, 2]] - reach, pose[[0, 2]] + reach])
            left.plot(*ends.T, color=color, lw=2, alpha=0.4)
        left.plot(*poses[:, [0, 2]].T, color=color, lw=1, label=name)
    left.axhline(0, color="k", lw=1)
    left.set(xlabel="x, m", ylabel="z, m", aspect="equal")
    left.legend()
    right.plot(worst)
    right.axhline(1, color="0.6", ls=":")
    right.set(xlabel="round", ylabel="health lost / health, worst bond")
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    main(*sys.argv[1:2])
