"""A batch on one core, on all of them, and sharded over devices.

`python -m tests.benchmarks.devices [--devices N] [--json FILE]` prints microseconds a
body of the round trip of `fracture_step`, and a world of a step of `world_step`'s cubes
as they fall and rest: by plain `jax.vmap` on one core and on all, which XLA shares out
as it sees fit, and by `jax.shard_map` over as many CPU devices as there are cores. One
process, laps of all in turn, the least of each. It moves threads as Linux does.
"""

import argparse
import json
import os
import pathlib

import jax
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from blastjax import world
from blastjax.author import shapes
from blastjax.rigid import build
from tests.benchmarks.fracture_step import blasts, round_trip
from tests.benchmarks.timing import keep_memory, least
from tests.benchmarks.world_step import batched

CORES = sorted(os.sched_getaffinity(0))


def run_on(cores):
    """Move every thread of this process to some cores."""
    for thread in os.listdir("/proc/self/task"):
        os.sched_setaffinity(int(thread), cores)


def plain(step, shared, each, cores):
    """Return a call of a batch, by plain vmap, on some cores."""
    axes = None, *[0 for _ in each]
    compiled = jax.jit(jax.vmap(step, axes)).lower(shared, *each).compile()

    def call():
        run_on(cores)
        jax.block_until_ready(compiled(shared, *each))

    return call


def sharded(step, shared, each):
    """Return a call of a batch that is sharded over all devices."""
    mesh = jax.make_mesh((jax.device_count(),), ("env",), axis_types=(AxisType.Auto,))
    whole, part = PartitionSpec(), PartitionSpec("env")
    axes = None, *[0 for _ in each]
    many = jax.shard_map(
        jax.vmap(step, axes),
        mesh=mesh,
        in_specs=(whole, *[part for _ in each]),
        out_specs=part,
        check_vma=False,
    )
    shared = jax.device_put(shared, NamedSharding(mesh, whole))
    each = jax.device_put(each, NamedSharding(mesh, part))
    compiled = jax.jit(many).lower(shared, *each).compile()

    def call():
        run_on(CORES)
        jax.block_until_ready(compiled(shared, *each))

    return call


def fractures(batch):
    """Return the step of one body, its asset and what each body has of its own."""
    asset = shapes.grid((8, 8, 8), (1 / 8,) * 3, root=True)
    return round_trip, asset, blasts(batch, np.random.default_rng(512))


def falls(batch, steps):
    """Return steps of one world, its scene and the worlds."""
    asset = shapes.grid((3, 3, 3), (0.5,) * 3)
    below = np.asarray(asset.chunk_centroid)[:, 2].min() - 0.25
    scene = build(asset, slots=8, position=(0.0, 0.0, 0.01 - below), timestep=0.002)
    worlds, speed = batched(world.init(scene), batch)
    dof = scene.host.slot_dof[0, 2]
    data = worlds.data.replace(qvel=worlds.data.qvel.at[:, dof].add(speed))
    impact = world.Impact(threshold=1e9, hardness=1.0, max_radius=1.0)

    def fall(scene, now):
        return world.rollout(scene, now, steps, impact=impact)[0]

    return fall, scene, (worlds.replace(data=data),)


def main(arguments=None):
    """Print the table; write JSON where told to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--devices", type=int, default=len(CORES))
    parser.add_argument("--bodies", type=int, default=2048)
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--json", type=pathlib.Path)
    chosen = parser.parse_args(arguments)
    # Before JAX starts. XLA's pool has to be larger than the devices that wait in it.
    os.environ["NPROC"] = str(4 * chosen.devices)
    flag = f"--xla_force_host_platform_device_count={chosen.devices}"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}"
    keep_memory()
    print(f"jax {jax.__version__}, {len(CORES)} cores, {chosen.devices} devices")
    print(f"{'microseconds':24}{'one core':>10}{'all cores':>11}{'sharded':>9}")
    rows = []
    for name, (step, shared, each), size in (
        ("a fracture step", fractures(chosen.bodies), chosen.bodies),
        (
            "a world step",
            falls(chosen.worlds, chosen.steps),
            chosen.worlds * chosen.steps,
        ),
    ):
        calls = {
            "one core": plain(step, shared, each, CORES[:1]),
            "all cores": plain(step, shared, each, CORES),
            "sharded": sharded(step, shared, each),
        }
        times = {k: 1e6 * t / size for k, t in least(calls, chosen.repeats).items()}
        rows.append({"what": name, **times})
        print(f"{name:24}{times['one core']:10.2f}", end="")
        for key in ("all cores", "sharded"):
            ratio = times["one core"] / times[key]
            print(f"{times[key]:8.2f} ({ratio:.2f}x)", end="")
        print(flush=True)
    if chosen.json:
        chosen.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
