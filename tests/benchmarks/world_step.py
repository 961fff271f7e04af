"""A step of a breaking world against its peers: python -m tests.benchmarks.world_step.

The same block of cubes lands on a plane: as this library's breakable, with and without
damage by impact, and a batch of more than one tile by `tiles.vmap` too; as MJX bodies
welded at every bond; as a single MJX body that cannot break; and both of these in
MuJoCo C. float32 (C: float64), one process, the same time step and iteration limits,
laps of all of them in turn, the best of each counts.
"""

import argparse
import json
import time
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from blastjax import tiles, world
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


class Batch:
    """A compiled step of many worlds that have come to rest."""

    def __init__(self, step, start, options, vmap=jax.vmap):
        began = time.perf_counter()
        self.step = jax.jit(vmap(step)).lower(start).compile()
        self.compiling = time.perf_counter() - began
        self.now = start
        for _ in range(options.settle):
            self.now = self.step(self.now)
        jax.block_until_ready(self.now)
        self.bytes = sum(x.nbytes for x in jax.tree.leaves(start))

    def lap(self, steps):
        """Return seconds a step."""
        began = time.perf_counter()
        for _ in range(steps):
            self.now = self.step(self.now)
        jax.block_until_ready(self.now)
        return (time.perf_counter() - began) / steps


class Native:
    """MuJoCo C on one core, one world after the other."""

    compiling, bytes = 0.0, 0

    def __init__(self, model, options):
        self.model, self.data = model, mujoco.MjData(model)
        self.batch = options.batch
        mujoco.mj_step(model, self.data, options.settle)

    def lap(self, steps):
        """Return seconds a step of the whole batch."""
        began = time.perf_counter()
        mujoco.mj_step(self.model, self.data, steps)
        return (time.perf_counter() - began) / steps * self.batch


def competitors(options) -> dict[str, Any]:
    """Return everything that can do laps, by name."""
    asset = shapes.grid((options.cubes,) * 3, (EDGE,) * 3)
    height = 0.5 * EDGE * options.cubes * (1 + TILT) + GAP
    center = np.asarray(asset.chunk_centroid).mean(0)
    place = np.array([0.0, 0.0, height]) - center
    turn = np.array([np.cos(TILT / 2), np.sin(TILT / 2), 0.0, 0.0])
    scene = build(
        asset,
        slots=options.slots,
        position=place,
        quaternion=turn,
        density=DENSITY,
        chunk_contacts=options.chunk_contacts,
        timestep=options.timestep,
        iterations=options.iterations,
        line_search=options.line_search,
    )
    worlds, speed = batched(world.init(scene), options.batch)
    qvel = worlds.data.qvel.at[:, scene.host.slot_dof[0, 2]].add(speed)
    worlds = worlds.replace(data=worlds.data.replace(qvel=qvel))
    impact = world.Impact(threshold=1e9, hardness=1.0, min_radius=0.3, max_radius=1.0)

    def breaking(w):
        return world.step(scene, w, impact=impact)[0]

    def rigid(w):
        return world.step(scene, w)[0]

    found: dict[str, Any] = {"ours, breaking": Batch(breaking, worlds, options)}
    if options.batch > tiles.WIDTH:
        found["ours, in tiles"] = Batch(breaking, worlds, options, tiles.vmap)
    if options.alone:
        return found
    found["ours, rigid only"] = Batch(rigid, worlds, options)
    for name, single in (("welds", False), ("one body", True)):
        text = welded(asset, place, turn, options, single=single)
        model = mujoco.MjModel.from_xml_string(text)
        found[f"C {name}"] = Native(model, options)
        if options.cubes > options.mjx_welds and not single:
            continue
        device = mjx.put_model(model, impl="jax")
        datas, speed = batched(mjx.make_data(device), options.batch)
        datas = datas.replace(qvel=datas.qvel.at[:, 2::6].add(speed[:, None]))

        def step(d, device=device):
            return mjx.step(device, d)

        found[f"MJX {name}"] = Batch(step, datas, options)
    return found


def run(options):
    """Return the figures of one size and one batch."""
    rivals = competitors(options)
    laps = {name: [] for name in rivals}
    for _ in range(options.repeat):
        for name, rival in rivals.items():
            laps[name].append(rival.lap(options.steps))
    return {
        "chunks": options.cubes**3,
        "batch": options.batch,
        "slots": options.slots,
        "microseconds": {n: min(x) / options.batch * 1e6 for n, x in laps.items()},
        "compile_seconds": {n: r.compiling for n, r in rivals.items()},
        "bytes": {n: r.bytes // options.batch for n, r in rivals.items()},
    }


def show(figures):
    """Print one table."""
    print(
        f"{figures['chunks']} chunks, {figures['slots']} slots, "
        f"batch {figures['batch']}"
    )
    print(f"{'':18}{'us a world step':>16}{'of ours':>9}{'compile s':>11}{'bytes':>9}")
    ours = figures["microseconds"]["ours, breaking"]
    for name, lap in figures["microseconds"].items():
        compiling, size = figures["compile_seconds"][name], figures["bytes"][name]
        print(f"{name:18}{lap:16.0f}{lap / ours:9.2f}{compiling:11.1f}{size:9d}")


def draw(tables, path):
    """Write a picture of time against size or batch."""
    from matplotlib import figure

    sizes = {t["chunks"] for t in tables}
    key = "chunks" if len(sizes) > 1 else "batch"
    canvas = figure.Figure(figsize=(6, 4), layout="constrained")
    axes = canvas.add_subplot()
    for name in dict.fromkeys(n for t in tables for n in t["microseconds"]):
        line = [(t[key], t["microseconds"].get(name, np.nan)) for t in tables]
        axes.loglog(*zip(*line, strict=True), "o-", label=name)
    ticks = sorted({t[key] for t in tables})
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.set_xlabel(key)
    axes.set_ylabel("microseconds a step of a world")
    axes.legend()
    canvas.savefig(path, dpi=150)


def main(arguments=None):
    """Print tables; write JSON and a picture where told to."""
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--batch", type=int, nargs="+", default=[64], help="worlds at a time")
    add("--cubes", type=int, nargs="+", default=[3, 4], help="cubes along an edge")
    add("--slots", type=int, default=8, help="K")
    add("--chunk-contacts", action="store_true", help="let our chunks meet each other")
    add("--alone", action="store_true", help="leave the peers out")
    add("--mjx-welds", type=int, default=3, help="most cubes an edge for MJX's welds")
    add("--timestep", type=float, default=0.002, help="s")
    add("--iterations", type=int, default=20, help="of every solver")
    add("--line-search", type=int, default=6, help="of every solver")
    add("--settle", type=int, default=100, help="steps before timing")
    add("--steps", type=int, default=10, help="steps a lap")
    add("--repeat", type=int, default=10, help="laps, the best counts")
    add("--json", metavar="FILE", help="write the figures there")
    add("--picture", metavar="FILE", help="draw time against size, or against batch")
    options = parser.parse_args(arguments)
    tables = []
    for cubes in options.cubes:
        for batch in options.batch:
            one = argparse.Namespace(
                **{**vars(options), "cubes": cubes, "batch": batch}
            )
            tables.append(run(one))
            show(tables[-1])
    if options.json:
        with open(options.json, "w") as out:
            json.dump(tables, out, indent=1)
    if options.picture:
        draw(tables, options.picture)


if __name__ == "__main__":
    main()
