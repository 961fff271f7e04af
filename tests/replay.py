"""Replay of recorded cases through the reference, bit by bit.

`verify_lowlevel` and `verify_desc` take a case from `recorded` and return what does not
agree, in words; an empty list means that every number of the case is what the rules
make of the case's inputs, or what the recorder is known to write where it has nothing
to say. Inputs that nothing depends on can only be checked for their range.
"""

import math

import numpy as np

from tests import reference as ref

INV = ref.INV
UNWRITTEN = 0xDEAD
"""What the recorder writes for a map that Blast did not write."""
NOT_CALLED = 2
"""What the recorder writes for the result of a call it did not make."""
KINDS = ["explicit", "falloff", "cutter", "capsule", "shear", "triangle", "impact"]
RECORDS = ["separate", "in place", "nothing"]
NUM_KINDS = 10
"""Of generators of cases."""
FLAGS = [
    "shuffled",
    "inexact",
    "world",
    "junk",
    "odd_healths",
    "small_buffers",
    "zero_areas",
    "random_normals",
    "odd_damage",
]
UNLIKELY = 1e-6
"""A flag whose traces would be missing this rarely by chance must show them."""
ZERO_AREA_CHANCE, ODD_CHANCE = 0.2, 0.1
"""How often the recorder makes an area 0, or a health or a damage odd."""
NO_MARGIN = ref.FLT_MAX


def bits(values):
    """Integers that are equal exactly when the numbers are, bit by bit."""
    values = np.asarray(values)
    if values.dtype.kind == "f":
        return values.astype(np.float32, copy=False).view(np.uint32)
    return values.astype(np.int64)


class Report:
    """A list of differences."""

    def __init__(self, case):
        self.case, self.where, self.lines = case, "", []

    def holds(self, what, truth):
        """Note `what` unless it is so."""
        if not truth:
            self.lines.append(f"case {self.case}{self.where}: {what}")

    def same(self, what, ours, recorded):
        """Note the first element in which two arrays differ."""
        ours, recorded = np.asarray(ours), np.asarray(recorded)
        if ours.size == recorded.size == 0:
            return
        if ours.shape != recorded.shape:
            self.holds(f"{what}: shape {recorded.shape} for {ours.shape}", False)
            return
        differ = np.argwhere(bits(ours) != bits(recorded))
        if len(differ):
            at = tuple(int(i) for i in differ[0])
            text = f"{what}{list(at) or ''}: {recorded[at]} recorded, ours {ours[at]}"
            self.holds(text, False)

    def columns(self, recorded, prefix="", **ours):
        """Compare several columns by name."""
        for name, values in ours.items():
            self.same(prefix + name, values, recorded[prefix + name])


def verify_lowlevel(case):
    """List what in a recorded low-level case differs from the reference."""
    return _verify(case, case["case_id"], _replay)


def verify_desc(case):
    """List what in a recorded descriptor case differs from the reference."""
    return _verify(case, case["desc_id"], _replay_desc)


def _verify(case, number, replay):
    report = Report(number)
    try:
        with np.errstate(all="ignore"):
            replay(case, report)
    except Exception as error:  # a corrupt case may break anything
        report.holds(f"the replay broke down: {error!r}", False)
    return report.lines


def _replay(case, report):
    chunks, bonds = _describe(case, report)
    asset = ref.Asset(chunks, bonds)
    _check_asset(asset, chunks, case, report)
    _check_fillers(asset, case, report)
    _check_flags(case, report)
    family = _instance(asset, case)
    for number, state in enumerate(case["states"]):
        for i, op in enumerate(case["ops"][number]):
            report.where = f" round {number} op {i}"
            _check_op(family, op, case, report)
        touched = {int(op["op_actor"]) for op in case["ops"][number]}
        report.where = f" round {number}"
        _check_splits(family, case["splits"][number], touched, case, report)
        report.holds("round of the state", state["state_round"] == number)
        report.holds("case of the state", state["state_case"] == case["case_id"])
        _check_state(family, state, report)
        if report.lines:
            return


# Descriptors and asset


def _describe(case, report):
    """Repair and reorder the raw descriptors, and compare on the way."""
    raw = {name[4:]: rows for name, rows in case.items() if name.startswith("raw_")}
    n = len(raw["chunk_parent"])
    chunks = ref.Chunks(
        raw["chunk_parent"],
        raw["chunk_flags"],
        raw["chunk_centroid"],
        raw["chunk_volume"],
        raw["chunk_userdata"],
    )
    bonds = ref.Bonds(
        raw["bond_chunks"],
        raw["bond_normal"],
        raw["bond_area"],
        raw["bond_centroid"],
        raw["bond_userdata"],
    )
    report.same("raw_chunk_flags", chunks.support, raw["chunk_flags"])
    raw_reason = ref.rejection(chunks.parent, chunks.support)
    if raw_reason == "loop":
        raise ValueError("the parents form a loop")
    chunks.support, exact = ref.ensure_coverage(chunks.parent, chunks.support)
    reason = ref.rejection(chunks.parent, chunks.support)
    new_index, ordered = ref.reorder_map(chunks.parent, chunks.support)
    report.columns(
        case,
        case_n_raw_chunk=n,
        case_n_raw_bond=len(bonds.chunks),
        case_create_raw_ok=raw_reason is None,
        case_cov_ret=exact,
        cov_chunk_flags=chunks.support,
        case_create_cov_ok=reason is None,
        case_map_ret=ordered,
        reorder_map=new_index,
    )
    report.holds("case_keep_normal_order", case["case_keep_normal_order"] in (0, 1))
    if not ordered:
        keep = case["case_keep_normal_order"]
        chunks, bonds = ref.reorder(chunks, bonds, new_index, keep)
    report.columns(
        case,
        "re_",
        chunk_parent=chunks.parent,
        chunk_flags=chunks.support,
        chunk_userdata=chunks.userdata,
        bond_chunks=bonds.chunks,
        bond_normal=bonds.normal,
    )
    return chunks, bonds


def _check_asset(asset, chunks, case, report):
    ranges = np.array([(c[0], c[-1] + 1) if c else (INV, INV) for c in asset.children])
    degrees = [len(entries) for entries in asset.adjacency]
    links = [link for entries in asset.adjacency for link in entries]
    report.columns(
        case,
        "case_",
        created=1,
        create_warnings=len(asset.warnings),
        create_errors=0,
        n_chunk=asset.n_chunk,
        n_bond=asset.n_bond,
        n_node=asset.n_node,
        n_support=asset.n_support,
        n_leaf=asset.children.count([]),
        first_sub=asset.first_sub,
        n_lower=asset.n_lower,
        asset_size=asset.size,
        n_op=sum(map(len, case["ops"])),
        n_split=sum(map(len, case["splits"])),
        n_round=len(case["states"]) - 1,
        n_state=len(case["states"]),
    )
    report.columns(
        case,
        chunk_centroid=asset.chunk_centroid,
        chunk_volume=asset.chunk_volume,
        chunk_parent=asset.chunk_parent,
        chunk_first_child=ranges[:, 0],
        chunk_child_stop=ranges[:, 1],
        chunk_userdata=asset.chunk_userdata,
        chunk_node=asset.chunk_node,
        chunk_leaf_count=asset.leaf_count,
        bond_normal=asset.bond_normal,
        bond_area=asset.bond_area,
        bond_centroid=asset.bond_centroid,
        bond_userdata=asset.bond_userdata,
        node_chunk=asset.node_chunk,
        adj_partition=np.cumsum([0, *degrees]),
        adj_node=[node for node, _ in links],
        adj_bond=[bond for _, bond in links],
    )


def _instance(asset, case):
    """Make the family with the healths of the case."""
    healths = [
        case[
            f"init_{what}_health"
            if case[f"case_{what}_health_mode"]
            else f"case_uniform_{what}_health"
        ]
        for what in ("bond", "chunk")
    ]
    return ref.Family(asset, *healths)


def _check_fillers(asset, case, report):
    """Check numbers that nothing depends on against the recorder's habits."""
    report.same(
        "raw_chunk_userdata",
        1000 + np.arange(asset.n_chunk),
        case["raw_chunk_userdata"],
    )
    report.same(
        "raw_bond_userdata",
        5000 + np.arange(case["case_n_raw_bond"]),
        np.sort(case["raw_bond_userdata"]),
    )
    lengths = ref.length(case["raw_bond_normal"])
    report.holds("raw_bond_normal: not of length 1", np.all(abs(lengths - 1) < 1e-5))
    for what in ("bond", "chunk"):
        mode = case[f"case_{what}_health_mode"]
        uniform = case[f"case_uniform_{what}_health"]
        rows = case[f"init_{what}_health"]
        report.holds(f"case_{what}_health_mode", mode in (0, 1))
        report.holds(
            f"case_uniform_{what}_health: out of range", 0.2 <= uniform < 3.001
        )
        if mode == 0:
            report.same(f"init_{what}_health", np.full_like(rows, uniform), rows)
        else:
            report.holds(f"case_uniform_{what}_health: 1 if unused", uniform != 1)
            report.holds(
                f"case_{what}_health_mode: uniform as it is",
                not len(rows) or np.any(bits(rows) != bits(uniform)),
            )
    if case["case_chunk_health_mode"] and asset.world != INV:
        unused = case["init_chunk_health"][-1]
        report.holds(
            "init_chunk_health of the world: out of range",
            0.1 <= unused < 2.001 or _is_odd(unused),
        )
    report.holds("case_kind: out of range", case["case_kind"] < NUM_KINDS)


def _is_odd(values):
    """Whether healths or damages are 0, negative, NaN, infinite or huge."""
    return ~(np.asarray(values) > 0) | (np.asarray(values) > 1e30)


def _check_flags(case, report):
    """Check what the flags say of the inputs; random_normals has no sure sign."""
    flags = int(case["case_flags"])
    report.holds("case_flags: out of range", flags < 2 ** len(FLAGS))
    has = {name: bool(flags >> i & 1) for i, name in enumerate(FLAGS)}

    def check(name, seen, chance_unseen):
        if has[name] != seen and (seen or chance_unseen < UNLIKELY):
            report.holds(f"case_flags: {name} is {has[name]}", False)

    parent = [p if p != INV else -1 for p in ref.indices(case["raw_chunk_parent"])]
    ordered = parent == sorted(parent) and all(p < i for i, p in enumerate(parent))
    sizes = np.unique(parent, return_counts=True)[1]  # of the groups of siblings
    chance = -math.lgamma(len(parent) + 1) + sum(math.lgamma(k + 1) for k in sizes)
    check("shuffled", not ordered, math.exp(chance))
    check("inexact", not case["case_cov_ret"], 1)
    check("world", bool(case["case_n_node"] > case["case_n_support"]), 0)
    areas = case["raw_bond_area"]
    check("zero_areas", bool((areas == 0).any()), (1 - ZERO_AREA_CHANCE) ** len(areas))

    odd = count = 0
    for what in ("bond", "chunk"):
        if case[f"case_{what}_health_mode"]:
            healths = case[f"init_{what}_health"]
            usual = healths == case["bond_area"] if what == "bond" else False
            odd += np.sum(_is_odd(healths) & ~np.asarray(usual))
            count += len(healths)
    check("odd_healths", bool(odd), (1 - ODD_CHANCE) ** count)

    ops = [op for ops in case["ops"] for op in ops]
    explicit = [
        op[f"{kind}_health"]
        for op in ops
        if op["op_kind"] == 0
        for kind in ("bcmd", "ccmd")
    ]
    damage = np.concatenate([*explicit, np.zeros(0, np.float32)])
    check("odd_damage", bool(_is_odd(damage).any()), (1 - ODD_CHANCE) ** len(damage))


# Ops


def _check_op(family, op, case, report):
    """Replay one generate and apply."""
    actor, kind, mode = (
        int(op[f"op_{name}"]) for name in ("actor", "kind", "event_mode")
    )
    report.holds("op_actor: not active", actor in family.actors)
    report.holds("op_kind", kind < len(KINDS))
    report.holds("op_event_mode", mode < len(RECORDS))
    _check_capacities(family.asset, op, case, report)
    _check_parameters(op, report)
    bond_commands = _rows(op, "bcmd_nodes bcmd_health")
    chunk_commands = _rows(op, "ccmd_chunk ccmd_health")
    if kind:
        named = parameters(KINDS[kind], op["op_params"])
        ours = family.generate(actor, KINDS[kind], named)
        _same_rows("bond command", ours[0], bond_commands, report)
        _same_rows("chunk command", ours[1], chunk_commands, report)
    else:
        _check_explicit(family.asset, bond_commands, chunk_commands, report)
    report.same("op_margin", _margin(family, op, bond_commands), op["op_margin"])
    events = family.apply(
        actor,
        bond_commands,
        chunk_commands,
        record=RECORDS[mode],
        bond_room=int(op["op_cap_bev"]),
        chunk_room=int(op["op_cap_cev"]),
    )
    bond_events = _rows(op, "bev_userdata bev_nodes bev_health")
    _same_rows("bond event", events.bonds, bond_events, report)
    chunk_events = _rows(op, "cev_userdata cev_chunk cev_health")
    _same_rows("chunk event", events.chunks, chunk_events, report)
    report.columns(
        op,
        "op_",
        n_bcmd=len(bond_commands),
        n_ccmd=len(chunk_commands),
        n_bev=len(bond_events),
        n_cev=len(chunk_events),
        apply_warnings=len(events.warnings),
        split_required=family.split_required(actor),
        can_fracture=family.can_fracture(actor),
    )


def _rows(op, names):
    """Rows of several columns as flat tuples of Python ints and float32."""
    columns = []
    for name in names.split():
        if name.endswith("health"):
            columns.append(list(op[name]))
        else:
            columns += np.atleast_2d(op[name].T).tolist()
    return list(zip(*columns, strict=True))


def _same_rows(what, ours, recorded, report):
    """Compare rows whose last entry is a float."""
    report.same(f"{what}s", len(ours), len(recorded))
    for i, (a, b) in enumerate(zip(ours, recorded, strict=False)):
        if a[:-1] != b[:-1] or bits(a[-1]) != bits(b[-1]):
            report.holds(f"{what} {i}: {b} recorded, ours {a}", False)
            return


def parameters(kind, p):
    """Name the recorded parameters of a program."""
    if kind == "triangle":
        return {"damage": p[0], "corners": p[1:10].reshape(3, 3)}
    named = dict(damage=p[0], position=p[1:4], min_radius=p[10], max_radius=p[11])
    extra = {
        "capsule": ("position1", p[4:7]),
        "shear": ("normal", p[4:7]),
        "impact": ("accelerator", p[14]),
    }
    return named | dict([extra[kind]]) if kind in extra else named


USED = {
    "explicit": [],
    "falloff": [0, 1, 2, 3, 10, 11, 15],
    "cutter": [0, 1, 2, 3, 10, 11, 15],
    "capsule": [0, 1, 2, 3, 4, 5, 6, 10, 11, 15],
    "shear": [0, 1, 2, 3, 4, 5, 6, 10, 11, 15],
    "triangle": [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 15],
    "impact": [0, 1, 2, 3, 10, 11, 14, 15],
}
"""Parameters that a kind of op uses; the others are 0."""


def _check_parameters(op, report):
    """Check unused parameters, and the damage against the material."""
    kind, p = KINDS[op["op_kind"]], op["op_params"]
    unused = np.delete(p, USED[kind])
    report.same("op_params: unused", np.zeros_like(unused), unused)
    material, raw = op["op_material"], op["op_raw_damage"]
    if kind == "explicit":
        report.same("op_material: unused", np.float32([100, 0, 1]), material)
        report.same("op_raw_damage: unused", np.float32(0), raw)
        return
    normalized = ref.normalized_damage(*material, raw)
    report.holds("op_params[14], op_params[15]", set(p[14:].tolist()) <= {0.0, 1.0})
    report.holds(
        "op_params[0]: not the normalized damage",
        (bits(p[0]) == bits(normalized)) == (p[15] == 1),
    )
    health, low, high = material
    report.holds(
        "op_material: out of range",
        (health in (-1, 0) or 1 <= health < 200.1)
        and 0 <= low < 0.301
        and 0.5 <= high < 1.001,
    )
    report.holds("op_raw_damage: out of range", 0 < raw < 3.001 * max(health, 1))
    report.holds("op_params[0]: out of range", 0 <= p[0] < 3.001)
    report.holds("op_params: radii", 0 <= p[10] <= p[11])
    if kind == "shear":
        report.holds("op_params: normal", abs(ref.length(p[4:7]) - 1) < 1e-5)
    if kind == "capsule":
        report.holds("op_params: position1", np.all(p[4:7] != 0))


def _check_explicit(asset, bond_commands, chunk_commands, report):
    """Commands that were not generated name real chunks, and bonds if not damage 1."""
    chunks = [chunk for chunk, _ in chunk_commands]
    report.holds("ccmd_chunk: no chunk", all(c < asset.n_chunk for c in chunks))
    pairs = [(min(a, b), max(a, b)) for a, b, damage in bond_commands if damage != 1]
    report.holds("bcmd_nodes: no bond", set(pairs) <= set(asset.bond_between))
    strangers = [(a, b) for a, b, damage in bond_commands if damage == 1]
    report.holds(
        "bcmd_nodes: no two nodes",
        all(a != b and max(a, b) < asset.n_node for a, b in strangers),
    )


def _check_capacities(asset, op, case, report):
    """Buffers are ample or, in cases of small buffers, perhaps of a few events."""
    small = case["case_flags"] & 1 << FLAGS.index("small_buffers")
    for what, size, most in (("b", asset.n_bond, 4), ("c", asset.n_chunk, 3)):
        commands = int(op[f"op_n_{what}cmd"])
        allowed = {4 * size + 64}
        if op["op_event_mode"] == 2:
            allowed = {0}
        elif small and op["op_event_mode"] == 1:
            allowed |= {max(few, commands) for few in range(1, most + 1)}
        elif small:
            allowed |= set(range(1, most + 1))
        name = f"op_cap_{what}ev"
        report.holds(f"{name}: {op[name]}", int(op[name]) in allowed)


def _margin(family, op, bond_commands):
    """How close the recorder saw a health come to 0 without being 0.

    It subtracts the damage of all bond commands from the healths before the op, even
    where Blast ignores them, and looks at the healths in the chunk events.
    """
    health = {}
    left = [h for h in op["cev_health"]]
    for a, b, damage in bond_commands:
        bond = family.asset.bond_between.get((min(a, b), max(a, b)))
        if bond is None:
            continue
        before = health.get(bond, family.bond_health[bond])
        if ref.can_damage(before) and damage > 0:
            left.append(before - damage)
            health[bond] = max(left[-1], np.float32(0))
    margin = NO_MARGIN
    for value in left:
        if value != 0:
            margin = np.fmin(margin, abs(value))
    return margin


# Splits and states


def _check_splits(family, splits, touched, case, report):
    """Replay the recorded splits of a round; others may not have been called."""
    actors = [int(split["split_actor"]) for split in splits]
    report.holds("split_actor: not ascending", actors == sorted(set(actors)))
    small = case["case_flags"] & 1 << FLAGS.index("small_buffers")
    for index, split in zip(actors, splits, strict=True):
        required, room = family.split_required(index), family.max_split(index)
        allowed = {room, max(1, room // 3)} if small else {room}
        report.holds(f"split_max of actor {index}", int(split["split_max"]) in allowed)
        result = family.split(index, int(split["split_max"]))
        report.holds(
            f"split of actor {index}: not worth recording",
            index in touched or required or result.children,
        )
        report.columns(
            split,
            "split_",
            n_child=len(result.children),
            deleted=result.deleted,
            deleted_is_self=result.deleted,
            warnings=len(result.warnings),
        )
        report.same(f"split_child of actor {index}", result.children, split["children"])


def _check_state(family, state, report):
    report.columns(
        state,
        bond_health=family.bond_health,
        chunk_health=family.chunk_health,
        chunk_actor=family.chunk_actor,
        node_island=family.node_island,
        state_n_actor=len(family.actors),
    )
    recorded = [int(actor["actor_index"]) for actor in state["actors"]]
    report.same("actor_index", sorted(family.actors), recorded)
    shown = family.visible()
    for index, row in zip(sorted(family.actors), state["actors"], strict=False):
        members = family.actors[index].nodes
        nodes = [node for node in members if node != family.asset.world]
        report.columns(
            row,
            nodes=nodes,
            visible=shown[index],
            actor_n_node=len(nodes),
            actor_n_vis=len(shown[index]),
            actor_graph_node_count=len(members),
            actor_external=family.external(index),
            actor_can_fracture=family.can_fracture(index),
            actor_split_required=family.split_required(index),
            actor_max_split=family.max_split(index),
        )


# Descriptor cases


def _replay_desc(case, report):
    parent, support = ref.indices(case["desc_parent"]), list(case["desc_flags"])
    report.holds("desc_flags", set(support) <= {0, 1})
    reason = ref.rejection(parent, support)
    n = len(parent)
    expected = dict(
        n_chunk=n,
        acyclic=reason != "loop",
        create_ok=reason is None,
        create_warn=reason == "loop",
        create_err=reason in ("coverage", "order"),
    )
    if reason == "loop":
        expected |= dict.fromkeys(
            ("map_raw_ret", "cov_ret", "create_cov_ok", "map_ret", "create_final_ok"),
            NOT_CALLED,
        ) | dict.fromkeys(("map_raw", "map"), np.full(n, UNWRITTEN))
        expected["cov_flags"] = support
    else:
        unwritten = np.full(n, UNWRITTEN)
        new_index, ordered = ref.reorder_map(parent, support)
        expected["map_raw"] = unwritten if new_index is None else new_index
        expected["map_raw_ret"] = ordered
        chunks = ref.Chunks(parent, support)
        chunks.support, expected["cov_ret"] = ref.ensure_coverage(parent, support)
        expected["cov_flags"] = chunks.support
        covered = ref.rejection(parent, chunks.support)
        expected["create_cov_ok"] = covered is None
        expected["map"], expected["map_ret"] = ref.reorder_map(parent, chunks.support)
        chunks, _ = ref.reorder(chunks, ref.Bonds(), expected["map"])
        final = ref.rejection(chunks.parent, chunks.support)
        expected["create_final_ok"] = final is None
    report.columns(case, "desc_", **expected)
    *inputs, normalized = case["material_hmmdo"]
    report.same("material_hmmdo", ref.normalized_damage(*inputs), normalized)
