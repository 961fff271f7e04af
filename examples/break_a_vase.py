"""Cut a vase into shards, hit it, and count what comes off.

The vase is a lathe's: a profile turned about z. `python -m blastjax fracture` does the
same with a file, and `python -m blastjax --asset` lets it fall apart in MJX.
"""

import pathlib

import numpy as np
import trimesh

from blastjax import chunks, damage, fracture, pictures
from blastjax.author import bonds, cut

# Half of a section through the wall: up the outside, down the inside; m.
OUTSIDE = [(0, 0), (0.09, 0), (0.13, 0.1), (0.14, 0.18), (0.08, 0.34), (0.1, 0.4)]
INSIDE = [(0.085, 0.4), (0.065, 0.34), (0.125, 0.18), (0.115, 0.1), (0.08, 0.015)]


def main(folder: str | pathlib.Path = "examples/pictures") -> int:
    """Cut, hit, print, draw, and return how many actors there are."""
    profile = np.array([*OUTSIDE, *INSIDE, (0, 0.015)])
    vase = cut.solid(trimesh.creation.revolve(profile, sections=64))

    # Eight large pieces, each cut again into six shards; the shards are the support.
    tree = cut.voronoi(vase, cut.uniform(vase, 8, seed=1))
    tree = cut.voronoi(tree, cut.uniform(tree, 6, seed=2))

    # Bonds are the faces that the cuts left; the foot is bonded to the table.
    table = bonds.to_plane(tree.meshes, point=(0, 0, 0), normal=(0, 0, -1))
    made = cut.destructible(tree, world=[table])
    asset = made.destructible.asset
    print(f"{len(tree.leaves)} shards, {len(made.contacts.area)} bonds between them")

    # A hit on the shoulder breaks all bonds up to 0.1 m away.
    state = fracture.init(asset, bond_health=1.0)
    hit = damage.falloff(asset, state, np.array([0.12, 0.0, 0.25]), 3.0, 0.1, 0.15)
    state, broken = fracture.apply(asset, state, hit)
    state, _ = fracture.split(asset, state)

    mass = np.asarray(chunks.moments(asset, state, density=2400.0).mass)
    actors = np.flatnonzero(chunks.active(asset, state))
    loose = np.sort(mass[actors[actors > 0]])[::-1]
    print(f"{int(broken.bond_broken.sum())} bonds broke: {len(loose)} loose pieces")
    print(f"the largest have {', '.join(f'{1000 * m:.0f} g' for m in loose[:3])}")

    folder = pathlib.Path(folder)
    pictures.exploded(made.destructible, folder / "vase.png")
    pictures.levels(made.destructible, folder / "vase_levels.png")
    pictures.graph(made.destructible, folder / "vase_bonds.png")
    return len(actors)


if __name__ == "__main__":
    main()
