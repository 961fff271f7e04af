"""Throw a fragile bar so that it survives its landing, by gradient through contact.

The bar must come to x = 2 m. Its throw (speed along x and z, spin) is improved by
the derivative of the health that its bonds lose, through flight, impact and friction.
`python examples/soft_landing.py landing.png` also draws the throws.
"""

import os
import sys

import jax
import jax.numpy as jnp
import numpy as np

from blastjax import rigid, world
from blastjax.author import shapes

BAR = shapes.grid((3, 1, 1), (0.4, 0.2, 0.2))
HEALTH, GOAL, STEPS = 1.0, 2.0, 150
TOUGH = 1e6
"""Health of the bar that is thrown to learn: it loses health but does not break."""
IMPACT = world.Impact(threshold=400.0, hardness=57.0, min_radius=0.2, max_radius=0.8)


def build() -> rigid.Scene:
    """Return the bar, 1.5 m above the floor, nose up; spheres collide for its cubes."""
    turn = (np.cos(0.4), 0.0, -np.sin(0.4), 0.0)
    return rigid.build(
        BAR,
        slots=3,
        position=(0.0, 0.0, 1.5),
        quaternion=turn,
        density=300.0,
        chunk_contacts=False,
        collision="sphere",
        timestep=0.008,
    )


def throw(scene: rigid.Scene, start: world.World, way: jax.Array) -> tuple:
    """Return the world after a throw (3,), and per step damage (B,) and place (3,)."""
    push = jnp.zeros(6).at[jnp.array([0, 2, 4])].set(way)
    qvel = start.data.qvel.at[:6].set(push.astype(start.data.qvel.dtype))
    start = start.replace(data=start.data.replace(qvel=qvel))
    return world.rollout(
        scene,
        start,
        STEPS,
        impact=IMPACT,
        record=lambda w, e: (e.damage.bond, w.data.qpos[scene.host.slot_qpos[0]]),
    )


def main(
    picture: str | os.PathLike[str] | None = None, rounds: int = 80
) -> tuple[float, float, int]:
    """Return the worst share of health lost, before and after, and pieces."""
    scene = build()
    tough = world.init(scene, bond_health=TOUGH)

    def cost(way: jax.Array) -> tuple[jax.Array, tuple]:
        _, (hurt, pose) = throw(scene, tough, way)
        lost = jnp.sum(hurt, axis=0) / HEALTH
        missed = pose[-1, 0] - GOAL
        # A little for effort: who throws high enough never lands.
        effort = 0.02 * jnp.sum(way**2)
        return 3 * jnp.sum(lost**2) + 2 * missed**2 + effort, (lost.max(), pose)

    def slopes(way: jax.Array) -> tuple:
        # Three inputs: forward mode costs no memory, whatever the number of steps.
        def along(tangent: jax.Array) -> tuple:
            value, slope, seen = jax.jvp(cost, (way,), (tangent,), has_aux=True)
            return value, slope, seen

        value, slope, seen = jax.vmap(along, out_axes=(None, 0, None))(jnp.eye(3))
        return value, slope, seen

    both = jax.jit(slopes)
    way, mean, square = jnp.array([2.0, 2.5, 0.0]), jnp.zeros(3), jnp.zeros(3)
    values, worst, paths, ways = [], [], [], []
    for count in range(1, rounds + 1):
        value, slope, (lost, pose) = both(way)
        values.append(float(value)), worst.append(float(lost)), ways.append(way)
        paths.append(np.asarray(pose))
        mean, square = 0.9 * mean + 0.1 * slope, 0.99 * square + 0.01 * slope**2
        fair = mean / (1 - 0.9**count), square / (1 - 0.99**count)
        # Smaller and smaller: an impact that moves to another step is a small jump.
        way = way - 0.15 * 0.96**count * fair[0] / (jnp.sqrt(fair[1]) + 1e-6)
    best = int(np.argmin(values))

    fragile = world.init(scene, bond_health=HEALTH)
    end = jax.jit(lambda w: throw(scene, fragile, w)[0].bodies.label)
    pieces = [int((end(ways[k]) >= 0).sum()) for k in (0, best)]
    print(f"first throw: {worst[0]:.2f} of its health lost, {pieces[0]} pieces")
    vx, vz, spin = (float(x) for x in ways[best])
    print(f"best throw:  {worst[best]:.2f} of its health lost, {pieces[1]} pieces")
    print(f"  {vx:.2f} m/s ahead, {vz:.2f} m/s up, {spin:.2f} rad/s")
    print(f"  it lies at x = {paths[best][-1, 0]:.2f} m")
    if picture:
        draw([paths[0], paths[best]], worst, picture)
    return worst[0], worst[best], pieces[1]


def draw(paths: list[np.ndarray], worst: list[float], picture) -> None:
    """Draw the bar's way through the first and the best throw, and the health lost."""
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10.5, 3.8), width_ratios=(2, 1))
    for path, color, name in zip(
        paths, ("tab:red", "tab:blue"), ("first throw", "best throw"), strict=True
    ):
        for pose in path[::6]:
            w, _, y, _ = pose[3:]
            angle = 2 * np.arctan2(y, w)
            reach = 0.6 * np.array([np.cos(angle), -np.sin(angle)])
            ends = np.stack([pose[[0, 2]] - reach, pose[[0, 2]] + reach])
            left.plot(*ends.T, color=color, lw=2, alpha=0.4)
        left.plot(*path[:, [0, 2]].T, color=color, lw=1, label=name)
    left.axhline(0, color="k", lw=1)
    left.set(xlabel="x, m", ylabel="z, m", aspect="equal")
    left.legend()
    right.semilogy(worst)
    right.axhline(1, color="0.6", ls=":")
    right.set(xlabel="round", ylabel="health lost / health, worst bond")
    figure.tight_layout()
    figure.savefig(picture, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    main(*sys.argv[1:2])
