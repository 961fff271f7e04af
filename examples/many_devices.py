"""Break a batch of walls on all devices: the batch axis is sharded, nothing else.

On a machine with one CPU device, ask for more before JAX starts:
`NPROC=8 XLA_FLAGS=--xla_force_host_platform_device_count=2 python many_devices.py`.
"""

import time

import jax
import jax.numpy as jnp
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from blastjax import Asset, chunks, damage, fracture
from blastjax.author import shapes


def shoot(wall: Asset, place: jax.Array) -> jax.Array:
    """Return how much of a wall one shot at (x, z), m, breaks loose, m^3."""
    point = jnp.array([place[0], -0.1, place[1]])
    state = fracture.init(wall)
    blow = damage.falloff(wall, state, point, 4.0, 0.2, 0.8)
    state, _ = fracture.step(wall, state, blow)
    volume = chunks.element_values(wall, wall.chunk_volume)
    return jnp.sum(jnp.where(state.actor != 0, volume, 0.0))


def main(batch: int = 1024, bricks: int = 8, courses: int = 8) -> jax.Array:
    """Print what the shots did and how long they took; return (batch,) m^3."""
    devices = jax.make_mesh(
        (jax.device_count(),), ("env",), axis_types=(AxisType.Auto,)
    )
    each, whole = PartitionSpec("env"), PartitionSpec()
    # Each device runs the loops of its own environments to their own end: under plain
    # `jit` the devices would agree on every round of every loop.
    shoot_all = jax.shard_map(
        jax.vmap(shoot, in_axes=(None, 0)),
        mesh=devices,
        in_specs=(whole, each),
        out_specs=each,
        check_vma=False,
    )
    wall = jax.device_put(shapes.wall(bricks, courses), NamedSharding(devices, whole))
    places = jax.random.uniform(jax.random.key(0), (batch, 2), minval=-1.0, maxval=1.5)
    places = jax.device_put(places, NamedSharding(devices, each))

    run = jax.jit(shoot_all).lower(wall, places).compile()
    start = time.perf_counter()
    loose = jax.block_until_ready(run(wall, places))
    spent = time.perf_counter() - start
    print(f"{batch} walls on {jax.device_count()} devices in {spent * 1e3:.1f} ms")
    print(
        f"loose: {float(loose.mean()):.4f} m^3 a wall, at most {float(loose.max()):.3f}"
    )
    return loose


if __name__ == "__main__":
    main()
