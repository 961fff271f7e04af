"""Slots against one body a chunk with welds: python -m tests.benchmarks.welds.

The same block of cubes lands on a plane, once as this library's breakable, once as MJX
bodies welded at every bond, once as a single MJX body that cannot break; and the welds
in MuJoCo C. float32, one process, the same time step, tolerance and iteration limits.
"""

import argparse
import json
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from blastjax import world
from blastjax.author import shapes
from blastjax.rigid import build

EDGE, DENSITY, TILT, GAP = 0.5, 1000.0, 0.05, 0.02


def welded(asset, place, turn, options, *, single):
    """Return the MJCF of the cubes: one body and no welds, or one each and welds."""
    center = np.asarray(asset.chunk_centroid)
    half = " ".join(map(str, np.asarray(asset.chunk_size)[0]))
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, turn)
    world_center = place + center @ matrix.reshape(3, 3).T

    def text(vector):
        return " ".join(f"{x:.9g}" for x in vector)

    def geom(position):
        return (
            f'<geom type="box" size="{half}" pos="{text(position)}" '
            f'density="{DENSITY}" contype="0" conaffinity="1"/>'
        )

    if single:
        cubes = "".join(geom(c) for c in center)
        bodies = (
            f'<body pos="{text(place)}" quat="{text(turn)}"><freejoint/>{cubes}</body>'
        )
        welds = ""
    else:
        bodies = "".join(
            f'<body name="b{i}" pos="{text(c)}" quat="{text(turn)}"><freejoint/>'
            f"{geom((0, 0, 0))}</body>"
            for i, c in enumerate(world_center)
        )
        welds = "".join(
            f'<weld body1="b{a}" body2="b{b}"/>'
            for a, b in np.asarray(asset.bond_nodes)
        )
    return (
        f'<mujoco><option timestep="{options.timestep}" '
        f'iterations="{options.iterations}" ls_iterations="{options.line_search}">'
        '<flag eulerdamp="disable"/></option>'
        f'<worldbody><geom type="plane" size="0 0 .05"/>{bodies}</worldbody>'
        f"<equality>{welds}</equality></mujoco>"
    )


def batched(data, count):
    """Repeat a world, and let the copies fall at slightly different speeds."""
    copies = jax.tree.map(lambda x: jnp.repeat(x[None], count, axis=0), data)
    speed = -0.2 * jnp.arange(count, dtype=jnp.float32) / count
    return copies, speed


def timed(step, start, options):
    """Return (seconds to compile, seconds a batched step once it rests)."""
    began = time.perf_counter()
    compiled = jax.jit(step).lower(start).compile()
    compiling = time.perf_counter() - began
    now = start
    for _ in range(options.settle):
        now = compiled(now)
    jax.block_until_ready(now)
    laps = []
    for _ in range(options.repeat):
        began = time.perf_counter()
        for _ in range(options.steps):
            now = compiled(now)
        jax.block_until_ready(now)
        laps.append((time.perf_counter() - began) / options.steps)
    return compiling, min(laps)


def run(options):
    """Return all figures."""
    asset = shapes.grid((options.cubes,) * 3, (EDGE,) * 3)
    height = 0.5 * EDGE * options.cubes * (1 + TILT) + GAP
    center = np.asarray(asset.chunk_centroid).mean(0)
    place = np.array([0.0, 0.0, height]) - center
    turn = np.array([np.cos(TILT / 2), np.sin(TILT / 2), 0.0, 0.0])
    figures = {"cubes": len(asset.chunk_volume), "batch": options.batch}

    scene = build(
        asset,
        slots=options.slots,
        position=place,
        quaternion=turn,
        density=DENSITY,
        chunk_contacts=False,
        timestep=options.timestep,
        iterations=options.iterations,
        line_search=options.line_search,
    )
    worlds, speed = batched(world.init(scene), options.batch)
    dof = scene.host.slot_dof[0, 2]
    qvel = worlds.data.qvel.at[:, dof].add(speed)
    worlds = worlds.replace(data=worlds.data.replace(qvel=qvel))
    impact = world.Impact(threshold=1e9, hardness=1.0, min_radius=0.3, max_radius=1.0)
    ours = {
        "ours, breaking": lambda w: world.step(scene, w, impact=impact)[0],
        "ours, rigid only": lambda w: world.step(scene, w)[0],
    }
    for name, step in ours.items():
        figures[name] = timed(jax.vmap(step), worlds, options)

    for name, single in (("MJX welds", False), ("MJX one body", True)):
        text = welded(asset, place, turn, options, single=single)
        model = mujoco.MjModel.from_xml_string(text)
        device = mjx.put_model(model, impl="jax")
        datas, speed = batched(mjx.make_data(device), options.batch)
        qvel = datas.qvel.at[:, 2::6].add(speed[:, None])
        datas = datas.replace(qvel=qvel)
        step = jax.vmap(lambda d, m=device: mjx.step(m, d))
        figures[name] = timed(step, datas, options)
        data = mujoco.MjData(model)
        for _ in range(options.settle):
            mujoco.mj_step(model, data)
        began = time.perf_counter()
        for _ in range(options.steps):
            mujoco.mj_step(model, data)
        native = (time.perf_counter() - began) / options.steps * options.batch
        figures[name.replace("MJX", "C")] = (0.0, native)
    figures["ratio"] = figures["MJX welds"][1] / figures["ours, breaking"][1]
    return figures


def main(arguments=None):
    """Print the table, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batch", type=int, default=64, help="worlds at a time")
    parser.add_argument("--cubes", type=int, default=3, help="cubes along an edge")
    parser.add_argument("--slots", type=int, default=8, help="K")
    parser.add_argument("--timestep", type=float, default=0.002, help="s")
    parser.add_argument("--iterations", type=int, default=20, help="of every solver")
    parser.add_argument("--line-search", type=int, default=6, help="of every solver")
    parser.add_argument("--settle", type=int, default=100, help="steps before timing")
    parser.add_argument("--steps", type=int, default=10, help="steps a lap")
    parser.add_argument("--repeat", type=int, default=3, help="laps, the best counts")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(arguments)
    figures = run(options)
    if options.json:
        print(json.dumps(figures))
        return
    print(f"{figures['cubes']} cubes, {options.slots} slots, batch {options.batch}")
    print(f"{'':20}{'us a world step':>18}{'compile s':>12}")
    for name, figure in figures.items():
        if isinstance(figure, tuple):
            lap = figure[1] / options.batch * 1e6
            print(f"{name:20}{lap:18.0f}{figure[0]:12.1f}")
    print(f"MJX welds / ours: {figures['ratio']:.1f}")


if __name__ == "__main__":
    main()
