"""Sweep shots over a wall: one function for one shot, `jax.vmap` for all of them."""

import jax
import jax.numpy as jnp

from blastjax import chunks, damage, fracture
from blastjax.author import shapes

WALL = shapes.wall(bricks=6, courses=6)


def shoot(place: jax.Array, strength: jax.Array) -> dict[str, jax.Array]:
    """Return what one shot at (x, z), m, does to a whole wall."""
    state = fracture.init(WALL)
    point = jnp.array([place[0], -0.1, place[1]])
    blow = damage.falloff(WALL, state, point, strength, 0.2, 0.8)
    state, (broken, _) = fracture.step(WALL, state, blow)
    loose = (state.actor != 0) & chunks.is_chunk(WALL)
    volume = chunks.element_values(WALL, WALL.chunk_volume)
    return {
        "bonds": broken.bond_broken.sum(),
        "pieces": chunks.active(WALL, state).sum() - 1,
        "loose": jnp.sum(jnp.where(loose, volume, 0.0)),
    }


def main(columns: int = 5, rows: int = 3) -> None:
    """Print a table of shots along and up the wall."""
    x, z = jnp.linspace(-1.0, 1.0, columns), jnp.linspace(0.1, 1.1, rows)
    places = jnp.stack(jnp.meshgrid(x, z), axis=-1).reshape(-1, 2)
    strengths = jnp.array([1.5, 6.0])

    # A batch of batches: every place with every strength, in one compiled program.
    over_places = jax.vmap(shoot, in_axes=(0, None))
    over_both = jax.vmap(over_places, in_axes=(None, 0))
    result = jax.jit(over_both)(places, strengths)

    print("strength   x, m   z, m  bonds  pieces  loose, m^3")
    for i, strength in enumerate(strengths):
        for j, (x_, z_) in enumerate(places):
            bonds, pieces = int(result["bonds"][i, j]), int(result["pieces"][i, j])
            print(
                f"{float(strength):8.1f}  {float(x_):5.2f}  {float(z_):5.2f}  "
                f"{bonds:5d}  {pieces:6d}  {float(result['loose'][i, j]):10.3f}"
            )


if __name__ == "__main__":
    main()
