"""How good gradients of fracture are: python -m tests.benchmarks.gradient_quality.

The loss is a weighted count of what comes loose when bonds of random strength (logistic
noise) are hit; the gradient is by the blow's place, amount and radius. The reference is
the mean over very many samples of the leave-one-out score function; its own error is
printed, and bond flips check it. The error of leave-one-out is a / sqrt(runs) of the
gradient's length; a is also printed for random blows, to whom one blow is no witness.

For each estimator and number of runs of the loss: root mean square error, bias and
deviation relative to the length of the reference, the mean cosine, and time per
estimate. `--picture FILE` draws error against run time.
"""

import argparse
import json
import time

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np

from blastjax import chunks, damage, fracture, soft
from blastjax.author import shapes
from blastjax.core import Damage

TEMPERATURE = 0.1


def blow(x, z, amount, radius):
    """Return the parameters of a blow at (x, 0, z)."""
    return {
        "at": jnp.array([x, 0.0, z], jnp.float32),
        "amount": jnp.float32(amount),
        "radius": jnp.float32(radius),
    }


class Case:
    """A wall, a blow, and a loss of what comes loose."""

    def __init__(self, width, height, blow):
        asset = shapes.grid((width, 1, height), anchor=("z-",), dtype=np.float32)
        self.name, self.asset = f"{width} x {height}", asset
        nodes = asset.span_node.shape[0]
        place = chunks.element_values(asset, asset.chunk_centroid)[:nodes]
        self.worth = 0.5 + place[:, 2] / height
        self.size = width, height
        self.parameters = blow
        self.strength = soft.logistic(TEMPERATURE)

    def act(self, parameters):
        state = fracture.init(self.asset)
        dealt = damage.falloff(
            self.asset,
            state,
            parameters["at"],
            parameters["amount"],
            0.1 * parameters["radius"],
            parameters["radius"],
        )
        return state, Damage(bond=dealt.bond)

    def loss(self, state, parameters):
        loose = state.actor[: self.worth.shape[0]] != 0
        return jnp.sum(jnp.where(loose, self.worth, 0))

    def outcome(self, parameters, noise):
        """Return the loss of one draw of strengths, by logistic noise (B,)."""
        state, blow = self.act(parameters)
        left = soft.bond_margin(self.asset, state, blow) + TEMPERATURE * noise
        after, _ = fracture.split(self.asset, state.replace(bond_intact=left > 0))
        return self.loss(after, parameters)

    def noise(self, key, samples):
        shape = samples, self.asset.bond_area.shape[0]
        return jax.random.logistic(key, shape, jnp.float32)


def flat(tree):
    return jax.flatten_util.ravel_pytree(tree)[0]


def estimators(case, size):
    """Return name -> (runs of the loss, function of a key), at about `size` runs."""
    asset, at = case.asset, case.parameters
    vector, shaped = jax.flatten_util.ravel_pytree(at)
    unknowns, bonds = vector.size, asset.bond_area.shape[0]
    given = asset, case.act, case.loss

    def hard(parameters, key):
        def total(parameters):
            state, blow = case.act(parameters)
            after, _ = fracture.step(asset, state, blow)
            return case.loss(after, parameters)

        return flat(jax.grad(total)(parameters))

    def relaxed(parameters, key):
        def total(parameters):
            state, blow = case.act(parameters)
            weight = soft.loosen(asset, state, blow, temperature=TEMPERATURE)
            nodes = case.worth.shape[0]
            down = jnp.zeros((nodes, 3), jnp.float32).at[:, 2].set(-1.0)
            # What the world holds stays; what is loose moves with all of its speed.
            v, _ = soft.share_velocity(
                asset, weight, down, jnp.zeros_like(down), stiffness=1e3
            )
            return jnp.sum(case.worth * -v[:, 2])

        return flat(jax.grad(total)(parameters))

    def leave_one_out(parameters, key):
        found = soft.expect(*given, parameters, key, size, strength=case.strength)
        return flat(found.gradient)

    flips = max(2, size // (bonds + 1))

    def flip(parameters, key):
        found = soft.expect_by_flips(
            *given, parameters, key, flips, strength=case.strength
        )
        return flat(found.gradient)

    pairs = max(1, size // (2 * unknowns))

    def differences(parameters, key):
        noise, h = case.noise(key, pairs), 0.1
        center = flat(parameters)

        def mean(vector):
            run = jax.vmap(lambda n: case.outcome(shaped(vector), n))
            return jnp.mean(run(noise))

        def along(axis):
            off = h * jax.nn.one_hot(axis, unknowns)
            return (mean(center + off) - mean(center - off)) / (2 * h)

        return jax.vmap(along)(jnp.arange(unknowns))

    mirrored = max(1, size // 2)

    def evolution(parameters, key):
        one, two = jax.random.split(key)
        noise, spread = case.noise(one, mirrored), 0.1
        center = flat(parameters)
        direction = jax.random.normal(two, (mirrored, unknowns))

        def pair(direction, noise):
            ends = [
                case.outcome(shaped(center + sign * spread * direction), noise)
                for sign in (1, -1)
            ]
            return direction * (ends[0] - ends[1]) / (2 * spread)

        return jnp.mean(jax.vmap(pair)(direction, noise), axis=0)

    table = {
        "leave-one-out": (size, leave_one_out),
        "bond flip": (flips * (bonds + 1), flip),
        "finite differences": (pairs * 2 * unknowns, differences),
        "evolution strategy": (mirrored * 2, evolution),
    }
    if size == min_size():
        table = {"hard": (1, hard), "soft relaxation": (1, relaxed)} | table
    return table


SIZES = (16, 64, 256, 1024)


def min_size():
    return SIZES[0]


def reference(case, seed, batches, size):
    """Return the mean gradient, and the standard error of its length."""
    run = jax.jit(
        lambda p, key: flat(
            soft.expect(
                case.asset, case.act, case.loss, p, key, size, strength=case.strength
            ).gradient
        )
    )
    keys = jax.random.split(jax.random.key(seed), batches)
    found = np.stack(
        [np.asarray(run(case.parameters, key), np.float64) for key in keys]
    )
    error = found.std(axis=0, ddof=1) / np.sqrt(batches)
    return found.mean(axis=0), error


def flip_check(case, truth, error, seed, repeats, size):
    """Return how far bond flips are from the reference: chi^2 a degree of freedom."""
    run = jax.jit(
        lambda p, key: flat(
            soft.expect_by_flips(
                case.asset, case.act, case.loss, p, key, size, strength=case.strength
            ).gradient
        )
    )
    keys = jax.random.split(jax.random.key(seed), repeats)
    found = np.stack(
        [np.asarray(run(case.parameters, key), np.float64) for key in keys]
    )
    own = found.std(axis=0, ddof=1) / np.sqrt(repeats)
    spread = np.sqrt(own**2 + error**2)
    seen = spread > 1e-9
    off = (found.mean(axis=0) - truth)[seen] / spread[seen]
    length = np.linalg.norm(truth)
    return {
        "relative distance": float(np.linalg.norm(found.mean(0) - truth) / length),
        "expected distance": float(np.linalg.norm(spread) / length),
        "worst z": float(np.abs(off).max()),
        "chi2 per degree": float(np.mean(off**2)),
    }


def assess(case, truth, repeats, seed, sizes):
    """Return a row for each estimator and size."""
    rows, length = [], np.linalg.norm(truth)
    for size in sizes:
        for name, (runs, estimate) in estimators(case, size).items():
            once = runs == 1
            f = jax.jit(estimate)
            keys = jax.random.split(jax.random.key(seed), 1 if once else repeats)
            jax.block_until_ready(f(case.parameters, keys[0]))
            found, laps = [], []
            for key in keys:
                began = time.perf_counter()
                found.append(np.asarray(f(case.parameters, key), np.float64))
                laps.append(time.perf_counter() - began)
            found = np.stack(found)
            off = found - truth
            spread = found.std(axis=0)
            cosine = (
                found
                @ truth
                / np.maximum(np.linalg.norm(found, axis=1) * length, 1e-12)
            )
            rows.append(
                {
                    "case": case.name,
                    "estimator": name,
                    "runs": runs,
                    "rmse": float(np.sqrt(np.mean(np.sum(off**2, 1))) / length),
                    "bias": float(np.linalg.norm(off.mean(0)) / length),
                    "noise of bias": float(
                        np.linalg.norm(spread) / np.sqrt(len(keys)) / length
                    ),
                    "deviation": float(np.linalg.norm(spread) / length),
                    "cosine": float(cosine.mean()),
                    "milliseconds": 1e3 * float(np.median(laps)),
                }
            )
    return rows


def spread(case, seed, count, size):
    """Return quartiles of the leave-one-out error times sqrt(runs), over blows."""
    rng = np.random.default_rng(seed)
    width, height = case.size
    run = jax.jit(
        lambda p, key: soft.expect(
            case.asset, case.act, case.loss, p, key, size, strength=case.strength
        )
    )
    factors = []
    for key in jax.random.split(jax.random.key(seed), count):
        hit = blow(
            rng.uniform(-0.4, 0.4) * width,
            rng.uniform(0.2, 0.9) * height,
            rng.uniform(1.2, 3.0),
            rng.uniform(0.3, 0.7) * min(width, height),
        )
        found = run(hit, key)
        length = np.linalg.norm(flat(found.gradient))
        error = np.linalg.norm(flat(found.gradient_error))
        factors.append(error * np.sqrt(size) / max(length, 1e-9))
    return np.percentile(factors, [25, 50, 75]).round(2).tolist()


def draw(rows, path):
    """Draw error against run time, one panel a case."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    cases = list(dict.fromkeys(row["case"] for row in rows))
    figure, panels = plt.subplots(1, len(cases), figsize=(5.5 * len(cases), 4.4))
    names = list(dict.fromkeys(row["estimator"] for row in rows))
    for case, panel in zip(cases, np.atleast_1d(panels), strict=True):
        for number, name in enumerate(names):
            mine = [r for r in rows if (r["case"], r["estimator"]) == (case, name)]
            panel.loglog(
                [r["milliseconds"] for r in mine],
                [r["rmse"] for r in mine],
                marker="osD^vP"[number % 6],
                label=name,
                color=f"C{number}",
            )
        panel.axhline(1.0, color="0.6", lw=0.8, ls=":")
        panel.set_title(f"wall {case}")
        panel.set_xlabel("time per estimate, ms")
        panel.grid(True, which="both", alpha=0.2)
    np.atleast_1d(panels)[0].set_ylabel("relative error of the gradient (RMS)")
    np.atleast_1d(panels)[-1].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=130)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=128)
    parser.add_argument("--batches", type=int, default=64)
    parser.add_argument("--small", action="store_true", help="the 5 x 4 wall only")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--picture")
    parser.add_argument("--json")
    options = parser.parse_args()
    small = Case(5, 4, blow(-1.4, 1.4, 2.0, 1.6))
    cases = [(small, SIZES, 4096, options.batches, 16)]
    if not options.small:
        large = Case(16, 16, blow(-4.2, 7.0, 2.0, 8.0))
        cases.append((large, SIZES, 1024, options.batches, 2))
    rows, checks = [], {}
    for case, sizes, size, batches, flips in cases:
        truth, error = reference(case, options.seed + 1000, batches, size)
        length = np.linalg.norm(truth)
        check = flip_check(case, truth, error, options.seed + 2000, 32, flips)
        check["reference error"] = float(np.linalg.norm(error) / length)
        blows = spread(case, options.seed + 3000, 16, size)
        checks[case.name] = check
        print(f"wall {case.name}: reference of {batches * size} samples")
        for name, value in check.items():
            print(f"  bond flip against it, {name}: {value:.4f}")
        print(f"  leave-one-out error a / sqrt(runs), quartiles of a: {blows}")
        checks[case.name]["a over blows"] = blows
        print(f"  {'estimator':20s}   runs   rmse   bias (noise)   dev  cosine      ms")
        found = assess(case, truth, options.repeats, options.seed, sizes)
        for r in found:
            print(
                f"  {r['estimator']:20s} {r['runs']:6d} {r['rmse']:6.3f} "
                f"{r['bias']:6.3f} ({r['noise of bias']:.3f}) {r['deviation']:6.3f} "
                f"{r['cosine']:6.3f} {r['milliseconds']:9.3f}",
                flush=True,
            )
        rows += found
    if options.json:
        with open(options.json, "w") as file:
            json.dump({"rows": rows, "checks": checks}, file, indent=1)
    if options.picture:
        draw(rows, options.picture)


if __name__ == "__main__":
    main()
