"""What scenes with less and less cost: python -m tests.benchmarks.leanness.

Operations are counted in the traced program, before any optimisation. Compile time
includes tracing, time is the least of laps of all scenes in turn, scratch is what the
compiled program asks for besides its arguments and results, state is what one scene
carries from step to step. All on one core of one process.
"""

import argparse
import json
import pathlib
import time

import jax
import jax.numpy as jnp
import numpy as np

from blastjax import chunks, damage, fracture, stress, world
from blastjax.author import shapes
from blastjax.core import Damage
from blastjax.rigid import build
from tests.benchmarks.timing import least, one_core
from tests.operations import trace

ARM = """
<mujoco><worldbody>
  <geom type="plane" size="0 0 1"/>
  <body pos="3 0 2">
    <joint name="hinge" limited="true" range="-1 1"/><geom size="0.1"/>
  </body>
</worldbody><actuator><motor joint="hinge"/></actuator></mujoco>
"""
FLOOR = '<mujoco><worldbody><geom type="plane" size="0 0 1"/></worldbody></mujoco>'
AIR = "<mujoco/>"


def round_trips(cubes):
    """Yield name, step and state of one body, with less and less."""
    side, edge = (cubes,) * 3, (1.0 / cubes,) * 3
    full = {"anchor": ("z-",), "root": True, "pieces": (2, 1, 1)}
    point = jnp.array([0.2, 0.1, 0.5])

    def radial(asset, seen=True, on_chunks=True):
        def step(state):
            hit = damage.falloff(asset, state, point, 0.4, 0.1, 0.4)
            hit = hit if on_chunks else Damage(bond=hit.bond)
            state, events = fracture.step(asset, state, hit)
            return (state, events, chunks.visible(asset, state)) if seen else state

        return step

    asset = shapes.grid(side, edge, **full)
    masked = jnp.ones(asset.bond_nodes.shape[0])
    yield "all, unbreakable masks", radial(asset), fracture.init(asset, masked)
    yield "all can break", radial(asset), fracture.init(asset)
    for name, part in (
        ("no sub-support chunks", "pieces"),
        ("no world bonds", "anchor"),
        ("no hierarchy", "root"),
    ):
        del full[part]
        asset = shapes.grid(side, edge, **full)
        yield name, radial(asset), fracture.init(asset)
    yield "no chunk damage", radial(asset, on_chunks=False), fracture.init(asset)
    yield "no events", radial(asset, False, False), fracture.init(asset)


def world_steps(cubes):
    """Yield name, step and world, with less and less."""
    side, edge = (cubes,) * 3, (0.5,) * 3
    anchored = shapes.grid(side, edge, anchor=("z-",))
    plain = shapes.grid(side, edge)
    raised = {"position": (0.0, 0.0, 0.25 * cubes), "slots": 8}
    held = build(anchored, model=ARM, **raised)
    limits = stress.Limits(1e6, 1e7)
    load = world.Stress(stress.structure(held.asset), limits)
    options = {"impact": world.Impact(1e4, 1e3), "stress": load, "remove_dead": True}

    def stepping(scene, **options):
        return lambda now: world.step(scene, now, **options)

    def row(name, scene, **options):
        return name, stepping(scene, **options), world.init(scene)

    yield row("all", held, **options)
    for name, part in (("no stress", "stress"), ("no debris", "remove_dead")):
        del options[part]
        yield row(name, held, **options)
    scene = build(plain, model=ARM, **raised)
    yield row("no world bonds", scene, **options)
    scene = build(plain, model=FLOOR, **raised)
    yield row("no joints, no motors", scene, **options)
    scene = build(plain, model=FLOOR, chunk_contacts=False, **raised)
    yield row("no chunk contacts", scene, **options)
    yield row("no impact", scene, damage=Damage(bond=jnp.zeros(len(plain.bond_nodes))))
    yield row("nothing breaks", scene)
    yield row("no floor", build(plain, model=AIR, chunk_contacts=False, **raised))


def measure(cases, batch, repeats):
    """Return one row a case."""
    rows, calls = [], {}
    for name, step, start in cases:
        began = time.perf_counter()
        program = trace(step, start)
        counted = time.perf_counter()
        many = jax.tree.map(lambda x: jnp.repeat(x[None], batch, axis=0), start)
        compiled = jax.jit(jax.vmap(step)).lower(many).compile()
        compiling = time.perf_counter() - counted
        scratch = compiled.memory_analysis().temp_size_in_bytes
        rows.append(
            {
                "scene": name,
                "operations": program.operations,
                "trace_s": counted - began,
                "compile_s": compiling,
                "scratch": scratch // batch,
                "state": sum(np.asarray(x).nbytes for x in jax.tree.leaves(start)),
            }
        )
        calls[name] = lambda f=compiled, x=many: jax.block_until_ready(f(x))
        calls[name]()
    times = least(calls, repeats)
    return [row | {"us": 1e6 * times[row["scene"]] / batch} for row in rows]


def report(title, rows):
    """Print one table."""
    print(f"{title:24}{'operations':>11}{'compile s':>11}{'us':>10}", end="")
    print(f"{'scratch B':>11}{'state B':>9}")
    for row in rows:
        print(
            f"{row['scene']:24}{row['operations']:11d}{row['compile_s']:11.1f}"
            f"{row['us']:10.2f}{row['scratch']:11d}{row['state']:9d}",
            flush=True,
        )


def main(arguments=None):
    """Print the tables; write JSON where told to."""
    one_core()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=["fracture", "world"])
    parser.add_argument("--cubes", type=int, help="an edge; 8 (fracture) and 2 (world)")
    parser.add_argument("--batch", type=int, help="1,024 (fracture) and 64 (world)")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--json", type=pathlib.Path)
    chosen = parser.parse_args(arguments)
    tables = {}
    for name, title, cases, cubes, batch in (
        ("fracture", "round trip", round_trips, 8, 1024),
        ("world", "world step", world_steps, 2, 64),
    ):
        if chosen.only in (None, name):
            found = cases(chosen.cubes or cubes)
            rows = measure(found, chosen.batch or batch, chosen.repeats)
            report(title, rows)
            tables[name] = rows
    if chosen.json:
        chosen.json.write_text(json.dumps(tables, indent=1))


if __name__ == "__main__":
    main()
