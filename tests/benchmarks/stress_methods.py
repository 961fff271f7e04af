"""Bond forces, error against run time: python -m tests.benchmarks.stress_methods.

The library's methods and Blast's own scheme in float32, scipy's direct and conjugate
gradient solves in float64, all of one equation, against a refined direct solve in
float64; one process. Errors are relative, over all bond forces.
"""

import argparse
import json
import time

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from blastjax import fracture, stress
from blastjax.author import shapes
from blastjax.stress import parity

CAPS = (5, 10, 15, 25, 40, 60, 100, 200)
BLAST_CAPS = (25, 100, 400, 1600)
MOST_STEPS = 16_000
"""Where the search for the steps that a scheme needs gives up."""


def system(asset, frame, state, load):
    """Return C (6N, 6B) of the free nodes, the weights and the balanced load."""
    pairs = np.asarray(asset.bond_nodes)
    chunk = np.asarray(asset.element_chunk)[: len(frame.mass)]
    place = np.where((chunk >= 0)[:, None], np.asarray(asset.chunk_centroid)[chunk], 0)
    place, at = place.astype(float), np.asarray(asset.bond_centroid, float)
    alive = np.asarray(state.bond_intact)
    weight = np.where(alive, np.stack([frame.stiffness, frame.bending]), 0.0)
    weight = np.repeat(weight.T, 3, axis=1).reshape(-1)
    rows, columns, values = [], [], []
    bonds = np.arange(len(pairs))
    for side, sign in ((0, 1.0), (1, -1.0)):
        node = pairs[:, side]
        arm = at - place[node]
        free = chunk[node] >= 0
        for k in range(6):
            rows.append(6 * node + k)
            columns.append(6 * bonds + k)
            values.append(sign * free)
        for i, j, k, s in (
            (0, 1, 2, -1), (0, 2, 1, 1), (1, 0, 2, 1),
            (1, 2, 0, -1), (2, 0, 1, -1), (2, 1, 0, 1),
        ):  # fmt: skip
            rows.append(6 * node + 3 + i)
            columns.append(6 * bonds + j)
            values.append(sign * free * s * arm[:, k])
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    shape = 6 * len(chunk), 6 * len(pairs)
    gather = scipy.sparse.csr_matrix(entries, shape)
    right = np.concatenate([load.force, load.torque], axis=1).astype(float)
    count, piece = scipy.sparse.csgraph.connected_components(
        scipy.sparse.coo_matrix(
            (np.ones(alive.sum()), pairs[alive].T), (len(chunk), len(chunk))
        ),
        directed=False,
    )
    keep = chunk >= 0
    mass, inertia = np.asarray(frame.mass, float), np.asarray(frame.inertia, float)
    for p in range(count):
        nodes = np.flatnonzero(piece == p)
        if (chunk[nodes] < 0).any():
            continue
        total = mass[nodes].sum()
        center = (mass[nodes, None] * place[nodes]).sum(0) / total
        arm = place[nodes] - center
        own = np.einsum("ni,ni->n", arm, arm)[:, None, None] * np.eye(3)
        own = inertia[nodes] + mass[nodes, None, None] * (
            own - arm[:, :, None] * arm[:, None, :]
        )
        linear = right[nodes, :3].sum(0) / total
        twist = right[nodes, 3:] + np.cross(arm, right[nodes, :3])
        angular = np.linalg.lstsq(own.sum(0), twist.sum(0), rcond=None)[0]
        moved = linear + np.cross(angular, arm)
        right[nodes, :3] -= mass[nodes, None] * moved
        right[nodes, 3:] -= np.einsum("nij,j->ni", inertia[nodes], angular)
        # One node of a floating piece stands still.
        keep[nodes[0]] = False
    keep = np.repeat(keep, 6)
    return gather[keep], weight, -right.reshape(-1)[keep]


def direct(gather, weight, right, refine=12):
    """Return bond forces by a sparse direct solve, refined on the residual."""
    matrix = (gather @ scipy.sparse.diags(weight) @ gather.T).tocsc()
    matrix += 1e-13 * matrix.diagonal().max() * scipy.sparse.eye(matrix.shape[0])
    factor = scipy.sparse.linalg.splu(matrix)
    bond = np.zeros(gather.shape[1])
    for _ in range(refine + 1):
        bond += weight * (gather.T @ factor.solve(right - gather @ bond))
    return bond.reshape(-1, 6)


def scipy_cg(gather, weight, right, iterations):
    """Return bond forces by scipy's CG, preconditioned by the diagonal."""
    matrix = (gather @ scipy.sparse.diags(weight) @ gather.T).tocsr()
    diagonal = matrix.diagonal()
    inverse = scipy.sparse.diags(np.where(diagonal > 0, 1 / diagonal, 0.0))
    shift, _ = scipy.sparse.linalg.cg(
        matrix, right, rtol=1e-12, maxiter=iterations, M=inverse
    )
    return (weight * (gather.T @ shift)).reshape(-1, 6)


def error(force, exact):
    """Return the relative error of bond forces (B, 3)."""
    return float(
        np.linalg.norm(np.asarray(force, float) - exact[:, :3])
        / np.linalg.norm(exact[:, :3])
    )


def timed(call, repeat):
    """Return the result and the shortest time, s, once compiled."""
    jax.block_until_ready(call())
    laps = []
    for _ in range(repeat):
        start = time.perf_counter()
        result = jax.block_until_ready(call())
        laps.append(time.perf_counter() - start)
    return result, min(laps)


def cases():
    """Yield (name, asset, state, options of the structure)."""
    rng = np.random.default_rng(0)
    for length in (10, 100, 1000):
        chain = shapes.beam(length, dtype=np.float32)
        yield f"chain {length}", chain, fracture.init(chain), {}
    wall = shapes.grid((16, 1, 16), anchor=("z-",), dtype=np.float32)
    whole = fracture.init(wall)
    yield "wall 16x16", wall, whole, {}
    for part in (0.35, 0.5):
        keep = jnp.asarray(rng.random(len(wall.bond_area)) > part)
        health = jnp.where(keep, whole.bond_health, 0)
        state = whole.replace(bond_health=health, bond_intact=keep)
        yield f"wall, {part:.0%} broken", wall, state, {}
    heavy = 1000 * 10 ** rng.uniform(-3, 3, len(wall.chunk_volume))
    yield "wall, masses 1e6", wall, whole, {"density": heavy}
    stiff = 10 ** rng.uniform(-3, 3, len(wall.bond_area))
    yield "wall, stiffness 1e6", wall, whole, {"stiffness": stiff}


def study(name, asset, state, options, repeat):
    """Return rows (name, method, iterations, error, seconds, residual)."""
    rows = []
    gravity = jnp.array([1.0, 0.5, -9.81], jnp.float32)
    blast = None
    if not options:
        blast, options = as_in_blast(asset, state, gravity)
    auto = stress.structure(asset, **options)
    load = stress.gravity(auto.mass, gravity)
    parts = system(asset, auto, state, load)
    exact = direct(*parts)
    frames = {"two-level": stress.structure(asset, method="two-level", **options)}
    if auto.method == "force":
        frames["force"] = auto
    for method, frame in frames.items():
        for cap in CAPS if method == "two-level" else (0,):

            def call(frame=frame, cap=cap):
                return solve(frame, asset, state, load, cap)

            found, seconds = timed(call, repeat)
            steps = int(found.iterations)
            rows.append(
                (method, steps, error(found.force, exact), seconds,
                 float(found.residual))
            )  # fmt: skip
    for cap in BLAST_CAPS if blast is not None else ():
        force, seconds = timed(lambda cap=cap: blast(cap), repeat)
        rows.append(("Blast's scheme", cap, error(force, exact), seconds, None))
    for cap in (100, 1000):
        start = time.perf_counter()
        force = scipy_cg(*parts, cap)
        seconds = time.perf_counter() - start
        rows.append(("scipy cg", cap, error(force[:, :3], exact), seconds, None))
    start = time.perf_counter()
    force = direct(*parts, refine=0)
    seconds = time.perf_counter() - start
    rows.append(("scipy direct", 0, error(force[:, :3], exact), seconds, None))
    return [(name, *row) for row in rows]


@jax.jit
def solve(frame, asset, state, load, cap):
    """Solve to the last digit that the number of iterations allows."""
    return stress.solve(frame, asset, state, load, iterations=cap, tolerance=1e-9)


def as_in_blast(asset, state, gravity):
    """Return Blast's scheme, a function of the step limit, and the stiffnesses it has.

    These are 1 against displacement and the square of its length against rotation; its
    masses are all equal, so that bodies of equal chunks are the same problem.
    """
    bodies = parity.bodies(asset, 1000.0)
    network = parity.network(asset, state, bodies)
    push = jnp.where((bodies.mass > 0)[:, None], gravity[None], 0)
    limits = stress.Limits(1.0, 2.0)

    @jax.jit
    def blast(cap):
        found = parity.update(
            asset, state, bodies, network, parity.no_impulses(asset), push, limits,
            max_iterations=cap, cold=True, tolerance=0.0,
        )  # fmt: skip
        return found.force

    bending = np.full(len(asset.bond_area), float(network.length_scale) ** 2)
    return blast, {"stiffness": np.ones_like(bending), "bending": bending}


def against_blast(shape, repeat):
    """Return what a force error of 1e-4 costs Blast's scheme and the default here."""
    asset = shapes.grid(shape, anchor=("x-",), dtype=np.float32)
    state = fracture.init(asset)
    gravity = jnp.array([0.0, 0.0, -9.81], jnp.float32)
    blast, stiffness = as_in_blast(asset, state, gravity)
    frame = stress.structure(asset, method="two-level", **stiffness)
    load = stress.gravity(frame.mass, gravity)
    exact = direct(*system(asset, frame, state, load))

    def fewest(run, high):
        low = 1
        while error(run(high), exact) > 1e-4:
            low, high = high, 2 * high
            if low >= MOST_STEPS:
                return low
        while high - low > max(1, low // 50):
            middle = (low + high) // 2
            if error(run(middle), exact) > 1e-4:
                low = middle
            else:
                high = middle
        return high

    def ours(cap):
        return solve(frame, asset, state, load, cap).force

    rows = []
    for name, run, guess in (("Blast's scheme", blast, 500), ("two-level", ours, 8)):
        steps = fewest(run, guess)
        seconds = timed(lambda run=run, steps=steps: run(steps), repeat)[1]
        rows.append((name, steps, error(run(steps), exact), seconds))
    return rows


def draw(rows, path):
    """Draw error against run time, a panel for each case."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullFormatter

    names = list(dict.fromkeys(row[0] for row in rows))
    across = -(-len(names) // 2)
    figure, panels = plt.subplots(2, across, figsize=(4 * across, 7), squeeze=False)
    methods = {m: f"C{i}" for i, m in enumerate(dict.fromkeys(r[1] for r in rows))}
    for panel, name in zip(panels.flat, names, strict=False):
        for method, color in methods.items():
            line = [(r[4], r[3]) for r in rows if r[0] == name and r[1] == method]
            if line:
                x, y = zip(*line, strict=True)
                panel.loglog(x, y, "o-", ms=4, label=method, color=color)
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.set_title(name)
        panel.set_xlabel("run time, s")
        panel.set_ylabel("error of bond forces")
        panel.grid(alpha=0.3)
    for panel in panels.flat[len(names) :]:
        panel.axis("off")
    panels.flat[0].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def main(arguments=None):
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.stress_methods", description=__doc__
    )
    parser.add_argument("--repeat", type=int, default=3, help="laps, the best counts")
    parser.add_argument("--picture", help="draw the curves into this file")
    parser.add_argument("--json", help="write the rows into this file")
    parser.add_argument(
        "--beam", type=int, nargs=3, default=(256, 4, 4), help="beam for Blast's scheme"
    )
    options = parser.parse_args(arguments)
    rows = []
    print(f"{'case':22}{'method':14}{'steps':>6}{'error':>10}{'ms':>9}{'residual':>10}")
    for case in cases():
        for row in study(*case, options.repeat):
            rows.append(row)
            name, method, steps, wrong, seconds, residual = row
            left = "" if residual is None else f"{residual:10.1e}"
            print(
                f"{name:22}{method:14}{steps:6}{wrong:10.1e}{seconds * 1e3:9.2f}{left}"
            )
    versus = against_blast(options.beam, options.repeat)
    print(f"\nbeam {'x'.join(map(str, options.beam))} to a force error of 1e-4")
    for name, steps, wrong, seconds in versus:
        short = "" if wrong <= 1e-4 else "  (gave up)"
        print(f"{name:22}{steps:6} steps{wrong:10.1e}{seconds * 1e3:10.1f} ms{short}")
    (_, more, _, slow), (_, less, _, fast) = versus
    print(f"steps: 1/{more / less:.0f} of Blast's; time: {slow / fast:.1f} times less")
    if options.picture:
        draw(rows, options.picture)
        print(f"wrote {options.picture}")
    if options.json:
        with open(options.json, "w") as file:
            json.dump({"cases": rows, "beam": versus}, file, indent=1)
    return 0


if __name__ == "__main__":
    main()
