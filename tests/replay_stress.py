"""Replay of recorded stress solves by the rules, number by number.

`verify_stress` takes a case from `recorded` and lists what does not agree. Everything
around the solve is replayed exactly (loads, commands, healths, islands, excess forces);
the impulses are checked against what they must satisfy and what was made of them. The
solve itself is compared in `conformance_stress`.
"""

import numpy as np

from tests import reference as ref
from tests.replay import Report

F32 = np.float32
INV = ref.INV
BEAM, WALL, BLOCKS, RANDOM_GRAPH = 0, 3, (2, 4), 5
"""Kinds of cases: how their bonds lie."""
REACH = 1.6
"""Bonds lie this near to their nodes, in typical distances of nodes."""
WORLD_BOND = 7
"""The userdata that the recorder gives to bonds to the world."""
STRESS_RTOL = 2e-6
"""A few float32 roundings of the largest term."""
SQUARE_RTOL = 2e-3
"""What is left of a small difference of large squares, under a root."""
SIGN_RTOL = 1e-5
"""Forces this near to across the bond press or pull by accident."""
EXCESS_RTOL = 1e-6
"""Of sums of a few bonds."""
SPIN_RTOL = 4e-7
"""Of a double cross product, in whatever order."""
UNBREAKABLE = F32(0.5) * F32(ref.FLT_MAX)
GRAVITY, CENTRIFUGAL, AT_POSITION, AT_NODE = range(4)
UNUSED = {
    GRAVITY: slice(3, 8),
    CENTRIFUGAL: slice(6, 8),
    AT_POSITION: slice(7, 8),
    AT_NODE: [0, 1, 2, 7],
}
"""Parameters that a kind of load has no use for; the recorder writes 0."""


def verify_stress(case):
    """List what in a recorded case differs from the rules."""
    report = Report(case["case_id"])
    try:
        with np.errstate(all="ignore"):
            _Replay(case, report).run()
    except Exception as error:  # a corrupt case may break anything
        report.holds(f"the replay broke down: {error!r}", False)
    return report.lines


def effective(limits):
    """Return limits with negative ones inherited from compression."""
    full = np.array(limits, F32)
    full[2:] = np.where(full[2:] < 0, np.tile(full[:2], 2), full[2:])
    return full


class _Replay:
    def __init__(self, case, report):
        self.case, self.report = case, report
        self.mass, self.place = case["node_mass"], case["node_pos"]
        self.pairs = case["bond_nodes"].astype(np.int64)
        self.world = case["node_chunk"] == INV
        self.limits = effective(case["case_limits"])

    def run(self):
        self.check_case()
        self.check_nodes()
        self.check_bonds()
        self.make_family()
        self.listed = np.arange(len(self.mass))
        self.inside, self.new = np.zeros(len(self.pairs)), []
        frames = self.case["frames"]
        for i, frame in enumerate(frames):
            self.report.where = f" frame {i}"
            self.check_frame(frame)
            self.check_commands(frame)
            self.fracture(frame)
            self.check_excess(frame)
        diverged = np.array([np.isnan(f["frame_fp32_spread_impulse"]) for f in frames])
        self.report.holds(
            "histories stay diverged", (np.diff(diverged.astype(int)) >= 0).all()
        )

    def check_case(self):
        case, holds = self.case, self.report.holds
        holds("kind", case["case_kind"] <= 5)
        holds("information mode", case["case_info_mode"] <= 1)
        holds("reduction", case["case_reduction"] <= 2)
        holds("flags", case["case_do_fracture"] <= 1 and case["case_has_world"] <= 1)
        holds("density", np.isfinite(case["case_density"]) and case["case_density"] > 0)
        holds("world", int(self.world.sum()) == case["case_has_world"])
        holds(
            "chunks",
            case["case_n_chunk"] == case["case_n_node"] - case["case_has_world"] + 1,
        )
        limits = case["case_limits"]
        holds("limits", np.isfinite(limits).all() and (limits[:2] > 0).all())
        inherits = limits[2:] < 0
        holds("inherited limits are -1", (limits[2:][inherits] == -1).all())
        self.report.same("effective limits", self.limits, case["case_limits_effective"])

    def check_nodes(self):
        case, holds = self.case, self.report.holds
        chunk = np.where(self.world, INV, np.arange(len(self.world)) + 1)
        self.report.same("node_chunk", chunk, case["node_chunk"])
        holds("the world is last", not self.world[:-1].any())
        volume = case["node_volume"]
        holds(
            "finite nodes",
            np.isfinite(self.mass).all() and np.isfinite(self.place).all(),
        )
        holds("masses", (self.mass >= 0).all() and (volume >= 0).all())
        for name, values in (
            ("mass", self.mass),
            ("volume", volume),
            ("place", self.place),
        ):
            holds(f"the world's {name}", not values[self.world].any())
        by_density = np.array_equal(volume * case["case_density"], self.mass)
        holds("information mode fits the masses", by_density != case["case_info_mode"])
        if case["case_info_mode"] == 0:
            self.report.same("mass", volume * case["case_density"], self.mass)
            holds("volumes", (volume[~self.world] > 0).all())

    def check_bonds(self):
        case, holds = self.case, self.report.holds
        low, high = self.pairs.T
        holds("ends of bonds", (low < high).all() and (high < len(self.mass)).all())
        holds("order of bonds", (np.diff(low * len(self.mass) + high) > 0).all())
        normal = case["bond_normal"].astype(np.float64)
        holds("unit normals", (np.abs((normal**2).sum(1) - 1) < 1e-5).all())
        holds("areas", (case["bond_area"] > 0).all())
        holds("finite bonds", np.isfinite(case["bond_centroid"]).all())
        holds("healths", (case["bond_init_health"] > 0).all())
        userdata = case["bond_userdata"]
        to_world = self.world[high]
        holds("userdata of world bonds", (userdata[to_world] == WORLD_BOND).all())
        inner = userdata[~to_world]
        ordered = np.array_equal(np.arange(len(inner)), inner)
        # Random graphs are described in random order, and lose duplicates.
        holds("userdata", len(np.unique(inner)) == len(inner))
        holds("order of userdata", ordered != (case["case_kind"] == RANDOM_GRAPH))
        down = [-1, 0, 0] if case["case_kind"] == BEAM else [0, 0, -1]
        holds("normals to the world", (case["bond_normal"][to_world] == down).all())
        strides = len(np.unique((high - low)[~to_world]))
        if case["case_kind"] == WALL:
            holds("a wall is flat", strides <= 2)
        if case["case_kind"] in BLOCKS:
            holds("a block is not", strides == 3)

        health, area = case["bond_init_health"], case["bond_area"]
        limited = health < UNBREAKABLE
        ratio = health[limited].astype(np.float64) / area[limited]
        if np.mean(ratio == 1) > 0.5:
            holds("healths are areas", (ratio == 1).all())
        elif np.mean(health[limited] == 1) > 0.5:
            holds("healths are 1", (health[limited] == 1).all())
        else:
            holds("healths are parts of areas", (np.abs(ratio - 0.65) < 0.36).all())
        if not limited.all():
            lasting = health[~limited]
            holds("unbreakable healths", (lasting == F32(ref.FLT_MAX)).all())
        ends = self.place[self.pairs].astype(np.float64)
        away = case["bond_centroid"] - np.where(
            to_world[:, None], ends[:, 0], ends.mean(1)
        )
        reach = np.median(np.abs(ends[:, 1] - ends[:, 0])[~to_world].sum(1))
        holds("centroids lie near", (np.abs(away).max(1) < REACH * reach).all())

    def make_family(self):
        """Make the actors by the low-level rules; every chunk a root of its own."""
        case = self.case
        count = int((~self.world).sum())
        chunks = ref.Chunks([INV] * count, [True] * count)
        ends = np.where(self.world[self.pairs], INV, self.pairs)
        asset = ref.Asset(chunks, ref.Bonds([tuple(p) for p in ends.tolist()]))
        if not self.world.any() == (asset.world != INV):
            self.report.holds("the world has bonds", False)
        self.family = ref.Family(asset, case["bond_init_health"])

    def nodes(self, actor):
        """List the nodes of an actor as Blast's query does: without the world."""
        return [n for n in self.family.actors[actor].nodes if not self.world[n]]

    def check_frame(self, frame):
        same, holds = self.report.same, self.report.holds
        family = self.family
        same("health", family.bond_health, frame["frame_bond_health"])
        same("island", family.node_island, frame["frame_node_island"])
        first = frame["frame_index"] == 0
        holds("reset", frame["frame_reset"] <= (0 if first else 1))
        self.check_loads(frame)
        self.check_stress(frame)
        self.check_ends(frame)

    def check_loads(self, frame):
        holds = self.report.holds
        total, room = np.zeros_like(self.place), np.zeros_like(self.place)
        moves = self.mass > 0
        kinds, args, rows = (frame[f"load_{x}"] for x in ("type", "arg", "params"))
        for kind, arg, row in zip(kinds.tolist(), args.tolist(), rows, strict=True):
            holds("kind of load", kind in UNUSED)
            holds("parameters of load", np.isfinite(row).all())
            holds("unused parameters of load", not row[UNUSED[kind]].any())
            if kind == AT_NODE:
                holds("node of load", arg < len(moves))
                nodes = [arg]
            else:
                holds("actor of load", arg in self.family.actors)
                nodes = self.nodes(arg)
            if kind == GRAVITY:
                pull = np.broadcast_to(row[:3], (len(nodes), 3))
            elif kind == CENTRIFUGAL:
                arm = self.place[nodes] - row[:3]
                pull = _cross(row[3:6], _cross(row[3:6], arm))
                # In whatever order: products of the size of |spin|^2 |arm|.
                size = float(_dot(row[3:6], row[3:6])) * np.sqrt(_dot(arm, arm))
                room[nodes] += SPIN_RTOL * size[:, None]
            else:
                holds("mode of load", row[6] in (0, 1))
                if kind == AT_POSITION:
                    holds("position of load", row[:3].any())
                    if len(self.family.actors[arg].nodes) <= 1:
                        continue
                    away = self.place[nodes] - row[:3]
                    nodes = [nodes[int(np.argmin(_dot(away, away)))]]
                pull = row[None, 3:6]
                if row[6] == 0:
                    pull = pull * (F32(1) / self.mass[nodes[0]])
            total[nodes] += np.where(moves[nodes][:, None], pull, 0)
        recorded = frame["frame_node_vel"]
        room += np.where(room > 0, SPIN_RTOL * np.abs(recorded), 0)
        close = np.abs(total - recorded) <= room
        total = np.where(close, recorded, total)
        self.report.same("acceleration", total, recorded)

    def check_stress(self, frame):
        """Compare stresses with what the recorded impulses make of them."""
        holds, case = self.report.holds, self.case
        inside = frame["frame_bond_in_solver"]
        # Bonds that broke without a split leave the solver in this very update, and
        # some impulses are in the wrong place from then on: at most one for each.
        gone = (self.inside > 0) & (inside == 0)
        self.stale = 0 if self.new else int(gone.sum())
        self.inside = inside
        self.report.same("bonds in the solver", frame["frame_bond_health"] > 0, inside)
        group = frame["frame_solver_node"].astype(np.int64)
        ends = frame["frame_sbond_nodes"].astype(np.int64)
        number = {tuple(pair): i for i, pair in enumerate(ends.tolist())}
        holds("solver bonds differ", len(number) == len(ends))
        pairs = group[self.pairs]
        bond = np.flatnonzero((inside > 0) & (pairs[:, 0] != pairs[:, 1]))
        of = np.array([number[tuple(p)] for p in pairs[bond].tolist()], np.int64)
        holds("solver bonds have bonds", len(np.unique(of)) == len(ends))

        health = frame["frame_bond_health"][bond].astype(np.float64)
        way = self.place[self.pairs[bond]].astype(np.float64)
        way = way[:, 1] - way[:, 0]
        normal = case["bond_normal"][bond].astype(np.float64)
        normal = normal * np.where(_dot(normal, way) < 0, -1, 1)[:, None]
        lasting = health >= UNBREAKABLE
        weight = np.where(lasting, 0, health)

        def total(rows):
            sums = np.zeros((len(ends), *rows.shape[1:]))
            np.add.at(sums, of, rows)
            return sums

        area, held = total(weight), total(lasting.astype(float)) > 0
        area = np.where(held, 1, area)
        length = np.sqrt((total(weight[:, None] * way) ** 2).sum(1)) / area
        length = np.where(held, 1, length)
        mean = total(weight[:, None] * normal)
        mean /= np.where(held, 1, np.sqrt((mean**2).sum(1)))[:, None]
        force = frame["frame_sbond_lin"].astype(np.float64)
        torque = frame["frame_sbond_ang"].astype(np.float64)
        holds("finite impulses", np.isfinite(force).all() and np.isfinite(torque).all())

        def parts(vector):
            along = _dot(vector, mean)
            return along, np.sqrt(((vector - along[:, None] * mean) ** 2).sum(1))

        along, across = parts(force)
        twist, bend = parts(torque)
        extra = 2 * bend / length
        shear = (across + 2 * np.abs(twist) / length) / area
        size = np.sqrt((force**2).sum(1))
        turn = 2 * np.sqrt((torque**2).sum(1)) / length
        room = STRESS_RTOL * (size + turn) / area
        lost = _lost(across, size)
        lost_bend = _lost(extra, turn)
        sign = np.where(along < 0, -1, 1)
        for name, ours, slack in (
            ("normal", (along + sign * extra) / area, room + lost_bend / area),
            ("shear", shear, room + lost / area),
        ):
            ours = np.where(held, 0, ours)
            values = frame[f"frame_stress_{name}"]
            outside = np.setdiff1d(np.arange(len(values)), bond)
            holds(f"{name} stress outside the solver", not values[outside].any())
            mine = values[bond].astype(np.float64)
            gap = np.abs(mine - ours[of])
            if name == "normal":
                undecided = np.abs(along) <= SIGN_RTOL * size
                flipped = np.abs(mine + ours[of] - 2 * (along / area)[of] * ~held[of])
                gap = np.where(undecided[of], np.minimum(gap, flipped), gap)
            wrong = np.flatnonzero(~(gap <= np.where(held, 0, slack)[of] + 1e-37))
            if len(np.unique(of[wrong])) > self.stale:
                at = wrong[0]
                text = f"{mine[at]} for impulses that make {ours[of[at]]}"
                holds(
                    f"{name} stress of bond {bond[at]}: {text} {slack[of[at]]}", False
                )

    def check_commands(self, frame):
        """Compare commands with those of the recorded stresses, bit by bit."""
        found = []
        normal, shear = frame["frame_stress_normal"], frame["frame_stress_shear"]
        comp, comp_fatal, tens, tens_fatal, shr, shr_fatal = self.limits
        alive = frame["frame_bond_in_solver"] > 0
        over = (-normal > comp) | (normal > tens) | (shear > shr)
        over &= alive
        self.report.same("overstressed", int(over.sum()), frame["frame_overstressed"])

        def part(x, elastic, fatal):
            width = fatal - elastic
            share = (x - elastic) / (width if width > 0 else F32(1))
            return np.where(x > elastic, share, F32(0))

        share = np.where(
            -normal > comp,
            part(-normal, comp, comp_fatal),
            part(normal, tens, tens_fatal),
        ) + part(shear, shr, shr_fatal)
        health = frame["frame_bond_health"]
        for index in sorted(self.family.actors) if over.any() else ():
            nodes = self.family.actors[index].nodes
            if len(nodes) <= 1:
                continue
            for node in nodes:
                for other, bond in self.family.asset.adjacency[node]:
                    if (
                        other > node
                        and alive[bond]
                        and health[bond] > 0
                        and share[bond] > 0
                    ):
                        found.append((index, node, other, health[bond] * share[bond]))
        actor, first, second, amount = np.array(found or np.zeros((0, 4))).T
        self.report.same("command actors", actor.astype(int), frame["cmd_actor"])
        pairs = np.array([first, second], np.int64).T.reshape(-1, 2)
        self.report.same("command nodes", pairs, frame["cmd_nodes"])
        self.report.same("command healths", amount.astype(F32), frame["cmd_health"])

    def fracture(self, frame):
        """Apply the commands and split, as the recorder did."""
        self.new = []
        if self.case["case_do_fracture"]:
            columns = frame["cmd_actor"], frame["cmd_nodes"], frame["cmd_health"]
            commands = zip(*columns, strict=True)
            by_actor = {}
            for index, (a, b), amount in commands:
                by_actor.setdefault(int(index), []).append((int(a), int(b), amount))
            for index, rows in by_actor.items():
                self.family.apply(index, rows)
            for index in sorted(self.family.actors):
                self.new += self.family.split(index).children
        self.report.same("new actors", len(self.new), frame["frame_n_new_actor"])

    def check_excess(self, frame):
        """Compare what broken bonds bore beyond the fatal limits.

        Blast lists the nodes of an actor without the world, but visits as many as there
        are with it: the entry past the end is what an earlier list left there.
        """
        rows = zip(frame["excess_force"], frame["excess_torque"], strict=True)
        recorded = dict(zip(frame["excess_actor"].tolist(), rows, strict=True))
        self.report.holds(
            "order of excess forces",
            (np.diff(frame["excess_actor"].astype(int)) > 0).all(),
        )
        asked = []
        if self.new and not self.case["case_reduction"]:
            asked = sorted(self.family.actors)
        for actor in self.new:
            if len(self.family.actors[actor].nodes) > 1:
                self.list_nodes(actor)
        self.owner = {n: i for i, x in self.family.actors.items() for n in x.nodes}
        self.index = {
            tuple(pair): i for i, pair in enumerate(frame["frame_sbond_nodes"].tolist())
        }
        for actor in asked:
            self.list_nodes(actor)
            count = len(self.family.actors[actor].nodes)
            ours, room = self.excess(frame, self.listed[:count])
            theirs = recorded.pop(actor, None)
            if theirs is None:
                self.report.holds(
                    f"excess of actor {actor}", (np.abs(ours) <= room).all()
                )
                continue
            for name, a, b, slack in zip(
                ("force", "torque"), ours, theirs, room, strict=True
            ):
                fine = (np.abs(a - b) <= slack).all()
                text = f"excess {name} of actor {actor}: {b} recorded, ours {a}"
                self.report.holds(text, fine)
        self.report.holds(f"excess of others: {sorted(recorded)}", not recorded)

    def list_nodes(self, actor):
        """Write the nodes of an actor over the last list."""
        nodes = self.nodes(actor)
        self.listed[: len(nodes)] = nodes

    def excess(self, frame, nodes):
        """Sum the excess force and torque of nodes, and the rounding of the sums."""
        case = self.case
        _, press, _, pull, _, shear = self.limits.astype(np.float64)
        ours, room = np.zeros((2, 3)), np.zeros((2, 1))
        for node in nodes:
            for other, bond in self.family.asset.adjacency[node]:
                known = frame["frame_bond_in_solver"][bond]
                if self.family.bond_health[bond] > 0 or not known:
                    continue
                # The world belongs to no actor here, and so always to another.
                if not self.world[other] and self.owner[other] == self.owner[node]:
                    continue
                pair = self.pairs[bond]
                normal = case["bond_normal"][bond].astype(np.float64)
                if normal @ (self.place[pair[1]] - self.place[pair[0]]) < 0:
                    normal = -normal
                force = frame["frame_sbond_lin"][self.index[tuple(pair.tolist())]]
                force = force.astype(np.float64)
                along = float(frame["frame_stress_normal"][bond])
                across = float(frame["frame_stress_shear"][bond])
                over = max(along - pull, 0) + min(along + press, 0)
                rest = force - (force @ normal) * normal
                left = max(np.sqrt(rest @ rest), 1e-30)
                push = normal * over + rest / left * max(across - shear, 0)
                sign = 1 if other > node else -1
                push *= float(frame["frame_bond_health"][bond]) * sign
                arm = case["bond_centroid"][bond].astype(np.float64)
                # Blast takes the bits of the userdata for the third component.
                arm[2] = case["bond_userdata"][bond : bond + 1].view(F32)[0]
                ours += [push, np.cross(arm, push)]
                # The direction of a small rest is lost in the force.
                lost = np.sqrt(force @ force) / left * max(across - shear, 0)
                lost *= float(frame["frame_bond_health"][bond])
                size = EXCESS_RTOL * (lost + np.sqrt(push @ push))
                room += [[size], [size * np.sqrt(arm @ arm)]]
        return ours, room + 1e-30

    def check_ends(self, frame):
        """Check what is said about the solve."""
        holds = self.report.holds
        impulse, stress = (
            frame[f"frame_fp32_spread_{x}"] for x in ("impulse", "stress")
        )
        holds("spreads", np.isnan(impulse) == np.isnan(stress))
        for spread in (impulse, stress):
            holds("spreads are parts", np.isnan(spread) or 0 <= spread < 1)
        norms = frame["frame_err_linear"], frame["frame_err_angular"]
        holds("error norms", min(norms) >= 0 and np.isfinite(norms).all())
        if not frame["frame_sbond_lin"].any() and not frame["frame_sbond_ang"].any():
            holds("spreads of nothing", impulse == 0 and stress == 0)
        inside = frame["frame_bond_in_solver"] > 0
        normal = frame["frame_stress_normal"][inside].astype(np.float64)
        shear = frame["frame_stress_shear"][inside].astype(np.float64)
        press, _, pull, _, across, _ = self.limits.astype(np.float64)
        limit = np.where(normal > 0, pull, press)
        margin = min(
            np.abs(np.abs(normal) / limit - 1).min(initial=ref.FLT_MAX),
            np.abs(shear / across - 1).min(initial=ref.FLT_MAX),
        )
        gap = abs(margin - float(frame["frame_limit_margin"]))
        holds(
            f"limit margin {frame['frame_limit_margin']}, ours {margin}",
            gap <= 1e-6 * margin + 1e-12,
        )
        same = self.report.same
        same(
            "number of solver nodes",
            len(np.unique(frame["frame_solver_node"])),
            frame["frame_n_solver_node"],
        )
        same("convergence", int(frame["frame_iters"] >= 0), frame["frame_converged"])
        if frame["frame_iters"] < 0:
            same(
                "limit of steps",
                int(self.case["case_max_iter"]),
                -int(frame["frame_iters"]),
            )
        holds("steps", abs(int(frame["frame_iters"])) <= self.case["case_max_iter"])


def _lost(part, whole):
    """Return the rounding of a root of a difference of squares, `part` of `whole`."""
    small = SQUARE_RTOL * whole
    return np.where(part > small, 1e-6 * whole**2 / np.maximum(part, small), small)


def _dot(a, b):
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _cross(a, b):
    a = np.broadcast_to(a, b.shape)
    x, y, z = (0, 1, 2)
    return np.stack(
        [
            a[..., y] * b[..., z] - a[..., z] * b[..., y],
            a[..., z] * b[..., x] - a[..., x] * b[..., z],
            a[..., x] * b[..., y] - a[..., y] * b[..., x],
        ],
        axis=-1,
    )
