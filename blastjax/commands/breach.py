"""`python -m blastjax`: break a batch of brick walls, or of what a file holds."""

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from blastjax import tiles
from blastjax.commands.options import number, progress, quiet, whole

HELP = (
    "Shoot cannonballs at a batch of brick walls, each at another place, and show what "
    "is left of them."
)
_ROWS = (
    ("actors", "actors", "{:.0f}", "{:.1f}"),
    ("broken bonds", "broken_bonds", "{:.0f}", "{:.1f}"),
    ("freed volume, m^3", "freed_volume", "{:.3f}", "{:.3f}"),
    ("fallen volume, m^3", "fallen_volume", "{:.3f}", "{:.3f}"),
    ("largest loose piece, m^3", "largest_piece", "{:.3f}", "{:.3f}"),
    ("debris", "debris", "{:.0f}", "{:.1f}"),
)


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("--batch", type=whole(1), default=64, help="walls that are simulated together")
    add("--steps", type=whole(1), default=32, help="environment steps of 0.04 s each")
    add("--seed", type=whole(0), default=0, help="of the marked bricks and the aims")
    add("--asset", help="file of `fracture` to break instead of walls of bricks")
    add(
        "--collision",
        choices=("auto", "box", "sphere", "hull"),
        default="auto",
        help="as what chunks collide; auto takes hulls where there are meshes",
    )
    add("--bricks", type=whole(1), default=5, help="whole bricks in a course")
    add("--courses", type=whole(1), default=5, help="courses of the wall")
    add("--slots", type=whole(1), default=12, help="most pieces that move in a wall")
    add("--out", default="breach.gif", help="animation to write: .gif or .mp4")
    add("--show", type=whole(0), default=0, help="number of the wall to animate")
    add("--width", type=whole(16), default=480, help="of the animation, pixels")
    add("--height", type=whole(16), default=360, help="of the animation, pixels")
    add(
        "--fps",
        type=number(high=100.0),
        default=15.0,
        help="frames a second; 25 is real time",
    )
    add(
        "--backend",
        choices=("auto", "mujoco", "matplotlib"),
        default="auto",
        help="what draws; auto takes MuJoCo if it finds OpenGL",
    )


def run(args: argparse.Namespace, parser: argparse.ArgumentParser) -> int:
    """Run the command and return the exit code."""
    if args.show >= args.batch:
        parser.error(f"argument --show: there is no wall {args.show} in {args.batch}")
    started = time.perf_counter()
    with quiet():
        from blastjax import render
    try:
        render.check_path(args.out)
    except ValueError as error:
        parser.error(f"argument --out: {error}")
    if args.backend == "mujoco" and render.find_gl() is None:
        parser.error("argument --backend: MuJoCo finds no OpenGL here; try matplotlib")
    bar = progress()

    try:
        env = _environment(args)
    except (ValueError, OSError) as error:
        parser.error(f"argument --asset: {error}" if args.asset else str(error))
    what = f"walls of {env.bricks} bricks"
    if args.asset:
        what = f"times {args.asset} of {env.bricks} chunks"
    device = jax.local_devices()[0].device_kind
    print(f"{args.batch} {what} on {device}; compiling", flush=True)
    before = time.perf_counter()
    key_marks, key_aims = jax.random.split(jax.random.PRNGKey(args.seed))
    keys = jax.random.split(key_marks, args.batch)
    actions = _shots(args.batch, key_aims, args.seed)
    state, step, look = _programs(env, keys, actions)
    compiled = time.perf_counter() - before

    poses = [look(state, args.show)]
    before = time.perf_counter()
    for _ in bar(range(args.steps), desc="breaking", unit="step"):
        state = jax.block_until_ready(step(state))
        poses.append(look(state, args.show))
    ran = time.perf_counter() - before

    print(_table({name: np.asarray(value) for name, value in state.metrics.items()}))
    stepped = args.batch * args.steps / ran
    print(
        f"compiled in {compiled:.1f} s, ran in {ran:.1f} s: {stepped:,.0f} environment "
        f"steps/s, {stepped * env.config.frames:,.0f} physics steps/s"
    )
    with render.Renderer(
        env.scene, width=args.width, height=args.height, backend=args.backend
    ) as renderer:
        drawn = [
            renderer.draw(each) for each in bar(poses, desc="drawing", unit="frame")
        ]
    render.save(args.out, drawn, fps=args.fps)
    total = time.perf_counter() - started
    print(
        f"wrote {args.out}: {len(drawn)} frames of wall {args.show}, drawn by "
        f"{renderer.backend}; {total:.0f} s in all"
    )
    return 0


def _environment(args: argparse.Namespace) -> Any:
    with quiet():
        from blastjax import envs, serialize
    collision = None if args.collision == "auto" else args.collision
    if not args.asset:
        return envs.Breach(
            bricks=args.bricks,
            courses=args.courses,
            slots=args.slots,
            collision=collision,
        )
    saved = serialize.load(args.asset)
    if saved.asset is None:
        raise ValueError(f"{args.asset} holds no asset")
    what = saved.asset if saved.meshes is None else saved.destructible
    return envs.Breach(asset=what, slots=args.slots, collision=collision)


def _shots(batch: int, key: jax.Array, seed: int) -> jax.Array:
    """Return an action for each wall, (batch, 4): aims spread evenly over the wall."""
    # Multiples of the plastic number's powers fill a square evenly, in any number.
    plastic = 1.32471795724
    turns = jnp.arange(batch)[:, None] / jnp.array([[plastic, plastic**2]])
    start = jax.random.uniform(key, (1, 2)) if seed else jnp.full((1, 2), 0.5)
    aims = 1.6 * ((start + turns) % 1.0) - 0.8
    speed, trigger = jnp.full((batch, 1), 0.3), jnp.ones((batch, 1))
    return jnp.concatenate([aims, speed, trigger], axis=1)


def _programs(
    env: Any, keys: jax.Array, actions: jax.Array
) -> tuple[Any, Callable, Callable]:
    """Return the batch at its start, its compiled step, and the pose of one wall."""
    from blastjax import render

    # One device, though a CPU could be split into one for each core: two devices of one
    # process can block each other for good in XLA's thread pool.
    state = jax.block_until_ready(jax.jit(tiles.vmap(env.reset))(keys))
    step = jax.jit(tiles.vmap(env.step)).lower(state, actions).compile()

    @jax.jit
    def look(state: Any, index: int) -> render.Pose:
        one = jax.tree.map(lambda x: x[index], state.pipeline_state)
        return render.pose(env.scene, env.world(one), env.highlight(one))

    return state, lambda state: step(state, actions), look


def _table(metrics: dict[str, np.ndarray]) -> str:
    lines = [f"{'':26}{'least':>9}{'mean':>9}{'most':>9}"]
    for title, name, exact, mean in _ROWS:
        values = metrics[name]
        cells = (
            exact.format(values.min()),
            mean.format(values.mean()),
            exact.format(values.max()),
        )
        lines.append(f"{title:26}" + "".join(f"{cell:>9}" for cell in cells))
    return "\n".join(lines)
