"""Break a wall in a few lines: an asset, damage, a split, and who is who afterwards.

No physics here: this is fracture alone, which needs nothing but jax.
"""

import numpy as np

from blastjax import chunks, damage, fracture
from blastjax.author import shapes


def main() -> None:
    """Hit a wall in the middle and print the pieces."""
    # The description, made once on the host: 6 x 6 bricks that stand on the world.
    wall = shapes.wall(bricks=6, courses=6)

    # Its state: the health of every bond and brick, and which actor owns them.
    state = fracture.init(wall, bond_health=1.0)

    # A blow at half height: 3 units of health up to 0.3 m, falling to none at 0.7 m.
    blow = damage.falloff(wall, state, np.array([0.0, -0.1, 0.6]), 3.0, 0.3, 0.7)

    # Damage first, the split afterwards: the islands that are left become actors.
    state, broken = fracture.apply(wall, state, blow)
    state, parted = fracture.split(wall, state)

    # Actors are named by their smallest element; 0 is what the world still holds.
    weight = chunks.moments(wall, state, density=1800.0)
    names = np.flatnonzero(chunks.active(wall, state))
    print(f"{int(broken.bond_broken.sum())} bonds broke; {len(names)} actors")
    print(f"{int(parted.created.sum())} of them are new")
    for name in names:
        held = "held by the world" if name == 0 else "loose"
        bricks = int(((state.actor == name) & chunks.is_chunk(wall)).sum())
        x, _, z = np.asarray(weight.center[name])
        mass = float(weight.mass[name])
        print(
            f"  actor {name:2d}: {bricks:2d} bricks, {mass:6.0f} kg "
            f"around ({x:5.2f}, {z:4.2f}) m, {held}"
        )


if __name__ == "__main__":
    main()
