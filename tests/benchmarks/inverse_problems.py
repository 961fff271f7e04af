"""Inverse problems of fracture: python -m tests.benchmarks.inverse_problems.

Aiming: the place, strength and reach of one blow that frees exactly a given set of
chunks of a 16 x 16 wall. Recovery: strengths of all 64 chunks of an 8 x 8 wall that
explain which chunks came loose under a few known blows. A target is solved when the
hard outcome is exactly right. Every method starts at the same guess, evaluates its
candidates in one vmapped, compiled call, and is stopped at the same wall-clock time;
compilation is not counted. Methods take turns on every target.
"""

import argparse
import functools
import json
import math
import time

import cma
import jax
import jax.numpy as jnp
import numpy as np
import optax

from blastjax import damage, fracture, soft
from blastjax.author import shapes
from blastjax.core import Damage

STEPS_A_CALL = 25
"""Steps between looks at the clock."""
CALLS_A_START = 16
"""Calls after which descent starts anew elsewhere."""


class Aiming:
    """Find the blow (x, z, log amount, log radius) that frees exactly a set."""

    name, lanes, rate, temperature, sigma = "aiming", 4, 0.1, 0.1, 0.5

    def __init__(self, side=16):
        self.asset = shapes.grid((side, 1, side), anchor=("z-",), dtype=np.float32)
        self.side = side

    def target(self, rng):
        """Return what is known, the set to free, and the common guess."""
        while True:
            x, z = rng.uniform(-0.4, 0.4), rng.uniform(0.25, 0.85)
            truth = np.array(
                [
                    x * self.side,
                    z * self.side,
                    np.log(rng.uniform(1.5, 6.0)),
                    np.log(rng.uniform(2.5, 5.0)),
                ],
                np.float32,
            )
            known = np.zeros(1, np.float32)
            loose = np.asarray(self.loose(truth, known))
            if 6 <= loose.sum() <= 0.5 * self.side**2:
                break
        nodes = np.maximum(np.asarray(self.asset.element_chunk), 0)
        place = np.asarray(self.asset.chunk_centroid)[nodes][loose[0]]
        reach = np.sqrt(loose.sum() / np.pi) + 1
        guess = [place[:, 0].mean(), place[:, 2].mean(), np.log(3.0), np.log(reach)]
        return known, loose, np.array(guess, np.float32)

    def blow(self, parameters, known):
        asset = self.asset
        state = fracture.init(asset)
        at = jnp.stack([parameters[0], jnp.zeros_like(parameters[0]), parameters[1]])
        amount, radius = jnp.exp(parameters[2]), jnp.exp(parameters[3])
        dealt = damage.falloff(asset, state, at, amount, 0.0, radius)
        return state, Damage(bond=dealt.bond[None])

    @functools.partial(jax.jit, static_argnums=0)
    def loose(self, parameters, known):
        return loose(self, parameters, known)


class Recovery:
    """Find log strengths of all chunks from what came loose under known blows."""

    name, lanes, rate, temperature, sigma = "recovery", 4, 0.05, 0.1, 0.4

    def __init__(self, side=8, blows=6):
        self.asset = shapes.grid((side, 1, side), anchor=("z-",), dtype=np.float32)
        self.side, self.blows = side, blows

    def target(self, rng):
        """Return what is known, what came loose, and the common guess."""
        asset, side = self.asset, self.side
        while True:
            truth = rng.normal(0, 0.4, side**2).astype(np.float32)
            x = rng.uniform(-0.4, 0.4, self.blows) * side
            z = rng.uniform(0.2, 0.9, self.blows) * side
            at = np.stack([x, 0 * x, z], axis=1).astype(np.float32)
            amount = rng.uniform(1.5, 3.0, self.blows)
            known = np.stack(
                [
                    damage.falloff(asset, fracture.init(asset), p, a, 0.5, 4.0).bond
                    for p, a in zip(at, amount.astype(np.float32), strict=True)
                ]
            )
            loose = np.asarray(self.loose(truth, known))
            if (loose.sum(1) >= 4).all() and (loose.sum(1) <= 40).all():
                return known, loose, np.zeros(side**2, np.float32)

    def blow(self, parameters, known):
        asset = self.asset
        strength = jnp.exp(parameters)
        first, second = asset.bond_nodes[:, 0] - 1, asset.bond_nodes[:, 1] - 1
        other = jnp.where(second < 0, first, second)
        health = 0.5 * (strength[first] + strength[other])
        return fracture.init(asset, health), Damage(bond=known)

    @functools.partial(jax.jit, static_argnums=0)
    def loose(self, parameters, known):
        return loose(self, parameters, known)


def loose(problem, parameters, known):
    """Return which nodes come loose under each blow, (blows, N), by hard fracture."""
    state, blows = problem.blow(parameters, known)
    nodes = problem.asset.span_node.shape[0]

    def one(bond):
        after, _ = fracture.step(problem.asset, state, Damage(bond=bond))
        return after.actor[:nodes] != 0

    return jax.vmap(one)(blows.bond)


def margins(problem, parameters, known):
    state, blows = problem.blow(parameters, known)

    def one(bond):
        return soft.margin(problem.asset, state, Damage(bond=bond))

    return jax.vmap(one)(blows.bond)


def margin_loss(problem, parameters, known, target):
    """Return the release loss summed over blows, and whether all is exactly right."""
    found = margins(problem, parameters, known)

    def one(margin, target):
        return soft.release_loss(
            problem.asset, margin, target, temperature=problem.temperature
        )

    right = jnp.all((found <= 0) == target)
    return jnp.sum(jax.vmap(one)(found, target)), right


def by_margin(problem):
    """Return a solver: Adam on the margin loss from several starts at once."""
    optimizer = optax.adam(problem.rate)
    pace = jnp.asarray(np.geomspace(1.5, 0.2, problem.lanes), jnp.float32)
    slope = jax.grad(functools.partial(margin_loss, problem), has_aux=True)

    @jax.jit
    def advance(lanes, known, target):
        def running(carry):
            count, _, _, _, solved = carry
            return (count < STEPS_A_CALL) & ~jnp.any(solved)

        def step(carry):
            count, values, memory, best, _ = carry
            grads, right = jax.vmap(slope, (0, None, None))(values, known, target)
            change, memory = jax.vmap(optimizer.update)(grads, memory)
            # Long strides get there, short ones settle: lanes differ.
            change = change * pace[:, None]
            best = jnp.where(right[:, None], values, best)
            return count + 1, optax.apply_updates(values, change), memory, best, right

        values, memory = lanes
        none = jnp.zeros(values.shape[0], bool)
        carry = jax.lax.while_loop(
            running, step, (jnp.int32(0), values, memory, values, none)
        )
        return carry[1:3], carry[3], carry[4]

    def solve(known, target, guess, seconds, seed):
        rng = np.random.default_rng(seed)

        def begin(first):
            off = rng.normal(size=(problem.lanes, guess.size)) * problem.sigma
            off[0] *= not first
            values = jnp.asarray(guess[None] + off, jnp.float32)
            return values, jax.vmap(optimizer.init)(values)

        began, calls, lanes = time.perf_counter(), 0, begin(True)
        while time.perf_counter() - began < seconds:
            lanes, best, solved = advance(lanes, known, target)
            calls += 1
            if calls % CALLS_A_START == 0:
                lanes = begin(False)
            if bool(solved.any()):
                return np.asarray(best)[
                    int(solved.argmax())
                ], time.perf_counter() - began
        return None, seconds

    return solve


def by_search(problem, objective, ask):
    """Return a solver that evaluates what `ask` proposes, all at once."""

    def score(values, known, target):
        wrong = jnp.sum(loose(problem, values, known) != target)
        if objective == "outcome":
            return wrong.astype(jnp.float32), wrong == 0
        return margin_loss(problem, values, known, target)

    many = jax.jit(jax.vmap(score, (0, None, None)))

    def solve(known, target, guess, seconds, seed):
        began = time.perf_counter()
        propose, learn = ask(problem, guess, seed)
        while time.perf_counter() - began < seconds:
            values = np.asarray(propose(), np.float32)
            cost, right = map(np.asarray, many(values, known, target))
            if right.any():
                return values[right.argmax()], time.perf_counter() - began
            learn(cost)
        return None, seconds

    return solve


def cma_es(problem, guess, seed):
    """CMA-ES of the package cma, restarted where it gives up."""
    rng = np.random.default_rng(seed)
    now = {}

    def begin():
        options = {"seed": int(rng.integers(1, 2**31)), "verbose": -9}
        now["search"] = cma.CMAEvolutionStrategy(guess, problem.sigma, options)

    def propose():
        if now["search"].stop():
            begin()
        now["asked"] = now["search"].ask()
        return now["asked"]

    begin()
    return propose, lambda cost: now["search"].tell(now["asked"], cost.tolist())


def random_search(problem, guess, seed):
    rng = np.random.default_rng(seed)
    draw = rng.normal
    return (
        lambda: guess[None] + problem.sigma * draw(size=(32, guess.size)),
        lambda cost: None,
    )


METHODS = {
    "margin, Adam": by_margin,
    "CMA-ES on the outcome": lambda p: by_search(p, "outcome", cma_es),
    "CMA-ES on the margin loss": lambda p: by_search(p, "margin", cma_es),
    "random search": lambda p: by_search(p, "outcome", random_search),
}


def compare(problem, count, seconds, seed, show=True):
    """Return solved counts and times of all methods on the same targets."""
    rng = np.random.default_rng(seed)
    solvers = {name: make(problem) for name, make in METHODS.items()}
    known, target, guess = problem.target(rng)
    for solve in solvers.values():
        solve(known, target, guess, 1e-3, 0)
    times = {name: [] for name in solvers}
    solved = {name: 0 for name in solvers}
    for index in range(count):
        known, target, guess = problem.target(rng)
        for name, solve in solvers.items():
            found, spent = solve(known, target, guess, seconds, 1000 + index)
            times[name].append(spent)
            if found is not None:
                # What counts is the hard outcome, whatever the method believed.
                right = (np.asarray(problem.loose(found, known)) == target).all()
                solved[name] += bool(right)
    rows = {
        name: {
            "solved": solved[name],
            "targets": count,
            "median seconds": float(np.median(times[name])),
            "seconds": times[name],
        }
        for name in solvers
    }
    if show:
        print(
            f"{problem.name}: {count} targets, at most {seconds:g} s each; how many in"
        )
        print("  all, the median time, and how many when the first had 95 % of its own")
        own = sorted(rows[next(iter(rows))]["seconds"])
        limit = own[math.ceil(0.95 * len(own)) - 1]
        for name, row in rows.items():
            middle = row["median seconds"]
            soon = sum(t <= limit for t in row["seconds"] if t < seconds)
            print(
                f"  {name:28s} {row['solved']:3d} / {count}  {middle:9.4f} s"
                f"  {soon:3d} in {limit:.4f} s"
            )
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--aims", type=int, default=6)
    parser.add_argument("--aim-seconds", type=float, default=10.0)
    parser.add_argument("--recoveries", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json")
    options = parser.parse_args()
    rows = {
        "aiming": compare(Aiming(), options.aims, options.aim_seconds, options.seed),
        "recovery": compare(
            Recovery(), options.recoveries, options.seconds, options.seed
        ),
    }
    if options.json:
        with open(options.json, "w") as file:
            json.dump(rows, file, indent=1)


if __name__ == "__main__":
    main()
