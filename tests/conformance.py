"""Replay of recorded Blast cases through the public library, compared at level 1.

That is: asset arrays, coverage, order, accept or refuse; after every round the same
partition of support chunks into actors, the same visible chunks, flags and healths; and
the damage of every program. Ids and list orders are the library's own.

Every case runs padded to one of a few capacities, so that a few compilations serve all.
"""

import collections
import functools

import jax
import jax.numpy as jnp
import numpy as np

from blastjax import author, chunks, damage, fracture
from blastjax.core import Damage

INV = 0xFFFFFFFF
UNDERSIZED = 32
"""Bit of `case_flags`: some buffer was too small, so Blast lost part of the result."""
MARGIN = 1e-5
"""Healths this close to zero may fall on the other side in another order of sums."""
RTOL = 2e-5
"""A few hundred float32 roundings: the programs sum in another order than Blast."""

FALLOFF, CUTTER, CAPSULE, SHEAR, TRIANGLE, SPREAD = range(1, 7)


def signed(index):
    """Return indices with -1 for Blast's largest unsigned number."""
    index = np.asarray(index).astype(np.int64)
    return np.where(index == INV, -1, index)


@functools.cache
def compiled():
    """Return the library's functions under jit."""
    program = {
        FALLOFF: lambda a, s, p, m: damage.falloff(
            a, s, p[1:4], p[0], p[10], p[11], actors=m
        ),
        CUTTER: lambda a, s, p, m: damage.cutter(
            a, s, p[1:4], p[0], p[10], p[11], actors=m
        ),
        CAPSULE: lambda a, s, p, m: damage.capsule(
            a, s, p[1:4], p[4:7], p[0], p[10], p[11], actors=m
        ),
        SHEAR: lambda a, s, p, m: damage.shear(
            a, s, p[1:4], p[4:7], p[0], p[10], p[11], actors=m
        ),
        TRIANGLE: lambda a, s, p, m: damage.triangle(
            a, s, p[1:10].reshape(3, 3), p[0], actors=m
        ),
        SPREAD: lambda a, s, p, m: damage.impact_spread(
            a, s, p[1:4], p[0], p[10], p[11], actors=m
        ),
    }

    def restricted(asset, state, dealt, actors):
        dealt = damage.restrict(asset, state, dealt, actors)
        return fracture.apply(asset, state, dealt)[0]

    def flags(asset, state):
        return chunks.can_fracture(asset, state), chunks.split_required(asset, state)

    def view(asset, state):
        return (
            chunks.owner(asset, state),
            chunks.visible(asset, state),
            chunks.held(asset, state),
            *flags(asset, state),
        )

    return {
        "init": jax.jit(fracture.init),
        "apply": jax.jit(restricted),
        "split": jax.jit(lambda a, s, m: fracture.split(a, s, actors=m)[0]),
        "flags": jax.jit(flags),
        "view": jax.jit(view),
        **{kind: jax.jit(f) for kind, f in program.items()},
    }


def bucket(need):
    """Return one of a few capacities that holds this one."""
    size = max(need.nodes, need.sub_chunks, need.chunks / 2, need.bonds / 4, 16)
    size = (
        32 if size <= 32 else 160 if size <= 160 else int(2 ** np.ceil(np.log2(size)))
    )
    return author.Capacity(
        chunks=2 * size,
        nodes=size,
        sub_chunks=size,
        bonds=4 * size,
        has_world=True,
        depth=max(4, need.depth),
        height=max(4, need.height),
    )


class Replay:
    """One case on its way through the library; `found` lists what differs."""

    def __init__(self, case, padded=True):
        self.case = case
        self.padded = padded
        self.found = []
        self.differences = collections.Counter()

    def expect(self, what, ours, theirs, close=False):
        """Note a difference."""
        ours, theirs = np.asarray(ours), np.asarray(theirs)
        if close and ours.shape == theirs.shape:
            # Healths are sums: what matters is the rounding of the largest term.
            with np.errstate(invalid="ignore", over="ignore"):
                same = np.isclose(ours, theirs, rtol=RTOL, atol=RTOL, equal_nan=True)
            same = bool(same.all())
        else:
            same = bool(np.array_equal(ours, theirs))
        if not same:
            self.found.append(f"{what}: {ours!r} instead of {theirs!r}")
        return same

    def run(self):
        """Replay the case."""
        self.build()
        if self.case["case_flags"] & UNDERSIZED:
            self.differences["undersized buffers"] += 1
            return self
        self.start()
        for number in range(1, int(self.case["case_n_round"]) + 1):
            for op in self.case["ops"][number]:
                if not self.operate(op):
                    return self
            # Blast splits actor by actor, and only some were asked to.
            masks = [self.chosen(x["split_actor"]) for x in self.case["splits"][number]]
            actors = np.any([np.zeros(self.state.actor.shape, bool), *masks], axis=0)
            self.state = self.call["split"](self.asset, self.state, actors)
            if not self.compare(number):
                return self
        return self

    def build(self):
        """Author the asset and compare it."""
        case, expect = self.case, self.expect
        parent = signed(case["raw_chunk_parent"])
        support = (case["raw_chunk_flags"] & 1).astype(bool)
        raw = author.Chunks(
            parent, case["raw_chunk_centroid"], case["raw_chunk_volume"], support
        )
        raw_bonds = author.Bonds(
            signed(case["raw_bond_chunks"]).reshape(-1, 2),
            case["raw_bond_normal"],
            case["raw_bond_area"],
            case["raw_bond_centroid"],
        )
        expect(
            "raw accepted", accepts(raw, raw_bonds), bool(case["case_create_raw_ok"])
        )

        covered, exact = author.ensure_coverage(parent, support)
        expect("coverage exact", exact, bool(case["case_cov_ret"]))
        expect("covered support", covered, case["cov_chunk_flags"] & 1)
        fixed = author.Chunks(raw.parent, raw.centroid, raw.volume, covered)
        accepted = accepts(fixed, raw_bonds)
        expect("covered accepted", accepted, bool(case["case_create_cov_ok"]))

        chunk_map, ordered = author.reorder_map(parent, covered)
        expect("already ordered", ordered, bool(case["case_map_ret"]))
        expect("reorder map", chunk_map, case["reorder_map"])
        moved, bonds = fixed, raw_bonds
        if not ordered:
            keep = bool(case["case_keep_normal_order"])
            moved, bonds = author.reorder(
                fixed, raw_bonds, chunk_map, keep_normal_order=keep
            )
        expect("reordered parent", moved.parent, signed(case["re_chunk_parent"]))
        expect("reordered support", moved.support, case["re_chunk_flags"] & 1)
        expect("reordered bonds", bonds.chunks, signed(case["re_bond_chunks"]))
        normal = np.asarray(bonds.normal, np.float32)
        expect("reordered normals", normal, case["re_bond_normal"])

        built = author.build(
            moved,
            bonds,
            strict=True,
            drop_invalid_bonds=True,
            orient_normals=False,
            dtype=np.float32,
        )
        whole = author.build(raw, raw_bonds, drop_invalid_bonds=True)
        expect("built order", whole.chunk_map, case["reorder_map"])
        expect("built coverage", whole.support, case["cov_chunk_flags"] & 1)
        dropped = sum(len(x) > 0 for x in built.dropped.values())
        expect("categories of dropped bonds", dropped, case["case_create_warnings"])
        self.compare_asset(built, chunk_map)

    def compare_asset(self, built, chunk_map):
        """Compare the arrays of the asset."""
        case, expect = self.case, self.expect
        own = author.capacity(built.asset)
        asset = jax.tree.map(np.asarray, built.asset)
        old = np.argsort(chunk_map)
        expect("parents", asset.chunk_parent, signed(case["chunk_parent"]))
        expect("centroids", asset.chunk_centroid, case["chunk_centroid"])
        expect("volumes", asset.chunk_volume, case["chunk_volume"])
        expect("userdata", case["raw_chunk_userdata"][old], case["chunk_userdata"])
        first, stop = (
            signed(case["chunk_first_child"]),
            signed(case["chunk_child_stop"]),
        )
        expect("children", asset.chunk_children, stop - first)
        leaves = np.where(asset.chunk_children == 0, 1, 0)
        for i in range(len(leaves) - 1, -1, -1):
            if asset.chunk_parent[i] >= 0:
                leaves[asset.chunk_parent[i]] += leaves[i]
        expect("leaves", leaves, case["chunk_leaf_count"])
        expect("leaf count", (asset.chunk_children == 0).sum(), case["case_n_leaf"])

        world = int(asset.has_world)
        self.num_nodes = nodes = len(asset.span_node)
        # Blast numbers the world last, this library first.
        self.blast_node = np.roll(np.arange(nodes), world)
        node_chunk = np.roll(asset.element_chunk[:nodes], -world)
        expect("node chunks", node_chunk, signed(case["node_chunk"]))
        element = asset.chunk_element
        node = np.where((element >= 0) & (element < nodes), element - world, -1)
        expect("chunk nodes", node, signed(case["chunk_node"]))
        sub = asset.element_chunk[nodes:]
        self.first_sub = len(asset.chunk_parent) - len(sub)
        expect("first sub-support chunk", self.first_sub, case["case_first_sub"])
        expect("sub-support chunks", sub, np.arange(len(sub)) + self.first_sub)

        kept = np.flatnonzero(built.bond_map >= 0)
        described = kept[np.argsort(built.bond_map[kept])]
        self.bond_nodes = (asset.bond_nodes - world) % max(nodes, 1)
        expect("bond normals", asset.bond_normal, case["bond_normal"])
        expect("bond areas", asset.bond_area, case["bond_area"])
        expect("bond centroids", asset.bond_centroid, case["bond_centroid"])
        userdata = case["raw_bond_userdata"][described]
        expect("bond userdata", userdata, case["bond_userdata"])
        expect("bonds", len(asset.bond_nodes), case["case_n_bond"])
        ends = self.bond_nodes[np.concatenate([np.arange(len(described))] * 2)]
        ends[len(described) :] = ends[len(described) :, ::-1]
        order = np.lexsort((ends[:, 1], ends[:, 0]))
        expect("adjacent nodes", ends[order, 1], case["adj_node"])
        bond = order % max(len(described), 1)
        expect("adjacent bonds", bond, case["adj_bond"])
        starts = np.searchsorted(ends[order, 0], np.arange(nodes + 1))
        expect("adjacency", starts, case["adj_partition"])

        if self.padded:
            self.capacity = bucket(own)
            self.asset = author.pad(built.asset, self.capacity)
        else:
            # As many levels as a padded one is traced for: sizes alone tell programs
            # apart, of which each costs a compilation.
            self.capacity = own
            self.asset = built.asset.replace(depth=max(4, own.depth), height=4)
        self.shift = int(self.asset.has_world)
        self.call = compiled()

    def node(self, index):
        """Return the library's number of a node of Blast's, padded."""
        world = signed(self.case["node_chunk"])[index] < 0
        return np.where(world, 0, np.asarray(index, np.int64) + self.shift)

    def element(self, chunk):
        """Return the element of a chunk, padded; -1 above the support level."""
        return np.asarray(self.asset.chunk_element)[np.asarray(chunk, np.int64)]

    def start(self):
        """Make the state and compare it."""
        case, size = self.case, self.capacity
        bond = np.zeros(size.bonds, np.float32)
        if case["case_bond_health_mode"]:
            bond[: len(case["init_bond_health"])] = case["init_bond_health"]
        else:
            bond[:] = case["case_uniform_bond_health"]
        chunk = np.zeros(size.nodes, np.float32)
        if case["case_chunk_health_mode"]:
            chunk[self.node(np.arange(self.num_nodes))] = case["init_chunk_health"]
        else:
            chunk[:] = case["case_uniform_chunk_health"]
        self.state = self.call["init"](self.asset, bond, chunk)
        self.compare(0)

    def label(self, actor):
        """Return the label of an actor of Blast's, now."""
        actor = int(actor)
        if actor >= self.num_nodes:
            return int(self.element(actor - self.num_nodes + self.first_sub))
        return int(np.asarray(self.state.actor)[self.node(actor)])

    def chosen(self, actor):
        """Return the mask that names one actor."""
        return np.arange(self.state.actor.shape[0]) == self.label(actor)

    def operate(self, op):
        """Deal and apply one damage; return whether to go on."""
        kind, actors = int(op["op_kind"]), self.chosen(op["op_actor"])
        where = f"round {op['op_round']} actor {op['op_actor']} program {kind}"
        recorded = self.recorded(op)
        dealt = recorded
        if kind:
            params = op["op_params"]
            if params[15] == 1:
                health, low, high = op["op_material"]
                material = damage.Material(health, low, high)
                amount = damage.normalize(material, op["op_raw_damage"])
                self.expect(where + " material", amount, params[0], close=True)
            ours = self.call[kind](self.asset, self.state, params, actors)
            dealt = self.judge(where, op, ours, recorded[0])
        for part in dealt:
            self.state = self.call["apply"](self.asset, self.state, part, actors)
        if op["op_margin"] < MARGIN:
            self.differences["margin too small to tell"] += 1
            return False
        can_fracture, split_required = self.call["flags"](self.asset, self.state)
        label = self.label(op["op_actor"])
        same = self.expect(
            where + " can fracture", can_fracture[label], bool(op["op_can_fracture"])
        )
        return same and self.expect(
            where + " split required",
            split_required[label],
            bool(op["op_split_required"]),
        )

    def judge(self, where, op, ours, recorded):
        """Compare a program's damage with the recorded; return what to apply."""
        bond, chunk = np.asarray(ours.bond), np.asarray(ours.chunk)
        if op["op_kind"] == SPREAD:
            several = np.asarray(chunks.node_count(self.asset, self.state))
            if not op["op_params"][14] and several[self.label(op["op_actor"])] > 1:
                # Blast's spread needs scratch memory; without, it does nothing.
                self.differences["spread without scratch memory"] += 1
                return [recorded]
            if not np.allclose(bond, recorded.bond, rtol=RTOL, atol=RTOL):
                # By the shortest way a bond is never further away than by any other.
                nearer = (bond >= recorded.bond - RTOL * (1 + recorded.bond)).all()
                self.expect(where + " spread at least as far", nearer, True)
                self.differences["spread by the shortest way"] += 1
                return [recorded]
        self.expect(where + " bond damage", bond, recorded.bond, close=True)
        self.expect(where + " chunk damage", chunk, recorded.chunk, close=True)
        return [ours]

    def recorded(self, op):
        """Return recorded commands as damages to apply one after another.

        Blast takes commands one by one, and a chunk that lost its health ignores the
        next; commands to one chunk therefore come in as many parts.
        """
        bond = np.zeros(self.capacity.bonds, np.float32)
        index = {tuple(pair): i for i, pair in enumerate(np.sort(self.bond_nodes))}
        for pair, amount in zip(op["bcmd_nodes"], op["bcmd_health"], strict=True):
            at = index.get(tuple(sorted(map(int, pair))))
            if at is not None and amount > 0:
                with np.errstate(over="ignore"):
                    bond[at] += amount
        parts = []
        turn = collections.Counter()
        for chunk, amount in zip(op["ccmd_chunk"], op["ccmd_health"], strict=True):
            element = int(self.element(chunk))
            if element < 0 or not amount > 0:
                continue
            if turn[element] == len(parts):
                parts.append(np.zeros(self.state.chunk_health.shape, np.float32))
            parts[turn[element]][element] = amount
            turn[element] += 1
        none = np.zeros(self.state.chunk_health.shape, np.float32)
        parts = parts or [none]
        damages = [Damage(bond=np.zeros_like(bond), chunk=part) for part in parts]
        damages[-1] = damages[-1].replace(bond=bond)
        return damages

    def compare(self, number):
        """Compare the state after a round; return whether it agrees."""
        recorded, before = self.case["states"][number], len(self.found)
        where = f"round {number}"
        state = self.state
        nodes, bonds = self.num_nodes, int(self.case["case_n_bond"])
        health = np.asarray(state.bond_health)[:bonds]
        self.expect(where + " bond health", health, recorded["bond_health"], close=True)
        chunk_health = np.asarray(state.chunk_health)
        mine = self.node(np.arange(nodes))
        world = signed(self.case["node_chunk"]) < 0
        subs = np.arange(len(recorded["chunk_health"]) - nodes) + self.capacity.nodes
        ours = np.concatenate([chunk_health[mine][~world], chunk_health[subs]])
        theirs = recorded["chunk_health"]
        theirs = np.concatenate([theirs[:nodes][~world], theirs[nodes:]])
        self.expect(where + " chunk health", ours, theirs, close=True)

        owner, visible, held, can_fracture, split_required = map(
            np.asarray, self.call["view"](self.asset, state)
        )
        actor = np.asarray(state.actor)
        real = np.asarray(self.asset.element_chunk) >= 0
        unseen = set(actor[real & (actor >= 0)].tolist())
        for theirs in recorded["actors"]:
            name = f"{where} actor {theirs['actor_index']}"
            index = int(theirs["actor_index"])
            if len(theirs["nodes"]):
                label = int(actor[self.node(theirs["nodes"][0])])
                members = np.sort(self.node(theirs["nodes"]))
            else:
                chunk = index - nodes + self.first_sub
                members = np.atleast_1d(self.element(chunk))
                label = int(actor[members[0]])
            ours = np.flatnonzero((actor == label) & real)
            if label < 0 or not self.expect(name + " elements", ours, members):
                self.found.append(f"{name} has label {label}")
                break
            unseen.discard(label)
            seen = np.flatnonzero(visible & (owner == label))
            self.expect(name + " visible chunks", seen, theirs["visible"])
            external = bool(theirs["actor_external"])
            if held[label] != external and not self.unsplit(recorded, theirs):
                self.expect(name + " held", held[label], external)
            can = bool(theirs["actor_can_fracture"])
            self.expect(name + " can fracture", can_fracture[label], can)
            required = bool(theirs["actor_split_required"])
            self.expect(name + " split required", split_required[label], required)
        self.expect(where + " further actors", sorted(unseen), [])
        chunk_actor = signed(recorded["chunk_actor"])
        owned = owner[: len(chunk_actor)] >= 0
        self.expect(where + " owned chunks", owned, chunk_actor >= 0)
        return len(self.found) == before

    def unsplit(self, recorded, actor):
        """Whether an actor, not split yet, is of parts that the world is not all of."""
        members = list(map(int, actor["nodes"]))
        if actor["actor_graph_node_count"] > len(members):
            members.append(self.num_nodes - 1)
        parted = len(set(recorded["node_island"][members].tolist())) > 1
        self.differences["unsplit, world elsewhere"] += parted
        return parted


def accepts(described, bonds):
    """Return whether strict building takes the descriptions."""
    try:
        author.build(described, bonds, strict=True, drop_invalid_bonds=True)
    except ValueError:
        return False
    return True


def check_lowlevel(case):
    """Replay a case through the library; return mismatches and counted differences."""
    replay = Replay(case).run()
    return replay.found, replay.differences


def check_desc(case):
    """Compare the authoring of one descriptor; return mismatches."""
    found = []

    def expect(what, ours, theirs):
        if not np.array_equal(ours, theirs):
            found.append(f"{what}: {ours} instead of {theirs}")

    parent, support = signed(case["desc_parent"]), case["desc_flags"] & 1
    count = int(case["desc_n_chunk"])

    def created(support, order=None):
        zeros = np.zeros((count, 3))
        described = author.Chunks(parent, zeros, np.zeros(count), support)
        if order is not None:
            described, _ = author.reorder(described, author.Bonds.none(), order)
        return accepts(described, None)

    expect("accepted", created(support), bool(case["desc_create_ok"]))
    if case["desc_acyclic"]:
        try:
            raw_map, ordered = author.reorder_map(parent, support)
            expect("raw order", ordered, bool(case["desc_map_raw_ret"]))
            expect("raw map", raw_map, case["desc_map_raw"])
        except ValueError:
            expect(
                "raw map refused", True, bool((case["desc_map_raw"] == 0xDEAD).all())
            )
            expect("raw order", False, bool(case["desc_map_raw_ret"]))
        covered, exact = author.ensure_coverage(parent, support)
        expect("coverage exact", exact, bool(case["desc_cov_ret"]))
        expect("coverage", covered, case["desc_cov_flags"] & 1)
        expect("covered accepted", created(covered), bool(case["desc_create_cov_ok"]))
        order, ordered = author.reorder_map(parent, covered)
        expect("ordered", ordered, bool(case["desc_map_ret"]))
        expect("map", order, case["desc_map"])
        accepted = created(covered, order)
        expect("final accepted", accepted, bool(case["desc_create_final_ok"]))
    health, low, high, amount, units = case["material_hmmdo"]
    ours = damage.normalize(damage.Material(health, low, high), jnp.float32(amount))
    expect("material", np.float32(ours), units)
    return found
