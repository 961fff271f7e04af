"""A batch over several devices gives what one device gives."""

import os
import pathlib
import subprocess
import sys

import numpy as np
import pytest

ROOT = pathlib.Path(__file__).parent.parent

WALLS = """
import sys, numpy as np, jax
from tests.test_examples import load
assert jax.device_count() == int(sys.argv[1]), jax.devices()
np.save(sys.argv[2], load("many_devices").main(batch=64, bricks=4, courses=4))
"""

WORLDS = """
import sys, numpy as np, jax, jax.numpy as jnp
from jax.sharding import AxisType, NamedSharding, PartitionSpec as P
from blastjax import damage, rigid, world
from blastjax.author import shapes
assert jax.device_count() == int(sys.argv[1]), jax.devices()
scene = rigid.build(shapes.wall(2, 2), slots=4)
impact = world.Impact(threshold=200.0, hardness=5.0, max_radius=0.5)

def roll(scene, start, x):
    point = jnp.stack([x, 0.0 * x, 0.0 * x + 0.3])
    hit = damage.falloff(scene.asset, start.state, point, 2.0, 0.2, 0.4)
    now, _ = world.step(scene, start, damage=hit)
    def on(now, _):
        return world.step(scene, now, impact=impact)[0], None
    now, _ = jax.lax.scan(on, now, None, length=20)
    return now.data.qpos, now.state.actor

devices = jax.make_mesh((jax.device_count(),), ("env",), axis_types=(AxisType.Auto,))
each, whole = P("env"), P()
many = jax.shard_map(
    jax.vmap(roll, in_axes=(None, None, 0)), mesh=devices,
    in_specs=(whole, whole, each), out_specs=each, check_vma=False)
where = jax.device_put(jnp.linspace(-0.5, 0.5, 8), NamedSharding(devices, each))
scene, start = jax.device_put(
    (scene, world.init(scene)), NamedSharding(devices, whole))
qpos, actor = jax.jit(many)(scene, start, where)
assert (np.asarray(actor) > 0).any(), "nothing broke"
np.save(sys.argv[2], np.concatenate([qpos, actor], axis=1))
"""


def run(code, devices, path):
    environment = dict(os.environ)
    # Beside what the tests' settings say about compiling.
    count = f"--xla_force_host_platform_device_count={devices}"
    environment["XLA_FLAGS"] = f"{environment.get('XLA_FLAGS', '')} {count}"
    # XLA runs devices in a pool of one thread a core, and they wait in it for tasks
    # of the same pool: as many devices as threads can wait for ever.
    environment["NPROC"] = "8"
    subprocess.run(
        [sys.executable, "-c", code, str(devices), os.fspath(path)],
        cwd=ROOT,
        env=environment,
        check=True,
        timeout=600,
    )
    return np.load(path)


def test_walls_on_four_devices_are_those_on_one(tmp_path):
    one, four = (run(WALLS, n, tmp_path / f"{n}.npy") for n in (1, 4))
    assert one.shape == (64,) and len(np.unique(one)) > 5
    np.testing.assert_array_equal(one, four)


@pytest.mark.slow
def test_worlds_on_two_devices_are_those_on_one(tmp_path):
    one, two = (run(WORLDS, n, tmp_path / f"{n}.npy") for n in (1, 2))
    # The same program, but sums may be vectorised otherwise for half the batch.
    np.testing.assert_allclose(one, two, rtol=1e-5, atol=1e-5)
