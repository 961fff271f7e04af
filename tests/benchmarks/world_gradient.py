"""Gradients of the world step: python -m tests.benchmarks.world_gradient.

A bar of cubes is thrown at the floor, slides, and breaks at given bonds where the blow
is hard enough. First in float64: reverse against forward mode, and both against finite
differences. Then 200 steps in reverse mode: time to compile, time to run, and memory.
"""

import argparse
import functools
import json
import resource
import time

import jax
import jax.numpy as jnp
import numpy as np

from blastjax import world
from blastjax.author import shapes
from blastjax.rigid import build

EDGE = 0.5


def thrown(dtype, cubes, chunk_contacts, tolerance):
    """Return a scene, a bar of cubes above the floor, and how contacts hurt."""
    asset = shapes.grid((cubes, 1, 1), (EDGE,) * 3, dtype=dtype)
    scene = build(
        asset,
        slots=cubes,
        position=(0, 0, 0.02),
        chunk_contacts=chunk_contacts,
        timestep=0.004,
        tolerance=tolerance,
        iterations=30,
        line_search=20,
    )
    impact = world.Impact(
        threshold=10.0, hardness=100.0, min_radius=0.1, max_radius=1.0
    )
    health = np.linspace(1.0, 4.0, cubes - 1).astype(dtype)
    start = world.init(scene, bond_health=health, velocity=(1.5, 0.3, -2.0))
    return scene, start, impact


def loss(scene, start, impact, push, steps):
    """Return a mix of all final places, velocities and healths; and what broke."""
    qvel = start.data.qvel.at[:6].add(push[:6])
    health = start.state.bond_health * (1 + push[6])
    moment = start.replace(
        data=start.data.replace(qvel=qvel),
        state=start.state.replace(bond_health=health),
    )
    impact = impact.replace(hardness=impact.hardness * (1 + push[7]))
    moment, seen = world.rollout(
        scene,
        moment,
        steps,
        impact=impact,
        record=lambda w, e: (e.fracture.bond_broken, e.impulse.sum()),
    )
    poses = moment.data.qpos.reshape(-1, 7)
    place = jnp.sum(poses[:, :3] * jnp.array([1.0, 2.0, 3.0], poses.dtype))
    motion = 0.1 * jnp.sum(jnp.sin(moment.data.qvel))
    return place + motion + moment.state.bond_health.sum(), seen


def check(options):
    """Return errors of derivatives in float64."""
    with jax.enable_x64(True):
        scene, start, impact = thrown(np.float64, 3, options.pieces, 1e-14)
        run = functools.partial(loss, scene, start, impact, steps=options.steps)
        push = jnp.asarray([0.0, 0.0, 0.0, 0.2, -0.1, 0.3, 0.0, 0.0])
        began = time.perf_counter()
        (_, seen), back = jax.jit(jax.value_and_grad(run, has_aux=True))(push)
        reverse_time = time.perf_counter() - began
        began = time.perf_counter()
        forward = jax.jit(jax.jacfwd(run, has_aux=True))(push)[0]
        forward_time = time.perf_counter() - began
        broken, impulse = (np.asarray(x) for x in seen)
        plain = jax.jit(run)
        quotient, same = np.zeros(8), True
        for axis in range(8):
            # Fourth order: less truncation, so a wider step and less rounding.
            h = options.step * np.eye(8)[axis]
            ahead = [plain(push + k * h) for k in (-2, -1, 1, 2)]
            a, b, c, d = (float(x[0]) for x in ahead)
            quotient[axis] = (a - 8 * b + 8 * c - d) / (12 * options.step)
            same &= all(bool((x[1][0] == broken).all()) for x in ahead)
    back, forward = np.asarray(back), np.asarray(forward)
    scale = np.abs(forward).max()
    return {
        "steps": options.steps,
        "bonds broken at step": [int(np.argmax(b)) for b in broken.T if b.any()],
        "steps with contact": int((impulse > 0).sum()),
        "reverse - forward": float(np.abs(back - forward).max() / scale),
        "reverse - difference quotient": float(np.abs(back - quotient).max() / scale),
        "same bonds broke in all quotients": same,
        "gradient": back.tolist(),
        "compile and run, reverse, s": reverse_time,
        "compile and run, forward, s": forward_time,
    }


def measure(options):
    """Return cost and memory of a long rollout in reverse mode, float32."""
    scene, start, impact = thrown(np.float32, options.cubes, True, 1e-8)

    def total(push):
        return loss(scene, start, impact, push, options.long)

    push = jnp.zeros(8, jnp.float32)
    began = time.perf_counter()
    compiled = jax.jit(jax.value_and_grad(total, has_aux=True)).lower(push).compile()
    compiling = time.perf_counter() - began
    held = compiled.memory_analysis()
    began = time.perf_counter()
    (_, seen), slope = jax.block_until_ready(compiled(push))
    running = time.perf_counter() - began
    once = jax.jit(total).lower(push).compile()
    jax.block_until_ready(once(push))
    began = time.perf_counter()
    jax.block_until_ready(once(push))
    forward = time.perf_counter() - began
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {
        "steps": options.long,
        "cubes": options.cubes,
        "bonds broken": int(np.asarray(seen[0]).any(0).sum()),
        "finite": bool(np.isfinite(slope).all()),
        "compile, s": compiling,
        "run, s": running,
        "run without gradient, s": forward,
        "temporary memory, MB": held.temp_size_in_bytes / 2**20,
        "peak of the process, GB": peak,
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--step", type=float, default=2e-6)
    parser.add_argument("--long", type=int, default=200)
    parser.add_argument("--cubes", type=int, default=4)
    parser.add_argument("--pieces", action="store_true", help="let pieces collide")
    parser.add_argument("--json")
    options = parser.parse_args()
    figures = {}
    for name, run in (("float64", check), ("float32", measure)):
        figures[name] = run(options)
        print(name)
        for key, value in figures[name].items():
            print(f"  {key:36s} {value}", flush=True)
    if options.json:
        with open(options.json, "w") as file:
            json.dump(figures, file, indent=1)


if __name__ == "__main__":
    main()
