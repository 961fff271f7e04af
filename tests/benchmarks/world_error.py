"""Error of a world against its run time: python -m tests.benchmarks.world_error.

A block of 27 cubes falls askew, spinning, onto a plane, and may break there.

1. Time step and float type, unbroken: how far its centre is, at the worst moment, from
   where a far shorter time step in float64 puts it, against microseconds for each
   simulated millisecond.
2. Number of slots, breaking: the part of the mass that had to leave as debris, and how
   far the mean place of all chunks is from where enough slots would put it. What leaves
   counts from where it left.
"""

import argparse
import json
import time

import jax
import jax.numpy as jnp
import numpy as np

from blastjax import world
from blastjax.author import shapes
from blastjax.rigid import bodies, build

EDGE = (0.5, 0.5, 0.5)
TURN = (0.9, 0.2, 0.3, 0.1)


def fall(options, steps, *, double=False, slots=1, strength=None):
    """Return the path (16, 3), the part of mass lost and seconds to run it."""
    with jax.enable_x64(double):
        asset = shapes.grid((3, 3, 3), EDGE, dtype=np.float64 if double else np.float32)
        scene = build(
            asset,
            slots=slots,
            position=(0.0, 0.0, 1.1),
            quaternion=TURN,
            chunk_contacts=False,
            timestep=options.seconds / steps,
            max_contacts=108,
        )
        impact = None
        if strength is not None:
            impact = world.Impact(hardness=strength, min_radius=0.3, max_radius=0.8)
        start = world.init(scene, velocity=(1.0, 0.0, -1.0), spin=(1.0, 0.5, -0.7))

        def one(carry, _):
            now, place = carry
            now = world.step(scene, now, impact=impact)[0]
            seen, _ = bodies.chunk_poses(scene, now.bodies, now.data)
            here = (now.bodies.slot >= 0)[:, None]
            return (now, jnp.where(here, seen, place)), None

        def stretch(carry, _):
            carry, _ = jax.lax.scan(one, carry, length=steps // 16)
            return carry, carry[1].mean(axis=0)

        first = start, bodies.chunk_poses(scene, start.bodies, start.data)[0]
        run = jax.jit(lambda c: jax.lax.scan(stretch, c, length=16))
        run = run.lower(first).compile()
        laps = []
        for _ in range(options.repeat):
            began = time.perf_counter()
            (end, _), path = jax.block_until_ready(run(first))
            laps.append(time.perf_counter() - began)
        mass = float(scene.density * jnp.sum(asset.chunk_volume))
        return np.asarray(path, float), float(end.debris.mass) / mass, min(laps)


def main(arguments=None):
    """Print both tables; write JSON where told to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=0.64, help="simulated")
    parser.add_argument("--strength", type=float, default=300.0, help="N s a bond")
    parser.add_argument("--repeat", type=int, default=3, help="laps, the best counts")
    parser.add_argument("--json", metavar="FILE", help="write the figures there")
    options = parser.parse_args(arguments)
    per = 1e3 / options.seconds  # us for each simulated ms

    truth, _, _ = fall(options, 10240, double=True)
    rows = []
    print(f"{'time step ms':>13}{'type':>9}{'error m':>10}{'us a ms':>9}")
    for steps in (80, 160, 320, 640, 1280):
        for double in (False, True):
            path, _, lap = fall(options, steps, double=double)
            error = float(np.abs(path - truth).max())
            kind = "float64" if double else "float32"
            row = {"step": options.seconds / steps, "type": kind, "error": error}
            rows.append({**row, "microseconds": lap * per})
            print(f"{row['step'] * 1e3:13.2f}{kind:>9}{error:10.1e}{lap * per:9.0f}")

    whole, _, _ = fall(options, 320, slots=27, strength=options.strength)
    caps = []
    print(f"{'slots':>13}{'debris':>9}{'error m':>10}{'us a ms':>9}")
    for slots in (1, 2, 4, 8, 16, 27):
        path, lost, lap = fall(options, 320, slots=slots, strength=options.strength)
        error = float(np.abs(path - whole).max())
        caps.append({"slots": slots, "debris": lost, "error": error})
        caps[-1]["microseconds"] = lap * per
        print(f"{slots:13d}{lost:9.3f}{error:10.1e}{lap * per:9.0f}")
    if options.json:
        with open(options.json, "w") as out:
            json.dump({"time_steps": rows, "slots": caps}, out, indent=1)


if __name__ == "__main__":
    main()
