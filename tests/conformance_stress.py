"""Replay of recorded stress solves through the library's parity solver.

A frame is one update of Blast's solver. The library carries its network and its
impulses from frame to frame by its own rules. What must agree:

- solver nodes, solver bonds and their order exactly, the scales to a few roundings;
- impulses and stresses within `BAR` or `SPREADS` times the recorded float32 spread
  (how far two of Blast's own code paths lie apart), relative to the largest entry;
- the count of overstressed bonds and the commands exactly, unless a stress lies closer
  to a limit than the error of this frame;
- steps within `STEPS_RTOL`, and equal where the error norms agree;
- error norms: with those of our solve, and where the solve converged, with what the
  recorded impulses leave of the load in float64.

Where a frame fails, two things are allowed, and counted by name. First it is solved
again from the *recorded* impulses of the frame before, so that the noise of one frame
does not excuse the next. Then the frame's own float32 noise is measured: the same solve
with accelerations and arms moved by one rounding, `TRIALS` times. A frame may be out by
`OWN_SPREADS` times the largest distance of these solves from the first. Nothing else is
excused.
"""

import collections
import functools

import jax
import numpy as np

from blastjax import author, fracture
from blastjax.core import Damage
from blastjax.stress import parity
from blastjax.stress.limits import Limits
from tests.conformance import signed

BAR = 2e-4
"""Of the largest impulse or stress: some hundred roundings."""
SPREADS = 20
"""Two solves say little about how far apart a third may lie."""
OWN_SPREADS = 5
TRIALS = 6
ROUNDING = 2.0**-23
SCALE_RTOL = 4e-6
"""Scales are float32 sums of logarithms and lengths."""
NORM_RTOL = 1e-3
"""Of error norms, beyond their noise."""
RESIDUAL_RTOL, RESIDUAL_NOISES = 1e-4, 3
"""Of error norms made in float64 from recorded impulses, and of their rounding."""
STEPS_RTOL = 0.15
"""Of steps, where error norms are noisy too."""
SAME_NORMS = 1e-2
"""Error norms this close come from the same number of steps."""
MOST_STEPS = 100_000
"""A corrupt limit must not keep a solve going for hours."""
TINY = 1e-30

CAPACITIES = (112, 256), (448, 832), (2048, 5376)
"""(nodes, bonds) that cases are padded to, so that a few compilations serve all."""

RESTARTED = "restarted from recorded impulses"
NOISY = "beyond the bar by float32 noise"
NEAR = "with a stress too close to a limit"
STALE = "excess forces of an actor with the world"


def capacity(nodes, bonds):
    """Return a common capacity that holds a case."""
    for room in CAPACITIES:
        if nodes <= room[0] and bonds <= room[1]:
            break
    else:
        room = [1 << int(n - 1).bit_length() for n in (nodes, bonds)]
    return author.Capacity(
        chunks=room[0],
        nodes=room[0],
        sub_chunks=0,
        bonds=room[1],
        has_world=True,
        height=1,
    )


@functools.cache
def compiled():
    """Return the library's functions under jit."""

    def step(asset, state, amount):
        return fracture.step(asset, state, Damage(bond=amount))[0]

    return {
        "init": jax.jit(fracture.init),
        "bodies": jax.jit(parity.bodies),
        "step": jax.jit(step),
        "update": jax.jit(parity.update),
        "excess": jax.jit(parity.excess),
    }


def distance(ours, theirs):
    """Return the largest difference of pairs of arrays, by their largest entries."""
    worst = 0.0
    for a, b in zip(ours, theirs, strict=True):
        gap = np.abs(a - b.astype(np.float64)).max(initial=0)
        if not gap == 0:  # NaN passes no comparison
            worst = max(worst, gap / max(np.abs(b).max(initial=0), TINY))
    return worst if np.isfinite(worst) else np.inf


def moved(rows, rng):
    """Return rows with every entry one rounding up, down, or as it is."""
    factor = 1 + ROUNDING * rng.integers(-1, 2, rows.shape)
    return (rows * factor).astype(np.float32)


class Replay:
    """One case on its way through the library; `found` lists what differs."""

    def __init__(self, case):
        self.case, self.where = case, ""
        self.found, self.errors = [], []
        self.differences = collections.Counter()
        self.call = compiled()

    def expect(self, what, ours, theirs, rtol=0.0):
        """Note a difference."""
        ours, theirs = np.asarray(ours), np.asarray(theirs)
        same = ours.shape == theirs.shape and (
            np.allclose(ours, theirs, rtol=rtol, atol=0)
            if rtol
            else np.array_equal(ours, theirs)
        )
        if not same:
            text = f"{what}: {ours!s:.80} instead of {theirs!s:.80}"
            self.found.append(self.where + text)
        return same

    def run(self):
        """Replay the case."""
        self.build()
        frames = self.case["frames"]
        for number, frame in enumerate(frames):
            self.where = f"frame {number}: "
            if not self.solve(frame):
                break
            self.compare_limits(frame)
            self.advance(frame)
        return self

    def build(self):
        """Author the asset, and start the solver."""
        case = self.case
        world = signed(case["node_chunk"]) < 0
        count, self.num_bonds = len(world), len(case["bond_nodes"])
        chunk = np.where(world, -1, np.arange(count) + 1)
        centroid = np.concatenate([np.zeros((1, 3)), case["node_pos"][~world]])
        volume = np.concatenate([[0.0], case["node_volume"][~world]])
        parent = np.minimum(np.arange(len(volume)), 1) - 1
        described = author.Chunks(parent, centroid, volume, parent >= 0)
        bonds = author.Bonds(
            chunk[case["bond_nodes"].astype(np.int64)],
            case["bond_normal"],
            case["bond_area"],
            case["bond_centroid"],
        )
        built = author.build(described, bonds, orient_normals=False, dtype=np.float32)
        in_order = np.arange(self.num_bonds)
        if not self.expect("order of bonds", built.bond_map, in_order):
            raise ValueError("the bonds are not in the order of their nodes")
        self.capacity = capacity(count + 1 - int(world.any()), self.num_bonds)
        self.asset = author.pad(built.asset, self.capacity)
        self.node = np.where(world, 0, np.arange(count) + 1)
        self.pairs = {
            tuple(pair): i for i, pair in enumerate(case["bond_nodes"].tolist())
        }

        health = self.on_bonds(case["bond_init_health"])
        self.state = self.call["init"](self.asset, health, np.float32(1))
        self.bodies = parity.Bodies(
            mass=self.on_nodes(case["node_mass"]),
            volume=self.on_nodes(case["node_volume"]),
            position=self.on_nodes(case["node_pos"]),
        )
        if case["case_info_mode"] == 0:
            ours = self.call["bodies"](self.asset, np.float32(case["case_density"]))
            self.expect("masses", ours.mass, self.bodies.mass)
            self.expect("volumes", ours.volume, self.bodies.volume)
            self.expect("positions", ours.position, self.bodies.position)
        level = int(case["case_reduction"])
        self.network = parity.network(self.asset, self.state, self.bodies, level=level)
        self.own = self.recorded = parity.no_impulses(self.asset)
        self.limits = Limits(*case["case_limits"])

    def on_nodes(self, rows):
        """Return recorded rows in the library's order, padded."""
        full = np.zeros((self.capacity.nodes, *rows.shape[1:]), rows.dtype)
        full[self.node] = rows
        return full

    def on_bonds(self, rows):
        """Return recorded rows, padded."""
        full = np.zeros((self.capacity.bonds, *rows.shape[1:]), rows.dtype)
        full[: len(rows)] = rows
        return full

    def update(self, frame, start, rng=None):
        """Solve a frame, perhaps with inputs moved by roundings; return the result."""
        network, pull = self.network, self.on_nodes(frame["frame_node_vel"])
        if rng is not None:
            network = network.replace(arm=moved(network.arm, rng))
            pull = moved(pull, rng)
        result = self.call["update"](
            self.asset,
            self.state,
            self.bodies,
            network,
            start,
            pull,
            self.limits,
            max_iterations=np.int32(min(self.case["case_max_iter"], MOST_STEPS)),
            cold=np.bool_(frame["frame_reset"]),
        )
        return jax.tree.map(np.asarray, result)

    def rows(self, result):
        """Return impulses as after pruning, and stresses, without padding."""
        network, left = parity.prune(self.state, self.network, result.impulses)
        count = int(network.num_bonds)
        impulses = left.linear[:count], left.angular[:count]
        # The sign of a pressure is undecided where it is nearly all bending.
        pressure = np.abs(result.stress.normal[: self.num_bonds])
        return impulses, (pressure, result.stress.shear[: self.num_bonds])

    def solve(self, frame):
        """Compare one update; return whether its network agrees."""
        settled = [
            parity.settle(self.asset, self.state, self.bodies, self.network, start)
            for start in (self.own, self.recorded)
        ]
        self.network = settled[0][0]
        starts = [impulses for _, impulses in settled]
        result = self.update(frame, starts[0])
        pruned, left = parity.prune(self.state, self.network, result.impulses)
        if not self.compare_network(frame, pruned):
            return False

        recorded = (
            (frame["frame_sbond_lin"], frame["frame_sbond_ang"]),
            (np.abs(frame["frame_stress_normal"]), frame["frame_stress_shear"]),
        )
        spreads = [
            float(np.nan_to_num(frame[f"frame_fp32_spread_{x}"]))
            for x in ("impulse", "stress")
        ]
        bars = [max(BAR, SPREADS * s) for s in spreads]

        def errors(result):
            pairs = zip(self.rows(result), recorded, strict=True)
            return [distance(ours, theirs) for ours, theirs in pairs]

        error, start = errors(result), starts[0]
        norms = self.norm_gap(frame, result)
        fits = all(e <= b for e, b in zip(error, bars, strict=True))
        if not fits or norms > NORM_RTOL:
            again = self.update(frame, starts[1])
            better = not fits and max(errors(again)) < max(error)
            if better or (fits and self.norm_gap(frame, again) < 0.5 * norms):
                self.differences[RESTARTED] += 1
                start, result, error = starts[1], again, errors(again)
                left = parity.prune(self.state, self.network, result.impulses)[1]
        trials = functools.cache(lambda: self.trials(frame, start))
        self.compare_errors(error, bars, result, trials)
        self.compare_course(frame, result, trials)
        self.compare_residual(frame)
        self.result, self.error = result, error
        self.errors.append(error)
        self.network, self.own = pruned, left
        linear, angular = left.linear.copy(), left.angular.copy()
        count = int(pruned.num_bonds)
        linear[:count], angular[:count] = recorded[0]
        self.recorded = parity.Impulses(linear=linear, angular=angular)
        return True

    def compare_errors(self, error, bars, result, trials):
        """Compare errors of impulses and stresses with their bars, or with noise."""
        if all(e <= b for e, b in zip(error, bars, strict=True)):
            return
        ours = self.rows(result)
        others = [self.rows(trial) for trial in trials()]
        noise = [max(distance(x[i], ours[i]) for x in others) for i in range(2)]
        room = [max(b, OWN_SPREADS * n) for b, n in zip(bars, noise, strict=True)]
        if all(e <= r for e, r in zip(error, room, strict=True)):
            self.differences[NOISY] += 1
            return
        out, bar, own = (
            " ".join(f"{x:.1e}" for x in pair) for pair in (error, bars, noise)
        )
        text = f"impulses and stresses are out by {out}; bars {bar}, noise {own}"
        self.found.append(self.where + text)

    def trials(self, frame, start):
        """Return solves of a frame with its inputs moved by one rounding."""
        rng = np.random.default_rng(0)
        return [self.update(frame, start, rng) for _ in range(TRIALS)]

    def compare_network(self, frame, network):
        """Compare the graph that was solved; return whether it agrees."""
        count = int(network.num_bonds)
        in_solver = np.zeros(self.capacity.bonds, bool)
        known = network.bond_list
        in_solver[known[known >= 0]] = True
        agreed = [
            self.expect(
                "solver nodes",
                network.node_group[self.node],
                frame["frame_solver_node"],
            ),
            self.expect(
                "number of solver nodes",
                network.num_nodes,
                frame["frame_n_solver_node"],
            ),
            self.expect("number of solver bonds", count, frame["frame_n_solver_bond"]),
            self.expect(
                "solver bonds",
                network.solver_nodes[:count],
                frame["frame_sbond_nodes"],
            ),
            self.expect(
                "bonds in the solver",
                in_solver[: self.num_bonds],
                frame["frame_bond_in_solver"],
            ),
        ]
        for name, ours in (
            ("length", network.length_scale),
            ("mass", network.mass_scale),
        ):
            theirs = frame[f"frame_{name}_scale"]
            self.expect(f"{name} scale", ours, theirs, rtol=SCALE_RTOL)
        return all(agreed)

    def compare_course(self, frame, result, trials):
        """Compare how the solve went: steps, convergence, error norms."""
        names = "error_linear", "error_angular"
        ours = [float(getattr(result, name)) for name in names]
        theirs = [float(frame[f"frame_err_{x}"]) for x in ("linear", "angular")]
        scale = max(*theirs, TINY)
        gap = self.norm_gap(frame, result)
        steps, recorded = int(result.iterations), int(frame["frame_iters"])
        runs = [result]
        if gap > NORM_RTOL:
            runs += trials()
            noise = max(
                abs(float(getattr(run, name)) - own) / scale
                for name, own in zip(names, ours, strict=True)
                for run in runs
            )
            # Impulses that differ by the recorded spread differ in their gradient by as
            # much of the load, of which little is left when the solve ends.
            spread = float(np.nan_to_num(frame["frame_fp32_spread_impulse"]))
            noise = max(SPREADS * noise, spread / parity.TOLERANCE)
            if gap > noise:
                text = f"error norms {ours} instead of {theirs}, noise {noise:.1e}"
                self.found.append(self.where + text)
        converged = bool(frame["frame_converged"])
        if converged != (recorded >= 0) or frame["frame_converged"] > 1:
            self.found.append(self.where + f"{recorded} steps, converged: {converged}")
        if recorded < 0:
            self.expect(
                "steps at the limit", -int(self.case["case_max_iter"]), recorded
            )
        agree = gap <= SAME_NORMS and converged == bool(result.converged)
        if agree:
            self.expect("steps", steps, recorded)
        else:
            # The test may be passed a few steps sooner or later.
            counts = [abs(int(run.iterations)) for run in (*runs, *trials())]
            low, high = (1 - STEPS_RTOL) * min(counts), (1 + STEPS_RTOL) * max(counts)
            if not low <= abs(recorded) <= high:
                text = f"{recorded} steps, ours {sorted(counts)}"
                self.found.append(self.where + text)

    def compare_residual(self, frame):
        """Compare the error norms with those of the recorded impulses, in float64.

        Only a solve that converged tests its last impulses, and only the bonds that
        are still there have theirs recorded.
        """
        network, count = self.network, len(frame["frame_sbond_lin"])
        if frame["frame_iters"] < 0 or int(network.num_bonds) != count or not count:
            return
        length = float(frame["frame_length_scale"])
        force = frame["frame_sbond_lin"] / (length * float(frame["frame_mass_scale"]))
        torque = frame["frame_sbond_ang"] / (
            length**2 * float(frame["frame_mass_scale"])
        )
        impulses = np.concatenate([torque, force], axis=1).astype(np.float64)
        pull = self.on_nodes(frame["frame_node_vel"])[network.group_source] / length
        load = np.concatenate([np.zeros_like(pull), -pull], axis=1)
        rng = np.random.default_rng(0)

        def gradient(rounding):
            turn = rounding * rng.integers(-1, 2, impulses.shape)
            left = load - self.on_solver_nodes(impulses * (1 + turn))
            return self.on_solver_bonds(left)

        first = gradient(0.0)
        noise = max(np.linalg.norm(gradient(ROUNDING) - first) for _ in range(3))
        ours = [np.linalg.norm(x) for x in (first[:, 3:], first[:, :3])]
        theirs = [float(frame[f"frame_err_{x}"]) for x in ("linear", "angular")]
        gap = max(abs(a - b) for a, b in zip(ours, theirs, strict=True))
        if not gap <= max(RESIDUAL_RTOL * max(theirs), RESIDUAL_NOISES * noise):
            text = f"error norms {theirs} of impulses that leave {ours}"
            self.found.append(self.where + text)

    def weights(self):
        """Return what counts of each solver node's rows, angular first."""
        sides = self.network.turns[:, None], self.network.moves[:, None]
        return np.repeat(np.concatenate(sides, axis=1), 3, axis=1)

    def ends(self):
        """Yield sign, solver nodes and scaled arms of the ends of solver bonds."""
        count = int(self.network.num_bonds)
        scaled = self.network.arm[:count] / np.float64(self.network.length_scale)
        for end, sign in enumerate((1, -1)):
            yield sign, self.network.solver_nodes[:count, end], scaled[:, end]

    def on_solver_nodes(self, x):
        """Sum scaled impulses over their ends, in float64."""
        total = np.zeros((len(self.network.moves), 6))
        for sign, nodes, arm in self.ends():
            turn = x[:, :3] - np.cross(arm, x[:, 3:])
            rows = sign * np.concatenate([turn, x[:, 3:]], axis=1)
            np.add.at(total, nodes, rows)
        return total * self.weights()

    def on_solver_bonds(self, y):
        """Apply the transpose of that."""
        y, total = y * self.weights(), 0
        for sign, nodes, arm in self.ends():
            turn, push = y[nodes, :3], y[nodes, 3:]
            rows = np.concatenate([turn, push + np.cross(arm, turn)], axis=1)
            total = total + sign * rows
        return total

    def norm_gap(self, frame, result):
        """Return how far the error norms are out, by the larger one."""
        ours = float(result.error_linear), float(result.error_angular)
        theirs = float(frame["frame_err_linear"]), float(frame["frame_err_angular"])
        gaps = [abs(a - b) for a, b in zip(ours, theirs, strict=True)]
        # Rounding of the residual, from which the norms are made.
        floor = 1e-6 * self.load_norm(frame)
        gap = max(gaps) / max(*theirs, TINY)
        return gap if max(gaps) > floor or not np.isfinite(gap) else 0.0

    def load_norm(self, frame):
        """Return the norm of the right side, in the solver's units."""
        network = self.network
        pull = self.on_nodes(frame["frame_node_vel"])[network.group_source]
        pull = pull[network.moves] / network.length_scale
        return float(np.sqrt((pull.astype(np.float64) ** 2).sum()))

    def compare_limits(self, frame):
        """Compare what the stresses do: overstressed bonds, commands."""
        bonds = self.num_bonds
        ours = [
            x[:bonds] for x in (self.result.stress.normal, self.result.stress.shear)
        ]
        theirs = frame["frame_stress_normal"], frame["frame_stress_shear"]
        largest = max(np.abs(x).max(initial=0) for x in theirs)
        slack = 2 * self.error[1] * largest + TINY
        limits = np.array(self.case["case_limits_effective"], np.float64)
        undecided = np.sign(ours[0]) != np.sign(theirs[0])
        for stress, elastic in ((-theirs[0], 0), (theirs[0], 2), (theirs[1], 4)):
            undecided |= np.abs(stress - limits[elastic]) <= slack
        count, recorded = (
            int(self.result.overstressed),
            int(frame["frame_overstressed"]),
        )
        if count != recorded and abs(count - recorded) <= undecided.sum():
            self.differences[NEAR] += 1
        else:
            self.expect("overstressed", count, recorded)

        amount = np.zeros(bonds, np.float64)
        for pair, health in zip(
            frame["cmd_nodes"].tolist(), frame["cmd_health"], strict=True
        ):
            amount[self.pairs[tuple(pair)]] = health
        ours = self.result.damage.bond[:bonds].astype(np.float64)
        width = limits[1::2] - limits[::2]
        slope = (1 / np.where(width > 0, width, 1)).max()
        room = 2 * frame["frame_bond_health"].astype(np.float64) * slack * slope
        close = np.abs(ours - amount) <= room + 1e-5 * np.abs(amount)
        wrong = ~(close & ((ours > 0) == (amount > 0))) & ~undecided
        if wrong.any():
            at = int(np.flatnonzero(wrong)[0])
            text = f"command of bond {at}: {ours[at]} instead of {amount[at]}"
            self.found.append(self.where + text)
        self.amount = self.on_bonds(amount.astype(np.float32))

    def advance(self, frame):
        """Apply the recorded commands, split, and tell the solver."""
        if not self.case["case_do_fracture"]:
            return
        before = np.asarray(self.state.actor)
        self.state = self.call["step"](self.asset, self.state, self.amount)
        after = np.asarray(self.state.actor)
        labels = np.unique(after[after >= 0])
        pieces = np.zeros(len(after), bool)
        parted = {
            int(before[after == label][0])
            for label in labels
            if not np.array_equal(after == label, before == before[after == label][0])
        }
        for label in labels:
            pieces[label] = int(before[after == label][0]) in parted
        # The world alone is no actor.
        pieces[0] &= (after == 0).sum() > 1
        self.expect("new actors", pieces.sum(), frame["frame_n_new_actor"])
        self.network = parity.notify(self.asset, self.state, self.network, pieces)
        if pieces.any() and not self.case["case_reduction"]:
            self.compare_excess(frame, after)

    def compare_excess(self, frame, actor):
        """Compare excess forces; Blast's bug in their torques is put in here."""
        arm = np.array(self.asset.bond_centroid)
        arm[: self.num_bonds, 2] = self.case["bond_userdata"].view(np.float32)
        asset = self.asset.replace(bond_centroid=arm)
        center = np.zeros((len(actor), 3), np.float32)
        ours = self.call["excess"](
            asset, self.state, self.bodies, self.result, self.limits, center
        )
        ours = [np.asarray(x, np.float64) for x in ours]
        theirs = [np.zeros_like(x) for x in ours]
        for name, full in zip(("force", "torque"), theirs, strict=True):
            for index, row in zip(
                frame["excess_actor"], frame[f"excess_{name}"], strict=True
            ):
                full[int(actor[self.node[int(index)]])] = row
        # Each bond's stress is out by the error of the frame, times its health.
        health = np.where(self.amount > 0, self.result.health, 0).sum()
        stress = self.result.stress
        largest = max(np.abs(stress.normal).max(), np.abs(stress.shear).max())
        slack = (2 * self.error[1] + 1e-5) * largest * float(health)
        reach = float(np.abs(arm).max())
        for name, a, b, room in zip(
            ("force", "torque"), ours, theirs, (slack, slack * reach), strict=True
        ):
            far = np.abs(a - b).max(axis=1) > room
            # There Blast visits a node too many, which only the exact replay can name.
            self.differences[STALE] += bool(far[0])
            far[0] = False
            if far.any():
                at = int(np.flatnonzero(far)[0])
                text = f"excess {name} of actor {at}: {a[at]} instead of {b[at]}"
                self.found.append(self.where + text)


def check_stress(case):
    """Replay a case; return mismatches, counted differences and errors by frame.

    The errors are the relative ones of impulses and of stresses.
    """
    replay = Replay(case)
    try:
        with np.errstate(all="ignore"):
            replay.run()
    except Exception as error:  # a corrupt case may break anything
        replay.found.append(f"{replay.where}the replay broke down: {error!r}")
    return replay.found, replay.differences, replay.errors
