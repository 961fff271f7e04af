"""Size the joints of a beam by gradient: each just strong enough, and no more.

The beam spans two walls, so its joints share the load as their stiffnesses say: an area
changes the forces everywhere, not only its own stress. The loss asks every joint for
the same safety factor, and its derivative passes through the linear solve.
"""

import jax
import jax.numpy as jnp

from blastjax import fracture, stress
from blastjax.author import shapes
from blastjax.stress.failure import judge

WIDTH, MODULUS = 0.5, 1e9
LIMITS = stress.Limits(4e6, 5e6, 1e6, 1.5e6)


def main(length: int = 6, target: float = 2.0, steps: int = 60) -> jax.Array:
    """Print the safety factor of each joint before and after; return the last."""
    asset = shapes.beam(length, (WIDTH,) * 3, anchor=("x-", "x+"))
    state, plain = fracture.init(asset), stress.structure(asset, modulus=MODULUS)
    load = stress.gravity(plain.mass, jnp.array([0.0, 0.0, -9.81]))
    load = stress.add(load, stress.at_node(asset, 2, jnp.array([0.0, 0.0, -2e4])))

    def safety(log_area: jax.Array) -> jax.Array:
        """Return the safety factor of each joint, (B,), by the logs of the areas."""
        area = jnp.exp(log_area)
        stiffness = MODULUS * area / WIDTH
        sized = plain.replace(stiffness=stiffness, bending=stiffness * area / 12)
        return 1 / judge(sized, asset, state, load, LIMITS, area=area).utilisation

    def loss(log_area: jax.Array) -> jax.Array:
        return jnp.mean(jnp.log(safety(log_area) / target) ** 2)

    @jax.jit
    def improve(log_area: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Take one step downhill."""
        value, slope = jax.value_and_grad(loss)(log_area)
        return log_area - 0.7 * slope, value

    log_area, evaluate = jnp.log(asset.bond_area), jax.jit(safety)
    before = evaluate(log_area)
    for step in range(steps):
        log_area, value = improve(log_area)
        if step % 10 == 0:
            print(f"step {step:3d}: loss {float(value):.2e}")

    after, area = evaluate(log_area), jnp.exp(log_area)
    print("joint at x, m  area, m^2  safety before  after")
    for i in jnp.argsort(asset.bond_centroid[:, 0]):
        x = asset.bond_centroid[i, 0]
        print(f"{x:13.2f}  {area[i]:9.4f}  {before[i]:13.2f}  {after[i]:5.2f}")
    return after


if __name__ == "__main__":
    main()
