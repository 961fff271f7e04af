"""Reader of recordings of Blast: npz files of flat columns, cut up into cases.

A column holds the rows of all cases one after another. How many of them belong to a
case (or to an op, a state, an actor) is written in other columns. Every row must belong
to something: a column that is too short or too long raises ValueError.
"""

import pathlib

import numpy as np

DATA = pathlib.Path(__file__).parent / "data"


class Columns:
    """The columns of one file, each read once from its first to its last row."""

    def __init__(self, path, kind):
        with np.load(path) as file:
            self.data = {name: file[name] for name in file.files}
        self._check_columns(kind)
        self.at = dict.fromkeys(self.data, 0)
        self.groups = {}

    def _check_columns(self, kind):
        """Refuse a file whose columns have another type or width than ours."""
        with np.load(DATA / f"{kind}.npz") as file:
            for name in file.files:
                if name not in self.data:
                    raise ValueError(f"column {name} is missing")
                ours, theirs = (
                    (x.dtype, x.ndim, x.shape[1:])
                    for x in (file[name], self.data[name])
                )
                if ours != theirs:
                    raise ValueError(f"column {name} is {theirs} instead of {ours}")

    def rows(self, name, count):
        """Return the next `count` rows of a column."""
        start, stop = self.at[name], self.at[name] + int(count)
        if stop > len(self.data[name]):
            raise ValueError(f"column {name} ends before row {stop}")
        self.at[name] = stop
        return self.data[name][start:stop]

    def ragged(self, names, count):
        """Return the next `count` rows of several columns, by name."""
        return {name: self.rows(name, count) for name in names.split()}

    def record(self, prefix, ragged=""):
        """Return the next row of all columns of a prefix but the ragged ones."""
        if prefix not in self.groups:
            self.groups[prefix] = [
                n for n in self.data if n.startswith(prefix) and n not in ragged.split()
            ]
        return {n: self.rows(n, 1)[0] for n in self.groups[prefix]}

    def finish(self, number):
        """Check that nothing is left and that the numbers of the cases ascend."""
        if np.any(np.diff(self.data[number].astype(np.int64)) <= 0):
            raise ValueError(f"column {number} does not ascend")
        for name, stop in self.at.items():
            if stop != len(self.data[name]):
                left = len(self.data[name]) - stop
                raise ValueError(f"column {name} has {left} rows that nothing claims")


RAW_CHUNK = """raw_chunk_centroid raw_chunk_volume raw_chunk_parent raw_chunk_flags
    raw_chunk_userdata cov_chunk_flags reorder_map re_chunk_parent re_chunk_flags
    re_chunk_userdata"""
RAW_BOND = """raw_bond_normal raw_bond_area raw_bond_centroid raw_bond_userdata
    raw_bond_chunks re_bond_chunks re_bond_normal"""
CHUNK = """chunk_centroid chunk_volume chunk_parent chunk_first_child chunk_child_stop
    chunk_userdata chunk_node chunk_leaf_count"""
BOND = "bond_normal bond_area bond_centroid bond_userdata init_bond_health"
NODE = "node_chunk init_chunk_health"
STATE = "state_bond_health state_chunk_health state_chunk_actor state_node_island"
DESC = "desc_parent desc_flags desc_cov_flags desc_map_raw desc_map"
SOLVER_NODE = "node_chunk node_mass node_volume node_pos"
SOLVER_BOND = """bond_nodes bond_normal bond_area bond_centroid bond_userdata
    bond_init_health"""
FRAME_NODE = "frame_node_vel frame_node_island frame_solver_node"
FRAME_BOND = """frame_bond_health frame_bond_in_solver frame_stress_normal
    frame_stress_shear"""
FRAME_SBOND = "frame_sbond_nodes frame_sbond_lin frame_sbond_ang"


def lowlevel_cases(path):
    """Yield the cases of a recording of the low-level library, a dict each.

    Columns keep their names. `ops`, `splits` and `states` are lists by round (round 0
    is the creation); of these, ops and splits are lists again.
    """
    columns = Columns(path, "lowlevel")
    for _ in range(len(columns.data["case_id"])):
        yield _lowlevel_case(columns)
    columns.finish("case_id")


def _lowlevel_case(columns):
    case = columns.record("case_")
    case |= columns.ragged(RAW_CHUNK, case["case_n_raw_chunk"])
    case |= columns.ragged(RAW_BOND, case["case_n_raw_bond"])
    case |= columns.ragged(CHUNK, case["case_n_chunk"])
    case |= columns.ragged(BOND, case["case_n_bond"])
    case |= columns.ragged(NODE, case["case_n_node"])
    case |= columns.ragged("adj_partition", int(case["case_n_node"]) + 1)
    case |= columns.ragged("adj_node adj_bond", 2 * int(case["case_n_bond"]))
    rounds = int(case["case_n_round"])
    if rounds >= len(columns.data["state_round"]):
        raise ValueError(
            f"case {case['case_id']} has {rounds} rounds, of too few states"
        )
    ops = [_op(columns) for _ in range(int(case["case_n_op"]))]
    splits = [_split(columns) for _ in range(int(case["case_n_split"]))]
    case["ops"] = _by_round(ops, "op", case["case_id"], rounds)
    case["splits"] = _by_round(splits, "split", case["case_id"], rounds)
    case["states"] = [_state(columns, case) for _ in range(rounds + 1)]
    return case


def _op(columns):
    op = columns.record("op_")
    op |= columns.ragged("bcmd_nodes bcmd_health", op["op_n_bcmd"])
    op |= columns.ragged("ccmd_chunk ccmd_health", op["op_n_ccmd"])
    op |= columns.ragged("bev_nodes bev_health bev_userdata", op["op_n_bev"])
    op |= columns.ragged("cev_chunk cev_health cev_userdata", op["op_n_cev"])
    return op


def _split(columns):
    split = columns.record("split_", ragged="split_child")
    split["children"] = columns.rows("split_child", split["split_n_child"])
    return split


def _state(columns, case):
    state = columns.record("state_", ragged=STATE)
    for name, size in zip(
        STATE.split(), ("n_bond", "n_lower", "first_sub", "n_node"), strict=True
    ):
        rows = columns.rows(name, case[f"case_{size}"])
        state[name.removeprefix("state_")] = rows
    state["actors"] = []
    for _ in range(int(state["state_n_actor"])):
        actor = columns.record("actor_", ragged="actor_nodes actor_vis")
        actor["nodes"] = columns.rows("actor_nodes", actor["actor_n_node"])
        actor["visible"] = columns.rows("actor_vis", actor["actor_n_vis"])
        state["actors"].append(actor)
    return state


def _by_round(rows, what, case_id, rounds):
    """Sort rows into rounds, which must ascend from 1; all must be of this case."""
    grouped = [[] for _ in range(rounds + 1)]
    last = 1
    for row in rows:
        if row[f"{what}_case"] != case_id:
            raise ValueError(f"{what} of case {row[f'{what}_case']} in case {case_id}")
        if not last <= row[f"{what}_round"] <= rounds:
            raise ValueError(f"{what} of case {case_id} in a round out of order")
        last = int(row[f"{what}_round"])
        grouped[last].append(row)
    return grouped


def desc_cases(path):
    """Yield the cases of a recording of chunk descriptors, a dict each."""
    columns = Columns(path, "desc")
    for _ in range(len(columns.data["desc_id"])):
        yield _desc_case(columns)
    columns.finish("desc_id")


def _desc_case(columns):
    case = columns.record("desc_", ragged=DESC)
    case |= columns.ragged(DESC, case["desc_n_chunk"])
    case["material_hmmdo"] = columns.rows("material_hmmdo", 1)[0]
    return case


def stress_cases(path):
    """Yield the cases of a recording of the stress solver, a dict each.

    Columns keep their names; `frames` is a list of dicts, one an update.
    """
    columns = Columns(path, "stress")
    for _ in range(len(columns.data["case_id"])):
        yield _stress_case(columns)
    columns.finish("case_id")


def _stress_case(columns):
    case = columns.record("case_")
    case |= columns.ragged(SOLVER_NODE, case["case_n_node"])
    case |= columns.ragged(SOLVER_BOND, case["case_n_bond"])
    case["frames"] = [
        _frame(columns, case, number) for number in range(int(case["case_n_frame"]))
    ]
    return case


def _frame(columns, case, number):
    ragged = f"{FRAME_NODE} {FRAME_BOND} {FRAME_SBOND}"
    frame = columns.record("frame_", ragged=ragged)
    if frame["frame_case"] != case["case_id"] or frame["frame_index"] != number:
        where = f"frame {frame['frame_index']} of case {frame['frame_case']}"
        raise ValueError(f"{where} in place of {number} of case {case['case_id']}")
    frame |= columns.ragged(FRAME_NODE, case["case_n_node"])
    frame |= columns.ragged(FRAME_BOND, case["case_n_bond"])
    frame |= columns.ragged(FRAME_SBOND, frame["frame_n_solver_bond"])
    frame |= columns.ragged("load_type load_arg load_params", frame["frame_n_load"])
    frame |= columns.ragged("cmd_actor cmd_nodes cmd_health", frame["frame_n_cmd"])
    frame |= columns.ragged(
        "excess_actor excess_force excess_torque", frame["frame_n_excess"]
    )
    return frame
