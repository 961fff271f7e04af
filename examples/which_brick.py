"""Which bricks can be taken away before a table falls? One function, vmapped over all.

A brick is removed by cutting it loose; the rest then breaks round after round, until it
stands or lies.
`python examples/which_brick.py table.png` also draws it.
"""

import os
import sys

import jax
import jax.numpy as jnp
import numpy as np

from blastjax import chunks, fracture, stress
from blastjax.author import shapes
from blastjax.core import Asset, Damage
from blastjax.stress.failure import Verdict, collapse

BRICK = (0.5, 0.5, 0.5)
LIMITS = stress.Limits(1.3e5, 1.4e5)


def table() -> Asset:
    """Return a slab on four legs, with one arm that reaches out to +x."""
    legs = [(x, y, z) for x in (0, 5) for y in (0, 1) for z in range(3)]
    slab = [(x, y, 3) for x in range(6) for y in range(2)]
    arm = [(6, 0, 3), (7, 0, 3)]
    center = (np.array(legs + slab + arm) + 0.5) * BRICK
    return shapes.boxes(center, np.full(center.shape, 0.25), anchor=("z-",))


def main(picture: str | os.PathLike[str] | None = None) -> None:
    """Print what falls with each brick, and draw the whole structure."""
    asset = table()
    structure, whole = stress.structure(asset, density=2000.0), fracture.init(asset)
    weight = stress.gravity(structure.mass, jnp.array([0.0, 0.0, -9.81]))

    def without(node: jax.Array) -> tuple[jax.Array, jax.Array, Verdict]:
        """Return bonds broken, bricks fallen (the one removed too), and the rest."""
        blow = jnp.where(jnp.arange(whole.actor.shape[0]) == node, 1.0, 0.0)
        state, _ = fracture.step(asset, whole, Damage(chunk=blow))
        state, how = collapse(structure, asset, state, weight, LIMITS)
        fallen = chunks.is_chunk(asset) & (state.actor != 0)
        return how.fracture.bond_broken.sum(), fallen.sum(), how.verdict

    # Lane 0 takes away none; the world is node 0, and stays.
    nodes = jnp.arange(asset.span_node.shape[0])
    lanes = jnp.where(nodes == 0, -1, nodes)
    broken, fallen, verdict = jax.jit(jax.vmap(without))(lanes)

    print(f"whole: safety factor {float(verdict.safety[0, 0]):.2f}")
    print("brick   x, m  y, m  z, m  bonds  fallen  safety")
    for node, (x, y, z) in enumerate(stress.loads.node_place(asset)):
        if node:
            print(
                f"{node:5d}  {x:5.2f} {y:5.2f} {z:5.2f}  {int(broken[node]):5d}  "
                f"{int(fallen[node]):6d}  {float(verdict.safety[node, 0]):6.2f}"
            )
    print(f"{int((fallen == 1).sum())} of {len(nodes) - 1} bricks can go")
    if picture:
        from blastjax import render

        render.draw_utilisation(asset, whole, verdict.utilisation[0], picture)


if __name__ == "__main__":
    main(*sys.argv[1:2])
