"""Assemble a gate from parts, load it until it breaks, and export the pieces."""

import pathlib

import jax
import jax.numpy as jnp
import numpy as np

from blastjax import State, author, chunks, export, fracture, stress
from blastjax.author import materials, shapes

MATERIAL = materials.BRICK_AND_MORTAR


def main(path: str | pathlib.Path = "gate.glb") -> int:
    """Hang weights from the crown until it fails; return the number of pieces."""
    # Two columns that stand on the world, and an arch from one to the other.
    column = shapes.column(height=2.0, radius=0.4, drums=4, sides=8, taper=1.0)
    arch = shapes.arch(span=3.6, rise=1.8, thickness=0.4, width=0.5, anchor=False)
    places = [author.placed(at) for at in ((-2, 0, 0), (2, 0, 0), (0, 0, 2.0))]
    gate = author.merge([column, column, arch], places, touching=True).whole
    asset, state = gate.asset, fracture.init(gate.asset)
    print(f"{len(gate.meshes)} pieces, {len(asset.bond_area)} bonds")

    limits = stress.Limits(**materials.limits(MATERIAL))
    structure = stress.structure(
        asset, density=MATERIAL.density, modulus=MATERIAL.youngs_modulus
    )
    down = jnp.array([0.0, 0.0, -9.81])
    crown = jnp.argmax(asset.chunk_centroid[:, 2])
    node = asset.chunk_element[crown]

    @jax.jit
    def hang(weight: jax.Array) -> tuple[State, jax.Array]:
        """Return what is left under a weight (kg) at the crown, and whether it held."""
        load = stress.gravity(structure.mass, down)
        load = stress.add(load, stress.at_node(asset, node, weight * down))
        after, fall = stress.collapse(structure, asset, state, load, limits)
        return after, ~jnp.any(fall.fracture.bond_broken)

    for weight in (0.0, 100.0, 300.0, 1000.0, 3000.0, 10000.0):
        after, held = hang(jnp.asarray(weight))
        print(f"{weight:7.0f} kg: {'held' if held else 'broke'}")
        if not held:
            break

    export.save_pieces(path, gate, after)
    pieces = np.flatnonzero(chunks.active(asset, after))
    print(
        f"{len(pieces)} pieces in {path}, {int(chunks.held(asset, after).sum())} held"
    )
    return len(pieces)


if __name__ == "__main__":
    main()
